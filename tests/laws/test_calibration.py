"""A calibration recovers the model that made the labels, and rises with each feature."""

import numpy as np
import pytest
import torch

from posefilter.confidence.calibration import LIMIT, Calibration, read_calibration
from posefilter.confidence.fit import (
    Frames,
    cross_validate,
    fit_calibration,
    fit_choice,
)
from posefilter.confidence.logistic import Logistic, fit_logistic
from posefilter.confidence.verdicts import Costs, apply_prior, decide, score_verdicts
from posefilter.errors import UserError
from posefilter.metrics.confidence import calibration_error

PLANTED = Logistic((2.0, 0.0, 1.0), -0.5)
NAMES = ("a", "b", "c")


def sigmoid(z: np.ndarray) -> np.ndarray:
    return 1 / (1 + np.exp(-z))


def draw(count: int, seed: int = 0) -> Frames:
    """Draw frames of a planted model: half show the object, and there success is logistic."""
    rng = np.random.default_rng(seed)
    there = rng.random(count) < 0.5
    x = rng.normal(size=(count, 3))
    x[:, 1] += np.where(there, 1.0, -1.0)  # presence: logistic with weight 2 of two normals
    success = sigmoid(x[:, [0, 2]] @ np.array([2.0, 1.0]) - 0.5)
    right = there & (rng.random(count) < success)
    return Frames(NAMES, x, there, right)


def test_a_planted_regression_is_recovered() -> None:
    rng = np.random.default_rng(1)
    x = rng.normal(size=(20_000, 3))
    label = rng.random(len(x)) < sigmoid(x @ np.array(PLANTED.weights) + PLANTED.bias)
    found = fit_logistic(x, label)
    assert np.allclose(found.weights, PLANTED.weights, atol=0.08)
    assert found.bias == pytest.approx(PLANTED.bias, abs=0.08)


def test_what_speaks_against_its_own_meaning_is_not_used() -> None:
    rng = np.random.default_rng(2)
    x = rng.normal(size=(2000, 2))
    label = rng.random(len(x)) < sigmoid(x @ np.array([1.0, -3.0]))
    found = fit_logistic(x, label)
    assert found.weights[1] == 0
    assert found.weights[0] > 0


def test_both_probabilities_are_those_that_made_the_labels() -> None:
    frames = draw(20_000)
    found = fit_calibration(frames, "scenes").assess_features(torch.from_numpy(frames.values))
    x = frames.values
    presence = sigmoid(2 * x[:, 1])
    inside = (np.abs(x) < LIMIT).all(1)
    gap = np.abs(found.presence.numpy() - presence)[inside]
    assert gap.mean() < 0.01
    assert gap.max() < 0.06
    success = sigmoid(x[:, [0, 2]] @ np.array([2.0, 1.0]) - 0.5)
    gap = np.abs(found.probability.numpy() - presence * success)[inside]
    assert gap.mean() < 0.015
    assert gap.max() < 0.08
    held = cross_validate(draw(4000, seed=3))
    right = torch.from_numpy(draw(4000, seed=3).correct)
    assert float(calibration_error(held.probability, right)) < 0.025


def test_more_of_a_feature_never_lowers_a_probability() -> None:
    calibration = fit_calibration(draw(300), "scenes")
    base = torch.randn(50, 3, dtype=torch.float64)
    before = calibration.assess_features(base)
    assert bool((before.probability <= before.presence).all())
    for k in range(3):
        more = base.clone()
        more[:, k] += torch.rand(50, dtype=torch.float64) * 5
        after = calibration.assess_features(more)
        assert bool((after.presence >= before.presence).all())
        assert bool((after.probability >= before.probability).all())


def test_features_beyond_the_calibration_counts_as_its_edge_and_none_as_the_worst() -> None:
    calibration = fit_calibration(draw(300), "scenes")
    edge = torch.tensor(calibration.center) + LIMIT * torch.tensor(calibration.scale)
    rows = torch.stack([edge, 100 * edge.abs() + 100, torch.full((3,), torch.nan)]).double()
    found = calibration.assess_features(rows).probability
    assert float(found[0]) == pytest.approx(float(found[1]))
    worst = calibration.assess_features(torch.full((1, 3), -1e9, dtype=torch.float64))
    assert float(found[2]) == float(worst.probability)


def test_few_frames_and_sure_labels_leave_doubt() -> None:
    """Ten frames on either side, told apart perfectly, are no proof of perfection."""
    there = np.arange(20) < 10
    x = np.where(there, 1.0, -1.0)[:, None]
    found = fit_calibration(Frames(("a",), x, there, there), "scenes")
    presence = found.assess_features(torch.from_numpy(x)).presence
    assert 0.8 < float(presence[0]) < 0.99
    with pytest.raises(UserError, match="9 frames without the object"):
        fit_calibration(Frames(("a",), x[:19], there[:19], there[:19]), "scenes")


def test_a_calibration_survives_as_plain_data() -> None:
    made = fit_calibration(draw(200), "scenes", {"auroc": 0.9})
    assert read_calibration(made.to_plain(), "x") == made
    assert isinstance(made, Calibration)


@pytest.mark.parametrize(
    ("presence", "probability", "costs", "verdict"),
    [
        (0.99, 0.95, Costs(10, 5, 1), "found"),
        (0.99, 0.85, Costs(10, 5, 1), "unsure"),  # 1.5 > 1
        (0.99, 0.85, Costs(5, 5, 1), "found"),
        (0.15, 0.10, Costs(10, 5, 1), "absent"),
        (0.15, 0.10, Costs(10, 10, 1), "unsure"),
        (0.15, 0.10, Costs(10, 5, 0.5), "unsure"),
        (0.60, 0.55, Costs(1, 1, 100), "found"),  # what costs too much is not chosen
        (0.40, 0.35, Costs(1, 1, 100), "absent"),
    ],
)
def test_a_verdict_costs_least(
    presence: float, probability: float, costs: Costs, verdict: str
) -> None:
    assert decide(presence, probability, costs) == verdict


def test_verdicts_lower_the_cost_that_is_paid() -> None:
    frames = draw(4000, seed=5)
    found = fit_calibration(draw(4000, seed=6), "scenes").assess_features(
        torch.from_numpy(frames.values)
    )
    costs = Costs(10, 5, 1)
    right, there = torch.from_numpy(frames.correct), torch.from_numpy(frames.present)

    def pay(verdict: torch.Tensor) -> float:
        alarm, miss = (verdict > 0) & ~right, (verdict < 0) & there
        total = costs.false_alarm * alarm + costs.miss * miss + costs.unsure * (verdict == 0)
        return float(total.double().mean())

    own = pay(score_verdicts(found, costs))
    for other in (1.0, 0.0, -1.0):
        assert own < pay(torch.full((len(right),), other))
    assert own <= pay(score_verdicts(found, Costs(2, 2, 1))) + 0.01


def test_a_prior_makes_probabilities_of_images_that_seldom_show_the_object() -> None:
    made = fit_calibration(draw(6000, seed=8), "scenes")
    frames = draw(60_000, seed=9)
    kept = frames.present & (np.arange(60_000) % 9 == 0) | ~frames.present  # one of ten
    frames = frames.select(np.flatnonzero(kept))
    found = made.assess_features(torch.from_numpy(frames.values))
    pairs = zip(found.presence.tolist(), found.probability.tolist(), strict=True)
    adjusted = torch.tensor([apply_prior(q, p, float(frames.present.mean())) for q, p in pairs])
    there, right = torch.from_numpy(frames.present), torch.from_numpy(frames.correct)
    assert float(calibration_error(adjusted[:, 0], there)) < 0.015
    assert float(calibration_error(adjusted[:, 1], right)) < 0.015
    assert float(calibration_error(found.presence, there)) > 0.05


def test_a_prior_of_one_half_changes_nothing_and_others_keep_the_order() -> None:
    assert apply_prior(0.7, 0.4, 0.5) == pytest.approx((0.7, 0.4))
    # odds of 4 times odds of 1 to 9
    assert apply_prior(0.8, 0.6, 0.1) == pytest.approx((4 / 13, 4 / 13 * 0.75))
    assert apply_prior(0.0, 0.0, 0.9) == (0, 0)
    assert apply_prior(1.0, 0.5, 0.01) == (1, 0.5)
    for wrong in (0, 1, -0.1, float("nan"), True, "1"):
        with pytest.raises(UserError, match="prior="):
            apply_prior(0.5, 0.5, wrong)  # type: ignore[arg-type]


def test_costs_are_positive() -> None:
    for wrong in (0, -1, float("inf"), float("nan"), True, "1"):
        with pytest.raises(UserError, match="cost_miss="):
            Costs(miss=wrong)  # type: ignore[arg-type]


def test_the_choice_ranks_answers_by_what_makes_them_right() -> None:
    """Objects that are absent count as wrong answers, and all parts share one standardization."""
    frames = draw(20_000)
    first = fit_choice(frames, "scenes")
    values = {name: torch.from_numpy(frames.values[:, k]) for k, name in enumerate(NAMES)}
    ranks = first.rank(values)
    right = torch.from_numpy(frames.correct)
    assert float(ranks[right].mean()) > float(ranks[~right].mean()) + 0.3
    x = frames.values
    planted = sigmoid(2 * x[:, 1]) * sigmoid(x[:, [0, 2]] @ np.array([2.0, 1.0]) - 0.5)
    assert float(np.corrcoef(planted, ranks.numpy())[0, 1]) > 0.85
    last = fit_calibration(draw(300, seed=9), "scenes", first=first)
    assert (last.center, last.scale, last.choice) == (first.center, first.scale, first.choice)
    assert torch.equal(last.rank(values), ranks)
    assert read_calibration(last.to_plain(), "x") == last


def test_answers_are_not_compared_by_how_clearly_the_texture_decides() -> None:
    frames = draw(2000)
    named = frames._replace(features=("rotation_margin", "b", "texture_density"))
    first = fit_choice(named, "scenes")
    assert first.choice is not None
    assert [weight > 0 for weight in first.choice.weights] == [False, True, False]
    assert first.success.weights[0] > 0.5
    kept = fit_choice(frames._replace(values=frames.values[:, [1]], features=("b",)), "scenes")
    assert kept.choice is not None
    np.testing.assert_allclose(first.choice.weights[1], kept.choice.weights[0], atol=1e-4)


def test_a_calibration_of_an_earlier_version_compares_no_answers() -> None:
    plain = fit_calibration(draw(200), "scenes").to_plain()
    del plain["choice"]
    old = read_calibration(plain, "x")
    assert old.choice is None
    with pytest.raises(UserError, match="compares no answers"):
        old.rank({name: torch.zeros(1) for name in NAMES})
    negative = {"weights": [1.0, -1.0, 0.0], "bias": 0.0}
    with pytest.raises(UserError, match=r"-1\.0.*choice"):
        read_calibration({**plain, "choice": negative}, "x")
