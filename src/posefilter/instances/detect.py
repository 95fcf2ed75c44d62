"""Search one image for several objects, and let the more probable answer keep the pixels."""

import copy
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Generator, Tensor

from posefilter.confidence.calibration import Assessment
from posefilter.confidence.scale_ratio import ScaleRatio
from posefilter.confidence.second_look import measure_worth
from posefilter.confidence.tolerance import PoseTolerance
from posefilter.confidence.verdicts import Costs, Verdict, decide
from posefilter.confidence.visible_pixels import blank, find_visible
from posefilter.filters.loop import ParticleFilter
from posefilter.filters.resample import NoResampling
from posefilter.instances.pixels import keep_pixels, resize_mask
from posefilter.models.base import PoseEstimator
from posefilter.models.zoom import search
from posefilter.nets.pose_votes import has_depth
from posefilter.protocols import Encoding
from posefilter.types import Batch, BeliefBatch, Trace

_LIKELY = 0.5  # probability from which an answer is taken out of the image for other classes
# particles of the filter that follows one instance at most, and of its first step
_PARTICLES, _INITIAL_PARTICLES = 80, 320
# searches beyond the instances asked for, while an answer is doubtful, or was taken back
_SPARE = 1
_SHARE = 0.5  # of its visible pixels, that an answer must have for itself
_WORTH = 0.3  # mean probability of the network's surest cells, below which there is no more to find


class Detection(NamedTuple):
    """One object that is found in an image."""

    number: int  # of its method
    belief: BeliefBatch  # of one image
    assessment: Assessment | None  # None where the method is not calibrated
    visible: Tensor  # (H, W) bool, its visible pixels, of the first method's image
    mask: Tensor  # (H, W) bool, those that are its own: a more probable answer keeps the others
    within: float | None = None  # that it is there and within a tolerance, where one was given
    size: ScaleRatio | None = None  # by its visible pixels; None where the method cannot tell

    @property
    def probability(self) -> float:
        """That it is there and its pose right; -1 where nothing is known of that."""
        return -1.0 if self.assessment is None else float(self.assessment.probability[0])


@dataclass
class _Job:
    """One class that is searched for in one image."""

    number: int
    method: PoseEstimator
    batch: Batch  # of one image
    count: int  # instances at most
    filter: ParticleFilter
    generator: Generator
    tolerance: PoseTolerance | None = None
    searches: int = 0
    exhausted: bool = False
    seconds: float = 0.0


@torch.no_grad()
def detect(
    methods: Sequence[PoseEstimator],
    batches: Sequence[Batch],
    counts: Sequence[int],
    costs: Costs,
    tolerance: PoseTolerance | None = None,
) -> tuple[list[Detection], list[float]]:
    """Find the instances of several classes in one image, no two on the same pixels.

    Each class is searched for once; then again where instances are missing, without what is found.

    Args:
        methods: A trained filter a class.
        batches: The image, as each method takes it.
        counts: Instances of each class at most.
        costs: What errors cost: an object that is absent by these is left out.
        tolerance: What a right pose is, which verdicts go by; None: that of the probability.

    Returns:
        What is found, the most probable first; and the seconds that each class took.
    """
    classes = zip(methods, batches, counts, strict=True)
    jobs = [_begin(i, *one, tolerance) for i, one in enumerate(classes)]
    grid = (batches[0].depth.shape[-2], batches[0].depth.shape[-1])
    found: list[Detection] = []
    dropped: list[Detection] = []
    while any(_is_open(job, found, costs) for job in jobs):
        fresh = [_search(job, found, grid, costs) for job in jobs if _is_open(job, found, costs)]
        every = [*found, *(one for one in fresh if one is not None)]
        found = resolve(every)
        kept = {id(one.visible) for one in found}
        dropped += [one for one in every if id(one.visible) not in kept]
        found = [_judge_again(jobs[one.number], one, found, grid, costs) for one in found]
    there = [one for one in found if is_there(one, costs)]
    out = resolve(there)
    if len(_keep_best(out, counts)) < len(out):  # what is left out after all takes no pixels
        out = resolve([*there, *dropped], counts)
    return out, [job.seconds for job in jobs]


def is_there(one: Detection, costs: Costs) -> bool:
    """Tell whether an object may be in the image, by what errors cost; True where nothing is known
    of that.
    """
    return _judge(one, costs) != "absent"


def resolve(found: Sequence[Detection], counts: Sequence[int] | None = None) -> list[Detection]:
    """Return the detections that keep pixels, the most probable first.

    The more probable answer keeps the pixels, and one that has hardly any of its own is dropped.
    Those without a probability come last, by their scores.

    Args:
        found: Detections of one image.
        counts: How many of each class keep pixels at most; None: all.
    """
    order = sorted(found, key=lambda one: (-one.probability, -float(one.belief.score[0])))
    while True:
        kept = keep_pixels([one.visible for one in order], _SHARE)
        pairs = zip(order, kept, strict=True)
        out = [one._replace(mask=mask) for one, mask in pairs if mask is not None]
        best = out if counts is None else _keep_best(out, counts)
        if len(best) == len(out):
            return out
        # the first that is one too many: without it others may keep theirs
        excess = next(one for one in out if not any(one is each for each in best))
        order = [one for one in order if one.visible is not excess.visible]


def _begin(
    number: int,
    method: PoseEstimator,
    batch: Batch,
    count: int,
    tolerance: PoseTolerance | None = None,
) -> _Job:
    small = copy.copy(method.filter)
    small.particles = min(small.particles, _PARTICLES)
    small.initial_particles = min(small.initial_particles, _INITIAL_PARTICLES)
    if isinstance(small.resample, NoResampling):  # it keeps as many as it begins with
        small.particles = small.initial_particles
    return _Job(number, method, batch, count, small, method.generator("predict", 0), tolerance)


def _is_open(job: _Job, found: Sequence[Detection], costs: Costs) -> bool:
    """Tell whether a class is to be searched for once more."""
    if job.exhausted or job.searches >= job.count + _SPARE:
        return False
    own = [_judge(one, costs) for one in found if one.number == job.number]
    return sum(verdict in ("found", None) for verdict in own) < job.count


def _search(
    job: _Job, found: Sequence[Detection], grid: tuple[int, int], costs: Costs
) -> Detection | None:
    """Search for one instance more, in the image without what is found; None if there is none."""
    start = time.perf_counter()
    job.searches += 1
    hidden = _hide(job, [x for x in found if x.number == job.number or x.probability >= _LIKELY])
    image, encoding = _encode(job, hidden)
    one, worth = None, job.searches == 1 or float(measure_worth(encoding)) >= _WORTH
    if worth and bool(has_depth(image).all()):
        trace = search(job.method, image, job.generator, encoding, job.filter)
        depth, K = job.batch.depth[0, 0], job.batch.intrinsics[0]
        visible = find_visible(trace.belief.best, job.method.object_model, depth, K)[0]
        assessment = _assess(job.method, trace.belief, image, encoding)
        # with the pixels of others, so that an answer beside what is found, of the same object, is
        # seen to have too few of its own
        whole = resize_mask(visible, grid)
        within = _assess_within(job, assessment)
        seen = Detection(job.number, trace.belief, assessment, whole, whole, within)
        if bool((visible & ~hidden).any()) and is_there(seen, costs):
            answer = Trace((), (), (), trace.belief, encoding=encoding)
            size = job.method.measure_scale_ratio(answer, image, visible[None])
            one = seen._replace(size=size)
    job.exhausted = one is None
    job.seconds += time.perf_counter() - start
    return one


def _judge_again(
    job: _Job, one: Detection, found: Sequence[Detection], grid: tuple[int, int], costs: Costs
) -> Detection:
    """Return a doubtful detection with its probabilities in the image without the others of its
    class, once those that were asked for have been searched for.
    """
    others = [x for x in found if x.number == one.number and x is not one]
    searched = job.exhausted or job.searches >= job.count
    if _judge(one, costs) != "unsure" or not others or not searched:
        return one
    start = time.perf_counter()
    image, encoding = _encode(job, _hide(job, others) & ~_hide(job, [one]))
    assessment = _assess(job.method, one.belief, image, encoding)
    again = one._replace(assessment=assessment, within=_assess_within(job, assessment))
    job.seconds += time.perf_counter() - start
    return again


def _hide(job: _Job, taken: Sequence[Detection]) -> Tensor:
    """Return the pixels (H, W) bool of detections in a class's own image."""
    size = (job.batch.depth.shape[-2], job.batch.depth.shape[-1])
    hidden = torch.zeros(size, dtype=torch.bool, device=job.batch.depth.device)
    for one in taken:
        hidden |= resize_mask(one.mask, size)
    return hidden


def _encode(job: _Job, hidden: Tensor) -> tuple[Batch, Encoding]:
    """Return the image without some pixels, and as the method encodes it."""
    image = blank(job.batch, hidden[None]) if bool(hidden.any()) else job.batch
    return image, job.method.encode(image)


def _assess(
    method: PoseEstimator, belief: BeliefBatch, image: Batch, encoding: Encoding
) -> Assessment | None:
    return method.assess(Trace((), (), (), belief, encoding=encoding), image)


def _assess_within(job: _Job, assessment: Assessment | None) -> float | None:
    """Return the probability that a pose is within the tolerance; None where there is none."""
    if job.tolerance is None or assessment is None or assessment.features is None:
        return None
    assert job.method.calibration is not None  # it has assessed
    return float(job.method.calibration.assess(assessment.features, job.tolerance).probability[0])


def _judge(one: Detection, costs: Costs) -> Verdict | None:
    """Return the verdict on a detection; None where nothing is known of it."""
    if one.assessment is None:
        return None
    right = one.probability if one.within is None else one.within
    return decide(float(one.assessment.presence[0]), right, costs)


def _keep_best(found: Sequence[Detection], counts: Sequence[int]) -> list[Detection]:
    """Return no more of each class than were asked for."""
    left, out = list(counts), []
    for one in found:
        if left[one.number]:
            left[one.number] -= 1
            out.append(one)
    return out
