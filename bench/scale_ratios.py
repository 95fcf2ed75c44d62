"""How well the scale ratio tells a wrong depth scale, on held-out renders.

    python bench/scale_ratios.py --root DIR --meshes DIR [--only NAME ...] [--images 12]

The scenes are those that bench/held_out.py tests on. Each image is asked as it is, and with depths
1.25 and 0.8 times as large: of those whose pose is right as they are, how many are said to be of a
wrong size, and of the wrong answers that calibration alone would declare found, how many are
noticed. Writes the table of docs/results/confidence.md.
"""

from typing import Any

import numpy as np
import torch
from confidence import is_right_pose
from held_out import read_frames
from marked import format_row, put_table
from programs import HOME, make_parser

import posefilter
from posefilter.confidence.verdicts import decide
from posefilter.data.frames import Sample
from posefilter.memory import keep_freed_memory
from posefilter.weights import list_shipped

PAGE = HOME / "docs" / "results" / "confidence.md"
FACTORS = (1.0, 1.25, 0.8)
HEAD = ("object", "images right", "size, median", "flagged")
HEAD += tuple(
    f"depth x {factor:g}: {word}"
    for factor in FACTORS[1:]
    for word in ("size, median", "probable and wrong", "of these flagged")
)


def ask(estimator: posefilter.Estimator, sample: Sample) -> list[dict[str, Any]] | None:
    """Return what is said at each factor, None where the pose is wrong without any."""
    out = []
    for factor in FACTORS:
        result = estimator.predict(sample.rgb, factor * sample.depth, sample.intrinsics)
        right = is_right_pose(result, sample.camera_from_object.astype(np.float64))
        if factor == 1.0 and not right:
            return None
        assert result.presence is not None
        assert result.probability is not None
        probable = decide(result.presence, result.probability, result.costs) == "found"
        size, noticed = result.scale_ratio, result.wrong_size
        out.append({"size": size, "noticed": noticed, "wrong": probable and not right})
    return out


def tabulate(name: str, answers: list[list[dict[str, Any]]]) -> str:
    """Return an object's row."""
    cells: list[str] = [name, str(len(answers))]
    for k, factor in enumerate(FACTORS):
        own = [one[k] for one in answers]
        sizes = [one["size"] for one in own if not np.isnan(one["size"])]
        cells.append(f"{np.median(sizes):.2f}" if sizes else "")
        wrong = own if factor == 1.0 else [one for one in own if one["wrong"]]
        cells += [] if factor == 1.0 else [str(len(wrong))]
        cells.append(str(sum(one["noticed"] for one in wrong)))
    return format_row(cells)


def main() -> None:
    """Measure, print and write."""
    parser = make_parser(__doc__)
    parser.add_argument("--root", required=True, help="a folder of rendered scenes")
    parser.add_argument("--meshes", required=True, help="a folder of YCB's meshes")
    parser.add_argument("--only", nargs="+", default=list(list_shipped()), help="objects")
    parser.add_argument("--images", type=int, default=12, help="of each object")
    options = parser.parse_args()
    keep_freed_memory()
    torch.set_num_threads(1)
    rows = []
    for name in options.only:
        estimator = posefilter.load(name, device="cpu")
        frames = read_frames(options.root, options.meshes, name, options.images)
        answers = [ask(estimator, sample) for _, sample in frames]
        rows.append(tabulate(name, [one for one in answers if one is not None]))
        print(rows[-1], flush=True)
    PAGE.write_text(put_table(PAGE.read_text(), "scale-ratios", HEAD, rows))


if __name__ == "__main__":
    main()
