"""Pictures of the particles' journeys over an image: the paper's figures 2 and 4, as a figure and as a short film."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image, ImageDraw
from torch import Tensor

from posefilter.geometry.lookup import touches
from posefilter.types import Cloud

ON, OFF, START = (60, 220, 90), (255, 80, 60), (250, 220, 60)


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


def journey_figure(rgb: Tensor, mask: Tensor, states: Tensor, most: int = 100) -> Figure:
    """Draw where particles started (yellow), went (lines) and ended (green: on the object, red: off it).

    rgb (3, H, W), mask (1, H, W) bool, states (T, N, 2) [px]; `most` particles are drawn. The axes show half a frame more
    on each side, since particles may leave it.
    """
    H, W = mask.shape[-2:]
    path = states[:, :most].cpu()
    on = touches(mask[None].cpu(), path[-1:], 1)[0].numpy()
    figure = Figure(figsize=(8, 6), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    axes.imshow(rgb.permute(1, 2, 0).cpu().clamp(0, 1).numpy())
    axes.contour(mask[0].cpu().numpy(), [0.5], colors="white", linewidths=1)
    xy = path.numpy()
    for end, color in ((False, OFF), (True, ON)):
        chosen = xy[:, on == end]
        shade = tuple(c / 255 for c in color)
        axes.plot(chosen[..., 0], chosen[..., 1], "-", color=shade, linewidth=0.7, alpha=0.6)
        axes.plot(chosen[-1, :, 0], chosen[-1, :, 1], "o", color=shade, markersize=3)
    axes.plot(xy[0, :, 0], xy[0, :, 1], ".", color=tuple(c / 255 for c in START), markersize=2)
    reach = 0.5 if bool(((path < 0) | (path > torch.tensor([W, H]))).any()) else 0.02
    axes.set(xlim=(-reach * W, (1 + reach) * W), ylim=((1 + reach) * H, -reach * H))
    axes.set_title(f"{len(states)} steps: {on.mean():.0%} of the particles end on the object")
    return figure


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
