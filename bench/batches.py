"""Single images against batches, a cold estimate by the clock, and the share of the matmul peak.

    python bench/batches.py --frames DIR --meshes DIR [--only 003_cracker_box] [--threads 2]

An estimate without anything before it, image by image and 8 in one call; both in turn, in one
process. Then what an estimate multiplies and adds in matrix products and convolutions, counted by
torch, against the fastest product, in the type that estimates take, that this machine was seen to
do in the same process: how much a batch could win at most. Writes the table of docs/performance.md,
but for other weights or settings than those that ship, which are only printed.
"""

import math
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from marked import format_row, put_table
from programs import HOME, make_parser
from torch.utils.flop_counter import FlopCounterMode

import posefilter
from posefilter.data.frames import Sample
from posefilter.data.readers.registry import open_meshes, open_reader
from posefilter.data.sequences import SceneVideo, VideoFrame, list_scenes
from posefilter.memory import keep_freed_memory
from posefilter.nets.layers import fast_bfloat16

PAGE = HOME / "docs" / "performance.md"
# options whose defaults the table is of
OF_THE_TABLE = ("only", "weights", "overrides", "threads", "size")
HEAD = (
    "threads", "images in a call", "an image, ms", "CPU ms", "throughput over single images",
    "GFLOP an image", "GFLOP a CPU second", "peak", "share of the peak",
)  # fmt: skip
SIZE = 2048  # of the product that gives the peak


def count_convolution(x: Any, *_: Any, out_shape: Any = None, **__: Any) -> int:
    """Return the operations of oneDNN's 3 x 3 convolution; its weight is in an order of its own."""
    return int(2 * math.prod(out_shape) * x[1] * 9)


def count_linear(x: Any, *_: Any, out_shape: Any = None, **__: Any) -> int:
    """Return the operations of oneDNN's linear layer."""
    return int(2 * math.prod(out_shape) * x[-1])


def count_added(into: Any, a: Any, b: Any, *_: Any, out_shape: Any = None, **__: Any) -> int:
    """Return the operations of a product that is added to what is there."""
    return int(2 * math.prod(out_shape) * a[-1])


def list_counts() -> dict[Any, Callable[..., int]]:
    """Return how torch is to count the operations that it does not know."""
    return {
        torch.ops.mkldnn._convolution_pointwise: count_convolution,
        torch.ops.mkldnn._linear_pointwise: count_linear,
        torch.ops.aten.addmm_: count_added,
    }


def measure_peak() -> float:
    """Return the operations a second of the processor of the fastest of some products, in the type
    that estimates are computed in.
    """
    fast = fast_bfloat16(torch.device("cpu"))
    a = torch.randn(SIZE, SIZE).to(torch.bfloat16 if fast else torch.float32)
    return 2 * SIZE**3 / min(take_time(lambda: a @ a)[1] for _ in range(8))


def stack(frames: Sequence[VideoFrame | Sample]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return frames as a batch."""
    parts = [(one.rgb, one.depth, one.intrinsics) for one in frames]
    rgb, depth, intrinsics = (np.stack(part) for part in zip(*parts, strict=True))
    return rgb, depth, intrinsics


def take_time(call: Callable[[], Any]) -> tuple[float, float]:
    """Return the seconds of a call, by the clock and of the processor."""
    wall, cpu = time.perf_counter(), time.process_time()
    call()
    return time.perf_counter() - wall, time.process_time() - cpu


def measure(
    estimator: posefilter.Estimator, frames: Sequence[VideoFrame], threads: int, rounds: int
) -> list[str]:
    """Return the rows of single images and of a batch, measured in turn."""
    torch.set_num_threads(threads)
    peak = measure_peak()
    count = len(frames)
    batch = stack(frames)
    one = tuple(part[0] for part in batch)
    with FlopCounterMode(display=False, custom_mapping=list_counts()) as counter:
        estimator.predict(*one)
    work = counter.get_total_flops()
    estimator.predict(*batch)  # warm
    seconds: dict[int, list[tuple[float, float]]] = {1: [], count: []}
    for number in range(rounds):
        for n in range(number % 2, count, 2):
            frame = tuple(part[n] for part in batch)
            seconds[1].append(take_time(lambda frame=frame: estimator.predict(*frame)))
        taken = take_time(lambda: estimator.predict(*batch))
        seconds[count].append((taken[0] / count, taken[1] / count))
    medians = {size: np.median(np.array(all_), axis=0) for size, all_ in seconds.items()}
    rows = []
    for size, (wall, cpu) in medians.items():
        rate = work / cpu
        cells = [str(threads), str(size), f"{1000 * wall:.0f}", f"{1000 * cpu:.0f}"]
        cells += [f"{medians[1][0] / wall:.2f}", f"{work / 1e9:.1f}", f"{rate / 1e9:.0f}"]
        cells += [f"{peak / 1e9:.0f}", f"{100 * rate / peak:.0f} %"]
        rows.append(format_row(cells))
        print(rows[-1], flush=True)
    return rows


def main() -> None:
    """Measure, print and write."""
    parser = make_parser(__doc__)
    parser.add_argument("--frames", required=True, help="a folder of YCB-Video")
    parser.add_argument("--meshes", required=True, help="a folder of YCB's meshes")
    parser.add_argument("--only", default="003_cracker_box", help="the object")
    parser.add_argument("--weights", help="a file of the object, in place of what ships")
    parser.add_argument("--overrides", nargs="*", default=[], help="such as filter.steps=4")
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--size", type=int, default=8, help="images in a batch")
    parser.add_argument("--rounds", type=int, default=4, help="batches")
    options = parser.parse_args()
    keep_freed_memory()
    names = [options.only]
    meshes = open_meshes(options.meshes, None, "ycb_video", names)
    reader = open_reader("ycb_video", options.frames, names, meshes, subsets=["data"])
    frames = [frame for scene in list_scenes(reader) for frame in SceneVideo(reader, scene, names)]
    frames = [frame for frame in frames if options.only in frame.truth][: options.size]
    weights = options.weights or options.only
    estimator = posefilter.load(weights, device="cpu", overrides=options.overrides)
    first = frames[0]
    torch.set_num_threads(max(options.threads))
    wall, cpu = take_time(lambda: estimator.predict(first.rgb, first.depth, first.intrinsics))
    print(f"the first estimate of the process: {wall:.2f} s by the clock, {cpu:.2f} s of CPU")
    rows = []
    for threads in options.threads:
        rows += measure(estimator, frames, threads, options.rounds)
    changed = [name for name in OF_THE_TABLE if getattr(options, name) != parser.get_default(name)]
    if not changed:
        PAGE.write_text(put_table(PAGE.read_text(), "batches", HEAD, rows))


if __name__ == "__main__":
    main()
