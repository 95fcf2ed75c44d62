"""Build a method, from a configuration or from a checkpoint that carries its own."""

import re
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf

from posefilter.errors import UserError
from posefilter.models.base import PoseEstimator
from posefilter.models.compact import unpack
from posefilter.run.build import hint, instantiate, locate
from posefilter.run.job import Job
from posefilter.run.pieces import changed
from posefilter.types import ObjectModel

_NOT_KEPT = ("out", "folder", "trainer", "callbacks", "logger", "resume", "debug", "console")


def check_loss(job: Job) -> None:
    """Raise UserError unless the chosen loss fits the chosen method, naming those that do."""
    method, loss = locate(str(job.cfg.model._target_), "model"), job.choices["loss"]
    legal = getattr(method, "legal_losses", ())
    if loss not in legal:
        model = job.choices["model"]
        raise UserError(f"loss={loss} does not fit model={model}: choose {', '.join(legal)}{hint(loss, legal)}")


def recipe(job: Job) -> dict[str, Any]:
    """Return what a checkpoint carries, so that the method can be built again: choices, and settings not yet resolved."""
    settings = OmegaConf.to_container(job.cfg, resolve=False)
    assert isinstance(settings, dict)
    return {
        "choices": {group: choice for group, choice in job.choices.items() if not group.startswith("hydra/")},
        "settings": {key: value for key, value in settings.items() if key not in _NOT_KEPT},
    }


def build_method(recipe: dict[str, Any], model: ObjectModel | None = None) -> PoseEstimator:
    """Build the method of a recipe, for an object if it is known."""
    settings = OmegaConf.create(recipe["settings"])
    try:
        method = instantiate(settings.model, "model")
    except UserError as error:
        where, found, rest = str(error).partition(":")
        key, equals, value = where.partition("=")
        raise UserError(typed_key(settings, key) + equals + value + found + rest) from error
    assert isinstance(method, PoseEstimator)
    method.recipe = recipe
    if model is not None:
        method.adopt(model)
    return method


def read_checkpoint(path: str | Path | None) -> dict[str, Any]:
    """Read a checkpoint of ours.  Raises UserError where the path holds none."""
    if not path:
        raise UserError("checkpoint: is missing; give checkpoint=RUN/checkpoints/best.ckpt, or one of weights/")
    file = Path(path)
    if file.is_dir():
        file = file / "checkpoints" / "best.ckpt"
    if not file.is_file():
        raise UserError(f"checkpoint={path}: no such file")
    try:
        checkpoint = torch.load(file, map_location="cpu", weights_only=True)
    except Exception as error:  # a damaged archive fails in many ways, and pickle raises what it likes
        raise UserError(f"checkpoint={path}: not readable as a checkpoint ({type(error).__name__})") from error
    if not isinstance(checkpoint, dict) or not {"state_dict", "recipe", "object_model"} <= set(checkpoint):
        raise UserError(f"checkpoint={path}: not made by this project's train.py (no recipe or object in it)")
    return checkpoint


def method_of(checkpoint: dict[str, Any], wanted: dict[str, Any] | None = None) -> PoseEstimator:
    """Build the method that a checkpoint holds, with some of its pieces changed, and load its weights."""
    recipe = checkpoint["recipe"]
    recipe = {**recipe, "settings": changed(recipe["settings"], wanted or {})}
    method = build_method(recipe, ObjectModel(**checkpoint["object_model"]))
    try:
        missing, foreign = method.load_state_dict(unpack(checkpoint["state_dict"]), strict=False)
    except RuntimeError as error:  # tensors of other shapes
        raise UserError(
            "checkpoint: its weights do not fit the method; they were trained by another version of this code"
        ) from error
    lost = [key for key in missing if not key.startswith("scores.")]
    if lost or foreign:
        raise UserError(f"checkpoint: its weights do not fit the method ({len(lost)} missing, {len(foreign)} unknown)")
    return method.eval()


def typed_key(settings: DictConfig, where: str) -> str:
    """Return a place in the model's tree as one types it: `model.filter.initialise.behind` is `initialise.behind`."""
    path: list[str] = []
    for part in where.split("."):
        path.append(part)
        node: Any = OmegaConf.to_container(settings, resolve=False)
        for key in path:
            node = node.get(key) if isinstance(node, dict) else None
        if isinstance(node, str) and (link := re.fullmatch(r"\$\{([\w.]+)\}", node)):
            path = link[1].split(".")
    return ".".join(path)
