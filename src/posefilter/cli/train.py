"""Train a method, test its best checkpoint, and write down what came of it."""

import json
import logging
import time
import warnings
from pathlib import Path
from typing import Any

import torch
from lightning import Callback, LightningDataModule, Trainer
from lightning.pytorch.loggers import Logger
from omegaconf import DictConfig, OmegaConf
from torch.utils.data import default_collate

from posefilter.callbacks.tensorboard_layout import TensorBoardLayout
from posefilter.cli.checkpoints import build_method, method_of, read_checkpoint, recipe
from posefilter.cli.comparing import HANDS, comparable, differing
from posefilter.cli.console import JSON, is_installed, say, typed
from posefilter.cli.files import WholeCheckpoints
from posefilter.cli.instantiate import instantiate
from posefilter.cli.job import Job
from posefilter.cli.machine import settle
from posefilter.cli.progress_bar import progress
from posefilter.cli.results import record, show, write_json
from posefilter.cli.resume import BEFORE, LAST, last_checkpoints
from posefilter.cli.stopping import Stop
from posefilter.cli.warm_start import warm_start
from posefilter.data.module import PoseDataModule
from posefilter.errors import Stopped, UserError
from posefilter.models.base import PoseEstimator, score_of
from posefilter.paths import stays_inside

log = logging.getLogger(__name__)


def train(job: Job) -> float:
    """Train and test; write metrics.json into the job's folder.

    Returns the score that sweeps maximize.
    """
    done = finished(job)
    if done is not None:
        changed = changed_since(job)
        other = f", with other settings than now ({', '.join(changed[:5])})" if changed else ""
        sentence = f"{job.folder}: done before{other}; delete its metrics.json to run it again"
        say(job.cfg.console, "skipped", sentence, run=str(job.folder), changed=changed)
        return score_of(done)
    settle(job.cfg.threads, job.cfg.seed)
    # first, since they are the sooner to complain
    method, trainer = build_method(recipe(job)), build_trainer(job)
    data = build_data(job.cfg.data, job.cfg.console)
    data.setup("fit")
    method.set_object(data.object_model(0))
    if job.cfg.warm_start:
        copied, left = warm_start(method, read_checkpoint(job.cfg.warm_start))
        log.info(
            "warm start from %s: %d tensors copied, %d left as drawn",
            job.cfg.warm_start,
            copied,
            left,
        )
    rehearse(method, data)
    write_json(job.folder / "data.json", {**data.describe(), "split": data.split_record()})
    start, before = start_from(job)
    began = time.perf_counter(), time.process_time()
    try:
        trainer.fit(method, datamodule=data, ckpt_path=start, weights_only=True)
    except Stopped:
        say_stopped(job, trainer.global_step)
        raise
    best = job.folder / "checkpoints" / "best.ckpt"
    kept = read_checkpoint(best)
    training = cost(trainer.global_step, before, *began) | {"tested_step": int(kept["global_step"])}
    results = test(trainer, data, kept)
    metrics = record(results, job, data.describe(), best) | {"training": training}
    write_json(job.folder / "metrics.json", metrics)
    files = {"run": job.folder, "checkpoint": best, "metrics": job.folder / "metrics.json"}
    following = (
        []
        if job.swept
        else [
            typed("report", run=job.folder),
            typed("evaluate", checkpoint=best, **places(job)),
            "tensorboard --logdir outputs" if is_installed() else "make board",
        ]
    )
    show(
        metrics,
        f"{job.choices['model']}, loss {job.choices['loss']}",
        job.cfg.console,
        "trained",
        files,
        following,
    )
    return score_of(metrics)


def places(job: Job) -> dict[str, Any]:
    """Return the folders that an evaluation is to be told: outside of the working folder no
    checkpoint decides on any.
    """
    named = {key: job.cfg.data.get(key) for key in ("root", "meshes", "cache_dir", "model_points")}
    return {
        f"data__{key}": value
        for key, value in named.items()
        if value and not stays_inside(str(value), Path())
    }


def rehearse(method: PoseEstimator, data: PoseDataModule) -> None:
    """Run the filter on one image before it is trained, as a validation will.

    Pieces that do not fit each other raise their UserError now, not after the hour that it takes to
    the first validation.
    """
    was_training = method.training
    with torch.no_grad():
        batch = default_collate([data.val_dataset[0]])
        method.eval().box(method.predict_step(batch, 0), batch)
    method.train(was_training)


def cost(steps: int, before: int, wall: float, cpu: float) -> dict[str, float | None]:
    """Return what a step of training took, validations included: by the clock, and of this
    process's own processor time.

    before: steps that an earlier start had done; wall, cpu: the two clocks when this one began [s].
    The processor time says what a run costs where others compute beside it; it is the sum over
    threads, without the loader's workers.
    """
    done = steps - before
    each = (time.perf_counter() - wall, time.process_time() - cpu)
    seconds, cpu_seconds = (spent / done if done > 0 else None for spent in each)
    return {"steps": steps, "seconds_per_step": seconds, "cpu_seconds_per_step": cpu_seconds}


def build_data(node: DictConfig, console: str) -> PoseDataModule:
    """Build the data module, and have its scenes rendered where they are missing."""
    if console == JSON:
        node = without_bars(node)
    data = instantiate(node, "data")
    if not isinstance(data, PoseDataModule):
        raise UserError(f"data._target_={node.get('_target_')}: is no data module")
    data.prepare_data()
    return data


def without_bars(node: DictConfig) -> DictConfig:
    """Return the settings of the data with every bar switched off."""
    out = OmegaConf.create(OmegaConf.to_container(node, resolve=True))
    assert isinstance(out, DictConfig)
    for section in (out, out.get("generate")):
        if section and "progress" in section:
            section.progress = False
    return out


def build_trainer(job: Job) -> Trainer:
    """Build the trainer with its callbacks and logger; they write into the job's folder."""
    quiet()
    cfg = job.cfg.copy()
    cfg.folder = str(job.folder)
    steps, interval = cfg.trainer.get("max_steps", -1), cfg.trainer.get("val_check_interval")
    # else it would never be validated, and have no best checkpoint
    if isinstance(interval, int) and 0 < steps < interval:
        log.info(
            "trainer.val_check_interval=%d is more than max_steps=%d: validated at the end",
            interval,
            steps,
        )
        cfg.trainer.val_check_interval = steps
    callbacks: list[Callback] = [
        made for made in (instantiate(cfg.callbacks, "callbacks") or {}).values() if made
    ]
    for layout in callbacks:
        if isinstance(layout, TensorBoardLayout):
            layout.settings = comparable(job)
            layout.swept = (
                tuple(o.split("=", 1)[0].lstrip("+~") for o in job.overrides) if job.swept else ()
            )
    callbacks.append(progress(cfg.console))
    loggers: list[Logger] = [
        made for made in (instantiate(cfg.logger, "logger") or {}).values() if made
    ]
    return make_trainer(cfg.trainer, callbacks, loggers)


def make_trainer(
    node: DictConfig, callbacks: list[Callback], loggers: list[Logger] | None = None
) -> Trainer:
    """Build a trainer of its settings; refuse those that would blur poses."""
    precision = node.get("precision", "32-true")
    if str(precision) not in ("32-true", "32"):
        raise UserError(
            f"trainer.precision={precision}: half precision costs a pose millimeters, and double "
            f"slows all down; "
            "leave it at 32-true (networks take bfloat16 by themselves where that is fast and "
            "safe)"
        )
    trainer = instantiate(
        node,
        "trainer",
        callbacks=[*callbacks, Stop()],
        logger=loggers or False,
        plugins=WholeCheckpoints(),
        enable_progress_bar=False,
    )
    assert isinstance(trainer, Trainer)
    return trainer


def test(trainer: Trainer, data: LightningDataModule, checkpoint: dict[str, Any]) -> dict[str, Any]:
    """Test what a checkpoint holds, built anew from it alone, as `evaluate.py` would."""
    method = method_of(checkpoint)
    trainer.test(method, datamodule=data, verbose=False)
    return method.results()


def start_from(job: Job) -> tuple[Path | None, int]:
    """Return the checkpoint to go on from, of `resume` or of a sweep's job that was cut short, and
    its step; (None, 0) where the training starts anew.

    Where the last checkpoint is broken it is the one before, and the console says so.
    """
    begun = job.swept and any((job.folder / "checkpoints" / n).is_file() for n in (LAST, BEFORE))
    source = job.cfg.resume or (job.folder if begun else None)
    if source is None:
        return None, 0
    last, *before = last_checkpoints(source)
    try:
        return last, step_of(last)
    except UserError as error:
        if not before:
            raise
        say(job.cfg.console, "fallback", f"{error}; going on from {before[0]}", checkpoint=last)
        return before[0], step_of(before[0])


def step_of(checkpoint: Path) -> int:
    """Return the step at which a checkpoint was written.  Raises UserError where it is broken."""
    return int(read_checkpoint(checkpoint)["global_step"])


def say_stopped(job: Job, step: int) -> None:
    """Say where a training was stopped, and how to go on."""
    again = f"the same command with out={job.folder.parent}" if job.swept else ""
    again = again or typed("train", resume=job.folder)
    there = (job.folder / "checkpoints" / LAST).is_file()
    sentence = (
        f"stopped at step {step}; go on with: {again}" if there else f"stopped at step {step}"
    )
    say(job.cfg.console, "stopped", sentence, step=step, next=again)


def finished(job: Job) -> dict[str, Any] | None:
    """Return the metrics of a sweep's job that was done before, with the same overrides where they
    decide a result.
    """
    kept, path = job.folder / "metrics_train.json", job.folder / "metrics.json"
    path = kept if kept.is_file() else path
    if not (job.swept and path.is_file()):
        return None
    metrics: dict[str, Any] = json.loads(path.read_text())
    return metrics if deciding(metrics["overrides"]) == deciding(job.overrides) else None


def changed_since(job: Job) -> list[str]:
    """Return the settings in which a job that is done differs from what its words mean now, as
    defaults may change.
    """
    try:
        then = read_checkpoint(job.folder / "checkpoints" / "best.ckpt")["recipe"]
    except UserError:  # what is left of a finished job need not be whole: its results are
        return []
    return differing(then, recipe(job))


def deciding(overrides: list[str]) -> list[str]:
    """Return what was typed, in one order, less what says where and with how many hands a run is
    done.
    """
    return sorted(typed for typed in overrides if typed.split("=", 1)[0].lstrip("+~") not in HANDS)


def quiet() -> None:
    """Silence advice that does not apply here."""
    logging.getLogger("lightning.pytorch.utilities.rank_zero").setLevel(logging.WARNING)
    for text in (
        ".*does not have many workers.*",
        ".*LeafSpec.*",
        ".*Checkpoint directory.*",
        ".*log_every_n_steps.*",
    ):
        warnings.filterwarnings("ignore", text)
    torch.set_float32_matmul_precision("highest")  # TF32 would cost a pose at 1 m half a millimeter
