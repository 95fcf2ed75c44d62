"""The search over toy classes: a class is a color, an instance a square of it."""

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any, cast

import pytest
import torch
from torch import Generator, Tensor

from posefilter.confidence.calibration import Assessment
from posefilter.confidence.tolerance import PoseTolerance
from posefilter.confidence.verdicts import Costs
from posefilter.errors import UserError
from posefilter.estimator import count_instances
from posefilter.filters.resample import AdaptiveResampling, NoResampling, Systematic
from posefilter.geometry.camera import back_project
from posefilter.geometry.pose import make_pose
from posefilter.instances.detect import Detection, _begin, _is_open, detect, resolve
from posefilter.models.base import PoseEstimator
from posefilter.models.pose_particles import require_depth
from posefilter.nets.pose_votes import measure_cells
from posefilter.protocols import Resample
from posefilter.types import Batch, BeliefBatch, ObjectModel, Trace

H, W, SIDE = 48, 64, 6  # [px]
K = torch.tensor([[64.0, 0, 31.5], [0, 64.0, 23.5], [0, 0, 1]])
CORNERS = torch.tensor([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]).float()
MODEL = ObjectModel(
    "square", CORNERS * 0.05, torch.zeros(3), 0.087, 0.173, torch.eye(4)[None], CORNERS * 0.05
)


class Toy:
    """Finds the brightest pixel of its color; the brighter, the more probable."""

    def __init__(self, channel: int, rank: float = 1.0, calibrated: bool = True) -> None:
        self.channel, self.rank, self.object_model = channel, rank, MODEL
        self.filter = SimpleFilter()
        self.calibrated, self.encoded = calibrated, 0

    def encode(self, batch: Batch) -> Tensor:
        self.encoded += 1
        return batch.rgb[:, self.channel]

    def generator(self, stage: str, number: int) -> Generator:
        return Generator().manual_seed(0)

    def assess(self, trace: Trace, batch: Batch) -> Assessment | None:
        if not self.calibrated:
            return None
        brightness = self.rank * trace.belief.score.double().clamp(0, 1)
        return Assessment(brightness, brightness)

    def measure_scale_ratio(self, trace: Trace, batch: Batch, visible: Tensor) -> None:
        return None


class SimpleFilter:
    """What the search needs of a filter."""

    particles = initial_particles = 8
    magnified_width = None
    resample: Resample = Systematic()

    def __call__(self, batch: Batch, method: Any, generator: Generator) -> Any:
        seen = method.encode(batch)[0] * (batch.depth[0, 0] > 0)
        index = int(seen.argmax())
        pixel = torch.tensor([[index % W, index // W]]).float() + (SIDE - 1) / 2
        center = back_project(pixel, torch.tensor([1.0]), K)[0] + torch.tensor([0, 0, 0.03])
        pose = make_pose(torch.eye(3), center)[None]
        belief = BeliefBatch(pose[:, None], torch.zeros(1, 1), pose, seen.max()[None])
        return SimpleNamespace(belief=belief)


class Beside(SimpleFilter):
    """Finds the same place, a pixel further to the right at each call, and less surely."""

    def __init__(self) -> None:
        self.calls = 0

    def __call__(self, batch: Batch, method: Any, generator: Generator) -> Any:
        method.encode(batch)
        pixel = torch.tensor([[20.0 + self.calls, 20.0]]) + (SIDE - 1) / 2
        self.calls += 1
        center = back_project(pixel, torch.tensor([1.0]), K)[0] + torch.tensor([0, 0, 0.03])
        pose = make_pose(torch.eye(3), center)[None]
        score = torch.tensor([0.9 / self.calls])
        return SimpleNamespace(belief=BeliefBatch(pose[:, None], torch.zeros(1, 1), pose, score))


class Proposing(SimpleFilter):
    """Needs a cell with depth, as proposals do."""

    def __call__(self, batch: Batch, method: Any, generator: Generator) -> Any:
        require_depth(measure_cells(batch.depth, batch.intrinsics).valid)
        return super().__call__(batch, method, generator)


def draw(squares: Sequence[tuple[int, int, int, float]]) -> Batch:
    """Return an image of squares (u, v, channel, brightness) at 1 m, before a wall at 2 m."""
    rgb, depth = torch.zeros(1, 3, H, W), torch.full((1, 1, H, W), 2.0)
    for u, v, channel, value in squares:
        rgb[0, channel, v : v + SIDE, u : u + SIDE] = value
        depth[0, 0, v : v + SIDE, u : u + SIDE] = 1.0
    none = torch.zeros(1, dtype=torch.int64)
    return Batch(
        rgb, depth, depth > 9, K[None], torch.eye(4)[None], none, none, torch.full((1,), torch.nan)
    )


def run(toys: list[Toy], counts: list[int], batch: Batch) -> list[Detection]:
    methods = [cast(PoseEstimator, toy) for toy in toys]
    found, seconds = detect(methods, [batch] * len(toys), counts, Costs())
    assert len(seconds) == len(toys)
    return found


def corners(found: list[Detection]) -> list[tuple[int, int]]:
    """Return where each detection's pixels begin (u, v)."""
    places = [one.mask.nonzero() for one in found]
    return [(int(p[:, 1].min()), int(p[:, 0].min())) for p in places]


THREE = [(4, 5, 0, 0.95), (30, 20, 0, 0.9), (50, 36, 0, 0.85)]


def test_what_is_found_is_kept_where_too_little_depth_is_left_for_another_search() -> None:
    batch, toy = draw([(2, 2, 0, 0.95)]), Toy(0)
    toy.filter = Proposing()
    batch.depth[batch.depth > 1] = 0
    batch.depth[0, 0, 40, 56] = 2.0  # a cell's corner
    assert len(run([toy], [2], batch)) == 1


def test_each_instance_is_found_once_the_most_probable_first() -> None:
    found = run([Toy(0)], [3], draw(THREE))
    assert len(found) == 3
    for (u, v), (true_u, true_v, _, _) in zip(corners(found), THREE, strict=True):
        assert abs(u - true_u) <= 2
        assert abs(v - true_v) <= 2
    assert int(torch.stack([one.mask for one in found]).sum(0).max()) == 1
    probabilities = [one.probability for one in found]
    assert probabilities == sorted(probabilities, reverse=True)


def test_no_more_are_found_than_asked_for_or_than_there_are() -> None:
    assert len(run([Toy(0)], [2], draw(THREE))) == 2
    assert len(run([Toy(0)], [9], draw(THREE))) == 3
    assert run([Toy(1)], [3], draw(THREE)) == []


@pytest.mark.parametrize("calibrated", [True, False])
def test_what_is_left_of_a_found_object_is_no_other(calibrated: bool) -> None:
    """An object longer than the model: the second answer, a pixel beside the first, has few pixels
    of its own.
    """
    long = draw([(20, 20, 0, 0.95)])
    long.rgb[0, 0, 20:26, 26:30], long.depth[0, 0, 20:26, 26:30] = 0.9, 1.0
    toy = Toy(0, calibrated=calibrated)
    toy.filter = Beside()
    found = run([toy], [3], long)
    assert corners(found) == [(20, 20)]
    assert toy.encoded > 1


def test_the_first_search_is_on_the_whole_image_and_ends_where_all_are_sure() -> None:
    toy = Toy(0)
    run([toy], [1], draw(THREE))
    assert toy.encoded == 1
    toy = Toy(0)
    run([toy], [2], draw(THREE))
    assert toy.encoded == 2
    # what is doubtful is judged again without the other, and then searched for once more
    dim = [(u, v, channel, 0.8 * value) for u, v, channel, value in THREE[:2]]
    toy = Toy(0)
    run([toy], [2], draw(dim))
    assert toy.encoded > 3


def test_the_more_probable_class_keeps_the_pixels() -> None:
    both = draw([(10, 10, 0, 0.9), (40, 30, 1, 0.85)])
    both.rgb[0, 1, 10:16, 10:16] = 1.0  # the other class takes it for its own, too
    first, second = Toy(0), Toy(1, rank=0.8)
    found = run([first, second], [1, 1], both)
    assert [one.number for one in found] == [0, 1]
    places = corners(found)
    assert abs(places[0][0] - 10) <= 2
    assert abs(places[1][0] - 40) <= 2  # found by a second look, without what the first covers
    turned = run([Toy(1, rank=0.8), Toy(0)], [1, 1], both)  # in whatever order they come
    assert [(1 - one.number) for one in turned] == [0, 1]
    assert corners(turned) == places


def test_a_doubtful_answer_is_followed_by_another_search(monkeypatch: pytest.MonkeyPatch) -> None:
    """The brightest may be something that only looks alike: here it is believed by half."""

    class Doubtful(Toy):
        def assess(self, trace: Trace, batch: Batch) -> Assessment:
            bright = trace.belief.score.double()
            value = torch.where(bright > 0.92, 0.5, bright)
            return Assessment(value, value)

    (one,) = run([Doubtful(0)], [1], draw(THREE))
    assert one.probability == pytest.approx(0.9)
    monkeypatch.setattr("posefilter.instances.detect._SPARE", 0)
    (one,) = run([Doubtful(0)], [1], draw(THREE))
    assert one.probability == pytest.approx(0.5)


def test_without_a_calibration_as_many_are_returned_as_were_asked_for() -> None:
    found = run([Toy(0, calibrated=False)], [2], draw(THREE))
    assert [one.assessment for one in found] == [None, None]
    scores = [float(one.belief.score[0]) for one in found]
    assert scores == sorted(scores, reverse=True)


def test_counts_are_numbers_of_objects_that_are_loaded() -> None:
    assert count_instances(3, ["a", "b"]) == [3, 3]
    assert count_instances({"b": 2}, ["a", "b"]) == [1, 2]
    wrong: list[tuple[Any, str]] = [(0, "instances=0"), (True, "True"), ({"c": 1}, "not loaded")]
    for instances, told in wrong:
        with pytest.raises(UserError, match=told):
            count_instances(instances, ["a", "b"])


def make_detection(first: int, last: int, probability: float) -> Detection:
    """Return what is seen on some pixels of one row."""
    mask = torch.zeros(1, 200, dtype=torch.bool)
    mask[:, first:last] = True
    said = torch.tensor([probability], dtype=torch.float64)
    none = BeliefBatch(*(torch.zeros(1) for _ in BeliefBatch._fields))
    return Detection(0, none, Assessment(said, said), mask, mask)


def test_pixels_are_given_anew_in_each_round() -> None:
    a, b, c = (
        make_detection(0, 100, 0.6),
        make_detection(0, 45, 0.9),
        make_detection(45, 70, 0.8),
    )
    at_once = resolve([a, b, c])
    assert [one.probability for one in at_once] == [0.9, 0.8]  # 30 of a's 100 pixels are its own
    in_turn = resolve([*resolve([a, b]), c])
    assert [one.probability for one in in_turn] == [0.9, 0.8]
    kept = {one.probability: one for one in resolve([a, b])}
    doubted = kept[0.9]._replace(assessment=make_detection(0, 45, 0.3).assessment)
    (left,) = resolve([kept[0.6], doubted])
    assert left.probability == 0.6
    assert int(left.mask.sum()) == 100


def test_what_is_one_too_many_takes_no_pixels() -> None:
    first, better = make_detection(0, 100, 0.55), make_detection(120, 180, 0.97)
    other = make_detection(0, 90, 0.5)._replace(number=1)
    assert [one.probability for one in resolve([first, better, other])] == [0.97, 0.55]
    found = resolve([first, better, other], [1, 1])
    assert [(one.number, one.probability) for one in found] == [(0, 0.97), (1, 0.5)]
    assert int(found[1].mask.sum()) == 90
    assert [one.number for one in resolve([first, better, other], [2, 1])] == [0, 0]


def test_an_answer_that_is_surplus_in_the_end_does_not_hide_another_class() -> None:
    """It was the first of its class, and on the place of the other's only answer."""
    first, second = Toy(0), Toy(1)
    image = draw([(4, 5, 0, 0.6), (40, 30, 0, 0.5)])
    image.rgb[0, 1, 5 : 5 + SIDE, 4 : 4 + SIDE] = 0.55  # both classes see this square

    def assess(trace: Trace, batch: Batch) -> Assessment:
        u = trace.belief.best[0, 0, 3] > 0  # where the first class has its second answer
        sure = torch.tensor([0.97 if u else 0.6]).double()
        return Assessment(sure, sure)

    first.assess = assess  # type: ignore[method-assign]
    found = run([first, second], [1, 1], image)
    assert [(one.number, round(one.probability, 2)) for one in found] == [(0, 0.97), (1, 0.55)]
    assert corners(found) == [(40, 30), (4, 5)]


def test_the_verdict_goes_by_a_tolerance_where_one_is_given() -> None:
    """The object is there, its turn is not sure, and a miss is cheap."""

    class Turned(Toy):
        def assess(self, trace: Trace, batch: Batch) -> Assessment:
            presence, right = torch.tensor([[0.95], [0.5]]).double()
            return Assessment(presence, right, {"a": presence})

    class Calibrated:
        def assess(self, values: Any, tolerance: PoseTolerance) -> Assessment:
            assert tolerance == PoseTolerance(add_s=0.1)
            return Assessment(values["a"], 0.99 * values["a"])

    toy, batch, costs = Turned(0), draw(THREE[:1]), Costs(miss=0.5)
    toy.calibration = Calibrated()  # type: ignore[attr-defined]
    asked = [cast(PoseEstimator, toy)], [batch], [1], costs
    assert detect(*asked)[0] == []
    ((one,), _) = detect(*asked, PoseTolerance(add_s=0.1))
    assert one.within == pytest.approx(0.94, abs=0.01)


def test_an_answer_that_is_absent_after_all_takes_no_place() -> None:
    found, absent = make_detection(0, 9, 0.99), make_detection(20, 29, 0.0)
    job = cast(Any, SimpleNamespace(number=0, count=2, searches=2, exhausted=False))
    assert _is_open(job, [found, absent], Costs())
    assert not _is_open(job, [found, make_detection(20, 29, 0.99)], Costs())
    job.searches = 3
    assert not _is_open(job, [found, absent], Costs())


@pytest.mark.parametrize(
    ("resample", "particles"),
    [(Systematic(), 80), (AdaptiveResampling(Systematic()), 80), (NoResampling(), 320)],
)
def test_a_smaller_filter_without_resampling_keeps_as_many_as_it_begins_with(
    resample: Resample, particles: int
) -> None:
    toy = Toy(0)
    toy.filter.particles = toy.filter.initial_particles = 500
    toy.filter.resample = resample
    small = _begin(0, cast(PoseEstimator, toy), draw(THREE), 2).filter
    assert (small.particles, small.initial_particles) == (particles, 320)
    assert toy.filter.particles == 500
