"""Results of a test by image: poses in the format of the BOP challenge, and whole beliefs."""

import math
from collections import defaultdict
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from lightning import LightningModule, Trainer

from posefilter.callbacks.trace_callback import TraceCallback
from posefilter.data.frames import FrameRecord
from posefilter.files import open_whole
from posefilter.metrics.bop_results import PoseRow, choose_score, to_native
from posefilter.models.base import PoseEstimator
from posefilter.models.evaluation import last_assessment
from posefilter.types import Batch, BeliefBatch, Trace

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


class Records(TraceCallback):
    """Collect the `outcomes` of a test."""

    def __init__(self) -> None:
        super().__init__()
        self.outcomes: list[Outcome] = []

    def on_test_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Forget an earlier test."""
        self.outcomes = []

    def on_test_trace(
        self, trainer: Trainer, method: PoseEstimator, trace: Trace, batch: Batch, number: int
    ) -> None:
        """Take in one batch."""
        times = method.seconds_per_image
        seconds = times[-1] if times else math.nan
        probabilities = last_assessment(method, len(batch.rgb)).probability.tolist()
        assert method.last_belief is not None
        self.outcomes += collect_outcomes(method.last_belief, batch, seconds, probabilities)


def collect_outcomes(
    belief: BeliefBatch, batch: Batch, seconds: float, probabilities: Sequence[float]
) -> list[Outcome]:
    """Return the outcome of each image of a batch.

    Args:
        belief: B beliefs.
        batch: The B images.
        seconds: That an image took.
        probabilities: Of the B estimates; NaN where the method is not calibrated.
    """
    best = belief.best.detach().cpu().double().numpy()
    poses = belief.poses.detach().cpu().float().numpy()
    weights = belief.log_weights.detach().exp().cpu().float().numpy()
    return [
        Outcome(
            frame, best[i], float(belief.score[i]), seconds, poses[i], weights[i], probabilities[i]
        )
        for i, frame in enumerate(batch.frame_id.tolist())
    ]


def to_rows(
    outcomes: Sequence[Outcome], records: Sequence[FrameRecord], native_from_mesh: NativeFromMesh
) -> list[PoseRow]:
    """Return the estimates as lines of a results file.

    The score is as `choose_score` has it.  BOP's time is that of an image: of an image that shows
    several instances, that of all of its outcomes.
    Estimates that are not finite are left out, and so count as missed.

    Args:
        outcomes: Of the images.
        records: The split's, which `frame_id` indexes.
        native_from_mesh: Given a class, the transform (4, 4) from the frame of the mesh file to the
            dataset's own object frame [m].
    """
    seconds = defaultdict[tuple[int, int], float](float)
    for outcome in outcomes:
        record = records[outcome.frame_id]
        seconds[record.scene_id, record.im_id] += outcome.seconds
    rows = []
    for outcome in outcomes:
        if not np.isfinite(outcome.estimate).all():
            continue
        record = records[outcome.frame_id]
        pose = to_native(outcome.estimate, native_from_mesh(record.object))
        image = record.scene_id, record.im_id
        spent = seconds[image] if math.isfinite(seconds[image]) else -1.0
        score = choose_score(outcome.probability, outcome.score)
        rows.append(PoseRow(*image, record.obj_id, score, pose, spent))
    return rows


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
