"""Candidate poses that a likelihood learns from by contrast, and the persistent particles that find
its faults.

A likelihood trained on the truth and its neighbors alone scores absurd poses high, since it never
saw them. So candidates come from everywhere, and some from the likelihood's own filter: particles
that live on from visit to visit of a frame, advancing one step of an annealed filter each time
(persistent chains, Tieleman 2008).
"""

import math
from collections.abc import Sequence

import torch
from torch import Generator, Tensor, nn

from posefilter.errors import UserError
from posefilter.filters.initialize import draw_from_depth
from posefilter.filters.propagate import half_turns
from posefilter.geometry.pose import invert, origin_of, pose_about
from posefilter.geometry.rotation import random_rotation
from posefilter.geometry.spaces import PoseSpace
from posefilter.types import Batch, ObjectModel


def from_depth(
    batch: Batch, space: PoseSpace, count: int, generator: Generator, prior: Tensor | None = None
) -> Tensor:
    """Draw poses at measured points of a batch; see `draw_from_depth`.  -> (B, count, 4, 4)."""
    return draw_from_depth(batch.depth, batch.intrinsics, space, count, generator, prior)


def jiggle(
    poses: Tensor, sigma: Tensor, space: PoseSpace, generator: Generator, turn: float = 1.0
) -> Tensor:
    """Perturb poses by Gaussian moves of size sigma.

    (B, N, 4, 4), (B, N) [m] -> (B, N, 4, 4); `turn` scales the turns.
    """
    scale = space.noise_scale(sigma)
    scale = torch.cat([scale[..., :3], scale[..., 3:] * turn], dim=-1)
    return space.move(
        poses, scale * torch.randn(scale.shape, generator=generator, device=poses.device)
    )


def around_truth(
    batch: Batch,
    model: ObjectModel,
    space: PoseSpace,
    each: int,
    sigma: Sequence[float],
    generator: Generator,
) -> Tensor:
    """Draw the candidates that need the truth: it itself first, then `each` of every kind.  -> (B,
    1 + 4.5 each, 4, 4).

    Kinds: perturbed at every scale; from depth on the object; from depth anywhere; right place with
    a random rotation (half as many); half turns, slightly perturbed.
    """
    B = len(batch.rgb)
    device = batch.rgb.device
    truth = batch.camera_from_object[:, None]
    center = model.center.to(device)
    low, high = math.log(sigma[0]), math.log(sigma[1])
    size = torch.exp(torch.empty(B, each, device=device).uniform_(low, high, generator=generator))
    same = truth.expand(B, each, 4, 4)
    near = jiggle(same, size * 0.6, space, generator)
    on = from_depth(batch, space, each, generator, batch.mask.float() + 0.02)
    anywhere = from_depth(batch, space, each, generator)
    few = each // 2
    placed = jiggle(truth.expand(B, few, 4, 4), size[:, :few] * 0.5, space, generator, turn=0.0)
    turned = pose_about(
        random_rotation(B, few, generator=generator, device=device),
        origin_of(placed, center),
        center,
    )
    flipped = jiggle(half_turns(same, space, generator), size * 0.3, space, generator)
    return torch.cat([truth, near, on, anywhere, turned, flipped], dim=1)


class PersistentParticles(nn.Module):
    """A few particles a training frame, kept between visits; a frame's noise level falls to
    `sharpest` with each of them.

    They are stored relative to the truth (object_from_hypothesis), so that a sample whose camera
    was rolled or zoomed by augmentation finds them where they were.
    """

    def __init__(
        self, particles: int = 16, levels: int = 12, sharpest: float = 0.004, step: float = 0.4
    ) -> None:
        super().__init__()
        if particles < 1 or levels < 2:
            raise UserError(
                f"lesson: levels={levels} must be 2 or more, particles={particles} 1 "
                f"or more, or 0 for none"
            )
        self.particles, self.levels, self.sharpest, self.step = particles, levels, sharpest, step
        self._poses: dict[int, Tensor] = {}
        self._level: dict[int, int] = {}

    def recall(self, batch: Batch, fresh: Tensor, start: float) -> tuple[Tensor, Tensor]:
        """Return each frame's particles (B, M, 4, 4) and noise level (B,) [m]; new frames take the
        fresh ones, at start.
        """
        rows = []
        for row, frame in enumerate(batch.frame_id.tolist()):
            kept = self._poses.get(frame)
            rows.append(
                fresh[row]
                if kept is None
                else batch.camera_from_object[row] @ kept.to(fresh.device)
            )
        level = torch.tensor(
            [self._level.get(frame, 0) for frame in batch.frame_id.tolist()], device=fresh.device
        )
        return torch.stack(rows), start * (self.sharpest / start) ** (level / (self.levels - 1))

    def state(self) -> dict[str, Tensor]:
        """Return what a run needs to go on: frames (F,), their levels (F,) and particles (F, M, 4,
        4).
        """
        if not self._poses:
            return {}
        frames = sorted(self._poses)
        levels = torch.tensor([self._level[frame] for frame in frames])
        return {
            "frames": torch.tensor(frames),
            "levels": levels,
            "poses": torch.stack([self._poses[f] for f in frames]),
        }

    def restore(self, state: dict[str, Tensor]) -> None:
        """Go on from what `state` returned."""
        self._poses, self._level = {}, {}
        if state:
            frames = state["frames"].tolist()
            self._poses.update(zip(frames, state["poses"], strict=True))
            self._level.update(zip(frames, state["levels"].tolist(), strict=True))

    @torch.no_grad()
    def advance(
        self,
        batch: Batch,
        poses: Tensor,
        scores: Tensor,
        sigma: Tensor,
        used: Tensor,
        space: PoseSpace,
        generator: Generator,
    ) -> None:
        """Take one filter step where `used` (B,): resample by the scores at sigma, perturb, lower
        the noise level.
        """
        ancestors = torch.multinomial(
            torch.softmax(scores, dim=1), self.particles, replacement=True, generator=generator
        )
        resampled = poses.gather(1, ancestors[..., None, None].expand(-1, -1, 4, 4))
        size = (self.step * sigma)[:, None].expand(-1, self.particles)
        relative = invert(batch.camera_from_object)[:, None] @ jiggle(
            resampled, size, space, generator
        )
        for row, frame in enumerate(batch.frame_id.tolist()):
            if not bool(used[row]):
                continue
            level = self._level.get(frame, 0) + 1
            if level < self.levels:
                self._level[frame], self._poses[frame] = level, relative[row].cpu()
            else:
                self._level.pop(frame, None)
                self._poses.pop(frame, None)
