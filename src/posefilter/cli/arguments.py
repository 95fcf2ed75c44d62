"""What is typed, made into what Hydra reads; torch is not needed for it."""

import re
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

from hydra.core.override_parser.overrides_parser import OverridesParser

from posefilter.cli.choices import SEVERAL, read_settings
from posefilter.cli.main import COMMANDS
from posefilter.cli.plain import find, key_of
from posefilter.errors import UserError

MULTIRUN = ("-m", "--multirun")
_RERUN = "--experimental-rerun"
# options of Hydra that a value follows
_VALUED = (
    *("--cfg", "-c", "--package", "-p", "--config-path", "-cp", "--config-name", "-cn"),
    *("--config-dir", "-cd", "--shell-completion-for", _RERUN),
)
_INFO = ("--info", "-i")
_LONG = (  # Hydra's options that are spelled out, which may be cut short
    *(one for one in (*MULTIRUN, *_VALUED, *_INFO) if one.startswith("--")),
    *("--help", "--hydra-help", "--version", "--resolve", "--run", "--shell-completion"),
)
_KINDS = ("all", "config", "defaults", "defaults-tree", "plugins", "searchpath")  # of information
# settings that name files and folders, whatever the command, and what Hydra reads as a number
_PLACES = (
    *("out", "rgb", "depth", "bag", "mesh", "meshes", "name", "checkpoint", "resume", "warm_start"),
    *("estimates", "targets", "absent", "run", "distractor_meshes", "data.root", "data.meshes"),
    *("data.cache_dir", "data.model_points_dir", "generate.meshes", "data.generate.meshes"),
)
_LISTED = re.compile(  # a glimpse's size is one number
    r"^((?:\w+\.)*(?:intrinsics|distortion|camera)|(?:(?:\w+\.)*generate\.)?size)"
    r"=([^\[\],]+(?:,[^\[\],]+)+)$"
)
_NUMBER = re.compile(r"[+-]?[0-9_.]*[0-9][0-9_.]*([eE][+-]?[0-9_]+)?")
_FOLDERS = ("run", "runs", "sweep", "out")  # of a report
TYPED = {"sweep_folder": "sweep"}  # settings whose name is another than what is typed


def options_first(arguments: Sequence[str]) -> list[str]:
    """Return a command line with its options before all settings: Hydra's parser does not find
    settings on both sides of an option.

    Raises:
        UserError: An option is none of Hydra's, as where a setting is typed as one, or not of use.
    """
    options, settings, left = list[str](), list[str](), list(arguments)
    while left:
        word = left.pop(0)
        if not word.startswith("-"):
            settings.append(word)
            continue
        name, _, value = word.partition("=")
        if name.startswith("--") and not any(one.startswith(name) for one in _LONG):
            own = name.lstrip("-")
            raise UserError(f"{name}: is no option; settings are typed {own}={value or '...'}")
        if len(name) > len("--") and _RERUN.startswith(name):
            raise UserError(
                f"{_RERUN}: reads a file that no run has here; type resume=RUN to go on with a run"
            )
        options.append(word)
        if word in _INFO:  # whose value may be left out
            options.append(left.pop(0) if left and left[0] in _KINDS else _KINDS[0])
        elif word in _VALUED and left:
            options.append(left.pop(0))
    return [*options, *settings]


def check_config_name(arguments: Sequence[str], command: str) -> None:
    """Raise UserError where the settings of another command are named."""
    words = [part for argument in arguments for part in argument.split("=", 1)]
    for option, name in pairwise(words):
        other = name.removesuffix(".yaml")
        if option in ("--config-name", "-cn") and other in COMMANDS and other != command:
            raise UserError(
                f"--config-name={name}: is not {command}'s, but has the settings of {other}, which "
                "is a command of its own"
            )


def without_deletion(arguments: Sequence[str]) -> list[str]:
    """Return a command line with `logger=none` for `~logger`, as Hydra deletes no list."""
    deleted = {f"~{group}": f"{group}=none" for group in SEVERAL}
    return [deleted.get(argument, argument) for argument in arguments]


def with_home(arguments: Sequence[str]) -> list[str]:
    """Return settings with the home folder for `~` before the first `/` of a path: a shell leaves
    it where a setting is in quotes, and some shells where it is not.
    """
    tilde = re.compile(r"(?<=[=,\[])(['\"]?)~(?=/)")
    return [a if a.startswith("-") else tilde.sub(_at_home, a) for a in arguments]


def _at_home(found: re.Match[str]) -> str:
    try:
        return found[1] + str(Path.home())
    except RuntimeError as error:
        raise UserError("~: no home folder is known; type the path in full") from error


def bracketed(arguments: list[str]) -> list[str]:
    """Put brackets round plain lists: intrinsics=1,2,3,4 is four numbers, not a sweep."""
    return [_LISTED.sub(r"\1=[\2]", argument) for argument in arguments]


def without_trace(arguments: list[str], name: str) -> list[str]:
    """Leave out `debug=traceback`, which `run_command` obeys itself: `debug` is a group of choices
    of `train` alone.

    Raises UserError for a choice of it with another command.
    """
    if name == "train":
        return arguments
    left = [a for a in arguments if a != "debug=traceback"]
    for argument in left:
        if argument.startswith("debug=") and argument != "debug=null":
            raise UserError(
                f"{argument}: only valid for train; {name} accepts only debug=traceback"
            )
    return left


def quoted(arguments: Sequence[str], command: str = "") -> list[str]:
    """Return settings with quotes round values that Hydra's grammar has no place for, such as a
    folder with an umlaut in its name, and round names of files and folders that it would read as
    numbers: 1.10 would be 1.1, and 2024_05_02 be 20240502.

    Each part of a list of values is quoted by itself. A list that is a path that there is, as of a
    sweep's job, is one value.
    """
    out = []
    for argument in arguments:
        key, _, value = argument.partition("=")
        odd = re.search(r"[^\x20-\x7e]|[=#&;!^`~]", value) is not None
        is_place = key.lstrip("+~") in _PLACES or (command, key) == ("track", "frames")
        odd |= is_place and _NUMBER.fullmatch(value) is not None
        signs = re.search(r"[][(){}'\", ]", value) is not None and "${" not in value
        if is_place and signs and _exists(value):  # such as "IMG (1).png"
            argument = f"{key}={quote(value)}"
        elif odd and re.fullmatch(r"[+~]{0,2}[\w./@]+", key) and not _written(value):
            values = [value] if _exists(value) else value.split(",")
            argument = f"{key}=" + ",".join(map(quote, values))
        out.append(argument)
    return out


def quote(value: object) -> str:
    """Return a value as Hydra reads it back unchanged, whatever characters it has."""
    return "'" + str(value).replace("'", "\\'") + "'"


def _exists(path: str) -> bool:
    try:
        return Path(path).exists()
    except OSError:  # too long a name
        return False


def is_multirun(arguments: Sequence[str]) -> bool:
    """Tell whether a command line is of a sweep: it says so, or names a list of runs."""
    return any(a in MULTIRUN or a.startswith("sweep=") for a in arguments)


def maximized(arguments: Sequence[str]) -> list[str]:
    """Return a command line whose search maximizes what a training returns, as far as it does not
    say otherwise: Optuna would minimize.
    """
    searched = "hydra/sweeper=optuna" in arguments
    told = any(a.lstrip("+").startswith("hydra.sweeper.direction=") for a in arguments)
    return [*arguments, *(["hydra.sweeper.direction=maximize"] if searched and not told else [])]


def told_apart(arguments: Sequence[str], name: str, conf: Path) -> list[str]:
    """Return a command line whose sweep gives each job a folder of its own, also where it is over a
    setting that folders are not named after, such as `data.root`.

    Args:
        arguments: The command line.
        name: The command.
        conf: The folder of settings.
    """
    if not is_multirun(arguments):
        return list(arguments)
    unnamed = (
        find(read_settings(conf, name), "hydra.job.config.override_dirname.exclude_keys") or []
    )
    typed = [a for a in arguments if key_of(a) in unnamed]
    swept = {
        own.key_or_group
        for own in OverridesParser.create().parse_overrides(typed)
        if own.is_sweep_override()
    }
    left = [key for key in unnamed if key not in swept]
    named = f"hydra.job.config.override_dirname.exclude_keys=[{','.join(left)}]"
    return [*arguments, *([named] if swept else [])]


def _written(value: str) -> bool:
    """Tell whether a value is in Hydra's grammar: quoted, a list, a reference, or with escapes."""
    if value.startswith(("'", '"', "[", "{")) or "${" in value or value.rstrip().endswith(")"):
        return True
    return re.search(r"\\[=,]", value) is not None


def defer_settings(arguments: Sequence[str], conf: Path) -> list[str]:
    """Return a command line whose settings Hydra looks for in each job of a sweep over choices.

    Hydra composes a sweep's defaults first, without the choices that are swept, and refuses a
    setting that only these have: `model=patch_pf,cnn_patch model.net.width=16`. A setting that is
    swept over its one value is left to the jobs.

    Args:
        arguments: The command line.
        conf: The folder of settings.
    """
    if not is_multirun(arguments):
        return list(arguments)
    typed = [a for a in arguments if "=" in a and not a.startswith("-")]
    parsed = dict(zip(typed, OverridesParser.create().parse_overrides(typed), strict=True))
    if not any(o.is_sweep_override() and (conf / o.key_or_group).is_dir() for o in parsed.values()):
        return list(arguments)
    deferred = {
        argument: f"{own.key_or_group}=choice({own.get_value_element_as_str()})"
        for argument, own in parsed.items()
        if re.match(r"(?!hydra\b)\w+\.", argument) and not own.is_sweep_override()
    }
    return [deferred.get(argument, argument) for argument in arguments]


def name_places(arguments: Sequence[str]) -> list[str]:
    """Return the command line with its first two bare words as `bag=` and `out=`; values of Hydra's
    options are none.
    """
    names = iter(("bag", "out"))
    out = []
    for before, argument in pairwise(["", *arguments]):
        sign = argument.startswith(("-", "~", "+")) and not argument.startswith("~/")
        is_value = before in _VALUED or (before in _INFO and argument in _KINDS)
        bare = "=" not in argument and not sign and not is_value
        key = next(names, None) if bare else None
        out.append(argument if key is None else f"{key}={argument}")
    return out


def spelled(arguments: Sequence[str]) -> list[str]:
    """Return the command line as Hydra reads it: `sweep` is a group of its own, and folders may
    have `=` and `,` in them.
    """
    out = []
    for argument in arguments:
        key, found, value = argument.partition("=")
        if found and key in _FOLDERS and value and value[0] not in "'\"" and value != "null":
            value = quote(value)
        out.append(f"{'sweep_folder' if key == 'sweep' else key}{found}{value}")
    return out
