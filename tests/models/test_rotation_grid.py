"""Rao-Blackwellized particles on a toy world, with a renderer that knows its square."""

from functools import partial

import numpy as np
import pytest
import torch
from tests.models.toy import SIDE, scenes, square
from torch import Tensor

from posefilter.errors import UserError
from posefilter.filters.estimate import Argmax
from posefilter.filters.initialize import FromDepth
from posefilter.filters.loop import ParticleFilter, make_particles
from posefilter.filters.propagate import Gaussian
from posefilter.filters.refine import MeanShift
from posefilter.filters.resample import Systematic
from posefilter.filters.reweight import CurrentLikelihood
from posefilter.filters.schedule import Geometric
from posefilter.geometry.crops import look_at
from posefilter.geometry.pose import pose_about, rotation_of
from posefilter.geometry.rotation import angle_between
from posefilter.losses.grid_posterior import GridPosterior
from posefilter.meshes.mesh import Mesh
from posefilter.metrics.errors import add
from posefilter.models.rotation_grid import RotationGrid
from posefilter.nets.crop_encoder import CropEncoder
from posefilter.types import Step

GRID = 1000


def painted_square() -> Mesh:
    """Return the square of the toy world as a mesh."""
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * SIDE / 2
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    paint = np.concatenate([corners[:, :2] / SIDE + 0.5, np.full((4, 1), 0.9)], 1)
    white, up = np.full((1, 1, 3), 255, np.uint8), np.tile([0.0, 0, 1], (2, 3, 1))
    return Mesh("square", corners, faces, None, white, paint[faces].astype(np.float32), up)


def make(render: bool = True) -> RotationGrid:
    torch.manual_seed(0)
    pieces = (
        FromDepth((0.0, 0.2)),
        Geometric(0.04, 0.01),
        CurrentLikelihood(),
        Systematic(),
        Gaussian(0.4),
    )
    refine = MeanShift(3, 16, 0.02, 0.01)
    method = RotationGrid(
        CropEncoder((16, 24, 32, 48), 32, 16),
        GRID,
        train_cells=64,
        filter=ParticleFilter(60, 4, *pieces, Argmax(), refine, initial_particles=200),
        loss=GridPosterior(0.2),
        optimizer=partial(torch.optim.AdamW, lr=3e-3),
    )
    method.set_object(square())
    if render:
        method.render(painted_square())
    return method


def train(method: RotationGrid, steps: int) -> RotationGrid:
    optimizer = torch.optim.AdamW(method.parameters(), 3e-3)
    # without a rate that falls, the last step's chance decides, which the number of threads changes
    scheduler = torch.optim.lr_scheduler.LinearLR(optimizer, 1.0, 0.0, steps)
    method.train()
    for step in range(steps):
        generator = torch.Generator().manual_seed(step)
        losses = method.training_losses(scenes(16, seed=step), generator)
        optimizer.zero_grad()
        losses["loss"].mean().backward()
        # as in trainings; without it the processor's rounding decides whether 60 steps are enough
        torch.nn.utils.clip_grad_norm_(method.parameters(), 1.0)
        optimizer.step()
        scheduler.step()
    method.eval()
    return method


@pytest.fixture(scope="module")
def trained() -> RotationGrid:
    return train(make(), 60)


@torch.no_grad()
def errors(method: RotationGrid) -> Tensor:
    batch = scenes(12, seed=10_000)
    trace = method.eval().filter(batch, method, torch.Generator().manual_seed(0))
    return add(trace.belief.best, batch.camera_from_object, method.object_model.points)


def test_a_short_training_finds_the_pose(trained: RotationGrid) -> None:
    assert errors(make()).median() > 0.08
    assert errors(trained).median() < 0.045


@torch.no_grad()
def test_rotations_are_drawn_from_the_marginal_and_weigh_the_particle(
    trained: RotationGrid,
) -> None:
    batch = scenes(1, seed=3)
    encoding = trained.encode(batch)
    # many particles at one place
    place = batch.camera_from_object[:, :3, 3][:, None].expand(1, 4000, 3)
    turned = look_at(place) @ trained.grid[:1]
    state = pose_about(turned, place, torch.zeros(3))
    step = Step(0, 1, torch.tensor(0.01))
    out = trained.measure(
        encoding, make_particles(state, 0), step, torch.Generator().manual_seed(0)
    )
    scores = (
        trained.net.scale * trained.encode_crops(encoding, place[:, :1])[0, 0] @ trained.codes.T
    )
    mean = scores.exp().mean().log()
    torch.testing.assert_close(out.log_likelihood, mean.expand(1, 4000), atol=1e-3, rtol=0)
    torch.testing.assert_close(out.pose[..., :3, 3], place)
    drawn = angle_between(rotation_of(out.pose[0])[:, None], (look_at(place[0, :1]) @ trained.grid))
    shares = torch.bincount(drawn.argmin(1), minlength=GRID) / 4000
    top = scores.topk(3).indices
    torch.testing.assert_close(shares[top], scores.softmax(0)[top], atol=0.04, rtol=0)


@torch.no_grad()
def test_the_score_of_a_cells_own_pose_is_mostly_its_cosine(trained: RotationGrid) -> None:
    batch = scenes(1, seed=4)
    encoding, place = trained.encode(batch), batch.camera_from_object[:, :3, 3][:, None]
    poses = pose_about(look_at(place) @ trained.grid[::50], place, torch.zeros(3))
    found = trained.score_poses(encoding, poses, 0.0, torch.Generator(), 0)
    exact = trained.net.scale * trained.encode_crops(encoding, place)[0] @ trained.codes[::50].T
    both = torch.stack([found[0], exact[0]])
    assert torch.corrcoef(both)[0, 1] > 0.95
    index, share = trained.find_cells(trained.grid[7])
    assert index[0] == 7
    assert share[0] > share[1:].max()


@torch.no_grad()
def test_neither_mask_nor_truth_is_used_and_a_seed_repeats(trained: RotationGrid) -> None:
    batch = scenes(3, seed=30_000)
    blind = batch._replace(
        mask=torch.zeros_like(batch.mask), camera_from_object=torch.eye(4).expand(3, 4, 4)
    )
    a, b, other = (
        trained.filter(x, trained, torch.Generator().manual_seed(seed)).belief
        for x, seed in ((batch, 0), (blind, 0), (batch, 1))
    )
    assert torch.equal(a.poses, b.poses)
    assert torch.equal(a.best, b.best)
    assert not torch.equal(a.poses, other.poses)


def test_a_checkpoint_holds_the_codes_of_its_weights_and_needs_no_mesh() -> None:
    method = train(make(), 2)
    old = method.codes.clone()
    method.train()
    with torch.no_grad():
        method.net.out.weight.mul_(-1)
    checkpoint = {"state_dict": {k: v.clone() for k, v in method.state_dict().items()}}
    method.on_save_checkpoint(checkpoint)
    assert method.training
    other = make(render=False)
    other.load_state_dict(checkpoint["state_dict"])
    other.eval()
    assert (other.codes - old).abs().max() > 0.1
    assert torch.equal(errors(other), errors(method))
    with pytest.raises(UserError, match="call render"):
        other.train().training_losses(scenes(2), torch.Generator())


def test_too_few_cells_are_refused() -> None:
    with pytest.raises(UserError, match=r"model\.cells=5: fewer than model\.near_cells=6"):
        RotationGrid(CropEncoder(), 5, filter=None, loss=None, optimizer=None)  # type: ignore[arg-type]
