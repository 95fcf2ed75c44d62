"""What a command is asked to do."""

import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig, ListConfig, OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException

from posefilter.cli.plain import resolve, to_plain
from posefilter.errors import UserError
from posefilter.ranges import check_ranges

_ACCELERATORS = ("auto", "cpu", "gpu", "cuda")  # others have no float64
# settings that a command requires a value of
_NEEDED = {
    "train": ("model", "loss", "data", "filter", "optimizer", "trainer", "callbacks", "seed"),
    "predict": ("depth_scale", "seed", "out", "cost_false_alarm", "cost_miss", "cost_unsure"),
    "convert_bag": (
        *("color", "depth", "camera_info", "detections", "track", "seed"),
        *("max_time_difference", "copy_messages", "depth_scale"),
        *("cost_false_alarm", "cost_miss", "cost_unsure"),
    ),
    "calibrate": ("frames", "seed", "overwrite", "sets_only"),
    "track": ("stride", "fps", "seed", "out", "tracker"),
    "generate": ("seed",),
    "check_data": ("data", "out"),
    "evaluate": ("trainer", "absent_frames", "seed"),
    "onboard": ("seed", "budget_minutes", "test_frames", "workers"),
    "export": ("points", "max_mb", "format", "width", "height"),
}


# a mapping that the command line replaces whole, where Hydra would merge it with the defaults
_WHOLE = "data.split"


@dataclass(frozen=True)
class Job:
    """One run of one command."""

    cfg: DictConfig
    choices: dict[str, str]  # which file of each group
    overrides: list[str]  # as typed
    folder: Path  # where its files go
    name: str  # of the command
    swept: bool  # one of several that `-m` started


def make_job(
    cfg: DictConfig,
    choices: Mapping[Any, Any],
    overrides: Sequence[str],
    folder: Path,
    name: str,
    swept: bool = False,
) -> Job:
    """Return a job of settings as Hydra has composed them; they are changed in place."""
    _replace_typed(cfg, overrides)
    chosen = {str(group): str(choice) for group, choice in choices.items()}
    return Job(cfg, chosen, list(overrides), folder, name, swept)


def _replace_typed(cfg: DictConfig, overrides: Sequence[str]) -> None:
    """Keep of the mapping `_WHOLE` only what was typed, once it was typed whole.

    `data.split={test: 1.0}` means that and nothing else: the default shares of train and val are
    not added. `data.split.test=0.5` changes one share and leaves the others.

    Args:
        cfg: The composed configuration, changed in place.
        overrides: The command line's overrides.
    """
    starts = (f"{_WHOLE}=", f"{_WHOLE}.")
    own = [text for text in overrides if text.lstrip("+~").startswith(starts)]
    typed: set[str] | None = None
    for override in OverridesParser.create().parse_overrides(own):
        path, value = override.key_or_group, override.value()
        if path == _WHOLE and isinstance(value, dict):
            typed = {str(name) for name in value}
        elif typed is not None:
            typed.add(path.removeprefix(f"{_WHOLE}."))
    node = OmegaConf.select(cfg, _WHOLE, default=None)
    if typed is not None and isinstance(node, DictConfig):
        with open_dict(node):
            for name in set(map(str, node)) - typed:
                del node[name]


def write_job(job: Job) -> None:
    """Write a job's settings into its folder, as Hydra does for what is typed."""
    folder = job.folder / ".hydra"
    folder.mkdir(parents=True, exist_ok=True)
    own = {"runtime": {"choices": job.choices}, "overrides": {"task": job.overrides}}
    OmegaConf.save(job.cfg, folder / "config.yaml")
    OmegaConf.save(OmegaConf.create(job.overrides), folder / "overrides.yaml")
    OmegaConf.save(OmegaConf.create({"hydra": own}), folder / "hydra.yaml")


def first(*values: Any) -> Any:
    """Return the first value that is not null."""
    return next((value for value in values if value is not None), None)


def plain_name(text: str) -> str:
    """Return a text fit for a folder's name: no slashes, no Hydra signs, at most 120 characters.

    A longer one ends in a digest of the text, so that jobs of a sweep that differ only beyond have
    folders of their own.
    """
    name = re.sub(r"[^\w.,=\-]+", "_", re.sub(r"(^|,)[+~]+", r"\1", str(text))).strip("_")
    if len(name) > 120:
        name = f"{name[:111]}_{sha256(str(text).encode()).hexdigest()[:8]}"
    return name or "run"


def run_of(path: Any) -> str:
    """Return the folder that files about a checkpoint go to: its run, or one of their own below
    outputs/evaluations.
    """
    if path is None:
        return "outputs/evaluations/unnamed"
    file = Path(str(path))
    if file.is_dir():
        return str(file)
    if file.parent.name == "checkpoints":
        return str(file.parent.parent)
    return f"outputs/evaluations/{file.stem}"


def check_out(cfg: DictConfig) -> None:
    """Raise UserError where `out` is something that cannot name a folder or file, or a run's folder
    is given as `folder`, which the run sets.
    """
    if "folder" in cfg:  # not while it is missing
        raise UserError(f"folder={cfg.folder}: is set by the run; choose a folder by out=")
    out = cfg.get("out")
    named = isinstance(out, str | int | float) and not isinstance(out, bool) and str(out).strip()
    if out is not None and not named:
        raise UserError(f"out={out}: names no folder; give one, or leave it out")


def _resolve(cfg: DictConfig) -> dict[str, Any]:
    """Return settings with what they refer to, less those that refer to nothing: told when read."""
    out: dict[str, Any] = {}
    for key in cfg:
        with suppress(OmegaConfBaseException):
            out[str(key)] = resolve(cfg[key])
    return out


def check_settings(cfg: DictConfig, command: str, choices: Mapping[str, str] | None = None) -> None:
    """Check what needs nothing but the settings, before torch is imported.

    Args:
        cfg: The settings.
        command: The command's name.
        choices: Which file of each group; None: not known.

    Raises:
        UserError: A number is outside of its range, or another setting makes no sense.
    """
    plain = to_plain(cfg)
    check_ranges(plain, command)
    check_out(cfg)
    if command == "train" and choices is not None:
        _check_package(plain, choices)
    for key in _NEEDED.get(command, ()):
        if choices is not None and key not in plain and key not in choices:
            model = choices.get("model")
            place = "your own file" if model is None else f"the file of model={model}"
            raise UserError(
                f"{key}: nothing chooses one; type {key}=NAME, or add `- /{key}: NAME` to the "
                f"defaults in {place}"
            )
        if plain.get(key) is None:
            raise UserError(f"{key}=null: {command} requires a value; leave it out for the default")
    check_ranges(_resolve(cfg), command)  # what is made of other settings, too
    trainer = plain.get("trainer") or {}
    if command == "evaluate":
        _check_alone(trainer)
    accelerator = trainer.get("accelerator", "auto")
    if accelerator not in _ACCELERATORS:
        raise UserError(
            f"trainer.accelerator={accelerator}: there is none of this name; choose "
            f"{', '.join(_ACCELERATORS)}"
        )
    tags = cfg.get("tags") or []
    if not (isinstance(tags, ListConfig | list) and all(isinstance(tag, str) for tag in tags)):
        raise UserError(f"tags={tags}: must be a list of words, such as tags=[first]")
    if cfg.get("console", "json") not in ("rich", "json"):
        raise UserError(f"console={cfg.console}: choose rich or json")


def _check_package(plain: Mapping[str, Any], choices: Mapping[str, str]) -> None:
    """Refuse the file of a method that lacks its first line: Hydra puts all that it says below
    `model`.
    """
    model = plain.get("model")
    model = model if isinstance(model, Mapping) else {}
    nested = isinstance(model.get("model"), Mapping) and "_target_" not in model
    places = [key.partition("@") for key in choices]
    chosen = any(place == f"model.{group.replace('/', '.')}" for group, _, place in places)
    if nested or chosen:
        raise UserError(
            f"model={choices.get('model')}: the first line of its file must be "
            "`# @package _global_`; without it, all that it chooses and sets is below `model`"
        )


def _check_alone(trainer: Mapping[str, Any]) -> None:
    """Refuse the settings of a trainer that would test in several processes: Lightning ends all of
    them by a signal once the second is refused as one too many.
    """
    for key in ("devices", "num_nodes"):
        asked = trainer.get(key)
        count = len(asked) if isinstance(asked, list) else asked
        if isinstance(count, int) and count > 1:  # what `auto` stands for is known later
            raise UserError(f"trainer.{key}={asked}: evaluate tests in one process; leave it at 1")
