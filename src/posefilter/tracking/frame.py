"""One frame of a video, prepared once for all objects that are tracked in it."""

from functools import cached_property

from posefilter.confidence.blank import find_blank
from posefilter.images import Images, drop_unknown, make_batch, make_sized_batch
from posefilter.tracking.window import Window, cut_window
from posefilter.types import Batch


class Frame:
    """A photograph, and what objects that look at it have in common.

    Args:
        images: One photograph.
    """

    def __init__(self, images: Images) -> None:
        self.images = images._replace(depth=drop_unknown(images.depth))
        self._whole: dict[tuple[int | None, int | None], Batch] = {}

    @cached_property
    def blank(self) -> str:
        """Why it cannot be judged, in words; "" where it can be."""
        return find_blank(self.images.rgb[0], self.images.depth[0])

    def see_whole(self, size: tuple[int | None, int | None]) -> Batch:
        """Return the whole photograph at a size; of each size it is made once.

        Args:
            size: Width and height that a network was trained on [px]; None: see `make_batch`.
        """
        if size not in self._whole:
            self._whole[size] = make_batch(self.images, *size)
        return self._whole[size]

    def see_window(self, window: Window) -> Batch:
        """Return a part of the photograph."""
        part = cut_window(self.images, window)
        # its sides are whole pixels of both, so that it may be stretched by one of them
        return make_sized_batch(part, window.seen_height, window.seen_width)
