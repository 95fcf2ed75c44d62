"""Train a method, test its best checkpoint, and write down what came of it."""

import logging
import math
import shlex
import time
import traceback
from pathlib import Path
from typing import Any, NamedTuple

import torch
from lightning import Trainer
from lightning.fabric.utilities.exceptions import MisconfigurationException
from lightning.pytorch import callbacks, loops
from torch.utils.data import default_collate

from posefilter.callbacks.tensorboard import get_boards
from posefilter.callbacks.time_budget import TimeBudget
from posefilter.cli.best import check_kept
from posefilter.cli.build import build_data, build_trainer, check_share
from posefilter.cli.checkpoints import build_method, method_of, read_checkpoint, recipe
from posefilter.cli.console import is_installed, say, setting, typed
from posefilter.cli.folders import move_evaluation, own_metrics
from posefilter.cli.job import Job
from posefilter.cli.learned import DATA, list_learned
from posefilter.cli.machine import settle
from posefilter.cli.progress_bar import count_steps
from posefilter.cli.ranks import check_others, is_follower
from posefilter.cli.recipe import check_recipe
from posefilter.cli.results import record, show, write_json
from posefilter.cli.resume import LAST, list_unkept
from posefilter.cli.reuse import find_begun, finished, learned_from, start_from, take_over
from posefilter.cli.stopping import stopped_by_interrupt
from posefilter.cli.warm_start import name_modules, read_starts, warm_start
from posefilter.data.loaders import count_batches
from posefilter.data.module import PoseDataModule
from posefilter.errors import Stopped, UserError, naming
from posefilter.metrics.results import compute_checkpoint_score
from posefilter.models.base import PoseEstimator, Trained
from posefilter.models.rehearsal import check_method
from posefilter.paths import stays_inside
from posefilter.types import Batch

log = logging.getLogger(__name__)


class Run(NamedTuple):
    """What a training is made of."""

    job: Job
    method: PoseEstimator
    trainer: Trainer
    data: PoseDataModule

    @property
    def best(self) -> Path:
        """Return the checkpoint that is tested."""
        return self.job.folder / "checkpoints" / "best.ckpt"


def train(job: Job) -> float:
    """Train and test; write metrics.json into the job's folder.

    Returns the score that sweeps maximize.
    """
    metrics = finished(job)
    if metrics is None:
        run = build(job)
        training = take_over(job) or fit(run)
        checkpoint = read_checkpoint(run.best)
        tested_at = read_trained(checkpoint)
        training |= {"tested_step": tested_at.step}
        metrics = finish(run, training, test(run, checkpoint, tested_at))
        check_others(getattr(run.trainer.strategy.launcher, "procs", ()))
    return compute_checkpoint_score(metrics)


def build(job: Job) -> Run:
    """Build a run, and have the filter look at one image.

    Raises:
        UserError: A setting is wrong, or components do not fit each other: now, not after the hour
            that it takes to the first validation.
    """
    settle(job.cfg.threads, job.cfg.seed)
    # first, since they are the sooner to complain
    settings = recipe(job)
    with naming("what it trains could not be read again"):
        check_recipe(settings)
    method, trainer = build_method(settings), build_trainer(job)
    data = build_data(job.cfg.data, job.cfg.console, job.overrides)
    data.setup("fit")
    if len(data.objects) > 1:
        names = ", ".join(data.objects)
        raise UserError(
            f"data.object: a method learns one object, and the data have {names}; name one, or "
            "sweep over several, -m data.object=A,B"
        )
    object_model = data.object_to_learn()
    method.set_object(object_model)
    if job.cfg.warm_start and find_begun(job) is None:  # else its own checkpoint has them
        starts = read_starts(job.cfg.warm_start, object_model.name)
        copied, left = warm_start(method, starts)
        log.info("warm start from %s: %d tensors copied", job.cfg.warm_start, copied)
        if left:
            log.info("not in %s, and begin at random: %s", job.cfg.warm_start, name_modules(left))
    rehearse(method, data)
    data.check_test()  # which comes last
    if find_begun(job) is not None:
        check_scenes(job.folder / DATA, data)
    if not is_follower():
        write_json(job.folder / DATA, {**data.describe(), "split": data.split_record()})
    return Run(job, method, trainer, data)


def check_scenes(record: Path, data: PoseDataModule) -> None:
    """Refuse to go on where scenes that a run has learned from would be tested on.

    Raises:
        UserError: How many these are.
    """
    learned = list_learned(record, data)
    if learned:
        raise UserError(
            f"data.root={data.root}: its scenes have changed since the run began, and "
            f"{len(learned)} that it learned from would be tested on ({', '.join(learned[:3])}); "
            "train anew in another out=, or undo the change"
        )


def rehearse(method: PoseEstimator, data: PoseDataModule) -> None:
    """See whether a method's parts fit before it is trained, on an image of a validation and one
    of the training.

    Raises:
        UserError: A part returns other than its protocol says.
    """
    frames = data.train_dataset
    learned = default_collate([frames[0]] * 2) if len(frames) else None
    check_method(method, default_collate([data.val_dataset[0]]), learned)


def look_once(method: PoseEstimator, data: PoseDataModule) -> None:
    """Run the filter on one image, as a validation will."""
    was_training = method.training
    with torch.no_grad():
        batch = Batch(*(x.to(method.device) for x in default_collate([data.val_dataset[0]])))
        method.eval().box(method.predict_step(batch, 0), batch)
    method.train(was_training)


def fit(run: Run) -> dict[str, Any]:
    """Train, from where the run was cut short if it was; return what it took.

    Raises:
        Stopped: The run was told to stop; the console says how to go on.
        UserError: Lightning refuses a setting of the trainer or of a callback.
    """
    check_kept(run.trainer.callbacks, run.job.folder)  # type: ignore[attr-defined]
    check_validated(run)
    start, before = start_from(run.job)
    known = own_metrics(run.job.folder).get("training") or {}
    moved = None if is_follower() else move_evaluation(run.job.folder)
    if moved is not None:
        sentence = f"the evaluation that was here is now in {moved}"
        say(run.job.cfg.console, "moved", sentence, evaluation=moved)
    began = time.perf_counter(), time.process_time()
    try:
        with stopped_by_interrupt():
            run.trainer.fit(run.method, datamodule=run.data, ckpt_path=start, weights_only=True)
    except Stopped:
        say_stopped(run)
        raise
    except (MisconfigurationException, ValueError, RuntimeError) as error:
        told = " ".join(str(error).split())
        if start is not None and "loading state_dict" in told:
            first = told.partition(". ")[0]
            raise UserError(
                f"resume={start}: holds other networks than these settings ({first})"
            ) from error
        if not isinstance(error, MisconfigurationException) and not _raised_by_lightning(error):
            raise
        raise UserError(f"trainer or callbacks: {told}") from error
    say_ended(run)
    taken = cost(run.trainer.global_step, before, *began)
    if run.trainer.global_step == before:  # resumed at its end: what was measured stays
        taken |= {k: v for k, v in known.items() if k in taken and taken[k] is None}
    return {**taken, "learned_from": learned_from(run.job)}


def check_validated(run: Run) -> None:
    """Refuse a training that would end before its first validation, so that it would have no best
    checkpoint, or without a test.

    Raises:
        UserError: The settings, and the step of the first validation.
    """
    trainer = run.trainer
    every, interval = trainer.check_val_every_n_epoch, trainer.val_check_interval
    needed = {
        "limit_train_batches": "its validations, which choose the best checkpoint",
        "limit_val_batches": "its validations, which choose the best checkpoint",
        "limit_test_batches": "its test, with which it ends",
    }
    for name, what in needed.items():
        if getattr(trainer, name) == 0:
            raise UserError(f"trainer.{name}=0: a training needs {what}")
    check_share(trainer, run.data, "train")
    check_share(trainer, run.data, "test")
    _check_epochs(trainer)
    if every is None or trainer.max_steps < 0:
        return
    batches = count_batches(len(run.data.train_dataloader()), trainer.limit_train_batches)
    last = interval if isinstance(interval, int) else math.ceil(interval * batches)
    step = ((every - 1) * batches + last) // trainer.accumulate_grad_batches
    if step > trainer.max_steps:
        raise UserError(
            f"trainer.check_val_every_n_epoch={every}: an epoch has {batches} batches, so that the "
            f"first validation is after step {step}, and trainer.max_steps={trainer.max_steps}; "
            "null counts trainer.val_check_interval in steps"
        )


def _check_epochs(trainer: Trainer) -> None:
    """Refuse epochs that end before the first that is validated."""
    epochs, every = trainer.max_epochs, trainer.check_val_every_n_epoch
    if epochs is not None and every is not None and 0 <= epochs < every:
        raise UserError(
            f"trainer.check_val_every_n_epoch={every}: trainer.max_epochs={epochs} end before the "
            "first validation, so that there would be no best checkpoint"
        )


def _raised_by_lightning(error: Exception) -> bool:
    """Return whether Lightning's trainer or a callback of its own has raised an error itself,
    rather than passed it on. A RuntimeError of the trainer may be a device's.
    """
    packages = (callbacks,) if isinstance(error, RuntimeError) else (callbacks, loops)
    folders = [Path(str(package.__file__)).parent for package in packages]
    frames = traceback.extract_tb(error.__traceback__)
    return bool(frames) and any(Path(frames[-1].filename).is_relative_to(at) for at in folders)


def read_trained(checkpoint: dict[str, Any]) -> Trained:
    """Return how far the weights of a run's checkpoint have been trained."""
    return Trained(int(checkpoint["global_step"]), int(checkpoint["epoch"]))


def test(run: Run, checkpoint: dict[str, Any], tested_at: Trained) -> dict[str, Any]:
    """Test what a checkpoint holds, built anew from it alone, as `evaluate.py` would.

    tested_at: The results are logged there.
    """
    method = method_of(checkpoint)
    method.tested_at = tested_at
    try:
        with stopped_by_interrupt():
            run.trainer.test(method, datamodule=run.data, verbose=False)
    except Stopped:
        say_stopped(run)
        raise
    return method.collect_results()


def finish(
    run: Run, training: dict[str, Any], results: dict[str, Any], checkpoint: Path | None = None
) -> dict[str, Any]:
    """Write metrics.json, print the table, and say what may be typed next; return the metrics.

    checkpoint: What was tested; None for the run's best.
    """
    job, file = run.job, run.job.folder / "metrics.json"
    tested = checkpoint or run.best
    device = run.trainer.strategy.root_device
    metrics = record(results, job, run.data.describe(), tested, device) | {"training": training}
    if is_follower():
        return metrics
    write_json(file, metrics)
    report = typed("report", run=job.folder)
    evaluate = typed("evaluate", checkpoint=tested, **places(job), **plugins(job))
    inside = Path("outputs").resolve() in job.folder.resolve().parents
    everything = "tensorboard --logdir outputs" if is_installed() else "make board"
    board = everything if inside else f"tensorboard --logdir {shlex.quote(str(job.folder))}"
    title = f"{job.choices['model']}, loss {job.choices['loss']}"
    files = {"run": job.folder, "checkpoint": tested, "metrics": file}
    following = [] if job.swept else [report, evaluate]
    if following and get_boards(run.trainer):
        following.append(board)
    show(metrics, title, job.cfg.console, "trained", files, following)
    return metrics


def places(job: Job) -> dict[str, Any]:
    """Return the folders and files that an evaluation is to be told, and whether frames are kept on
    disk: outside of the working folder no checkpoint decides on any place.
    """
    data = job.cfg.data
    named = {key: data.get(key) for key in ("root", "meshes", "cache_dir", "model_points_dir")}
    for group in ("options", "split"):  # lists of frames
        named |= {f"{group}.{key}": value for key, value in (data.get(group) or {}).items()}
    outside = {
        f"data__{key}": value
        for key, value in named.items()
        if isinstance(value, str) and not stays_inside(value, Path())
    }
    return outside | ({"data__cache": "disk"} if data.get("cache") == "disk" else {})


def plugins(job: Job) -> dict[str, Any]:
    """Return the plug-ins that a later command is to be told, as no checkpoint names any."""
    return {"plugins": list(job.cfg.plugins)} if job.cfg.get("plugins") else {}


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


def say_ended(run: Run) -> None:
    """Say where a training ended before its last step, unless its time budget was up."""
    step, steps = run.trainer.global_step, count_steps(run.trainer)
    budgets = (one for one in run.trainer.callbacks if isinstance(one, TimeBudget))  # type: ignore[attr-defined]
    if steps is None or step >= steps or any(one.ended for one in budgets):
        return
    sentence = f"ended at step {step} of {steps}, by a callback or trainer.max_time"
    say(run.job.cfg.console, "ended", sentence, step=step, steps=steps)


def say_stopped(run: Run) -> None:
    """Say where a training was stopped, and how to go on."""
    job, step = run.job, run.trainer.global_step
    sentence, again = f"stopped at step {step}", None
    if (job.folder / "checkpoints" / LAST).is_file():
        words = list_unkept(job.overrides)
        again = " ".join([typed("train", resume=job.folder, **plugins(job)), *words])
        if job.swept:
            again = f"the same command with {setting('out', job.folder.parent)}"
        sentence += f"; resume with: {again}"
    say(job.cfg.console, "stopped", sentence, step=step, next=again)
