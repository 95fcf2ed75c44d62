"""Results of a test by image: poses in the format of the BOP challenge, and whole beliefs."""

import csv
import math
from collections.abc import Callable, Sequence
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import NamedTuple

import numpy as np
from lightning import LightningModule, Trainer

from posefilter.callbacks.trace_callback import TraceCallback
from posefilter.data.frames import FrameRecord
from posefilter.errors import UserError
from posefilter.files import open_whole, open_whole_text
from posefilter.models.base import PoseEstimator
from posefilter.types import Batch, Trace

HEADER = ("scene_id", "im_id", "obj_id", "score", "R", "t", "time")
NativeFromMesh = Callable[[str], np.ndarray]


class Outcome(NamedTuple):
    """The result of the filter for one image.

    Poses are camera_from_object in the mesh file's frame [m].
    """

    frame_id: int  # index into the split's records
    estimate: np.ndarray  # (4, 4) float64
    score: float
    seconds: float  # that the image took; NaN where it was not measured
    poses: np.ndarray  # (N, 4, 4) float32
    weights: np.ndarray  # (N,) float32, summing to 1
    probability: float = math.nan  # that the estimate is right, where the method is calibrated


class PoseRow(NamedTuple):
    """One line of a BOP results file, the pose in the dataset's own object frame."""

    scene_id: int
    im_id: int
    obj_id: int
    score: float
    camera_from_native: np.ndarray  # (4, 4) float64 [m]
    seconds: float  # -1 where unknown, as BOP has it


class Records(TraceCallback):
    """Collect the `outcomes` of a test.

    Args:
        beliefs: Keep the particles too.
    """

    def __init__(self, beliefs: bool = True) -> None:
        super().__init__()
        self.beliefs = beliefs
        self.outcomes: list[Outcome] = []

    def on_test_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Forget an earlier test."""
        self.outcomes = []

    def on_test_trace(
        self, trainer: Trainer, method: PoseEstimator, trace: Trace, batch: Batch, number: int
    ) -> None:
        """Take in one batch."""
        times = method.seconds_per_image
        found = collect_outcomes(trace, batch, times[-1] if times else math.nan, self.beliefs)
        probabilities = method.last_assessment(len(found)).probability.tolist()
        self.outcomes += [
            one._replace(probability=probability)
            for one, probability in zip(found, probabilities, strict=True)
        ]


def collect_outcomes(
    trace: Trace, batch: Batch, seconds: float, beliefs: bool = True
) -> list[Outcome]:
    """Return the outcome of each image of a batch.

    Args:
        trace: The run of the filter.
        batch: Its B images.
        seconds: That an image took.
        beliefs: Keep the particles too.
    """
    belief = trace.belief
    best = belief.best.detach().cpu().double().numpy()
    poses = belief.poses.detach().cpu().float().numpy()
    weights = belief.log_weights.detach().exp().cpu().float().numpy()
    keep = slice(None) if beliefs else slice(0)
    return [
        Outcome(frame, best[i], float(belief.score[i]), seconds, poses[i][keep], weights[i][keep])
        for i, frame in enumerate(batch.frame_id.tolist())
    ]


def to_rows(
    outcomes: Sequence[Outcome], records: Sequence[FrameRecord], native_from_mesh: NativeFromMesh
) -> list[PoseRow]:
    """Return the estimates as lines of a results file.

    The score is the probability where there is one, else the log-likelihood.
    Estimates that are not finite are left out, and so count as missed.

    Args:
        outcomes: Of the images.
        records: The split's, which `frame_id` indexes.
        native_from_mesh: Given a class, the transform (4, 4) from the frame of the mesh file to the
            dataset's own object frame [m].
    """
    rows = []
    for outcome in outcomes:
        if not np.isfinite(outcome.estimate).all():
            continue
        record = records[outcome.frame_id]
        pose = to_native(outcome.estimate, native_from_mesh(record.object))
        seconds = outcome.seconds if math.isfinite(outcome.seconds) else -1.0
        known = math.isfinite(outcome.probability)
        score = outcome.probability if known else outcome.score
        rows.append(PoseRow(record.scene_id, record.im_id, record.obj_id, score, pose, seconds))
    return rows


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
    """Write a BOP results file: R row by row, t in millimeters, every digit kept, so that reading
    gives the same numbers.
    """
    with open_whole_text(path) as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(HEADER)
        for row in rows:
            pose = np.asarray(row.camera_from_native, np.float64)
            R = " ".join(repr(float(x)) for x in pose[:3, :3].reshape(-1))
            t_mm = " ".join(
                format(Decimal(repr(float(x))).scaleb(3), "f") for x in pose[:3, 3]
            )  # moves the point, rounds nothing
            writer.writerow(
                [
                    row.scene_id,
                    row.im_id,
                    row.obj_id,
                    repr(float(row.score)),
                    R,
                    t_mm,
                    repr(float(row.seconds)),
                ]
            )


def read_poses_csv(path: Path) -> list[PoseRow]:
    """Read a BOP results file; its header may be missing.

    Raises UserError, naming file and line, where it is malformed.
    """
    if not path.is_file():
        raise UserError(f"estimates={path}: no such file")
    rows = []
    with path.open(newline="", encoding="utf-8", errors="replace") as file:
        for number, cells in enumerate(csv.reader(file), start=1):
            if not cells or (number == 1 and cells[0].strip().lstrip("\ufeff") == HEADER[0]):
                continue
            rows.append(_parse(cells, f"{path}, line {number}"))
    return rows


def _parse(cells: Sequence[str], where: str) -> PoseRow:
    if len(cells) != len(HEADER):
        raise UserError(
            f"{where}: {len(cells)} columns where {len(HEADER)} are due ({','.join(HEADER)})"
        )
    scene, image, object_id = (
        _whole(cell, name, where) for cell, name in zip(cells[:3], HEADER[:3], strict=True)
    )
    pose = np.eye(4)
    pose[:3, :3] = np.reshape([float(x) for x in _numbers(cells[4], 9, "R", where)], (3, 3))
    pose[:3, 3] = [float(x.scaleb(-3)) for x in _numbers(cells[5], 3, "t", where)]
    R = pose[:3, :3]
    if np.abs(R @ R.T - np.eye(3)).max() > 0.01 or np.linalg.det(R) < 0:
        raise UserError(f"{where}: R is no rotation (nine numbers, row by row, are due)")
    score, seconds = (_numbers(cells[i], 1, HEADER[i], where)[0] for i in (3, 6))
    return PoseRow(scene, image, object_id, float(score), pose, float(seconds))


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
            f"{where}: {name} has {len(numbers)} numbers where {count} are due, separated by blanks"
        )
    if name in "Rt" and not all(number.is_finite() for number in numbers):
        raise UserError(f"{where}: {name} is not finite: {cell!r}")
    return numbers


def write_beliefs(
    path: Path,
    outcomes: Sequence[Outcome],
    records: Sequence[FrameRecord],
    native_from_mesh: NativeFromMesh,
) -> None:
    """Write all beliefs as one .npz: poses (I, N, 4, 4) camera_from_native [m], weights (I, N), and
    their ids (I,).

    The ids are scene_id, im_id and obj_id, as in poses.csv. Image i of one array is image i of the
    others.
    """
    own = [records[outcome.frame_id] for outcome in outcomes]
    poses = [
        to_native(o.poses, native_from_mesh(r.object)).astype(np.float32)
        for o, r in zip(outcomes, own, strict=True)
    ]
    weights = [o.weights for o in outcomes]
    with open_whole(path) as file:
        np.savez_compressed(
            file,
            poses=np.stack(poses) if poses else np.zeros((0, 0, 4, 4), np.float32),
            weights=np.stack(weights) if weights else np.zeros((0, 0), np.float32),
            scene_id=np.array([r.scene_id for r in own], np.int64),
            im_id=np.array([r.im_id for r in own], np.int64),
            obj_id=np.array([r.obj_id for r in own], np.int64),
        )
