"""Folders that commands write to: what is in them is not overwritten, and none is left empty."""

import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from itertools import count
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.experimental.callback import Callback
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from posefilter.cli.console import setting
from posefilter.cli.job import Job, check_out
from posefilter.cli.plain import key_of
from posefilter.cli.ranks import is_follower
from posefilter.errors import Carrier, UserError
from posefilter.files import remove_parts, write_whole
from posefilter.limits import read_json
from posefilter.locks import hold
from posefilter.report.settings import SILENT

FAILED = "failed.json"  # in the folder of a sweep's job
OUTPUTS = "outputs"  # where commands write unless told otherwise
_WRITTEN = (".", "checkpoints", "figures", "beliefs")  # folders of ours in a command's folder
_BY_HYDRA = ("config.yaml", "hydra.yaml", "overrides.yaml")


class KeepResults(Callback):
    """Hydra's callback: refuses a folder that holds results, before anything is written to it."""

    def on_run_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Check a run's folder."""
        HydraConfig.instance().set_config(config)  # which the folder's name refers to
        with passing_hydra():
            check_place(config.hydra)
            self._check_run(config)

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Check a sweep's folder: an earlier start of the sweep is resumed."""
        with passing_hydra():
            check_place(config.hydra)
            check_out(config)
            folder = Path(config.hydra.sweep.dir)
            if holds_run(folder):
                refuse(folder, "a single run; choose another folder for a sweep")
            hold_folder(folder)

    def _check_run(self, config: DictConfig) -> None:
        check_out(config)
        folder = Path(config.hydra.run.dir)
        if config.hydra.job.name == "evaluate":
            if holds_evaluation(folder):
                refuse(folder, "an evaluation already; choose another folder: out=DIR")
            if (folder / "tracks.csv").is_file():
                refuse(folder, "tracks; choose another folder: out=DIR")
        elif holds_run(folder) and not config.get("resume") and not is_follower():
            again = setting("resume", folder)
            refuse(folder, f"a run already; choose another folder, or resume it: {again}")
        elif config.hydra.job.name == "train" and not config.get("resume") and not is_follower():
            others = sorted(folder.glob("*/.hydra/config.yaml"))
            if others:
                name = others[0].parents[1].name
                refuse(folder, f"other runs, such as {name}; choose a folder of its own")
        hold_folder(folder)


@contextmanager
def passing_hydra() -> Iterator[None]:
    """Have mistakes pass Hydra, which would go on after any exception of a callback."""
    try:
        yield
    except (UserError, OmegaConfBaseException, OSError) as error:
        raise Carrier(error) from error


def check_place(hydra: Any) -> None:
    """Refuse to work in the run's own folder, where paths that were typed would be looked for.

    Raises:
        UserError: Hydra's settings ask for it; the working folder is again that of the command.
    """
    if hydra.job.chdir:
        os.chdir(hydra.runtime.cwd)
        raise UserError(
            f"hydra.job.chdir={hydra.job.chdir}: paths are relative to the folder in which the "
            "command is typed; leave it out, and choose the run's folder by out="
        )


def refuse(folder: Path, what: str) -> None:
    """Refuse a folder for what it holds."""
    raise UserError(f"out={folder}: holds {what}")


def hold_folder(folder: Path) -> None:
    """Hold a command's folder for this process, and remove what one that was killed has left there.

    Raises:
        UserError: Another process holds it, or it cannot be written to.
    """
    if is_follower():
        return  # the first process of the training holds it
    if hold(folder):
        remove_parts(folder, _WRITTEN)


def holds_run(folder: Path) -> bool:
    """Tell whether a training has been there."""
    return (folder / "metrics.json").is_file() or (folder / "checkpoints").is_dir()


def holds_evaluation(folder: Path) -> bool:
    """Tell whether an evaluation has been there, other than a training's own test."""
    file = folder / "metrics.json"
    return file.is_file() and read_metrics(file).get("command") == "evaluate"


def read_results(job: Job) -> dict[str, Any]:
    """Return what a sweep's job that was done before has found; empty where there is none.

    Raises:
        UserError: Its folder holds the results of a job with other overrides, as far as they decide
            a result.
    """
    metrics = own_metrics(job.folder) if job.swept else {}
    others = {*deciding(metrics.get("overrides", []))} ^ {*deciding(job.overrides)}
    if metrics and others:
        told = ", ".join(sorted(others))
        raise UserError(
            f"{job.folder}: holds results of other settings ({told}); choose another out="
        )
    return metrics


def deciding(overrides: list[str]) -> list[str]:
    """Return what was typed, in one order, less what says where and with how many hands."""
    return sorted(typed for typed in overrides if key_of(typed) not in SILENT)


# what an evaluation writes, the file by which it is known last; and where what a run's own test has
# found is then
_PICTURES = ("figures/test_worst.jpg", "figures/test_best.jpg")
_EVALUATION = ("errors.csv", "poses.csv", "beliefs.npz", *_PICTURES, "metrics.json")
_OWN_RESULTS = {
    "metrics_train.json": "metrics.json",
    "errors_train.csv": "errors.csv",
    "figures/train_test_worst.jpg": _PICTURES[0],
    "figures/train_test_best.jpg": _PICTURES[1],
}


def move_evaluation(folder: Path) -> Path | None:
    """Move an evaluation out of the way of a run that goes on in its folder, into a folder in it;
    what the run's own test had found takes its place again.

    Returns:
        Where the evaluation is now; None where there is none.
    """
    if not holds_evaluation(folder):
        return None
    places = (folder / f"evaluation_{number}" for number in count(1))
    place = next(one for one in places if not one.exists())
    place.mkdir()
    for name in _EVALUATION:
        if (folder / name).is_file():
            (place / name).parent.mkdir(exist_ok=True)
            (folder / name).replace(place / name)
    for own, name in _OWN_RESULTS.items():
        if (folder / own).is_file():
            (folder / own).replace(folder / name)
    return place


def keep_training_results(folder: Path) -> None:
    """Set what a run's own test has written aside, before an evaluation in its folder writes
    others: `metrics_train.json`, `errors_train.csv`, and its pictures.
    """
    if not (folder / "metrics.json").is_file() or holds_evaluation(folder):
        return
    for own, name in _OWN_RESULTS.items():
        if (folder / name).is_file():
            shutil.copy2(folder / name, folder / own)


def own_metrics(folder: Path) -> dict[str, Any]:
    """Return what a run's own test found, also where an evaluation has since written its own; empty
    before the test.
    """
    for name in ("metrics_train.json", "metrics.json"):
        if (folder / name).is_file():
            metrics = read_metrics(folder / name)
            early = metrics.get("command") == "evaluate" and (folder / "checkpoints").is_dir()
            return {} if early else metrics  # of a checkpoint of a training that has not ended
    return {}


def read_metrics(file: Path) -> dict[str, Any]:
    """Return what a metrics.json holds.  Raises UserError where it is damaged."""
    metrics = read_json(file)
    if not isinstance(metrics, dict):
        raise UserError(f"{file}: holds no metrics; choose another out=")
    return metrics


def remove_if_empty(folder: Path, command: str) -> None:
    """Remove the folder of a command that has failed at once: nothing is in it but what Hydra
    wrote, the settings and the command's log. With it go the folders from `outputs` on that are
    empty then.
    """
    hydra, log = folder / ".hydra", folder / f"{command}.log"
    if not folder.is_dir() or folder.samefile(".") or {*folder.iterdir()} - {hydra, log}:
        return
    if hydra.is_dir() and {file.name for file in hydra.iterdir()} - {*_BY_HYDRA}:
        return
    for file in (log, *(hydra / name for name in _BY_HYDRA)):
        file.unlink(missing_ok=True)
    for empty in (hydra, folder):
        if empty.is_dir():
            empty.rmdir()
    if OUTPUTS in folder.parts:  # these folders are ours; others may be empty on purpose
        for parent in [one for one in folder.parents if OUTPUTS in one.parts]:
            if any(parent.iterdir()):
                return
            parent.rmdir()


def note_failure(job: Job, cause: str) -> bool:
    """Write down why a sweep's job has no result, until it has one.

    Returns:
        Whether it has none: results that were there before stay as they are, without a note.
    """
    with suppress(UserError):  # damaged ones are none
        if own_metrics(job.folder):
            return False
    content = {"overrides": job.overrides, "error": cause}
    write_whole(job.folder / FAILED, json.dumps(content, indent=2) + "\n")
    return True


def forget_failure(job: Job) -> None:
    """Remove the note of an earlier failure. In the working folder there is none of ours."""
    if job.folder.is_dir() and not job.folder.samefile("."):
        (job.folder / FAILED).unlink(missing_ok=True)
