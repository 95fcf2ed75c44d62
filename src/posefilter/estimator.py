"""From images to poses in one call: what `posefilter.load` returns."""

import math
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from omegaconf import OmegaConf

from posefilter.belief import Belief, Mode, PoseSet
from posefilter.belief.summaries import check_share
from posefilter.confidence.calibration import Assessment
from posefilter.confidence.conformal import Conformal
from posefilter.confidence.verdicts import Costs, Verdict, decide
from posefilter.errors import UserError
from posefilter.images import Images, check_images, make_batch
from posefilter.instances.detect import detect
from posefilter.instances.pixels import resize_mask
from posefilter.limits import MOST_SIDE
from posefilter.models.base import PoseEstimator
from posefilter.plausibility import find_warnings
from posefilter.types import Batch, ObjectModel, Trace
from posefilter.types import Belief as BeliefTensors

if TYPE_CHECKING:
    from posefilter.figures.overlay import Shape

_MOST = 100  # instances of an object


@dataclass(frozen=True, eq=False)
class Result:
    """Where one object is in one image, and how sure that is.

    Attributes:
        object: The object's name.
        pose: The estimate (4, 4), float64: camera_from_object in meters.  The camera's frame is
            OpenCV's (x right, y down, z ahead), the object's that of its mesh file.  It is the best
            guess, also where the object is not there: see `verdict`.
        score: The estimate's log-likelihood.  It ranks poses of one image; between images its level
            is arbitrary, so it is no measure of confidence: `probability` is.
        probability: That the object is there and the pose within 0.1 diameters (ADD, up to the
            object's symmetries), as calibrated on validation scenes.  None where the checkpoint is
            not calibrated; `calibration_note` says why.
        presence: That the object is there, whatever the pose: at least `probability`, or None.
        belief: Every particle and its weight.
        warnings: What makes the estimate implausible, in words; empty where nothing does.
        seconds: The filter's time for this image, its share of a batch.
        model: The object's center, size, surface points and hull.
        costs: What errors cost, which the verdict goes by.
        calibration_note: In words, why there is no probability; empty where there is one.
        conformal: What `conformal_set` goes by; None where the calibration has none.
        surface: The share of the object's surface points at which the depth shows a surface, by
            which the group of a conformal set is chosen.
        instance: Which of its class it is, from 0, the most probable first.
        mask: The pixels (H, W) bool of the image that are its own, where instances were asked for;
            else None.
    """

    object: str
    pose: np.ndarray
    score: float
    probability: float | None
    presence: float | None
    belief: Belief
    warnings: tuple[str, ...]
    seconds: float
    model: ObjectModel
    costs: Costs = field(default_factory=Costs, kw_only=True)
    calibration_note: str = field(default="", kw_only=True)
    conformal: Conformal | None = field(default=None, kw_only=True)
    surface: float = field(default=math.nan, kw_only=True)
    instance: int = field(default=0, kw_only=True)
    mask: np.ndarray | None = field(default=None, kw_only=True)

    @property
    def verdict(self) -> Verdict | None:
        """What to go by: "found", "unsure" or "absent", whichever costs least on average.

        None where there is no probability.  `decide` takes other costs.
        """
        return self.decide(self.costs)

    def decide(self, costs: Costs) -> Verdict | None:
        """Return the verdict at other costs of errors; None where there is no probability."""
        if self.probability is None or self.presence is None:
            return None
        return decide(self.presence, self.probability, costs)

    @property
    def covariance(self) -> np.ndarray:
        """The belief's covariance (6, 6) about its mean pose; see `Belief.covariance`."""
        return self.belief.covariance

    @property
    def modes(self) -> tuple[Mode, ...]:
        """The belief's modes, the heaviest first; see `Belief.modes`."""
        return self.belief.modes

    def conformal_set(self, level: float = 0.9) -> PoseSet:
        """Return a set of poses that holds the truth with a guaranteed probability.

        Of frames like the calibration's that show the object, at least `level` have the truth in
        this set, whatever the belief is worth; see `posefilter.confidence.conformal`.  It is the
        set of all poses where calibration frames are too few for the level.

        Args:
            level: Least probability, in [0, 1].

        Raises:
            UserError: The checkpoint was not calibrated for sets.
        """
        if self.conformal is None:
            why = self.calibration_note or "it was calibrated by an earlier version, without sets"
            raise UserError(f"{self.object}: has no conformal sets ({why})")
        check_share(level)
        limit = self.conformal.find_limit(level, self.surface)
        return self.belief.level_set(level, -self.belief.differential_entropy - limit)

    def draw_overlay(
        self, rgb: np.ndarray, intrinsics: np.ndarray, shape: "Shape | None" = None
    ) -> np.ndarray:
        """Draw the object's outline and axes on the image that it was found in: full where it is
        found, dashed where the verdict is unsure, none where it is absent.

        Args:
            rgb: The image (H, W, 3) uint8, RGB.
            intrinsics: Its camera matrix (3, 3) [px].
            shape: A mesh, for the exact outline; None: the convex hull.

        Returns:
            The picture (h, w, 3) uint8.
        """
        from posefilter.figures.overlay import draw_overlay  # slow to import, needed for pictures

        shape = self.model.hull if shape is None else shape
        pose = None if self.verdict == "absent" else self.pose
        unsure = self.verdict == "unsure"
        K, said = np.asarray(intrinsics), self.describe()
        return draw_overlay(rgb, K, pose, shape, caption=said, dashed=unsure)

    def describe(self) -> str:
        """Return the verdict in a few words: `003_cracker_box: found, probability 0.97`."""
        if self.verdict is None:
            return f"{self.object}, score {self.score:.2f}"
        if self.verdict == "absent":
            return f"{self.object}: absent, probability {self.presence:.2f} that it is there"
        return f"{self.object}: {self.verdict}, probability {self.probability:.2f}"

    def draw_belief(self, rgb: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
        """Draw the belief: rotations on a map, centers on the image, marginals.

        Args:
            rgb: The image (H, W, 3) uint8, RGB.
            intrinsics: Its camera matrix (3, 3) [px].

        Returns:
            The picture (h, w, 3) uint8.
        """
        from posefilter.figures.belief import draw_belief  # slow to import, needed for pictures

        tensors = BeliefTensors(
            torch.from_numpy(self.belief.samples),
            torch.from_numpy(self.belief.weights).log(),
            torch.from_numpy(self.pose),
            torch.tensor(self.score),
        )
        return draw_belief(tensors, self.model, rgb, np.asarray(intrinsics))


class Run(NamedTuple):
    """One object's filter on a batch of images."""

    method: PoseEstimator
    batch: Batch  # at the network's resolution
    trace: Trace
    seconds: float  # an image
    found: Assessment | None = None  # None where there is no probability
    surface: torch.Tensor | None = None  # (B,) evidence; None where there is no probability


class Estimator:
    """Trained filters, each for one object, that estimate poses from RGB-D images.

    Made by `posefilter.load`.

    Args:
        methods: A method an object, with its weights, its recipe and its object.
        device: Where to compute; None: on the GPU where there is one.
        costs: What errors cost, which verdicts go by.

    Raises:
        UserError: There is no method, or one that detects and estimates no pose.
    """

    def __init__(
        self,
        methods: Sequence[PoseEstimator],
        device: str | torch.device | None = None,
        costs: Costs | None = None,
    ) -> None:
        if not methods:
            raise UserError("an estimator needs the weights of one object at least")
        for method in methods:
            if "pose" not in method.capabilities:
                raise UserError(f"{type(method).__name__} detects, and estimates no pose")
        device = device or ("cuda" if torch.cuda.is_available() else "cpu")
        self.methods = tuple(method.to(device).eval() for method in methods)
        self.costs = costs or Costs()
        self._sizes = tuple(get_trained_size(one.recipe.get("settings", {})) for one in methods)

    @property
    def objects(self) -> tuple[str, ...]:
        """The names of the objects, in the order of the results."""
        return tuple(method.model.name for method in self.methods)

    @property
    def models(self) -> tuple[ObjectModel, ...]:
        """What is known of each object: its center, size, surface points and hull."""
        return tuple(method.model for method in self.methods)

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
        same pixels: the more probable keeps them.  An object that is absent then has no result.

        Args:
            rgb: Color, RGB, as a numpy array or tensor: (H, W, 3) or (3, H, W), uint8 or float in
                [0, 1]; or a batch of B such images.
            depth: z-depth (H, W) in meters, as float, aligned with the color; 0 or NaN where
                unknown; or (B, H, W).
            intrinsics: Camera matrix (3, 3) [px] of these images; or one each, (B, 3, 3).
            instances: How many of each object an image shows at most: a number, or one for each
                name, 1 for those left out.  None: one answer an object, whatever it covers.
            seed: Decides every random draw of the filter: the same images and seed give the same
                answer.

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
        found = collect_results(self.run(images, seed), self.costs)
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
        return collect_results(self.run(images, seed), self.costs)

    def _detect(self, images: Images, counts: Sequence[int], seed: int) -> list[list[Result]]:
        """Find several instances: a list of results an image, the most probable first."""
        for method in self.methods:
            method.seed = seed
        size = (images.depth.shape[1], images.depth.shape[2])
        out = []
        for i in range(len(images.depth)):
            one = Images(*(part[i : i + 1] for part in images))
            batches = [
                Batch(*(x.to(method.device) for x in make_batch(one, *own)))
                for method, own in zip(self.methods, self._sizes, strict=True)
            ]
            found, seconds = detect(self.methods, batches, counts, self.costs)
            many = Counter(each.number for each in found)
            before, results = Counter[int](), []
            for each in found:
                number, trace = each.number, Trace((), (), (), each.belief)
                spent = seconds[number] / many[number]
                run = Run(self.methods[number], batches[number], trace, spent, each.assessment)
                result = make_result(run, 0, self.costs)
                mask = resize_mask(each.mask, size).cpu().numpy()
                # a conformal set holds for the filter that was calibrated, this one is smaller
                which = before[number]
                results.append(replace(result, instance=which, mask=mask, conformal=None))
                before[number] += 1
            out.append(results)
        return out

    def run(self, images: Images, seed: int = 0) -> list[Run]:
        """Run each object's filter, and return every step of it: for figures of what it did."""
        runs = []
        for method, size in zip(self.methods, self._sizes, strict=True):
            batch = Batch(*(x.to(method.device) for x in make_batch(images, *size)))
            method.seed = seed
            start, found, surface = time.perf_counter(), None, None
            with torch.no_grad():
                trace = method.predict_step(batch, 0)
                if method.calibration is not None:
                    evidence = method.collect_evidence(trace, batch)
                    found, surface = method.calibration.assess(evidence), evidence["surface"]
            trace.belief.best.cpu()  # waits for a GPU
            seconds = (time.perf_counter() - start) / len(images.depth)
            runs.append(Run(method, batch, trace, seconds, found, surface))
        return runs


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
        if not isinstance(count, int) or isinstance(count, bool) or not 1 <= count <= _MOST:
            raise UserError(f"instances={count}: a whole number from 1 to {_MOST} is due")
    return counts


def collect_results(runs: Sequence[Run], costs: Costs | None = None) -> list[list[Result]]:
    """Return the results of runs on the same images: a list an image, of a result an object.

    Args:
        runs: A run an object.
        costs: What errors cost; None: the default.
    """
    count = len(runs[0].batch.rgb)
    return [[make_result(run, i, costs) for run in runs] for i in range(count)]


def make_result(run: Run, image: int, costs: Costs | None = None) -> Result:
    """Return what a run amounts to for one image of its batch."""
    model, belief, found = run.method.model, run.trace.belief, run.found
    calibration = run.method.calibration
    weights = belief.log_weights[image].double().cpu().exp().numpy()
    center = model.center.detach().cpu().double().numpy()
    pose = belief.best[image].double().cpu().numpy()
    return Result(
        object=model.name,
        pose=pose,
        score=float(belief.score[image]),
        probability=None if found is None else float(found.probability[image]),
        presence=None if found is None else float(found.presence[image]),
        belief=Belief(
            belief.poses[image].double().cpu().numpy(),
            weights / weights.sum(),
            center,
            float(model.radius),
            float(model.diameter),
            model.name,
            model.symmetries.detach().cpu().double().numpy(),
        ),
        warnings=find_warnings(
            pose,
            model,
            run.batch.depth[image, 0].cpu().numpy(),
            run.batch.intrinsics[image].double().cpu().numpy(),
        ),
        seconds=run.seconds,
        model=model,
        costs=costs or Costs(),
        calibration_note="" if found is not None else explain_missing(run.method),
        conformal=None if found is None or calibration is None else calibration.conformal,
        surface=math.nan if run.surface is None else float(run.surface[image]),
    )


def explain_missing(method: PoseEstimator) -> str:
    """Return why an estimate has no probability."""
    known = method.calibration is not None
    return "no pixel of the frame has depth" if known else method.calibration_note


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
