"""Whose pixels: those on which an object is seen, and no two objects on one."""

import numpy as np
import pytest
import torch
from scipy.ndimage import distance_transform_edt
from torch import Generator, Tensor

from posefilter.confidence.visible_pixels import blank, find_visible, lie_in_hull
from posefilter.geometry.camera import intrinsics
from posefilter.geometry.pose import make_pose
from posefilter.geometry.rotation import exp_so3
from posefilter.instances.pixels import keep_pixels, resize_mask
from posefilter.meshes.mesh import Mesh
from posefilter.meshes.store import MeshStore, object_model
from posefilter.rendering.embree import render_depth
from posefilter.types import Batch

H, W = 96, 128
K = intrinsics(150.0, 150.0, 63.5, 47.5)


@pytest.fixture(scope="module")
def carton() -> Mesh:
    return MeshStore("builtin").load("carton")


def pose(x: float, z: float, turn: float = 0.6) -> Tensor:
    return make_pose(exp_so3(torch.tensor([0.5, turn, 0.1])), torch.tensor([x, 0.0, z])).double()


def see(carton: Mesh, poses: list[Tensor], wall: float = 1.5) -> tuple[Tensor, np.ndarray]:
    """Return the depth (H, W) of cartons before a wall, and which of them is seen."""
    depth, index = render_depth([carton] * len(poses), [p.numpy() for p in poses], K.numpy(), H, W)
    return torch.from_numpy(np.where(depth > 0, depth, np.float32(wall))), index


def test_an_object_is_seen_where_it_was_rendered_and_not_where_another_is_before_it(
    carton: Mesh,
) -> None:
    poses = [pose(-0.12, 0.9), pose(0.0, 0.6, 1.4), pose(0.25, 0.9)]
    depth, index = see(carton, poses)
    model = object_model(carton, count=200)
    seen = find_visible(torch.stack(poses).float(), model, depth, K).numpy()
    for k in range(3):
        true = index == k
        assert true.sum() > 50
        extra, missing = seen[k] & ~true, true & ~seen[k]
        # 4 mm and 2 % of the diameter are 2 px here
        assert missing.sum() <= 0.02 * true.sum()
        assert distance_transform_edt(~true)[extra].max(initial=0) <= 3
    hidden = find_visible(torch.stack(poses).float(), model, torch.full((H, W), 0.3), K)
    assert not bool(hidden.any())  # a wall before all of them


def test_pixels_without_depth_count_where_the_hull_covers_them(carton: Mesh) -> None:
    one = pose(0.0, 0.8)
    _, index = see(carton, [one])
    model = object_model(carton, count=200)
    (seen,) = find_visible(one[None].float(), model, torch.zeros(H, W), K).numpy()
    true = index == 0
    assert (seen ^ true).sum() <= 0.08 * true.sum()
    behind = pose(0.0, -0.8)[None].float()
    assert not bool(find_visible(behind, model, torch.zeros(H, W), K).any())


def test_points_of_an_object_lie_in_its_hull_and_far_ones_do_not(carton: Mesh) -> None:
    model = object_model(carton, count=300)
    inner = model.points - model.center
    assert bool(lie_in_hull(inner, model, 1e-4).all())
    assert bool(lie_in_hull(torch.zeros(1, 3), model).all())
    sides = torch.from_numpy(carton.bounds[1] - carton.bounds[0]).float()
    out = 0.62 * sides * torch.cat([torch.eye(3), -torch.eye(3)])
    assert not bool(lie_in_hull(out, model).any())


def test_no_two_keep_a_pixel_and_the_first_keeps_all_of_its_own() -> None:
    masks = list(torch.rand(6, H, W, generator=Generator().manual_seed(0)) < 0.3)
    kept = [own for own in keep_pixels(masks, 0.0) if own is not None]
    assert len(kept) == 6
    assert int(torch.stack(kept).sum(0).max()) == 1
    assert torch.equal(torch.stack(kept).any(0), torch.stack(masks).any(0))
    assert torch.equal(kept[0], masks[0])
    for own, mask in zip(kept, masks, strict=True):
        assert bool((own <= mask).all())


def test_who_has_too_few_of_its_own_keeps_none() -> None:
    whole = torch.zeros(4, 4, dtype=torch.bool)
    whole[:2] = True
    low = torch.zeros(4, 4, dtype=torch.bool)
    low[1:3] = True  # half of it is free
    empty = torch.zeros(4, 4, dtype=torch.bool)
    kept = keep_pixels([whole, low, whole, empty], 0.5)
    assert [own is None for own in kept] == [False, False, True, True]
    assert keep_pixels([whole, low], 0.51)[1] is None
    # what was dropped takes nothing from those after it
    last = keep_pixels([whole, whole, low], 0.5)[2]
    assert last is not None
    assert int(last.sum()) == 4


def test_what_is_blanked_does_not_matter_any_more() -> None:
    g = Generator().manual_seed(1)
    none = torch.zeros(2, dtype=torch.int64)
    hidden = torch.zeros(2, H, W, dtype=torch.bool)
    hidden[0, 20:40, 30:60] = True
    rgb, depth = torch.rand(2, 3, H, W, generator=g), torch.rand(2, 1, H, W, generator=g) + 0.5
    eye = torch.eye(4).expand(2, 4, 4)
    batch = Batch(rgb, depth, depth > 9, K.expand(2, 3, 3), eye, none, none, torch.ones(2))
    other = batch._replace(
        rgb=torch.where(hidden[:, None], torch.rand(2, 3, H, W, generator=g), rgb),
        depth=torch.where(hidden[:, None], 0.2, depth),
    )
    first, second = blank(batch, hidden), blank(other, hidden)
    torch.testing.assert_close(first.rgb, second.rgb)
    torch.testing.assert_close(first.depth, second.depth)
    assert float(first.depth[0, 0, 20:40, 30:60].max()) == 0
    assert torch.equal(first.rgb[1], rgb[1])
    assert torch.equal(first.depth[0, 0, :16], depth[0, 0, :16])


def test_masks_keep_their_place_at_another_size() -> None:
    mask = torch.zeros(12, 16, dtype=torch.bool)
    mask[3:6, 4:9] = True
    large = resize_mask(mask, (24, 32))
    assert torch.equal(large, mask.repeat_interleave(2, 0).repeat_interleave(2, 1))
    assert torch.equal(resize_mask(large, (12, 16)), mask)


def test_a_smaller_mask_stays_in_its_place() -> None:
    middle = torch.zeros(9, 9, dtype=torch.bool)
    middle[4, 4] = True
    assert resize_mask(middle, (3, 3)).nonzero().tolist() == [[1, 1]]
