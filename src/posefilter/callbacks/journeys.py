"""The particles' journeys over an image: where each stood, what it saw there, and a short film of it."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw
from torch import Tensor

from posefilter.geometry.lookup import touches
from posefilter.models.image_space import ImageScene, ImageSpace
from posefilter.pictures.cloud import spread_choice, weights_of
from posefilter.pictures.journeys import OFF, ON
from posefilter.types import Cloud, Trace


def lineage(clouds: Sequence[Cloud]) -> Tensor:
    """Return where each particle of the last cloud, and its ancestors before it, stood.  -> (B, T, N, *S)."""
    last = clouds[-1]
    rows = torch.arange(len(last.state), device=last.state.device)[:, None]
    index = torch.arange(last.state.shape[1], device=last.state.device).expand(len(last.state), -1)
    path = []
    for cloud in reversed(clouds):
        path.append(cloud.state[rows, index])
        index = cloud.ancestors[rows, index]
    return torch.stack(path[::-1], dim=1)


def followed(trace: Trace, most: int = 8) -> Tensor:
    """Return the ways of a few particles of one image, chosen by their last weight.  -> (T, n, 2) [px]."""
    chosen = spread_choice(weights_of(trace.clouds[-1], 0), most).unique()
    return lineage(trace.clouds)[0][:, chosen]


def glimpses_of(method: ImageSpace, scene: ImageScene, states: Tensor) -> np.ndarray:
    """Return what particles see where they stand in one image, its colours.  (T, n, 2) [px] -> (T, n, k, k, 3) uint8."""
    seen = method.glimpse(scene.image, states.flatten(0, 1)[None].to(scene.image))[0, :, :3]
    colours = ((seen + 1) / 2).clamp(0, 1).mul(255).round().byte().cpu()
    return colours.unflatten(0, states.shape[:2]).permute(0, 1, 3, 4, 2).numpy()


def journey_film(rgb: Tensor, mask: Tensor, states: Tensor, between: int = 4, scale: int = 2) -> list[Image.Image]:
    """Return the frames of a film of the same, `between` frames a step, each particle with a tail.

    Particles that leave the frame are drawn on its rim.
    """
    H, W = mask.shape[-2:]
    picture = (rgb.permute(1, 2, 0).cpu().clamp(0, 1).numpy() * 255).astype(np.uint8)
    rim = mask[0].cpu().numpy() & ~_inner(mask)[0].cpu().numpy()
    picture = np.where(rim[..., None], np.uint8(255), (picture * 0.75).astype(np.uint8))
    ground = Image.fromarray(picture).resize((W * scale, H * scale), Image.Resampling.NEAREST)
    limit = torch.tensor([W - 1.0, H - 1.0])
    path = states.cpu().clamp_min(0).minimum(limit)
    shares = torch.linspace(0, len(path) - 1, (len(path) - 1) * between + 1) if len(path) > 1 else torch.zeros(1)
    frames = []
    for share in shares.tolist() + [len(path) - 1.0] * between:
        i = min(int(share), max(len(path) - 2, 0))
        here = path[i] + (share - i) * (path[min(i + 1, len(path) - 1)] - path[i])
        on = touches(mask[None].cpu(), here[None], 1)[0].tolist()
        frame = ground.copy()
        pen = ImageDraw.Draw(frame)
        for start, (u, v), inside in zip(path[i].tolist(), here.tolist(), on, strict=True):
            u, v = (u + 0.5) * scale, (v + 0.5) * scale
            color = ON if inside else OFF
            pen.line([(start[0] + 0.5) * scale, (start[1] + 0.5) * scale, u, v], fill=color)
            pen.ellipse([u - scale, v - scale, u + scale, v + scale], fill=color)
        frames.append(frame)
    return frames


def save_film(frames: list[Image.Image], path: Path, milliseconds: int = 120) -> None:
    """Write frames as an animated WebP that loops."""
    path.parent.mkdir(parents=True, exist_ok=True)
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=milliseconds, loop=0, quality=70)


def _inner(mask: Tensor) -> Tensor:
    outside = torch.nn.functional.pad((~mask[None]).float(), (1, 1, 1, 1), value=1.0)
    return torch.nn.functional.max_pool2d(outside, 3, stride=1)[0] == 0
