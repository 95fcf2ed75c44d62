"""Conformal sets hold the truth as often as they guarantee, in each group, whatever the belief."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from posefilter.confidence.calibration import Calibration, read_calibration
from posefilter.confidence.conformal import Conformal, choose_edges, fit_conformal
from posefilter.confidence.fit import Frames, cross_validate, fit_calibration
from posefilter.errors import UserError
from posefilter.geometry.pose import make_pose, move_about
from posefilter.geometry.rotation import random_rotation
from posefilter.metrics.credibility import Credibility, score_truth
from posefilter.types import BeliefBatch, ObjectModel

CENTER = torch.zeros(3)


def test_a_group_without_frames_gives_all_poses() -> None:
    empty = Conformal((0.5,), ((), (1.0, 2.0)))
    assert empty.find_limit(0.0, 0.1) == math.inf
    assert empty.find_limit(0.0, 0.9) == 1.0


@pytest.mark.parametrize("level", [0.5, 0.9])
def test_coverage_on_exchangeable_frames_is_at_least_the_level_and_hardly_more(
    level: float,
) -> None:
    """Few frames a calibration, thousands of calibrations: the mean coverage is what is meant."""
    rng, count = np.random.default_rng(0), 19
    covered: list[list[bool]] = [[], []]
    for _ in range(3000):
        surface = rng.random(2 * count + 1)
        # of the second group a belief is far too sure, of the first too wide
        nonconformity = rng.standard_t(3, size=2 * count + 1) * np.where(surface < 0.25, 1, 50)
        group = surface[1:] >= 0.25
        own = (np.sort(nonconformity[1:][group == k]).tolist() for k in (False, True))
        found = Conformal((0.25,), tuple(map(tuple, own)))
        limit = found.find_limit(level, surface[0])
        covered[found.find_group(surface[0])].append(bool(nonconformity[0] <= limit))
    for hits in covered:
        error = math.sqrt(0.25 / len(hits))
        assert level - 3 * error < np.mean(hits)
    assert np.mean(covered[1]) < level + 0.06


def test_the_limit_is_the_order_statistic_of_the_definition() -> None:
    found = Conformal((0.25,), (tuple(range(1, 10)), tuple(range(101, 120))))
    assert found.find_limit(0.9, 0.1) == 9  # ceil(0.9 x 10)
    assert found.find_limit(0.91, 0.1) == math.inf  # the tenth of nine
    assert found.find_limit(0.95, 0.3) == 119
    assert found.find_limit(0.96, 0.3) == math.inf
    assert found.find_limit(0.5, 0.25) == 110  # an edge belongs to the group above
    assert found.find_limit(0.0, 0.1) == 1
    assert found.find_group(math.nan) == 0
    assert Conformal((), ((),)).find_limit(0.1, 0.5) == math.inf


def test_occluded_frames_raise_the_limit_where_they_are_enough_for_the_level() -> None:
    own = tuple(float(x) for x in range(1, 20))
    occluded = (12.0, 13.0, 14.0, 15.0, 16.0)
    found = Conformal((), (own,), "probability", (occluded,))
    assert found.find_limit(0.5, 0.3) == 14  # ceil(0.5 x 6), above 10
    assert found.find_limit(0.8, 0.3) == 16  # as the group's own
    assert found.find_limit(0.9, 0.3) == 18  # the sixth of five: the group's own limit is larger
    assert replace(found, occluded=(occluded[1:],)).find_limit(0.5, 0.3) == 10  # four are too few
    rare = replace(found, scores=(own + (20.0,) * 7,))
    assert rare.find_limit(0.5, 0.3) == 14  # five of 26 are less than a fifth: the 14th of 26
    easy = (-9.0, -8.0, -7.0, -6.0, -5.0)
    assert replace(found, occluded=(easy,)).find_limit(0.5, 0.3) == 10  # never a smaller set


def test_a_set_of_a_higher_level_holds_those_of_lower_ones() -> None:
    own = tuple(float(x) for x in range(40))
    occluded = tuple(float(x) for x in range(27, 41))
    found = Conformal((), (own,), "probability", (occluded,))
    levels = [x / 100 for x in range(5, 98)]
    limits = [found.find_limit(level, 0.3) for level in levels]
    assert limits == sorted(limits)
    assert limits[levels.index(0.95)] == 40  # 14 are too few for 95 %: the largest of them
    assert found.find_limit(0.98, 0.3) == float("inf")  # so are all 40 here


def test_frames_of_unknown_visibility_are_not_occluded() -> None:
    seen = np.array([0.1, math.nan, 0.25, 0.2])
    found = fit_conformal(np.array([4.0, 3.0, 2.0, 1.0]), np.full(4, 0.5), seen)
    assert found.occluded == ((1.0, 4.0),)
    assert found.scores == ((1.0, 2.0, 3.0, 4.0),)
    assert fit_conformal(np.zeros(4), np.full(4, 0.5)).occluded == ()


@pytest.mark.parametrize("level", [0.5, 0.8])
def test_sets_hold_the_truth_of_occluded_frames_that_the_probability_does_not_tell(
    level: float,
) -> None:
    """Of a group's frames a third are harder, and nothing that a new frame shows says which."""
    rng = np.random.default_rng(5)
    covered: dict[bool, dict[bool, list[bool]]] = {
        known: {True: [], False: []} for known in (True, False)
    }
    for _ in range(300):
        seen = rng.choice([0.1, 0.9], size=161, p=[0.3, 0.7])
        scores = rng.normal(size=161) + np.where(seen < 0.25, 3.0, 0.0)
        for known, own in covered.items():
            visibility = seen[1:] if known else None
            found = fit_conformal(scores[1:], np.full(160, 0.5), visibility)
            hit = bool(scores[0] <= found.find_limit(level, 0.5))
            own[bool(seen[0] < 0.25)].append(hit)
    assert np.mean(covered[False][True]) < level - 0.2
    assert np.mean(covered[True][True]) > level - 0.1
    assert np.mean(covered[True][False]) >= level


def model(symmetries: torch.Tensor | None = None) -> ObjectModel:
    points = torch.randn(30, 3, generator=torch.Generator().manual_seed(1)) * 0.05
    group = torch.eye(4)[None] if symmetries is None else symmetries
    return ObjectModel("thing", points, CENTER, 0.1, 0.2, group, points)


def draw_beliefs(believed: float, count: int = 40) -> tuple[BeliefBatch, torch.Tensor]:
    """Return beliefs with a deviation of `believed` times that of their truths."""
    g = torch.Generator().manual_seed(0)
    scale = torch.tensor([0.01] * 3 + [0.1] * 3)
    middle = make_pose(random_rotation(count, generator=g), torch.randn(count, 3, generator=g))
    noise = torch.randn(count, 100, 6, generator=g) * scale * believed
    poses = move_about(middle[:, None].expand(-1, 100, -1, -1), noise, CENTER)
    truth = move_about(middle, torch.randn(count, 6, generator=g) * scale, CENTER)
    even = torch.full((count, 100), -math.log(100))
    return BeliefBatch(poses, even, middle, torch.zeros(count)), truth


def test_ranks_are_uniform_where_beliefs_are_right_and_high_where_they_are_vain() -> None:
    right, vain = (score_truth(*draw_beliefs(width), model()) for width in (1.0, 0.3))
    assert float(right.rank.mean()) == pytest.approx(0.5, abs=0.14)
    assert float((right.rank < 0.8).double().mean()) == pytest.approx(0.8, abs=0.15)
    assert float(vain.rank.mean()) > 0.9
    assert float(right.nonconformity.mean()) == pytest.approx(0, abs=0.8)
    assert float(vain.nonconformity.mean()) > 5
    assert float(right.log_density.mean()) > float(vain.log_density.mean())
    turn = torch.diag(torch.tensor([-1.0, -1, 1, 1]))
    belief, truth = draw_beliefs(1.0, 3)
    known = model(torch.stack([torch.eye(4), turn]))
    a, b = score_truth(belief, truth, known), score_truth(belief, truth @ turn, known)
    for one, other in zip(a, b, strict=True):
        assert torch.allclose(one, other, atol=1e-4)


def test_coverage_is_counted_by_quarter_of_visibility() -> None:
    metric, nan = Credibility(), math.nan
    ranks = torch.tensor([0.1, 0.7, 0.85, 0.95, 0.3, 0.99]).double()
    seen = torch.tensor([0.1, 0.2, 0.5, 0.74, 1.0, nan])
    for part in (slice(0, 2), slice(2, 6)):
        flat = type(score_truth(*draw_beliefs(1.0, 0), model()))(
            ranks[part], ranks[part], ranks[part]
        )
        metric.update(flat, seen[part])
    curves = numbers = metric.compute()
    assert numbers["coverage_50"] == pytest.approx(100 * 2 / 6)
    assert numbers["coverage_90"] == pytest.approx(100 * 4 / 6)
    assert [(one["from"], one["instances"]) for one in curves["quarters"]] == [
        (0, 2),
        (0.5, 2),
        (0.75, 1),
    ]
    at = curves["levels"].index(0.8)
    assert curves["all"][at] == pytest.approx(3 / 6)
    assert [one["coverage"][at] for one in curves["quarters"]] == [1, 0, 1]


def frames(count: int = 60) -> tuple[Frames, np.ndarray]:
    """Return frames, and the nonconformity (n,) of their truths, NaN without the object."""
    rng = np.random.default_rng(3)
    there = np.arange(count) < count // 2
    nonconformity = np.where(there, rng.normal(size=count), np.nan)
    drawn = Frames(
        ("surface", "score"),
        rng.random((count, 2)),
        there,
        there & (rng.random(count) < 0.5),
        visibility=np.where(there, rng.random(count), np.nan),
    )
    return drawn, nonconformity


def fit(drawn: Frames, nonconformity: np.ndarray) -> tuple[Calibration, Conformal]:
    """Return a calibration with sets, and these: by cross-validation, as calibrate.py does."""
    own, held = drawn.present, cross_validate(drawn).probability.numpy()
    visibility = None if drawn.visibility is None else drawn.visibility[own]
    sets = fit_conformal(nonconformity[own], held[own], visibility)
    return replace(fit_calibration(drawn, "scenes"), conformal=sets), sets


def test_a_calibration_carries_the_scores_of_the_frames_with_the_object() -> None:
    own, nonconformity = frames()
    made, sets = fit(own, nonconformity)
    assert sum(sets.scores, ()) != ()
    together = sorted(x for group in sets.scores for x in group)
    assert together == sorted(nonconformity[own.present].tolist())
    assert read_calibration(made.to_plain(), "x") == made
    occluded = sorted(x for group in sets.occluded for x in group)
    assert own.visibility is not None
    assert occluded == sorted(nonconformity[own.visibility < 0.25].tolist())
    assert occluded
    earlier = made.to_plain()
    del earlier["conformal"]
    assert read_calibration(earlier, "x").conformal is None


def test_what_an_earlier_version_stored_is_grouped_by_surface() -> None:
    content = fit_calibration(frames()[0], "scenes").to_plain()
    content["conformal"] = {"edges": [0.25], "surprises": [[1.0], [2.0]]}
    read = read_calibration(content, "x").conformal
    assert read == Conformal((0.25,), ((1.0,), (2.0,)), "surface")


def draw_hard_and_easy(
    count: int, rng: np.random.Generator
) -> tuple[Frames, np.ndarray, np.ndarray]:
    """Draw frames whose truths conform the less the less is seen, which is a hidden number."""
    seen = rng.random(count)
    there = rng.random(count) < 0.6
    values = np.stack([seen + 0.1 * rng.normal(size=count), rng.normal(size=count)], 1)
    right = there & (rng.random(count) < 1 / (1 + np.exp(-12 * (seen - 0.4))))
    scale = np.where(seen < 0.4, 8.0, 1.0)
    nonconformity = np.where(there, scale * rng.standard_t(4, size=count), np.nan)
    return Frames(("coordinates", "score"), values, there, right), nonconformity, seen


@pytest.mark.parametrize("level", [0.5, 0.8, 0.9, 0.95])
def test_groups_by_probability_cover_the_hard_frames_as_often_as_the_easy_ones(
    level: float,
) -> None:
    rng = np.random.default_rng(4)
    held: dict[str, list[np.ndarray]] = {"hard": [], "easy": []}
    for _ in range(12):
        made, sets = fit(*draw_hard_and_easy(650, rng)[:2])
        assert sets.by == "probability"
        assert len(sets.scores) in (5, 6)
        assert all(18 < len(own) < 150 for own in sets.scores)
        new, nonconformity, seen = draw_hard_and_easy(2000, rng)
        own = new.present
        probability = made.assess_features(torch.from_numpy(new.values[own])).probability
        limit = [sets.find_limit(level, float(p)) for p in probability]
        inside = nonconformity[own] <= np.array(limit)
        held["hard"].append(inside[seen[own] < 0.3])
        held["easy"].append(inside[seen[own] > 0.6])
    share = {name: float(np.concatenate(rows).mean()) for name, rows in held.items()}
    assert share["hard"] == pytest.approx(level, abs=0.06)
    assert share["easy"] == pytest.approx(level, abs=0.06)


def test_few_frames_are_one_group() -> None:
    assert choose_edges(np.linspace(0, 1, 39)) == ()
    assert choose_edges(np.linspace(0, 1, 41)) == pytest.approx((0.5,))
    assert choose_edges(np.linspace(0, 1, 199)) == pytest.approx((0.25, 0.5, 0.75))
    assert choose_edges(np.linspace(0, 1, 200)) == pytest.approx((0.1, 0.25, 0.45, 0.7))
    assert choose_edges(np.linspace(0, 1, 399)) == pytest.approx((0.1, 0.25, 0.45, 0.7))
    assert choose_edges(np.linspace(0, 1, 400)) == pytest.approx((0.05, 0.15, 0.25, 0.45, 0.7))
    assert len(choose_edges(np.zeros(400))) == 1  # all alike: no limit tells them apart


@pytest.mark.parametrize(
    "wrong",
    [
        [],
        {"edges": [0.25]},
        {"edges": [], "scores": [[1.0], [2.0]]},
        {"edges": [0.25], "scores": [[2.0, 1.0], []]},
        {"edges": [0.25], "scores": [[float("nan")], []]},
        {"edges": [0.25], "scores": [["1"], []]},
        {"edges": [0.25, 0.2], "scores": [[], [], []]},
        {"edges": [0.1] * 40, "scores": [[]] * 41},
        {"edges": [], "scores": [[1.0]], "by": "score"},
        {"edges": [], "scores": [[1.0]], "by": []},
        {"edges": [], "scores": [[1.0]], "more": 1},
        {"edges": [], "scores": [[1.0]], "occluded": [[1.0], []]},
        {"edges": [], "scores": [[1.0]], "occluded": [[2.0, 1.0]]},
        {"edges": [], "scores": [[1.0]], "occluded": 1},
    ],
)
def test_scores_that_are_none_are_refused(wrong: object) -> None:
    content = fit_calibration(frames()[0], "scenes").to_plain() | {"conformal": wrong}
    with pytest.raises(UserError, match="checkpoint=x: its calibration"):
        read_calibration(content, "checkpoint=x")
