"""What has been tracked so far, in two files that a killed `track.py` leaves behind."""

import os
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from posefilter.cli.console import finite
from posefilter.cli.folders import holds_run
from posefilter.errors import UserError
from posefilter.files import GrowingFile
from posefilter.metrics.bop_results import HEADER, PoseRow, choose_score, format_pose_row, to_native
from posefilter.tracking.records import TrackRow, describe_row, format_row

POSES = "poses.csv"
_LINES, _CSV = "poses.partial.jsonl", "poses.partial.csv"

NativeFromMesh = Callable[[str], np.ndarray]


class TrackLog:
    """The rows of tracks; each frame's are on the disk before the next frame is looked at.

    Args:
        folder: Of the command.
        native_from_mesh: The frames of a dataset's objects, by object.
    """

    def __init__(self, folder: Path, native_from_mesh: NativeFromMesh) -> None:
        self.rows: list[TrackRow] = []
        self._native = native_from_mesh
        self._lines, self._poses = GrowingFile(folder / _LINES), GrowingFile(folder / _CSV)
        self._header = ",".join(HEADER) + "\n"

    def add(self, rows: Sequence[TrackRow]) -> None:
        """Add a frame's rows.

        Raises:
            UserError: They cannot be written.
        """
        self.rows += rows
        self._lines.add("".join(format_row(finite(describe_row(row))) for row in rows))
        self._poses.add(self._header + "".join(map(format_pose_row, self.list_poses(rows))))
        self._header = ""

    def list_poses(self, rows: Sequence[TrackRow]) -> list[PoseRow]:
        """Return the rows of the results file: of frames in which the object was tracked."""
        return [to_pose_row(row, self._native) for row in rows if row.result.is_tracked]

    def close(self) -> None:
        """Close the two files, which stay."""
        self._lines.close()
        self._poses.close()

    def remove(self) -> None:
        """Remove the two files: all that is in them is written under its own name."""
        self._lines.path.unlink(missing_ok=True)
        self._poses.path.unlink(missing_ok=True)


def to_pose_row(row: TrackRow, native_from_mesh: NativeFromMesh) -> PoseRow:
    """Return a row of the results file, in the dataset's own object frame; BOP's time is that of an
    image, all objects together.
    """
    pose = to_native(row.result.pose, native_from_mesh(row.result.object))
    score = choose_score(row.result.probability, row.result.score)
    return PoseRow(row.scene_id, row.im_id, row.obj_id, score, pose, row.image_seconds)


def check_unused(folder: Path) -> None:
    """Raise UserError where a folder holds tracks, or what a killed `track.py` has left of some, or
    a run.
    """
    if (folder / POSES).is_file():
        raise UserError(f"out={folder}: holds tracks already; choose another folder: out=DIR")
    if holds_run(folder):
        raise UserError(f"out={folder}: holds a run; choose another folder: out=DIR")
    lines, poses = folder / _LINES, folder / _CSV
    if os.path.lexists(lines) or os.path.lexists(poses):
        raise UserError(
            f"out={folder}: holds {_count_frames(lines)} frames of a track.py that was cut off, in "
            f"{lines.name} and {poses.name}; choose another folder, or move these files away"
        )


def _count_frames(lines: Path) -> int:
    """Return the number of frames in a poses.partial.jsonl; a line without an end is not one."""
    if not lines.is_file():
        return 0
    with lines.open("rb") as file:
        # what comes before a line's numbers names its video and frame
        return len({x.partition(b', "scene_id"')[0] for x in file if x.endswith(b"\n")})
