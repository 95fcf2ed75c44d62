"""A calibrated belief is as wide as the errors of right estimates, however wide the filter's is."""

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from torch import Tensor

from posefilter import Belief
from posefilter.cli.calibrate import Beliefs, fit_beliefs
from posefilter.confidence.belief_scale import (
    BeliefScale,
    PoseSpread,
    calibrate_belief,
    draw_student_t,
    fit_belief_scale,
    measure_spread,
)
from posefilter.confidence.calibration import Calibration, read_calibration
from posefilter.confidence.logistic import Logistic
from posefilter.errors import UserError
from posefilter.geometry.pose import make_pose, move_about
from posefilter.geometry.rotation import exp_so3, log_so3, random_rotation
from posefilter.metrics.credibility import score_truth
from posefilter.models.base import PoseEstimator
from posefilter.types import BeliefBatch, ObjectModel

CENTER = torch.tensor([0.01, -0.02, 0.03], dtype=torch.float64)
RADIUS, DIAMETER = 0.1, 0.19
# of errors, a turn as the shift at the radius [m]: uncertain along the view, sure of one turn
ROOT = torch.diag(torch.tensor([2e-3, 2e-3, 5e-3, 4e-3, 1e-3, 3e-3], dtype=torch.float64))
ROOT[2, 3] = 2e-3


def model(symmetries: Tensor | None = None) -> ObjectModel:
    points = torch.randn(30, 3, generator=torch.Generator().manual_seed(1)).double() * 0.05
    group = torch.eye(4, dtype=torch.float64)[None] if symmetries is None else symmetries
    return ObjectModel("thing", points, CENTER, RADIUS, DIAMETER, group, points)


def move(pose: Tensor, twist: Tensor) -> Tensor:
    """Move poses by twists whose turn is a shift at the radius."""
    return move_about(pose, twist / twist.new_tensor([1.0] * 3 + [RADIUS] * 3), CENTER)


def bare(probability: Tensor) -> Tensor:
    """Return no features."""
    return torch.zeros(len(probability), 0)


def draw_true(count: int, generator: torch.Generator, degrees: int = 5) -> Tensor:
    """Return independent draws (count, 6) of Student's t, whose moments are what they are."""
    normal = torch.randn(count, 6, generator=generator, dtype=torch.float64)
    squares = torch.randn(count, degrees, generator=generator, dtype=torch.float64).square()
    return normal * (degrees / squares.sum(1, keepdim=True)).sqrt()


def simulate(count: int, too_wide: float, slope: float, seed: int = 0) -> tuple[Beliefs, Tensor]:
    """Return beliefs whose particles are too wide by a factor, and what is said of them: errors
    shrink with the logit of the probability by `slope`.
    """
    generator = torch.Generator().manual_seed(seed)
    logit = torch.rand(count, generator=generator, dtype=torch.float64) * 6 - 1
    rotation = random_rotation(count, generator=generator).double()
    best = make_pose(rotation, torch.tensor([0.1, 0.0, 0.8], dtype=torch.float64).expand(count, 3))
    error = draw_true(count, generator) * (slope * logit).exp()[:, None] @ ROOT.mT
    noise = torch.randn((count, 200, 6), generator=generator, dtype=torch.float64)
    poses = move(best[:, None], too_wide * noise @ ROOT.mT)
    beliefs = BeliefBatch(
        poses, torch.full((count, 200), -math.log(200)).double(), best, torch.zeros(count)
    )
    return Beliefs(beliefs, move(best, error)), logit.sigmoid()


@pytest.mark.parametrize("too_wide", [0.3, 1.0, 4.0])
def test_the_scale_of_simulated_errors_is_found(too_wide: float) -> None:
    (beliefs, truth), probability = simulate(300, too_wide, slope=-0.15)
    found = fit_belief_scale(
        measure_spread(beliefs, truth, model()), probability, bare(probability)
    )
    assert found is not None
    assert found.slope == pytest.approx(-0.15, abs=0.05)
    scatter = measure_spread(beliefs, truth, model()).scatter
    middle = torch.tensor([2.0]).sigmoid()  # of the simulated frames
    size = found.find_factor(middle, bare(middle)) * sizes(found.find_shape(scatter)).mean()
    true = math.exp(-0.15 * 2) * sizes(ROOT @ ROOT.mT)
    assert float(size / true) == pytest.approx(1, abs=0.1)


@pytest.mark.parametrize("spread_out", [0.2, 5.0])
def test_where_particles_are_close_errors_have_the_shape_of_all(spread_out: float) -> None:
    """And where they are far apart, that of the particles."""
    generator = torch.Generator().manual_seed(1)
    count = 600
    common = 1e-3 * torch.randn(6, 6, generator=generator, dtype=torch.float64)
    common = common @ common.mT + 1e-7 * torch.eye(6, dtype=torch.float64)
    # of each image along an axis of its own
    axis = torch.randn(count, 6, generator=generator, dtype=torch.float64)
    axis = 3e-3 * spread_out * axis / axis.norm(dim=1, keepdim=True)
    scatter = axis[:, :, None] * axis[:, None] + 1e-7 * torch.eye(6, dtype=torch.float64)
    shape = 0.49 * (scatter + common)
    errors = draw_true(count, generator)[..., None]
    twist = (torch.linalg.cholesky(shape) @ errors)[..., 0]
    probability = torch.full((count,), 0.5)
    found = fit_belief_scale(PoseSpread(twist, scatter), probability, bare(probability))
    assert found is not None
    factor = found.find_factor(probability, bare(probability))[:, None, None]
    learned = factor**2 * found.find_shape(scatter)
    # the divergence of Kullback and Leibler between normal distributions of these covariances
    between = torch.linalg.solve(learned, shape)
    trace = between.diagonal(dim1=1, dim2=2).sum(1)
    assert float(0.5 * (trace - 6 - torch.linalg.slogdet(between)[1]).mean()) < 0.1
    without = replace(found, common=())
    assert torch.equal(without.find_shape(scatter), scatter)


def sizes(covariance: Tensor) -> Tensor:
    """Return the geometric mean of the axes of ellipsoids.  (*, 6, 6) -> (*,)."""
    return torch.linalg.slogdet(covariance)[1].div(12).exp()


@pytest.mark.parametrize("too_wide", [0.3, 4.0])
@pytest.mark.slow
def test_sets_and_ellipsoids_of_new_frames_hold_the_truth_as_often_as_they_say(
    too_wide: float,
) -> None:
    (beliefs, truth), probability = simulate(120, too_wide, slope=-0.2)
    scale, _ = fit_beliefs(
        Beliefs(beliefs, truth), probability, bare(probability), np.ones(120, bool), model()
    )
    assert scale is not None
    (new, new_truth), said = simulate(150, too_wide, slope=-0.2, seed=7)
    before = score_truth(new, new_truth, model())
    after_belief, _ = calibrate_belief(new, said, bare(said), scale, model())
    after = score_truth(after_belief, new_truth, model())
    assert float(after.log_density.mean()) > float(before.log_density.mean()) + 1
    error = math.sqrt(0.25 / 150)
    for level in (0.5, 0.9):
        # kernels of 200 draws make sets a little too small, see docs/results/confidence.md
        share = float((after.rank < level).double().mean())
        assert level - 0.12 - 2 * error < share < level + 2 * error
        assert abs(float((before.rank < level).double().mean()) - level) > abs(share - level)
    spread = measure_spread(after_belief, new_truth, model())
    inside = (
        torch.linalg.solve(spread.scatter, spread.twist[..., None])[..., 0] * spread.twist
    ).sum(1)
    # of Student's t, over its variance: the median of 6 F(6, 5) is 5.8, times 3 / 5
    assert 0.35 < float((inside < 3.5).double().mean()) < 0.65


@pytest.mark.slow
def test_a_fit_takes_right_estimates_alone_and_few_of_them_give_none() -> None:
    (beliefs, truth), probability = simulate(40, 1.0, slope=-0.2)
    right = np.arange(40) < 30
    far = truth.clone()
    far[30:, 2, 3] += 1.0
    with_wrong, score = fit_beliefs(
        Beliefs(beliefs, far), probability, bare(probability), right, model()
    )
    without, _ = fit_beliefs(
        Beliefs(beliefs, truth).select(np.arange(30)),
        probability[:30],
        bare(probability)[:30],
        right[:30],
        model(),
    )
    assert with_wrong == without
    assert np.median(score[30:]) > np.median(score[:30]) + 5
    few = np.arange(40) < 9
    none, plain = fit_beliefs(Beliefs(beliefs, truth), probability, bare(probability), few, model())
    assert none is None
    own = score_truth(beliefs, truth, model()).nonconformity.numpy()
    assert plain == pytest.approx(own)


def test_no_frame_is_judged_by_a_scale_that_has_seen_it() -> None:
    (beliefs, truth), probability = simulate(25, 1.0, slope=-0.2)
    other = truth.clone()
    other[0, 0, 3] += 0.02
    all_right = np.ones(25, bool)
    a, b = (
        fit_beliefs(Beliefs(beliefs, one), probability, bare(probability), all_right, model())[1]
        for one in (truth, other)
    )
    # the four others of the frame's own part are calibrated by the same fit as before
    assert int((a == b).sum()) == 4
    assert a[0] != b[0]


@pytest.mark.parametrize(  # F(6, n) at 95 %
    ("degrees", "most"), [(3, 8.94), (4, 6.16), (5, 4.95), (6, 4.28), (8, 3.58)]
)
def test_draws_have_the_moments_of_the_distribution_and_are_always_the_same(
    degrees: int, most: float
) -> None:
    moment = torch.eye(6, dtype=torch.float64) * degrees / (degrees - 2)
    for count in (32, 200, 201):
        draws = draw_student_t(count, degrees)
        assert draws.shape == (count, 6)
        assert torch.allclose(draws.mT @ draws / count, moment, atol=1e-9)
        assert torch.equal(draws, draw_student_t(count, degrees))
    half = draw_student_t(200, degrees)
    assert torch.equal(half[::2], -half[1::2])
    tail = draw_student_t(200, degrees).square().sum(1)
    assert float((tail < 6 * most).double().mean()) == pytest.approx(0.95, abs=0.035)


@pytest.mark.parametrize("degrees", [3, 4, 5, 6, 8])
def test_the_degrees_of_freedom_are_found(degrees: int) -> None:
    """Also that few frames leave the usual ones."""
    twist = 0.5 * draw_true(2000, torch.Generator().manual_seed(degrees), degrees)
    scatter = torch.eye(6, dtype=torch.float64).expand(2000, 6, 6)
    probability = torch.full((2000,), 0.9)
    for count, want in ((2000, degrees), (15, 5)):
        spread = PoseSpread(twist[:count], scatter[:count])
        found = fit_belief_scale(spread, probability[:count], bare(probability[:count]))
        assert found is not None
        assert found.degrees == want
    factor = fit_belief_scale(PoseSpread(twist, scatter), probability, bare(probability))
    assert factor is not None
    size = factor.find_factor(probability[:1], bare(probability[:1])) * sizes(
        factor.find_shape(scatter[0])
    )
    assert float(size) == pytest.approx(0.5, rel=0.05)


def test_a_widened_belief_has_errors_so_many_times_as_large() -> None:
    (beliefs, _), probability = simulate(2, 2.0, slope=0)
    scale = BeliefScale(-0.3, 0.0, common=tuple(0.01 * k for k in range(21)))
    given = beliefs, probability, bare(probability), scale, model()
    once, twice = calibrate_belief(*given)[0], calibrate_belief(*given, 2.0)[0]
    assert torch.equal(once.best, twice.best)
    for i in range(2):
        # of the first draws, which are the same with either
        first, second = (one.poses[i, :32, :3, 3] - one.best[i, :3, 3] for one in (once, twice))
        center = model().center.double()
        turned = [
            (one.poses[i, :32, :3, :3] - one.best[i, :3, :3]) @ center for one in (once, twice)
        ]
        assert torch.allclose(second + turned[1], 2 * (first + turned[0]), atol=1e-9)


def test_the_covariance_about_the_estimate_is_that_of_the_model() -> None:
    (beliefs, truth), probability = simulate(3, 2.0, slope=0)
    lower = torch.linalg.cholesky(ROOT @ ROOT.mT)
    common = tuple(lower[torch.tril_indices(6, 6).unbind()].tolist())
    scale = BeliefScale(bias=-0.5, slope=-0.1, common=common)
    out, _ = calibrate_belief(beliefs, probability, bare(probability), scale, model())
    assert torch.equal(out.best, beliefs.best)
    assert torch.equal(out.score, beliefs.score)
    scatter = measure_spread(beliefs, truth, model()).scatter
    factor = scale.find_factor(probability, bare(probability))
    for i in range(3):
        weights = out.log_weights[i].exp()
        own = Belief(out.poses[i].numpy(), weights.numpy(), CENTER.numpy(), RADIUS, DIAMETER)
        unit = np.array([1.0] * 3 + [RADIUS] * 3)
        found = own.covariance_about(beliefs.best[i].numpy()) * unit[:, None] * unit
        wanted = (5 / 3 * factor[i] ** 2 * (scatter[i] + ROOT @ ROOT.mT)).numpy()
        assert found == pytest.approx(wanted, abs=1e-3 * float(wanted.max()))


def test_hypotheses_elsewhere_keep_their_poses_and_their_mass() -> None:
    (beliefs, _), probability = simulate(1, 1.0, slope=0)
    poses, log_weights = beliefs.poses.clone(), torch.zeros(1, 200, dtype=torch.float64)
    half_turn = torch.eye(4, dtype=torch.float64)
    half_turn[:3, :3] = exp_so3(torch.tensor([0.0, math.pi, 0.0], dtype=torch.float64))
    poses[0, :60] = poses[0, :60] @ half_turn
    log_weights[0, :60] = math.log(2)
    given = beliefs._replace(poses=poses, log_weights=log_weights.log_softmax(1))
    out, _ = calibrate_belief(given, probability, bare(probability), BeliefScale(0.0, 0.0), model())
    weights = out.log_weights[0].exp()
    kept = (out.poses[0, :, None] - poses[0, None, :60]).abs().amax((2, 3)).amin(1) < 1e-12
    mass = 120 / 260
    assert float(weights.sum()) == pytest.approx(1)
    assert float(weights[kept].sum()) == pytest.approx(mass, abs=1e-6)
    # systematic: each is drawn once or twice
    assert int(kept.sum()) == round(200 * mass)
    # of a symmetric object they are the same pose
    group = torch.stack([torch.eye(4, dtype=torch.float64), half_turn])
    group[1, :3, 3] = CENTER - half_turn[:3, :3] @ CENTER
    poses[0, :60] = beliefs.poses[0, :60] @ group[1]
    same, _ = calibrate_belief(
        given._replace(poses=poses), probability, bare(probability), BeliefScale(0, 0), model(group)
    )
    centers = same.poses[0, :, :3, :3] @ CENTER + same.poses[0, :, :3, 3]
    away = (same.poses[0, :, :3, :3].mT @ given.best[0, :3, :3]).diagonal(dim1=1, dim2=2).sum(1)
    assert float(away.min()) > 1  # no half turn among them
    assert float((centers - centers.mean(0)).norm(dim=1).median()) < 0.02


def test_of_a_continuous_symmetry_any_turn_is_as_dense() -> None:
    (beliefs, _), probability = simulate(4, 1.0, slope=0)
    angle = torch.arange(36, dtype=torch.float64)[:, None] * math.radians(10)
    rotation = exp_so3(angle * torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
    bowl = model(make_pose(rotation, CENTER - rotation @ CENTER))
    out, _ = calibrate_belief(beliefs, probability, bare(probability), BeliefScale(0.0, 0.0), bowl)
    half = exp_so3(torch.tensor([0.0, 0.0, math.radians(5)], dtype=torch.float64))
    between = beliefs.best @ make_pose(half, CENTER - half @ CENTER)
    at, beside = (score_truth(out, one, bowl) for one in (beliefs.best, between))
    assert float((at.log_density - beside.log_density).abs().max()) < 1
    assert float(beside.rank.max()) < 0.5
    # turned to either side alike: the mean is the estimate
    for poses, best in zip(out.poses.double(), beliefs.best.double(), strict=True):
        about_z = log_so3(best[:3, :3].mT @ poses[:, :3, :3])[:, 2]
        assert abs(math.degrees(float(about_z.mean()))) < 0.5
        assert math.degrees(float(about_z.std())) > 2


def test_one_particle_and_none_near_the_estimate_become_a_belief_about_it() -> None:
    best = torch.eye(4)[None]
    for shift in (0.0, 1.0):
        poses = best[:, None].clone()
        poses[0, 0, 2, 3] += shift
        lone = BeliefBatch(poses, torch.zeros(1, 1), best, torch.zeros(1))
        out, _ = calibrate_belief(
            lone, torch.ones(1), bare(torch.ones(1)), BeliefScale(0.0, 0.0), model()
        )
        assert out.poses.shape == (1, 200, 4, 4)
        assert out.poses.dtype == torch.float32
        weights = out.log_weights[0].exp()
        near = out.poses[0, :, :3, 3].norm(dim=1) < 0.5
        assert int(near.sum()) == (200 if shift == 0 else 32)
        assert float(weights.sum()) == pytest.approx(1, abs=1e-5)
        Belief(out.poses[0].numpy(), weights.numpy(), CENTER.numpy(), RADIUS, DIAMETER)


def test_where_an_estimate_is_not_finite_the_particles_stay() -> None:
    (beliefs, truth), probability = simulate(12, 1.0, slope=0)
    best = beliefs.best.clone()
    best[1] = torch.nan
    log_weights = torch.full((12, 200), -1e9, dtype=torch.float64)
    log_weights[:, 3], log_weights[:, 7] = math.log(0.25), math.log(0.75)
    given = beliefs._replace(best=best, log_weights=log_weights)
    out, _ = calibrate_belief(given, probability, bare(probability), BeliefScale(0.0, 0.0), model())
    assert torch.equal(out.poses[1, :50], beliefs.poses[1, [3]].expand(50, 4, 4))
    assert torch.equal(out.poses[1, 50:], beliefs.poses[1, [7]].expand(150, 4, 4))
    assert float(out.log_weights.exp().sum(1).sub(1).abs().max()) < 1e-9
    # one does not keep the others from being calibrated
    right = np.arange(12) != 1
    scale, surprise = fit_beliefs(
        Beliefs(given, truth), probability, bare(probability), right, model()
    )
    assert scale is not None
    assert np.isfinite(surprise).all()


def test_the_scatter_is_about_the_estimate_and_has_full_rank() -> None:
    (beliefs, truth), _ = simulate(1, 1.0, slope=0)
    twist = torch.zeros(3, 6, dtype=torch.float64)
    twist[0, 0], twist[1, 4], twist[2, 2] = 0.01, 0.02, 1.0  # the last is another hypothesis
    weights = torch.tensor([[0.6, 0.2, 0.2]], dtype=torch.float64)
    poses = move(beliefs.best[:, None], twist)
    found = measure_spread(
        beliefs._replace(poses=poses, log_weights=weights.log()), truth, model()
    ).scatter[0]
    count = 0.8**2 / (0.6**2 + 0.2**2)  # effective
    moment = torch.diag(torch.tensor([0.75 * 0.01**2, 0, 0, 0, 0.25 * 0.02**2, 0]).double())
    prior = (0.03 * DIAMETER) ** 2 * torch.eye(6, dtype=torch.float64)
    assert torch.allclose(found, (count * moment + 4 * prior) / (count + 4), atol=1e-12, rtol=1e-6)


def test_ten_frames_do_not_take_a_fit_far_from_what_is_known_of_other_objects() -> None:
    spread = PoseSpread(
        torch.zeros(10, 6, dtype=torch.float64), torch.eye(6, dtype=torch.float64).expand(10, 6, 6)
    )
    found = fit_belief_scale(spread, torch.full((10,), 0.5), torch.zeros(10, 2))
    assert found is not None
    # no errors at all: as small as a scale may be, and of the slope its prior alone
    assert found.bias == -3.0
    assert found.slope == pytest.approx(-0.2, abs=1e-3)
    assert found.weights == pytest.approx((0.0, 0.0), abs=1e-6)
    far = fit_belief_scale(
        spread._replace(twist=torch.full_like(spread.twist, 1e4)),
        torch.full((10,), 0.5),
        torch.zeros(10, 2),
    )
    assert far is not None
    assert np.isfinite(far.common).all()
    few = spread._replace(twist=draw_true(10, torch.Generator().manual_seed(0)))
    found = fit_belief_scale(few, torch.full((10,), 0.5), torch.zeros(10, 2))
    assert found is not None
    shape = found.find_factor(torch.tensor([0.5]), torch.zeros(1, 2)) ** 2 * found.find_shape(
        spread.scatter[0]
    )
    # errors as the particles say: within a factor of two along each axis
    assert float(torch.linalg.eigvalsh(shape).log().abs().max()) < 2 * math.log(2)


def test_the_factor_is_limited_to_what_frames_can_tell() -> None:
    scale = BeliefScale(0.1, -0.2)
    said = torch.tensor([0.0, 0.5, 1.0])
    assert scale.find_factor(said, bare(said)).log().tolist() == pytest.approx([1.1, 0.1, -0.9])


def test_what_speaks_for_an_estimate_tells_how_wide_its_belief_is() -> None:
    """Errors that shrink with a feature, which says nothing of whether the pose is right."""
    (beliefs, truth), probability = simulate(300, 1.0, slope=0)
    told = torch.linspace(-1.5, 1.5, 300, dtype=torch.float64)[:, None] * torch.tensor([1.0, 0.0])
    spread = measure_spread(beliefs, truth, model())
    spread = spread._replace(twist=spread.twist * (-0.4 * told[:, :1]).exp())
    found = fit_belief_scale(spread, probability, told)
    assert found is not None
    assert found.weights == pytest.approx((-0.4, 0.0), abs=0.08)
    factor = found.find_factor(torch.full((2,), 0.5), torch.tensor([[1.0, 0.0], [-1.0, 9.0]]))
    assert float((factor[1] / factor[0]).log()) == pytest.approx(0.8, abs=0.2)
    far = found.find_factor(torch.zeros(2), torch.tensor([[99.0, 0.0], [-99.0, 0.0]]))
    assert far.log().tolist() == [-3.0, 3.0]


def calibration(belief_scale: BeliefScale | None) -> Calibration:
    one = Logistic((1.0,), 0.0)
    counts = {"right": 10, "wrong": 2, "absent": 12}
    return Calibration(
        ("score",), (0.0,), (1.0,), one, one, counts, "fat", {}, belief_scale=belief_scale
    )


def test_the_factor_goes_by_the_default_tolerance_whatever_the_verdict_goes_by() -> None:
    (beliefs, _), _ = simulate(2, 1.0, slope=0)
    own = calibration(BeliefScale(-0.5, -0.3))
    found = own.assess({"score": torch.tensor([1.0, -1.0])})
    method = SimpleNamespace(calibration=own, object_model=model())
    elsewhere = found._replace(probability=torch.zeros(2))  # of a stricter tolerance
    out, _ = PoseEstimator.calibrate_belief(method, beliefs, elsewhere)  # type: ignore[arg-type]
    wanted, _ = calibrate_belief(
        beliefs, found.probability, bare(found.probability), BeliefScale(-0.5, -0.3), model()
    )
    assert torch.equal(out.poses, wanted.poses)
    assert not torch.equal(out.poses[0], beliefs.poses[0])
    for plain, known in ((calibration(None), found), (own, None)):
        method = SimpleNamespace(calibration=plain, object_model=model())
        same, _ = PoseEstimator.calibrate_belief(method, beliefs, known)  # type: ignore[arg-type]
        assert same is beliefs


def test_a_scale_is_stored_and_read_and_older_calibrations_have_none() -> None:
    plain = calibration(BeliefScale(-0.25, -0.125)).to_plain()
    usual = {"bias": -0.25, "slope": -0.125, "weights": [], "degrees": 5, "common": []}
    assert plain["belief_scale"] == usual
    assert read_calibration(plain, "x").belief_scale == BeliefScale(-0.25, -0.125)
    plain = calibration(BeliefScale(-0.25, -0.125, (0.5,), 3)).to_plain()
    assert read_calibration(plain, "x").belief_scale == BeliefScale(-0.25, -0.125, (0.5,), 3)
    for wrong in (7, 3.0, True, "3"):
        plain["belief_scale"]["degrees"] = wrong
        with pytest.raises(UserError, match="degrees"):
            read_calibration(plain, "x")
    del plain["belief_scale"]["degrees"]
    assert read_calibration(plain, "x").belief_scale == BeliefScale(-0.25, -0.125, (0.5,))
    whole = BeliefScale(-0.25, -0.125, (0.5,), 3, tuple(0.01 * k for k in range(21)))
    assert read_calibration(calibration(whole).to_plain(), "x").belief_scale == whole
    del plain["belief_scale"]["common"]  # of an earlier version
    assert read_calibration(plain, "x").belief_scale == BeliefScale(-0.25, -0.125, (0.5,))
    del plain["belief_scale"]["weights"]
    assert read_calibration(plain, "x").belief_scale == BeliefScale(-0.25, -0.125)
    del plain["belief_scale"]
    assert read_calibration(plain, "x").belief_scale is None


@pytest.mark.parametrize(
    "content",
    [
        [],
        {"bias": 0.0},
        {"bias": 0.0, "slope": 0.0, "more": 1.0},
        {"bias": math.nan, "slope": 0.0},
        {"bias": 11.0, "slope": 0.0},
        {"bias": 0.0, "slope": -1e5},
        {"bias": "0", "slope": 0.0},
        {"bias": True, "slope": 0.0},
        {"bias": 0.0, "slope": 0.0, "weights": 1.0},
        {"bias": 0.0, "slope": 0.0, "weights": [0.0, 0.0]},
        {"bias": 0.0, "slope": 0.0, "weights": [math.inf]},
        {"bias": 0.0, "slope": 0.0, "weights": [20.0]},
        {"bias": 0.0, "slope": 0.0, "common": [0.0] * 20},
        {"bias": 0.0, "slope": 0.0, "common": [math.nan] * 21},
        {"bias": 0.0, "slope": 0.0, "common": [1e3] * 21},
        {"bias": 0.0, "slope": 0.0, "common": [-1e3] * 21},
    ],
)
def test_a_scale_that_is_none_is_refused(content: object) -> None:
    plain = calibration(None).to_plain() | {"belief_scale": content}
    with pytest.raises(UserError, match=r"x: its calibration .*belief_scale"):
        read_calibration(plain, "x")


def open_belief(beliefs: BeliefBatch, draws: Tensor) -> Belief:
    weights = beliefs.log_weights[0].exp().numpy()
    own = (CENTER.numpy(), RADIUS, DIAMETER, "thing", np.eye(4)[None], int(draws[0]))
    return Belief(beliefs.poses[0].numpy(), weights, *own)


def test_draws_are_one_mode_however_wide_and_the_uncertainty_is_of_the_estimate() -> None:
    (beliefs, _), probability = simulate(1, 1.0, slope=0)
    wide, draws = calibrate_belief(
        beliefs, probability, bare(probability), BeliefScale(1.5, 0.0), model()
    )
    belief = open_belief(wide, draws)
    assert belief.draws == 200
    assert len(belief.modes) == 1
    assert belief.modes[0].pose == pytest.approx(beliefs.best[0].numpy(), abs=1e-3)
    off = np.linalg.norm((belief.samples - belief.modes[0].pose) @ [*CENTER, 1], axis=1)
    assert belief.uncertainty().translation == pytest.approx(np.quantile(off, 0.95), rel=0.05)
    assert belief.uncertainty().mass == pytest.approx(1)
    as_particles = replace(belief, draws=0)
    assert len(as_particles.modes) > 5  # what quick shift would make of them

    # most of the particles are elsewhere: another hypothesis is heavier, and no more certain
    poses = beliefs.poses.clone()
    poses[0, 30:, 0, 3] += 0.3
    away, draws = calibrate_belief(
        beliefs._replace(poses=poses),
        probability,
        bare(probability),
        BeliefScale(0.0, 0.0),
        model(),
    )
    belief = open_belief(away, draws)
    assert belief.draws == 32
    assert belief.modes[0].mass > 0.7
    assert abs(belief.modes[0].pose[0, 3] - poses[0, 30:, 0, 3].mean()) < 0.02
    near = (
        belief.modes[1]
        if len(belief.modes) == 2
        else max(belief.modes[1:], key=lambda mode: mode.mass)
    )
    assert near.pose == pytest.approx(beliefs.best[0].numpy(), abs=2e-3)
    assert belief.uncertainty().mass == pytest.approx(near.mass)
    assert "of a pose that has 16 % of the belief" in belief.uncertainty().describe()
    assert sum(mode.mass for mode in belief.modes) == pytest.approx(1)


def test_draws_survive_a_file_and_another_frame_and_are_none_of_a_fused_belief(
    tmp_path: Path,
) -> None:
    (beliefs, _), probability = simulate(1, 1.0, slope=0)
    belief = open_belief(
        *calibrate_belief(beliefs, probability, bare(probability), BeliefScale(0, 0), model())
    )
    belief.save(tmp_path / "belief.npz")
    assert Belief.load(tmp_path / "belief.npz").draws == 200
    assert belief.transform(np.eye(4)).draws == 200
    assert belief.fuse(belief, 50).draws == 0
    for wrong in (-1, 201):
        with pytest.raises(UserError, match="cannot be draws"):
            replace(belief, draws=wrong)
