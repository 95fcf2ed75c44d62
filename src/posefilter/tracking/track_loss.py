"""Whether a track is lost: what becomes of it by the probability that the object is there."""

from posefilter.tracking.settings import TrackerSettings

STATUSES = STARTED, TRACKED, RECOVERED, LOST = "started", "tracked", "recovered", "lost"


class TrackLossDetector:
    """Judge a track by the presence of its object, frame after frame.

    A track is lost after `patience` frames in a row whose presence is below `lost_below`; a lost
    one is recovered, or started where it has never been tracked, by a frame whose presence is above
    `found_above`. Between the two it stays what it is. At first it is lost.

    Args:
        settings: Of the tracker.
    """

    def __init__(self, settings: TrackerSettings) -> None:
        self.settings = settings
        self.lost, self.ever_tracked = True, False
        self.doubts = 0
        self.sure = False  # of the last frame

    def judge(self, presence: float) -> tuple[bool, str]:
        """Return whether a frame's estimate is to be trusted, and the object's status after it.

        Args:
            presence: The probability that the object is where the estimate puts it, in [0, 1].
        """
        settings = self.settings
        self.sure = presence > settings.found_above
        if self.lost:
            trusted = self.sure
            status = LOST if not trusted else RECOVERED if self.ever_tracked else STARTED
        else:
            trusted = presence >= settings.lost_below
            self.doubts = 0 if trusted else self.doubts + 1
            status = LOST if self.doubts >= settings.patience else TRACKED
        self.lost = status == LOST
        self.ever_tracked |= not self.lost
        if self.lost:
            self.doubts = 0
        return trusted, status
