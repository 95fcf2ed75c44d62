"""Search an image again while the answer is doubtful, and keep the one more probably right.

A filter that has converged on a wrong mode does not come back from it: all its particles are there,
and its likelihood prefers it. Other searches may find the right one: of the image without what the
first answer took for the object, by other random draws, and of the magnified part of the image that
most likely shows the object, which the network may miss where it is small. Which answer is right is
then not asked of the likelihood, which has erred, but of a logistic regression on the evidence
for an answer: agreement of the particles, measured depth, texture, and the network of object
coordinates.

An answer is doubtful, too, where the object appears larger or smaller there than it is: the same
design in another size, as of a package of the same brand. No answer of that kind replaces another.
"""

import math
from collections.abc import Iterator
from itertools import islice
from typing import Any

import torch
from torch import Generator, Tensor

from posefilter.confidence.calibration import Calibration
from posefilter.confidence.visible_pixels import blank, find_visible
from posefilter.filters.traces import keep_last_step, map_traces
from posefilter.types import Batch, Trace

DOUBTFUL = 0.5  # rank below which an answer is doubtful
MARGIN = 1.0  # [nat] of the log-odds by which another answer must be better: the first has more
# often been right, and without a margin a tie would be decided by noise
_WORTH = 0.1  # mean probability of a network's surest cells, below which there is no more to find
_CELLS = 6  # of the network, that a small object covers
LEAST_DEPTH = 0.01  # share of the pixels whose depth is known


def read_objectness(encoding: Any) -> Tensor | None:
    """Return the objectness of each cell, (B, 1, h, w); None where an encoding has none."""
    return getattr(encoding, "objectness", None)


def measure_worth(encoding: Any) -> Tensor:
    """Return the mean probability of the surest cells of each image, (B,); (1,) of 1 where there
    is none.
    """
    cells = read_objectness(encoding)
    if cells is None:
        return torch.ones(1)
    objectness = cells.flatten(1)
    return objectness.topk(min(_CELLS, objectness.shape[1])).values.mean(1)


@torch.no_grad()
def look_again(method: Any, first: Trace, batch: Batch, generator: Generator) -> Trace:
    """Return the trace with each doubtful answer replaced by a better one, where one is found.

    Args:
        method: A `PoseEstimator` that was calibrated; any other's trace is returned as it is.
        first: A finished run of its filter, or the last step of one.
        batch: Its B images; mask and pose are not used.
        generator: Draws the other searches.

    Returns:
        The trace; of an image whose answer was replaced, of the search that found it. The encoding
        stays that of the whole images.
    """
    calibration, searches = method.calibration, method.filter.max_searches
    if calibration is None or calibration.choice is None or searches < 2:
        return first
    ranks = _rank(method, calibration, first, batch)
    contradicted = _contradicts(method, first, batch).to(ranks.device)
    trace = first
    for row in ((ranks < DOUBTFUL) | contradicted).nonzero()[:, 0].tolist():
        own = Batch(*(x[row : row + 1] for x in batch))
        least = _improve(float(ranks[row]))
        if contradicted[row]:
            least = min(least, DOUBTFUL)
        found = _search(method, calibration, trace, row, least, own, generator)
        if found is not None:
            trace = _put(trace, row, found)
    return trace


def _rank(method: Any, calibration: Calibration, trace: Trace, batch: Batch) -> Tensor:
    """Return what answers are compared by, (B,).  A margin of rotations that has no part in it, and
    costs time, is not measured.
    """
    ignored = calibration.choice_ignores("rotation_margin")
    known = (trace.belief.score.new_zeros(len(batch.rgb)),) if ignored else ()
    return calibration.rank(method.collect_features(trace, batch, *known))


def _contradicts(method: Any, trace: Trace, batch: Batch) -> Tensor:
    """Return of which images the object appears in another size than it has, (B,) bool."""
    size = method.measure_scale_ratio(trace, batch)
    if size is None:
        return torch.zeros(len(batch.rgb), dtype=torch.bool, device=batch.rgb.device)
    return size.contradicts()


def _improve(rank: float) -> float:
    """Return the rank that another answer must exceed."""
    odds = rank / max(1 - rank, 1e-9) * math.exp(MARGIN)
    return odds / (1 + odds)


def _search(
    method: Any,
    calibration: Calibration,
    first: Trace,
    row: int,
    min_rank: float,
    image: Batch,
    generator: Generator,
) -> Trace | None:
    """Return the best of an image's other searches; None where no rank is above `min_rank`."""
    object_model, pose = method.object_model, first.belief.best[row : row + 1]
    hidden = find_visible(pose, object_model, image.depth[0, 0], image.intrinsics[0])
    best: Trace | None = None
    # of a single image, its first search has encoded it
    known = first.encoding is not None and len(first.belief.best) == 1
    whole = first.encoding if known else method.encode(image)
    parts = _list_parts(method, image, blank(image, hidden))
    for part in islice(parts, method.filter.max_searches - 1):
        if float((part.depth > 0).float().mean()) < LEAST_DEPTH:
            continue
        encoding = whole if part is image else method.encode(part)
        if float(measure_worth(encoding)) < _WORTH:
            continue
        found = method.search(part, generator, encoding)
        # what was hidden is there: judged by the whole image, as the first answer
        found = found._replace(encoding=whole)
        value = float(_rank(method, calibration, found, image)[0])
        if value > min_rank and not _contradicts(method, found, image).any():
            min_rank, best = value, found
            if value >= DOUBTFUL:
                break
    return best


def _list_parts(method: Any, image: Batch, rest: Batch) -> Iterator[Batch]:
    """Yield where one image is searched again, in turn; `rest` is it without the first answer."""
    yield rest
    yield image
    part = method.choose_part(image)
    if part is not None:
        yield part


def _put(trace: Trace, row: int, found: Trace) -> Trace:
    """Return a trace with the row of one image replaced by another trace's only one."""
    if len(trace.particles) < len(found.particles):
        found = keep_last_step(found)

    def put(old: Tensor, new: Tensor) -> Tensor:
        out = old.clone()
        out[row] = new[0]
        return out

    return map_traces(put, trace, found)
