"""Decode frames at the size of the network, through a cache."""

import dataclasses
from collections.abc import Callable, Sequence

from posefilter.data.cache import FrameCache, Prepared
from posefilter.data.frames import FrameRecord, Sample
from posefilter.data.readers.base import BaseReader
from posefilter.data.readers.checked import index_records, read_checked
from posefilter.data.resize import network_size, resize
from posefilter.errors import BadData


class FrameDecoder:
    """A reader whose frames are resized and cached.

    Args:
        reader: Reads frames.
        records: All of its records, in its order.
        width: Of the network's images [px]; None: by the height, or as stored.
        height: Likewise.
        cache: Opens the cache, given `read`.

    Raises:
        UserError: Two records cannot be told apart.
    """

    def __init__(
        self,
        reader: BaseReader,
        records: Sequence[FrameRecord],
        width: int | None,
        height: int | None,
        cache: Callable[[Callable[[FrameRecord], Sample]], FrameCache],
    ) -> None:
        self._reader, self._size = reader, (width, height)
        self.cache = cache(self.read)
        self._index = index_records(reader, records)

    def fetch(self, record: FrameRecord) -> Prepared | BadData:
        """Decode a frame into the cache, unless it is there; return the error of a bad one."""
        kept = self.cache.find(record)
        if kept is not None:
            return kept
        try:
            sample = self.read(record)
            sample = dataclasses.replace(sample, visibility=self._reader.visible_share(sample))
        except BadData as error:
            return error
        return self.cache.keep(record, sample)

    def read(self, record: FrameRecord) -> Sample:
        """Decode a frame, see whether it can be right, and resize it."""
        sample = read_checked(self._reader, self._index[record.key], record)
        height, width = sample.mask.shape
        return resize(sample, *network_size(height, width, *self._size))
