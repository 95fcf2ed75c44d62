"""Measure what a validation's figures cost: `python bench/figures_cost.py [--checkpoint FILE]
[train.py's settings ...]`.

Validations of the same method on the same images run by turns without and with every callback that
only looks, each figure drawn at each validation however long it takes (in a training, drawing is
put off where it would take more than its share). Computing time tells the same where other programs
keep the machine busy. Without a checkpoint the method is new, which takes as long.
"""

import tempfile
import time
from pathlib import Path
from typing import Any

import torch
from lightning import Callback, LightningModule, Trainer
from lightning.pytorch.loggers import TensorBoardLogger
from programs import HOME, make_parser

from posefilter.callbacks.tensorboard import Budget
from posefilter.cli.checkpoints import build_method, method_of, read_checkpoint, recipe
from posefilter.cli.command import compose_job
from posefilter.cli.instantiate import instantiate
from posefilter.cli.machine import settle

LOOKING = ("layout", "speed", "diagnostics", "health", "figures")


class Clock(Callback):
    """Remember when a validation began and ended, seen from its place among the callbacks."""

    def __init__(self) -> None:
        self.began = self.ended = (0.0, 0.0)

    def on_validation_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Start."""
        self.began = time.perf_counter(), time.process_time()

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Stop."""
        self.ended = time.perf_counter(), time.process_time()


def validate(
    method: LightningModule, data: Any, callbacks: list[Callback], folder: str
) -> tuple[float, float]:
    """Return what one validation takes: time, and computing time of all threads [s]."""
    first, last = Clock(), Clock()
    trainer = Trainer(
        logger=TensorBoardLogger(folder, name="", version="", default_hp_metric=False),
        callbacks=[first, *callbacks, last],
        enable_progress_bar=False, enable_model_summary=False, enable_checkpointing=False,
        inference_mode=False,
    )  # fmt: skip
    trainer.validate(method, datamodule=data, verbose=False)
    return last.ended[0] - first.began[0], last.ended[1] - first.began[1]


def looking(job: Any, folder: str) -> list[Callback]:
    """Build the callbacks that look, without a limit to what drawing takes."""
    job.cfg.folder = folder
    made = instantiate({name: job.cfg.callbacks[name] for name in LOOKING}, "callbacks")
    for callback in made.values():
        if isinstance(getattr(callback, "budget", None), Budget):
            callback.budget = Budget(None)
    return list(made.values())


def main() -> None:
    """Measure and print."""
    parser = make_parser(__doc__)
    parser.add_argument("--checkpoint", default=None)
    parser.add_argument("--repeats", type=int, default=5)
    known, settings = parser.parse_known_args()
    with tempfile.TemporaryDirectory() as folder:
        job = compose_job("train", HOME / "conf", settings, Path(folder))
        settle(job.cfg.threads, job.cfg.seed)
        data = instantiate(job.cfg.data, "data")
        data.prepare_data()
        data.setup("fit")
        checkpoint = read_checkpoint(known.checkpoint) if known.checkpoint else None
        if checkpoint:
            method = method_of(checkpoint)
        else:
            method = build_method(recipe(job), data.object_to_learn())
        # caches, fonts and compiled kernels: neither's to pay
        validate(method, data, looking(job, folder), folder)
        plain, drawn = [], []
        for number in range(known.repeats):
            for with_figures in (True, False) if number % 2 else (False, True):
                took = validate(method, data, looking(job, folder) if with_figures else [], folder)
                (drawn if with_figures else plain).append(took)
                print(
                    f"{'with' if with_figures else 'without'} figures: {took[0]:.2f} s, computing "
                    f"{took[1]:.2f} s",
                    flush=True,
                )
    print(f"{known.repeats} validations each, by turns, {torch.get_num_threads()} threads")
    for kind, without, with_all in zip(
        ("time", "computing"), zip(*plain, strict=True), zip(*drawn, strict=True), strict=True
    ):
        ratios = [a / b for a, b in zip(with_all, without, strict=True)]
        print(
            f"{kind}: {sum(without):.2f} s without and {sum(with_all):.2f} s with all figures; "
            f"ratio "
            f"{sum(with_all) / sum(without):.3f}, of pairs {min(ratios):.3f} to {max(ratios):.3f}"
        )


if __name__ == "__main__":
    main()
