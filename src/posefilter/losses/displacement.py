"""Losses on where the particles go.

Lengths in frame widths, so that they do not grow with the image.
"""

import torch
from torch import Tensor

from posefilter.geometry.boxes import box_iou, box_of_pose
from posefilter.geometry.lookup import nearest_true, true_pixels, window
from posefilter.protocols import Label
from posefilter.types import Batch, ObjectModel, Trace


def moved(trace: Trace) -> Tensor:
    """Return where each reading sends its particles: (T, B, N, 2) [px]."""
    return torch.stack(
        [c.state + r.displacement for c, r in zip(trace.particles, trace.outputs, strict=True)]
    )


class Offset:
    """Squared distance between each moved particle and the nearest pixel of the mask, of all steps
    (the paper, figure 4).

    Taught through the whole roll-out: a displacement is also blamed for what later ones make of it.
    """

    def __call__(self, trace: Trace, batch: Batch, model: ObjectModel) -> Tensor:
        """Return (B,)."""
        places = moved(trace)
        flat = places.transpose(0, 1).flatten(1, 2)
        return (
            ((flat - nearest_true(batch.mask, flat)) / batch.rgb.shape[-1]).square().sum(-1).mean(1)
        )


class Chamfer:
    """Chamfer distance between the moved particle's patch and the mask, as two sets of pixels (the
    paper, eq. 5).

    Each set is its pixels' coordinates; both directions' mean squared distance to the nearest of
    the other, mean over particles and steps. Differentiable in the offset, the pairs held fixed.
    The mask's side: an even selection of `most`.
    """

    def __init__(self, size: int = 9, most: int = 256) -> None:
        self.size = size
        self.most = most

    def __call__(self, trace: Trace, batch: Batch, model: ObjectModel) -> Tensor:
        """Return (B,)."""
        places = moved(trace).transpose(0, 1).flatten(1, 2)
        return (
            self.patch_to_mask(places, batch.mask) + self.mask_to_patch(places, batch.mask)
        ) / batch.rgb.shape[-1] ** 2

    def patch_to_mask(self, places: Tensor, mask: Tensor) -> Tensor:
        """Mean squared distance of each patch pixel to its nearest mask pixel.

        (B, P, 2), (B, 1, H, W) -> (B,) [px^2].
        """
        pixels = (places[:, :, None] + window(self.size, places.device)).flatten(1, 2)
        return (pixels - nearest_true(mask, pixels)).square().sum(-1).mean(1)

    def mask_to_patch(self, places: Tensor, mask: Tensor) -> Tensor:
        """Mean squared distance of each mask pixel to its nearest patch pixel.  (B, P, 2), (B, 1,
        H, W) -> (B,) [px^2].

        The patch is a grid, so the nearest of it is found an axis at a time by rounding.
        """
        targets, real = true_pixels(mask, self.most)
        way = targets[:, None] - places[:, :, None]  # (B, P, M, 2)
        partner = way.detach().round().clamp(-((self.size - 1) // 2), self.size // 2)
        apart = (way - partner).square().sum(-1) * real[:, None]
        return (apart.sum(-1) / real.sum(1)[:, None].clamp_min(1)).mean(1)


class DirectDisplacement:
    """A direct lesson for the displacement: each reading's displacement against the one that its
    label asks for (Huber).

    Each step is judged by itself: its label takes the place where it stood as given, and blames no
    earlier step for it. What was seen there is another matter: with model.detach_position=false it teaches
    the displacement that led there, by this loss as by any.
    """

    def __init__(self, label: Label, width: float = 0.05) -> None:
        self.label = label
        self.width = width

    def __call__(self, trace: Trace, batch: Batch, model: ObjectModel) -> Tensor:
        """Return (B,)."""
        wanted = self.label(trace, batch, model)
        displacement = torch.stack([output.displacement for output in trace.outputs])
        off = (displacement - wanted) / batch.rgb.shape[-1]
        lost = (
            torch.nn.functional.huber_loss(
                off, torch.zeros_like(off), delta=self.width, reduction="none"
            )
            / self.width
        )
        return lost.sum(-1).mean((0, 2))


class Sides:
    """How far the box's four sides lie from the particle, told in its latent: L1 plus 1 - IoU, on
    the object.

    The latent's four numbers are the distances to the left, top, right and bottom side, in frame
    widths (as in FCOS, Tian et al. 2019). The box is the one that `iou` is measured against: the
    whole object's, hidden parts too, within the frame.
    """

    def __init__(self, label: Label) -> None:
        self.label = label

    def __call__(self, trace: Trace, batch: Batch, model: ObjectModel) -> Tensor:
        """Return (B,)."""
        height, width = batch.rgb.shape[-2:]
        whole = box_of_pose(batch.camera_from_object, model.hull, batch.intrinsics, height, width)
        box = (whole / width)[:, None]
        on = self.label(trace, batch, model) > 0
        total = batch.rgb.new_zeros(len(batch.rgb))
        for particles, output, inside in zip(trace.particles, trace.outputs, on, strict=True):
            place = particles.state.detach() / batch.rgb.shape[-1]
            true = box - place.repeat(1, 1, 2)
            told = torch.cat([-output.latent[..., :2], output.latent[..., 2:]], dim=-1)
            lost = (told - true).abs().sum(-1) + 1 - box_iou(told, true)
            total = total + (lost * inside).sum(1) / inside.sum(1).clamp_min(1)
        return total / len(trace.outputs)
