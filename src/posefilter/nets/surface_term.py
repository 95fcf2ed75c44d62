"""What the measured depth says of a hypothesis's own surface, as a term of its log-likelihood.

`PoseLikelihood` asks single image points. Where the camera looks through the hypothesis each of
them may still look like the object, or like an occluder. Here the hypothesis's surface is asked:
how much of what should be seen is seen, hidden by something nearer, or seen through? A surface that
is seen through cannot be there.
"""

from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from posefilter.geometry.fragments import sample_farthest_points
from posefilter.geometry.pose import origin_of, rotation_of, translation_of
from posefilter.nets.linear import Linear

if TYPE_CHECKING:
    from posefilter.nets.likelihood import Pixels

_NEAREST = 0.05  # [m] points nearer to the camera's plane are projected as if they were there
_TINY = 1e-6
_FEW = 0.02  # share of the points, added to denominators
_MOST = 2000  # surface points that the term's are chosen from


class SurfaceTerm(nn.Module):
    """A term of the log-likelihood from a pose's visible, hidden and contradicted surface.

    A surface point whose pixel shows a surface at its own depth agrees; one before which something
    is measured is hidden; one whose pixel shows what lies behind it is seen through. Their shares,
    at two tolerances that grow with the noise level, apart for points that face the camera and
    points that do not, are the inputs of a small network. It is zero before it is trained.

    Args:
        points: Surface points that a pose is judged by.
        width: Width of the network.
        scale: Factor on its output.
    """

    inputs = 17

    def __init__(self, points: int = 64, width: int = 32, scale: float = 20.0) -> None:
        super().__init__()
        self.count, self.scale = points, scale
        self.register_buffer("points", torch.zeros(points, 3), persistent=False)
        self.enter = Linear(self.inputs + 9, width)
        self.hidden = Linear(width, width)
        self.leave = nn.Linear(width, 1)
        nn.init.zeros_(self.leave.weight)
        nn.init.zeros_(self.leave.bias)

    def set_object(self, points: Tensor) -> None:
        """Choose the surface points, far from each other.  (P, 3) [m], mesh frame."""
        own = self.get_buffer("points")
        few = points[:: max(1, len(points) // _MOST)]
        own.copy_(sample_farthest_points(few.to(own), self.count)[0])

    def forward(
        self,
        image: "Pixels",
        poses: Tensor,
        sigma: Tensor,
        level: Tensor,
        center: Tensor,
        radius: float,
        points: Tensor | None = None,
    ) -> Tensor:
        """Return the term.

        Args:
            image: The images; without context the object's membership counts as 0.
            poses: (B, N, 4, 4) camera_from_object [m].
            sigma: (B,) or () noise level [m].
            level: (B, 9) or (1, 9) the same, encoded.
            center: (3,) the object's center [m], or that of the surface's part.
            radius: The object's radius [m].
            points: (Q, 3) the surface points, of a part [m]; None: those of the object.

        Returns:
            (B, N).
        """
        shares = self.measure(image, poses, sigma, center, radius, points)
        at = level[:, None].expand(*shares.shape[:2], -1)
        x = torch.relu(self.enter(torch.cat([shares, at], dim=-1)))
        out: Tensor = self.leave(torch.relu(self.hidden(x)))[..., 0]
        return self.scale * out

    def measure(
        self,
        image: "Pixels",
        poses: Tensor,
        sigma: Tensor,
        center: Tensor,
        radius: float,
        points: Tensor | None = None,
    ) -> Tensor:
        """Return the network's inputs but the noise level; arguments as of `forward`.

        -> (B, N, 17).
        """
        (H, W), (B, N) = image.size, poses.shape[:2]
        own = self.get_buffer("points") if points is None else points
        R, t = rotation_of(poses), translation_of(poses)
        # one product for all poses: (B, N, 3, P)
        at = (R.flatten(0, 2) @ own.T).view(B, N, 3, -1) + t[..., None]
        x, y, z = at.unbind(-2)
        fx, fy, cx, cy = image.camera
        with torch.no_grad():
            over = z.clamp_min(_NEAREST).reciprocal()
            u, v = (fx * x * over + cx).round(), (fy * y * over + cy).round()
            inside = (u >= 0) & (u < W) & (v >= 0) & (v < H) & (z > _NEAREST)
            column, row = u.clamp_(0, W - 1).long(), v.clamp_(0, H - 1).long()
            depth = image.values[..., 3].gather(1, (row * W + column).flatten(1)).view(B, N, -1)
            known = (inside & (depth > 0)).to(z.dtype)
        # the cosine of the angle between the way outward and the way to the camera
        toward = ((origin_of(poses, center)[..., None] - at) * at).sum(-2)
        cosine = toward / ((own - center).norm(dim=-1) * at.square().sum(-2).sqrt() + _TINY)
        front, back = cosine.clamp_min(0), (-cosine).clamp_min(0)
        weights = [w / (w.sum(-1, keepdim=True) + _TINY) for w in (front, back)]
        known_weights = [w * known for w in weights]
        behind = depth - z  # what is measured lies so far behind the point
        spread = sigma.reshape(-1, 1, 1)
        out: list[Tensor] = []
        for tolerance in (0.004 + 0.5 * spread, 0.01 + 0.03 * radius + 2 * spread):
            offset = behind / tolerance
            through = (offset - 0.5).clamp(0, 1)
            hidden = (-offset - 0.5).clamp(0, 1)
            agrees = 1 - through - hidden
            for weight in known_weights:
                out += [(weight * share).sum(-1) for share in (agrees, through, hidden)]
        seen = known_weights[0] * agrees
        total = seen.sum(-1)
        out += [(weights[0] * inside).sum(-1), known_weights[0].sum(-1)]
        out.append((seen * offset.clamp(-2, 2)).sum(-1) / (total + _FEW))
        if image.context is None:
            out += [torch.zeros_like(total)] * 2
        else:
            # only of the cells that are asked for: there are more of them in an image
            logit = image.context.smooth[..., 0].detach()
            cells = (row // 2) * image.context.columns + column // 2
            member = logit.gather(1, cells.flatten(1)).sigmoid().view(B, N, -1) * inside
            out += [(seen * member).sum(-1) / (total + _FEW), (weights[0] * member).sum(-1)]
        return 2 * torch.stack(out, dim=-1) - 1
