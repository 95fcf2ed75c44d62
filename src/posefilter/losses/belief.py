"""Negative log density of the truth under the weighted particles: an end-to-end loss on the belief.

The particles (x_i, w_i) of a step are a mixture with a kernel about each,

    p(y) = sum_i w_i K(y; x_i),        loss = -log p(truth),

as differentiable particle filters are trained (Jonschkowski, Rastogi and Brock 2018; Karkus, Hsu
and Lee 2018). w_i are the filter's own weights, normalized, and not only the step's likelihood. So
the gradient reaches all that made them: the likelihood of the step, by w_i; the displacements that
led to x_i; predicted poses; and earlier likelihoods as far as the resampling and the reweighting
let it through (docs/methods/choices.md).

There is no background: far from all particles -log p grows as the squared distance to the nearest,
so that the gradient does not vanish where the belief is wrong. Logarithms are natural.

References:
    Jonschkowski, Rastogi, Brock: Differentiable particle filters. RSS (2018).
    Karkus, Hsu, Lee: Particle filter networks with application to visual localization. CoRL (2018).
    Khatri, Mardia: The von Mises-Fisher matrix distribution in orientation statistics. JRSS B 39
        (1977).
"""

import math
from collections.abc import Mapping
from typing import ClassVar, Protocol

import torch
from torch import Tensor

from posefilter.capabilities import Capabilities
from posefilter.errors import check_choice
from posefilter.geometry.lookup import mask_pixels
from posefilter.geometry.pose import origin_of, rotation_of
from posefilter.types import Batch, ObjectModel, ParticleOutput, Particles, Trace


class TruthDensity(Protocol):
    """The log density of the truth under the particles of one step."""

    def __call__(
        self, particles: Particles, output: ParticleOutput, batch: Batch, object_model: ObjectModel
    ) -> Tensor:
        """Return (B,) [nat]."""


class MaskDensity:
    """Mean log density of the true mask's pixels, under particles that are pixels.

    It is -H(q, p), the cross-entropy of q, uniform on the M pixels of the mask, and the mixture p:

        (1 / M) sum_m log sum_i w_i N(u_m; x_i, s^2 I)        [per squared frame width]

    It is greatest where the particles' mass covers the mask evenly: a belief at one point of the
    object is worse than one over all of it. Where the object is not visible it is 0.

    Args:
        sigma: s, in frame widths.
        max_pixels: Maximum number of mask pixels, an even selection; None for all.
    """

    requires: ClassVar[Capabilities] = ("pixel_space",)

    def __init__(self, sigma: float = 0.03, max_pixels: int | None = 256) -> None:
        self.sigma, self.max_pixels = sigma, max_pixels

    def __call__(
        self, particles: Particles, output: ParticleOutput, batch: Batch, object_model: ObjectModel
    ) -> Tensor:
        """Return (B,) [nat]."""
        pixels, valid = mask_pixels(batch.mask, self.max_pixels)
        offset = (pixels.to(batch.rgb)[:, :, None] - particles.state[:, None]) / batch.rgb.shape[-1]
        log_kernel = -0.5 * (offset / self.sigma).square().sum(-1)  # (B, M, N)
        log_p = (particles.log_weights[:, None] + log_kernel).logsumexp(2)
        log_p = log_p - math.log(2 * math.pi * self.sigma**2)
        return (log_p * valid).sum(1) / valid.sum(1).clamp_min(1)


class PoseDensity:
    """Log density of the true pose, under the particles' poses.

    With c the position of the object's center and R the rotation,

        K(T; T_i) = N(c; c_i, s^2 I) exp(k tr(R_i^T R)) / z(k),        k = 1 / (2 a^2)

    an isotropic matrix Fisher distribution (Khatri and Mardia 1977): for small angles a Gaussian
    of standard deviation a about each axis, smooth up to half a turn. Where SO(3) has the volume
    pi^2, the measure of `credibility/log_density` (geometry/pose_density.py),

        z(k) = pi^2 e^k (I_0(2 k) - I_1(2 k))

    Symmetries: the mean density over the object's equivalent true poses, the density of the belief
    when a pose and what a symmetry makes of it count as one. So a belief may be at any one of them,
    and loses log S of S; the mean of the logarithms would demand all.

    Args:
        translation_mm: s [mm].
        rotation_deg: a [degrees].
    """

    requires: ClassVar[Capabilities] = ("pose",)

    def __init__(self, translation_mm: float = 20.0, rotation_deg: float = 10.0) -> None:
        self.translation_m = translation_mm / 1000
        self.sharpness = 0.5 / math.radians(rotation_deg) ** 2  # k
        double = torch.tensor(2 * self.sharpness, dtype=torch.float64)
        # I_0 and I_1 without e^(2 k)
        bessel = float(torch.special.i0e(double) - torch.special.i1e(double))
        log_volume = math.log(bessel) + 2 * math.log(math.pi)
        self.log_scale = -log_volume - 1.5 * math.log(2 * math.pi * self.translation_m**2)

    def __call__(
        self, particles: Particles, output: ParticleOutput, batch: Batch, object_model: ObjectModel
    ) -> Tensor:
        """Return (B,) [nat]."""
        truth = batch.camera_from_object[:, None]
        truth = truth @ object_model.symmetries.to(truth)
        log_kernel = self.log_kernel(output.pose[:, None], truth[:, :, None], object_model.center)
        log_p = (particles.log_weights[:, None] + log_kernel).logsumexp((1, 2))
        return log_p - math.log(truth.shape[1])

    def log_kernel(self, pose: Tensor, at: Tensor, center: Tensor) -> Tensor:
        """Return log K(at; pose).  (*, 4, 4) x 2, (3,) of the object [m] -> (*) [nat]."""
        center = center.to(pose)
        shift = (origin_of(pose, center) - origin_of(at, center)) / self.translation_m
        # |R_i - R|^2 / 2 = 3 - tr(R_i^T R), without cancellation
        turn = 0.5 * (rotation_of(pose) - rotation_of(at)).square().sum((-2, -1))
        return self.log_scale - 0.5 * shift.square().sum(-1) - self.sharpness * turn


class BeliefNll:
    """Negative log density of the truth under the weighted particles, summed over terms.

    Terms are densities of different things, such as the mask and the pose. Their sum takes these as
    independent given the belief.

    Args:
        terms: By name.
        steps: "all" for the mean over steps, or "last", which the earlier likelihoods and
            displacements learn from only through the filter.

    Raises:
        UserError: `steps` is neither "last" nor "all".
    """

    requires: ClassVar[Capabilities] = ("rollout",)

    def __init__(self, terms: Mapping[str, TruthDensity], steps: str = "all") -> None:
        check_choice("loss.steps", steps, "last", "all")
        self.terms, self.steps = dict(terms), steps

    def __call__(self, trace: Trace, batch: Batch, object_model: ObjectModel) -> Tensor:
        """Return (B,) [nat]; 0 where the object is not visible."""
        judged = list(zip(trace.particles, trace.outputs, strict=True))
        if self.steps == "last":
            judged = judged[-1:]
        log_p = [
            term(particles, output, batch, object_model)
            for particles, output in judged
            for term in self.terms.values()
        ]
        return -torch.stack(log_p).sum(0) / len(judged) * batch.mask.flatten(1).any(1)
