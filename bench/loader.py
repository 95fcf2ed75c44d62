"""Measure how long training waits for its data: `python bench/loader.py [--steps N] [train.py's
settings ...]`.

The method really trains, a few steps for each kind of cache and each number of loader processes,
and `Speed` says which share of the time it waited. Epochs are short here, so that what their starts
cost is in the share. Without settings: the default method on 400 rendered frames.
"""

import tempfile
import time
from pathlib import Path

import torch
from omegaconf import OmegaConf
from programs import HOME, make_parser

from posefilter.callbacks.speed import Speed
from posefilter.cli.build import build_data, make_trainer, quiet
from posefilter.cli.checkpoints import build_method, recipe
from posefilter.cli.command import compose_job
from posefilter.cli.instantiate import instantiate
from posefilter.cli.job import Job
from posefilter.cli.machine import settle

FEW = ["data.generate.frames=400"]


def measure(job: Job, cache: str, workers: int, steps: int) -> tuple[float, float, float]:
    """Train; return the time until the data was ready [s], steps a second, and the share of the
    time spent waiting.
    """
    node = job.cfg.data.copy()
    node.cache, node.workers = cache, workers
    began = time.perf_counter()
    data = build_data(node, "json")
    data.setup("fit")
    ready = time.perf_counter() - began
    method, speed = build_method(recipe(job)), Speed()
    method.set_object(data.object_to_learn())
    brief = {"max_steps": steps, "limit_val_batches": 0, "log_every_n_steps": 2 * steps}
    trainer = make_trainer(OmegaConf.merge(job.cfg.trainer, brief), [speed])
    trainer.fit(method, datamodule=data)
    found = speed.training()
    return ready, found["train_steps_per_second"], found["waiting_fraction"]


def main() -> None:
    """Print a table: cache, processes, set-up, speed, share of the time spent waiting."""
    parser = make_parser(__doc__)
    parser.add_argument("--steps", type=int, default=60)
    parser.add_argument("--workers", default="0,1,2")
    known, settings = parser.parse_known_args()
    quiet()
    with tempfile.TemporaryDirectory() as folder:
        job = compose_job("train", HOME / "conf", [*FEW, *settings], Path(folder))
        settle(job.cfg.threads, job.cfg.seed)
        job.cfg.trainer.default_root_dir = folder
        instantiate(job.cfg.data, "data").prepare_data()
        print(
            f"batches of {job.cfg.data.batch_size}, {torch.get_num_threads()} threads, "
            f"{known.steps} steps each"
        )
        print(f"{'cache':8} {'workers':>7} {'set-up [s]':>10} {'steps/s':>8} {'waiting':>8}")
        for cache in ("none", "memory", "disk"):
            for workers in map(int, known.workers.split(",")):
                ready, rate, share = measure(job, cache, workers, known.steps)
                print(f"{cache:8} {workers:7d} {ready:10.1f} {rate:8.2f} {share:8.1%}", flush=True)


if __name__ == "__main__":
    main()
