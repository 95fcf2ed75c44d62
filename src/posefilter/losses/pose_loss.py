"""Losses on the particles' poses: how far they put the object's points from where they belong."""

import torch
from torch import Tensor

from posefilter.errors import UserError
from posefilter.geometry.camera import back_project
from posefilter.geometry.fragments import fragment_errors, may_be_object
from posefilter.geometry.lookup import nearest_pixel, pick
from posefilter.geometry.pose import invert, transform
from posefilter.geometry.pose_error import deviation, nearest_pose_error, thin
from posefilter.losses.likelihood import log_not
from posefilter.protocols import Label
from posefilter.types import Batch, Fragments, ObjectModel, ParticleOutput, Particles, Trace


class Add:
    """ADD of the last step's poses (the paper, eq. 1), over every particle or weighted by
    likelihood.  [m]

    weighting: mean (every particle alike) or likelihood (the cloud's normalized likelihoods, which
    learn from it too); points: an even selection of the model's.
    """

    distance = staticmethod(deviation)

    def __init__(self, weighting: str = "mean", points: int = 256) -> None:
        if weighting not in ("mean", "likelihood"):
            raise UserError(f"loss.weighting={weighting!r} is unknown: choose mean or likelihood")
        self.weighting = weighting
        self.points = points

    def __call__(self, trace: Trace, batch: Batch, model: ObjectModel) -> Tensor:
        """Return (B,) [m]."""
        output: ParticleOutput = trace.outputs[-1]
        points = thin(model.points, self.points).to(batch.rgb)
        off = self.distance(output.pose, batch.camera_from_object, points)
        if self.weighting == "mean":
            return off.mean(1)
        return (torch.softmax(output.log_likelihood, dim=1) * off).sum(1)


class AddS(Add):
    """ADD-S of the last step's poses: each estimated point to the nearest true one (the paper, eq.
    2).  [m]
    """

    distance = staticmethod(nearest_pose_error)


class Confidence:
    """Pose error weighted by the particle's own confidence c: e c - w log c on the object
    (DenseFusion, Wang et al. 2019).

    e is ADD over the diameter, and c the likelihood. DenseFusion is given the object's pixels; a
    particle off the object has no pose to tell, so there its c is pushed down by -w log(1 - c), a
    quarter of the particles' weight in all.
    """

    def __init__(self, label: Label, weight: float = 0.5, points: int = 64) -> None:
        self.label = label
        self.weight = weight
        self.points = points

    def __call__(self, trace: Trace, batch: Batch, model: ObjectModel) -> Tensor:
        """Return (B,)."""
        points = thin(model.points, self.points).to(batch.rgb)
        on = self.label(trace, batch, model) > 0
        total = batch.rgb.new_zeros(len(batch.rgb))
        for output, inside in zip(trace.outputs, on, strict=True):
            off = deviation(output.pose, batch.camera_from_object, points) / model.diameter
            log_c = output.log_likelihood
            fit = off * log_c.exp() - self.weight * log_c
            fit = (fit * inside).sum(1) / inside.sum(1).clamp_min(1)
            reject = -self.weight * log_not(log_c)
            total = total + fit + 0.25 * (reject * ~inside).sum(1) / (~inside).sum(1).clamp_min(1)
        return total / len(trace.outputs)


class SurfacePointLoss:
    """Where a particle's own measured 3-D point lies on the object, against where it belongs.

    A particle on the object sees one point of the surface: its object coordinates are what it can
    know best, and many particles' coordinates fix a pose. Told outright, by a pose, they are judged
    by their distance, over the radius; told as fragments (EPOS, Hodan et al. 2020), by
    `fragment_weight` x (the cross-entropy of the fragments, and `within` x the L1 error of the
    place in the true one, in units of the fragments' reach). Counts particles whose pixel is on the
    mask and has depth.
    """

    def __init__(self, fragment_weight: float = 0.25, within: float = 0.3) -> None:
        self.fragment_weight, self.within = fragment_weight, within

    def __call__(self, trace: Trace, batch: Batch, model: ObjectModel) -> Tensor:
        """Return (B,)."""
        total = batch.rgb.new_zeros(len(batch.rgb))
        for particles, output in zip(trace.particles, trace.outputs, strict=True):
            point, true, counts = true_points(particles, batch, model)
            if output.fragments is None:
                guess = transform(invert(output.pose), point[:, :, None])[:, :, 0]
                off = ((guess - true).square().sum(-1) + 1e-12).sqrt() / model.radius
            else:
                off = self._of_fragments(
                    output.fragments, (true - model.center.to(true)) / model.radius
                )
            total = total + (off * counts).sum(1) / counts.sum(1).clamp_min(1)
        return total / len(trace.outputs)

    def _of_fragments(self, said: Fragments, true: Tensor) -> Tensor:
        """Judge what is said by the true points over the radius, from the center.

        (B, N, 3) -> (B, N).
        """
        surprise, error = fragment_errors(
            said.log_share, said.place, said.centers, said.reach, true
        )
        return self.fragment_weight * (surprise + self.within * error)


def true_points(
    particles: Particles, batch: Batch, model: ObjectModel
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the point that each particle measures, and which point of the object it is.

    -> (B, N, 3) in the camera [m]; (B, N, 3) in the object's frame [m]; (B, N) bool: the particle's
    pixel is on the mask, and its depth can be of the object.
    """
    seen = torch.cat([batch.depth, batch.mask.to(batch.depth)], dim=1)
    z, on = pick(seen, nearest_pixel(particles.state)).unbind(-1)
    point = back_project(particles.state.detach(), z, batch.intrinsics)
    true = transform(invert(batch.camera_from_object), point)
    near = may_be_object((true - model.center.to(true)) / model.radius)
    return point, true, (on > 0) & (z > 0) & near
