"""Choices of groups, and the folders that they come from: what of them is typed is checked before
Hydra stumbles over it; torch is not needed for it.
"""

import re
from collections.abc import Mapping, Sequence
from itertools import pairwise, product
from pathlib import Path
from typing import Any

import yaml

from posefilter.cli.ablations import BY_NAME, find_variant, list_models
from posefilter.cli.instantiate import hint
from posefilter.cli.plain import key_of
from posefilter.cli.renamed import rename
from posefilter.cli.trust import find_folders, named, trusted
from posefilter.errors import UserError

SEVERAL = ("logger",)  # groups of which several choices can be made at once


def check_choices(arguments: list[str], conf: Path, command: str | None = None) -> None:
    """Raise UserError where a group is given a value instead of the name of one of its files, where
    a choice is typed as a setting, and for names that have changed: Hydra stumbles over them.
    """
    for argument in arguments:
        key, _, value = argument.partition("=")
        group = key.replace(".", "/") if re.fullmatch(r"\w+", value) else key
        own = re.fullmatch(r"[\w/]+", group) is not None and (conf / group).is_dir()
        if own and value == "null" and key != "preset":
            raise UserError(
                f"{argument}: takes the name of a choice, or is left out for the default; there "
                f"are {', '.join(list_choices(conf / group))}"
            )
        if own and group != key:
            choice = f"{group}={value}"
            raise UserError(f"{argument}: names a choice; type {rename(choice, command) or choice}")
        if own and group in SEVERAL and value.startswith("[") and value != "[]":
            check_several(group, value, [conf, *choice_folders(arguments)])
        elif own and value.startswith(("[", "{")):
            options = list_choices(conf / group)
            there = f"there are {', '.join(options)}" if options else f"see conf/{group}"
            raise UserError(f"{group}={value}: takes the name of a choice, not a value; {there}")
        if key == "preset" and value != "null":
            check_preset(value, [conf, *choice_folders(arguments)])
        is_there = own and (conf / group / f"{value}.yaml").is_file()
        if not is_there and (now := rename(argument, command)):
            raise UserError(f"{argument}: is now {now}")
    typed = dict(a.split("=", 1) for a in arguments if "=" in a)
    check_variants(typed, conf)
    if command == "train" and "ablation" in typed:
        check_ablations(typed, conf)
    asked = [*find_folders(named()), *config_folders(arguments)]
    check_names([conf, *choice_folders(arguments)], asked)


def check_added(
    typed: Sequence[str], conf: Path, command: str, arguments: Sequence[str] = ()
) -> None:
    """Raise UserError where a setting is added that nothing would read: its first name is known
    neither to the command nor to an interpolation, nor is it a group.

    Args:
        typed: What is typed.
        conf: The folder of settings.
        command: The command's name.
        arguments: All that the command is given, the settings of a resumed run too.
    """
    added = [key_of(one) for one in typed if re.match(r"\+{1,2}[\w.]+=", one)]
    if not added:
        return
    folders = [conf, *choice_folders(typed)]
    settings = read_settings(conf, command)
    chosen = {name for one in settings["defaults"] if isinstance(one, dict) for name in one}
    groups = {path.name for folder in folders for path in folder.glob("*") if path.is_dir()}
    files = (file for folder in folders for file in folder.glob("*/**/*.yaml"))
    text = "\n".join([*typed, *arguments, *(file.read_text(encoding="utf-8") for file in files)])
    for key in added:
        top = key.partition(".")[0]
        is_referred_to = re.search(rf"\$\{{(oc\.select:)?{top}[.,}}]", text)
        if not (top in {*settings, *chosen, *groups, "hydra"} or is_referred_to):
            raise UserError(
                f"+{key}: nothing reads a setting of this name; typed without + it is looked for "
                "among those that there are"
            )


def check_names(folders: Sequence[Path], own: Sequence[Path]) -> None:
    """Raise UserError where a file is hidden by one of its name in an earlier folder.

    Args:
        folders: All that are searched, in this order.
        own: Those of them whose files are to be found.
    """
    first = dict[Path, Path]()
    for folder in folders:
        for file in sorted(folder.rglob("*.yaml")):
            other = first.setdefault(file.relative_to(folder), file)
            hidden = other is not file and folder in own
            if hidden and other.read_bytes() != file.read_bytes():
                raise UserError(
                    f"{file}: has the name of {other}, which would be read in its place; give it "
                    "another name"
                )


def check_several(group: str, value: str, folders: Sequence[Path]) -> None:
    """Raise UserError where a list of choices has one that no folder has."""
    known = sorted({name for folder in folders for name in list_choices(folder / group)})
    for name in (part.strip(" '\"") for part in value.strip("[]").split(",")):
        if name not in known:
            raise UserError(
                f"{group}={value}: there is no choice '{name}'{hint(name, known).rstrip('?')}; "
                f"there are {', '.join(known)}"
            )


def check_variants(typed: Mapping[str, str], conf: Path) -> None:
    """Raise UserError for a variant that a method lacks: Hydra would leave it without a preset."""
    for model, variant in product(*(typed.get(k, "").split(",") for k in ("model", "variant"))):
        known = list_choices(conf / "preset" / model) if re.fullmatch(r"\w+", model) else []
        real = re.fullmatch(r"\w+", variant) and (conf / "variant" / f"{variant}.yaml").is_file()
        if known and real and variant not in known and "preset" not in typed:
            raise UserError(
                f"variant={variant}: model={model} has no such variant; choose "
                f"variant={' or '.join(known)}"
            )


def check_ablations(typed: Mapping[str, str], conf: Path) -> None:
    """Raise UserError for a step between variants that is another method's, or changes another
    variant than the one that is typed, which would win.
    """
    if "experiment" not in typed:  # which may set the method
        defaults = read_settings(conf, "train")["defaults"]
        usual = next(one["model"] for one in defaults if "model" in one)
        typed = {"model": usual, **typed}
    keys = ("ablation", "model", "variant")
    for name, model, variant in product(*(typed.get(key, "").split(",") for key in keys)):
        if name not in BY_NAME:
            continue
        models = list_models(name)
        if model in list_models() and model not in models:
            raise UserError(
                f"ablation={name}: is a step of model={' or '.join(models)}, not of model={model}"
            )
        own = find_variant(BY_NAME[name])
        if variant not in ("", own):
            raise UserError(
                f"ablation={name}: is a step from variant={own}; leave variant={variant} out"
            )


def check_preset(name: str, folders: Sequence[Path]) -> None:
    """Raise UserError where no folder has a preset: methods need none, so that Hydra is silent."""
    if any((folder / "preset" / f"{name}.yaml").is_file() for folder in folders):
        return
    known = [
        f"{folder.name}/{choice}"
        for top in folders
        for folder in sorted((top / "preset").glob("[!_]*"))
        if folder.is_dir() and folder.name != "size"
        for choice in list_choices(folder)
    ]
    raise UserError(say_no_choice("preset", name, known))


def say_no_choice(group: str, name: str, known: Sequence[str]) -> str:
    """Return that a group has no choice of a name, which is the nearest, and which it has."""
    near = hint(name, known).rstrip("?")
    own = "" if named() else "; one of your own needs plugins=[PACKAGE] or --config-dir DIR"
    return f"{group}={name}: there is no such choice{near}; there are {', '.join(known)}{own}"


def config_folders(arguments: Sequence[str]) -> list[Path]:
    """Return the folder typed by --config-dir (or -cd): of several, Hydra takes the last."""
    words = [part for a in arguments for part in a.split("=", 1)]
    return [Path(b) for a, b in pairwise(words) if a in ("--config-dir", "-cd")][-1:]


def choice_folders(arguments: Sequence[str]) -> list[Path]:
    """Return the folders that add to the choices: of plug-ins, and typed ones."""
    return [*find_folders(trusted()), *config_folders(arguments)]


def typed_plugins(arguments: Sequence[str]) -> list[str]:
    """Return what was typed by `plugins=[...]`: names of packages, unless they are misspelt."""
    typed = [a.partition("=")[2] for a in arguments if re.match(r"\+{0,2}plugins=", a)]
    words = re.split(r"[\[\],\s'\"]+", typed[-1]) if typed else []
    return [word for word in words if word not in ("", "null")]


def read_settings(conf: Path, command: str) -> dict[str, Any]:
    """Return the settings of a command as they stand in its file, with its list of defaults."""
    content: dict[str, Any] = yaml.safe_load((conf / f"{command}.yaml").read_text(encoding="utf-8"))
    return content


def list_choices(group: Path) -> list[str]:
    """Return the choices of a group of conf/; files that begin with `_` are bases of others."""
    return sorted(f.stem for f in group.glob("*.yaml") if not f.stem.startswith("_"))
