"""Draw a belief about one pose over all six axes: rotation on a map of the sphere, and the marginals of each axis.

The map follows Murphy et al. 2021 (Implicit-PDF, figure 3): a rotation is a point where one of the object's axes points, and
a colour for the turn about that axis. Ours looks along the camera: the centre is towards it, right and up are the image's.
"""

import math

import numpy as np
import torch
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.gridspec import GridSpec
from matplotlib.lines import Line2D

from posefilter.geometry.camera import project
from posefilter.geometry.pose import origin_of, rotation_of
from posefilter.geometry.rotation import log_so3
from posefilter.pictures.canvas import new_figure
from posefilter.types import Belief, ObjectModel

_TILT = colormaps["hsv"]
_MASS = "#4a6fa5"
_TRUE, _BEST = "#159947", "#d6219c"  # darker than on photographs: these are read on white
_NAMES = "xyz"


def draw_belief(
    belief: Belief,
    model: ObjectModel,
    rgb: np.ndarray,
    K: np.ndarray,
    truth: np.ndarray | None = None,
    title: str = "",
    axis: int | None = None,
) -> Figure:
    """Draw the belief of one image: its centres on the photograph, its rotations on a map, and six marginals.

    belief: of one image, with its leading dimension of 1 or without; rgb (H, W, 3) uint8; K (3, 3) [px]; truth (4, 4);
    axis: the object's axis on the map (its longest, if None).
    """
    poses, weights, best = single(belief)
    true = None if truth is None else torch.as_tensor(np.asarray(truth), dtype=torch.float64)
    axis = longest_axis(model) if axis is None else axis
    figure = new_figure(1100, 1040)
    top = figure.add_gridspec(1, 6, left=0.065, right=0.975, bottom=0.55, top=0.91, wspace=0.9)
    below = figure.add_gridspec(2, 6, left=0.065, right=0.975, bottom=0.06, top=0.47, hspace=0.55, wspace=0.9)
    draw_centres(figure.add_subplot(top[0, :2]), poses, weights, best, true, model, rgb, K)
    draw_rotations(figure.add_subplot(top[0, 2:], projection="mollweide"), poses, weights, best, true, axis)
    draw_marginals(figure, below, poses, weights, best, true, model)
    ess = float(1 / weights.square().sum())
    title = title or f"Belief about {model.name}: {len(weights)} particles, {ess:.0f} of them effective"
    figure.suptitle(title, fontsize=14, x=0.02, y=0.985, ha="left")
    handles = [Line2D([], [], color=_BEST, linestyle="-", marker="s", mfc="none", markersize=9, label="estimate")]
    if true is not None:
        handles.append(Line2D([], [], color=_TRUE, linestyle="--", marker="o", mfc="none", markersize=9, label="truth"))
    figure.legend(handles=handles, loc="upper right", ncols=2, fontsize=11, frameon=False)
    return figure


def single(belief: Belief) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return the poses (N, 4, 4), weights (N,) that sum to 1, and estimate (4, 4) of a belief about one image."""
    poses, log_weights, best = (x.detach().cpu().double() for x in (belief.poses, belief.log_weights, belief.best))
    if poses.ndim == 4:
        if len(poses) != 1:
            raise ValueError(f"a belief about one image is due, not about {len(poses)}")
        poses, log_weights, best = poses[0], log_weights[0], best[0]
    return poses, torch.softmax(log_weights, 0), best


def longest_axis(model: ObjectModel) -> int:
    """Return which of the object's axes its bounding box is longest along; the last of equals."""
    size = (model.hull.max(0).values - model.hull.min(0).values).tolist()
    return max(range(3), key=lambda i: (round(size[i], 4), i))


def sphere_map(rotations: torch.Tensor, axis: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return where an axis of the object points, and the turn about it.  (*, 3, 3) camera_from_object -> (*) x 3 [rad].

    Longitude: 0 towards the camera, positive to the image's right; latitude: positive upwards in the image; tilt: the angle
    of the object's next axis from "up" at that point of the sphere, clockwise as seen from outside it.
    """
    direction, other = rotations[..., axis], rotations[..., (axis + 1) % 3]
    longitude = torch.atan2(direction[..., 0], -direction[..., 2])
    latitude = torch.asin((-direction[..., 1]).clamp(-1, 1))
    east = torch.stack([longitude.cos(), torch.zeros_like(longitude), longitude.sin()], -1)
    north = torch.linalg.cross(direction, east)
    return longitude, latitude, torch.atan2((other * east).sum(-1), (other * north).sum(-1))


def draw_rotations(
    axes: Axes, poses: torch.Tensor, weights: torch.Tensor, best: torch.Tensor, true: torch.Tensor | None, axis: int
) -> None:
    """Draw rotations on a Mollweide map: place = where the axis points, colour = turn about it, area = weight."""
    longitude, latitude, tilt = (x.numpy() for x in sphere_map(rotation_of(poses), axis))
    order = np.argsort(weights.numpy())
    area = 6 + 60 * weights.numpy() / weights.max().item()
    dots = axes.scatter(longitude[order], latitude[order], s=area[order], c=tilt[order], cmap=_TILT, linewidths=0)
    dots.set_clim(-math.pi, math.pi)
    for pose, marker, size in ((true, "o", 900), (best, "s", 500)):
        if pose is not None:
            u, v, turn = (float(x) for x in sphere_map(rotation_of(pose), axis))
            inner = _TILT((turn / math.pi + 1) / 2)
            edge = _TRUE if marker == "o" else _BEST
            axes.scatter(u, v, s=size, marker=marker, facecolors="none", edgecolors=[edge], linewidths=5)
            axes.scatter(u, v, s=size, marker=marker, facecolors="none", edgecolors=[inner], linewidths=2)
    axes.grid(alpha=0.3)
    axes.set_xticks(np.deg2rad([-90, 0, 90]), ["left", "to camera", "right"], fontsize=9)
    axes.set_yticks(np.deg2rad([-60, -30, 0, 30, 60]), ["60° down", "30° down", "0°", "30° up", "60° up"], fontsize=8)
    axes.set_title(
        f"Rotations: place = where the object's {_NAMES[axis]} axis points, colour = turn about it", fontsize=11, pad=10
    )
    bar = axes.figure.colorbar(dots, ax=axes, orientation="horizontal", shrink=0.5, aspect=40, pad=0.06)
    bar.set_ticks([-math.pi, -math.pi / 2, 0, math.pi / 2, math.pi], labels=["-180°", "-90°", "0°", "90°", "180°"])
    bar.set_label(f"the object's {_NAMES[(axis + 1) % 3]} axis, clockwise from upwards", fontsize=9)


def draw_centres(
    axes: Axes,
    poses: torch.Tensor,
    weights: torch.Tensor,
    best: torch.Tensor,
    true: torch.Tensor | None,
    model: ObjectModel,
    rgb: np.ndarray,
    K: np.ndarray,
) -> None:
    """Draw on the photograph where particles put the object's centre, cut to the object as the estimate has it."""
    camera = torch.as_tensor(np.asarray(K), dtype=torch.float64)
    center = model.center.cpu().double()
    at = lambda pose: project(origin_of(pose, center)[None], camera)[0].tolist()  # noqa: E731
    dots = project(origin_of(poses, center), camera).numpy()
    order = np.argsort(weights.numpy())
    axes.imshow(rgb)
    axes.scatter(dots[order, 0], dots[order, 1], s=8, c=weights[order], cmap="plasma", linewidths=0, alpha=0.9)
    if true is not None:
        axes.scatter([at(true)[0]], [at(true)[1]], s=300, marker="o", facecolors="none", edgecolors=[_TRUE], linewidths=2)
    axes.scatter([at(best)[0]], [at(best)[1]], s=180, marker="s", facecolors="none", edgecolors=[_BEST], linewidths=2)
    left, top, right, bottom = window(dots, weights.numpy(), best, model, camera.numpy(), *rgb.shape[:2])
    axes.set(xlim=(left, right), ylim=(bottom, top), xlabel="u [px]", ylabel="v [px]")
    axes.locator_params(nbins=4)
    axes.set_title("Centres on the photograph", fontsize=11)


def window(
    dots: np.ndarray, weights: np.ndarray, best: torch.Tensor, model: ObjectModel, K: np.ndarray, height: int, width: int
) -> tuple[float, float, float, float]:
    """Return the square part of the frame that shows the object as estimated, and 98 % of the particles.  -> [px]."""
    z = max(float(origin_of(best, model.center.cpu().double())[2]), 0.05)
    middle = project(origin_of(best, model.center.cpu().double())[None], torch.as_tensor(K))[0].numpy()
    reach = 1.1 * model.radius * K[0, 0] / z
    far = np.abs(dots - middle).max(1)
    order = np.argsort(far)
    reach = max(reach, float(far[order][np.searchsorted(np.cumsum(weights[order]), 0.98).clip(max=len(far) - 1)]) * 1.1)
    reach = min(reach, max(height, width) / 2)
    u = float(np.clip(middle[0], min(reach, width / 2), max(width - reach, width / 2)))
    v = float(np.clip(middle[1], min(reach, height / 2), max(height - reach, height / 2)))
    return u - reach, v - reach, u + reach, v + reach


def shifts_and_turns(
    poses: torch.Tensor, reference: torch.Tensor, mean: torch.Tensor, center: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return centres less `mean`, camera axes (*, 3) [m], and turns from the reference, object axes (*, 3) [rad]."""
    turn = log_so3(rotation_of(reference).mT @ rotation_of(poses))
    return origin_of(poses, center) - mean, turn


def draw_marginals(
    figure: Figure,
    layout: GridSpec,
    poses: torch.Tensor,
    weights: torch.Tensor,
    best: torch.Tensor,
    true: torch.Tensor | None,
    model: ObjectModel,
) -> None:
    """Draw six weighted histograms: shifts from the mean, camera axes; turns from the estimate, object axes."""
    center = model.center.cpu().double()
    mean = (weights[:, None] * origin_of(poses, center)).sum(0)
    parts = [shifts_and_turns(p, best, mean, center) for p in (poses, best, true) if p is not None]
    labels = ("right", "down", "away")
    for row, (scale, unit) in enumerate(((1000.0, "mm"), (180 / math.pi, "degrees"))):
        for i in range(3):
            axes = figure.add_subplot(layout[row, 2 * i : 2 * i + 2])
            marks = [float(part[row][i]) * scale for part in parts[1:]]
            histogram(axes, parts[0][row][:, i].numpy() * scale, weights.numpy(), marks)
            if row == 0:
                axes.set_title(f"Shift of the centre {labels[i]} (camera {_NAMES[i]})", fontsize=11)
                axes.set_xlabel(f"from the belief's mean [{unit}]", fontsize=9)
            else:
                axes.set_title(f"Turn about the object's {_NAMES[i]}", fontsize=11)
                axes.set_xlabel(f"from the estimate [{unit}]", fontsize=9)
            if i == 0:
                axes.set_ylabel("share of the belief", fontsize=9)


def histogram(axes: Axes, values: np.ndarray, weights: np.ndarray, marks: list[float], bins: int = 25) -> None:
    """Draw a weighted histogram of the middle 95 % and a margin; what lies beyond is told in words.

    marks: the estimate's value, and the truth's where it is known; both are always within the picture.
    """
    order = np.argsort(values)
    mass = np.cumsum(weights[order])
    low, high = (float(values[order][min(int(np.searchsorted(mass, q)), len(values) - 1)]) for q in (0.025, 0.975))
    margin = max(0.3 * (high - low), 1e-2)
    low, high = min(low - margin, *marks), max(high + margin, *marks)
    pad = 0.02 * (high - low)
    mass, edges = np.histogram(values, np.linspace(low - pad, high + pad, bins + 1), weights=weights)
    axes.stairs(mass, edges, fill=True, color=_MASS)  # one patch: bars of their own take ten times as long
    for value, colour, style in zip(marks, (_BEST, _TRUE), ("-", "--"), strict=False):
        axes.axvline(value, color=colour, linestyle=style, linewidth=1.8)
    beyond = float(weights[(values < low - pad) | (values > high + pad)].sum())
    if beyond >= 5e-4:
        said = axes.text(0.98, 0.96, f"{beyond:.1%} beyond", transform=axes.transAxes, ha="right", va="top", fontsize=8)
        said.set_bbox({"facecolor": "white", "alpha": 0.8, "linewidth": 0, "pad": 1})
    axes.set_xlim(low - pad, high + pad)
    axes.set_ylim(0, 1.15 * max(float(mass.max()), 1e-6))
    axes.locator_params(nbins=4)
    axes.tick_params(labelsize=8)
    axes.spines[["top", "right"]].set_visible(False)
