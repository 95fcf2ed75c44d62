"""From a command line to a job, and from a mistake to one readable line."""

import io
import os
import sys
import traceback
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

import hydra
from hydra import compose
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from posefilter.cli.ablations import register_ablations
from posefilter.cli.arguments import (
    MULTIRUN,
    bracketed,
    check_config_name,
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
from posefilter.cli.choices import check_added, check_choices, typed_plugins
from posefilter.cli.components import loosen
from posefilter.cli.console import logging_for
from posefilter.cli.explain import explain, explain_hydra, is_launchers
from posefilter.cli.fit import check_fit
from posefilter.cli.job import Job, first, make_job, plain_name, run_of
from posefilter.cli.main import COMMANDS, describe_version
from posefilter.cli.options import add_plugin_folders, open_settings
from posefilter.cli.plain import to_plain
from posefilter.cli.ranks import STARTED, is_follower
from posefilter.cli.resume import keep_record, with_resumed
from posefilter.cli.running import EXPECTED, import_plugin, run_job
from posefilter.cli.trust import Scope, find_folders, trust, trusted
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
    printable,
)
from posefilter.files import write_whole
from posefilter.locks import release_all
from posefilter.paths import find_conf
from posefilter.ranges import check_ranges
from posefilter.signals import stopped_by_sigterm

_IN_PROCESSES = ("train", "onboard")  # commands that can be several processes of one training
_RESUMED = ("generate", "onboard")  # when they are typed again
_FAILED = (FloatingPointError, ProblemsFound, NotThere)  # nothing is wrong with the command line


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
    trace = "debug=traceback" in arguments
    conf = find_conf() if home is None else home / "conf"
    os.environ["HYDRA_FULL_ERROR"] = "1"  # so that errors arrive here, not in Hydra's own printer
    register_resolvers()
    add_plugin_folders()
    show_all_signs()
    before, begun, kept = sys.argv, list[Job](), list[Job]()
    started = os.environ.get(STARTED)
    os.environ[STARTED] = name
    record: dict[Path, bytes] = {}
    try:
        arguments = with_home(arguments)
        for package in typed_plugins(arguments):  # whose choices Hydra is to find
            trust(package)
            if not find_folders([package]):
                import_plugin(package)  # which says so where there is no such package
        if {"--help", "-h"} & {*arguments}:
            print(describe_command(name, conf, arguments))
            return 0
        if "--version" in arguments:  # Hydra's own
            print(describe_version())
            return 0
        if is_follower() and name not in _IN_PROCESSES:
            raise UserError(
                "this is one of several processes that srun or torchrun has started, and the first "
                "does all of the work; start one (srun --ntasks=1)"
            )
        arguments = without_trace(arguments, name)
        arguments = without_deletion(arguments)
        check_config_name(arguments, name)
        check_choices(arguments, conf, name)
        if {"--cfg", "-c"} & {*arguments} and {*MULTIRUN} & {*arguments}:
            raise UserError("--cfg shows the settings of one job; leave -m out")
        arguments = bracketed(arguments)
        record = keep_record(arguments)
        typed, arguments = arguments, with_resumed(arguments)
        check_choices(arguments, conf, name)  # a resumed run's too
        check_added(typed, conf, name, arguments)
        arguments = quoted(loosen(arguments, name), name) + logging_for(arguments)
        arguments = told_apart(maximized(options_first(arguments)), name, conf)
        sys.argv = [sys.argv[0], *defer_settings(arguments, conf)]
        with stopped_by_sigterm():
            hydra.main(config_path=str(conf.resolve()), config_name=name, version_base="1.3")(
                lambda cfg: run_job(cfg, name, begun, kept)
            )()
        if kept:
            raise ProblemsFound(
                f"{len(kept)} jobs failed; what their folders held before stays, such as "
                f"{kept[0].folder}"
            )
    except KeyboardInterrupt:
        print(f"{name}: interrupted{_tell_resumed(name)}", file=sys.stderr)
        return INTERRUPTED
    except Stopped as stopped:
        print(f"{name}: {stopped}{_tell_resumed(name)}", file=sys.stderr)
        return 128 + stopped.number
    except (Carrier, *EXPECTED) as caught:
        error = caught.args[0] if isinstance(caught, Carrier) else caught
        if not isinstance(error, ProblemsFound):  # else the work is done, with these settings
            write_record(record)
        if trace:
            traceback.print_exception(error)
        print(f"{name}: {printable(explain(error, name, conf, arguments))}", file=sys.stderr)
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


def _tell_resumed(name: str) -> str:
    """Return how a command that was interrupted goes on, of those that resume by themselves."""
    return "; give the same command again to go on from there" if name in _RESUMED else ""


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
    with open_settings(conf):
        cfg = compose(name, [*overrides], return_hydra_config=True)
    choices = cfg.hydra.runtime.choices
    with open_dict(cfg):
        del cfg["hydra"]
    return make_job(cfg, choices, overrides, folder, name)


def compose_config(name: str, overrides: list[str]) -> DictConfig:
    """Compose a command's settings as the command line would, for the library.

    Raises UserError where they name what there is not, or choices of a training that do not fit.
    """
    conf = find_conf()
    if not (conf / f"{name}.yaml").is_file():
        raise UserError(f"command={name}: there is none; choose {', '.join(COMMANDS)}")
    for package in typed_plugins(overrides):
        if package not in trusted():
            raise UserError(
                f"plugins={package}: in Python call posefilter.trust('{package}') instead"
            )
    try:
        check_choices(overrides, conf, name)
        check_added(overrides, conf, name)
        job = compose_job(name, conf, loosen(bracketed(overrides), name), Path())
        check_ranges(to_plain(job.cfg), name)
        if name == "train":
            check_fit(job.cfg, job.choices, Scope.CONFIG)
        return job.cfg
    except (HydraException, OmegaConfBaseException, YAMLError) as error:
        raise UserError(explain(error, name, conf, overrides)) from error
