"""Write annotated frames as a video."""

import os
from pathlib import Path

import cv2
import numpy as np
from cv2.utils import logging

from posefilter.errors import Stopped, UserError
from posefilter.figures.animation import encode_gif
from posefilter.files import write_whole

_GIF_WIDTH = 480  # [px]


class VideoWriter:
    """Write pictures to an .mp4 or .gif file as they come; use as a context.

    The file takes its name at the end, when it is whole. A user's mistake or an interruption ends
    it early, with the pictures so far; after another error there is none.

    Args:
        path: The file, without its ending.
        form: "mp4", "gif", or "none" to write nothing.
        fps: Frames a second.

    """

    def __init__(self, path: Path, form: str, fps: float) -> None:
        self.path, self.form, self.fps = path.with_name(f"{path.name}.{form}"), form, fps
        os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # nothing of FFmpeg's own
        self._part = path.with_name(f".{path.name}.{os.getpid()}.part.mp4")
        self._writer: cv2.VideoWriter | None = None
        self._count = 0
        self._pictures: list[np.ndarray] = []
        self._size: tuple[int, int] | None = None

    def __enter__(self) -> "VideoWriter":
        """Return the writer."""
        # of a full disk it has a line a frame to say, which is said in one at the end
        self._level = logging.setLogLevel(logging.LOG_LEVEL_SILENT)
        return self

    def add(self, picture: np.ndarray, min_height: int = 0) -> None:
        """Add a picture (H, W, 3) uint8; later ones are brought to the first one's width, and cut
        or filled with white below to its height, or to `min_height` if that is more, since what
        they show must not be squeezed.

        Raises:
            UserError: This OpenCV cannot encode videos.
        """
        if self.form == "none":
            return
        if self._size is None:
            rows, columns = max(min_height, picture.shape[0]), picture.shape[1]
            scale = min(1.0, _GIF_WIDTH / columns) if self.form == "gif" else 1.0
            # even, as codecs want it
            self._size = (2 * round(scale * columns / 2), 2 * round(scale * rows / 2))
        width, height = self._size
        if picture.shape[1] != width:
            scaled = max(1, round(picture.shape[0] * width / picture.shape[1]))
            picture = cv2.resize(picture, (width, scaled), interpolation=cv2.INTER_AREA)
        below = ((0, max(0, height - picture.shape[0])), (0, 0), (0, 0))
        picture = np.pad(picture[:height], below, constant_values=255)
        if self.form == "gif":
            self._pictures.append(picture)
            return
        if self._writer is None:
            code = cv2.VideoWriter.fourcc(*"mp4v")
            self._writer = cv2.VideoWriter(str(self._part), code, self.fps, self._size)
            if not self._writer.isOpened():
                raise UserError(
                    "save_video=mp4: this OpenCV cannot encode it; choose save_video=gif or none"
                )
        self._writer.write(np.ascontiguousarray(picture[..., ::-1]))
        self._count += 1

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Finish the file.

        Raises:
            UserError: It cannot be written, as on a full disk.
        """
        keep = kind is None or issubclass(kind, UserError | KeyboardInterrupt | Stopped)
        try:
            if self._writer is not None:
                self._writer.release()
                if keep:
                    self._check_part()
                    self._part.replace(self.path)
            if self._pictures and keep:
                shown, waits = pace_gif(len(self._pictures), self.fps)
                pictures = [self._pictures[n] for n in shown]
                write_whole(self.path, encode_gif(pictures, waits[:-1], hold=waits[-1]))
        finally:
            self._part.unlink(missing_ok=True)
            logging.setLogLevel(self._level)

    def _check_part(self) -> None:
        """Raise UserError where frames are missing: OpenCV does not tell that a disk is full."""
        written = cv2.VideoCapture(str(self._part))
        frames = int(written.get(cv2.CAP_PROP_FRAME_COUNT))
        written.release()
        if frames != self._count:
            raise UserError(
                f"{self.path}: cannot be written ({frames} of {self._count} frames are on the "
                f"disk; is it full?)"
            )


def pace_gif(count: int, fps: float) -> tuple[list[int], list[int]]:
    """Return which pictures of a video a GIF shows, and how long each [ms], so that it plays at the
    video's speed.

    A GIF counts in hundredths of a second, and browsers show what is to take less than two for ten.
    """
    ends = [round(100 * (n + 1) / fps) for n in range(count)]
    shown, waits, since = list[int](), list[int](), 0
    for n, end in enumerate(ends):
        if end - since >= 2 or not shown:
            shown.append(n)
            waits.append(10 * max(2, end - since))
            since = max(end, since + 2)
    return shown, waits
