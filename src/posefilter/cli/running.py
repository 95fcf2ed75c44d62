"""One job that Hydra has prepared: it is checked, its work is done, and what goes wrong is told."""

import importlib
import sys
import traceback
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, ListConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from posefilter.cli.choices import check_names
from posefilter.cli.console import JSON, say, settle_logging
from posefilter.cli.explain import first_line
from posefilter.cli.fit import check_fit
from posefilter.cli.folders import (
    check_place,
    forget_failure,
    hold_folder,
    note_failure,
    read_results,
    remove_if_empty,
)
from posefilter.cli.job import Job, check_settings, make_job
from posefilter.cli.preflight import check_files
from posefilter.cli.trust import Scope, find_folders, installed, named, trust, trusted
from posefilter.errors import Carrier, UserError
from posefilter.locks import release
from posefilter.paths import find_conf

Work = Callable[[Job], Any]
EXPECTED = (
    UserError,
    HydraException,
    OmegaConfBaseException,
    FloatingPointError,
    OSError,  # a full disk, a folder that may not be written
    MemoryError,
)
# others write to a folder of another
_OWN_FOLDER = ("train", "evaluate", "predict", "check_data", "track")


def run_job(cfg: DictConfig, name: str, begun: list[Job], kept: list[Job]) -> Any:
    """Do a job that Hydra has prepared, and return what its work returns.

    It is added to those that have begun; to those that are kept, where a sweep's job fails whose
    folder holds earlier results.
    """
    try:
        job = job_of(cfg)
        begun.append(job)
        console = job.cfg.get("console", JSON)
        settle_logging(console)
    except EXPECTED as error:  # a setting refers to nothing
        raise Carrier(error) from error
    try:
        check_place(HydraConfig.get())
        check_settings(cfg, name, job.choices)
        if name in _OWN_FOLDER:
            hold_folder(job.folder)
        forget_failure(job)
        use_plugins(cfg)
        if not (name == "train" and read_results(job)):
            check_files(name, cfg)
        if name == "train":
            check_fit(cfg, job.choices, Scope.CONFIG)
        if not job.swept:  # before torch is imported, which takes seconds
            say(console, "started", f"{name}: starting", command=name, folder=str(job.folder))
        work: Work = getattr(importlib.import_module(f"posefilter.cli.{name}"), name)
        result = work(job)
        forget_failure(job)  # of the same job, started while this one held the folder
        return result
    except Exception as error:
        if type(error).__name__ == "OutOfMemoryError":  # torch's, of a GPU
            error = MemoryError(str(error))
        if job.swept and "summary" in HydraConfig.get().callbacks:  # the other jobs go on
            if not isinstance(error, EXPECTED):
                note_plugin(error)
                traceback.print_exception(error)
            print(f"{job.name} {' '.join(job.overrides)}: {first_line(error)}", file=sys.stderr)
            if not note_failure(job, first_line(error)):
                kept.append(job)
            return None  # of NaN Optuna's sweeper would make an error
        if not isinstance(error, EXPECTED):
            note_plugin(error)
            raise
        release(job.folder)
        with suppress(OSError):  # nothing of ours is in a folder that may not be written
            remove_if_empty(job.folder, job.name)
        raise Carrier(error) from error
    finally:
        if job.swept:
            release(job.folder)
            finish_wandb()


def note_plugin(error: Exception) -> None:
    """Add to an error the plug-in whose code raised it, if any, for the end of its traceback."""
    for frame, line in reversed([*traceback.walk_tb(error.__traceback__)]):
        package = str(frame.f_globals.get("__name__")).partition(".")[0]
        if package in trusted():
            code = frame.f_code
            place = f"{code.co_filename}, line {line}, in {code.co_name}"
            error.add_note(f"plugins={package}: the error is of this plug-in's code, {place}")
            return


def finish_wandb() -> None:
    """End the run that Weights & Biases logs, where it is in use: the next job has its own."""
    wandb = sys.modules.get("wandb")
    if getattr(wandb, "run", None) is not None:
        wandb.finish()  # type: ignore[union-attr]


def use_plugins(cfg: DictConfig) -> None:
    """Trust the packages that the user names in `plugins`; import them, and installed plug-ins.

    An installed plug-in that cannot be used is warned of: the command may not need it.

    Raises UserError where one that is named is not there.
    """
    packages = cfg.get("plugins") or ListConfig([])
    if not isinstance(packages, ListConfig):
        raise UserError(
            f"plugins={packages}: must be a list of packages, such as plugins=[my_package]"
        )
    for package in packages:
        trust(package)
    import_trusted()


def import_trusted() -> None:
    """Import the plug-ins that the user has named himself, and installed ones."""
    for package in sorted(named()):
        import_plugin(package)
    import_installed()


def import_installed() -> None:
    """Import installed plug-ins, which may register readers; warn of one that cannot be used."""
    for package, name in installed().items():
        try:
            import_plugin(package)
            if package not in named():
                check_names([find_conf(), *find_folders(trusted())], find_folders([package]))
        except UserError as error:
            reason = str(error).removeprefix(f"plugins={package}: ")
            told = f"warning: installed plug-in {package} (entry point {name}): {reason}"
            print(told, file=sys.stderr)


def import_plugin(package: str) -> None:
    """Import a plug-in, which may register readers.  Raises UserError where that fails."""
    try:
        importlib.import_module(package)
    except ModuleNotFoundError as error:
        raise UserError(
            f"plugins={package}: there is no package '{error.name}' (is it installed?)"
        ) from error
    except (Exception, SystemExit) as error:  # a plug-in may not end the run as if it were done
        raise UserError(
            f"plugins={package}: could not be imported ({type(error).__name__}: "
            f"{first_line(error)}); debug=traceback shows where"
        ) from error


def job_of(cfg: DictConfig) -> Job:
    """Return the job that Hydra has prepared."""
    own = HydraConfig.get()
    swept = own.mode is RunMode.MULTIRUN
    # as typed: what an interpolation stands for may be a secret, or not known yet
    typed: Any = OmegaConf.to_container(own.overrides.task, resolve=False)
    folder, name = Path(own.runtime.output_dir), own.job.config_name or ""
    return make_job(cfg, own.runtime.choices, typed, folder, name, swept)
