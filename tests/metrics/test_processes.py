"""Metrics of a test that several processes share.

What they gather and add up must be what one process would have had, whatever the batches.
"""

import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from tests.models.toy import scenes, square
from torch import Generator, Tensor
from torchmetrics import Metric

from posefilter.geometry.pose import make_pose
from posefilter.metrics.bop import BopErrors
from posefilter.metrics.collect import (
    BeliefQuality,
    BoxIoU,
    ErrorsByVisibility,
    ParticlesOnObject,
    PoseErrors,
)
from posefilter.metrics.confidence import Confidence
from posefilter.metrics.credibility import Credibility, TruthScores
from posefilter.metrics.diagnostics import FilterDiagnostics
from posefilter.metrics.parts import PartIoU
from posefilter.metrics.scores import InstanceErrors
from posefilter.types import BeliefBatch, ParticleOutput, Particles, Step, Trace

MODEL = square()
HALVES = {"left": MODEL.points[MODEL.points[:, 0] < 0], "right": MODEL.points}
IMAGES = 6
BATCH = scenes(IMAGES)
G = Generator().manual_seed(2)
SHIFTS = 0.02 * torch.rand(IMAGES, 1, 3, generator=G) + 0.02 * torch.rand(IMAGES, 8, 3, generator=G)
CLOUD = make_pose(
    BATCH.camera_from_object[:, None, :3, :3].expand(-1, 8, 3, 3),
    BATCH.camera_from_object[:, None, :3, 3] + SHIFTS,
)
PIXELS = torch.rand(IMAGES, 8, 2, generator=G) * torch.tensor([70.0, 50.0]) - 3
NUMBERS = torch.rand(5, IMAGES, 8, generator=G)
BOXES = torch.cat([PIXELS[:, 0], PIXELS[:, 0] + 20], 1)


def some(values: Any, part: slice) -> Any:
    return type(values)(*(x[part] for x in values))


def trace_of(part: slice) -> Trace:
    log_w = torch.log_softmax(NUMBERS[0, part], 1)
    empty = torch.zeros(len(log_w), 8, 0)
    particles = Particles(PIXELS[part], empty, log_w, torch.arange(8).expand(len(log_w), 8))
    output = ParticleOutput(
        NUMBERS[1, part], PIXELS[part] * NUMBERS[2, part, :, None], CLOUD[part], empty
    )
    return Trace((particles,), (output,), (Step(0, 1, torch.tensor(0.0)),), belief_of(part))


def belief_of(part: slice) -> BeliefBatch:
    log_w = torch.log_softmax(NUMBERS[0, part], 1)
    return BeliefBatch(CLOUD[part], log_w, CLOUD[part, 0], log_w[:, 0])


def measure(part: slice) -> InstanceErrors:
    errors = PoseErrors([MODEL])
    errors.update(GUESS[part], TRUTH[part])
    return errors.last()


TRUTH, GUESS = BATCH.camera_from_object, CLOUD[:, 0]
SEEN = torch.linspace(0.1, 1.0, IMAGES)
SCORES = TruthScores(*NUMBERS[:3, :, 0].double())
RIGHT = NUMBERS[3, :, 0] > 0.5
KINDS: dict[str, tuple[Callable[..., Metric], Callable[[Any, slice], None]]] = {
    "errors": (
        lambda **kwargs: PoseErrors([MODEL], **kwargs),
        lambda metric, part: metric.update(GUESS[part], TRUTH[part]),
    ),
    "by visibility": (
        lambda **kwargs: ErrorsByVisibility([MODEL], **kwargs),
        lambda metric, part: metric.update(measure(part), SEEN[part]),
    ),
    "BOP": (
        lambda **kwargs: BopErrors([MODEL], **kwargs),
        lambda metric, part: metric.update(GUESS[part], TRUTH[part], BATCH.intrinsics[part], 64),
    ),
    "boxes": (BoxIoU, lambda metric, part: metric.update(BOXES[part], BOXES[part] + 3)),
    "on object": (
        ParticlesOnObject,
        lambda metric, part: metric.update(BATCH.mask[part], PIXELS[part]),
    ),
    "belief": (
        lambda **kwargs: BeliefQuality(MODEL, **kwargs),
        lambda metric, part: metric.update(belief_of(part), TRUTH[part]),
    ),
    "credibility": (
        Credibility,
        lambda metric, part: metric.update(some(SCORES, part), SEEN[part]),
    ),
    "parts": (
        lambda **kwargs: PartIoU(MODEL._replace(parts=HALVES), **kwargs),
        lambda metric, part: metric.update(GUESS[part], some(BATCH, part)),
    ),
    "confidence": (
        Confidence,
        lambda metric, part: metric.update(
            *NUMBERS[:2, part, 0], torch.arange(IMAGES)[part] % 3 > 0, RIGHT[part], SEEN[part] - 0.5
        ),
    ),
    "diagnostics": (
        FilterDiagnostics,
        lambda metric, part: metric.update(trace_of(part), some(BATCH, part)),
    ),
}
every = pytest.mark.parametrize(("make", "add"), KINDS.values(), ids=KINDS.keys())


def flatten(value: Any, at: str = "") -> dict[str, float]:
    """Return all numbers of a result by their places."""
    if isinstance(value, dict):
        return {
            k: x for name, one in value.items() for k, x in flatten(one, f"{at}/{name}").items()
        }
    if isinstance(value, list):
        return {k: x for i, one in enumerate(value) for k, x in flatten(one, f"{at}/{i}").items()}
    return {at: float(value)}


def agree(one: Any, other: Any) -> None:
    a, b = flatten(one), flatten(other)
    assert a == pytest.approx(b, rel=1e-6, abs=1e-9, nan_ok=True)
    assert any(math.isfinite(x) and x != 0 for x in a.values())


@every
def test_two_halves_are_the_whole(make: Any, add: Any) -> None:
    whole, first, second = make(), make(), make()
    add(whole, slice(0, IMAGES))
    add(first, slice(0, 4))
    add(second, slice(4, IMAGES))
    first.merge_state(second)
    agree(first.compute(), whole.compute())


@every
def test_processes_that_have_the_same_count_all_twice(make: Any, add: Any) -> None:
    once = make(dist_sync_fn=lambda x, group: [x, x], distributed_available_fn=lambda: True)
    twice = make()
    for metric, times in ((once, 1), (twice, 2)):
        for _ in range(times):
            add(metric, slice(0, 4))
            add(metric, slice(4, IMAGES))
    agree(once.compute(), twice.compute())


@every
def test_each_process_gathers_as_often_whatever_its_batches(make: Any, add: Any) -> None:
    """Otherwise one would wait for another for ever."""
    counts = []
    for batches in ([], [slice(0, 6)], [slice(0, 1), slice(1, 3), slice(3, 6)]):
        calls = []

        def gather(x: Tensor, group: object, calls: list[Tensor] = calls) -> list[Tensor]:
            calls.append(x)
            return [x]

        metric = make()
        for part in batches:
            add(metric, part)
        metric.sync(dist_sync_fn=gather, distributed_available=lambda: True)
        counts.append(len(calls))
    assert counts[0] == counts[1] == counts[2] > 0


@pytest.mark.parametrize("name", ["boxes", "parts"])
def test_a_count_loses_no_image_however_many_there_are(name: str) -> None:
    """Numbers of 32 bits with a fraction stop counting at 2^24."""
    make, add = KINDS[name]
    metric = make()
    counts, totals = ("count", "total") if name == "boxes" else ("counts", "totals")
    for state in (counts, totals):
        getattr(metric, state).fill_(1 << 24)
    add(metric, slice(0, 1))
    assert (getattr(metric, counts) == (1 << 24) + 1).all()
    assert (getattr(metric, totals) > 1 << 24).all()
