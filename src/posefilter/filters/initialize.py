"""Initial distributions: states of the first particles."""

from typing import ClassVar

import torch
from torch import Generator, Tensor, nn

from posefilter.capabilities import Capabilities
from posefilter.errors import check_range
from posefilter.geometry.camera import rays
from posefilter.geometry.pose import pose_about
from posefilter.geometry.rotation import random_rotation
from posefilter.geometry.spaces import PoseSpace
from posefilter.protocols import Encoding, Initialize, Method, ProposesPoses
from posefilter.types import Batch


def draw_cells(weight: Tensor, count: int, generator: Generator) -> Tensor:
    """Draw cells of a map with probability proportional to weight, with replacement.

    (B, h, w) >= 0 -> (B, count, 2) int64 as (column, row).
    """
    index = torch.multinomial(weight.flatten(1), count, replacement=True, generator=generator)
    return torch.stack([index % weight.shape[2], index // weight.shape[2]], dim=-1)


def draw_from_depth(
    depth: Tensor,
    K: Tensor,
    space: PoseSpace,
    count: int,
    generator: Generator,
    prior: Tensor | None = None,
    depth_offset: tuple[float, float] = (0.1, 0.9),
) -> Tensor:
    """Draw poses at measured points: uniform rotations, centers on the ray behind the surface.

    An image without a measured point, or with none where the prior is positive, counts as 1 m deep
    everywhere.

    Args:
        depth: (B, 1, H, W) z-depth [m], 0 where unknown.
        K: (B, 3, 3) camera matrices [px].
        space: Gives the object's center and radius.
        count: Poses of an image.
        generator: Source of randomness.
        prior: (B, 1, H, W) >= 0, weight of each pixel; uniform if None.
        depth_offset: Range of the center's distance behind the surface, in radii; drawn uniformly.

    Returns:
        Poses (B, count, 4, 4), camera_from_object [m].
    """
    weight = (depth[:, 0] > 0).to(depth.dtype)
    if prior is not None:
        weight = weight * prior[:, 0]
    empty = ~(weight > 0).flatten(1).any(1)[:, None, None]
    z = torch.where(empty, 1.0, depth[:, 0])
    cell = draw_cells(torch.where(empty, 1.0, weight), count, generator)
    depth_at = z.flatten(1).gather(1, cell[..., 1] * depth.shape[3] + cell[..., 0])[..., None]
    ray = rays(cell.to(depth.dtype), K)
    push = torch.empty_like(depth_at).uniform_(*depth_offset, generator=generator) * space.radius
    center = ray * depth_at + ray / ray.norm(dim=-1, keepdim=True) * push
    R = random_rotation(*center.shape[:2], generator=generator, device=depth.device)
    return pose_about(R, center, depth.new_tensor(space.center))


class UniformPixels:
    """Pixels drawn uniformly over the image."""

    requires: ClassVar[Capabilities] = ("pixel_space",)

    def __call__(
        self, batch: Batch, encoding: Encoding, method: Method, particles: int, generator: Generator
    ) -> Tensor:
        """Return (B, N, 2) [px], over the whole area of the image's pixels."""
        B, _, H, W = batch.rgb.shape
        share = torch.rand(B, particles, 2, generator=generator, device=batch.rgb.device)
        return share * share.new_tensor([W, H]) - 0.5


class FromDepth:
    """Poses at measured points of the image, with uniform rotations.

    Args:
        depth_offset: Range of the center's distance behind the surface, in radii; drawn uniformly.
    """

    requires: ClassVar[Capabilities] = ("pose_space",)

    def __init__(self, depth_offset: tuple[float, float] = (0.1, 0.9)) -> None:
        self.depth_offset = check_range("filter.initialize.depth_offset", depth_offset)

    def __call__(
        self, batch: Batch, encoding: Encoding, method: Method, particles: int, generator: Generator
    ) -> Tensor:
        """Return (B, N, 4, 4) [m]."""
        space = method.space
        assert isinstance(space, PoseSpace)  # of what `requires` says
        return draw_from_depth(
            batch.depth,
            batch.intrinsics,
            space,
            particles,
            generator,
            depth_offset=self.depth_offset,
        )


class FromObjectness:
    """Pixels drawn from the encoding's objectness map (the paper, section 6, idea 4).

    Args:
        uniform_fraction: Weight of the uniform distribution that is mixed in, so that every
            pixel can be drawn.
    """

    requires: ClassVar[Capabilities] = ("pixel_space", "objectness")

    def __init__(self, uniform_fraction: float = 0.1) -> None:
        self.uniform_fraction = uniform_fraction

    def __call__(
        self, batch: Batch, encoding: Encoding, method: Method, particles: int, generator: Generator
    ) -> Tensor:
        """Return (B, N, 2) [px], uniform within each drawn cell."""
        weight = encoding.objectness[:, 0].detach()
        weight = weight / weight.sum((1, 2), keepdim=True).clamp_min(1e-12)
        even = max(self.uniform_fraction, 1e-6) / weight[0].numel()
        weight = (1 - self.uniform_fraction) * weight + even
        cell = draw_cells(weight, particles, generator)
        H, W = batch.rgb.shape[-2:]
        size = weight.new_tensor([W / weight.shape[2], H / weight.shape[1]])
        within = torch.rand(cell.shape, generator=generator, device=weight.device)
        return (cell + within) * size - 0.5


class FromProposals:
    """Poses that the method itself proposes."""

    requires: ClassVar[Capabilities] = ("pose_space", "propose_poses")

    def __call__(
        self, batch: Batch, encoding: Encoding, method: Method, particles: int, generator: Generator
    ) -> Tensor:
        """Return (B, N, 4, 4) [m]."""
        assert isinstance(method, ProposesPoses)  # of what `requires` says
        return method.propose_poses(encoding, particles, generator)


class Informed(nn.Module):
    """In training, draw a fraction of the pixels around the object (the paper, section 4.3).

    The mask is ground truth, so it is used in training mode only. In evaluation mode all particles
    come from `initializer`.

    Args:
        initializer: Draws all other particles.
        object_fraction: Fraction of the particles that are drawn around the object.
        sigma_px: Standard deviation of their distance from the mask's pixels [px].
    """

    requires: ClassVar[Capabilities] = ("pixel_space",)

    def __init__(
        self, initializer: Initialize, object_fraction: float = 0.5, sigma_px: float = 10.0
    ) -> None:
        super().__init__()
        self.initializer = initializer
        self.object_fraction, self.sigma_px = object_fraction, sigma_px

    def forward(
        self, batch: Batch, encoding: Encoding, method: Method, particles: int, generator: Generator
    ) -> Tensor:
        """Return (B, N, 2) [px]."""
        state = self.initializer(batch, encoding, method, particles, generator)
        count = round(self.object_fraction * particles)
        if not self.training or count == 0:
            return state
        mask = batch.mask[:, 0].to(state.dtype)
        visible = (mask > 0).flatten(1).any(1)[:, None, None]
        near = draw_cells(torch.where(visible, mask, 1.0), count, generator).to(state.dtype)
        noise = torch.randn(near.shape, generator=generator, device=state.device)
        near = near + self.sigma_px * noise
        return torch.cat([torch.where(visible, near, state[:, :count]), state[:, count:]], dim=1)
