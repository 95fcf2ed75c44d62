"""The likelihood as a share of the peak of matrix products, and where an estimate's time goes.

`bench/peers.py roofline` says how it is called. The peak is the best rate of `torch.mm` in bfloat16
over some sizes, measured in the same run, by turns with the likelihood. The likelihood's operations
are those of its network's matrix products alone: what makes the inputs counts as none, so that the
share is what remains beside it.
"""

import statistics
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from marked import format_row
from torch import Tensor, nn

import posefilter
from posefilter.nets import fused
from posefilter.nets import likelihood as reference
from posefilter.nets.layers import ResnetFC

OBJECT = "003_cracker_box"
SIZES = ((4096, 96, 96), (4096, 256, 256), (2048, 1024, 1024), (4096, 2048, 1024))
SHARES = ("what", "dtype", "GFLOP/s", "of the peak %", "least", "most")
PARTS = ("part of an estimate", "ms", "share %")
Table = tuple[str, tuple[str, ...], list[str]]


def count_operations(likelihood: nn.Module) -> int:
    """Return the floating-point operations of a point: two for each weight of its products."""
    own: Any = likelihood
    layers = [own.enter, own.leave]
    for block in own.blocks:
        assert isinstance(block, ResnetFC)
        layers += [block.inner, block.outer]
    return 2 * sum(layer.weight.numel() for layer in layers)


def clock(call: Callable[[], Any]) -> float:
    """Return the seconds of a call."""
    begun = time.process_time()
    call()
    return time.process_time() - begun


def measure_peak(dtype: torch.dtype) -> float:
    """Return the best rate of a matrix product over the sizes [operations / s]."""
    best = 0.0
    for m, k, n in SIZES:
        a, b = torch.randn(m, k).to(dtype), torch.randn(k, n).to(dtype)
        repeats = max(1, round(2e9 / (2 * m * k * n)))
        torch.mm(a, b)
        took = clock(lambda a=a, b=b, r=repeats: [torch.mm(a, b) for _ in range(r)])  # type: ignore[misc]
        best = max(best, repeats * 2 * m * k * n / took)
    return best


class Recorder:
    """Seconds spent within functions, while they are replaced by ones that are clocked."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._undo: list[Callable[[], None]] = []
        self._inside: list[float] = []

    def watch(self, owner: Any, name: str, title: str) -> None:
        """Clock a function of a module or class; what it calls that is watched is its own."""
        plain = getattr(owner, name)

        def clocked(*args: Any, **settings: Any) -> Any:
            self._inside.append(0.0)
            begun = time.process_time()
            try:
                return plain(*args, **settings)
            finally:
                took = time.process_time() - begun
                inner = self._inside.pop()
                self.seconds[title] = self.seconds.get(title, 0.0) + took - inner
                if self._inside:
                    self._inside[-1] += took

        setattr(owner, name, clocked)
        self._undo.append(lambda: setattr(owner, name, plain))

    def close(self) -> None:
        """Put the functions back."""
        for undo in self._undo:
            undo()


def draw_image() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return a drawn image of 640 x 480: what is computed does not depend on what it shows."""
    draw = np.random.default_rng(0)
    rgb = draw.integers(0, 256, (480, 640, 3), dtype=np.uint8)
    depth = draw.uniform(0.6, 1.2, (480, 640)).astype(np.float32)
    return rgb, depth, np.array([[1066.0, 0, 320], [0, 1066.0, 240], [0, 0, 1]])


def capture(estimator: Any, image: tuple[np.ndarray, ...]) -> list[tuple[Any, ...]]:
    """Return the arguments of each call of the likelihood in an estimate."""
    calls: list[tuple[Any, ...]] = []
    plain = reference.score

    def noted(*args: Any, **settings: Any) -> Tensor:
        calls.append((args, settings))
        return plain(*args, **settings)

    reference.score = noted
    try:
        estimator.predict(*image)
    finally:
        reference.score = plain
    return calls


def measure_likelihood(repeats: int) -> Table:
    """Return the table of the likelihood's rate, for its largest call of an estimate."""
    estimator = posefilter.load(OBJECT, device="cpu")
    calls = capture(estimator, draw_image())
    args, settings = max(calls, key=lambda call: call[0][2].shape[1] * call[0][6].shape[2])
    likelihood, poses, noise = args[0], args[2], args[6]
    points = poses.shape[0] * poses.shape[1] * noise.shape[2]
    dtype = settings.get("dtype", args[7] if len(args) > 7 else torch.float32)
    work = points * count_operations(likelihood)
    network: list[tuple[Any, ...]] = []
    with torch.no_grad():
        plain = fused._Weights.score
        fused._Weights.score = lambda *own: network.append(own) or plain(*own)  # type: ignore[method-assign, assign, func-returns-value]
        try:
            fused.score(*args, **settings)
        finally:
            fused._Weights.score = plain  # type: ignore[method-assign]
        rates: dict[str, list[float]] = {"peak": [], "network": [], "whole": []}
        for _ in range(repeats):
            rates["peak"].append(measure_peak(dtype))
            rates["network"].append(work / clock(lambda: plain(*network[0])))
            rates["whole"].append(work / clock(lambda: fused.score(*args, **settings)))
    names = {
        "peak": "matrix product, the best size",
        "network": f"the likelihood's network, {points:,} points",
        "whole": "the likelihood with its inputs",
    }
    lines = []
    for key, title in names.items():
        shares = sorted(100 * a / b for a, b in zip(rates[key], rates["peak"], strict=True))
        rate = statistics.median(rates[key]) / 1e9
        cells = [title, str(dtype).removeprefix("torch."), f"{rate:.0f}"]
        cells += [f"{x:.0f}" for x in (statistics.median(shares), shares[0], shares[-1])]
        lines.append(format_row(cells))
    return "roofline", SHARES, lines


def measure_parts(repeats: int) -> Table:
    """Return the table of where an estimate's time goes, medians."""
    from posefilter.confidence.calibration import Calibration
    from posefilter.filters import loop, refine
    from posefilter.models.pose_pf import PosePF

    estimator, image = posefilter.load(OBJECT, device="cpu"), draw_image()
    estimator.predict(*image)
    rows: list[dict[str, float]] = []
    for _ in range(repeats):
        recorder = Recorder()
        watched = (
            (PosePF, "encode", "networks on the image: U-Net, proposals"),
            (fused._Weights, "score", "likelihood: its network"),
            (fused, "_inputs", "likelihood: its inputs"),
            (reference.PoseLikelihood, "forward", "likelihood: surface term, pooling"),
            (refine.Rescore, "__call__", "rescoring, without the likelihood"),
            (refine.MeanShift, "__call__", "mean shift, without the likelihood"),
            (loop.ParticleFilter, "forward", "filter: resampling, moves, proposals"),
            (Calibration, "assess", "calibrated confidence"),
        )
        for owner, name, title in watched:
            recorder.watch(owner, name, title)
        try:
            whole = clock(lambda: estimator.predict(*image))
        finally:
            recorder.close()
        row = dict(recorder.seconds)
        row["what is left"] = whole - sum(row.values())
        rows.append(row | {"all": whole})
    lines = []
    total = statistics.median(row["all"] for row in rows)
    for title in rows[0]:
        own = statistics.median(row.get(title, 0.0) for row in rows)
        lines.append((own, format_row([title, f"{1000 * own:.1f}", f"{100 * own / total:.0f}"])))
    return "parts", PARTS, [line for _, line in sorted(lines, reverse=True)]


def measure(repeats: int, threads: int) -> list[Table]:
    """Return the tables."""
    torch.set_num_threads(threads)
    return [measure_likelihood(repeats), measure_parts(repeats)]
