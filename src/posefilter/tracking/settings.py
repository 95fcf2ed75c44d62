"""What a tracker is set to."""

from dataclasses import dataclass, field

from posefilter.errors import UserError
from posefilter.tracking.motion import RandomWalk


def check_whole(settings: object, **least: int) -> None:
    """Raise UserError where a setting is no whole number, or below its least value."""
    for name, bound in least.items():
        value = getattr(settings, name)
        if not isinstance(value, int) or isinstance(value, bool) or value < bound:
            raise UserError(f"tracker: {name}={value} must be a whole number, {bound} or more")


@dataclass(frozen=True)
class Effort:
    """What a frame may cost.

    Attributes:
        least: Particles of the belief at least.
        most: Particles at most; KLD sampling chooses between.
        proposals: Particles that the network proposes, beside them, in frames of which it sees the
            whole image.
        steps: Likelihood steps.
        start: Noise level of the first step [m].
        stop: Noise level of the last [m].
        points: Image points that a pose is scored from.

    Raises:
        UserError: A number is out of range.
    """

    least: int
    most: int
    proposals: int
    steps: int
    start: float
    stop: float
    points: int

    def __post_init__(self) -> None:
        """Check the numbers."""
        check_whole(self, least=1, most=1, proposals=0, steps=1, points=1)
        if self.most < self.least:
            raise UserError(
                f"tracker: most={self.most} particles are fewer than least={self.least}"
            )
        if not 0 < self.stop <= self.start:
            raise UserError(
                f"tracker: start={self.start}, stop={self.stop}: noise levels fall, and are above 0"
            )


@dataclass(frozen=True)
class TrackerSettings:
    """Settings of a tracker.

    Attributes:
        motion: How an object may move between two frames.
        follow: What a frame costs while the object is tracked.
        search: What it costs while the object is lost.
        walk: Standard deviation of the move between two steps, over the noise level.
        rounds: Fits of a quadratic to the likelihood about the mode's mean that end a frame; 0: the
            mean as it is.
        fit_points: Image points that a pose is scored from in these fits.
        jump: Log odds against a jump to what the network proposes, while the object is tracked
            [nat]; so that it does not flip between faces that look alike.
        epsilon: Kullback-Leibler divergence that KLD sampling allows [nat].
        quantile: Probability that it stays below.
        cell: Side of the cells that it counts [m].
        look_around: Every so many frames the network sees the whole image, so that proposals come
            from everywhere; 0: never.
        side: Largest side of the window about the object that it sees otherwise [px].
        reach: Half the window's side, in projected radii of the object.
        noise: Standard deviation of the estimate of a single frame, for smoothing [m]; 0: none.
        lost_below: A frame counts against the object where its presence is below, in [0, 1].
        found_above: What a search finds is taken up where its presence is above. While a track's is
            not, the network sees the whole image in the next frame.
        patience: Frames in a row that count against an object that is lost.
        full_every: While it is lost, every so many frames the estimator's own filter searches;
            0: never.

    Raises:
        UserError: A number is out of range.
    """

    motion: RandomWalk = field(default_factory=RandomWalk)
    follow: Effort = Effort(32, 300, 8, 1, 0.008, 0.008, 64)
    search: Effort = Effort(64, 64, 160, 6, 0.04, 0.004, 64)
    walk: float = 0.4
    rounds: int = 1
    fit_points: int = 128
    jump: float = 5.0
    epsilon: float = 0.15
    quantile: float = 0.95
    cell: float = 0.03
    look_around: int = 4
    side: int = 320
    reach: float = 1.25
    noise: float = 0.0015
    lost_below: float = 0.3
    found_above: float = 0.5
    patience: int = 2
    full_every: int = 5

    def __post_init__(self) -> None:
        """Check the numbers."""
        check_whole(self, rounds=0, fit_points=1, look_around=0, side=64, patience=1, full_every=0)
        if not (min(self.walk, self.noise, self.jump) >= 0 and self.reach >= 1):
            raise UserError("tracker: walk, noise and jump must be 0 or more, reach 1 or more")
        if not 0 <= self.lost_below <= self.found_above <= 1:
            raise UserError(
                f"tracker: lost_below={self.lost_below} and found_above={self.found_above} must "
                f"lie in [0, 1], the second no lower"
            )
        if not (self.epsilon > 0 and self.cell > 0 and 0 < self.quantile < 1):
            raise UserError("tracker: epsilon and cell must be above 0, quantile between 0 and 1")
