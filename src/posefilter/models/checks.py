"""Choices that fit one by one, and not together: each check raises a UserError that says what to
choose instead.
"""

from typing import TYPE_CHECKING

from posefilter.errors import UserError
from posefilter.filters.agreement import Agreement
from posefilter.labels.membership import Quality
from posefilter.losses.displacement import Sides
from posefilter.losses.pose_loss import SurfacePointLoss
from posefilter.models.box_heads import PoseBox, VotedBox
from posefilter.nets.heads import NoPose, SurfacePointFragments
from posefilter.nets.mlp import LatentNet

if TYPE_CHECKING:
    from posefilter.models.base import PoseEstimator
    from posefilter.models.image_space import ImageSpace


def check_estimate(method: "PoseEstimator") -> None:
    """Raise UserError unless its particles tell, by their own points, what the estimate asks them
    for.
    """
    kind, filters = type(method), (method.filter, method.train_filter)
    if any(isinstance(f.estimate, Agreement) for f in filters) and not (
        kind.tells_pose and hasattr(kind, "surface_points")
    ):
        raise UserError(
            f"filter/estimate=agreement: no particle of {kind.__name__} tells which point of the object "
            f"its own pixel shows; "
            "choose filter/estimate=argmax"
        )


def check_poses(method: "ImageSpace") -> None:
    """Raise UserError where a pose is asked of particles that tell none, or none told by a method
    that is judged by it.
    """
    name, untold = type(method).__name__, isinstance(method.pose_head, NoPose)
    if method.tells_pose and untold:
        raise UserError(
            f"model/pose_head=none: {name} is judged by its poses; choose fragments, "
            f"own_point or absolute"
        )
    if untold and isinstance(method.box_head, PoseBox):
        raise UserError(
            f"model/box_head=pose: no particle of {name} tells a pose; choose "
            f"model/box_head=votes or model/box_head=spread"
        )
    losses = [candidate_sampler.loss for candidate_sampler in method.aux_losses.values()]
    if untold and any(isinstance(getattr(loss, "label", None), Quality) for loss in losses):
        raise UserError(
            f"loss/aux/likelihood=quality: no particle of {name} tells a pose; choose balanced or focal"
        )
    if untold and any(isinstance(loss, SurfacePointLoss) for loss in losses):
        raise UserError(
            f"loss/aux/pose=own_point: no particle of {name} tells a pose; choose loss/aux/pose=none"
        )


def check_fragments(method: "ImageSpace") -> None:
    """Raise UserError where fragments are told and nothing teaches them."""
    taught = any(
        isinstance(candidate_sampler.loss, SurfacePointLoss)
        for candidate_sampler in method.aux_losses.values()
    )
    if isinstance(method.pose_head, SurfacePointFragments) and not taught:
        raise UserError(
            "model/pose_head: nothing but loss/aux/pose=own_point teaches fragments; choose it, "
            "or model/pose_head=own_point"
        )


def check_votes(method: "ImageSpace") -> None:
    """Raise UserError unless the latent that is read, or taught, as the box's four sides is nothing
    else.
    """
    taught = any(
        isinstance(candidate_sampler.loss, Sides)
        for candidate_sampler in method.aux_losses.values()
    )
    if not (taught or isinstance(method.box_head, VotedBox)):
        return
    if isinstance(method.net, LatentNet):
        raise UserError(
            "model/box_head=votes: the box's sides would take the place of all that the net remembers "
            "from step to step; "
            "choose model/box_head=pose or model/box_head=spread"
        )
    if method.latent_width != 4:
        raise UserError(
            f"model.net.latent_width={method.latent_width}: model/box_head=votes needs 4, one for "
            f"each of the box's sides"
        )


def check_training_clouds(method: "ImageSpace") -> None:
    """Raise UserError unless all clouds of a training roll-out are of one size: the losses judge
    them side by side.
    """
    rolled, name = (
        method.train_filter,
        "filter" if method.train_filter is method.filter else "model.train_filter",
    )
    if rolled.steps > 1 and rolled.first_particles != rolled.particles:
        raise UserError(
            f"{name}.first_particles={rolled.first_particles}: a training needs as many as "
            f"{name}.particles="
            f"{rolled.particles}; choose {name}.first_particles=null or model/train_rollout=truncated "
            f"(evaluate.py takes any)"
        )
