"""Measure how long training waits for its data: `python bench/loader.py ROOT --object NAME --meshes builtin`.

A step of training is stood in for by `--step-ms` of computing on one core (give the step time of your method); between steps
the next batch is asked for, and the time until it is there is what training waits. Augmentation is as strong as it gets.
"""

import argparse
import time

import torch

from posefilter.data.augment import Blank, Colour, Compose, DepthNoise, PasteOccluder, RollAndZoom
from posefilter.data.module import PoseDataModule


def compute(seconds: float) -> None:
    """Keep one core busy, as a training step does."""
    end = time.perf_counter() + seconds
    matrix = torch.rand(128, 128)
    while time.perf_counter() < end:
        matrix = (matrix @ matrix).clamp(0, 1)


def measure(module: PoseDataModule, step: float, steps: int) -> tuple[float, float]:
    """Return the share of time spent waiting, and the first wait [s] (workers starting), which the share leaves out."""
    waiting = working = first = 0.0
    done = 0
    loader = module.train_dataloader()
    for epoch in range(steps):
        loader.sampler.set_epoch(epoch)
        batches = iter(loader)
        while done <= steps:
            began = time.perf_counter()
            if next(batches, None) is None:
                break
            waited = time.perf_counter() - began
            compute(step)
            if done == 0:
                first = waited
            else:
                waiting, working = waiting + waited, working + time.perf_counter() - began - waited
            done += 1
        if done > steps:
            break
    return waiting / (waiting + working), first


def main() -> None:
    """Print a table: cache, workers, set-up time, share of time waiting."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("root")
    parser.add_argument("--object", default=None)
    parser.add_argument("--meshes", default="builtin")
    parser.add_argument("--width", type=int, default=320)
    parser.add_argument("--batch", type=int, default=6)
    parser.add_argument("--step-ms", type=float, default=400.0)
    parser.add_argument("--steps", type=int, default=25)
    parser.add_argument("--workers", type=int, nargs="+", default=[0, 1, 2])
    args = parser.parse_args()
    torch.set_num_threads(1)
    augment = Compose([RollAndZoom(), PasteOccluder(), Blank(), DepthNoise(), Colour()])
    print(f"{'cache':8} {'workers':>7} {'set-up [s]':>10} {'first batch [s]':>15} {'waiting':>8}")
    for cache in ("none", "memory", "disk"):
        for workers in args.workers:
            module = PoseDataModule(
                "fat",
                args.root,
                args.object,
                args.meshes,
                image_width=args.width,
                split={"train": 1.0},
                batch_size=args.batch,
                workers=workers,
                augment=augment,
                cache=cache,
                progress=False,
            )
            began = time.perf_counter()
            module.setup("fit")
            ready = time.perf_counter() - began
            share, first = measure(module, args.step_ms / 1000, args.steps)
            print(f"{cache:8} {workers:7d} {ready:10.1f} {first:15.2f} {share:8.1%}", flush=True)


if __name__ == "__main__":
    main()
