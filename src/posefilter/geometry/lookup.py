"""Sampling of images and masks at pixel positions.  Pixel centers are at integer (u, v)."""

import torch
import torch.nn.functional as F
from torch import Tensor


def patch_offsets(size: int, device: torch.device | None = None) -> Tensor:
    """Return the pixel offsets (u, v) of a patch, in raster order.  -> (size * size, 2) [px]."""
    side = torch.arange(size, device=device) - (size - 1) // 2
    return torch.stack(torch.meshgrid(side, side, indexing="xy"), dim=-1).reshape(-1, 2)


def nearest_pixel(pixels: Tensor) -> Tensor:
    """Round to whole pixels, halves upwards.

    (*, 2) [px] -> (*, 2) int64; positions far off the frame are clamped so that none overflows.
    """
    return (pixels.detach() + 0.5).floor().clamp(-1e6, 1e6).long()


def nearest_inside(pixels: Tensor, height: int, width: int) -> Tensor:
    """Return the nearest whole pixel of the frame to each position.

    (*, 2) [px] -> (*, 2) int64.
    """
    corner = torch.tensor([width - 1, height - 1], device=pixels.device)
    return torch.minimum(nearest_pixel(pixels).clamp_min(0), corner)


def is_off_frame(pixels: Tensor, width: int, height: int) -> Tensor:
    """Return which positions lie beyond the frame's edges.  (*, 2) [px] -> (*) bool."""
    u, v = pixels.unbind(-1)
    return (u < -0.5) | (u > width - 0.5) | (v < -0.5) | (v > height - 0.5)


def gather_pixels(image: Tensor, index: Tensor) -> Tensor:
    """Gather whole pixels, zero outside the frame.

    (B, C, H, W), (B, P, 2) int64 as (u, v) -> (B, P, C).
    """
    C, H, W = image.shape[1:]
    u, v = index.unbind(-1)
    inside = (u >= 0) & (u < W) & (v >= 0) & (v < H)
    flat = (v.clamp(0, H - 1) * W + u.clamp(0, W - 1))[:, None].expand(-1, C, -1)
    return (image.flatten(2).gather(2, flat) * inside[:, None]).transpose(1, 2)


def gather_rows(table: Tensor, index: Tensor) -> Tensor:
    """Gather rows of each image's table.  (B, R, C), (B, P) int64 -> (B, P, C).

    Without a gradient whole rows are copied, which is several times faster; with one the order in
    which gradients are summed stays that of `gather`.
    """
    if torch.is_grad_enabled() and table.requires_grad:
        return table.gather(1, index[..., None].expand(-1, -1, table.shape[-1]))
    B, R, C = table.shape
    first = torch.arange(B, device=index.device)[:, None] * R
    return table.reshape(B * R, C).index_select(0, (index + first).flatten()).unflatten(0, (B, -1))


def sample(image: Tensor, pixels: Tensor, stride: int = 1, padding: str = "zeros") -> Tensor:
    """Sample an image, or a map of `stride` pixels a cell, bilinearly.

    Differentiable in image and positions. The center of cell i lies at pixel i stride +
    (stride - 1) / 2.

    Args:
        image: (B, C, h, w).
        pixels: (B, P, 2) [px].
        stride: Pixels of a cell.
        padding: "zeros", or "border" for the values at the edge.

    Returns:
        Values (B, P, C).
    """
    h, w = image.shape[-2:]
    cells = (pixels - (stride - 1) / 2) / stride
    scale = pixels.new_tensor([max(w - 1, 1), max(h - 1, 1)])
    grid = (cells / scale * 2 - 1)[:, :, None]
    values = F.grid_sample(image, grid, padding_mode=padding, align_corners=True)
    return values[..., 0].transpose(1, 2)


def overlaps_mask(mask: Tensor, pixels: Tensor, size: int = 1) -> Tensor:
    """Return whether the size x size patch at each position overlaps the mask.

    (B, 1, H, W) bool, (B, P, 2) [px] -> (B, P) bool.
    """
    # far fewer pixels than the frame has
    index = nearest_pixel(pixels)[:, :, None] + patch_offsets(size, pixels.device)
    inside = gather_pixels(mask, index.flatten(1, 2))
    return inside.unflatten(1, index.shape[1:3]).flatten(2).any(-1)


def erode(mask: Tensor, margin_px: int) -> Tensor:
    """Erode masks by a square of `margin_px`; a mask that would vanish is kept.

    (B, 1, H, W) bool -> the same shape.
    """
    if margin_px == 0:
        return mask
    side = 2 * margin_px + 1
    inner = _all_within(_all_within(mask, side).mT, side).mT  # an axis at a time
    return torch.where(inner.flatten(1).any(1)[:, None, None, None], inner, mask)


def _all_within(mask: Tensor, side: int) -> Tensor:
    """Return where all of an odd number of neighbors along the last axis are in the mask; there is
    none beyond the frame.

    Running sums take as long for many neighbors as for few.  (*, n) bool -> the same shape.
    """
    outside = F.pad((~mask).float(), (side // 2, side // 2), value=1.0)
    sums = F.pad(outside.cumsum(-1), (1, 0))
    return sums[..., side:] == sums[..., :-side]


def mask_pixels(mask: Tensor, max_pixels: int | None = None) -> tuple[Tensor, Tensor]:
    """List each mask's pixels in raster order, padded to the longest list.

    Args:
        mask: (B, 1, H, W) bool.
        max_pixels: Maximum number; larger masks are subsampled evenly.

    Returns:
        Pixels (B, M, 2) [px] as (u, v), and which are not padding (B, M) bool.
    """
    found = []
    for one in mask[:, 0]:
        pixels = one.nonzero().flip(-1).float()
        if max_pixels is not None and len(pixels) > max_pixels:
            every = torch.linspace(0, len(pixels) - 1, max_pixels, device=pixels.device)
            pixels = pixels[every.long()]
        found.append(pixels)
    longest = max(1, *(len(f) for f in found))
    positions = torch.stack([F.pad(f, (0, 0, 0, longest - len(f))) for f in found])
    counts = torch.tensor([len(f) for f in found], device=mask.device)
    return positions, torch.arange(longest, device=mask.device) < counts[:, None]


def argmin(values: Tensor) -> Tensor:
    """Return the first index of each row's minimum.  (*, n) -> (*) int64.

    On the CPU it uses numpy's vectorized argmin, which is faster than PyTorch's.
    """
    if values.device.type != "cpu" or torch.compiler.is_compiling():
        return values.argmin(-1)
    return torch.from_numpy(values.detach().numpy().argmin(-1))


def nearest_mask_pixel(mask: Tensor, pixels: Tensor, chunk: int | None = None) -> Tensor:
    """Return the mask pixel nearest to each position; the position itself where a mask is empty.

    A position on the mask has its own pixel. The nearest one to any other lies on the mask's rim,
    so a search over the rim is exact. Without gradient.

    Args:
        mask: (B, 1, H, W) bool.
        pixels: (B, P, 2) positions [px].
        chunk: Distances held at once; None: on a CPU as many as its cache holds, on a GPU 2^25.

    Returns:
        Nearest pixels (B, P, 2) [px].
    """
    pixels = pixels.detach()
    inner = _all_within(mask, 3) & _all_within(mask.mT, 3).mT
    rim, real = mask_pixels(mask & ~inner)
    rim = rim.to(pixels.dtype)
    square = torch.where(real, rim.square().sum(-1), torch.inf)[:, None]
    if chunk is None:
        chunk = 1 << (17 if pixels.device.type == "cpu" else 25)
    parts = pixels.split(max(1, chunk // rim.shape[:2].numel()), dim=1)
    # |x - r|^2 less |x|^2, which is the same for every r
    best = [argmin(torch.baddbmm(square, part, rim.mT, alpha=-2)) for part in parts]
    found = rim.gather(1, torch.cat(best, dim=1)[..., None].expand(-1, -1, 2))
    own = nearest_pixel(pixels)
    found = torch.where(gather_pixels(mask.float(), own) > 0, own.to(found.dtype), found)
    return torch.where(mask.flatten(1).any(1)[:, None, None], found, pixels)


def centroid(mask: Tensor) -> Tensor:
    """Return the masks' centroids; the frame's center where a mask is empty.

    (B, 1, H, W) bool -> (B, 2) [px].
    """
    H, W = mask.shape[-2:]
    weight = mask[:, 0].float()
    total = weight.sum((1, 2))
    u = (weight.sum(1) * torch.arange(W, device=mask.device)).sum(1)
    v = (weight.sum(2) * torch.arange(H, device=mask.device)).sum(1)
    frame = torch.tensor([(W - 1) / 2, (H - 1) / 2], device=mask.device)
    mean = torch.stack([u, v], -1) / total[:, None].clamp_min(1)
    return torch.where(total[:, None] > 0, mean, frame)
