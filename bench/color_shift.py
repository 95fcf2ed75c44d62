"""Measure what a change of color alone costs a trained filter: the same images, recolored in known
ways.

    python bench/color_shift.py CHECKPOINT --source ycb_video --root DIR --meshes DIR
        [--images 20] [--only TEXT ...] [--out FILE.json]

The depth, and so the geometry, is the same in every row. A filter whose figures fall relies on
colors that another camera does not reproduce. `outscored` is the share of images in which a wrong
pose outscores the truth, where the method scores poses. In the last row labels on the object, which
its mesh may lack, are painted over: the pixels of its mask whose every channel is above 0.35 take
the median color of the mask. Of a FAT folder that the checkpoint was
trained on, its own held-out split is taken.
"""

import json
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from programs import make_parser
from torch.utils.data import DataLoader, Dataset

from posefilter.cli.checkpoints import method_of, read_checkpoint
from posefilter.data.dataset import FrameDataset, to_batch
from posefilter.data.frames import Sample
from posefilter.data.module import PoseDataModule
from posefilter.data.photometric import hue_rotation, mixing_matrix, respond, tint_gains
from posefilter.models.base import PoseEstimator
from posefilter.types import Batch

Recolor = Callable[[Sample], np.ndarray]
_SAME = np.eye(3)
_LIGHT = 0.35  # channels above it are a label's, not a dark object's


def shifts() -> dict[str, Recolor]:
    """Return the shifts by name; each returns a sample's colors (H, W, 3) uint8."""
    linear = {name: _shift(*shift) for name, shift in linear_shifts().items()}
    return linear | {"labels painted over": paint_labels}


def paint_labels(sample: Sample) -> np.ndarray:
    """Return the colors with the light pixels of the object in the object's median color."""
    rgb = sample.rgb.copy()
    rgb[sample.mask & (sample.rgb.min(-1) > 255 * _LIGHT)] = np.median(sample.rgb[sample.mask], 0)
    return rgb


def _shift(matrix: np.ndarray, exponent: float) -> Recolor:
    return lambda sample: respond(sample.rgb, matrix, exponent)


def linear_shifts() -> dict[str, tuple[np.ndarray, float]]:
    """Return a 3 x 3 matrix and an exponent each (see `photometric.respond`)."""
    warm, cold = (np.diag(tint_gains(sign * np.array([0.12, 0.0, -0.12]))) for sign in (1, -1))
    out = {"as it is": (_SAME, 1.0)}
    out |= {
        f"hue {angle:+d} degrees": (hue_rotation(np.deg2rad(angle)), 1.0)
        for angle in (-24, -12, 12, 24)
    }
    out |= {"tinted warm": (warm, 1.0), "tinted cold": (cold, 1.0)}
    out |= {
        "channels mixed": (mixing_matrix(np.full(6, 0.12)), 1.0),
        "channels parted": (mixing_matrix(np.full(6, -0.12)), 1.0),
    }
    return out | {f"gamma {exponent}": (_SAME, exponent) for exponent in (0.7, 1.5)}


class Recolored(Dataset[Batch]):
    """A dataset's frames after a shift."""

    def __init__(self, frames: FrameDataset, recolor: Recolor) -> None:
        self.frames, self.recolor = frames, recolor

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.frames)

    def __getitem__(self, i: int) -> Batch:
        """Return frame i, recolored."""
        sample = self.frames.sample(i)
        return to_batch(replace(sample, rgb=self.recolor(sample)))


def measure(method: PoseEstimator, frames: Dataset[Batch]) -> dict[str, Any]:
    """Return a method's metrics on frames."""
    method.on_test_epoch_start()
    with torch.no_grad():
        for number, batch in enumerate(DataLoader(frames, batch_size=4)):
            method.test_step(batch, number)
    return method.compute_metrics()


def table(results: dict[str, dict[str, Any]]) -> str:
    """Return the results as a Markdown table."""
    lines = [
        "| color | ADD AUC | ADD-S AUC | ADD < 0.1 d % | median mm | outscored % |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for name, metrics in results.items():
        add, outscored = metrics["add"], metrics["belief"].get("truth_outscored_by_wrong")
        cells = [add["auc"], metrics["add_s"]["auc"], add["recall_01d"], add["median_mm"]]
        wrong = "–" if outscored is None else f"{100 * outscored:.0f}"
        lines.append(f"| {name} | {' | '.join(f'{cell:.1f}' for cell in cells)} | {wrong} |")
    return "\n".join(lines)


def main() -> int:
    """Measure, print the table, and write the metrics if asked."""
    parser = make_parser(__doc__)
    parser.add_argument("checkpoint")
    parser.add_argument("--source", default="ycb_video", choices=["ycb_video", "fat", "bop"])
    parser.add_argument("--root", required=True, help="the dataset's folder")
    parser.add_argument("--meshes", required=True, help="a folder of meshes")
    parser.add_argument("--images", type=int, default=None, help="at most so many")
    parser.add_argument("--only", nargs="+", help="rows whose names hold one of these texts")
    parser.add_argument("--out", type=Path, default=None, help="a JSON file for the metrics")
    options = parser.parse_args()
    torch.set_num_threads(1)
    checkpoint = read_checkpoint(options.checkpoint)
    method, trained = method_of(checkpoint), checkpoint["recipe"]["settings"].get("data", {})
    same = trained.get("root") and Path(trained["root"]).resolve() == Path(options.root).resolve()
    split = trained["split"] if same else {"test": 1.0}
    kept = ("image_width", "image_height", *(["min_visibility_test"] if same else []))
    size = {key: trained[key] for key in kept if key in trained}
    where = (options.source, options.root, method.object_model.name, options.meshes)
    data = PoseDataModule(*where, split=split, limit_test=options.images, **size)
    data.setup("test")
    results = {}
    for name, recolor in shifts().items():
        if not options.only or any(text in name for text in options.only):
            results[name] = measure(method, Recolored(data.test_dataset, recolor))
    print(table(results))
    if options.out:
        options.out.parent.mkdir(parents=True, exist_ok=True)
        options.out.write_text(json.dumps(results, indent=2) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
