"""The filter of parts: its unary potentials, what it leaves to `PosePF`, and whom it refuses."""

import math
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from omegaconf import OmegaConf
from tests.models.toy import SIDE, scenes, square
from torch import Tensor

from posefilter.cli.checkpoints import build_method, method_of, recipe
from posefilter.cli.command import compose_job
from posefilter.errors import UserError
from posefilter.filters.candidates import perturb
from posefilter.filters.estimate import Argmax
from posefilter.filters.initialize import FromProposals
from posefilter.filters.loop import ParticleFilter, make_particles
from posefilter.filters.messages import WithinParts, pass_messages
from posefilter.filters.propagate import Gaussian
from posefilter.filters.refine import NoRefine
from posefilter.filters.resample import Systematic
from posefilter.filters.reweight import CurrentLikelihood
from posefilter.filters.schedule import Geometric
from posefilter.losses.contrastive import Contrastive
from posefilter.models.candidate_samplers import CandidatePoses
from posefilter.models.parts_pf import PartsPF, find_joint, make_region
from posefilter.models.pose_pf import PosePF
from posefilter.nets.likelihood import PoseLikelihood, Region
from posefilter.nets.proposals import ObjectCoordinateNet
from posefilter.nets.surface_term import SurfaceTerm
from posefilter.types import ObjectModel, Step

CONF = Path(__file__).parents[2] / "conf"


def halves() -> ObjectModel:
    """Return the square, whose left and right half are parts."""
    whole = square()
    left = whole.points[:, 0] < 0
    return whole._replace(parts={"left": whole.points[left], "right": whole.points[~left]})


def make(kind: type[PosePF], resample: Any, **more: Any) -> PosePF:
    torch.manual_seed(0)
    pieces = (FromProposals(), Geometric(0.05, 0.01), CurrentLikelihood(), resample)
    pieces += (Gaussian(0.4), Argmax(), NoRefine())
    surface = SurfaceTerm(16, 8)
    torch.nn.init.normal_(surface.leave.weight)  # else it is zero
    method = kind(
        likelihood=PoseLikelihood(16, 2, 3, sigma=(0.01, 0.2), context=4, surface=surface),
        candidate_sampler=CandidatePoses(6, proposals=4, particles=6, sigma_range=(0.01, 0.2)),
        proposals=ObjectCoordinateNet((16, 24, 32, 32), fragments=16, features=4),
        filter=ParticleFilter(20, 3, *pieces, initial_particles=41),
        loss=Contrastive(),
        optimizer=partial(torch.optim.AdamW, lr=3e-3),
        **more,
    )
    method.set_object(halves())
    return method


def parts_pf(**more: Any) -> PosePF:
    return make(PartsPF, WithinParts(Systematic()), **more)


def around_truth(count: int, images: int = 2) -> tuple[Any, Tensor]:
    batch = scenes(images, seed=3)
    truth = batch.camera_from_object[:, None].expand(-1, count, -1, -1)
    space = parts_pf().space
    sigma = torch.full((images, count), 0.02)
    return batch, perturb(truth, sigma, space, torch.Generator().manual_seed(1))  # type: ignore[arg-type]


def test_a_region_as_large_as_the_object_is_scored_as_the_object() -> None:
    method = parts_pf().eval()
    batch, poses = around_truth(30)
    center, radius = method.object_model.center, method.object_model.radius
    surface = method.likelihood.surface.get_buffer("points")
    whole = Region(center, radius, surface)
    with torch.no_grad():
        encoding = method.encode(batch)
        own, plain = (
            method._score(
                encoding,
                poses,
                torch.tensor(0.02),
                torch.Generator().manual_seed(2),
                64,
                region=region,
            )
            for region in (whole, None)
        )
    assert torch.allclose(own, plain, atol=2e-3)
    assert float(plain.std()) > 0.01


def test_a_part_is_judged_by_the_image_about_it_alone() -> None:
    """What is seen at the right end of the square does not change the score of its left half."""
    method = parts_pf().eval()
    batch = scenes(1, seed=3)
    method.proposals = None
    method.likelihood.context = None  # the network's own view of the image is wide
    torch.manual_seed(0)
    method.likelihood.enter = torch.nn.Linear(3 * (2 * 3 + 1) + 7, 16)
    left, right = (make_region(points) for points in (halves().parts or {}).values())
    narrow = [part._replace(radius=0.01) for part in (left, right)]
    u = torch.arange(batch.rgb.shape[-1])
    pose = batch.camera_from_object[0]
    end = pose[:3, :3] @ right.center + pose[:3, 3]
    column = batch.intrinsics[0, 0, 0] * end[0] / end[2] + batch.intrinsics[0, 0, 2]
    far = (u > column - 3)[None, None, None].expand_as(batch.rgb)
    painted = batch._replace(rgb=torch.where(far, 1 - batch.rgb, batch.rgb))
    scores = []
    with torch.no_grad():
        for images in (batch, painted):
            encoding = method.encode(images)
            for part in narrow:
                g = torch.Generator().manual_seed(2)
                sigma = torch.tensor(0.02)
                own = batch.camera_from_object[:, None]
                scores.append(method._score(encoding, own, sigma, g, 32, region=part))
    assert torch.equal(scores[0], scores[2])
    assert not torch.allclose(scores[1], scores[3], atol=1e-3)


def test_likelihoods_are_the_parts_own_and_the_messages() -> None:
    method = parts_pf(translation_mm=6.0, rotation_deg=8.0).eval()
    assert isinstance(method, PartsPF)
    batch, poses = around_truth(21)
    step = Step(0, 1, torch.tensor(0.02))
    with torch.no_grad():
        encoding = method.encode(batch)
        found = method.measure(
            encoding, make_particles(poses, 0), step, torch.Generator().manual_seed(5)
        )
        g = torch.Generator().manual_seed(5)
        regions = [make_region(points) for points in (method.object_model.parts or {}).values()]
        blocks = [slice(0, 11), slice(11, 21)]
        unary = torch.cat(
            [
                method._score(encoding, poses[:, block], step.sigma, g, method.pixels, True, region)
                for block, region in zip(blocks, regions, strict=True)
            ],
            dim=1,
        )
    joint = find_joint(*(method.object_model.parts or {}).values())
    shift = math.hypot(0.006, 0.02)
    turn = math.hypot(math.radians(8.0), 0.02 / method.object_model.radius)
    scales = (torch.tensor(shift), torch.tensor(turn))
    expected = pass_messages(unary, poses, blocks, joint.expand(2, 2, 3), *scales)
    assert torch.allclose(found.log_likelihood, expected, atol=1e-3)
    assert torch.equal(found.pose, poses)


def test_a_part_lies_where_its_points_are_and_meets_the_other_between_them() -> None:
    left, right = (halves().parts or {}).values()
    region = make_region(left)
    assert torch.allclose(region.center, left.mean(0), atol=1e-6)
    assert bool(((left - region.center).norm(dim=1) <= region.radius + 1e-6).all())
    joint = find_joint(left, right)
    assert torch.allclose(joint, find_joint(right, left), atol=1e-6)
    assert float(left[:, 0].max()) < float(joint[0]) < float(right[:, 0].min())
    assert float(joint[1].abs()) <= SIDE / 2


def test_it_is_trained_and_it_scores_poses_as_pose_pf() -> None:
    own, plain = parts_pf(), make(PosePF, Systematic())
    batch, poses = around_truth(12, 4)
    batch = batch._replace(frame_id=torch.arange(4))
    assert own.state_dict().keys() == plain.state_dict().keys()
    own.load_state_dict(plain.state_dict())
    losses = [
        one.train().training_losses(batch, torch.Generator().manual_seed(1)) for one in (own, plain)
    ]
    for name, value in losses[1].items():
        assert torch.equal(losses[0][name], value), name
    with torch.no_grad():
        scores = [
            one.eval().score_poses(
                one.encode(batch), poses, 0.02, torch.Generator().manual_seed(1), 32
            )
            for one in (own, plain)
        ]
    assert torch.equal(*scores)


def test_the_filter_keeps_each_part_among_its_own() -> None:
    method = parts_pf().eval()
    batch = scenes(2, seed=4)
    with torch.no_grad():
        trace = method.filter(batch, method, torch.Generator().manual_seed(0))
    assert [p.state.shape[1] for p in trace.particles] == [41, 20, 20]
    first, *later = trace.particles
    counts = [first.state.shape[1], *(p.state.shape[1] for p in later)]
    for before, after, particles in zip(counts, counts[1:], later, strict=False):
        old, new = method.space.split(before), method.space.split(after)  # type: ignore[attr-defined]
        for source, block in zip(old, new, strict=True):
            inside = particles.ancestors[:, block]
            assert bool(((inside >= source.start) & (inside < source.stop)).all())
    mass = trace.particles[-1].log_weights.unflatten(1, (2, 10)).logsumexp(2)
    assert torch.allclose(mass, torch.full_like(mass, math.log(0.5)), atol=1e-3)


@pytest.mark.parametrize("parts", [None, {}, {"all": torch.rand(9, 3)}])
def test_an_object_without_two_parts_is_refused(parts: dict[str, Tensor] | None) -> None:
    with pytest.raises(UserError, match=r"model=parts_pf: square has .* parts\.json") as caught:
        parts_pf().set_object(square()._replace(parts=parts))
    assert "\n" not in str(caught.value)


def test_resampling_over_all_particles_is_refused() -> None:
    with pytest.raises(UserError, match="resampling within each part"):
        make(PartsPF, Systematic())
    with pytest.raises(UserError, match="particles are of the object's parts"):
        make(PosePF, WithinParts(Systematic()))


@pytest.mark.parametrize("name", ["translation_mm", "rotation_deg"])
def test_a_kernel_without_width_is_refused(name: str) -> None:
    with pytest.raises(UserError, match=rf"{name}=0"):
        parts_pf(**{name: 0.0})


def test_weights_of_pose_pf_are_tested_by_parts() -> None:
    """As by `evaluate.py checkpoint=... model._target_=...PartsPF filter/resample=within_parts`."""
    plain = build_method(recipe(compose_job("train", CONF, ["model=pose_pf"], Path("nowhere"))))
    plain.set_object(halves())
    checkpoint: dict[str, Any] = {"state_dict": plain.state_dict()}
    plain.on_save_checkpoint(checkpoint)
    scheme = OmegaConf.to_container(OmegaConf.load(CONF / "filter/resample/within_parts.yaml"))
    by_parts = {"_target_": "posefilter.models.parts_pf.PartsPF", "translation_mm": 9.0}
    wanted = {"model": by_parts, "filter": {"resample": scheme}}
    found = method_of(checkpoint, wanted, lightning=False)
    assert isinstance(found, PartsPF)
    assert (found.translation_mm, found.space.parts) == (9.0, 2)
    assert all(torch.equal(found.state_dict()[k], v) for k, v in plain.state_dict().items())
    with pytest.raises(UserError, match="filter/resample=within_parts"):
        method_of(checkpoint, {"model": by_parts}, lightning=False)
