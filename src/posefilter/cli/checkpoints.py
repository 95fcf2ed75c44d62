"""Build a method, from a configuration or from a checkpoint that carries its own."""

from collections import Counter
from collections.abc import Sequence
from itertools import islice
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from torch import Tensor

from posefilter.cli.archive import Bounded, check_archive, check_content
from posefilter.cli.components import changed
from posefilter.cli.fit import check_fit, typed_key
from posefilter.cli.instantiate import instantiate_recipe
from posefilter.cli.job import Job
from posefilter.cli.plain import resolve, to_plain
from posefilter.cli.recipe import NOT_KEPT, check_recipe, resolve_foreign, without_pretrained
from posefilter.cli.trust import Scope
from posefilter.confidence.calibration import read_calibration
from posefilter.errors import UserError, find_reason, naming
from posefilter.filters.loop import MAX_SEARCHES
from posefilter.models.base import PoseEstimator, with_lightning
from posefilter.models.quantization import unpack, unpack_object
from posefilter.ranges import check_ranges
from posefilter.types import ObjectModel
from posefilter.weights import expand_weights, find_weights

_COMPILED = "_orig_mod."  # in the names of weights of what `torch.compile` returned
_SPARE_ELEMENTS, _SPARE_TENSORS = 1 << 24, 20_000  # that a method may make beside its weights


def recipe(job: Job) -> dict[str, Any]:
    """Return what a checkpoint carries, to build the method again: choices, and settings that refer
    to each other.

    Any other interpolation is resolved here and now, since no reader of the checkpoint would.
    """
    kept = {key: value for key, value in to_plain(job.cfg).items() if key not in NOT_KEPT}
    choices = {group: c for group, c in job.choices.items() if not group.startswith("hydra/")}
    return {"choices": choices, "settings": resolve_foreign(kept)}


def build_method(
    recipe: dict[str, Any], object_model: ObjectModel | None = None, lightning: bool = True
) -> PoseEstimator:
    """Build the method of a recipe.

    Args:
        recipe: Of a checkpoint, or of `recipe`.
        object_model: Its object, where it is known.
        lightning: Whether it is a LightningModule; False for prediction alone, which is seconds
            sooner there.
    """
    settings = OmegaConf.create(recipe["settings"])
    assert isinstance(settings, DictConfig)
    _check_references(settings)
    check_fit(settings, recipe["choices"], Scope.RECIPE)
    variant = _with_lightning if lightning else None
    try:
        check_ranges({"model": resolve(settings.get("model"))}, "train")
        method = instantiate_recipe(settings.get("model"), "model", variant)
    except UserError as error:
        where, found, rest = str(error).partition(":")
        key, equals, value = where.partition("=")
        typed = typed_key(recipe["settings"], key)
        raise UserError(typed + equals + value + found + rest) from error
    if not isinstance(method, PoseEstimator):
        raise UserError(f"model: is a {type(method).__name__}, not a method")
    method.recipe = recipe
    if object_model is not None:
        method.set_object(object_model)
    return method


def _check_references(settings: DictConfig) -> None:
    """Raise UserError where what a method is made of refers to what is not there."""
    try:
        resolve(settings.get("model"))
    except OmegaConfBaseException as error:
        reason = find_reason(error)[:200]
        raise UserError(f"model: its settings refer to what is not there ({reason})") from error


def _with_lightning(kind: Any) -> Any:
    return with_lightning(kind) if issubclass(kind, PoseEstimator) else kind


def find_checkpoint(path: str | Path | None, setting: str = "checkpoint") -> Path:
    """Return the file that a checkpoint's path, its run's folder, or a name stands for; `setting`
    is what named it.

    Raises:
        UserError: There is none.
    """
    file = find_weights(path, setting)
    if file.is_dir():
        file = file / "checkpoints" / "best.ckpt"
        if not file.is_file():
            raise UserError(f"{setting}={path}: is a folder without checkpoints/best.ckpt")
    if not file.is_file():
        raise UserError(f"{setting}={path}: no such file")
    return file


def read_checkpoint(path: str | Path | None, setting: str = "checkpoint") -> dict[str, Any]:
    """Read a checkpoint of ours, as data that others may have written; `setting` is what named it.

    Raises UserError where the path holds none, and where what it holds could do harm (see `archive`
    and `recipe`).
    """
    file = find_checkpoint(path, setting)
    said = f"{setting}={path}"
    with naming(said):
        check_archive(file)
        try:
            loaded = torch.load(file, map_location="cpu", weights_only=True)
        # a damaged archive fails in many ways, and pickle raises what it likes
        except Exception as error:
            why = type(error).__name__
            raise UserError(f"not readable as a checkpoint ({why})") from error
        checkpoint = check_content(loaded, file)
        recipe = check_recipe(checkpoint["recipe"])
    if checkpoint.get("calibration") is not None:
        read_calibration(checkpoint["calibration"], said)
    return {**checkpoint, "recipe": recipe}


def methods_of(weights: Any, wanted: dict[str, Any]) -> list[PoseEstimator]:
    """Return the methods of all checkpoints that a setting stands for, see `expand_weights`, to
    estimate with; `wanted` as in `method_of`.
    """
    found = expand_weights(weights)
    return [method_of(read_checkpoint(one), wanted, lightning=False) for one in found]


def method_of(
    checkpoint: dict[str, Any], wanted: dict[str, Any] | None = None, lightning: bool = True
) -> PoseEstimator:
    """Build the method that a checkpoint holds, with some of its components changed, and load its
    weights; `lightning` as in `build_method`.
    """
    recipe = checkpoint["recipe"]
    settings = changed(recipe["settings"], wanted or {})
    same = is_calibrated_filter(settings, recipe["settings"])
    recipe = {**recipe, "settings": without_pretrained(settings)}
    state = unpack(checkpoint["state_dict"])
    elements = 4 * sum(value.numel() for value in state.values()) + _SPARE_ELEMENTS
    try:
        with Bounded(elements, 20 * len(state) + _SPARE_TENSORS):
            method = build_method(recipe, unpack_object(checkpoint["object_model"]), lightning)
    except UserError:
        raise
    except Exception as error:  # settings that do not fit each other break in any component
        why = f"{type(error).__name__}: {find_reason(error)[:200]}"
        raise UserError(f"checkpoint: its recipe describes no method ({why})") from error
    state = _name_alike(state, method)
    try:
        missing, foreign = method.load_state_dict(state, strict=False)
    except RuntimeError as error:  # tensors of other shapes
        own = method.state_dict()
        others = (key for key in own if key in state and state[key].shape != own[key].shape)
        first = "".join(
            f" ({key} is {tuple(state[key].shape)} there, and {tuple(own[key].shape)} here)"
            for key in islice(others, 1)
        )
        raise UserError(
            f"checkpoint: its weights do not fit the method{first}; they were trained by another "
            "version of this code, or of a plug-in"
        ) from error
    if missing or foreign:
        first = f"{missing[0]} is not there" if missing else f"{foreign[0]} is unknown"
        raise UserError(
            f"checkpoint: its weights do not fit the method ({len(missing)} missing, "
            f"{len(foreign)} unknown: {first})"
        )
    if checkpoint.get("calibration") is not None:
        if same:
            method.calibration = read_calibration(checkpoint["calibration"], "checkpoint")
        else:
            method.calibration_note = "the checkpoint was calibrated for another filter"
    return method.eval()


def _name_alike(state: dict[str, Tensor], method: PoseEstimator) -> dict[str, Tensor]:
    """Return weights by the names that they have in a method: `torch.compile` of a network adds
    `_orig_mod.` to those of its weights, and here or there it may be compiled.
    """
    own = {key.replace(_COMPILED, ""): key for key in method.state_dict()}
    return {own.get(key.replace(_COMPILED, ""), key): value for key, value in state.items()}


def is_calibrated_filter(settings: dict[str, Any], calibrated: dict[str, Any]) -> bool:
    """Tell whether a checkpoint's calibration holds for settings: they are those that it was made
    with, or have fewer searches. Then fewer answers to choose from are judged by the same features.
    """

    def split(one: dict[str, Any]) -> tuple[dict[str, Any], int]:
        own = one.get("filter")
        # earlier recipes leave it out
        own = {"magnified_width": None, **own} if isinstance(own, dict) else {}
        searches = own.pop("max_searches", MAX_SEARCHES)
        return {**one, "filter": own}, searches if isinstance(searches, int) else MAX_SEARCHES

    (new, asked), (old, known) = split(settings), split(calibrated)
    return new == old and asked <= known


def check_once(objects: Sequence[str]) -> None:
    """Raise UserError where two checkpoints are of one object: answers go by its name."""
    name, count = Counter(objects).most_common(1)[0]
    if count > 1:
        raise UserError(
            f"checkpoint: {count} of them are of {name}; take one after the other, each with an "
            "out= of its own"
        )
