"""Poses in the format of the BOP challenge: `scene_id,im_id,obj_id,score,R,t,time`, one line an
estimate (<https://bop.felk.cvut.cz/challenges>, "Formats").
"""

import csv
import math
import sys
from collections import defaultdict
from collections.abc import Sequence
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import NamedTuple

import numpy as np

from posefilter.errors import UserError
from posefilter.files import open_whole_text
from posefilter.geometry.rigid import rigid
from posefilter.limits import open_text

_NEAREST = 0.02  # [m] median distance of objects
_SAME_SECONDS = 0.001  # by which times of one image may differ, as bop_toolkit has it
_LEAST = -sys.float_info.max  # not all who read such files know infinity
HEADER = ("scene_id", "im_id", "obj_id", "score", "R", "t", "time")


class PoseRow(NamedTuple):
    """One line of a BOP results file, the pose in the dataset's own object frame."""

    scene_id: int
    im_id: int
    obj_id: int
    score: float
    camera_from_native: np.ndarray  # (4, 4) float64 [m]
    seconds: float  # -1 where unknown, as BOP has it


def choose_score(probability: float | None, score: float) -> float:
    """Return the score of a line: the calibrated probability that the object is there and the pose
    right; where there is none (None or NaN), the estimator's own score, and the least number where
    that is not finite: a frame that showed nothing ranks last, also among log-likelihoods.

    A file of calibrated methods alone, or of one method that is not, ranks across images and
    objects as BOP has it; scores of methods that are not calibrated compare in one image only.
    """
    numbers = (probability, score)
    return next((float(x) for x in numbers if x is not None and math.isfinite(x)), _LEAST)


def measure_seconds(rows: Sequence[PoseRow]) -> tuple[float | None, int]:
    """Return the mean time of an image, and in how many images rows differ in it.

    BOP's time is that of an image, and the same in all of its rows.  Where rows differ, they are
    taken for times of one class each, and are added up.

    Args:
        rows: Of a results file; images of which a row has no time are left out.

    Returns:
        The mean [s], None where no image has a time; and the number of images.
    """
    images = defaultdict[tuple[int, int], list[PoseRow]](list)
    for row in rows:
        images[row.scene_id, row.im_id].append(row)
    means, mixed = list[float](), 0
    for own in images.values():
        times = [row.seconds for row in own]
        if not all(time >= 0 for time in times):
            continue
        differ = max(times) - min(times) > _SAME_SECONDS
        by_class = {row.obj_id: row.seconds for row in own}
        means.append(sum(by_class.values()) if differ else times[0])
        mixed += differ
    return sum(means) / len(means) if means else None, mixed


def to_native(camera_from_object: np.ndarray, native_from_mesh: np.ndarray) -> np.ndarray:
    """Return poses of the dataset's own object frame.

    (*, 4, 4) of the mesh file's -> (*, 4, 4) float64.
    """
    return np.asarray(camera_from_object, np.float64) @ np.linalg.inv(
        np.asarray(native_from_mesh, np.float64)
    )


def to_mesh(camera_from_native: np.ndarray, native_from_mesh: np.ndarray) -> np.ndarray:
    """Return poses of the mesh file's frame: undoes `to_native`."""
    return np.asarray(camera_from_native, np.float64) @ np.asarray(native_from_mesh, np.float64)


def write_poses_csv(path: Path, rows: Sequence[PoseRow]) -> None:
    """Write a BOP results file."""
    with open_whole_text(path) as file:
        file.write(",".join(HEADER) + "\n")
        file.writelines(map(format_pose_row, rows))


def format_pose_row(row: PoseRow) -> str:
    """Return a line of a BOP results file: R row by row, t in millimeters, every digit kept, so
    that reading gives the same numbers.
    """
    pose = np.asarray(row.camera_from_native, np.float64)
    R = " ".join(repr(float(x)) for x in pose[:3, :3].reshape(-1))
    # moves the point, rounds nothing
    t_mm = " ".join(format(Decimal(repr(float(x))).scaleb(3), "f") for x in pose[:3, 3])
    ids, numbers = row[:3], (repr(float(row.score)), R, t_mm, repr(float(row.seconds)))
    return ",".join([*map(str, ids), *numbers]) + "\n"


def read_poses_csv(path: Path) -> list[PoseRow]:
    """Read a BOP results file; its header may be missing.

    Raises UserError, naming file and line, where it is malformed.
    """
    if not path.is_file():
        raise UserError(f"estimates={path}: no such file")
    rows = []
    table = csv.reader(open_text(path))
    try:
        for number, cells in enumerate(table, start=1):
            first = cells[0].strip().lstrip("\ufeff").lower() if cells else ""
            if not any(map(str.strip, cells)) or (number == 1 and first == HEADER[0]):
                continue
            rows.append(_parse(cells, f"{path}, line {number}"))
    except csv.Error as error:
        raise UserError(
            f"{path}, line {table.line_num}: is no line of a table ({error})"
        ) from error
    away = [float(np.linalg.norm(row.camera_from_native[:3, 3])) for row in rows]
    if away and 0 < (median := float(np.median(away))) < _NEAREST:
        raise UserError(
            f"estimates={path}: t puts objects {1000 * median:.2g} mm from the camera, in the "
            f"median; BOP's unit is millimeters: is this in meters?"
        )
    return rows


def _parse(cells: Sequence[str], where: str) -> PoseRow:
    if len(cells) != len(HEADER):
        raise UserError(
            f"{where}: {len(cells)} columns, expected {len(HEADER)} ({','.join(HEADER)})"
        )
    scene, image, object_id = (
        _whole(cell, name, where) for cell, name in zip(cells[:3], HEADER[:3], strict=True)
    )
    R = np.reshape([float(x) for x in _numbers(cells[4], 9, "R", where)], (3, 3))
    t = [float(x.scaleb(-3)) for x in _numbers(cells[5], 3, "t", where)]
    if np.abs(R @ R.T - np.eye(3)).max() > 0.01 or np.linalg.det(R) < 0:
        raise UserError(f"{where}: R is no rotation; expected nine numbers, row by row")
    score, seconds = (_numbers(cells[i], 1, HEADER[i], where)[0] for i in (3, 6))
    return PoseRow(scene, image, object_id, float(score), rigid(R, t), float(seconds))


def _whole(cell: str, name: str, where: str) -> int:
    try:
        return int(cell)
    except ValueError as error:
        raise UserError(f"{where}: {name} is {cell!r}, and should be a whole number") from error


def _numbers(cell: str, count: int, name: str, where: str) -> list[Decimal]:
    try:
        numbers = [Decimal(part) for part in cell.split()]
    except InvalidOperation as error:
        raise UserError(f"{where}: {name} holds something that is no number: {cell!r}") from error
    if len(numbers) != count:
        raise UserError(
            f"{where}: {name} has {len(numbers)} numbers, expected {count} separated by blanks"
        )
    # NaN has no place in an order; a signaling one is not even one of time
    if (name == "score" and numbers[0].is_nan()) or any(number.is_snan() for number in numbers):
        raise UserError(f"{where}: {name} is no number: {cell!r}")
    # what is finite to a Decimal may be too large for a float
    finite = (number.is_finite() and math.isfinite(float(number)) for number in numbers)
    if name in ("R", "t") and not all(finite):
        raise UserError(f"{where}: {name} is not finite: {cell!r}")
    return numbers
