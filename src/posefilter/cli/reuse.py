"""What was done before, and need not be done again: a sweep's finished job, the training of one
that learned the same, the steps of a run that was cut short.
"""

import json
from hashlib import sha256
from pathlib import Path
from typing import Any

from posefilter.cli.checkpoints import is_calibrated_filter, read_checkpoint, recipe
from posefilter.cli.comparing import differing
from posefilter.cli.console import say
from posefilter.cli.files import save_whole
from posefilter.cli.folders import own_metrics, read_results
from posefilter.cli.instantiate import locate
from posefilter.cli.job import Job
from posefilter.cli.plain import find, resolve
from posefilter.cli.resume import BEFORE, LAST, last_checkpoints
from posefilter.errors import UserError

# threads: another number adds up a gradient in another order, so that its last digits differ
_LEARNED_FROM = ("model", "data", "trainer", "callbacks", "seed", "warm_start", "threads")
_TESTED_WITH = ("limit_test", "workers", "progress")  # of the data
_MOST_STEPS = 1 << 40
_WORKERS = "data.workers"  # with other ones the same is learned, at another speed
_SPEEDS = ("seconds_per_step", "cpu_seconds_per_step")


def finished(job: Job) -> dict[str, Any] | None:
    """Return the metrics of a sweep's job that was done before; the console says so.

    Raises:
        UserError: Its folder holds the results of another.
    """
    metrics = read_results(job)
    if not metrics:
        return None
    changed = changed_since(job)
    other = f", with other settings than now ({', '.join(changed[:5])})" if changed else ""
    sentence = f"{job.folder}: done before{other}; delete its metrics.json to run it again"
    say(job.cfg.console, "skipped", sentence, run=str(job.folder), changed=changed)
    return metrics


def changed_since(job: Job) -> list[str]:
    """Return the settings in which a job that is done differs from what its words mean now."""
    try:
        then = read_checkpoint(job.folder / "checkpoints" / "best.ckpt")["recipe"]
    except UserError:  # what is left of a finished job need not be whole: its results are
        return []
    return differing(then, recipe(job))


def learned_from(job: Job) -> str:
    """Return a digest of all that a job's training depends on: two jobs that have the same learn
    the same.

    Left out is what only testing reads: a few settings of the data, what the method names in
    `test_only_settings`, and `filter` where training rolls out another. The weights of each step
    are then the same; which step is the best, the validations of the job that trained have chosen,
    by its own filter.
    """
    cfg = job.cfg.copy()
    cfg.folder = ""
    used: dict[str, Any] = {key: resolve(cfg[key]) for key in _LEARNED_FROM}
    method: Any = locate(str(cfg.model._target_), "model")
    tested = {
        *method.test_only_settings,
        *(["filter"] if used["model"].get("train_rollout") else []),
    }
    used["model"] = {key: value for key, value in used["model"].items() if key not in tested}
    used["data"] = {key: value for key, value in used["data"].items() if key not in _TESTED_WITH}
    return sha256(json.dumps(used, sort_keys=True, default=str).encode()).hexdigest()


def take_over(job: Job) -> dict[str, Any] | None:
    """Take the checkpoints of another job of the sweep that has learned what this one would.

    Returns:
        The other's record of its training, less its speed where this job would have another; None
        where there is no such job.
    """
    if not job.swept:
        return None
    wanted = learned_from(job)
    alike: list[tuple[Path, dict[str, Any]]] = []
    for folder in sorted(job.folder.parent.iterdir()):
        has_weights = (folder / "checkpoints" / "best.ckpt").is_file()
        training = own_metrics(folder).get("training", {}) if has_weights else {}
        if folder != job.folder and training.get("learned_from") == wanted:
            alike.append((folder, training))
    if not alike:
        return None
    # first a job that was trained: a copy of its weights may stand before it, and chose no step
    folder, training = min(alike, key=lambda entry: "trained_as" in entry[1])
    trainer = training.get("trained_as", folder.name)
    checkpoint = read_checkpoint(folder / "checkpoints" / "best.ckpt")
    then, now = checkpoint["recipe"], recipe(job)
    others = differing(then, now)
    if find(then["settings"], _WORKERS) != find(now["settings"], _WORKERS):
        others.append(_WORKERS)
        training = {**training, **dict.fromkeys(_SPEEDS)}
    if not is_calibrated_filter(now["settings"], then["settings"]):
        checkpoint.pop("calibration", None)
    save_whole({**checkpoint, "recipe": now}, job.folder / "checkpoints" / "best.ckpt")
    # there are none where what differs is no setting of a training, as a logger
    reason = f"training does not depend on {', '.join(others)}, but " if others else ""
    sentence = (
        f"{job.folder.name}: only tested, with what {trainer} has learned; {reason}its "
        f"best checkpoint was chosen by validations of {trainer}"
    )
    say(job.cfg.console, "reused", sentence, run=str(job.folder), trained=str(folder))
    return {**training, "trained_as": trainer}


def start_from(job: Job) -> tuple[Path | None, int]:
    """Return the checkpoint to go on from, of `resume` or of a sweep's job that was cut short, and
    its step; (None, 0) where the training starts anew.

    Where the last checkpoint is broken it is the one before, and the console says so.

    Raises:
        UserError: No checkpoint is whole, or a sweep's job was begun with other settings.
    """
    source = find_begun(job)
    if source is None:
        return None, 0
    last, *before = last_checkpoints(str(source))  # a folder's name may read as a number
    try:
        checkpoint, step = _read_training(last)
    except UserError as error:
        if not before:
            raise
        sentence = f"{error}; going on from {before[0]}"
        say(job.cfg.console, "fallback", sentence, broken=last, checkpoint=before[0])
        last = before[0]
        checkpoint, step = _read_training(last)
    changed = [] if job.cfg.resume else differing(checkpoint["recipe"], recipe(job))
    changed = [key for key in changed if key not in {f"data.{name}" for name in _TESTED_WITH}]
    if changed:
        raise UserError(
            f"{job.folder}: holds a run that was cut short, with other settings than now "
            f"({', '.join(changed[:5])}); delete it, or choose another out="
        )
    return last, step


def _read_training(file: Path) -> tuple[dict[str, Any], int]:
    """Return what a checkpoint of a training holds, and its step.

    Raises UserError where it is broken, or has weights alone.
    """
    checkpoint = read_checkpoint(file)
    step = checkpoint.get("global_step")
    if not isinstance(step, int) or not 0 <= step < _MOST_STEPS:
        raise UserError(
            f"checkpoint={file}: is of no training that can go on (it has no step); a new one "
            f"begins with its weights by warm_start={file}"
        )
    return checkpoint, step


def find_begun(job: Job) -> Any:
    """Return the run or checkpoint that a job goes on from; None where it starts anew."""
    begun = job.swept and any((job.folder / "checkpoints" / n).is_file() for n in (LAST, BEFORE))
    return job.cfg.resume or (job.folder if begun else None)


def step_of(checkpoint: Path) -> int:
    """Return the step at which a checkpoint was written.  Raises UserError where it is broken."""
    return _read_training(checkpoint)[1]
