"""Output heads: a displacement over the image, and a pose."""

import math
from typing import ClassVar, NamedTuple, Protocol

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from posefilter.capabilities import Capabilities
from posefilter.errors import UserError
from posefilter.geometry.fragments import gather_fragment, init_fragments
from posefilter.geometry.pose import make_pose
from posefilter.geometry.rotation import matrix_from_6d, matrix_from_quat_xyzw
from posefilter.types import Fragments, ObjectModel


class Displacement(Protocol):
    """Turns two network outputs into a displacement."""

    def __call__(
        self, raw: Tensor, logit: Tensor, state: Tensor, width: int, height: int
    ) -> Tensor:
        """(B, N, 2), likelihood's logit (B, N), (B, N, 2) [px] in a frame of width x height -> (B,
        N, 2) [px].
        """


class PosePrediction(NamedTuple):
    """The predicted pose of each particle."""

    pose: Tensor  # (B, N, 4, 4) camera_from_object
    # distribution of its object point; None if a single point is predicted
    fragments: Fragments | None = None


class Unbounded(nn.Module):
    """The outputs are the displacement in a unit of length; particles may leave the frame.

    The paper does not state the unit. It decides how far an untrained network throws particles.

    Args:
        unit: "half_frame" for half the frame's width, a number of pixels, or "learned" for one
            positive number of pixels that is trained with the network and starts at 10.
    """

    learned_from_px: ClassVar[float] = 10.0

    def __init__(self, unit: str | float = "half_frame") -> None:
        super().__init__()
        length = (
            isinstance(unit, int | float) and not isinstance(unit, bool) and 0 < unit < math.inf
        )
        if unit not in ("half_frame", "learned") and not length:
            raise UserError(
                f"model.displacement.unit={unit}: choose half_frame, learned, or a number of "
                "pixels above 0"
            )
        self.unit = unit
        if unit == "learned":  # its logarithm, so that it stays positive
            self.log_unit = nn.Parameter(torch.tensor(math.log(self.learned_from_px)))

    def forward(self, raw: Tensor, logit: Tensor, state: Tensor, width: int, height: int) -> Tensor:
        """(B, N, 2) -> (B, N, 2) [px]."""
        return raw * self.unit_px(width)

    def unit_px(self, width: int) -> Tensor | float:
        """Return the unit in a frame of this width [px]."""
        if self.unit == "half_frame":
            return width / 2
        return self.log_unit.exp() if self.unit == "learned" else float(self.unit)


class Bounded(nn.Module):
    """At most `max_displacement` frame widths along each axis (tanh), and within the frame.

    The clamp to the frame has a straight-through gradient, so that particles at an edge still get
    one.

    Args:
        max_displacement: Largest displacement along an axis, in frame widths.
    """

    def __init__(self, max_displacement: float = 0.25) -> None:
        super().__init__()
        self.max_displacement = max_displacement

    def forward(self, raw: Tensor, logit: Tensor, state: Tensor, width: int, height: int) -> Tensor:
        """(B, N, 2), (B, N), (B, N, 2) [px] -> (B, N, 2) [px]."""
        corner = state.new_tensor([width - 1.0, height - 1.0])
        goal = state + torch.tanh(raw) * self.max_displacement * width
        inside = torch.minimum(goal.clamp_min(0.0), corner)
        return goal + (inside - goal).detach() - state


class Gated(nn.Module):
    """Another displacement x the probability that the particle is off the object.

    Particles on the object then stay on it. The likelihood gets no gradient through the gate.

    Args:
        displacement: The displacement to gate.
    """

    def __init__(self, displacement: Displacement) -> None:
        super().__init__()
        self.displacement = displacement

    def forward(self, raw: Tensor, logit: Tensor, state: Tensor, width: int, height: int) -> Tensor:
        """(B, N, 2), (B, N), (B, N, 2) [px] -> (B, N, 2) [px]."""
        gate = torch.sigmoid(-logit.detach())[..., None]
        return self.displacement(raw, logit, state, width, height) * gate


class _AnyObject(nn.Module):
    """A head that does not depend on the object."""

    def set_object(self, object_model: ObjectModel) -> None:
        """Need nothing of the object."""


class AbsoluteQuaternion(_AnyObject):
    """Seven outputs: a quaternion (x, y, z, w), normalized here, and the translation [m]."""

    provides: ClassVar[Capabilities] = ("pose",)

    width = 7

    def forward(self, raw: Tensor, point: Tensor) -> PosePrediction:
        """(B, N, 7), (B, N, 3) -> PosePrediction."""
        return PosePrediction(make_pose(matrix_from_quat_xyzw(raw[..., :4]), raw[..., 4:]))


class _SurfacePointHead(nn.Module):
    """A head that predicts two columns of the rotation, and the object point of the measured
    point.
    """

    provides: ClassVar[Capabilities] = ("pose",)

    center: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("center", torch.zeros(3), persistent=False)
        self.radius = 1.0

    def set_object(self, object_model: ObjectModel) -> None:
        """Use the object's center and radius as origin and unit of object points."""
        self.center, self.radius = object_model.center.to(self.center), object_model.radius

    def _pose(self, columns: Tensor, object_point: Tensor, point: Tensor) -> Tensor:
        """Return poses.

        Args:
            columns: (B, N, 6) two columns of the rotation, minus those of the identity.
            object_point: (B, N, 3) from the center, in radii.
            point: (B, N, 3) measured, in the camera [m].

        Returns:
            camera_from_object (B, N, 4, 4).
        """
        # so that zeros are a rotation, not a singularity
        start = columns.new_tensor([1.0, 0.0, 0.0, 0.0, 1.0, 0.0])
        R = matrix_from_6d(columns + start)
        x = self.center + self.radius * object_point
        return make_pose(R, point - (R @ x[..., None])[..., 0])


class SurfacePointSixD(_SurfacePointHead):
    """Nine outputs: two columns of the rotation (Zhou et al. 2019), and an object point.

    The translation is t = p - R x, with p the measured point in the camera and x the predicted
    object point. The regressed values are thus bounded by the object's size and independent of its
    position.
    """

    width = 9

    def forward(self, raw: Tensor, point: Tensor) -> PosePrediction:
        """(B, N, 9), (B, N, 3) [m] -> PosePrediction."""
        return PosePrediction(self._pose(raw[..., :6], raw[..., 6:], point))


class SurfacePointFragments(_SurfacePointHead):
    """The same with a distribution over surface fragments (EPOS, Hodan et al. 2020): 6 + 4 K
    outputs.

    A single point averages over ambiguous points; a distribution over fragments keeps several
    modes. The pose is that of the most probable fragment.

    Args:
        fragments: Number of fragments, K.
    """

    requires: ClassVar[Capabilities] = ("surface_point_loss",)

    centers: Tensor  # (K, 3) the fragments' centers, from the object's center, in radii
    reach: Tensor  # () their mean radius, in radii of the object; by its name in checkpoints

    def __init__(self, fragments: int = 64) -> None:
        super().__init__()
        if fragments < 1:
            raise UserError(f"model.pose_head.fragments={fragments}: must be 1 or more")
        self.width = 6 + 4 * fragments
        self.fragments = fragments
        self.register_buffer("centers", torch.zeros(fragments, 3))
        self.register_buffer("reach", torch.ones(()))

    def set_object(self, object_model: ObjectModel) -> None:
        """Compute the object's fragments, unless loaded weights have theirs."""
        super().set_object(object_model)
        init_fragments(
            self.centers, self.reach, object_model.points, object_model.center, object_model.radius
        )

    def forward(self, raw: Tensor, point: Tensor) -> PosePrediction:
        """(B, N, 6 + 4 K), (B, N, 3) [m] -> PosePrediction."""
        columns, share, offset = raw.split([6, self.fragments, 3 * self.fragments], dim=-1)
        position = self.centers + self.reach * offset.unflatten(-1, (self.fragments, 3))
        mode = gather_fragment(position, share.argmax(-1))
        fragments = Fragments(
            torch.log_softmax(share, dim=-1),
            position,
            self.centers.expand(len(raw), -1, -1),
            self.reach,
        )
        return PosePrediction(self._pose(columns, mode, point), fragments)


class NoPose(_AnyObject):
    """No outputs, for detectors; `pose` has no rotation and lies at the measured point, for
    figures.
    """

    width = 0

    def forward(self, raw: Tensor, point: Tensor) -> PosePrediction:
        """(B, N, 0), (B, N, 3) [m] -> PosePrediction."""
        return PosePrediction(make_pose(torch.eye(3).to(point), point))


def fill_depth(depth: Tensor, size: int = 7) -> Tensor:
    """Fill unknown depth by the mean of known depth near by, else by the image's median.

    An image without depth counts as 1 m deep.

    (B, 1, H, W) [m], 0 where unknown -> (B, 1, H, W) [m].
    """
    known = (depth > 0).to(depth.dtype)
    total, count = _window_mean(torch.cat([depth, known]), size).chunk(2)
    near = total / count.clamp_min(1e-6)
    median = _known_median(depth.flatten(1))[:, None, None, None]
    return torch.where(depth > 0, depth, torch.where(near > 0, near, median))


def _known_median(depth: Tensor) -> Tensor:
    """Return the lower median of what is known, 1 where nothing is.  (B, n) [m] -> (B,) [m]."""
    if not torch.compiler.is_compiling():
        return torch.nan_to_num(torch.where(depth > 0, depth, torch.nan).nanmedian(1).values, nan=1)
    # for export: ONNX has no median
    ordered = torch.where(depth > 0, depth, torch.inf).sort(1).values
    count = (depth > 0).sum(1, keepdim=True)
    middle = ordered.gather(1, (count - 1).clamp_min(0) // 2)
    return torch.where(count > 0, middle, torch.ones_like(middle))[:, 0]


def _window_mean(x: Tensor, size: int) -> Tensor:
    """Average over a square around each pixel, zeros beyond the frame.  (B, C, H, W) -> the
    same.
    """
    rows = F.avg_pool2d(x, (size, 1), 1, (size // 2, 0))
    return F.avg_pool2d(rows, (1, size), 1, (0, size // 2))
