"""Learn the weights of a ResNet trunk from images alone, without labels, poses or depth.

    python bench/self_supervised.py --out outputs/self_supervised/resnet18.pt [--steps 3000]
        [--seed 0] [KEY=VALUE ...]
    python train.py model=patch_pf model/encoder=resnet
        model.encoder.trunk.weights=outputs/self_supervised/resnet18.pt

Two views of a frame are drawn, each turned, zoomed, cut and colored in its own way. Features at the
same point of the frame should agree in both views, and differ from those at other points (VADeR,
Pinheiro et al. 2020; InfoNCE, van den Oord et al. 2018). Other points are those of the same frame
alone, where VADeR takes other images: here every frame shows the same object, so that a pixel of
another frame may be the same point of it.

What is typed beyond the options is as for train.py: `data`, whose training scenes alone are
learned from, and `model.encoder.trunk`. Validation scenes only tell how often a point is found in
the other view. The top-down path above the trunk is learned as well, and left out of the file,
which has torchvision's names.
"""

import math
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import torch
import torch.nn.functional as F
from programs import HOME, make_parser
from torch import Generator, Tensor, nn

from posefilter.cli.build import build_data
from posefilter.cli.command import compose_job
from posefilter.cli.instantiate import instantiate
from posefilter.cli.machine import settle
from posefilter.data.dataset import FrameDataset
from posefilter.files import open_whole
from posefilter.geometry.lookup import sample
from posefilter.nets.encoders import ResNetEncoder
from posefilter.nets.resnet import ResNet

CHOICES = ("model=patch_pf", "model/encoder=resnet", "data/augment=none", "data.workers=0")
SIZE = (96, 128)  # of a view (height, width) [px]
ROLL = math.radians(30.0)  # most, to either side
ZOOM = (0.7, 1.5)
TEMPERATURE = 0.1
POINTS = 128  # of each frame
BATCH = 8  # frames
LR, WEIGHT_DECAY, WARMUP = 1e-3, 1e-2, 100  # of AdamW; steps
EVERY = 250  # steps between lines


class Views(NamedTuple):
    """One view of each frame."""

    rgb: Tensor  # (B, 3, h, w) in [0, 1]
    frame_from_view: Tensor  # (B, 2, 3) [px]


def uniform(low: float, high: float, shape: tuple[int, ...], generator: Generator) -> Tensor:
    """Draw uniformly between two bounds."""
    return low + (high - low) * torch.rand(shape, generator=generator)


def map_points(affine: Tensor, points: Tensor) -> Tensor:
    """Map points.  (B, 2, 3), (B, P, 2) [px] -> (B, P, 2) [px]."""
    return points @ affine[:, :, :2].mT + affine[:, None, :, 2]


def invert(affine: Tensor) -> Tensor:
    """Return the inverse maps.  (B, 2, 3) -> (B, 2, 3)."""
    inverse = torch.linalg.inv(affine[:, :, :2])
    return torch.cat([inverse, -inverse @ affine[:, :, 2:]], dim=2)


def draw_affine(count: int, height: int, width: int, generator: Generator) -> Tensor:
    """Draw where views lie in frames: their middle in the middle half of the frame, any zoom and
    roll of the ranges.

    Returns:
        Frame from view (count, 2, 3) [px].
    """
    scale = uniform(math.log(ZOOM[0]), math.log(ZOOM[1]), (count,), generator).exp().reciprocal()
    angle = uniform(-ROLL, ROLL, (count,), generator)
    c, s = scale * angle.cos(), scale * angle.sin()
    turn = torch.stack([torch.stack([c, -s], 1), torch.stack([s, c], 1)], dim=1)
    middle = uniform(0.25, 0.75, (count, 2), generator) * torch.tensor([width - 1, height - 1])
    own = torch.tensor([SIZE[1] - 1, SIZE[0] - 1]) / 2
    return torch.cat([turn, (middle - turn @ own)[:, :, None]], dim=2)


def recolor(rgb: Tensor, generator: Generator) -> Tensor:
    """Change gain and offset of each channel, take away some or all of the saturation, and add
    noise, as a camera or a lamp would.  (B, 3, h, w) -> the same shape, in [0, 1].
    """
    B = len(rgb)
    gain = uniform(-0.3, 0.3, (B, 3, 1, 1), generator).exp()
    offset = uniform(-0.1, 0.1, (B, 3, 1, 1), generator)
    # of a fifth of the views all is taken away
    gray = (uniform(-0.5, 1.125, (B, 1, 1, 1), generator) / 0.8).clamp(0, 1)
    rgb = rgb.lerp(rgb.mean(1, keepdim=True).expand_as(rgb), gray) * gain + offset
    noise = uniform(0.0, 0.04, (B, 1, 1, 1), generator)
    return (rgb + noise * torch.randn(rgb.shape, generator=generator)).clamp(0, 1)


def draw_views(rgb: Tensor, generator: Generator) -> Views:
    """Draw a view of each frame.  (B, 3, H, W) in [0, 1]."""
    (B, _, H, W), (h, w) = rgb.shape, SIZE
    affine = draw_affine(B, H, W, generator)
    v, u = torch.meshgrid(torch.arange(h), torch.arange(w), indexing="ij")
    grid = torch.stack([u, v], dim=-1).float().reshape(1, -1, 2).expand(B, -1, -1)
    values = sample(rgb, map_points(affine, grid), padding="border")
    return Views(recolor(values.mT.unflatten(2, (h, w)), generator), affine)


def draw_points(
    first: Views, second: Views, frame: tuple[int, int], generator: Generator
) -> tuple[Tensor, Tensor, Tensor]:
    """Draw points of the first view, and find them in the second.

    frame: (height, width) [px].

    Returns:
        Points in each view (B, POINTS, 2) [px], and which of them both views and the frame have
        (B, POINTS) bool.
    """
    here = torch.rand(len(first.rgb), POINTS, 2, generator=generator)
    here = here * torch.tensor([SIZE[1] - 1, SIZE[0] - 1])
    at = map_points(first.frame_from_view, here)
    there = map_points(invert(second.frame_from_view), at)
    seen = [
        ((points >= 0) & (points <= torch.tensor([width - 1, height - 1]))).all(-1)
        for points, (height, width) in ((at, frame), (there, SIZE))
    ]
    return here, there, seen[0] & seen[1]


def compare(first: Tensor, second: Tensor, seen: Tensor) -> tuple[Tensor, Tensor]:
    """Return the loss, InfoNCE in both directions, and the share of points whose most similar one
    in the other view is their own.

    Args:
        first: Features at the points in one view (B, P, C).
        second: In the other.
        seen: (B, P) bool; other points count for nothing.
    """
    logits = F.normalize(first, dim=-1) @ F.normalize(second, dim=-1).mT / TEMPERATURE
    own = torch.arange(logits.shape[1]).expand(logits.shape[:2])
    losses, found = [], []
    for one in (logits, logits.mT):
        masked = one.masked_fill(~seen[:, None], -torch.inf)[seen]
        losses.append(F.cross_entropy(masked, own[seen]))
        found.append((masked.argmax(-1) == own[seen]).float().mean())
    return torch.stack(losses).mean(), torch.stack(found).mean()


def score(encoder: nn.Module, rgb: Tensor, generator: Generator) -> tuple[Tensor, Tensor]:
    """Return loss and share of found points of two drawn views.  (B, 3, H, W) in [0, 1]."""
    views = [draw_views(rgb, generator) for _ in range(2)]
    *points, seen = draw_points(views[0], views[1], (rgb.shape[2], rgb.shape[3]), generator)
    both = torch.cat([view.rgb for view in views])
    # no depth is known, and the geometry stem, of zeros, makes nothing of the camera either
    maps = encoder(both, torch.zeros_like(both[:, :1]), torch.eye(3).expand(len(both), 3, 3))
    features = encoder.sample_features(maps, torch.cat(points))  # type: ignore[operator]
    return compare(*features.chunk(2), seen)


def draw_batches(frames: FrameDataset, generator: Generator) -> Iterator[Tensor]:
    """Yield the colors of shuffled frames without end.  (BATCH, 3, H, W) in [0, 1]."""
    while True:
        order = torch.randperm(len(frames), generator=generator)
        for rows in order.split(BATCH):
            if len(rows) == min(BATCH, len(frames)):
                yield torch.stack([frames[i].rgb for i in rows.tolist()])


@torch.no_grad()
def validate(encoder: nn.Module, frames: FrameDataset) -> float:
    """Return the share of points [%] that are found, of the same views each time."""
    encoder.eval()
    generator = Generator().manual_seed(0)
    batches = torch.arange(len(frames)).split(BATCH)
    found = [
        score(encoder, torch.stack([frames[i].rgb for i in rows.tolist()]), generator)[1]
        for rows in batches
    ]
    encoder.train()
    return 100 * float(torch.stack(found).mean())


def learn(
    trunk: ResNet, train: FrameDataset, val: FrameDataset, steps: int, generator: Generator
) -> None:
    """Train a trunk, and say now and then how it stands."""
    encoder = ResNetEncoder(trunk).train()
    trunk.geometry.requires_grad_(False)  # a filter begins without it, as with published weights
    encoder.relevance.requires_grad_(False)
    parameters = [p for p in encoder.parameters() if p.requires_grad]
    optimizer = torch.optim.AdamW(parameters, LR, weight_decay=WEIGHT_DECAY)
    batches, start = draw_batches(train, generator), time.process_time()
    for step in range(steps + 1):
        if step % EVERY == 0 or step == steps:
            minutes = (time.process_time() - start) / 60
            found = validate(encoder, val)
            print(f"step {step}: {found:.1f} % of points found, {minutes:.1f} CPU min", flush=True)
        if step == steps:
            return
        rise = min(1.0, (step + 1) / WARMUP)
        optimizer.param_groups[0]["lr"] = LR * rise * (1 + math.cos(math.pi * step / steps)) / 2
        loss, _ = score(encoder, next(batches), generator)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()


def write_trunk(trunk: ResNet, path: Path) -> None:
    """Write what `load_trunk` reads: torchvision's names, and no geometry stem."""
    state = {k: v for k, v in trunk.state_dict().items() if not k.startswith("geometry.")}
    with open_whole(path) as file:
        torch.save(state, file)


def main() -> None:
    """Train, and write the file."""
    parser = make_parser(__doc__)
    parser.add_argument("more", nargs="*")
    parser.add_argument("--out", type=Path, required=True, help="the file; one that is there stays")
    parser.add_argument("--steps", type=int, default=3000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int)
    options = parser.parse_args()
    if options.out.exists():
        parser.error(f"{options.out}: is there already; choose another --out")
    settle(options.threads, options.seed)
    job = compose_job("train", HOME / "conf", [*CHOICES, *options.more], Path())
    data = build_data(job.cfg.data, "json", job.overrides)
    data.setup("fit")
    trunk = instantiate(job.cfg.model.encoder.trunk, "model.encoder.trunk")
    generator = Generator().manual_seed(options.seed)
    learn(trunk, data.train_dataset, data.val_dataset, options.steps, generator)
    write_trunk(trunk, options.out)


if __name__ == "__main__":
    main()
