"""What a network's plain outputs mean: a displacement over the image, and a pose."""

from typing import Protocol

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from posefilter.geometry.pose import make_pose
from posefilter.geometry.rotation import matrix_from_6d, matrix_from_quat_xyzw


class Motion(Protocol):
    """Turns two plain outputs into a displacement."""

    def __call__(self, raw: Tensor, logit: Tensor, state: Tensor, width: int, height: int) -> Tensor:
        """(B, N, 2), likelihood's logit (B, N), (B, N, 2) [px] in a frame of width x height -> (B, N, 2) [px]."""
        ...


class PoseCode(Protocol):
    """Turns plain outputs into a pose."""

    width: int  # outputs that make a pose

    def about(self, center: Tensor, radius: float) -> None:
        """Learn the object's bounding sphere: (3,) [m] in its own frame, [m]."""
        ...

    def __call__(self, raw: Tensor, point: Tensor) -> Tensor:
        """(B, N, width), the particles' own camera points (B, N, 3) [m] -> (B, N, 4, 4) camera_from_object."""
        ...


class Unbounded(nn.Module):
    """The outputs are the displacement, in half frame widths; a particle may leave the frame, and go on."""

    def forward(self, raw: Tensor, logit: Tensor, state: Tensor, width: int, height: int) -> Tensor:
        """(B, N, 2) -> (B, N, 2) [px]."""
        return raw * (width / 2)


class Bounded(nn.Module):
    """At most `reach` frame widths along each axis (tanh), and never out of the frame."""

    def __init__(self, reach: float = 0.25) -> None:
        super().__init__()
        self.reach = reach

    def forward(self, raw: Tensor, logit: Tensor, state: Tensor, width: int, height: int) -> Tensor:
        """(B, N, 2), (B, N), (B, N, 2) [px] -> (B, N, 2) [px]."""
        corner = state.new_tensor([width - 1.0, height - 1.0])
        goal = state + torch.tanh(raw) * self.reach * width
        return torch.minimum(goal.clamp_min(0.0), corner) - state


class Held(nn.Module):
    """Another motion, less the surer the particle is of being on the object: who is there stays there.

    A displacement that is wrong in one place in twenty throws a cloud off again, all copies of a particle at once. The
    likelihood learns nothing through this: it has a lesson of its own.
    """

    def __init__(self, motion: Motion) -> None:
        super().__init__()
        self.motion = motion

    def forward(self, raw: Tensor, logit: Tensor, state: Tensor, width: int, height: int) -> Tensor:
        """(B, N, 2), (B, N), (B, N, 2) [px] -> (B, N, 2) [px]."""
        return self.motion(raw, logit, state, width, height) * torch.sigmoid(-logit.detach())[..., None]


class _AnyObject(nn.Module):
    """A code that does not depend on the object."""

    def about(self, center: Tensor, radius: float) -> None:
        """Need nothing of the object."""


class AbsoluteQuaternion(_AnyObject):
    """Seven outputs: a quaternion (x, y, z, w), made unit, and the translation in the camera [m]."""

    width = 7

    def forward(self, raw: Tensor, point: Tensor) -> Tensor:
        """(B, N, 7), (B, N, 3) -> (B, N, 4, 4)."""
        return make_pose(matrix_from_quat_xyzw(raw[..., :4]), raw[..., 4:])


class OwnPointSixD(nn.Module):
    """Nine outputs: two columns of the rotation (Zhou et al. 2019), and which object point the particle's own 3-D point is.

    The translation follows: t = p - R x, p being the measured point in the camera and x the told one in the object. So what
    is regressed is bounded by the object's size, and independent of where in the room it stands.
    """

    width = 9
    center: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("center", torch.zeros(3), persistent=False)
        self.radius = 1.0

    def about(self, center: Tensor, radius: float) -> None:
        """Take the object's centre and radius as origin and unit of x."""
        self.center, self.radius = center.to(self.center), radius

    def forward(self, raw: Tensor, point: Tensor) -> Tensor:
        """(B, N, 9), (B, N, 3) [m] -> (B, N, 4, 4)."""
        start = raw.new_tensor(
            [1.0, 0.0, 0.0, 0.0, 1.0, 0.0]
        )  # so that outputs about zero are a rotation, not a singularity
        R = matrix_from_6d(raw[..., :6] + start)
        x = self.center + self.radius * raw[..., 6:]
        return make_pose(R, point - (R @ x[..., None])[..., 0])


class NoPose(_AnyObject):
    """No outputs: a detector's particle tells where, not how. Its `pose` is unturned, at its own point, for drawing only."""

    width = 0

    def forward(self, raw: Tensor, point: Tensor) -> Tensor:
        """(B, N, 0), (B, N, 3) [m] -> (B, N, 4, 4)."""
        return make_pose(torch.eye(3, dtype=point.dtype, device=point.device), point)


def fill_depth(depth: Tensor, size: int = 7) -> Tensor:
    """Fill unknown depth with the mean of what is known near by, else the image's median (1 m where nothing is known).

    (B, 1, H, W) [m], 0 where unknown -> (B, 1, H, W) [m].
    """
    known = (depth > 0).to(depth.dtype)
    total, count = _window_mean(torch.cat([depth, known]), size).chunk(2)
    near = total / count.clamp_min(1e-6)
    flat = torch.where(depth > 0, depth, torch.nan).flatten(1).nanmedian(1).values
    median = torch.nan_to_num(flat, nan=1.0)[:, None, None, None]
    return torch.where(depth > 0, depth, torch.where(near > 0, near, median))


def _window_mean(x: Tensor, size: int) -> Tensor:
    """Average over a square about each pixel, zeros beyond the frame, an axis at a time.  (B, C, H, W) -> the same."""
    rows = F.avg_pool2d(x, (size, 1), 1, (size // 2, 0))
    return F.avg_pool2d(rows, (1, size), 1, (0, size // 2))
