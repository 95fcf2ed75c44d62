"""Search a magnified window of the image where the object is small in it.

A network sees little of an object of a few cells, and learns most from larger ones. Where the first
steps of the filter agree on a place, and the object is small there, the image's part about it is
magnified and the filter runs on that. Where they do not agree, the filter runs to its end on the
whole image, and once more about its answer where that is small. A window is an image of another
camera: its poses are those of the whole image.
"""

from copy import copy
from itertools import islice
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Generator, Tensor

from posefilter.confidence.second_look import LEAST_DEPTH, measure_worth, read_objectness
from posefilter.data.resize import resize_depth
from posefilter.errors import UserError
from posefilter.filters.loop import ParticleFilter
from posefilter.filters.traces import map_traces
from posefilter.geometry.camera import project, resize_intrinsics
from posefilter.geometry.pose import origin_of
from posefilter.nets.pose_votes import has_depth
from posefilter.protocols import Encoding
from posefilter.types import Batch, ObjectModel, Particles, Trace

LEAST_ZOOM, MOST_ZOOM = 1.2, 4.0  # less gains nothing, more is blurred
PART_ZOOM = 2.0  # of the parts in which a doubtful object is looked for
STEPS = 3  # of the filter, after which particles that agree are near the object
HEAVIEST = 200  # particles that a place may be about
AGREED = 0.7  # weight of the particles within half a diameter of one of them


def with_encoding(method: Any, encoding: Encoding) -> Any:
    """Return a method whose images are encoded already.

    It is a copy, whose class has all that protocols ask for: from Python 3.12 on `isinstance` does
    not see what `__getattr__` would find.
    """
    out = copy(method)
    vars(out).update(vars(method))  # with its trainer, which Lightning leaves out of copies
    out.encode = lambda batch: encoding
    return out


def check_zoom(method: Any) -> None:
    """Raise UserError where windows are asked of a method or a filter that cannot search them."""
    if getattr(method.filter, "magnified_width", None) is None:
        return
    if "pose_space" not in method.capabilities:
        raise UserError(
            "filter.magnified_width: needs a method whose particles are poses, such as "
            f"pose_pf; those of {type(method).__name__} are places in one image"
        )
    if type(method.filter).forward is not ParticleFilter.forward:
        raise UserError(
            f"filter.magnified_width: {type(method.filter).__name__} has a forward() of its "
            "own, which windows would not run; choose null"
        )


def search(
    method: Any,
    batch: Batch,
    generator: Generator,
    encoding: Encoding = None,
    particle_filter: ParticleFilter | None = None,
) -> Trace:
    """Run a filter on B images, on magnified windows of those in which the object is small.

    Where it is small in none the trace is that of the filter alone, bit for bit; where it is in
    some, the others are searched by other random draws.

    Args:
        method: A method whose particles are poses.
        batch: The images; mask and pose are not used.
        generator: Draws the particles.
        encoding: What `encode` returns of them, where it is known.
        particle_filter: The filter; None: the method's own.

    Returns:
        The trace, with the encoding of the whole images. Log-likelihoods are those of what was
        searched.
    """
    run = method.filter if particle_filter is None else particle_filter
    target: float | None = getattr(run, "magnified_width", None)
    if target is None:
        return run(
            batch, method if encoding is None else with_encoding(method, encoding), generator
        )
    encoding = method.encode(batch) if encoding is None else encoding
    object_model = method.object_model
    steps = run.iterate(batch, encoding, method, generator)
    begun = list(islice(steps, STEPS))
    centers, weight = find_place(begun[-1].particles, object_model)
    zoom = measure_zoom(centers, batch, object_model, target)
    small = (zoom > 1) & (weight >= AGREED)
    whole: Trace | None = None
    if not small.all():
        if small.any():
            whole = run(select(batch, ~small), method, generator)
        else:  # it goes on as if nobody had looked
            whole = run.finish([*begun, *steps], encoding, method, generator)
        centers = centers.clone()
        centers[~small] = origin_of(whole.belief.best, object_model.center.to(centers.device))
        zoom = measure_zoom(centers, batch, object_model, target)
        late = ~small & (zoom > 1)
        if not (small | late).any():
            return whole._replace(encoding=encoding)
        others = ~late[~small]
        whole, small = map_traces(lambda x: x[others], whole), small | late
    pixels = project(centers[:, None], batch.intrinsics)[:, 0]
    view = magnify(select(batch, small), pixels[small], zoom[small])
    near: Trace = run(view, method, generator)
    return merge(whole, near, small)._replace(encoding=encoding)


def choose_part(method: Any, image: Batch) -> Batch | None:
    """Return the part of one image in which the network is surest of the object when it sees it
    twice as large; None where no part has depth, or the method's encoding has no objectness.

    Nine parts overlap by half, so that one of them shows an object of a quarter of the image whole.
    """
    height, width = image.rgb.shape[-2:]
    centers = [
        ((width - 1) * u, (height - 1) * v) for v in (0.25, 0.5, 0.75) for u in (0.25, 0.5, 0.75)
    ]
    pixels = image.intrinsics.new_tensor(centers)
    copies = Batch(*(x.expand(len(pixels), *x.shape[1:]) for x in image))
    windows = magnify(copies, pixels, pixels.new_full((len(pixels),), PART_ZOOM))
    has_depth = _has_depth(windows)
    if not has_depth.any():
        return None
    windows = select(windows, has_depth)
    encoding = method.encode(windows)
    if read_objectness(encoding) is None:
        return None
    surest = int(measure_worth(encoding).argmax())
    return Batch(*(x[surest : surest + 1] for x in windows))


def find_place(particles: Particles, object_model: ObjectModel) -> tuple[Tensor, Tensor]:
    """Return the place with the most weight within half a diameter of it, (B, 3) of the object's
    center in camera axes [m], and that weight, (B,) in [0, 1].
    """
    centers = origin_of(particles.state, object_model.center.to(particles.state.device))
    weights = particles.log_weights.exp()
    heaviest = weights.topk(min(HEAVIEST, weights.shape[1])).indices
    about = centers.gather(1, heaviest[..., None].expand(-1, -1, 3))
    near = torch.cdist(about, centers) < object_model.diameter / 2  # (B, M, N)
    most, index = (near * weights[:, None]).sum(-1).max(1)
    near_weights = near[torch.arange(len(index), device=index.device), index] * weights
    mean = (near_weights[..., None] * centers).sum(1) / near_weights.sum(1, keepdim=True)
    return mean, most


def measure_zoom(
    centers: Tensor, batch: Batch, object_model: ObjectModel, magnified_width: float
) -> Tensor:
    """Return how much images are magnified for an object at `centers`, (B,): 1 where it is not
    small, not before the camera, or where hardly a pixel about it has depth.

    Args:
        centers: (B, 3) of the object, in camera axes [m].
        batch: The images.
        object_model: The object.
        magnified_width: Its diameter after that, in widths of the image.
    """
    z = centers[:, 2]
    diameter = batch.intrinsics[:, 0, 0] * object_model.diameter / z.clamp_min(1e-3)  # [px]
    zoom = (magnified_width * batch.rgb.shape[-1] / diameter).clamp_max(MOST_ZOOM)
    zoom = torch.where((z > 0) & (zoom >= LEAST_ZOOM), zoom, 1.0)
    pixels = project(centers[:, None], batch.intrinsics)[:, 0]
    small = zoom > 1
    if small.any():
        view = magnify(select(batch, small), pixels[small], zoom[small])
        zoom[small] = torch.where(_has_depth(view), zoom[small], 1.0)
    return zoom


def _has_depth(view: Batch) -> Tensor:
    """Return in which images there is depth to start from, (B,) bool: in some pixels, and in one of
    the proposal network's cells.
    """
    enough = (view.depth > 0).flatten(1).float().mean(1) >= LEAST_DEPTH
    return enough & has_depth(view)


def magnify(batch: Batch, pixels: Tensor, zoom: Tensor) -> Batch:
    """Return windows of images, magnified to the images' size.

    A window is as many whole pixels as `zoom` makes of it, about `pixels` and inside of the image.

    Args:
        batch: The images; their masks and poses are kept.
        pixels: (B, 2) centers of the windows [px].
        zoom: (B,) magnification, 1 or more.
    """
    height, width = batch.rgb.shape[-2:]
    color, depth, mask, cameras = [], [], [], []
    for i in range(len(pixels)):
        (u, v), factor = pixels[i].tolist(), float(zoom[i])
        rows, columns = _place(v, height, factor), _place(u, width, factor)
        part = slice(None), rows, columns
        color.append(
            F.interpolate(
                batch.rgb[i][part][None], (height, width), mode="bilinear", align_corners=False
            )
        )
        z = resize_depth(batch.depth[i][part][0].cpu().numpy(), height, width)
        depth.append(torch.from_numpy(np.ascontiguousarray(z)).to(batch.depth))
        mask.append(F.interpolate(batch.mask[i][part][None].float(), (height, width)) > 0.5)
        K = batch.intrinsics[i].clone()
        K[:2, 2] -= K.new_tensor([columns.start, rows.start])
        scales = width / (columns.stop - columns.start), height / (rows.stop - rows.start)
        cameras.append(resize_intrinsics(K, *scales))
    return batch._replace(
        rgb=torch.cat(color),
        depth=torch.stack(depth)[:, None],
        mask=torch.cat(mask),
        intrinsics=torch.stack(cameras),
    )


def _place(center: float, size: int, zoom: float) -> slice:
    """Return the pixels of a window along one side of the image."""
    count = min(size, max(1, round(size / zoom)))
    first = min(max(0, round(center - (count - 1) / 2)), size - count)
    return slice(first, first + count)


def select(batch: Batch, rows: Tensor) -> Batch:
    """Return some images of a batch; rows (B,) bool."""
    return Batch(*(x[rows] for x in batch))


def merge(first: Trace | None, second: Trace, is_second: Tensor) -> Trace:
    """Return the trace of images that were searched in two parts.

    Args:
        first: Of the images that are not the second's; None where there are none.
        second: Of the others.
        is_second: (B,) bool.
    """
    if first is None:
        return second
    order = torch.cat([(~is_second).nonzero()[:, 0], is_second.nonzero()[:, 0]]).argsort()
    return map_traces(lambda a, b: torch.cat([a, b])[order], first, second)
