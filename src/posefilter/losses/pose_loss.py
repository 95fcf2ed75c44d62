"""Losses of the particles' poses, by the distances of the object's points."""

from typing import ClassVar

import torch
from torch import Tensor

from posefilter.capabilities import Capabilities
from posefilter.errors import check_choice
from posefilter.geometry.camera import back_project
from posefilter.geometry.fragments import fragment_errors, within_bounds
from posefilter.geometry.lookup import gather_pixels, nearest_pixel
from posefilter.geometry.pose import invert, transform
from posefilter.geometry.pose_error import add_distance, add_s_distance, subsample
from posefilter.losses.likelihood import log1mexp
from posefilter.protocols import Label
from posefilter.types import Batch, ObjectModel, ParticleOutput, Particles, Trace


class Add:
    """ADD of the last step's poses [m] (the paper, eq. 1).

    Args:
        weighting: "mean" over particles, or "likelihood" for the mean weighted by normalized
            likelihoods, which then get gradients too.
        points: Number of points, an even selection of the model's.

    Raises:
        UserError: `weighting` is unknown.
    """

    requires: ClassVar[Capabilities] = ("pose", "rollout")

    distance = staticmethod(add_distance)

    def __init__(self, weighting: str = "mean", points: int = 256) -> None:
        check_choice("loss.weighting", weighting, "mean", "likelihood")
        self.weighting = weighting
        self.points = points

    def __call__(self, trace: Trace, batch: Batch, object_model: ObjectModel) -> Tensor:
        """Return (B,) [m]."""
        output: ParticleOutput = trace.outputs[-1]
        points = subsample(object_model.points, self.points).to(batch.rgb)
        error = self.distance(output.pose, batch.camera_from_object, points)
        if self.weighting == "mean":
            return error.mean(1)
        return (torch.softmax(output.log_likelihood, dim=1) * error).sum(1)


class AddS(Add):
    """ADD-S of the last step's poses [m]: the nearest true point of each estimated one (eq. 2)."""

    distance = staticmethod(add_s_distance)


class Confidence:
    """Pose error weighted by a confidence c: e c - w log c (DenseFusion, Wang et al. 2019).

    e is ADD over the diameter, and c the likelihood. DenseFusion is given the object's pixels; here
    particles can be off the object. Their c is driven to 0 by -w log(1 - c), with a quarter of the
    weight.

    Args:
        label: Positive for particles on the object.
        weight: w, the weight of the confidence's logarithm.
        points: Number of points of ADD.
    """

    requires: ClassVar[Capabilities] = ("pose", "rollout")

    def __init__(self, label: Label, weight: float = 0.5, points: int = 64) -> None:
        self.label = label
        self.weight = weight
        self.points = points

    def __call__(self, trace: Trace, batch: Batch, object_model: ObjectModel) -> Tensor:
        """Return (B,)."""
        points = subsample(object_model.points, self.points).to(batch.rgb)
        on = self.label(trace, batch, object_model) > 0
        total = batch.rgb.new_zeros(len(batch.rgb))
        for output, inside in zip(trace.outputs, on, strict=True):
            error = add_distance(output.pose, batch.camera_from_object, points)
            error = error / object_model.diameter
            log_c = output.log_likelihood
            fit = error * log_c.exp() - self.weight * log_c
            fit = (fit * inside).sum(1) / inside.sum(1).clamp_min(1)
            reject = -self.weight * log1mexp(log_c)
            total = total + fit + 0.25 * (reject * ~inside).sum(1) / (~inside).sum(1).clamp_min(1)
        return total / len(trace.outputs)


class SurfacePointLoss:
    """Error of the predicted object point of each particle's own measured point.

    A single predicted point is compared by its distance, in radii. For fragments (EPOS, Hodan et
    al. 2020) the loss is `fragment_weight` x (cross-entropy of the fragments + `offset_weight` x
    L1 error of the position in the true fragment). Only particles on the mask and with valid depth
    count.

    Args:
        fragment_weight: Weight of the loss of fragments.
        offset_weight: Weight of the position in the fragment.
    """

    provides: ClassVar[Capabilities] = ("surface_point_loss",)
    requires: ClassVar[Capabilities] = ("pixel_space", "pose", "rollout")

    def __init__(self, fragment_weight: float = 0.25, offset_weight: float = 0.3) -> None:
        self.fragment_weight, self.offset_weight = fragment_weight, offset_weight

    def __call__(self, trace: Trace, batch: Batch, object_model: ObjectModel) -> Tensor:
        """Return (B,)."""
        total = batch.rgb.new_zeros(len(batch.rgb))
        for particles, output in zip(trace.particles, trace.outputs, strict=True):
            point, true, counts = measured_points(particles, batch, object_model)
            if output.fragments is None:
                guess = transform(invert(output.pose), point[:, :, None])[:, :, 0]
                error = ((guess - true).square().sum(-1) + 1e-12).sqrt() / object_model.radius
            else:
                relative = (true - object_model.center.to(true)) / object_model.radius
                nll, offset = fragment_errors(*output.fragments, relative)
                error = self.fragment_weight * (nll + self.offset_weight * offset)
            total = total + (error * counts).sum(1) / counts.sum(1).clamp_min(1)
        return total / len(trace.outputs)


def measured_points(
    particles: Particles, batch: Batch, object_model: ObjectModel
) -> tuple[Tensor, Tensor, Tensor]:
    """Return each particle's measured point in both frames.

    Returns:
        Points in the camera (B, N, 3) [m]; the true object points (B, N, 3) [m], object frame; and
        bool (B, N): the particle is on the mask, and its depth can belong to the object.
    """
    maps = torch.cat([batch.depth, batch.mask.to(batch.depth)], dim=1)
    z, on = gather_pixels(maps, nearest_pixel(particles.state)).unbind(-1)
    point = back_project(particles.state.detach(), z, batch.intrinsics)
    true = transform(invert(batch.camera_from_object), point)
    near = within_bounds((true - object_model.center.to(true)) / object_model.radius)
    return point, true, (on > 0) & (z > 0) & near
