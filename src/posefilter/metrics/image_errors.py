"""Errors of each image of a test, as a CSV table."""

import csv
import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import torch

from posefilter.files import open_whole_text
from posefilter.forms import MOST
from posefilter.limits import open_text
from posefilter.metrics.scores import InstanceErrors, summarize_errors
from posefilter.paths import name_in_table

FILE = "errors.csv"


class ImageError(NamedTuple):
    """One row of errors.csv; NaN for unknown values, infinite errors for missed objects."""

    scene_id: int
    im_id: int
    obj_id: int
    object: str
    image: str  # the frame's name in its dataset
    visibility: float  # share of the object's pixels that is visible
    add_mm: float
    add_s_mm: float
    diameter_mm: float
    particles_on_object: float  # share of the last particles
    score: float
    seconds: float
    presence: float = math.nan  # probability that the object is there
    probability: float = math.nan  # that it is there and the pose right
    log_density: float = math.nan  # of the belief at the truth [nat]
    credible_rank: float = math.nan  # share of the belief that is denser than the truth
    add_up_to_symmetry_mm: float = math.nan

    @property
    def error_mm(self) -> float:
        """The ADD up to symmetry; the ADD where it is not known, as in files of earlier
        versions.
        """
        known = not math.isnan(self.add_up_to_symmetry_mm)
        return self.add_up_to_symmetry_mm if known else self.add_mm


def write_errors(path: Path, rows: Sequence[ImageError]) -> None:
    """Write errors.csv with all digits, so that metrics.json can be recomputed from it exactly."""
    with open_whole_text(path) as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(ImageError._fields)
        writer.writerows(row._replace(image=name_in_table(row.image)) for row in rows)


def read_errors(path: Path) -> list[ImageError]:
    """Return the rows of errors.csv.

    Raises:
        ValueError: Where a row is malformed.
        BadData: It is larger than such a file can be, or no text.
    """
    try:
        return [parse_row(row) for row in csv.DictReader(open_text(path))]
    except csv.Error as error:
        raise ValueError(str(error)) from error


def parse_row(row: dict[str, str]) -> ImageError:
    """Return one row; additional columns are ignored.

    Raises:
        ValueError: A column is missing, or its value is malformed.
    """
    optional = ImageError._field_defaults  # later than the others, so that older files have none
    row = {name: str(value) for name, value in optional.items()} | row
    missing = [name for name in ImageError._fields if row.get(name) is None]
    if missing:
        raise ValueError(f"column {missing[0]} is missing")
    kinds = ImageError.__annotations__
    error = ImageError(*(kinds[name](row[name]) for name in ImageError._fields))
    for name, value in zip(ImageError._fields, error, strict=True):
        if isinstance(value, float) and MOST < abs(value) < math.inf:
            raise ValueError(f"{name}={value} cannot be computed with")
    return error


def summarize_images(
    rows: Sequence[ImageError], symmetric: bool = False
) -> dict[str, dict[str, float]]:
    """Return the blocks `add` and `add_s` of metrics.json for a set of images, and if asked
    `add_up_to_symmetry`, which all of them must know.
    """
    names = [f"{name}_mm" for name in InstanceErrors._fields]
    columns = [[getattr(row, name) for row in rows] for name in names]
    errors = InstanceErrors(*torch.tensor(columns, dtype=torch.float64) / 1000)
    return summarize_errors(errors, symmetric)
