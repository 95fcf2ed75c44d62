"""From a command line to a job, and from a mistake to one readable line."""

import importlib
import io
import os
import sys
import traceback
from collections.abc import Callable, Mapping
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import Any

import hydra
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, ListConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from posefilter.cli.ablation_configs import register_ablations
from posefilter.cli.arguments import (
    MULTIRUN,
    bracketed,
    check_choices,
    defer_settings,
    maximized,
    name_places,
    options_first,
    quoted,
    spelled,
    told_apart,
    with_home,
    without_deletion,
    without_trace,
)
from posefilter.cli.components import loosen
from posefilter.cli.console import JSON, logging_for, say, settle_logging
from posefilter.cli.explain import explain, explain_hydra, first_line, is_launchers
from posefilter.cli.fit import check_fit
from posefilter.cli.folders import (
    forget_failure,
    hold_folder,
    note_failure,
    read_results,
    remove_if_empty,
)
from posefilter.cli.job import Job, check_settings, first, plain_name, run_of
from posefilter.cli.main import COMMANDS
from posefilter.cli.preflight import check_files
from posefilter.cli.ranks import STARTED
from posefilter.cli.replaced import replace_typed
from posefilter.cli.resume import keep_record, with_resumed
from posefilter.cli.trust import Scope, installed, trust
from posefilter.cli.usage import describe_command
from posefilter.errors import (
    FAILURE,
    INTERRUPTED,
    MISTAKE,
    Carrier,
    NotThere,
    ProblemsFound,
    Stopped,
    UserError,
)
from posefilter.files import write_whole
from posefilter.locks import release, release_all
from posefilter.paths import find_conf
from posefilter.signals import stopped_by_sigterm

Work = Callable[[Job], Any]
EXPECTED = (
    UserError,
    HydraException,
    OmegaConfBaseException,
    FloatingPointError,
    OSError,  # a full disk, a folder that may not be written
    MemoryError,
)
_FAILED = (FloatingPointError, ProblemsFound, NotThere)  # nothing is wrong with the command line
# others write to a folder of another
_OWN_FOLDER = ("train", "evaluate", "predict", "check_data", "track")


def run_command(name: str, home: Path | None = None, arguments: list[str] | None = None) -> int:
    """Compose `conf/<name>.yaml` with the command line, do the work (or a sweep of it), and return
    the exit status.

    The work is the function `name` of the module `posefilter.cli.<name>`, imported only when the
    settings have stood up. A mistake ends in one line on stderr and status 2; `debug=traceback`
    shows where it came from.
    """
    arguments = sys.argv[1:] if arguments is None else arguments
    arguments = spelled(arguments) if name == "report" else arguments
    arguments = name_places(arguments) if name == "convert_bag" else arguments
    arguments = with_home(arguments)
    trace = "debug=traceback" in arguments
    conf = find_conf() if home is None else home / "conf"
    os.environ["HYDRA_FULL_ERROR"] = "1"  # so that errors arrive here, not in Hydra's own printer
    register_resolvers()
    show_all_signs()
    before, begun, kept = sys.argv, list[Job](), list[Job]()
    started = os.environ.get(STARTED)
    os.environ[STARTED] = name
    record: dict[Path, bytes] = {}
    try:
        if {"--help", "-h"} & {*arguments}:
            print(describe_command(name, conf, arguments))
            return 0
        arguments = without_trace(arguments, name)
        arguments = without_deletion(arguments)
        check_choices(arguments, conf, name)
        if {"--cfg", "-c"} & {*arguments} and {*MULTIRUN} & {*arguments}:
            raise UserError("--cfg shows the settings of one job; leave -m out")
        arguments = bracketed(arguments)
        record = keep_record(arguments)
        arguments = with_resumed(arguments)
        check_choices(arguments, conf, name)  # a resumed run's too
        arguments = quoted(loosen(arguments, name)) + logging_for(arguments)
        arguments = told_apart(maximized(options_first(arguments)), name, conf)
        sys.argv = [sys.argv[0], *defer_settings(arguments, conf)]
        with stopped_by_sigterm():
            hydra.main(config_path=str(conf.resolve()), config_name=name, version_base="1.3")(
                _task(name, begun, kept)
            )()
        if kept:
            raise ProblemsFound(
                f"{len(kept)} jobs failed; what their folders held before stays, such as "
                f"{kept[0].folder}"
            )
    except KeyboardInterrupt:
        print(f"{name}: interrupted", file=sys.stderr)
        return INTERRUPTED
    except Stopped as stopped:
        print(f"{name}: {stopped}", file=sys.stderr)
        return 128 + stopped.number
    except (Carrier, *EXPECTED) as caught:
        error = caught.args[0] if isinstance(caught, Carrier) else caught
        write_record(record)
        if trace:
            traceback.print_exception(error)
        print(f"{name}: {explain(error, name, conf, arguments)}", file=sys.stderr)
        return FAILURE if isinstance(error, _FAILED) else MISTAKE
    except Exception as error:
        write_record(record)
        if trace or (begun and not is_launchers(error)):
            raise
        print(f"{name}: {explain_hydra(error, conf, arguments)}", file=sys.stderr)
        return MISTAKE
    finally:
        sys.argv = before
        os.environ.pop(STARTED)
        os.environ.update({} if started is None else {STARTED: started})
        release_all()
    return 0


def write_record(record: Mapping[Path, bytes]) -> None:
    """Give a run that could not go on its settings back."""
    for file, content in record.items():
        with suppress(OSError):  # the error that it could not go on for is told
            if file.read_bytes() != content:
                write_whole(file, content)


def show_all_signs() -> None:
    """Have a console whose encoding lacks a sign, such as an umlaut of a folder, show its number:
    no run may end for it.
    """
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def _task(name: str, begun: list[Job], kept: list[Job]) -> Callable[[DictConfig], Any]:
    """Return the function that Hydra calls for each job, which it adds to those that have begun; to
    those that are kept, where a sweep's job fails whose folder holds earlier results.
    """

    def task(cfg: DictConfig) -> Any:
        try:
            job = job_of(cfg)
            begun.append(job)
            console = job.cfg.get("console", JSON)
            settle_logging(console)
        except EXPECTED as error:  # a setting refers to nothing
            raise Carrier(error) from error
        try:
            check_settings(cfg, name)
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
            return work(job)
        except Exception as error:
            if job.swept and "summary" in HydraConfig.get().callbacks:  # the other jobs go on
                if not isinstance(error, EXPECTED):
                    traceback.print_exception(error)
                print(f"{job.name} {' '.join(job.overrides)}: {first_line(error)}", file=sys.stderr)
                if not note_failure(job, first_line(error)):
                    kept.append(job)
                return None  # of NaN Optuna's sweeper would make an error
            if not isinstance(error, EXPECTED):
                raise
            release(job.folder)
            with suppress(OSError):  # nothing of ours is in a folder that may not be written
                remove_if_empty(job.folder, job.name)
            raise Carrier(error) from error
        finally:
            if job.swept:
                release(job.folder)
                finish_wandb()

    return task


def finish_wandb() -> None:
    """End the run that Weights & Biases logs, where it is in use: the next job has its own."""
    wandb = sys.modules.get("wandb")
    if getattr(wandb, "run", None) is not None:
        wandb.finish()  # type: ignore[union-attr]


def use_plugins(cfg: DictConfig) -> None:
    """Trust the packages that the user names in `plugins`; import them, and installed plug-ins.

    Raises UserError where one is not there.
    """
    named = cfg.get("plugins") or ListConfig([])
    if not isinstance(named, ListConfig):
        raise UserError(
            f"plugins={named}: must be a list of packages, such as plugins=[my_package]"
        )
    for package in named:
        trust(package)
    for package in (*named, *installed()):  # they may register readers
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
    choices = {str(k): str(v) for k, v in own.runtime.choices.items()}
    swept = own.mode is RunMode.MULTIRUN
    # as typed: what an interpolation stands for may be a secret, or not known yet
    typed: Any = OmegaConf.to_container(own.overrides.task, resolve=False)
    replace_typed(cfg, typed)
    return Job(
        cfg,
        choices,
        typed,
        Path(own.runtime.output_dir),
        own.job.config_name or "",
        swept,
    )


def register_resolvers() -> None:
    """Teach configurations `${first:a,b}` (not null), `${plain:text}` (fit for a folder),
    `${run_of:checkpoint}`, and the table of ablations.
    """
    OmegaConf.register_new_resolver("first", first, replace=True)
    OmegaConf.register_new_resolver("run_of", run_of, replace=True)
    OmegaConf.register_new_resolver("plain", plain_name, replace=True)
    register_ablations()


def compose_job(name: str, conf: Path, overrides: list[str], folder: Path) -> Job:
    """Compose a job as the command line would, for tests, tools, and commands that run others."""
    register_resolvers()
    running = GlobalHydra.instance().is_initialized()
    with (
        nullcontext() if running else initialize_config_dir(str(conf.resolve()), version_base="1.3")
    ):
        cfg = compose(name, [*overrides], return_hydra_config=True)
    choices = {str(k): str(v) for k, v in cfg.hydra.runtime.choices.items()}
    OmegaConf.set_struct(cfg, False)
    cfg.pop("hydra")
    OmegaConf.set_struct(cfg, True)
    replace_typed(cfg, overrides)
    return Job(cfg, choices, list(overrides), folder, name, False)


def compose_config(name: str, overrides: list[str]) -> DictConfig:
    """Compose a command's settings as the command line would, for the library.

    Raises UserError where they name what there is not.
    """
    conf = find_conf()
    if not (conf / f"{name}.yaml").is_file():
        raise UserError(f"command={name}: there is none; choose {', '.join(COMMANDS)}")
    try:
        check_choices(overrides, conf, name)
        return compose_job(name, conf, loosen(bracketed(overrides), name), Path()).cfg
    except (HydraException, OmegaConfBaseException) as error:
        raise UserError(explain(error, name, conf, overrides)) from error
