"""The scores of image points by two kernels of a GPU: their inputs, and the network.

In `nets/fused.py` each operation reads and writes all points. Here a program takes some of them,
and keeps what is between in registers: the first kernel goes from poses to inputs, the second from
inputs to scores. Products are of bfloat16, with sums and the residual stream in float32. In one
kernel both were slower, since the registers did not suffice.

Triton compiles them at first use, which takes some seconds, and keeps them on disk.
"""

from typing import NamedTuple

import torch
import triton
import triton.language as tl
from torch import Tensor

_POINTS = 256  # of a program that makes inputs
_ROWS, _WARPS = 128, 8  # points of a program that runs the network, and its warps
_LEAST = 16  # of a product's sides


class Layers(NamedTuple):
    """A network's weights at one noise level, filled up with zeros to powers of two."""

    enter: Tensor  # (K, W) bfloat16
    context: Tensor  # (C, W) bfloat16
    floors: Tensor  # (blocks + 1, W) of the residual stream, before each block and at the end
    inner: Tensor  # (blocks, W, W) bfloat16
    bias: Tensor  # (blocks, W)
    outer: Tensor  # (blocks, W, W) bfloat16
    leave: Tensor  # (W,)


def pack(
    enter: Tensor,
    context: Tensor,
    blocks: list[tuple[Tensor, Tensor, Tensor, Tensor]],
    floor: Tensor,
    leave: Tensor,
    dtype: torch.dtype = torch.bfloat16,
) -> Layers:
    """Fill a network's weights up.

    Args:
        enter: (w, F) of the first layer.
        context: (w, c) of the first layer.
        blocks: Of each: floor (w,), inner weight (w, w), its bias (w,), outer weight, transposed
            (w, w).
        floor: (w,) of the last layer.
        leave: (w,) of the last layer.
        dtype: Of the products' operands.
    """
    (width, inputs), more = enter.shape, context.shape[1]
    W, K, C = (_fill(size) for size in (width, inputs, more))

    def put(x: Tensor, *size: int, dtype: torch.dtype = torch.float32) -> Tensor:
        out = torch.zeros(size, device=x.device, dtype=dtype)
        out[tuple(slice(0, one) for one in x.shape)] = x
        return out

    floors, inner, bias, outer = (torch.stack(parts) for parts in zip(*blocks, strict=True))
    floors, count = torch.cat([floors, floor[None]]), len(blocks)
    return Layers(
        put(enter.t(), K, W, dtype=dtype),
        put(context.t(), C, W, dtype=dtype),
        put(floors, count + 1, W),
        put(inner.mT, count, W, W, dtype=dtype),
        put(bias, count, W),
        put(outer, count, W, W, dtype=dtype),
        put(leave, W),
    )


def _fill(size: int) -> int:
    return max(_LEAST, triton.next_power_of_2(size))


def score_points(
    values: Tensor,
    size: tuple[int, int],
    intrinsics: Tensor,
    fragments: Tensor,
    smooth: Tensor,
    centers: Tensor,
    grid: tuple[int, int],
    columns: int,
    stride: int,
    poses: Tensor,
    center: Tensor,
    radius: float,
    noise: Tensor,
    spread: float,
    octaves: int,
    layers: Layers,
) -> tuple[Tensor, Tensor]:
    """Score the image points of poses.

    Args:
        values: (B, H * W, 4) red, green, blue in [0, 1], z-depth [m] (0 unknown).
        size: H, W.
        intrinsics: (B, 3, 3) [px].
        fragments: (B * h * w * K, 4) as of `fused.Tables`.
        smooth: (B * rows, c) as of `fused.Tables`.
        centers: (B, K, 3) of the fragments, in radii.
        grid: h, w of the coordinate network's output.
        columns: Of the smooth table.
        stride: Pixels of a cell of the coordinate network's output.
        poses: (B, N, 4, 4) camera_from_object [m].
        center: (3,) the object's center [m].
        radius: The object's radius [m].
        noise: (B, 1, P, 2) standard normal.
        spread: Standard deviation of the pixels, in projected radii.
        octaves: Of the position's Fourier features.
        layers: The network's weights.

    Returns:
        Scores (B, N, P) without the last layer's bias, and which points lie in the frame.
    """
    (B, N), P, K = poses.shape[:2], noise.shape[2], centers.shape[1]
    (filled, width), total = layers.enter.shape, B * N * P
    inputs = torch.empty(filled, total, device=poses.device, dtype=layers.enter.dtype)
    cells = torch.empty(total, device=poses.device, dtype=torch.int32)
    inside = torch.empty(B, N, P, dtype=torch.bool, device=poses.device)
    scores = poses.new_empty(B, N, P)
    given = (values, intrinsics, fragments, centers, poses, center, noise)
    _make_inputs[(triton.cdiv(total, _POINTS),)](
        *(one.contiguous() for one in given),
        inputs,
        cells,
        inside.view(torch.uint8),
        total,
        N,
        P,
        *size,
        *grid,
        columns,
        smooth.shape[0] // B,
        stride,
        radius,
        spread,
        FRAGMENTS=K,
        OCTAVES=octaves,
        FILLED=filled,
        POINTS=_POINTS,
        num_warps=4,
    )
    _run_network[(triton.cdiv(total, _ROWS),)](
        inputs,
        cells,
        smooth.contiguous(),
        *layers,
        scores,
        total,
        CONTEXT=smooth.shape[1],
        FILLED_CONTEXT=layers.context.shape[0],
        FILLED=filled,
        WIDTH=width,
        BLOCKS=len(layers.inner),
        ROWS=_ROWS,
        num_warps=_WARPS,
    )
    return scores, inside


@triton.jit
def _contract(x, y, z):
    far = tl.maximum(tl.sqrt(x * x + y * y + z * z), 1e-6)
    factor = tl.where(far > 2, (3 - 2 / far) / far, 1.0)
    return x * factor, y * factor, z * factor


@triton.jit
def _asinh(x):
    size = tl.abs(x)
    found = tl.log(size + tl.sqrt(size * size + 1))
    return tl.where(x < 0, -found, found)


@triton.jit
def _make_inputs(
    values,
    intrinsics,
    fragments,
    centers,
    poses,
    center,
    noise,
    inputs,
    cells,
    inside,
    total,
    N,
    P,
    H,
    W,
    GH,
    GW,
    COLUMNS,
    TABLE,
    STRIDE,
    radius,
    spread,
    FRAGMENTS: tl.constexpr,
    OCTAVES: tl.constexpr,
    FILLED: tl.constexpr,
    POINTS: tl.constexpr,
):
    """Write the inputs of points, (FILLED, total), in the order of `fused._inputs`; the rows of the
    smooth table; and which points lie in the frame.
    """
    at = tl.program_id(0) * POINTS + tl.arange(0, POINTS)
    ok = at < total
    number, point = tl.where(ok, at, 0) // P, tl.where(ok, at, 0) % P
    image = number // N

    # the pixel
    T = poses + number * 16
    R00, R01, R02, t0 = tl.load(T), tl.load(T + 1), tl.load(T + 2), tl.load(T + 3)
    R10, R11, R12, t1 = tl.load(T + 4), tl.load(T + 5), tl.load(T + 6), tl.load(T + 7)
    R20, R21, R22, t2 = tl.load(T + 8), tl.load(T + 9), tl.load(T + 10), tl.load(T + 11)
    c0, c1, c2 = tl.load(center), tl.load(center + 1), tl.load(center + 2)
    mx = R00 * c0 + R01 * c1 + R02 * c2 + t0
    my = R10 * c0 + R11 * c1 + R12 * c2 + t1
    mz = R20 * c0 + R21 * c1 + R22 * c2 + t2
    K = intrinsics + image * 9
    fx, fy, cx, cy = tl.load(K), tl.load(K + 4), tl.load(K + 2), tl.load(K + 5)
    over = tl.maximum(mz, 1e-3)
    reach = spread * radius * fx / tl.maximum(mz, 0.1)
    draw = noise + (image * P + point) * 2
    u = tl.floor(mx / over * fx + cx + reach * tl.load(draw) + 0.5)
    v = tl.floor(my / over * fy + cy + reach * tl.load(draw + 1) + 0.5)
    seen = (u >= 0) & (u < W) & (v >= 0) & (v < H)
    u = tl.minimum(tl.maximum(u, 0.0), W - 1.0)
    v = tl.minimum(tl.maximum(v, 0.0), H - 1.0)
    row, column = v.to(tl.int32), u.to(tl.int32)
    pixel = values + (image * (H * W) + row * W + column) * 4
    depth = tl.load(pixel + 3)
    tl.store(inside + at, seen.to(tl.uint8), mask=ok)
    tl.store(cells + at, image * TABLE + (row // 2) * COLUMNS + column // 2, mask=ok)

    # its point, from the object's center, and its ray, both in the object's frame
    known = depth > 0
    x, y = (u - cx) / fx, (v - cy) / fy
    square = x * x + y * y + 1
    s = tl.where(known, depth, (x * mx + y * my + mz) / square)
    ox, oy, oz = x * s - mx, y * s - my, s - mz
    p0 = (ox * R00 + oy * R10 + oz * R20) / radius
    p1 = (ox * R01 + oy * R11 + oz * R21) / radius
    p2 = (ox * R02 + oy * R12 + oz * R22) / radius
    unit = 1 / tl.sqrt(square)
    out = inputs + (3 * (2 * OCTAVES + 1)) * total + at
    for k in tl.static_range(3):
        tl.store(out + k * total, tl.load(pixel + k) * 2 - 1, mask=ok)
    tl.store(out + 3 * total, (x * R00 + y * R10 + R20) * unit, mask=ok)
    tl.store(out + 4 * total, (x * R01 + y * R11 + R21) * unit, mask=ok)
    tl.store(out + 5 * total, (x * R02 + y * R12 + R22) * unit, mask=ok)
    tl.store(out + 6 * total, known.to(tl.float32), mask=ok)

    # what the coordinate network says there of the nearest fragment
    fragment = tl.zeros((POINTS,), tl.int32)
    nearest = tl.full((POINTS,), float("inf"), tl.float32)
    one = centers + image * (FRAGMENTS * 3)
    for k in range(FRAGMENTS):
        f0, f1, f2 = tl.load(one + 3 * k), tl.load(one + 3 * k + 1), tl.load(one + 3 * k + 2)
        away = f0 * f0 + f1 * f1 + f2 * f2 - 2 * (p0 * f0 + p1 * f1 + p2 * f2)
        fragment = tl.where(away < nearest, k, fragment)
        nearest = tl.minimum(away, nearest)
    gx = tl.minimum(tl.maximum((u + 0.5) / STRIDE - 0.5, 0.0), GW - 1.0)
    gy = tl.minimum(tl.maximum((v + 0.5) / STRIDE - 0.5, 0.0), GH - 1.0)
    left, top = tl.floor(gx), tl.floor(gy)
    gx, gy = gx - left, gy - top
    left, top = left.to(tl.int32), top.to(tl.int32)
    right, bottom = tl.minimum(left + 1, GW - 1), tl.minimum(top + 1, GH - 1)
    first = fragments + (image * (GH * GW * FRAGMENTS) + fragment) * 4
    a = first + (top * GW + left) * (FRAGMENTS * 4)
    b = first + (top * GW + right) * (FRAGMENTS * 4)
    c = first + (bottom * GW + left) * (FRAGMENTS * 4)
    d = first + (bottom * GW + right) * (FRAGMENTS * 4)
    wa, wb, wc, wd = (1 - gy) * (1 - gx), (1 - gy) * gx, gy * (1 - gx), gy * gx
    share = wa * tl.load(a) + wb * tl.load(b) + wc * tl.load(c) + wd * tl.load(d)
    e0 = wa * tl.load(a + 1) + wb * tl.load(b + 1) + wc * tl.load(c + 1) + wd * tl.load(d + 1)
    e1 = wa * tl.load(a + 2) + wb * tl.load(b + 2) + wc * tl.load(c + 2) + wd * tl.load(d + 2)
    e2 = wa * tl.load(a + 3) + wb * tl.load(b + 3) + wc * tl.load(c + 3) + wd * tl.load(d + 3)
    e0, e1, e2 = e0 / share - p0, e1 / share - p1, e2 / share - p2
    tl.store(out + 7 * total, tl.log(tl.maximum(share, 1e-6)) / 5, mask=ok)
    near0, near1, near2 = _contract(e0, e1, e2)
    tl.store(out + 8 * total, near0, mask=ok)
    tl.store(out + 9 * total, near1, mask=ok)
    tl.store(out + 10 * total, near2, mask=ok)
    tl.store(out + 11 * total, _asinh(e0 * 10), mask=ok)
    tl.store(out + 12 * total, _asinh(e1 * 10), mask=ok)
    tl.store(out + 13 * total, _asinh(e2 * 10), mask=ok)
    for k in tl.static_range(3 * (2 * OCTAVES + 1) + 14, FILLED):
        tl.store(inputs + k * total + at, tl.zeros((POINTS,), tl.float32), mask=ok)

    # the position, with its Fourier features
    p0, p1, p2 = _contract(p0, p1, p2)
    _write_waves(inputs + at, total, p0 * 0.5, 0, OCTAVES, ok)
    _write_waves(inputs + at, total, p1 * 0.5, 1, OCTAVES, ok)
    _write_waves(inputs + at, total, p2 * 0.5, 2, OCTAVES, ok)


@triton.jit
def _write_waves(out, total, p, axis: tl.constexpr, OCTAVES: tl.constexpr, ok):
    """Write one axis of the position, and its sines and cosines: each octave's by the double angle
    of the one before.
    """
    tl.store(out + axis * total, p, mask=ok)
    sine, cosine = tl.sin(p * 3.141592653589793), tl.cos(p * 3.141592653589793)
    for k in tl.static_range(OCTAVES):
        tl.store(out + (3 + 3 * k + axis) * total, sine, mask=ok)
        tl.store(out + (3 + 3 * (OCTAVES + k) + axis) * total, cosine, mask=ok)
        sine, cosine = 2 * sine * cosine, 1 - 2 * sine * sine


@triton.jit
def _run_network(
    inputs,
    cells,
    smooth,
    enter,
    context,
    floors,
    inner,
    bias,
    outer,
    leave,
    scores,
    total,
    CONTEXT: tl.constexpr,
    FILLED_CONTEXT: tl.constexpr,
    FILLED: tl.constexpr,
    WIDTH: tl.constexpr,
    BLOCKS: tl.constexpr,
    ROWS: tl.constexpr,
):
    """Write the scores of points."""
    at = tl.program_id(0) * ROWS + tl.arange(0, ROWS)
    ok = at < total
    j, w, q = tl.arange(0, FILLED), tl.arange(0, WIDTH), tl.arange(0, FILLED_CONTEXT)
    tile = tl.load(inputs + j[None, :] * total + at[:, None], mask=ok[:, None], other=0.0)
    h = tl.dot(tile, tl.load(enter + j[:, None] * WIDTH + w[None, :]))
    cell = tl.load(cells + at, mask=ok, other=0)
    more = tl.load(
        smooth + cell[:, None] * CONTEXT + q[None, :], mask=(q < CONTEXT)[None, :], other=0.0
    ).to(enter.dtype.element_ty)
    h = tl.dot(more, tl.load(context + q[:, None] * WIDTH + w[None, :]), acc=h)
    square = w[:, None] * WIDTH + w[None, :]
    for n in tl.static_range(BLOCKS):
        active = tl.maximum(h, tl.load(floors + n * WIDTH + w)[None, :])
        active = active.to(enter.dtype.element_ty)
        middle = tl.dot(active, tl.load(inner + n * WIDTH * WIDTH + square))
        middle = tl.maximum(middle + tl.load(bias + n * WIDTH + w)[None, :], 0.0)
        middle = middle.to(enter.dtype.element_ty)
        h = tl.dot(middle, tl.load(outer + n * WIDTH * WIDTH + square), acc=h)
    active = tl.maximum(h, tl.load(floors + BLOCKS * WIDTH + w)[None, :])
    tl.store(scores + at, tl.sum(active * tl.load(leave + w)[None, :], 1), mask=ok)
