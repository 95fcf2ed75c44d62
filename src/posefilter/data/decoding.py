"""Decode frames at the size of the network, through a cache, and find out which are fit for use."""

import dataclasses
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from posefilter.data.cache import FARTHEST, FrameCache, Prepared
from posefilter.data.frames import FrameRecord, NotShown, Sample
from posefilter.data.readers.base import BaseReader
from posefilter.data.readers.checked import index_records, read_checked
from posefilter.data.resize import network_size, resize
from posefilter.errors import BadData, UserError
from posefilter.progress import bars

_CHUNK = 64  # records decoded at a time


class FrameDecoder:
    """A reader whose frames are resized and cached.

    Args:
        reader: Reads frames.
        records: All of its records, in its order.
        width: Of the network's images [px]; None: by the height, or as stored.
        height: Likewise.
        cache: Opens the cache, given `read`.
        threads: That decode.
        progress: Draw bars.

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
        threads: int,
        progress: bool,
    ) -> None:
        self._reader, self._size = reader, (width, height)
        self._threads, self._progress = threads, progress
        self.examples: dict[str, str] = {}  # of each cause of bad frames, the first message
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

    def find_usable(
        self,
        records: Sequence[FrameRecord],
        min_visibility: float,
        limit: int | None,
        on_error: str,
        title: str,
    ) -> tuple[list[FrameRecord], Counter[str]]:
        """Return the records that can be used, and how many were left out for which reason.

        Frames whose visibility is unknown pass; `limit` is how many are enough. Raises UserError
        for the first broken file where `on_error` is "raise". An object that is listed but not in
        the label, or so far away that its depth is not kept, is no error: it is left out and
        counted.
        """
        chosen: list[FrameRecord] = []
        left_out: Counter[str] = Counter()
        for record, found in self._fetch_all(records, title):
            if limit is not None and len(chosen) >= limit:
                break
            if isinstance(found, BadData):
                if on_error == "raise" and not isinstance(found, NotShown):
                    raise UserError(
                        f"{found}; data.on_error=skip leaves such frames out and counts them"
                    ) from found
                left_out[found.cause] += 1
                self.examples.setdefault(found.cause, str(found))
            elif found.pixels == 0 and record.object:
                left_out["the mask vanishes at this image size"] += 1
            elif self._measure_distance(record, found) > FARTHEST:
                left_out[f"the object is beyond {FARTHEST:.2f} m, where depth is not kept"] += 1
            elif found.visibility < min_visibility:
                left_out[f"visibility below {min_visibility}"] += 1
            else:
                chosen.append(record)
        return chosen, left_out

    def _measure_distance(self, record: FrameRecord, found: Prepared) -> float:
        """Return the z [m] of an object's center, whose origin may be far from its body."""
        center = np.append(self._reader.find_center(record.object), 1.0)
        return float((found.camera_from_object @ center)[2])

    def _fetch_all(
        self, records: Sequence[FrameRecord], title: str
    ) -> Iterator[tuple[FrameRecord, Prepared | BadData]]:
        """Yield the records in order, each with what is kept of it, or what is wrong with it."""
        shown = self._progress and len(records) >= _CHUNK
        with ThreadPoolExecutor(self._threads) as pool, bars(shown=shown, transient=True) as bar:
            task = bar.add_task(title, total=len(records))
            for at in range(0, len(records), _CHUNK):
                chunk = records[at : at + _CHUNK]
                for pair in zip(chunk, pool.map(self.fetch, chunk), strict=True):
                    bar.advance(task)
                    yield pair
