"""Reading images and masks at particles' places.  Pixel centers at integer (u, v)."""

import torch
import torch.nn.functional as F
from torch import Tensor


def window(size: int, device: torch.device | None = None) -> Tensor:
    """Return the pixel offsets (u, v) of a glimpse, row by row.  -> (size * size, 2) [px]."""
    side = torch.arange(size, device=device) - (size - 1) // 2
    return torch.stack(torch.meshgrid(side, side, indexing="xy"), dim=-1).reshape(-1, 2)


def nearest_pixel(pixels: Tensor) -> Tensor:
    """Round to whole pixels, halves upwards.

    (*, 2) [px] -> (*, 2) int64; far-off particles are capped, not wrapped.
    """
    return (pixels.detach() + 0.5).floor().clamp(-1e6, 1e6).long()


def pick(image: Tensor, index: Tensor) -> Tensor:
    """Read whole pixels, zero outside the frame.

    (B, C, H, W), (B, P, 2) int64 as (u, v) -> (B, P, C).
    """
    C, H, W = image.shape[1:]
    u, v = index.unbind(-1)
    inside = (u >= 0) & (u < W) & (v >= 0) & (v < H)
    flat = (v.clamp(0, H - 1) * W + u.clamp(0, W - 1))[:, None].expand(-1, C, -1)
    return (image.flatten(2).gather(2, flat) * inside[:, None]).transpose(1, 2)


def sample(image: Tensor, pixels: Tensor, stride: int = 1, padding: str = "zeros") -> Tensor:
    """Read an image, or a map of `stride` pixels a cell, bilinearly.  (B, C, h, w), (B, P, 2) [px]
    -> (B, P, C).

    Differentiable in both. Cell i's center lies at pixel i stride + (stride - 1) / 2. padding:
    zeros, or border (the edge's own values go on for ever).
    """
    h, w = image.shape[-2:]
    cells = (pixels - (stride - 1) / 2) / stride
    scale = pixels.new_tensor([max(w - 1, 1), max(h - 1, 1)])
    grid = (cells / scale * 2 - 1)[:, :, None]
    return F.grid_sample(image, grid, padding_mode=padding, align_corners=True)[..., 0].transpose(
        1, 2
    )


def touches(mask: Tensor, pixels: Tensor, size: int = 1) -> Tensor:
    """Tell whether a size x size glimpse meets the mask.

    (B, 1, H, W) bool, (B, P, 2) [px] -> (B, P) bool.
    """
    # far fewer pixels than the frame has
    index = nearest_pixel(pixels)[:, :, None] + window(size, pixels.device)
    return pick(mask, index.flatten(1, 2)).unflatten(1, index.shape[1:3]).flatten(2).any(-1)


def shrink(mask: Tensor, margin_px: int) -> Tensor:
    """Erode masks by a square of `margin_px`; a mask that would vanish stays as it is.

    (B, 1, H, W) bool -> the same.
    """
    if margin_px == 0:
        return mask
    outside = F.pad((~mask).float(), (margin_px,) * 4, value=1.0)
    # an axis at a time
    inner = ~_any_within(_any_within(outside, 2 * margin_px + 1).mT, 2 * margin_px + 1).mT
    return torch.where(inner.flatten(1).any(1)[:, None, None, None], inner, mask)


def _any_within(values: Tensor, side: int) -> Tensor:
    """Tell whether any of `side` neighbors along the last axis is above 0: running sums.

    (*, n) -> (*, n - side + 1).
    """
    sums = F.pad(values.float().cumsum(-1), (1, 0))
    return sums[..., side:] > sums[..., :-side]


def true_pixels(mask: Tensor, most: int | None = None) -> tuple[Tensor, Tensor]:
    """List each mask's pixels, padded to the longest list.  (B, 1, H, W) bool -> (B, M, 2) [px] as
    (u, v), (B, M) bool real.

    most: where a mask has more, an even selection in raster order.
    """
    found = []
    for one in mask[:, 0]:
        pixels = one.nonzero().flip(-1).float()
        if most is not None and len(pixels) > most:
            pixels = pixels[torch.linspace(0, len(pixels) - 1, most, device=pixels.device).long()]
        found.append(pixels)
    longest = max(1, *(len(f) for f in found))
    places = torch.stack([F.pad(f, (0, 0, 0, longest - len(f))) for f in found])
    counts = torch.tensor([len(f) for f in found], device=mask.device)
    return places, torch.arange(longest, device=mask.device) < counts[:, None]


def least(values: Tensor) -> Tensor:
    """Return the first index of each row's least value: `argmin(-1)`.  (*, n) -> (*) int64.

    On the processor numpy's, which compares many at once where PyTorch's takes them one by one.
    """
    if values.device.type != "cpu":
        return values.argmin(-1)
    return torch.from_numpy(values.detach().numpy().argmin(-1))


def nearest_true(mask: Tensor, pixels: Tensor, chunk: int = 1 << 17) -> Tensor:
    """Return the mask pixel nearest to each place; the place itself where a mask is empty.

    (B, 1, H, W) bool, (B, P, 2) [px] -> (B, P, 2) [px], without gradient. A place on the mask finds
    its own pixel; every other finds a pixel of the mask's rim, since from an inner one a step
    towards the place would be nearer: exact, yet a search over the rim alone. chunk: distances held
    at once, few enough for a processor's cache.
    """
    pixels = pixels.detach()
    inner = (
        F.max_pool2d(F.pad((~mask).float(), (1, 1, 1, 1), value=1.0), (3, 1), stride=1)[..., 1:-1]
        == 0
    )
    inner &= (
        F.max_pool2d(F.pad((~mask).float(), (1, 1, 1, 1), value=1.0), (1, 3), stride=1)[:, :, 1:-1]
        == 0
    )
    rim, real = true_pixels(mask & ~inner)
    rim = rim.to(pixels.dtype)
    square = torch.where(real, rim.square().sum(-1), torch.inf)[:, None]
    parts = pixels.split(max(1, chunk // rim.shape[:2].numel()), dim=1)
    # |x - r|^2 less |x|^2, which is the same for every r
    best = torch.cat(
        [least(torch.baddbmm(square, part, rim.transpose(1, 2), alpha=-2)) for part in parts], dim=1
    )
    found = rim.gather(1, best[..., None].expand(-1, -1, 2))
    own = nearest_pixel(pixels)
    found = torch.where(pick(mask.float(), own) > 0, own.to(found.dtype), found)
    return torch.where(mask.flatten(1).any(1)[:, None, None], found, pixels)


def center_of(mask: Tensor) -> Tensor:
    """Return the masks' centroids; the frame's center where a mask is empty.

    (B, 1, H, W) bool -> (B, 2) [px].
    """
    H, W = mask.shape[-2:]
    weight = mask[:, 0].float()
    total = weight.sum((1, 2))
    u = (weight.sum(1) * torch.arange(W, device=mask.device)).sum(1)
    v = (weight.sum(2) * torch.arange(H, device=mask.device)).sum(1)
    frame = torch.tensor([(W - 1) / 2, (H - 1) / 2], device=mask.device)
    return torch.where(
        total[:, None] > 0, torch.stack([u, v], -1) / total[:, None].clamp_min(1), frame
    )
