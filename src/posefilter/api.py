"""The library's verbs: load what is trained, compose a configuration, build what it describes."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from omegaconf import DictConfig

from posefilter.cli.checkpoints import (
    build_method,
    method_of,
    methods_of,
    read_checkpoint,
    recipe,
)
from posefilter.cli.components import SECTIONS, changes
from posefilter.cli.job import Job
from posefilter.cli.plain import key_of
from posefilter.confidence.tolerance import PoseTolerance
from posefilter.confidence.verdicts import Costs
from posefilter.devices import take_threads
from posefilter.errors import UserError
from posefilter.estimator import Estimator
from posefilter.models.base import PoseEstimator

if TYPE_CHECKING:
    from posefilter.data.module import PoseDataModule

_COSTS = "give load costs=posefilter.Costs(...)"
_INSTEAD = {  # of settings of `predict.py`
    "seed": "give predict seed=",
    "instances": "give predict instances=",
    "plugins": "call posefilter.trust",
    "threads": "call torch.set_num_threads",
    **dict.fromkeys(("cost_false_alarm", "cost_miss", "cost_unsure"), _COSTS),
    **dict.fromkeys(
        (f"pose_tolerance.{field.name}" for field in fields(PoseTolerance)),
        "give load pose_tolerance=posefilter.PoseTolerance(...)",
    ),
}


def load(
    weights: str | Path | Sequence[str | Path],
    *,
    overrides: Sequence[str] = (),
    device: str | None = None,
    costs: Costs | None = None,
    pose_tolerance: PoseTolerance | None = None,
) -> Estimator:
    """Load one trained filter, or several that run in one call.

    A checkpoint is data: nothing in it can run code.  What a plug-in defines is built only if you
    trust the plug-in before: `posefilter.trust("my_package")`.

    Args:
        weights: A checkpoint, a run's folder, or the name of weights that ship with posefilter,
            such as `003_cracker_box`; a list of these, one an object; a pattern such as
            `weights/*.ckpt`; or `all` for those that ship.
        overrides: What to change of the filter, as typed on the command line: such as
            `filter.particles=1000` or `filter/refine=none`.  Nothing else is one: the seed, for
            one, is an argument of `Estimator.predict`.
        device: Where to compute, such as `cpu` or `cuda:0`; None: on the GPU where there is one.
        costs: What errors cost, which `Result.verdict` goes by; None: the default.
        pose_tolerance: What a right pose is, which `Result.verdict` goes by, such as
            `posefilter.PoseTolerance(translation_mm=5, rotation_deg=10)`; None: an ADD below 0.1
            diameters.

    Returns:
        The estimator; see `Estimator.predict`.

    Raises:
        UserError: A file is missing or holds no checkpoint, or an override does not fit it.
    """
    overrides = check_overrides(overrides)
    wanted = changes(compose(overrides, "predict")) if overrides else {}
    take_threads()
    return Estimator(methods_of(weights, wanted), device, costs, pose_tolerance)


def load_method(weights: str | Path) -> PoseEstimator:
    """Load a trained method as a LightningModule, for a trainer of your own: one, too, that detects
    and estimates no pose.

    ```python
    method = posefilter.load_method("outputs/runs/carton")
    lightning.Trainer(max_steps=100).fit(method.train(), data)
    ```

    A checkpoint is data, as for `load`.

    Args:
        weights: A checkpoint, one that Lightning wrote of what `build` returns, too; a run's
            folder; or the name of weights that ship with posefilter.

    Returns:
        The method with its object, in evaluation mode.

    Raises:
        UserError: A file is missing or holds no checkpoint with a recipe.
    """
    return method_of(read_checkpoint(weights))


def _list_overrides(overrides: Iterable[str], example: str) -> list[str]:
    """Return settings, of a generator too, as a list; raises UserError where one is no text."""
    listed = isinstance(overrides, Iterable) and not isinstance(overrides, str | Mapping)
    texts = [*overrides] if listed else []
    if not listed or not all(isinstance(text, str) for text in texts):
        raise UserError(f"overrides={overrides!r}: must be a list, such as ['{example}']")
    return texts


def check_overrides(overrides: Iterable[str]) -> list[str]:
    """Return what is to be changed of a trained filter.

    Raises:
        UserError: They are no list of texts, or one sets what is not the filter's.
    """
    texts = _list_overrides(overrides, "filter.particles=1000")
    for override in texts:
        key = key_of(override).split("@")[0]
        if not key.startswith(tuple(f"{section}{mark}" for section in SECTIONS for mark in "./")):
            instead = f": {_INSTEAD[key]}" if key in _INSTEAD else ""
            raise UserError(
                f"overrides: '{override}' changes nothing of a trained filter{instead}; what does "
                "begins with filter or model, such as filter.particles=1000 or filter/refine=none"
            )
    return texts


def compose(overrides: Sequence[str] = (), command: str = "train") -> DictConfig:
    """Compose the configuration of a command, as the command line would.

    Args:
        overrides: What would be typed after the command, such as `model=patch_pf` or
            `filter.particles=100`.
        command: One of calibrate, check_data, convert_bag, evaluate, export, generate, onboard,
            predict, report, track and train.

    Returns:
        The configuration; `folder` is missing in it, since no run has begun.

    Raises:
        UserError: An override names what there is not, a choice of a training that does not fit
            the others, or a plug-in that is not trusted: see `trust`.
    """
    texts = _list_overrides(overrides, "model=patch_pf")
    from posefilter.cli.command import compose_config  # Hydra: `load` answers without it

    return compose_config(command, texts)


def build(config: DictConfig, data: "PoseDataModule | None" = None) -> PoseEstimator:
    """Build the method that a configuration of `train` describes, untrained; its weights are those
    of the configuration's seed.

    ```python
    config = posefilter.compose(["model=pose_pf", "data.generate.frames=200"])
    data = posefilter.build_data(config)
    method = posefilter.build(config, data)
    lightning.Trainer(max_steps=100).fit(method, data)
    ```

    Args:
        config: What `compose` returns.
        data: The data that it is to learn from, which says what its object is; None: call
            `method.set_object` before it is used.

    Returns:
        The method, a LightningModule.

    Raises:
        UserError: A setting does not fit; the message names it.
    """
    _check_config(config, "model")
    if data is not None and not hasattr(data, "object_to_learn"):
        raise UserError(
            f"data: is a {type(data).__name__}; give what posefilter.build_data returns"
        )
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(int(config.seed))
        method = build_method(recipe(Job(config, {}, [], Path(), "train", False)))
    if data is not None:
        data.prepare_data()
        data.setup("fit")
        method.set_object(data.object_to_learn())
    return method


def build_data(config: DictConfig) -> "PoseDataModule":
    """Build the data module that a configuration describes; nothing is read or rendered yet.

    Args:
        config: What `compose` returns.

    Raises:
        UserError: A setting does not fit; the message names it.
    """
    from posefilter.cli.build import make_data  # readers and meshes: `load` needs none
    from posefilter.cli.running import import_trusted

    _check_config(config, "data")
    import_trusted()  # plug-ins register readers
    return make_data(config.data)


def _check_config(config: Any, section: str) -> None:
    """Raise UserError for what `compose` does not return, or returns for another command."""
    if not isinstance(config, DictConfig):
        raise UserError(
            f"config: is a {type(config).__name__}; give what posefilter.compose returns"
        )
    if config.get(section) is None:
        raise UserError(f"config: has no {section}; give what posefilter.compose returns for train")
