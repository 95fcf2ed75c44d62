"""What a tracker is set to."""

from dataclasses import dataclass, field, fields
from typing import Any, cast

from posefilter.errors import UserError
from posefilter.ranges import find_range
from posefilter.tracking.motion import ConstantVelocity


def check_settings(settings: Any, place: str) -> None:
    """Check each setting by the range of its place, and those without a range by their class.

    Args:
        settings: A dataclass.
        place: Of its settings in `RANGES`.

    Raises:
        UserError: A setting is outside of its range, or of another class.
    """
    for one in fields(settings):
        value, allowed = getattr(settings, one.name), find_range(f"{place}.{one.name}")
        kind = cast(type, one.type)
        if not (isinstance(value, kind) if allowed is None else allowed.holds(value)):
            expected = f"a {kind.__module__}.{kind.__name__}" if allowed is None else allowed
            raise UserError(f"tracker: {one.name}={value!r} must be {expected}")


@dataclass(frozen=True)
class FilterSettings:
    """Settings of the filter that runs in a frame.

    Attributes:
        min_particles: Particles of the belief at least.
        max_particles: Particles at most; KLD sampling chooses between.
        proposals: Particles that the network proposes, beside them, in frames of which it sees the
            whole image.
        steps: Likelihood steps.
        initial_sigma: Noise level of the first step [m].
        final_sigma: Noise level of the last [m].
        pixels: Image points that a pose is scored from.

    Raises:
        UserError: A number is out of range.
    """

    min_particles: int
    max_particles: int
    proposals: int
    steps: int
    initial_sigma: float
    final_sigma: float
    pixels: int

    def __post_init__(self) -> None:
        """Check the numbers."""
        check_settings(self, "tracker.follow")  # the ranges of probe and search are the same
        if self.max_particles < self.min_particles:
            raise UserError(
                f"tracker: max_particles={self.max_particles} is below "
                f"min_particles={self.min_particles}"
            )
        if self.final_sigma > self.initial_sigma:
            raise UserError(
                f"tracker: initial_sigma={self.initial_sigma}, final_sigma={self.final_sigma}: "
                "noise levels fall"
            )


@dataclass(frozen=True)
class TrackerSettings:
    """Settings of a tracker.

    Attributes:
        motion: How an object may move between two frames.
        follow: The filter while the object is tracked.
        probe: The filter that probes the whole image for an object that is lost.
        search: The filter of a search, which starts from the best of a probe.
        noise_scale: Standard deviation of the move between two steps, over the noise level.
        quadratic_fits: Fits of a quadratic to the likelihood about the mode's mean that end a
            frame; 0: the mean as it is.
        fit_pixels: Image points that a pose is scored from in these fits.
        icp_prior: Standard deviation of that estimate, as the prior of ICP with the measured depth
            [m on the object's surface]; 0: no ICP. A method that keeps no depth has none.
        texture_every: Every so many frames the texture turns the estimate and the particles,
            among the turns that the shape leaves open, where it does in single images; 0: never. A
            search that finds the object again always ends so.
        jump_penalty: Log odds against a jump to what the network proposes, while the object is
            tracked [nat]; so that it does not flip between faces that look alike.
        kld_epsilon: Kullback-Leibler divergence that KLD sampling allows [nat].
        kld_quantile: Probability that it stays below.
        kld_bin_size: Side of the cells that it counts [m].
        whole_image_every: Every so many frames the network sees the whole image, so that proposals
            come from everywhere; 0: never.
        window_side: Largest side of the window about the object that it sees otherwise [px].
        window_scale: Half the window's side, in projected radii of the object.
        smoothing_noise: Standard deviation of the estimate of a single frame, for smoothing [m];
            0: none.
        lost_below: A frame counts against the object where its presence is below, in [0, 1].
        found_above: What a search finds is taken up where its presence is above. While a track's is
            not, the network sees the whole image in the next frame.
        elsewhere_penalty: Log odds against an object elsewhere than where it was lost, if something
            nearer covered it there [nat]; they fade with time.
        patience: Frames in a row that count against an object that is lost.
        search_above: While the object is lost, a probe whose presence is above is worth a search.
        probe_every: While it is lost and other objects are tracked, too, one frame in so many is
            probed for it; for one object alone each is.
        search_every: While it is lost, every so many probes it is searched for anyway; 0: never.

    Raises:
        UserError: A number is out of range.
    """

    motion: ConstantVelocity = field(default_factory=ConstantVelocity)
    follow: FilterSettings = FilterSettings(32, 300, 8, 1, 0.008, 0.008, 64)
    probe: FilterSettings = FilterSettings(32, 32, 64, 1, 0.02, 0.02, 32)
    search: FilterSettings = FilterSettings(64, 64, 64, 6, 0.04, 0.004, 32)
    noise_scale: float = 0.4
    quadratic_fits: int = 1
    fit_pixels: int = 128
    icp_prior: float = 0.004
    texture_every: int = 8
    jump_penalty: float = 5.0
    kld_epsilon: float = 0.15
    kld_quantile: float = 0.95
    kld_bin_size: float = 0.03
    whole_image_every: int = 4
    window_side: int = 320
    window_scale: float = 1.25
    smoothing_noise: float = 0.0004
    lost_below: float = 0.3
    found_above: float = 0.5
    elsewhere_penalty: float = 5.0
    patience: int = 2
    search_above: float = 0.1
    probe_every: int = 2
    search_every: int = 3

    def __post_init__(self) -> None:
        """Check the numbers."""
        check_settings(self, "tracker")
        if self.lost_below > self.found_above:
            raise UserError(
                f"tracker: lost_below={self.lost_below} is above found_above={self.found_above}"
            )
