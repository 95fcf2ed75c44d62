"""What an estimate amounts to: `posefilter.Result`."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch

from posefilter.belief import Belief, Mode, PoseSet
from posefilter.belief.belief import belief_over
from posefilter.belief.summaries import check_probability
from posefilter.confidence.calibration import Assessment, Calibration
from posefilter.confidence.conformal import Conformal
from posefilter.confidence.scale_ratio import ScaleRatio, pool_gains
from posefilter.confidence.tolerance import RIGHT, PoseTolerance, check_pose_tolerance
from posefilter.confidence.verdicts import (
    Costs,
    Verdict,
    apply_prior,
    check_costs,
    decide,
    describe_probability,
)
from posefilter.errors import UserError
from posefilter.models.base import PoseEstimator
from posefilter.plausibility import find_input_warnings, find_warnings
from posefilter.types import Batch, BeliefBatch, ObjectModel, Trace

if TYPE_CHECKING:
    from posefilter.figures.overlay import Shape

_THERE = 0.5  # presence from which an object's scale ratio counts for the others of its image


@dataclass(frozen=True, eq=False, repr=False)
class Result:
    """Where one object is in one image, and how sure that is.

    Attributes:
        object: The object's name.
        pose: The estimate (4, 4), float64: camera_from_object in meters.  The camera's frame is
            OpenCV's (x right, y down, z ahead), the object's that of its mesh file.  It is the best
            guess, also where the object is not there: see `verdict`.
        score: By the shipped settings the estimate's log-likelihood; other choices of
            `filter/estimate` and `filter/refine` define their own, which `pose.json` writes as
            `score_is`.  It ranks poses of one image; between images its level is arbitrary, so it
            is no measure of confidence: `probability` is.
        probability: That the object is there and the pose within 0.1 diameters (ADD, up to the
            object's symmetries), as calibrated on validation scenes.  None where the checkpoint is
            not calibrated; `calibration_note` says why.
        presence: That the object is there, whatever the pose: at least `probability`, or None.
        pose_tolerance: What a right pose is, which the verdict goes by; None: what `probability` is
            of.  See `probability_within`.
        belief: Weighted poses.  Where `belief_calibrated`, those about the estimate are draws as
            wide as the errors of right estimates are, and the others are particles, which stand for
            other hypotheses; else every particle and its weight, as the filter leaves them.
        warnings: What makes the estimate implausible, in words; empty where nothing does.
        scale_ratio: How large the object appears, relative to its mesh: 1 where the depth and the
            intrinsics are right.  NaN where the method cannot tell, or too few pixels show it.  A
            track has that of the frame in which it began, or was found again; one that contradicts,
            or is NaN, is measured anew in frames with the whole image.
        wrong_size: Whether it appears so much larger or smaller that depth or intrinsics must be
            wrong; where several objects are found in one image, together with those of the same
            scale ratio.  `probability` supposes that they are right, so "found" becomes "unsure".
        blank: Why the image cannot be judged, in words: it is of one color, or its depth is the
            same everywhere.  The verdict is then "unsure".  Empty where it can be.
        seconds: The filter's time for this image, its share of a batch.
        object_model: The object's center, size, surface points and hull.
        costs: What errors cost, which the verdict goes by.
        calibration: What made the probabilities; None where there are none.
        features: What it made them of, by name.
        calibration_note: In words, why there is no probability; empty where there is one.
        conformal: What `conformal_set` goes by; None where the calibration has none.
        depth_inlier_fraction: The fraction of the object's surface points, those that face away
            included, whose depth at the pose agrees with the measured one.  Earlier calibrations
            choose the group of a conformal set by it, under the name `surface`.
        instance: Which of its class it is, from 0, the most probable first.
        input_warnings: Those of `warnings` that do not depend on the pose, which of an absent
            object says nothing.
        mask: The pixels (H, W) bool of the image that are its own, where instances were asked for;
            else None.
    """

    object: str
    pose: np.ndarray
    score: float
    probability: float | None
    presence: float | None
    belief: Belief
    warnings: tuple[str, ...]
    seconds: float
    object_model: ObjectModel
    _: KW_ONLY
    costs: Costs = field(default_factory=Costs)
    pose_tolerance: PoseTolerance | None = None
    calibration: Calibration | None = None
    features: Mapping[str, float] = field(default_factory=dict)
    calibration_note: str = ""
    conformal: Conformal | None = None
    depth_inlier_fraction: float = math.nan
    scale_ratio: float = math.nan
    wrong_size: bool = False
    blank: str = ""
    instance: int = 0
    input_warnings: tuple[str, ...] = ()
    mask: np.ndarray | None = None

    def __repr__(self) -> str:
        place = ", ".join(f"{x:.3f}" for x in self.pose[:3, 3])
        return f"{type(self).__name__}({self.describe()}; at ({place}) m)"

    @property
    def verdict(self) -> Verdict | None:
        """What to go by: "found", "unsure" or "absent", whichever costs least on average.

        None where there is no probability.  Of an image that cannot be judged (`blank`) always
        "unsure".  `decide` takes other costs, and another tolerance.
        """
        return self.decide(self.costs)

    def decide(
        self, costs: Costs, pose_tolerance: PoseTolerance | None = None, prior: float = 0.5
    ) -> Verdict | None:
        """Return the verdict at other costs of errors; None where there is no probability.

        Args:
            costs: What errors cost.
            pose_tolerance: What a right pose is; None: what `verdict` goes by.
            prior: Share of the images that show the object, in (0, 1); `presence` and `probability`
                are of one half. See `posefilter.confidence.verdicts.apply_prior`.

        Raises:
            UserError: As of `probability_within`; or the prior is not between 0 and 1.
        """
        check_costs(costs)
        check_pose_tolerance(pose_tolerance)
        if self.blank:
            return "unsure"
        if self.presence is None:
            return None
        tolerance = pose_tolerance or self.pose_tolerance or RIGHT
        known = self.presence, self.probability_within(tolerance)
        verdict = decide(*(known if prior == 0.5 else apply_prior(*known, prior)), costs)
        return "unsure" if verdict == "found" and self.wrong_size else verdict

    def probability_within(self, pose_tolerance: PoseTolerance | None) -> float:
        """Return the probability that the object is there and the pose within a tolerance.

        It is learned from the same calibration frames as `probability`, from how far their
        estimates are off.  Few frames tell little of a tolerance that nearly all of them keep, or
        nearly none.

        Args:
            pose_tolerance: What a right pose is, such as `PoseTolerance(translation_mm=5,
                rotation_deg=10)`, or `PoseTolerance(add_s=0.1)` where it does not matter how a can
                is turned about its axis; None: as of `probability`.

        Raises:
            UserError: There is no probability, or the checkpoint was calibrated by an earlier
                version, which knows of no other tolerance than an ADD below 0.1 diameters.
        """
        check_pose_tolerance(pose_tolerance)
        if pose_tolerance in (None, RIGHT) and self.probability is not None:
            return self.probability
        return float(self._assess(pose_tolerance or RIGHT).probability)

    def _assess(self, pose_tolerance: PoseTolerance) -> Assessment:
        """Return what the calibration makes of the features."""
        if self.calibration is None or not self.features:
            why = self.calibration_note or "the image cannot be judged"
            raise UserError(f"{self.object}: has no probability ({why})")
        row = {name: torch.tensor([value]) for name, value in self.features.items()}
        return self.calibration.assess(row, pose_tolerance)

    @property
    def model(self) -> ObjectModel:
        """The earlier name of `object_model`."""
        return self.object_model

    @property
    def surface(self) -> float:
        """The earlier name of `depth_inlier_fraction`."""
        return self.depth_inlier_fraction

    @property
    def covariance(self) -> np.ndarray:
        """The covariance (6, 6) of the pose's error, if the pose is right: see
        `Belief.error_covariance`.

        That of the whole belief about its mean, other modes included, is `belief.covariance`.
        """
        return self.belief.error_covariance(self.pose)

    @property
    def belief_calibrated(self) -> bool:
        """Whether the belief's width is calibrated.  It is not where a calibration is of an earlier
        version or of too few right estimates, nor that of a track in a frame that did not show it.
        """
        return self.belief.draws > 0

    @property
    def modes(self) -> tuple[Mode, ...]:
        """The belief's modes, the heaviest first; see `Belief.modes`."""
        return self.belief.modes

    def conformal_set(self, level: float = 0.9) -> PoseSet:
        """Return a set of poses that holds the truth with a probability, whatever the belief is
        worth.

        Of frames like the calibration's that show the object, at least `level` have the truth in
        this set: exactly so where groups are told apart by `surface`, and nearly where by the
        probability; see `posefilter.confidence.conformal`.  It is the set of all poses where
        calibration frames are too few for the level.

        Args:
            level: Least probability, in [0, 1].

        Raises:
            UserError: The checkpoint was not calibrated for sets.
        """
        if self.conformal is None:
            why = self.calibration_note or self._why_no_sets
            raise UserError(f"{self.object}: has no conformal sets ({why})")
        check_probability("level", level)
        by_depth = self.conformal.by == "surface"
        value = self.depth_inlier_fraction if by_depth else self.probability
        assert value is not None  # where there are sets there is a probability
        limit = self.conformal.find_limit(level, value)
        threshold = -self.belief.differential_entropy - limit
        return self.belief.highest_density_region(level, threshold)

    @property
    def _why_no_sets(self) -> str:
        if self.mask is None:
            return "it was calibrated by an earlier version, without sets"
        return "their guarantee is of one search of the whole image, not of instances"

    @property
    def shown_pose(self) -> np.ndarray | None:
        """The pose (4, 4) that pictures show; None where the object is absent."""
        return None if self.verdict == "absent" else self.pose

    def draw_overlay(self, rgb: Any, intrinsics: Any, shape: "Shape | None" = None) -> np.ndarray:
        """Draw the object's outline and axes on the image that it was found in: full where it is
        found, dashed where the verdict is unsure, none where it is absent.

        Args:
            rgb: The image, in any form that `Estimator.predict` takes.
            intrinsics: Its camera matrix (3, 3) [px].
            shape: A mesh, for the exact outline; None: the convex hull.

        Returns:
            The picture (h, w, 3) uint8.

        Raises:
            UserError: The image or the camera matrix is not as it should be.
        """
        from posefilter.figures.overlay import draw_overlay  # slow to import, needed for pictures

        shape = self.object_model.hull if shape is None else shape
        pose, words, unsure = self.shown_pose, self.describe(), self.verdict == "unsure"
        return draw_overlay(rgb, intrinsics, pose, shape, caption=words, dashed=unsure)

    def describe(self) -> str:
        """Return the verdict in a few words: `003_cracker_box: found, probability 0.97`."""
        if self.blank:
            return f"{self.object}: unsure, the image cannot be judged"
        if self.probability is None or self.presence is None:
            return f"{self.object}, score {self.score:.2f}"
        there = f"{describe_probability(self.presence)} that it is there"
        if self.verdict == "absent":
            return f"{self.object}: absent, probability {there}"
        if self.verdict == "unsure" and self.wrong_size:
            return f"{self.object}: unsure, appears {self.scale_ratio:.2f} times its size"
        said, tolerance = describe_probability(self.probability), self.pose_tolerance
        if tolerance is not None:
            within = describe_probability(self.probability_within(tolerance))
            said = f"{within} {tolerance.describe()}"
        if self.verdict == "unsure":
            return f"{self.object}: unsure, probability {said}, {there}"
        return f"{self.object}: found, probability {said}"

    def draw_belief(self, rgb: Any, intrinsics: Any) -> np.ndarray:
        """Draw the belief: rotations on a map, centers on the image, marginals.

        Args:
            rgb: The image, in any form that `Estimator.predict` takes.
            intrinsics: Its camera matrix (3, 3) [px].

        Returns:
            The picture (h, w, 3) uint8.
        """
        from posefilter.figures.belief import draw_belief  # slow to import, needed for pictures

        tensors = BeliefBatch(
            torch.from_numpy(self.belief.samples),
            torch.from_numpy(self.belief.weights).log(),
            torch.from_numpy(self.pose),
            torch.tensor(self.score),
        )
        title = f"Belief\n{self.describe()}"
        draws = self.belief.draws
        return draw_belief(rgb, intrinsics, tensors, self.object_model, title=title, draws=draws)

    def draw_band(
        self, rgb: Any, intrinsics: Any, shape: "Shape | None" = None, level: float = 0.95
    ) -> np.ndarray:
        """Draw how sure the belief is of the object's outline: the band in which, at a point of
        the outline, it lies with the probability `level`, if the belief is right.

        Args:
            rgb: The image, in any form that `Estimator.predict` takes.
            intrinsics: Its camera matrix (3, 3) [px].
            shape: A mesh, for the exact outline; None: the convex hull.
            level: That probability.

        Returns:
            The picture (h, w, 3) uint8.

        Raises:
            UserError: The level is not in [0, 1], or the image not as it should be.
        """
        from posefilter.figures.band import draw_band  # slow to import, needed for pictures

        check_probability("level", level)
        shape = self.object_model.hull if shape is None else shape
        poses, weights = self.belief.samples, self.belief.weights
        return draw_band(rgb, intrinsics, poses, weights, shape, level, caption=self.describe())


class Run(NamedTuple):
    """One object's filter on a batch of images."""

    method: PoseEstimator
    batch: Batch  # at the network's resolution
    trace: Trace
    seconds: float  # an image
    found: Assessment | None = None  # None where there is no probability
    size: ScaleRatio | None = None  # None where the method cannot tell
    blank: Sequence[str] = ()  # of each image, as `find_blank` says it; none: all can be judged
    # (B,) how many of the belief's first poses are draws about the estimate, None: not calibrated
    draws: torch.Tensor | None = None
    # depth (H, W) [m] and camera matrix of a single photograph of which `batch` is a part
    photograph: tuple[np.ndarray, np.ndarray] | None = None


def collect_results(
    runs: Sequence[Run], costs: Costs | None = None, pose_tolerance: PoseTolerance | None = None
) -> list[list[Result]]:
    """Return the results of runs on the same images: a list an image, of a result an object.

    Args:
        runs: A run an object.
        costs: What errors cost; None: the default.
        pose_tolerance: What a right pose is; None: an ADD below 0.1 diameters.
    """
    runs, count = pool_scale_ratios(runs), len(runs[0].batch.rgb)
    return [[make_result(run, i, costs, pose_tolerance) for run in runs] for i in range(count)]


def pool_scale_ratios(runs: Sequence[Run]) -> list[Run]:
    """Return runs on the same images with scale ratios that are judged together: see
    `posefilter.confidence.scale_ratio.pool_gains`.
    """
    out = list(runs)
    known = [
        (i, ScaleRatio(*(part.cpu() for part in run.size)), run.found.presence.cpu() > _THERE)
        for i, run in enumerate(runs)
        if run.size is not None and run.found is not None
    ]
    if len(known) > 1:
        numbers, ratios, there = zip(*known, strict=True)
        for i, ratio in zip(numbers, pool_gains(ratios, there), strict=True):
            out[i] = out[i]._replace(size=ratio)
    return out


def make_result(
    run: Run, image: int, costs: Costs | None = None, pose_tolerance: PoseTolerance | None = None
) -> Result:
    """Return what a run amounts to for one image of its batch."""
    object_model, belief, found = run.method.object_model, run.trace.belief, run.found
    calibration, note = run.method.calibration, ""
    if found is None:
        note = run.method.calibration_note if calibration is None else "the frame shows nothing"
        calibration = None
    features = {} if found is None or found.features is None else found.features
    values = {name: float(value[image]) for name, value in features.items()}
    pose = belief.best[image].double().cpu().numpy()
    size = math.nan if run.size is None else float(run.size.scale[image])
    wrong_size = run.size is not None and bool(run.size.contradicts()[image])
    blank = run.blank[image] if run.blank else ""
    depth, K = run.photograph or (
        run.batch.depth[image, 0].cpu().numpy(),
        run.batch.intrinsics[image].double().cpu().numpy(),
    )
    seen = size if wrong_size else None
    doubts = (blank,) if blank else ()
    return Result(
        object=object_model.name,
        pose=pose,
        score=float(belief.score[image]),
        probability=None if found is None else float(found.probability[image]),
        presence=None if found is None else float(found.presence[image]),
        belief=make_belief(belief, image, object_model, run.draws),
        warnings=(*doubts, *find_warnings(pose, object_model, depth, K, seen)),
        input_warnings=(*doubts, *find_input_warnings(depth, K, seen)),
        seconds=run.seconds,
        object_model=object_model,
        costs=costs or Costs(),
        pose_tolerance=pose_tolerance,
        calibration=calibration,
        features=values,
        calibration_note=note,
        conformal=None if calibration is None else calibration.conformal,
        depth_inlier_fraction=values.get("surface", math.nan),
        scale_ratio=size,
        wrong_size=wrong_size,
        blank=blank,
    )


def make_belief(
    beliefs: BeliefBatch, image: int, object_model: ObjectModel, draws: torch.Tensor | None = None
) -> Belief:
    """Return one belief of a batch as users get it.

    Args:
        beliefs: B beliefs.
        image: Which of them.
        object_model: The object.
        draws: (B,) as of `PoseEstimator.calibrate_belief`; None: not calibrated.
    """
    weights = beliefs.log_weights[image].double().cpu().exp().numpy()
    samples = beliefs.poses[image].double().cpu().numpy()
    count = 0 if draws is None else int(draws[image])
    return belief_over(object_model, samples, weights / weights.sum(), count)
