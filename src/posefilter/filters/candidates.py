"""Candidate poses for contrastive training of a likelihood, and persistent particles.

A likelihood that is trained only near the truth gives high scores to distant wrong poses.
Candidates therefore also come from measured points anywhere in the image, and from the filter
itself: persistent particles advance by one step of an annealed filter when the likelihood learns
from their frame at their noise level (persistent chains, Tieleman 2008).
"""

import math
from collections.abc import Sequence

import torch
from torch import Generator, Tensor, nn

from posefilter.errors import UserError
from posefilter.filters.initialize import draw_from_depth
from posefilter.geometry.pose import invert, origin_of, pose_about, take_poses
from posefilter.geometry.rotation import random_rotation
from posefilter.geometry.spaces import PoseSpace
from posefilter.protocols import Propagate
from posefilter.types import Batch, ObjectModel, Step


def perturb(poses: Tensor, sigma: Tensor, space: PoseSpace, generator: Generator) -> Tensor:
    """Perturb poses by Gaussian noise in the space's tangent.

    (B, N, 4, 4), noise levels (B, N) [m] -> (B, N, 4, 4).
    """
    scale = space.noise_scale(sigma)
    noise = torch.randn(scale.shape, generator=generator, device=poses.device)
    return space.move(poses, scale * noise)


def sample_around_truth(
    batch: Batch,
    object_model: ObjectModel,
    space: PoseSpace,
    per_kind: int,
    sigma: Sequence[float],
    generator: Generator,
    rotations: Propagate,
) -> Tensor:
    """Draw the candidates that need the truth.

    The truth itself comes first. Then follow, `per_kind` of them unless stated otherwise:
    perturbations of the truth at every scale; poses from depth on the object; poses from depth
    anywhere; random rotations near the true center (`per_kind // 2`); turns of the truth, slightly
    perturbed.

    Args:
        batch: Images with their true poses.
        object_model: The object.
        space: The space of the poses.
        per_kind: Candidates of a kind.
        sigma: Lowest and highest noise level [m]; levels are drawn log-uniformly.
        generator: Source of randomness.
        rotations: The kernel that turns the truth, such as half turns of every particle.

    Returns:
        Poses (B, 1 + 4 per_kind + per_kind // 2, 4, 4), camera_from_object.
    """
    B = len(batch.rgb)
    device = batch.rgb.device
    truth = batch.camera_from_object[:, None]
    center = object_model.center.to(device)
    low, high = math.log(sigma[0]), math.log(sigma[1])
    size = torch.empty(B, per_kind, device=device).uniform_(low, high, generator=generator).exp()
    copies = truth.expand(B, per_kind, 4, 4)
    nearby = perturb(copies, size * 0.6, space, generator)
    arguments = batch.depth, batch.intrinsics, space, per_kind, generator
    on_object = draw_from_depth(*arguments, batch.mask.float() + 0.02)
    anywhere = draw_from_depth(*arguments)
    half = per_kind // 2
    shifted = perturb(truth.expand(B, half, 4, 4), size[:, :half] * 0.5, space, generator)
    any_rotation = random_rotation(B, half, generator=generator, device=device)
    rotated = pose_about(any_rotation, origin_of(shifted, center), center)
    still = copies.new_zeros(B, per_kind, space.dimensions)
    turned = rotations(copies, still, Step(0, 1, size[:, 0]), space, generator)
    flipped = perturb(turned, size * 0.3, space, generator)
    return torch.cat([truth, nearby, on_object, anywhere, rotated, flipped], dim=1)


class PersistentParticles(nn.Module):
    """A few particles for each training frame, kept between visits of the frame.

    The frame's noise level falls geometrically to `sharpest` with each step; then the frame starts
    anew. Particles are stored relative to the truth (object_from_hypothesis), so that they stay
    valid where augmentation rolls or zooms the camera.

    Args:
        particles: Particles of a frame.
        levels: Noise levels, two or more.
        sharpest: Lowest noise level [m].
        step: Standard deviation of a perturbation, over the noise level.

    Raises:
        UserError: `particles` is below 1, or `levels` below 2.
    """

    def __init__(
        self, particles: int = 16, levels: int = 12, sharpest: float = 0.004, step: float = 0.4
    ) -> None:
        super().__init__()
        if particles < 1 or levels < 2:
            raise UserError(
                f"model.candidate_sampler: sigma_levels={levels} must be 2 or more, "
                f"particles={particles} 1 or more, or 0 for none"
            )
        self.particles, self.levels, self.sharpest, self.step = particles, levels, sharpest, step
        self._poses: dict[int, Tensor] = {}
        self._level: dict[int, int] = {}

    def recall(self, batch: Batch, fresh: Tensor, start: float) -> tuple[Tensor, Tensor]:
        """Return each frame's particles and noise level.

        Args:
            batch: Images; `frame_id` says which frames.
            fresh: (B, M, 4, 4) particles for frames that have none yet.
            start: Highest noise level [m].

        Returns:
            Particles (B, M, 4, 4) camera_from_object, and noise levels (B,) [m].
        """
        frames, rows = batch.frame_id.tolist(), list(fresh)
        for row, frame in enumerate(frames):
            if frame in self._poses:
                stored = self._poses[frame].to(fresh.device)
                rows[row] = batch.camera_from_object[row] @ stored
        level = torch.tensor([self._level.get(frame, 0) for frame in frames], device=fresh.device)
        return torch.stack(rows), start * (self.sharpest / start) ** (level / (self.levels - 1))

    def state(self) -> dict[str, Tensor]:
        """Return what a resumed run needs.

        Returns:
            "frames" (F,), "levels" (F,) and "poses" (F, M, 4, 4); empty where nothing is stored.
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
        """Restore what `state` returned."""
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
        """Advance by one filter step: resample by the scores, perturb, lower the noise level.

        Args:
            batch: Images whose frames' particles advance.
            poses: (B, C, 4, 4) candidates, camera_from_object.
            scores: (B, C) unnormalized log weights.
            sigma: (B,) noise level of the scores [m].
            used: (B,) bool; other frames stay as they are.
            space: The space of the poses.
            generator: Source of randomness.
        """
        ancestors = torch.multinomial(
            torch.softmax(scores, dim=1), self.particles, replacement=True, generator=generator
        )
        size = (self.step * sigma)[:, None].expand(-1, self.particles)
        moved = perturb(take_poses(poses, ancestors), size, space, generator)
        relative = invert(batch.camera_from_object)[:, None] @ moved
        for row, frame in enumerate(batch.frame_id.tolist()):
            if not bool(used[row]):
                continue
            level = self._level.get(frame, 0) + 1
            if level < self.levels:
                self._level[frame], self._poses[frame] = level, relative[row].cpu()
            else:
                self._level.pop(frame, None)
                self._poses.pop(frame, None)
