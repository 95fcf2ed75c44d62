"""The pose-space method end to end on a toy world, and the laws that its lessons must keep."""

from functools import partial

import pytest
import torch
from tests.models.toy import scenes, square
from torch.nn.functional import pad

from posefilter.errors import UserError
from posefilter.filters.candidates import perturb
from posefilter.filters.estimate import Argmax
from posefilter.filters.initialize import FromDepth, FromProposals
from posefilter.filters.loop import ParticleFilter
from posefilter.filters.propagate import Gaussian
from posefilter.filters.refine import Compose, Gradient, NoRefine, Rescore
from posefilter.filters.resample import Systematic
from posefilter.filters.reweight import CurrentLikelihood
from posefilter.filters.schedule import Geometric
from posefilter.geometry.pose import invert
from posefilter.labels.paper_points import PaperPoints
from posefilter.losses.contrastive import Contrastive
from posefilter.losses.regression import Regression
from posefilter.metrics.errors import add
from posefilter.models.candidate_samplers import CandidatePoses, LabeledRays, pick_pixels
from posefilter.models.pose_pf import PosePF
from posefilter.nets.likelihood import PoseLikelihood
from posefilter.nets.paper_likelihood import PaperLikelihood
from posefilter.nets.proposals import ObjectCoordinateNet
from posefilter.types import Batch, BeliefBatch

SIGMA = (0.01, 0.2)


def working(initialize: object = None) -> PosePF:
    torch.manual_seed(0)
    start = initialize or FromProposals()
    pieces = (
        start,
        Geometric(0.05, SIGMA[0]),
        CurrentLikelihood(),
        Systematic(),
        Gaussian(0.4),
        Argmax(),
        NoRefine(),
    )
    method = PosePF(
        PoseLikelihood(width=48, blocks=2, octaves=3, sigma=SIGMA, context=4),
        CandidatePoses(candidates_per_kind=6, proposals=4, particles=6, sigma_range=SIGMA),
        ObjectCoordinateNet((16, 24, 32, 32), fragments=16, features=4),
        filter=ParticleFilter(100, 6, *pieces, initial_particles=200),
        loss=Contrastive(),
        optimizer=partial(torch.optim.AdamW, lr=3e-3),
    )
    method.set_object(square())
    return method


def error(method: PosePF, count: int = 16, more: tuple[int, int] = (0, 0)) -> torch.Tensor:
    """Return the filter's ADD on scenes that no training saw, with so many more columns and rows of
    background [m].
    """
    method.eval()
    batch = widened(scenes(count, seed=10_000), *more)
    with torch.no_grad():
        trace = method.filter(batch, method, torch.Generator().manual_seed(0))
    return add(trace.belief.best, batch.camera_from_object, method.object_model.points)


def widened(batch: Batch, columns: int, rows: int) -> Batch:
    """Return the batch with background on the right and below; what was to be seen keeps its
    place.
    """
    rgb, depth, mask = (
        pad(x, (0, columns, 0, rows), value=v)
        for x, v in zip(batch[:3], (0.5, 1.5, 0), strict=True)
    )
    return batch._replace(rgb=rgb, depth=depth, mask=mask)


@pytest.fixture(scope="module")
def trained() -> PosePF:
    method = working()
    optimizer = torch.optim.AdamW(method.parameters(), 3e-3)
    method.train()
    for step in range(100):
        batch = scenes(8, seed=step)._replace(frame_id=torch.arange(8) + 8 * (step % 4))
        losses = method.training_losses(batch, torch.Generator().manual_seed(step))
        assert set(losses) == {"likelihood", "proposals"}
        optimizer.zero_grad()
        sum(value.mean() for value in losses.values()).backward()
        torch.nn.utils.clip_grad_norm_(method.parameters(), 5.0)
        optimizer.step()
    return method


def test_a_short_training_finds_the_pose(trained: PosePF) -> None:
    after, before = error(trained), error(working())
    assert after.median() < 0.025
    assert before.median() > 0.1


@pytest.mark.parametrize("more", [(0, 4), (5, 3), (1, 0)])
def test_sides_that_are_no_whole_cells_are_as_good(more: tuple[int, int], trained: PosePF) -> None:
    """As FAT's 960 x 540 at width 320 is: 180 rows are 22 cells and a half."""
    assert error(trained, more=more).median() < 0.03
    losses = trained.training_losses(widened(scenes(4), *more), torch.Generator().manual_seed(0))
    assert all(value.isfinite().all() for value in losses.values())


def test_refinement_brings_the_estimate_closer(trained: PosePF) -> None:
    """From places a few centimeters off, so that the gain does not drown in what so short a
    training leaves open.
    """
    trained.eval()
    batch = scenes(32, seed=40_000)
    g = torch.Generator().manual_seed(0)
    truth = batch.camera_from_object
    start = perturb(truth[:, None], torch.full((32, 1), 0.05), trained.space, g)
    belief = BeliefBatch(start, torch.zeros(32, 1), start[:, 0], torch.zeros(32))
    with torch.no_grad():
        encoding = trained.encode(batch)
        climb = Gradient(40, lr=4e-3, sigma=SIGMA[0], final_sigma=SIGMA[0])
        refined = Compose([Rescore(1, 256, SIGMA[0]), climb])(belief, encoding, trained, g)
    before, after = (
        add(x, truth, trained.object_model.points).median() for x in (belief.best, refined.best)
    )
    assert before > 0.05
    assert after < 0.6 * before


def test_the_trained_likelihood_prefers_the_truth(trained: PosePF) -> None:
    trained.eval()
    batch = scenes(16, seed=20_000)
    encoding = trained.encode(batch)
    g = torch.Generator().manual_seed(0)
    truth = batch.camera_from_object[:, None]
    others = FromDepth()(batch, encoding, trained, 60, g)
    with torch.no_grad():
        scores = trained.score_poses(encoding, torch.cat([truth, others], 1), 0.02, g, 128)
    assert (scores[:, :1] > scores[:, 1:]).float().mean() > 0.97


def test_neither_mask_nor_truth_is_used(trained: PosePF) -> None:
    trained.eval()
    batch = scenes(3, seed=30_000)
    blind = batch._replace(
        mask=torch.zeros_like(batch.mask), camera_from_object=torch.eye(4).expand(3, 4, 4)
    )
    with torch.no_grad():
        a, b = (
            trained.filter(x, trained, torch.Generator().manual_seed(0)).belief
            for x in (batch, blind)
        )
    assert torch.equal(a.best, b.best)


def test_the_papers_samples_lie_along_the_rays() -> None:
    method = PosePF(
        PaperLikelihood(),
        LabeledRays(rays=8),
        filter=working(FromDepth()).filter,
        loss=Regression(PaperPoints()),
        optimizer=torch.optim.Adam,
    )
    method.set_object(square())
    batch = scenes(2)
    trace = method.candidate_sampler(
        method, method.encode(batch), batch, torch.Generator().manual_seed(0)
    )
    state, weight = trace.particles[0].state, trace.particles[0].log_weights.exp()
    assert state.shape == (2, 8 * 30 * 2, 4)
    # one ray, colors random: from 10 cm before the camera to 5 cm behind the surface
    first = state[0, :30]
    assert torch.equal(first[:, :2], first[:1, :2].expand(30, 2))
    assert first[:, 2].diff().min() > 0
    assert first[-1, 2] == pytest.approx(0.05, rel=0.2)
    u, v = first[0, :2].long().tolist()
    assert batch.mask[0, 0, v, u]
    on = (weight[0] > 0) & (state[0, :, 3] > 0.5)
    assert (state[0, on, 2].abs() <= 0.01).all()
    loss = method.training_losses(batch, torch.Generator().manual_seed(0))["likelihood"]
    assert loss.shape == (2,)
    assert torch.isfinite(loss).all()


def test_all_rays_are_each_pixel_once_and_images_differ_in_their_number() -> None:
    usable = torch.tensor([[0.0, 1, 0, 1, 1], [0, 0, 1, 0, 0], [0, 0, 0, 0, 0]])
    pick, drawn = pick_pixels(usable, None, torch.Generator())
    assert pick.shape == (3, 3)
    assert [row[mask].tolist() for row, mask in zip(pick, drawn, strict=True)] == [
        [1, 3, 4],
        [2],
        [],
    ]
    some, drawn = pick_pixels(usable, 50, torch.Generator().manual_seed(0))
    assert [set(row.tolist()) for row in some[:2]] == [{1, 3, 4}, {2}]
    assert drawn.all(1).tolist() == [True, True, False]


def test_every_ray_of_an_image_has_the_same_weight_and_padding_none() -> None:
    method = PosePF(
        PaperLikelihood(),
        LabeledRays(rays=None, samples=3),
        filter=working(FromDepth()).filter,
        loss=Regression(PaperPoints()),
        optimizer=torch.optim.Adam,
    )
    method.set_object(square())
    batch = scenes(2)
    sizes = (batch.mask & (batch.depth > 0.1)).flatten(1).sum(1)
    batch.mask[1, 0, :, : batch.mask.shape[-1] // 2] = False
    smaller = (batch.mask & (batch.depth > 0.1)).flatten(1).sum(1)
    assert 0 < smaller[1] < sizes[1]
    trace = method.candidate_sampler(
        method, method.encode(batch), batch, torch.Generator().manual_seed(0)
    )
    weight = trace.particles[0].log_weights.exp().unflatten(1, (2, -1, 3))  # color, ray, sample
    assert ((weight[:, 0, :, 0] > 0).sum(1) == smaller).all()
    torch.testing.assert_close(weight.flatten(1).sum(1), torch.ones(2))
    assert torch.isfinite(
        method.training_losses(batch, torch.Generator().manual_seed(0))["likelihood"]
    ).all()


def test_labeled_rays_and_a_start_from_proposals_refuse_another_method() -> None:
    method = working()
    method.candidate_sampler, method.loss = LabeledRays(), Regression(PaperPoints())
    with pytest.raises(UserError, match=r"LabeledRays needs a likelihood that .*\(score_samples\)"):
        method.set_object(method.object_model)
    method = working()
    method.proposals = None
    with pytest.raises(UserError, match=r"FromProposals needs .*\(propose_poses\)"):
        method.set_object(method.object_model)


def test_the_logged_error_of_the_coordinates_is_of_images_that_show_the_object(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    method, batch, logged = working().train(), scenes(2), list[float]()
    monkeypatch.setattr(method, "log_scalar", lambda name, value: logged.append(float(value)))
    only = torch.tensor([True, False])
    # the network sees the same images, whatever their masks are
    for seen in (only, ~only, only | True, only & False):
        own = batch._replace(mask=batch.mask & seen[:, None, None, None])
        method.training_losses(own, torch.Generator().manual_seed(0))
    assert len(logged) == 3
    assert logged[2] == pytest.approx((logged[0] + logged[1]) / 2, rel=1e-4)


def test_candidates_hold_the_truth_whatever_the_camera() -> None:
    method = working()
    batch = scenes(2)
    trace = method.candidate_sampler(
        method, method.encode(batch), batch, torch.Generator().manual_seed(0)
    )
    relative = invert(batch.camera_from_object)[:, None] @ trace.particles[0].state
    assert (relative[:, 0] - torch.eye(4)).abs().max() < 1e-5
