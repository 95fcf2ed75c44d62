"""What `--help` prints: a command's own settings and choices, on a page.

It is read from the YAML files as they stand, so that it costs no composition of them.
"""

import re
import shutil
import textwrap
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from hydra.core.config_store import ConfigStore

from posefilter.cli.arguments import TYPED
from posefilter.cli.choices import choice_folders, list_choices, read_settings
from posefilter.cli.console import name_program
from posefilter.cli.main import COMMANDS

_SETTING = re.compile(r"^(\w+): *(.*?) *(?:# *(.*))?$")  # a key at the top of a file
_UNLISTED = ("generate", "folder", "debug")  # what others are handed on to, or has a line below
_HIDDEN = ("trainer",)  # groups whose choice the command itself makes
_MOST_CHOICES = 20
_INDENT, _NARROWEST, _WIDEST = 26, 60, 120
_MEANINGS = {
    "variant": "(paper: as published; working: with this project's modifications, which work)"
}
_FILTER = {"filter.particles": "number of particles; filter.steps: number of filter steps"}
_TOLERANCE = {
    "pose_tolerance.add_s": "largest ADD-S of a right pose; or .add, .translation_mm, .rotation_deg"
}
# the settings that are typed most, of sections that the chosen files fill
_SECTIONS = {
    "train": {
        "data.root": "folder of the dataset; with data=scenes, where scenes are rendered",
        "data.object": "name of the object in the dataset",
        **_FILTER,
        "trainer.max_steps": "number of training steps",
        "optimizer.lr": "learning rate",
    },
    "evaluate": {
        "data.root": "folder of the dataset",
        "data.meshes": "builtin, or a folder of meshes",
        **_FILTER,
        **_TOLERANCE,
    },
    "predict": {**_FILTER, **_TOLERANCE},
    "track": {
        "data.root": "folder of the dataset, where data= is given",
        "tracker.motion.translation_mm": "least standard deviation of a frame's motion",
        "tracker.follow.pixels": "image points of a pose; cost is in proportion",
        "tracker.smoothing_noise": "standard deviation of one frame's estimate [m]",
    },
    "check_data": {"data.root": "folder of the dataset"},
}


class Group(NamedTuple):
    """A group of files to choose from."""

    name: str
    choices: list[str]
    default: str | None


def describe_command(name: str, conf: Path, arguments: Sequence[str] = ()) -> str:
    """Return the page of `--help`.

    Args:
        name: The command, such as `train`.
        conf: The folder of the settings.
        arguments: The command line; folders typed by `--config-dir`, and those of plug-ins, add
            their choices.
    """
    text = (conf / f"{name}.yaml").read_text(encoding="utf-8")
    width = max(_NARROWEST, min(_WIDEST, shutil.get_terminal_size((100, 24)).columns))
    program, script = name_program(name), f"python {name}.py"
    examples = [
        line.removeprefix("# ").replace(script, program)
        for line in text.splitlines()
        if line.startswith(f"# {script}")
    ]
    groups = list(list_groups(name, [conf, *choice_folders(arguments)]))
    lines = [f"{name}: {COMMANDS[name]}", ""]
    lines += [part for one in examples for part in _wrap(f"  {one}", width, 6)]
    if groups:
        lines += ["", f"choices, typed group=choice; {_explain_defaults(name)}"]
        for group in groups:
            shown = " ".join(f"[{c}]" if c == group.default else c for c in group.choices)
            lines += _entry(group.name, f"{shown} {_MEANINGS.get(group.name, '')}".rstrip(), width)
    lines += ["", "settings, typed key=value"]
    settings = {
        f"{TYPED.get(key, key)}={value}": comment for key, value, comment in list_settings(text)
    }
    for key, comment in {**settings, **_SECTIONS.get(name, {})}.items():
        lines += _entry(key, _shorten(comment, width - _INDENT), width)
    lines += ["", *_entry("--cfg job", "print every setting, and run nothing", width)]
    if name in ("train", "evaluate"):
        lines += _entry("-m key=a,b,c", "sweep: a run for each value", width)
    if name != "train":  # where it is one of the choices
        lines += _entry("debug=traceback", "show where a mistake came from", width)
    return "\n".join(lines)


def _explain_defaults(name: str) -> str:
    """Return what is chosen where nothing is typed."""
    marked = "the default is in brackets"
    if name == "train":
        return f"{marked}, else the variant's preset chooses"
    return marked if name == "check_data" else "where none is typed, as trained"


def list_groups(name: str, folders: Sequence[Path]) -> Iterator[Group]:
    """Yield the groups of a command: those of its defaults first, in their order; of a training
    those within them, too.

    Args:
        name: The command.
        folders: Of settings; the first is the project's own.
    """
    defaults = _read_defaults(folders[0], name)
    names = list(defaults)
    if name == "train":
        nested = {
            folder.relative_to(top).as_posix()
            for top in folders
            for folder in top.rglob("*")
            if folder.is_dir()
        }
        methods = {choice for top in folders for choice in list_choices(top / "model")}
        names += sorted(nested - {*names, "preset"} - {f"preset/{one}" for one in methods})
    for group in (one for one in names if one not in _HIDDEN):
        found = {choice for top in folders for choice in list_choices(top / group)}
        found |= _list_stored(group)
        if len(found) > _MOST_CHOICES:
            some = [*sorted(found)[:3], f"... ({len(found)} in all)"]
            yield Group(group, some, None)
        elif found:
            yield Group(group, sorted(found), defaults.get(group))


def list_settings(text: str) -> Iterator[tuple[str, str, str]]:
    """Yield (key, value, comment) of the settings at the top of a file, as they are written."""
    for line in text.splitlines():
        found = _SETTING.match(line)
        if found and found[2] and found[1] not in _UNLISTED and not found[2].startswith("{"):
            yield found[1], found[2], found[3] or ""


def _read_defaults(conf: Path, name: str) -> dict[str, str | None]:
    """Return the groups of a file's defaults, with the default choice of each."""
    out: dict[str, str | None] = {}
    for one in read_settings(conf, name).get("defaults", []):
        if isinstance(one, str) and one != "_self_":
            out |= _read_defaults(conf, one)
        elif isinstance(one, dict):
            within = ("override ", "optional ")  # of what another file chooses
            out |= {key: value for key, value in one.items() if not key.startswith(within)}
    return out


def _list_stored(group: str) -> set[str]:
    """Return the choices that are made in Python, those of tables."""
    try:
        return {name.removesuffix(".yaml") for name in ConfigStore.instance().list(group)}
    except OSError:  # so Hydra says that there are none
        return set()


def _shorten(text: str, width: int) -> str:
    """Return as many of a comment's clauses as fit into one line; at least the first."""
    clauses = re.split(r"(?<=;) ", text)
    while len(" ".join(clauses)) > width and len(clauses) > 1:
        clauses.pop()
    return " ".join(clauses).rstrip(";")


def _entry(left: str, right: str, width: int) -> list[str]:
    """Return a name and what is said of it, in two columns."""
    start = f"  {left}".ljust(_INDENT - 1)
    if len(start) >= _INDENT:
        start = f"{start} "
    return _wrap(f"{start} {right}" if right else start, width, _INDENT)


def _wrap(text: str, width: int, indent: int) -> list[str]:
    """Return a text's lines, those after the first indented."""
    return textwrap.wrap(
        text, width, subsequent_indent=" " * indent, break_long_words=False, break_on_hyphens=False
    )
