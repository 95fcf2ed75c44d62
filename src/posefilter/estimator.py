"""From images to poses in one call: what `posefilter.load` returns."""

import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from numbers import Integral
from typing import Any

import numpy as np
import torch
from omegaconf import OmegaConf

from posefilter.confidence.blank import find_blank
from posefilter.confidence.tolerance import PoseTolerance, check_pose_tolerance
from posefilter.confidence.verdicts import Costs, check_costs
from posefilter.devices import choose_device, take_threads
from posefilter.errors import UserError, check_seed, find_reason
from posefilter.images import Images, check_images, make_batch
from posefilter.instances.detect import detect
from posefilter.instances.pixels import resize_mask
from posefilter.limits import MOST_SIDE
from posefilter.models.base import PoseEstimator
from posefilter.precision import in_float32
from posefilter.result import Result, Run, collect_results, make_result, pool_scale_ratios
from posefilter.types import Batch, ObjectModel, Trace

_MOST = 100  # instances of an object


class Estimator:
    """Trained filters, each for one object, that estimate poses from RGB-D images.

    Made by `posefilter.load`.

    Args:
        methods: A method an object, with its weights, its recipe and its object.
        device: Where to compute; None: on the GPU where there is one.
        costs: What errors cost, which verdicts go by.
        pose_tolerance: What a right pose is, which verdicts go by; None: an ADD below 0.1
            diameters.

    Raises:
        UserError: They are no list of methods, or one detects and estimates no pose.
    """

    def __init__(
        self,
        methods: Sequence[PoseEstimator],
        device: str | torch.device | None = None,
        costs: Costs | None = None,
        pose_tolerance: PoseTolerance | None = None,
    ) -> None:
        if not isinstance(methods, (list, tuple)) or not all(
            hasattr(method, "capabilities") for method in methods
        ):
            raise UserError(
                "an estimator needs a list of methods; posefilter.load makes one of a file"
            )
        if not methods:
            raise UserError("an estimator needs the weights of one object at least")
        for method in methods:
            if "pose" not in method.capabilities:
                raise UserError(f"{type(method).__name__} detects, and estimates no pose")
        device = choose_device() if device is None else device
        if str(device).split(":")[0] not in ("cpu", "cuda"):
            raise UserError(f"device={device}: choose cpu, cuda or cuda:N; others have no float64")
        try:
            self.methods = tuple(method.to(device).eval() for method in methods)
        except (RuntimeError, AssertionError) as error:  # torch's, of devices that are not there
            why = find_reason(error)
            raise UserError(f"device={device}: cannot be used ({why})") from error
        check_costs(costs)
        check_pose_tolerance(pose_tolerance)
        self.costs, self.pose_tolerance = costs or Costs(), pose_tolerance
        for method in self.methods:
            if pose_tolerance is not None and method.calibration is not None:
                method.calibration.fit_success(pose_tolerance)  # refused now, or ready
        self._sizes = tuple(get_trained_size(one.recipe.get("settings", {})) for one in methods)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({', '.join(self.objects)}; {self.methods[0].device})"

    @property
    def objects(self) -> tuple[str, ...]:
        """The names of the objects, in the order of the results."""
        return tuple(method.object_model.name for method in self.methods)

    @property
    def object_models(self) -> tuple[ObjectModel, ...]:
        """What is known of each object: its center, size, surface points and hull."""
        return tuple(method.object_model for method in self.methods)

    @property
    def models(self) -> tuple[ObjectModel, ...]:
        """The earlier name of `object_models`."""
        return self.object_models

    def predict(
        self,
        rgb: Any,
        depth: Any,
        intrinsics: Any,
        *,
        instances: int | Mapping[str, int] | None = None,
        seed: int = 0,
    ) -> Any:
        """Find each object in an image, or in each of a batch.

        With `instances`, an image may show an object more than once, and no two results are on the
        same pixels: the more probable keeps them.  An object that is absent then has no result;
        in an image that cannot be judged (`Result.blank`) each has one, which is unsure.

        Args:
            rgb: Color, RGB, as a numpy array or tensor: (H, W, 3) or (3, H, W), uint8 or float in
                [0, 1]; or a batch of B such images.
            depth: z-depth (H, W) in meters, as float, aligned with the color; 0, NaN or more than
                100 m where unknown; or (B, H, W).
            intrinsics: Camera matrix (3, 3) [px] of these images; or one each, (B, 3, 3).
            instances: How many of each object an image shows at most: a number, or one for each
                name, 1 for those left out.  None: one answer an object, whatever it covers.
            seed: Decides every random draw of the filter: the same images and seed give the same
                answer.  An image has other draws in a batch than alone.

        Returns:
            A `Result` where one image is given and one object was loaded; a list of them, an
            object each, where several were loaded; for a batch, a list with one of these an image.
            With `instances` a list of all that is found, the most probable first.
            `predict_batch` returns the same always as a list of lists.

        Raises:
            UserError: Images or intrinsics are not as they should be, or `instances` is no number
                from 1 to 100.
        """
        images, batched = check_images(rgb, depth, intrinsics)
        if instances is not None:
            several = self._detect(images, count_instances(instances, self.objects), seed)
            return several if batched else several[0]
        found = collect_results(self.run(images, seed), self.costs, self.pose_tolerance)
        answers = [own if len(self.methods) > 1 else own[0] for own in found]
        return answers if batched else answers[0]

    def predict_batch(
        self, rgb: Any, depth: Any, intrinsics: Any, *, seed: int = 0
    ) -> list[list[Result]]:
        """Find each object in each image; as `predict`, with the same nesting whatever is given.

        Returns:
            A list an image, of a `Result` an object.
        """
        images, _ = check_images(rgb, depth, intrinsics)
        return collect_results(self.run(images, seed), self.costs, self.pose_tolerance)

    @in_float32
    def _detect(self, images: Images, counts: Sequence[int], seed: int) -> list[list[Result]]:
        """Find several instances: a list of results an image, the most probable first."""
        seed = check_seed(seed)
        take_threads()
        for method in self.methods:
            method.seed = seed
        size = (images.depth.shape[1], images.depth.shape[2])
        out, blank = [], list_blank(images)
        for i in range(len(images.depth)):
            one = Images(*(part[i : i + 1] for part in images))
            if blank[i]:  # what cannot be judged is not searched for more, and is told as such
                runs = self.run(one, seed)
                (results,) = collect_results(runs, self.costs, self.pose_tolerance)
                nothing = np.zeros(size, bool)
                out.append([replace(one, mask=nothing, conformal=None) for one in results])
                continue
            batches = [
                Batch(*(x.to(method.device) for x in make_batch(one, *own)))
                for method, own in zip(self.methods, self._sizes, strict=True)
            ]
            asked = self.costs, self.pose_tolerance
            found, seconds = detect(self.methods, batches, counts, *asked)
            many = Counter(each.number for each in found)
            before, results, runs = Counter[int](), [], []
            for each in found:
                number = each.number
                spent = seconds[number] / many[number]
                method, batch = self.methods[number], batches[number]
                belief, draws = method.calibrate_belief(each.belief, each.assessment)
                trace = Trace((), (), (), belief)
                runs.append(
                    Run(method, batch, trace, spent, each.assessment, each.size, draws=draws)
                )
            for each, run in zip(found, pool_scale_ratios(runs), strict=True):
                number = each.number
                result = make_result(run, 0, self.costs, self.pose_tolerance)
                mask = resize_mask(each.mask, size).cpu().numpy()
                # a conformal set holds for the filter that was calibrated, this one is smaller
                which = before[number]
                results.append(replace(result, instance=which, mask=mask, conformal=None))
                before[number] += 1
            out.append(results)
        return out

    @in_float32
    def run(self, images: Images, seed: int = 0) -> list[Run]:
        """Run each object's filter, and return every step of it: for figures of what it did.

        The trace's belief is the calibrated one, where there is one.
        """
        seed = check_seed(seed)
        take_threads()
        runs, blank = [], list_blank(images)
        for method, size in zip(self.methods, self._sizes, strict=True):
            batch = Batch(*(x.to(method.device) for x in make_batch(images, *size)))
            method.seed = seed
            start = time.perf_counter()
            with torch.no_grad():
                trace = method.predict_step(batch, 0)
                found = method.assess(trace, batch)
                ratio = method.measure_scale_ratio(trace, batch)
                belief, draws = method.calibrate_belief(trace.belief, found)
            trace = trace._replace(belief=belief)
            trace.belief.best.cpu()  # waits for a GPU
            seconds = (time.perf_counter() - start) / len(images.depth)
            runs.append(Run(method, batch, trace, seconds, found, ratio, blank, draws))
        return runs


def list_blank(images: Images) -> list[str]:
    """Return of each image why it cannot be judged, "" where it can be."""
    return [find_blank(*one) for one in zip(images.rgb, images.depth, strict=True)]


def count_instances(instances: int | Mapping[str, int], objects: Sequence[str]) -> list[int]:
    """Return how many instances of each object are searched for.

    Args:
        instances: A number, or one for each name; 1 for the names left out.
        objects: The names.

    Raises:
        UserError: One is no whole number from 1 to 100, or no object has the name.
    """
    wanted = dict(instances) if isinstance(instances, Mapping) else {}
    unknown = sorted(set(wanted) - set(objects))
    if unknown:
        raise UserError(f"instances: {unknown[0]} is not loaded, only {', '.join(objects)}")
    rest = 1 if isinstance(instances, Mapping) else instances
    counts = [wanted.get(name, rest) for name in objects]
    for count in counts:
        whole = isinstance(count, Integral) and not isinstance(count, bool)
        if not whole or not 1 <= count <= _MOST:
            raise UserError(f"instances={count!r}: must be a whole number from 1 to {_MOST}")
    return counts


def get_trained_size(settings: dict[str, Any]) -> tuple[int | None, int | None]:
    """Return the width and height of the images that a method was trained on [px], None where they
    follow the image's.

    Raises:
        UserError: A checkpoint's settings name others than images have.
    """
    trained = OmegaConf.create(settings).get("data") or {}
    width, height = trained.get("image_width"), trained.get("image_height")
    for size in (width, height):
        if size is not None and not (isinstance(size, int) and 0 < size <= MOST_SIDE):
            raise UserError(
                f"checkpoint: was trained on images of {size} pixels, which there are not"
            )
    return width, height
