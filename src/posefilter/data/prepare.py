"""Go once through a split before it is used: decode into the cache, and find out which frames are
fit for use.
"""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor

from posefilter.data.cache import Prepared
from posefilter.data.frames import FrameRecord, NotShown
from posefilter.errors import BadData, UserError
from posefilter.progress import bars

_CHUNK = 64  # records decoded at a time
Fetch = Callable[[FrameRecord], Prepared | BadData]


def usable(
    records: Sequence[FrameRecord],
    fetch: Fetch,
    min_visibility: float,
    limit: int | None,
    on_error: str,
    threads: int,
    title: str,
    progress: bool,
) -> tuple[list[FrameRecord], Counter[str]]:
    """Return the records that can be used, and how many were left out for which reason.

    Frames whose visibility is unknown pass; `limit` is how many are enough. Raises UserError for
    the first broken file where `on_error` is "raise". An object that is listed but not in the label
    is no error: it is left out and counted.
    """
    chosen: list[FrameRecord] = []
    left_out: Counter[str] = Counter()
    for record, found in _decoded(records, fetch, threads, title, progress):
        if limit is not None and len(chosen) >= limit:
            break
        if isinstance(found, BadData):
            if on_error == "raise" and not isinstance(found, NotShown):
                raise UserError(
                    f"{found}; data.on_error=skip leaves such frames out and counts them"
                ) from found
            left_out[found.cause] += 1
        elif found.pixels == 0:
            left_out["the mask vanishes at this image size"] += 1
        elif found.visibility < min_visibility:
            left_out[f"visibility below {min_visibility}"] += 1
        else:
            chosen.append(record)
    return chosen, left_out


def _decoded(
    records: Sequence[FrameRecord], fetch: Fetch, threads: int, title: str, progress: bool
) -> Iterator[tuple[FrameRecord, Prepared | BadData]]:
    """Yield the records in order, each with what is kept of it, or what is wrong with it."""
    shown = progress and len(records) >= _CHUNK
    with ThreadPoolExecutor(threads) as pool, bars(shown=shown, transient=True) as bar:
        task = bar.add_task(title, total=len(records))
        for at in range(0, len(records), _CHUNK):
            chunk = records[at : at + _CHUNK]
            for pair in zip(chunk, pool.map(fetch, chunk), strict=True):
                bar.advance(task)
                yield pair
