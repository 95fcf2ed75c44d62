"""The likelihood of poses without gradient, several times faster than `PoseLikelihood` itself.

`PoseLikelihood` is the reference: it is what is trained, and what this file must equal up to
rounding. Here the same numbers are computed in another order. What depends on the image alone is
tabulated once. The inputs of all points lie feature by feature in one buffer, each written by
operations on whole rows. The noise level is folded into the first layer's weights, and ReLUs into
matrix products. The network goes over points in parts: on a CPU those that fit into its cache, on a
GPU as many as bound its memory.
"""

import math
import os
from functools import lru_cache
from importlib.util import find_spec
from shutil import which
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor, nn

from posefilter import cuda_graphs
from posefilter.errors import UserError
from posefilter.geometry.camera import project
from posefilter.geometry.lookup import argmin
from posefilter.geometry.pose import origin_of, rotation_of
from posefilter.nets.cache import ModuleCache
from posefilter.nets.coordinates import STRIDE, Context
from posefilter.nets.layers import ResnetFC
from posefilter.nets.linear import list_onednn_types

if TYPE_CHECKING:
    from posefilter.nets.likelihood import Pixels, PoseLikelihood

# points that the network takes at once
PART, GPU_PART = 4096, 1 << 18
# points from which a GPU's kernels are worth their seconds of compiling, and whose inputs they keep
KERNEL_POINTS = 1 << 17, 1 << 24
_LEAST = 1e-12  # added to the shares of fragments, so that their sum can be divided by


class Tables(NamedTuple):
    """What depends on the images alone, as float32 rows for gathering; images follow each other."""

    fragments: Tensor  # (B * h * w * K, 4) share of a fragment, and its position times the share
    smooth: Tensor  # (B * H / 2 * W / 2, 2 + C) membership, logit / 8, features


def applies(device: torch.device) -> bool:
    """Return whether poses can be scored here: without gradient, on a CPU or by CUDA, not traced
    for export.
    """
    plain = not torch.is_grad_enabled() and not torch.compiler.is_compiling()
    return plain and device.type in ("cpu", "cuda")


def missing_context() -> UserError:
    """Return the error of a likelihood with context whose points have none."""
    return UserError(
        "model/likelihood: this one reads the proposal network; choose model/proposals=dense or "
        "model/likelihood=pointwise"
    )


def score_on_gpu(
    likelihood: "PoseLikelihood",
    image: "Pixels",
    poses: Tensor,
    sigma: Tensor,
    center: Tensor,
    radius: float,
    noise: Tensor,
    dtype: torch.dtype,
) -> Tensor:
    """Score poses with the term of their surfaces, as a graph where that has been recorded.

    Arguments and result as of `score`; the term is the one of `PoseLikelihood.judge_surface`.
    """
    context, tables = image.context, _find_tables(likelihood, image)
    parts = [poses, sigma, center, noise, image.values, image.intrinsics]
    if context is not None and tables is not None:
        parts += [context.smooth, context.centers, *tables]

    def work(poses: Tensor, sigma: Tensor, center: Tensor, noise: Tensor, *rest: Tensor) -> Tensor:
        own = image._replace(values=rest[0], intrinsics=rest[1])
        if context is not None and tables is not None:
            inner = context._replace(smooth=rest[2], centers=rest[3])
            own = own._replace(context=inner, tables=Tables(*rest[4:]))
        found = score(likelihood, own, poses, sigma, center, radius, noise, dtype)
        return found + likelihood.judge_surface(own, poses, sigma, center, radius)

    if not cuda_graphs.applies(*parts):
        return work(*parts)
    grid = None if context is None else (context.grid, context.columns)
    key = (image.size, grid, radius, dtype, likelihood.ray, cuda_graphs.describe(*parts))
    learned = [*likelihood.parameters(), *likelihood.buffers()]
    return RECORDINGS.get(likelihood, learned, key, cuda_graphs.Recording)(work, *parts)


def make_tables(context: Context) -> Tables:
    """Tabulate the coordinate network's output."""
    share = context.share.flatten()[:, None] + _LEAST
    logit, features = context.smooth[..., :1], context.smooth[..., 1:]
    smooth = torch.cat([torch.sigmoid(logit), logit / 8, features], dim=-1)
    fragments = torch.cat([share, share * context.position.flatten(0, 1)], dim=-1)
    return Tables(fragments, smooth.flatten(0, 1))


def _find_tables(likelihood: "PoseLikelihood", image: "Pixels") -> Tables | None:
    """Return the images' tables, made now where they were not before; None for a likelihood without
    context.
    """
    if likelihood.context is None:
        return None
    if image.tables is not None:
        return image.tables
    if image.context is None:
        raise missing_context()
    return make_tables(image.context)


def score(
    likelihood: "PoseLikelihood",
    image: "Pixels",
    poses: Tensor,
    sigma: Tensor,
    center: Tensor,
    radius: float,
    noise: Tensor,
    dtype: torch.dtype = torch.float32,
    spread: float = 0.6,
) -> Tensor:
    """Score poses at one noise level, as `PoseLikelihood.forward` does.

    Args:
        likelihood: Its weights are used.
        image: The images.
        poses: (B, N, 4, 4) camera_from_object [m].
        sigma: () noise level [m].
        center: (3,) the object's center [m].
        radius: The object's radius [m].
        noise: (B, 1, P, 2) standard normal.
        dtype: Type that the network is computed in; geometry is in that of the poses.
        spread: Standard deviation of the pixels, in projected radii.

    Returns:
        Log-likelihoods (B, N).
    """
    tables = _find_tables(likelihood, image)
    octaves = likelihood.octaves
    count = poses.shape[0] * poses.shape[1] * noise.shape[2]
    fits = dtype == torch.bfloat16 and KERNEL_POINTS[0] <= count <= KERNEL_POINTS[1]
    if tables is not None and fits and has_kernels(poses.device):
        scores, inside = _score_by_kernel(
            likelihood, image, tables, poses, sigma, center, radius, noise, spread
        )
        return likelihood.pool(scores, inside, likelihood.level(sigma.reshape(1)), poses, center)
    inputs, cells, inside = _inputs(octaves, image, tables, poses, center, radius, noise, spread)
    if sigma.device.type == "cpu":  # a video asks at the same few noise levels in every frame
        weights = CACHE.get(
            likelihood,
            _list_parameters(likelihood),
            (float(sigma), dtype),
            lambda: _Weights(likelihood, sigma, dtype),
        )
    else:  # a GPU would have to be waited for, to know the level
        weights = _Weights(likelihood, sigma, dtype)
    context = None if tables is None else tables.smooth
    scores = weights.score(inputs.flatten(1), context, cells).view(inside.shape)
    return likelihood.pool(scores, inside, likelihood.level(sigma.reshape(1)), poses, center)


@lru_cache(maxsize=8)
def has_kernels(device: torch.device) -> bool:
    """Return whether a device has kernels of its own (`nets/kernels.py`): a GPU that multiplies
    bfloat16, where Triton and the C compiler that it needs are installed.
    """
    if device.type != "cuda" or torch.cuda.get_device_capability(device) < (8, 0):
        return False
    return find_spec("triton") is not None and bool(os.environ.get("CC") or which("gcc"))


def _score_by_kernel(
    likelihood: "PoseLikelihood",
    image: "Pixels",
    tables: Tables,
    poses: Tensor,
    sigma: Tensor,
    center: Tensor,
    radius: float,
    noise: Tensor,
    spread: float,
) -> tuple[Tensor, Tensor]:
    """Return the points' scores (B, N, P), and which lie in the frame; arguments as of `score`."""
    from posefilter.nets import kernels  # Triton, where it is needed

    assert image.context is not None
    own = _Weights(likelihood, sigma, torch.float32)
    layers = kernels.pack(own.enter, own.context, own.blocks, own.floor, own.leave)
    about = image.context
    scores, inside = kernels.score_points(
        image.values,
        image.size,
        image.intrinsics,
        tables.fragments,
        tables.smooth,
        about.centers,
        about.grid,
        about.columns,
        STRIDE,
        poses,
        center,
        radius,
        noise,
        spread,
        likelihood.octaves,
        layers,
    )
    return scores.add_(own.last), inside


def _inputs(
    octaves: int,
    image: "Pixels",
    tables: Tables | None,
    poses: Tensor,
    center: Tensor,
    radius: float,
    noise: Tensor,
    spread: float,
) -> tuple[Tensor, Tensor | None, Tensor]:
    """Return the inputs of all points but the context's features, (F, B, N, P) in the order of
    `_columns`; the rows of `Tables.smooth` (B * N * P); and which points lie in the frame (B, N,
    P).
    """
    H, W = image.size
    (B, N), P = poses.shape[:2], noise.shape[2]
    middle, R = origin_of(poses, center), rotation_of(poses)
    fx, fy, cx, cy = image.camera
    pixel = project(middle, image.intrinsics)[..., None]
    reach = (spread * radius * fx[..., 0] / middle[..., 2].clamp_min(0.1))[..., None]
    u = torch.addcmul(pixel[..., 0, :], reach, noise[..., 0]).round_()
    v = torch.addcmul(pixel[..., 1, :], reach, noise[..., 1]).round_()
    inside = (u >= 0) & (u < W) & (v >= 0) & (v < H)
    u.clamp_(0, W - 1)
    v.clamp_(0, H - 1)
    number = torch.arange(B, device=poses.device)[:, None, None]
    row, column = v.long(), u.long()
    values = image.values.flatten(0, 1).index_select(
        0, torch.add(row * W + column, number, alpha=H * W).flatten()
    )
    values = values.view(B, N, P, 4)

    ways = 3 * (2 * octaves + 1)
    buffer = poses.new_empty(ways + 7 + (0 if tables is None else 7), B, N, P)
    z, known = values[..., 3], values[..., 3] > 0
    x, y = (u - cx) / fx, (v - cy) / fy
    square = (x * x).addcmul_(y, y).add_(1)
    mx, my, mz = middle[..., None].unbind(-2)
    along = (x * mx).addcmul_(y, my).add_(mz).div_(square)
    s = torch.where(known, z, along)
    offset = (x * s - mx, y * s - my, s - mz)
    unit = square.rsqrt_()
    position = poses.new_empty(3, B, N, P)
    for axis in range(3):
        a, b, c = R[..., axis, None].unbind(-2)
        at = torch.mul(offset[0], a, out=position[axis])
        at.addcmul_(offset[1], b).addcmul_(offset[2], c).div_(radius)
        way = torch.mul(x, a, out=buffer[ways + 3 + axis])
        way.addcmul_(y, b).add_(c).mul_(unit)
        torch.mul(values[..., axis], 2, out=buffer[ways + axis]).sub_(1)
    buffer[ways + 6] = known

    torch.mul(_contract(position), 0.5, out=buffer[:3])
    if octaves:
        angle = buffer[:3] * math.pi
        sines = buffer[3 : 3 + 3 * octaves].unflatten(0, (octaves, 3))
        cosines = buffer[3 + 3 * octaves : ways].unflatten(0, (octaves, 3))
        torch.sin(angle, out=sines[0])
        torch.cos(angle, out=cosines[0])
        for k in range(1, octaves):  # the double angle
            torch.mul(sines[k - 1], cosines[k - 1], out=sines[k]).mul_(2)
            torch.mul(sines[k - 1], sines[k - 1], out=cosines[k]).mul_(-2).add_(1)
    if tables is None:
        return buffer, None, inside

    assert image.context is not None
    found = _predict(image.context, tables, u, v, position)
    total = found[..., 0]
    torch.log(total.clamp_min(1e-6), out=buffer[ways + 7]).div_(5)
    error = buffer[ways + 11 :]
    for axis in range(3):
        torch.div(found[..., 1 + axis], total, out=error[axis]).sub_(position[axis])
    buffer[ways + 8 : ways + 11] = _contract(error)
    _asinh_(error.mul_(10))
    columns, rows = image.context.columns, image.context.smooth.shape[1]
    cells = (row // 2) * columns + column // 2
    return buffer, torch.add(cells, number, alpha=rows).flatten(), inside


def _contract(x: Tensor) -> Tensor:
    """`contract` of vectors whose components are the first axis.  (3, *) -> (3, *)."""
    far = (x[0] * x[0]).addcmul_(x[1], x[1]).addcmul_(x[2], x[2]).sqrt_().clamp_min_(1e-6)
    return x * torch.where(far > 2, (3 - 2 / far) / far, 1.0)


def _asinh_(x: Tensor) -> Tensor:
    """torch.asinh_, which goes number by number on CPUs, by operations that are vectorized."""
    size = x.abs()
    size += (size * size).add_(1).sqrt_()
    return torch.copysign(size.log_(), x, out=x)


def _predict(context: Context, tables: Tables, u: Tensor, v: Tensor, position: Tensor) -> Tensor:
    """Sample fragments' shares and positions at pixels, as `query` does.

    (B, N, P) x 2 [px], object points of the hypothesis (3, B, N, P) from the center, in radii ->
    (B, N, P, 4): the share, and the predicted position times the share.
    """
    (h, w), (B, K) = context.grid, context.centers.shape[:2]
    points = position.flatten(2).permute(1, 2, 0)
    square = context.centers.square().sum(-1)[:, None]
    fragment = argmin(torch.baddbmm(square, points, context.centers.mT, alpha=-2))
    fragment += torch.arange(B, device=u.device)[:, None] * (h * w * K)
    x = ((u + 0.5) / STRIDE - 0.5).clamp_(0, w - 1).flatten(1)
    y = ((v + 0.5) / STRIDE - 0.5).clamp_(0, h - 1).flatten(1)
    left, top = x.floor(), y.floor()
    x, y = x.sub_(left), y.sub_(top)
    columns = [at.long() * K for at in (left, (left + 1).clamp_max_(w - 1))]
    rows = [(at.long() * (w * K)).add_(fragment) for at in (top, (top + 1).clamp_max_(h - 1))]
    index = torch.stack([row + column for row in rows for column in columns], dim=-1)
    near = torch.stack([b * a for b in (1 - y, y) for a in (1 - x, x)], dim=-1)
    found: Tensor = torch.nn.functional.embedding_bag(
        index.flatten(0, 1), tables.fragments, mode="sum", per_sample_weights=near.flatten(0, 1)
    )
    return found.view(*u.shape, 4)


def _columns(octaves: int) -> list[int]:
    """Return where `PoseLikelihood` has the inputs in the order of `_inputs`; sines and cosines are
    octave by octave here, and axis by axis there.
    """
    waves = [3 + axis * octaves + k for k in range(octaves) for axis in range(3)]
    return [0, 1, 2, *waves, *(3 * octaves + i for i in waves)]


@lru_cache(maxsize=32)
def _to_index(columns: tuple[int, ...], device: torch.device) -> Tensor:
    """Return columns as an index on a device."""
    return torch.tensor(columns, dtype=torch.int64, device=device)


def _list_parameters(likelihood: "PoseLikelihood") -> list[Tensor]:
    """Return what `_Weights` depends on; `parameters()` searches all modules, a ms a frame."""
    layers = [likelihood.enter, *likelihood.modulate, likelihood.leave]
    for block in likelihood.blocks:
        assert isinstance(block, ResnetFC)
        layers += [block.inner, block.outer]
    own = [layer for layer in layers if isinstance(layer, nn.Linear)]
    return [one for layer in own for one in (layer.weight, layer.bias)]


class _Weights:
    """The likelihood's network at one noise level."""

    def __init__(self, likelihood: "PoseLikelihood", sigma: Tensor, dtype: torch.dtype) -> None:
        level = likelihood.level(sigma.reshape(()))
        gain, bias = likelihood.modulate(level).chunk(2)
        enter = likelihood.enter
        weight = enter.weight * (1 + gain)[:, None]
        ways = 3 * (2 * likelihood.octaves + 1)
        if not likelihood.ray:
            weight[:, ways + 3 : ways + 6] = 0
        plain = ways + 7
        order = [*_columns(likelihood.octaves), *range(ways, plain)]
        rest: list[int] = []
        if likelihood.context is not None:
            # share, then both forms of the error; membership and logit are in the table
            order += [plain, *range(plain + 3, plain + 9)]
            rest = [plain + 1, plain + 2, *range(plain + 9, weight.shape[1])]
        self.dtype = dtype
        self.enter = weight[:, _to_index(tuple(order), weight.device)].to(dtype)
        self.context = weight[:, _to_index(tuple(rest), weight.device)].to(dtype)
        # the residual stream is kept without its bias, which is known: relu(x + b) = max(x, -b) + b
        stream = enter.bias * (1 + gain) + bias
        self.blocks: list[tuple[Tensor, Tensor, Tensor, Tensor]] = []
        for block in likelihood.blocks:
            assert isinstance(block, ResnetFC)
            inner, outer = block.inner, block.outer
            inner_bias = inner.bias + inner.weight @ stream
            floor, stream = -stream, stream + outer.bias
            parts = (floor, inner.weight, inner_bias, outer.weight.t())
            self.blocks.append(tuple(x.to(dtype) for x in parts))  # type: ignore[arg-type]
        leave = likelihood.leave
        self.floor, self.leave = (-stream).to(dtype), leave.weight[0].to(dtype)
        self.last = leave.bias + leave.weight @ stream

    def score(self, inputs: Tensor, table: Tensor | None, cells: Tensor | None) -> Tensor:
        """Score points.  (F, points), (rows, 2 + C), (points,) -> (points,)."""
        out = inputs.new_empty(inputs.shape[1])
        size = PART if inputs.device.type == "cpu" else GPU_PART
        for start in range(0, len(out), size):
            part = slice(start, start + size)
            x = torch.mm(inputs[:, part].to(self.dtype).t(), self.enter.t())
            if table is not None and cells is not None:
                rows = table.index_select(0, cells[part]).to(self.dtype)
                x.addmm_(rows, self.context.t())
            active = torch.empty_like(x)
            for floor, inner, bias, outer in self.blocks:
                torch.maximum(x, floor, out=active)
                x.addmm_(_linear_relu(active, inner, bias), outer)
            torch.maximum(x, self.floor, out=active)
            out[part] = torch.mv(active, self.leave)
        return out.add_(self.last)


def _linear_relu(x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """relu(x W^T + b), in one operation where oneDNN or cuBLAS has it.  (m, k), (n, k), (n,) -> (m,
    n).
    """
    if x.dtype in _TYPES and x.device.type == "cpu":
        out: Tensor = torch.ops.mkldnn._linear_pointwise(x, weight, bias, "relu", [], "")
        return out
    return torch._addmm_activation(bias, x, weight.t())


_TYPES = list_onednn_types()
CACHE: ModuleCache[_Weights] = ModuleCache()
RECORDINGS: ModuleCache[cuda_graphs.Recording] = ModuleCache()
