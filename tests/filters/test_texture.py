"""The print decides the turns that a shape leaves open, and says nothing where there is none."""

import gc
import weakref
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from torch import Generator, Tensor

from posefilter.errors import UserError
from posefilter.filters.texture import (
    TextureRotations,
    blur,
    coarsen_texture,
    list_rotations,
    measure_texture,
)
from posefilter.geometry.camera import project
from posefilter.geometry.lookup import gather_pixels, nearest_pixel, sample
from posefilter.geometry.pose import make_pose, transform
from posefilter.geometry.rotation import angle_between, exp_so3, random_rotation
from posefilter.geometry.spaces import PoseSpace
from posefilter.meshes.store import MeshStore
from posefilter.meshes.texture import sample_texture
from posefilter.rendering.surfaces import Lights
from posefilter.types import BeliefBatch, ObjectModel
from printed_objects import Seen, W, load, look


def draw(name: str, count: int) -> list[Tensor]:
    """Return random poses in which the object fills a good part of the image."""
    g, model = Generator().manual_seed(5), load(name)
    rotations = random_rotation(count, generator=g)
    shift = torch.tensor([0.0, 0, 4.5 * model.radius])
    return [make_pose(R, shift - R @ model.center) for R in rotations]


def believe(pose: Tensor, count: int = 40) -> BeliefBatch:
    poses = pose.expand(1, count, 4, 4).clone()
    return BeliefBatch(poses, torch.full((1, count), -np.log(count)), pose[None], torch.zeros(1))


def method(object_model: ObjectModel) -> SimpleNamespace:
    return SimpleNamespace(object_model=object_model)


def turn(
    belief: BeliefBatch, encoding: Seen, object_model: ObjectModel, **settings: float
) -> BeliefBatch:
    out = TextureRotations(**settings)(
        belief, encoding, method(object_model), Generator().manual_seed(0)
    )  # type: ignore[arg-type]
    assert torch.equal(out.score, belief.score)
    return out


@pytest.mark.parametrize("name", ["soup_can", "carton", "tuna_can"])
@pytest.mark.slow
def test_a_print_turns_the_shape_back(name: str) -> None:
    model = load(name)
    turns, _ = list_rotations(model)
    assert len(turns) > 1
    right = 0
    poses = draw(name, 6)
    for number, pose in enumerate(poses):
        wrong = pose @ turns[(number + 1) * len(turns) // 7]
        best = turn(believe(wrong), look(name, pose), model).best[0]
        right += bool(angle_between(best[:3, :3], pose[:3, :3]) < np.deg2rad(6))
    assert right >= 5  # an end of a can may show no print


def test_the_right_turn_stays() -> None:
    model, (pose, *_) = load("carton"), draw("carton", 1)
    given = believe(pose)
    out = turn(given, look("carton", pose), model)
    assert torch.allclose(out.best[0], pose, atol=1e-5)
    assert torch.allclose(out.poses, given.poses, atol=1e-5)


def test_a_coarser_print_has_the_mean_colors_around_its_points_and_none_through_a_wall() -> None:
    g, model = Generator().manual_seed(0), load("carton")
    place = torch.rand(4000, 3, generator=g) * torch.tensor([0.2, 0.2, 0.001])  # a thin plate
    place = place[place[:, 0].argsort()]  # from one end to the other, as points of a mesh may be
    front = torch.rand(4000, generator=g) < 0.5
    normal = torch.where(front, 1.0, -1.0)[:, None] * torch.tensor([0.0, 0.0, 1.0])
    noise = torch.rand(4000, generator=g)
    color = torch.stack([front.float(), 1 - front.float(), noise], dim=1)
    plate = model._replace(texture=torch.cat([place, normal, color], dim=1), diameter=0.28)
    assert coarsen_texture(plate, 4000) is plate
    coarse = coarsen_texture(plate, 400).texture
    assert coarse is not None
    assert torch.equal(coarse[:, :6], torch.cat([place, normal], dim=1)[::10])
    torch.testing.assert_close(coarse[:, 6], front[::10].float())  # red in front, and green behind
    torch.testing.assert_close(coarse[:, 7], 1 - front[::10].float())
    assert coarse[:, 0].quantile(0.5) == pytest.approx(0.1, abs=0.01)
    assert coarse[:, 8].std() < 0.5 * noise.std()  # of some ten
    assert coarse[:, 8].mean() == pytest.approx(float(noise.mean()), abs=0.03)


def test_a_coarser_texture_has_a_color_at_each_point_wherever_the_mesh_is() -> None:
    """Points that are the same up to rounding have a color of their own."""
    g = Generator().manual_seed(0)
    normal = torch.nn.functional.normalize(torch.randn(3000, 3, generator=g), dim=1)
    place = 0.05 * normal + torch.tensor([3.0, 0.0, 0.0])
    texture = torch.cat([place, normal, torch.rand(3000, 3, generator=g)], dim=1)
    model = load("carton")
    for points in (texture, texture.repeat(2, 1)):
        coarse = coarsen_texture(model._replace(texture=points), 800).texture
        assert coarse is not None
        assert coarse.isfinite().all()


def test_a_coarser_texture_is_made_once_and_not_kept_for_ever() -> None:
    model = load("carton")
    assert model.texture is not None
    own = model._replace(texture=model.texture.repeat(2, 1))
    first, other = (coarsen_texture(own, most).texture for most in (100, 50))
    assert first is not None
    assert other is not None
    assert coarsen_texture(own._replace(name="other"), 100).texture is first
    assert len(other) == 50
    kept = weakref.ref(first)
    del first, own
    gc.collect()
    assert kept() is None


def test_a_plain_object_says_nothing() -> None:
    model, pose = load("bowl"), draw("bowl", 1)[0]
    texture = model.texture
    assert texture is not None
    plain = model._replace(texture=torch.cat([texture[:, :6], texture[:, 6:] * 0 + 0.5], dim=1))
    evidence = measure_texture(pose[None, None], look("bowl", pose), plain)
    assert evidence.abs().max() < 1e-3


def test_exposure_white_balance_and_light_hardly_matter() -> None:
    model, pose = load("carton"), draw("carton", 2)[1]
    encoding = look("carton", pose)
    first = float(measure_texture(pose[None, None], encoding, model))
    tinted = encoding.measured_color * torch.tensor([0.9, 0.6, 0.5])[:, None, None]
    second = float(
        measure_texture(pose[None, None], encoding._replace(measured_color=tinted), model)
    )
    other = Lights(0.3, ((-0.6, 0.2, -0.8),), (0.8,))
    third = float(measure_texture(pose[None, None], look("carton", pose, other), model))
    assert first > 20
    assert second == pytest.approx(first, rel=0.25)
    assert third == pytest.approx(first, rel=0.35)


def measure_plainly(
    pose: Tensor, encoding: Seen, object_model: ObjectModel, shift: float
) -> Tensor:
    """Return the evidence of one pose: all of the image blurred, a regression a shift."""
    color, K = encoding.measured_color[0].double(), encoding.intrinsics[0].double()
    assert object_model.texture is not None
    points, normals, own = object_model.texture.double().split(3, dim=1)
    pose = pose.double()
    at, normals = transform(pose, points), normals @ pose[:3, :3].T
    cosine = -(normals * torch.nn.functional.normalize(at, dim=-1)).sum(-1)
    pixels = project(at, K)
    z = gather_pixels(encoding.measured_depth[None].double(), nearest_pixel(pixels)[None])[0, :, 0]
    seen = (z > 0) & ((z - at[:, 2]).abs() < 0.004 + 0.03 * object_model.diameter) & (cosine > 0.25)
    root = (seen * cosine).sqrt()[:, None]
    basis = root * torch.cat([torch.ones_like(root), normals], dim=1)

    def leave(values: Tensor) -> Tensor:
        ridge = 1e-6 * basis[:, 0].square().sum() + 1e-9
        gram = basis.T @ basis + ridge * torch.eye(4, dtype=torch.float64)
        return root * values - basis @ torch.linalg.inv(gram) @ basis.T @ (root * values)

    focal, spacing = float(K[0, 0]), object_model.radius * (4 * np.pi / 3 / len(points)) ** 0.5
    middle = float((pose[:3, :3] @ object_model.center.double() + pose[:3, 3])[2])
    image = (blur(color, max(0.5, 0.33 * spacing * focal / middle)) + 0.03).log()
    x, best = leave((own + 0.03).log()), 0.0
    for u in (-1, 0, 1):
        for v in (-1, 0, 1):
            moved = pixels + shift * focal * torch.tensor([u, v])
            y = leave(sample(image[None], moved[None])[0])
            r = float((x * y).sum() / (x.square().sum() * y.square().sum()).sqrt())
            best = max(best, r)
    covered = (root[:, 0].square() * (spacing * focal / at[:, 2]).square()).sum()
    count = 0.4 * min(float(seen.sum()), float(covered) / 2)
    return torch.tensor(-0.5 * count * np.log1p(-(min(best, 0.99) ** 2)))


@pytest.mark.parametrize("shift", [0.0, 0.002])
@pytest.mark.parametrize("beside", [0.0, 0.07, -0.09])  # [m] where the frame cuts the object off
@pytest.mark.slow
def test_the_part_of_the_image_that_matters_gives_what_the_whole_does(
    shift: float, beside: float
) -> None:
    model = load("carton")
    for pose in draw("carton", 3):
        pose = pose.clone()
        pose[0, 3] += beside * float(pose[2, 3]) / 0.5
        encoding, off = look("carton", pose), pose.clone()
        off[:3, 3] += torch.tensor([0.002, -0.001, 0.001])
        for one in (pose, off):
            found = float(measure_texture(one[None, None], encoding, model, shift=shift))
            plain = float(measure_plainly(one, encoding, model, shift))
            assert found == pytest.approx(plain, rel=1e-3, abs=0.01)


def test_what_is_hidden_is_not_compared() -> None:
    model, pose = load("carton"), draw("carton", 1)[0]
    encoding = look("carton", pose)
    nothing = encoding._replace(measured_depth=torch.full_like(encoding.measured_depth, 0.1))
    assert float(measure_texture(pose[None, None], nothing, model)) == 0
    left = encoding.measured_depth.clone()
    left[..., W // 2 :] = 0
    half = float(measure_texture(pose[None, None], encoding._replace(measured_depth=left), model))
    assert 0 < half < float(measure_texture(pose[None, None], encoding, model))


def test_particles_take_shares_of_the_turns_and_others_stay() -> None:
    """Without any print each turn is as likely; a particle that is elsewhere is left alone."""
    model, pose = load("carton"), draw("carton", 1)[0]
    assert model.texture is not None
    gray = torch.cat([model.texture[:, :6], torch.full_like(model.texture[:, 6:], 0.5)], dim=1)
    model = model._replace(texture=gray)
    turns, _ = list_rotations(model)
    given = believe(pose, 40)
    given.poses[0, 0, :3, 3] += 1.0
    out = turn(given, look("carton", pose), model)
    assert torch.equal(out.poses[0, 0], given.poses[0, 0])
    x, y, z = model.center.tolist()
    space = PoseSpace((x, y, z), model.radius)
    apart = space.distance(out.poses[0, 1:, None], (pose @ turns)[None])
    assert apart.amin(1).max() < 1e-3
    counts = apart.argmin(1).bincount(minlength=len(turns))
    assert counts.min() >= 39 // len(turns) - 1


def test_evidence_falls_with_the_angle() -> None:
    model, pose = load("soup_can"), draw("soup_can", 4)[2]
    turns, coarse = list_rotations(model)
    at = pose @ turns[coarse]
    evidence = measure_texture(at[None], look("soup_can", pose), model)[0]
    off = angle_between(at[:, :3, :3], pose[:3, :3])
    assert evidence.argmax() == off.argmin()


def test_turns_that_are_tried_first_lie_ten_degrees_apart() -> None:
    turns, coarse = list_rotations(load("soup_can"))
    assert coarse[0] == 0
    assert torch.allclose(turns[0], torch.eye(4))
    R = turns[coarse][:, :3, :3]
    angles = angle_between(R[:, None], R[None]) + 4 * torch.eye(len(R))
    assert torch.rad2deg(angles.min()) > 9.8
    assert 36 <= len(coarse) <= 80 < len(turns)


def test_an_object_whose_shape_leaves_nothing_open_stays() -> None:
    model, pose = load("mug"), draw("mug", 1)[0]
    assert len(list_rotations(model)[0]) == 1
    given = believe(pose)
    assert turn(given, look("mug", pose), model) is given


def test_without_a_texture_it_is_refused_in_one_line() -> None:
    model, pose = load("carton"), draw("carton", 1)[0]
    with pytest.raises(UserError, match="carries no texture of 'carton'"):
        turn(believe(pose), look("carton", pose), model._replace(texture=None))


@pytest.mark.parametrize("settings", [{"learned_weight": -1}, {"pixels": 0}, {"sigma": 0}])
def test_numbers_out_of_range(settings: dict[str, float]) -> None:
    with pytest.raises(UserError, match="turns by texture need"):
        TextureRotations(**settings)  # type: ignore[arg-type]


def test_texture_is_that_of_the_mesh() -> None:
    mesh = MeshStore("builtin").load("carton")
    points, normals, color = np.split(sample_texture(mesh, 500), 3, axis=1)
    low, high = mesh.bounds
    assert (points > low - 1e-6).all()
    assert (points < high + 1e-6).all()
    assert np.abs(np.linalg.norm(normals, axis=1) - 1).max() < 1e-5
    outward = (normals * (points - (low + high) / 2)).sum(1)
    assert (outward > 0).all()
    assert color.std() > 0.05
    assert color.min() >= 0
    assert color.max() <= 1


def test_a_blur_keeps_what_is_flat_and_the_mean() -> None:
    flat = torch.full((3, 20, 30), 0.4)
    assert torch.allclose(blur(flat, 2.0), flat)
    dot = torch.zeros(1, 41, 41)
    dot[0, 20, 20] = 1
    soft = blur(dot, 2.0)
    assert float(soft.sum()) == pytest.approx(1, abs=1e-5)
    assert float(soft.max()) == pytest.approx(1 / (2 * np.pi * 4), rel=0.05)


def test_small_images_are_blurred_too() -> None:
    assert blur(torch.rand(3, 2, 3), 5.0).shape == (3, 2, 3)


def test_a_turn_between_those_that_are_tried_first_is_found() -> None:
    """A turn by 7 degrees about a can's axis is found although no first turn is there."""
    model, pose = load("soup_can"), draw("soup_can", 3)[1]
    turns, _ = list_rotations(model)
    axis = turns[1, :3, :3]
    generator = torch.stack(
        [axis[2, 1] - axis[1, 2], axis[0, 2] - axis[2, 0], axis[1, 0] - axis[0, 1]]
    )
    about = generator / generator.norm() * np.deg2rad(-7)
    off = torch.eye(4)
    off[:3, :3] = exp_so3(about[None])[0]
    off[:3, 3] = model.center - off[:3, :3] @ model.center
    best = turn(believe(pose @ off), look("soup_can", pose), model).best[0]
    assert torch.rad2deg(angle_between(best[:3, :3], pose[:3, :3])) < 3


@pytest.mark.parametrize("degrees", [-5.0, -2.5, 5.0])
@pytest.mark.slow
def test_turns_are_compared_where_their_print_fits_best(
    degrees: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before the last step, the chosen turn is within a step of the truth, not within half of ten
    degrees.
    """
    model, pose = load("soup_can"), draw("soup_can", 3)[1]
    turns, first = list_rotations(model)
    angles = torch.rad2deg(angle_between(turns[:, :3, :3], torch.eye(3).expand(len(turns), 3, 3)))
    beside = int((angles - abs(degrees)).abs().argmin())
    assert beside not in first.tolist()
    monkeypatch.setattr(
        TextureRotations, "_rotate_finely", lambda self, best, chosen, *_: best @ chosen
    )
    out = turn(believe(pose @ turns[beside], 50), look("soup_can", pose), model)
    assert torch.rad2deg(angle_between(out.best[0, :3, :3], pose[:3, :3])) < 2.6
    # and particles are where the turns were compared, not at those of the first ten degrees
    off = torch.rad2deg(angle_between(out.poses[0, :, :3, :3], pose[None, :3, :3]))
    assert off.median() < 2.6
