"""A second look replaces a doubtful answer by a better one, and nothing else.

A toy class is a color. Its filter finds the brightest pixel of a channel, its rank is how green
that pixel is: so a bright red square that is not green is a doubtful answer. A blue one appears too
large.
"""

from dataclasses import replace
from inspect import getattr_static
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Generator, Tensor

from posefilter.confidence.calibration import Calibration, Logistic
from posefilter.confidence.scale_ratio import ScaleRatio
from posefilter.confidence.second_look import look_again, measure_worth
from posefilter.filters.traces import keep_last_step
from posefilter.geometry.camera import back_project
from posefilter.geometry.pose import make_pose
from posefilter.models.zoom import with_encoding
from posefilter.types import Batch, BeliefBatch, ObjectModel, Particles, Trace

H, W, SIDE = 48, 64, 6  # [px]
K = torch.tensor([[64.0, 0, 31.5], [0, 64.0, 23.5], [0, 0, 1]])
CORNERS = torch.tensor([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]).float()
MODEL = ObjectModel(
    "square", CORNERS * 0.05, torch.zeros(3), 0.087, 0.173, torch.eye(4)[None], CORNERS * 0.05
)
NONE = Logistic((0.0,), 0.0)
COUNTS = {"right": 1, "wrong": 1, "absent": 1}
CALIBRATION = Calibration(("green",), (0.5,), (0.25,), NONE, NONE, COUNTS, "scenes", {})
CALIBRATION = replace(CALIBRATION, choice=Logistic((5.0,), 0.0))


class Toy:
    """Finds the pixel that is most red; with `filter.draws`, one that its generator draws."""

    object_model = MODEL
    part: Batch | None = None  # that the fourth search is of

    def __init__(
        self, max_searches: int = 3, calibration: Calibration | None = CALIBRATION
    ) -> None:
        self.calibration, self.filter = calibration, ToyFilter(max_searches)

    def encode(self, batch: Batch) -> Tensor:
        return batch.rgb

    def search(self, batch: Batch, generator: Generator, encoding: Any = None) -> Trace:
        return self.filter(batch, with_encoding(self, encoding), generator)

    def choose_part(self, image: Batch) -> Batch | None:
        return self.part

    def collect_features(self, trace: Trace, batch: Batch) -> dict[str, Tensor]:
        return {"green": self._read(trace, batch, 1)}

    def measure_scale_ratio(self, trace: Trace, batch: Batch) -> ScaleRatio | None:
        scale = 1 + self._read(trace, batch, 2)
        return ScaleRatio(scale, torch.full_like(scale, 99), torch.ones_like(scale))

    def _read(self, trace: Trace, batch: Batch, channel: int) -> Tensor:
        at = trace.belief.poses[:, 0, :2, 3].long()
        rows = zip(batch.rgb, at, strict=True)
        return torch.stack([rgb[channel, int(v), int(u)] for rgb, (u, v) in rows])


class ToyFilter:
    """What the search needs of a filter.  The particle's pose holds the pixel that was found."""

    def __init__(self, max_searches: int) -> None:
        self.max_searches, self.runs, self.draws, self.steps = max_searches, 0, False, 1

    def __call__(self, batch: Batch, method: Any, generator: Generator) -> Trace:
        self.runs += 1
        seen = method.encode(batch)
        red = getattr(seen, "rgb", seen)[:, 0] * (batch.depth[:, 0] > 0)
        if self.draws:  # any of the squares
            noise = torch.rand(red.shape, generator=generator)
            red = (red > 0.5) * noise
        index = red.flatten(1).argmax(1)
        pixel = torch.stack([index % W, index // W], dim=1).float()
        depth = torch.ones(len(index))
        center = back_project(pixel + (SIDE - 1) / 2, depth, K)
        center = center + torch.tensor([0, 0, 0.03])
        found = make_pose(torch.eye(3).expand(len(index), 3, 3), center)
        place = torch.eye(4).repeat(len(index), 1, 1, 1)
        place[:, 0, :2, 3] = pixel
        zeros = torch.zeros(len(index), 1)
        particles = Particles(place, zeros[..., None], zeros, zeros.long())
        belief = BeliefBatch(place, zeros, found, red.flatten(1).amax(1))
        return Trace((particles,) * self.steps, (), (), belief, zeros, None)


def draw(images: list[list[tuple[int | float, ...]]], wall: float = 2.0) -> Batch:
    """Return images of squares (u, v, red, green, blue if any) at 1 m, before a wall."""
    n = len(images)
    rgb, depth = torch.zeros(n, 3, H, W), torch.full((n, 1, H, W), wall)
    for i, squares in enumerate(images):
        for u, v, *color in squares:
            at = (slice(int(v), int(v) + SIDE), slice(int(u), int(u) + SIDE))
            for channel, value in enumerate(color):
                rgb[i, channel][at] = value
            depth[i, 0][at] = 1.0
    index = torch.zeros(n, dtype=torch.int64)
    nan = torch.full((n,), torch.nan)
    eye, many = torch.eye(4).repeat(n, 1, 1), K.repeat(n, 1, 1)
    return Batch(rgb, depth, depth > 9, many, eye, index, index, nan)


def run(toy: Toy, batch: Batch) -> tuple[Trace, Trace]:
    generator = Generator().manual_seed(0)
    first = toy.filter(batch, toy, generator)
    return first, look_again(toy, first, batch, generator)


def places(trace: Trace) -> list[tuple[int, int]]:
    return [(int(p[0, 0, 3]), int(p[0, 1, 3])) for p in trace.belief.poses]


WRONG, RIGHT = (5, 5, 1.0, 0.0), (40, 30, 0.8, 1.0)


def test_what_hides_behind_a_doubtful_answer_is_found() -> None:
    first, last = run(Toy(), draw([[WRONG, RIGHT]]))
    assert places(first) == [(5, 5)]
    assert places(last) == [(40, 30)]
    assert torch.equal(last.particles[0].state, last.belief.poses)
    center = last.belief.best[0, :2, 3]
    assert torch.allclose(center, torch.tensor([11.0, 9.0]) / 64, atol=1e-5)


def test_only_the_doubtful_rows_of_a_batch_change() -> None:
    toy = Toy()
    sure = (20, 10, 1.0, 1.0)
    first, last = run(toy, draw([[sure], [WRONG, RIGHT], [sure, RIGHT]]))
    assert places(last) == [(20, 10), (40, 30), (20, 10)]
    assert places(first) == [(20, 10), (5, 5), (20, 10)]  # the first trace is left as it was
    assert toy.filter.runs == 2


def test_the_better_of_two_doubtful_answers_is_kept() -> None:
    worse = (40, 30, 0.8, 0.1)
    _, last = run(Toy(), draw([[(5, 5, 1.0, 0.2), worse]]))
    assert places(last) == [(5, 5)]
    toy = Toy()
    _, last = run(toy, draw([[(5, 5, 1.0, 0.2), (40, 30, 0.8, 0.3)]]))
    assert places(last) == [(40, 30)]
    assert toy.filter.runs == 3


def test_other_draws_are_tried_in_the_whole_image() -> None:
    """What is hidden with a wrong answer may be the object itself."""
    toy = Toy()
    toy.filter.draws = True
    found = []
    for seed in range(20):
        batch = draw([[(5, 5, 1.0, 0.0), (9, 9, 0.9, 1.0)]])  # overlap: hidden together
        generator = Generator().manual_seed(seed)
        first = toy.filter(batch, toy, generator)
        if places(first)[0] < (9, 9):
            found.append(places(look_again(toy, first, batch, generator))[0] >= (9, 9))
    assert any(found)


def test_the_last_step_of_a_first_answer_serves_as_the_whole_trace() -> None:
    toy = Toy()
    toy.filter.draws, toy.filter.steps = True, 3
    batch = draw([[WRONG, RIGHT, (20, 20, 1.0, 0.4)]] * 6)
    generator = Generator().manual_seed(0)
    first = toy.filter(batch, toy, generator)
    state = generator.get_state()
    whole = look_again(toy, first, batch, generator)
    assert places(whole) != places(first)
    generator.set_state(state)
    last = look_again(toy, keep_last_step(first), batch, generator)
    assert places(last) == places(whole)
    assert len(last.particles) == 1
    assert torch.equal(last.particles[0].state, whole.particles[2].state)


@pytest.mark.parametrize(
    "toy",
    [
        Toy(max_searches=1),
        Toy(calibration=None),
        Toy(calibration=replace(CALIBRATION, choice=None)),
    ],
)
def test_one_look_is_all_without_a_choice(toy: Toy) -> None:
    first, last = run(toy, draw([[WRONG, RIGHT]]))
    assert last is first
    assert toy.filter.runs == 1


def test_two_looks_are_one_more() -> None:
    toy = Toy(max_searches=2)
    run(toy, draw([[(5, 5, 1.0, 0.0), (40, 30, 0.8, 0.1)]]))
    assert toy.filter.runs == 2


def test_the_fourth_search_is_of_the_part_that_most_likely_shows_the_object() -> None:
    small = (40, 30, 0.4, 1.0)  # and not seen beside what is more red
    batch = draw([[(5, 5, 1.0, 0.0), (20, 20, 0.9, 0.0), small]])
    for searches, place in ((3, (5, 5)), (4, (40, 30))):
        toy = Toy(max_searches=searches)
        toy.part = draw([[small]])
        _, last = run(toy, batch)
        assert places(last) == [place]
        assert toy.filter.runs == searches


def test_an_image_without_depth_beside_the_answer_is_not_searched_for_more() -> None:
    toy = Toy()
    toy.filter.max_searches = 2
    _, last = run(toy, draw([[WRONG]], wall=0.0))
    assert places(last) == [(5, 5)]
    assert toy.filter.runs == 1


def test_where_the_network_sees_nothing_there_is_nothing_to_find() -> None:
    sure, blind = torch.zeros(1, 1, 6, 8), torch.zeros(1, 1, 6, 8)
    sure[0, 0, 2, 2:8] = 0.9
    assert measure_worth(SimpleNamespace(objectness=sure)) == pytest.approx(0.9)
    assert measure_worth(SimpleNamespace(objectness=blind)) == 0
    assert measure_worth(torch.zeros(1)) == 1


class BlindToy(Toy):
    """Its network is sure of nothing."""

    def encode(self, batch: Batch) -> Any:
        return SimpleNamespace(rgb=batch.rgb, objectness=torch.zeros(len(batch.rgb), 1, 6, 8))


def test_no_further_search_is_made_where_the_network_sees_nothing() -> None:
    toy = BlindToy()
    _, last = run(toy, draw([[WRONG, RIGHT]]))
    assert places(last) == [(5, 5)]
    assert toy.filter.runs == 1


def test_an_answer_that_is_hardly_better_does_not_replace_the_first() -> None:
    _, last = run(Toy(), draw([[(5, 5, 1.0, 0.2), (40, 30, 0.8, 0.23)]]))
    assert places(last) == [(5, 5)]


def test_an_answer_of_another_size_is_doubtful_however_sure() -> None:
    """The next best takes its place, though its rank be lower, if it is more often right."""
    larger = (5, 5, 1.0, 1.0, 0.5)
    first, last = run(Toy(), draw([[larger, (40, 30, 0.8, 0.7)]]))
    assert places(first) == [(5, 5)]
    assert places(last) == [(40, 30)]
    _, last = run(Toy(), draw([[larger, (40, 30, 0.8, -0.1)]]))  # itself doubtful
    assert places(last) == [(5, 5)]


def test_an_answer_of_another_size_replaces_none() -> None:
    """Where depth or intrinsics are wrong all appear so, and the first answer stays."""
    larger = (40, 30, 0.8, 1.0, 0.5)
    toy = Toy()
    _, last = run(toy, draw([[(5, 5, 1.0, 1.0, 0.5), larger]]))
    assert places(last) == [(5, 5)]
    _, last = run(Toy(), draw([[WRONG, larger]]))
    assert places(last) == [(5, 5)]
    # a size that the network's own errors reach is none
    _, last = run(Toy(), draw([[WRONG, (40, 30, 0.8, 1.0, 0.1)]]))
    assert places(last) == [(40, 30)]


@pytest.mark.parametrize(("weight", "measured"), [(0.0, False), (1.0, True)])
def test_a_margin_of_rotations_that_answers_are_not_compared_by_is_not_measured(
    weight: float, measured: bool
) -> None:
    asked = []

    class WithMargin(Toy):
        def collect_features(
            self, trace: Trace, batch: Batch, margin: Tensor | None = None
        ) -> dict[str, Tensor]:
            asked.append(margin is None)
            green = super().collect_features(trace, batch)["green"]
            return {"green": green, "rotation_margin": green if margin is None else margin}

    calibration = replace(
        CALIBRATION,
        features=("green", "rotation_margin"),
        center=(0.5, 0.5),
        scale=(0.25, 0.25),
        choice=Logistic((5.0, weight), 0.0),
    )
    _, last = run(WithMargin(calibration=calibration), draw([[WRONG, RIGHT]]))
    assert places(last) == [RIGHT[:2]]
    assert len(asked) > 1
    assert set(asked) == {measured}


def test_a_method_whose_images_are_encoded_is_of_its_class() -> None:
    toy = Toy()
    known, batch = with_encoding(toy, "kept"), draw([[(9, 9, 1.0, 1.0)]])
    assert known.encode(batch) == "kept"
    assert toy.encode(batch) is batch.rgb
    # protocols are checked so from Python 3.12 on
    assert getattr_static(known, "collect_features") is Toy.collect_features
