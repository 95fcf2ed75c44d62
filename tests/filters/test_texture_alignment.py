"""The print draws the estimate to where the image shows it, and nothing else does."""

from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Generator, Tensor

from posefilter.errors import UserError
from posefilter.filters.icp import PointToPlaneIcp
from posefilter.filters.texture import measure_texture
from posefilter.filters.texture_alignment import TextureAlignment, find_sides, pixel_derivatives
from posefilter.geometry.camera import project
from posefilter.geometry.pose import make_pose, transform
from posefilter.geometry.rotation import random_rotation
from posefilter.geometry.spaces import PoseSpace
from posefilter.rendering.surfaces import Lights
from posefilter.types import BeliefBatch, ObjectModel
from printed_objects import K, Seen, load, look

EXACT = TextureAlignment(texture_error=1e-4, min_gain=0.0)  # of a texture that is where it should


def draw(name: str, count: int) -> list[Tensor]:
    """Return random poses in which the object fills a good part of the image."""
    g, model = Generator().manual_seed(2), load(name)
    shift = torch.tensor([0.0, 0, 5.5 * model.radius])
    rotations = random_rotation(count, generator=g)
    return [make_pose(R, shift - R @ model.center) for R in rotations]


def space_of(model: ObjectModel) -> PoseSpace:
    return PoseSpace(tuple(model.center.tolist()), model.radius)


def displace(pose: Tensor, model: ObjectModel, seed: int, scale: float = 0.004) -> Tensor:
    """Return a pose that is off by some millimeters and degrees."""
    space, g = space_of(model), Generator().manual_seed(seed)
    noise = space.noise_scale(torch.tensor(scale)) * torch.randn(6, generator=g)
    return space.move(pose[None], noise[None])[0]


def align(start: Tensor, seen: Seen, model: ObjectModel, refine: Any = None) -> Tensor:
    """Return what becomes of estimates (B, 4, 4)."""
    given = BeliefBatch(start[:, None], torch.zeros(len(start), 1), start, torch.ones(len(start)))
    method: Any = SimpleNamespace(object_model=model)
    out = (refine or TextureAlignment())(given, seen, method, Generator())
    assert torch.equal(out.score, given.score)
    assert torch.equal(out.poses, given.poses)
    return out.best


def off(found: Tensor, truth: Tensor, model: ObjectModel) -> Tensor:
    """Return mean distances of surface points [mm]."""
    gap = transform(found, model.points) - transform(truth, model.points)
    return 1000 * gap.norm(dim=-1).mean(-1)


@pytest.mark.parametrize("name", ["carton", "soup_can", "tuna_can"])
@pytest.mark.slow
def test_an_estimate_that_is_millimeters_off_is_drawn_to_the_truth(name: str) -> None:
    model, before, after, by_depth = load(name), [], [], []
    for seed, pose in enumerate(draw(name, 8)):
        start, seen = displace(pose, model, seed)[None], look(name, pose)
        before.append(off(start, pose[None], model))
        after.append(off(align(start, seen, model), pose[None], model))
        by_depth.append(off(align(start, seen, model, PointToPlaneIcp()), pose[None], model))
    moved, depth, found = (torch.cat(one).median() for one in (before, by_depth, after))
    assert moved > 3
    assert found < 0.4 * moved
    assert found < 0.85 * depth


def test_a_plain_object_and_one_that_is_not_there_stay() -> None:
    model, pose = load("carton"), draw("carton", 1)[0]
    assert model.texture is not None
    start, seen = displace(pose, model, 1)[None], look("carton", pose)
    plain = model._replace(
        texture=torch.cat([model.texture[:, :6], torch.full_like(model.texture[:, 6:], 0.5)], 1)
    )
    assert torch.equal(align(start, seen, plain), start)
    nothing = seen._replace(measured_depth=seen.measured_depth * 0)
    assert torch.equal(align(start, nothing, model), start)
    noise = torch.rand(seen.measured_color.shape, generator=Generator().manual_seed(0))
    assert torch.equal(align(start, seen._replace(measured_color=noise), model), start)


def test_exposure_white_balance_and_light_hardly_matter() -> None:
    model, pose = load("carton"), draw("carton", 2)[1]
    start, seen = displace(pose, model, 3)[None], look("carton", pose)
    tint = torch.tensor([0.9, 0.6, 0.5])[:, None, None]
    tinted = seen._replace(measured_color=seen.measured_color * tint)
    lit = look("carton", pose, Lights(0.3, ((-0.6, 0.2, -0.8),), (0.8,)))
    plain, *others = (align(start, one, model, EXACT) for one in (seen, tinted, lit))
    assert float(off(plain, pose[None], model)) < 1.5
    assert all(float(off(one, plain, model)) < 0.8 for one in others)


def test_colors_beside_the_depth_draw_it_along() -> None:
    model, pose = load("carton"), draw("carton", 1)[0]
    seen = look("carton", pose)
    moved = seen._replace(measured_color=seen.measured_color.roll(2, dims=-1))  # to the right
    shift = (align(pose[None], moved, model, EXACT)[0] - pose)[:3, 3]
    one_pixel = float(pose[2, 3] / K[0, 0])
    assert 1.2 * one_pixel < shift[0] < 2.3 * one_pixel
    assert abs(shift[1]) < 0.5 * one_pixel


def test_an_estimate_is_moved_where_the_evidence_rises_clearly() -> None:
    model, pose = load("carton"), draw("carton", 1)[0]
    start, seen = displace(pose, model, 1)[None], look("carton", pose)
    moved = align(start, seen, model, EXACT)
    before, after = measure_texture(torch.stack([start, moved], dim=1), seen, model, shift=0)[0]
    rise = float(after - before)
    assert rise > 5
    for least, found in ((rise - 0.1, moved), (rise + 0.1, start)):
        refine = TextureAlignment(texture_error=1e-4, min_gain=least)
        assert torch.equal(align(start, seen, model, refine), found)


def test_a_side_whose_texture_was_scanned_beside_its_place_turns_nothing() -> None:
    """The depth tells the turn; a rigid print would have to turn to be on both sides' prints."""
    model, seen_turns = load("carton"), {1e-4: 0.0, 0.003: 0.0}
    assert model.texture is not None
    side = find_sides(model.texture[:, 3:6]) == 0
    texture = model.texture.clone()
    tangent = torch.linalg.cross(texture[side][:1, 3:6], torch.tensor([[0.6, 0.0, 0.8]]))
    texture[side, :3] += 0.004 * torch.nn.functional.normalize(tangent, dim=-1)
    for pose in draw("carton", 8):
        seen = look("carton", pose)
        for error in seen_turns:
            refine = TextureAlignment(texture_error=error, min_gain=0.0)
            found = align(pose[None], seen, model._replace(texture=texture), refine)
            seen_turns[error] += float(off(found, pose[None], model))
    assert seen_turns[0.003] < 0.8 * seen_turns[1e-4]


def test_what_hides_a_part_has_no_say() -> None:
    model, pose = load("carton"), draw("carton", 1)[0]
    start, seen = displace(pose, model, 5)[None], look("carton", pose)
    color, depth = seen.measured_color.clone(), seen.measured_depth.clone()
    color[..., 60:, :] = torch.rand(color[..., 60:, :].shape, generator=Generator().manual_seed(1))
    depth[..., 60:, :] = 0.5 * float(pose[2, 3])  # a wall before the lower half
    found = align(start, Seen(color, depth, seen.intrinsics), model, EXACT)
    assert float(off(found, pose[None], model)) < 0.75 * float(off(start, pose[None], model))


def test_each_image_of_a_batch_counts_by_itself() -> None:
    model, poses = load("carton"), draw("carton", 3)
    starts = torch.stack([displace(pose, model, 7 + i) for i, pose in enumerate(poses)])
    images = [look("carton", pose) for pose in poses]
    images[1] = images[1]._replace(measured_depth=images[1].measured_depth * 0)  # shows nothing
    together = align(starts, Seen(*(torch.cat(part) for part in zip(*images, strict=True))), model)
    for i, image in enumerate(images):
        torch.testing.assert_close(together[i], align(starts[i : i + 1], image, model)[0])
    assert torch.equal(together[1], starts[1])


def test_pixels_move_by_their_derivatives() -> None:
    model, pose = load("carton"), draw("carton", 1)[0].double()
    space = space_of(model)
    points = model.points[:20].double()
    center = transform(pose, model.center.double()[None])[0]
    at = transform(pose, points)
    found = pixel_derivatives(at, at - center, pose, K.double())
    step = 1e-6
    for axis in range(6):
        twist = torch.zeros(1, 6, dtype=torch.float64)
        twist[0, axis] = step
        moved = project(transform(space.move(pose[None], twist)[0], points), K.double())
        numeric = (moved - project(at, K.double())) / step
        torch.testing.assert_close(found[..., axis], numeric, rtol=1e-3, atol=1e-2)


@pytest.mark.parametrize(
    ("settings", "told"),
    [
        ({"iterations": 0}, "iterations and initial_blur of 1 or more"),
        ({"initial_blur": 0.5}, "iterations and initial_blur of 1 or more"),
        ({"prior": 0.0}, "prior, independent and texture_error above 0"),
        ({"texture_error": 0.0}, "prior, independent and texture_error above 0"),
        ({"min_gain": -1.0}, "min_gain of 0 or more"),
        ({"min_correlation": 1.0}, "min_correlation=1.0: must lie between 0 and 1"),
        ({"gate": 0.0}, "ICP needs numbers above 0"),
    ],
)
def test_impossible_settings_are_refused(settings: dict[str, Any], told: str) -> None:
    with pytest.raises(UserError, match=told):
        TextureAlignment(**settings)


def test_a_checkpoint_without_a_texture_is_told() -> None:
    model, pose = load("carton"), draw("carton", 1)[0]
    with pytest.raises(UserError, match="carries no texture of 'carton'"):
        align(pose[None], look("carton", pose), model._replace(texture=None))
