"""Choices that fit one by one, and not together: each check raises a UserError that says what to choose instead."""

from typing import TYPE_CHECKING

from posefilter.errors import UserError
from posefilter.filters.agreement import Agreement
from posefilter.labels.membership import Quality
from posefilter.losses.deviation import OwnPoint
from posefilter.losses.motion import Sides
from posefilter.models.box import PoseBox, VotedBox
from posefilter.nets.heads import NoPose, OwnPointFragments
from posefilter.nets.mlp import LatentNet

if TYPE_CHECKING:
    from posefilter.models.base import PoseEstimator
    from posefilter.models.image_space import ImageSpace


def check_estimate(method: "PoseEstimator") -> None:
    """Raise UserError unless its particles tell, by their own points, what the estimate asks them for."""
    kind, filters = type(method), (method.filter, method.train_filter)
    if any(isinstance(f.estimate, Agreement) for f in filters) and not (kind.tells_pose and hasattr(kind, "own_points")):
        raise UserError(
            f"estimate=agreement: no particle of {kind.__name__} tells which point of the object its own pixel shows; "
            "choose estimate=best"
        )


def check_poses(method: "ImageSpace") -> None:
    """Raise UserError where a pose is asked of particles that tell none, or none told by a method that is judged by it."""
    name, untold = type(method).__name__, isinstance(method.pose_code, NoPose)
    if method.tells_pose and untold:
        raise UserError(f"pose_code=none: {name} is judged by its poses; choose fragments, own_point or absolute")
    if untold and isinstance(method.bounds, PoseBox):
        raise UserError(f"bounds=pose: no particle of {name} tells a pose; choose bounds=votes or bounds=spread")
    losses = [lesson.loss for lesson in method.lessons.values()]
    if untold and any(isinstance(getattr(loss, "label", None), Quality) for loss in losses):
        raise UserError(f"likelihood_lesson=quality: no particle of {name} tells a pose; choose balanced or focal")
    if untold and any(isinstance(loss, OwnPoint) for loss in losses):
        raise UserError(f"pose_lesson=own_point: no particle of {name} tells a pose; choose pose_lesson=none")


def check_fragments(method: "ImageSpace") -> None:
    """Raise UserError where fragments are told and nothing teaches them."""
    taught = any(isinstance(lesson.loss, OwnPoint) for lesson in method.lessons.values())
    if isinstance(method.pose_code, OwnPointFragments) and not taught:
        raise UserError("pose_code: nothing but pose_lesson=own_point teaches fragments; choose it, or pose_code=own_point")


def check_votes(method: "ImageSpace") -> None:
    """Raise UserError unless the memory that is read, or taught, as the box's four sides is nothing else."""
    taught = any(isinstance(lesson.loss, Sides) for lesson in method.lessons.values())
    if not (taught or isinstance(method.bounds, VotedBox)):
        return
    if isinstance(method.net, LatentNet):
        raise UserError(
            "bounds=votes: the box's sides would take the place of all that the net remembers from step to step; "
            "choose bounds=pose or bounds=spread"
        )
    if method.memory_width != 4:
        raise UserError(f"net.memory_width={method.memory_width}: bounds=votes needs 4, one for each of the box's sides")


def check_training_clouds(method: "ImageSpace") -> None:
    """Raise UserError unless all clouds of a training roll-out are of one size: the losses judge them side by side."""
    rolled, name = method.train_filter, "filter" if method.train_filter is method.filter else "train_filter"
    if rolled.steps > 1 and rolled.first_particles != rolled.particles:
        raise UserError(
            f"{name}.first_particles={rolled.first_particles}: a training needs as many as {name}.particles="
            f"{rolled.particles}; choose {name}.first_particles=null or train_filter=short (evaluate.py takes any)"
        )
