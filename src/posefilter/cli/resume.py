"""Going on with a run that was cut short: the same settings, from its last checkpoint."""

import re
import shlex
from pathlib import Path
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException

from posefilter.cli.arguments import quoted
from posefilter.cli.plain import find, key_of
from posefilter.cli.recipe import calls_resolver
from posefilter.cli.renamed import update
from posefilter.errors import BadData, UserError, naming
from posefilter.limits import MOST_YAML, read_bytes, read_yaml
from posefilter.paths import check_links, stays_inside

LAST, BEFORE = "last.ckpt", "last.previous.ckpt"  # of a run's checkpoints
_DROPPED = ("resume", "out", "hydra.run.dir", "plugins")
# by whose change a run would be another, or that a checkpoint brings with it: groups and settings
_KEPT_GROUPS = (
    "model", "variant", "preset", "data", "loss", "optimizer", "scheduler", "experiment", "ablation"
)  # fmt: skip
_KEPT = (
    "seed", "warm_start", "data.split", "data.split_seed", "data.object", "data.batch_size", "loss",
    "optimizer", "scheduler",
)  # fmt: skip
_OVERRIDE = re.compile(r"([+~]{0,2})([A-Za-z_][\w./@]*)(?:=(.*))?", re.DOTALL)
# that a run writes to
_PLACES = ("cache_dir", "default_root_dir", "dirpath", "folder", "log_dir", "root_dir", "save_dir")
_SENDING = ("mlflow", "wandb")  # loggers
_LONGEST, _MOST = 1 << 16, 1000  # of a file of overrides [bytes], and of its lines


def run_folder(resume: str | Path) -> Path:
    """Return the folder of a run that is given by itself or by one of its checkpoints."""
    path = Path(resume)
    folder = path.parent.parent if path.suffix == ".ckpt" else path
    if not (folder / ".hydra" / "overrides.yaml").is_file():
        raise UserError(
            f"resume={resume}: not a run's folder (no .hydra/overrides.yaml in {folder})"
        )
    return folder


def last_checkpoints(resume: str | Path) -> list[Path]:
    """Return the checkpoints to go on from: the last one, and the one before to fall back to.

    Raises UserError where there is none.
    """
    path = Path(resume)
    path = path if path.suffix == ".ckpt" else path / "checkpoints" / LAST
    found = [path, path.with_name(BEFORE)] if path.name == LAST else [path]
    there = [one for one in found if one.is_file()]
    if not there:
        raise UserError(
            f"resume={resume}: no {path}; the run was stopped before its first "
            f"checkpoint: start it anew"
        )
    return there


def with_resumed(arguments: list[str]) -> list[str]:
    """Put the resumed run's own overrides ahead of the command line's, so that these may still
    change a thing.

    Raises:
        UserError: There is no such run; its record is damaged, or brings what only the user may
            type; or what is typed cannot be changed any more.
    """
    given = _resumed(arguments)
    if given is None:
        return arguments
    folder = run_folder(given)
    last_checkpoints(given)
    check_links(folder)
    for argument in arguments:
        check_kept(argument, folder)
    named = {*map(key_of, arguments)}
    before = [update(one, "train") for one in overrides_of(folder)]
    kept = [one for one in before if key_of(one) not in named and key_of(one) not in _DROPPED]
    added = {key_of(one) for one in before if one.startswith("+")}
    # `~key` of what the run had added: it is left out, and nothing is there to be deleted
    arguments = [a for a in arguments if not (a.startswith("~") and key_of(a) in added)]
    with naming(f"resume={folder}"):
        for override in kept:
            check_override(override)
    # a choice of `sweep` brings the jobs' settings, and would start them all
    alone = ["hydra.mode=RUN"] if any(key_of(one) == "sweep" for one in kept) else []
    return [*kept, *arguments, f"out={folder}", *alone]


def keep_record(arguments: list[str]) -> dict[Path, bytes]:
    """Return what a resumed run's folder says of its settings, by file: Hydra writes them anew
    before it is known whether the run can go on with them. Nothing where no run is resumed.
    """
    given = _resumed(arguments)
    if given is None:
        return {}
    files = sorted((run_folder(given) / ".hydra").glob("*.yaml"))
    return {file: read_bytes(file, MOST_YAML) for file in files}


def overrides_of(folder: Path) -> list[str]:
    """Return what was typed to start a run.  Raises UserError where its record is damaged."""
    file = folder / ".hydra" / "overrides.yaml"
    try:
        before = read_yaml(file, _LONGEST)
    except BadData:
        before = None
    if not (
        isinstance(before, list)
        and len(before) <= _MOST
        and all(isinstance(one, str) for one in before)
    ):
        raise UserError(f"{file}: should be a list of settings, as train.py writes it")
    return before


def check_override(override: str) -> None:
    """Raise UserError where a setting that a run's folder brings is one that only the user may
    type.

    Such are Hydra's own, interpolations that call something, places outside of the working folder,
    and loggers that send what a run finds to a server.
    """
    found = _OVERRIDE.fullmatch(override)
    if found is None or not override.isprintable() or re.match(r"hydra\b", found[2]):
        raise UserError(
            f"{override[:80]!r} in its .hydra/overrides.yaml is not a setting of a training run"
        )
    key, value = found[2], (found[3] or "").strip("'\"")
    if calls_resolver(value):
        raise UserError(f"its {key} calls a function; if that is right, type {key}=... yourself")
    words = [word for word in re.split(r"[\[\]{},\s'\"]|:(?!//)", value) if word]
    sends = key == "logger" and not {*words}.isdisjoint(_SENDING)
    if sends or key.startswith("logger."):
        raise UserError(
            f"its {key}={value} may send results elsewhere; if it is right, type it as well"
        )
    place = key.rpartition(".")[2] in _PLACES and value not in ("", "null")
    if place or not all(stays_inside(word, Path()) for word in words):
        raise UserError(
            f"its {key}={value} lies outside of the working folder; if it is right, type it as well"
        )


def list_unkept(overrides: list[str]) -> list[str]:
    """Return those overrides of a run that must be typed again to resume it, see `check_override`,
    as they are typed in a shell.
    """
    words = []
    for override in (one for one in overrides if key_of(one) not in _DROPPED):
        try:
            check_override(override)
        except UserError:
            words.append(shlex.quote(override))
    return words


def check_kept(argument: str, folder: Path) -> None:
    """Raise UserError where an argument changes a setting that a run keeps."""
    key, value = key_of(argument), argument.partition("=")[2]
    out = str(_read_value(argument)) if key == "out" and value not in ("", "null") else str(folder)
    if Path(out).resolve() != folder.resolve():
        raise UserError(
            f"{argument}: a run that is resumed stays in its folder; leave out= out, or type "
            f"warm_start={folder}/checkpoints/{LAST} for a new run that begins with its weights"
        )
    kept = key in _KEPT_GROUPS or any(key == one or key.startswith(f"{one}.") for one in _KEPT)
    if kept and _read_value(argument) != _find_recorded(key, folder):
        raise UserError(
            f"{argument}: the run began with another, which a resumed run keeps; leave it out, or "
            f"begin a new run"
        )


def _read_value(argument: str) -> Any:
    """Return the value of a typed setting, as Hydra reads it; the argument itself where it is none,
    or several.
    """
    try:
        own = OverridesParser.create().parse_override(quoted([argument])[0])
        return argument if own.is_sweep_override() else own.value()
    except HydraException:
        return argument


def _find_recorded(key: str, folder: Path) -> Any:
    """Return what a run's record says of a choice or setting."""
    choice = key in _KEPT_GROUPS
    file = folder / ".hydra" / ("hydra.yaml" if choice else "config.yaml")
    try:
        record = read_yaml(file)
    except BadData as error:
        raise UserError(f"{file}: cannot be read, so that {key}= cannot be compared") from error
    return find(record, f"hydra.runtime.choices.{key}" if choice else key)


def _resumed(arguments: list[str]) -> str | None:
    """Return what is to be resumed, as typed last; None where nothing is."""
    given = [a.removeprefix("resume=") for a in arguments if a.startswith("resume=")]
    if not given or given[-1] in ("", "null"):
        return None
    # a name with a = or a comma is typed in Hydra's quotes
    is_quoted = given[-1][0] in "'\""
    return str(_read_value(f"resume={given[-1]}")) if is_quoted else given[-1]
