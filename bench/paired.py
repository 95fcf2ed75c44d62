"""Compare tests of the same images by their areas, with intervals over scenes.

    python bench/paired.py REFERENCE FOLDER ...

Each is a folder in which evaluate.py wrote errors.csv. Frames of a scene are alike, so that
intervals resample scenes, not images (95 %, percentile bootstrap of the paired difference to the
reference). Of images of one scene there is none.
"""

import sys
from collections.abc import Sequence
from pathlib import Path

import torch
from marked import format_table
from programs import make_parser
from scene_bootstrap import bootstrap_scenes

from posefilter.metrics.image_errors import FILE, ImageError, read_errors
from posefilter.metrics.scores import auc

HEAD = ("test", "images", "scenes", "ADD AUC", "difference", "ADD-S AUC", "difference")
HEAD += ("ADD < 0.1 d %",)


def read_test(folder: Path) -> dict[tuple[str, str], ImageError]:
    """Return the rows of a test by object and image.

    Raises:
        ValueError: An image shows the object more than once.
    """
    rows = read_errors(folder / FILE)
    found = {(row.object, row.image): row for row in rows}
    if len(found) < len(rows):
        raise ValueError(f"{folder / FILE}: several rows of one object and image")
    return found


def pair(
    reference: dict[tuple[str, str], ImageError], other: dict[tuple[str, str], ImageError]
) -> tuple[list[str], torch.Tensor]:
    """Return the scenes, (N,), and the errors [m] of both tests, (2, N, 2): ADD and ADD-S.

    Raises:
        ValueError: The two are not of the same images.
    """
    if reference.keys() != other.keys():
        raise ValueError("these tests are not of the same images")
    errors = [
        [[test[key].add_mm, test[key].add_s_mm] for key in reference] for test in (reference, other)
    ]
    scenes = [image.rpartition("/")[0] for _, image in reference]
    return scenes, torch.tensor(errors, dtype=torch.float64) / 1000


def bound_difference(
    scenes: Sequence[str], errors: torch.Tensor, draws: int = 2000
) -> tuple[float, float] | None:
    """Return the 95 % interval of the second test's area minus the first's, None of one scene.

    Args:
        scenes: (N,) names.
        errors: (2, N) [m].
        draws: Of the bootstrap.
    """
    if len(set(scenes)) < 2:
        return None
    return bootstrap_scenes(scenes, lambda rows: auc(errors[1, rows]) - auc(errors[0, rows]), draws)


def make_cells(name: str, scenes: Sequence[str], errors: torch.Tensor, recall: float) -> list[str]:
    """Return a row for people.  errors (2, N, 2) [m]: ADD and ADD-S of the reference and of it."""
    cells = [name, str(len(scenes)), str(len(set(scenes)))]
    for which in range(2):
        first, second = (auc(one) for one in errors[..., which])
        bounds = bound_difference(scenes, errors[..., which])
        ends = "" if bounds is None else f" [{bounds[0]:+.1f}, {bounds[1]:+.1f}]"
        cells += [f"{second:.1f}", f"{second - first:+.1f}{ends}"]
    return [*cells, f"{recall:.0f}"]


def main() -> int:
    """Print a table: a row a folder, compared with the first."""
    parser = make_parser(__doc__)
    parser.add_argument("folders", nargs="+", type=Path, metavar="FOLDER")
    tests = [(folder, read_test(folder)) for folder in parser.parse_args().folders]
    rows = []
    for folder, test in tests:
        scenes, errors = pair(tests[0][1], test)
        right = [row.add_mm < 0.1 * row.diameter_mm for row in test.values()]
        rows.append(make_cells(folder.name, scenes, errors, 100 * sum(right) / len(right)))
    print(format_table(HEAD, rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
