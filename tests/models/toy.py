"""A toy world for the image-space methods: a tilted square with a color for every place, before a
gray wall.
"""

import math

import torch

from posefilter.geometry.camera import intrinsics, pixel_grid, rays
from posefilter.geometry.pose import invert, make_pose, transform
from posefilter.geometry.rotation import exp_so3
from posefilter.types import Batch, ObjectModel

H, W, SIDE = 48, 64, 0.2


def square() -> ObjectModel:
    """Return the square's model: 20 cm, in the plane z = 0."""
    line = torch.linspace(-SIDE / 2, SIDE / 2, 7)
    points = torch.stack(torch.meshgrid(line, line, torch.zeros(1), indexing="ij"), -1).reshape(
        -1, 3
    )
    hull = torch.tensor([[x, y, 0.0] for x in (-0.1, 0.1) for y in (-0.1, 0.1)])
    return ObjectModel(
        "square",
        points,
        torch.zeros(3),
        SIDE / math.sqrt(2),
        SIDE * math.sqrt(2),
        torch.eye(4)[None],
        hull,
    )


def scenes(count: int, seed: int = 0) -> Batch:
    """Draw images of the square, 0.8 m away and wholly in view, turned by up to 1 rad in the plane
    and 0.3 out of it.
    """
    g = torch.Generator().manual_seed(seed)
    K = intrinsics(60.0, 60.0, (W - 1) / 2, (H - 1) / 2).expand(count, 3, 3)
    turn = (torch.rand(count, 3, generator=g) * 2 - 1) * torch.tensor([0.3, 0.3, 1.0])
    place = (torch.rand(count, 3, generator=g) * 2 - 1) * torch.tensor(
        [0.22, 0.12, 0.05]
    ) + torch.tensor([0, 0, 0.8])
    pose = make_pose(exp_so3(turn), place)
    view = rays(pixel_grid(H, W).reshape(1, -1, 2).expand(count, -1, -1), K)
    normal = pose[:, None, :3, 2]
    z = (normal * pose[:, None, :3, 3]).sum(-1) / (normal * view).sum(-1)
    hit = transform(invert(pose), view * z[..., None])
    on = (hit[..., :2].abs() <= SIDE / 2).all(-1)
    paint = torch.cat([hit[..., :2] / SIDE + 0.5, torch.full_like(z, 0.9)[..., None]], -1)
    noise = 0.4 + 0.2 * torch.rand(count, H * W, 1, generator=g).expand(-1, -1, 3)
    rgb = torch.where(on[..., None], paint, noise).transpose(1, 2).unflatten(2, (H, W))
    depth = torch.where(on, z, 1.5).unflatten(1, (1, H, W))
    zeros = torch.zeros(count, dtype=torch.int64)
    return Batch(rgb, depth, on.unflatten(1, (1, H, W)), K, pose, zeros, zeros, torch.ones(count))
