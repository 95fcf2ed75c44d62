"""Build what a training or a test runs on: the data, and the trainer with its callbacks."""

import logging
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from lightning import Callback, Trainer
from lightning.pytorch.loggers import Logger, TensorBoardLogger
from lightning.pytorch.plugins.environments import SLURMEnvironment
from lightning.pytorch.strategies.launchers import _MultiProcessingLauncher
from omegaconf import DictConfig, OmegaConf

from posefilter.callbacks.tensorboard_layout import TensorBoardLayout
from posefilter.cli.comparing import comparable
from posefilter.cli.console import JSON
from posefilter.cli.files import WholeCheckpoints
from posefilter.cli.instantiate import instantiate
from posefilter.cli.job import Job
from posefilter.cli.plain import key_of, resolve
from posefilter.cli.progress_bar import progress
from posefilter.cli.ranks import is_follower
from posefilter.cli.stopping import FinalValidation, Stop
from posefilter.data.loaders import count_batches
from posefilter.data.module import PoseDataModule
from posefilter.devices import choose_device
from posefilter.errors import UserError
from posefilter.precision import check_precision

log = logging.getLogger(__name__)


def build_data(node: DictConfig, console: str, overrides: Sequence[str] = ()) -> PoseDataModule:
    """Build the data module, and have its scenes rendered where they are missing.

    Args:
        node: The settings of the data.
        console: "rich" or "json".
        overrides: What was typed.

    Raises:
        UserError: A setting is wrong, or the scenes that are there were rendered otherwise than is
            typed.
    """
    if console == JSON:
        node = without_bars(node)
    if node.get("generate") and "_target_" not in node.generate:
        node = node.copy()
        node.generate = None  # sizes that debug=smoke has for scenes: this dataset renders none
    data = make_data(node)
    data.prepare_data()
    if node.get("generate"):
        settings = {k: v for k, v in resolve(node.generate).items() if not k.startswith("_")}
        _check_rendered(data.root, settings, overrides)
        _check_mesh(data)
    return data


def make_data(node: DictConfig) -> PoseDataModule:
    """Build the data module; nothing is read or rendered yet."""
    data = instantiate(node, "data")
    if not isinstance(data, PoseDataModule):
        raise UserError(f"data._target_={node.get('_target_')}: is no data module")
    return data


def _check_rendered(root: Path, settings: Mapping[str, Any], overrides: Sequence[str]) -> None:
    """Refuse scenes that were rendered otherwise than is typed: they are not rendered anew."""
    keys = {*map(key_of, overrides)}
    typed = {name for name in settings if f"data.generate.{name}" in keys}
    if not typed:
        return
    from posefilter.synthetic.generate import list_changed  # renderers: other data need none

    changed = [
        f"{name}={settings[name]}" for name in list_changed(root, **settings) if name in typed
    ]
    if changed:
        raise UserError(
            f"data.generate.{', '.join(changed)}: the scenes in {root} were rendered with another "
            "value, and are not rendered anew; name a folder of their own, data.root=DIR"
        )


def _check_mesh(data: PoseDataModule) -> None:
    """Refuse scenes that show another mesh than the one that would be learned."""
    from posefilter.synthetic.generate import shows_another_mesh

    for name in data.objects:
        if shows_another_mesh(data.root, data.meshes, name):
            raise UserError(
                f"{data.root}: its scenes show another mesh of {name} than data.meshes="
                f"{data.meshes.root} has now; name a folder of their own, data.root=DIR, or keep "
                "the scenes as they are, data.generate=null"
            )


def without_bars(node: DictConfig) -> DictConfig:
    """Return the settings of the data with every bar switched off."""
    out = OmegaConf.create(resolve(node))
    assert isinstance(out, DictConfig)
    for section in (out, out.get("generate")):
        if section and "progress" in section:
            section.progress = False
    return out


def build_trainer(job: Job) -> Trainer:
    """Build the trainer with its callbacks and logger; they write into the job's folder."""
    quiet()
    cfg = job.cfg.copy()
    cfg.folder = str(job.folder)
    _check_trainer(cfg.trainer)
    steps, interval = cfg.trainer.get("max_steps", -1), cfg.trainer.get("val_check_interval")
    accumulated = cfg.trainer.get("accumulate_grad_batches", 1)
    steps *= accumulated if isinstance(accumulated, int) else 1  # the interval is of batches
    # else it would never be validated, and have no best checkpoint
    if isinstance(interval, int) and 0 < steps < interval:
        said = "trainer.val_check_interval=%d is more than the %d batches: validated at the end"
        log.info(said, interval, steps)
        cfg.trainer.val_check_interval = steps
    callbacks: list[Callback] = _build_all(cfg.callbacks, "callbacks", Callback)
    for layout in callbacks:
        if isinstance(layout, TensorBoardLayout):
            layout.settings = comparable(job)
            layout.swept = list_swept(job)
    callbacks += [progress(cfg.console), FinalValidation()]
    loggers: list[Logger] = _build_all(cfg.get("logger"), "logger", Logger)
    for logger in loggers:
        if not isinstance(logger, TensorBoardLogger):  # whose settings TensorBoardLayout logs
            logger.log_hyperparams(comparable(job))
    trainer = make_trainer(cfg.trainer, callbacks, loggers)
    environment = trainer._accelerator_connector.cluster_environment
    if job.swept and trainer.world_size > 1 and not environment.creates_processes_externally:
        raise UserError(
            f"trainer.devices={cfg.trainer.get('devices')}: each job of a sweep trains in one "
            "process, since the others would begin the whole sweep; start the runs one by one, "
            "without -m"
        )
    return trainer


def list_swept(job: Job) -> tuple[str, ...]:
    """Return the settings in which a sweep's jobs differ, as far as that is known: else all that
    were typed.
    """
    from posefilter.report.sweeps import read_asked

    if not job.swept:
        return ()
    folder = next((one for one in job.folder.parents if (one / "multirun.yaml").is_file()), None)
    if folder is None:  # not Hydra's own sweeper
        return tuple(map(key_of, job.overrides))
    asked = [f"{key}={values}" for key, values in read_asked(folder).items()]
    parsed = OverridesParser.create().parse_overrides(asked)
    return tuple(own.key_or_group for own in parsed if _is_varied(own))


def _is_varied(override: Override) -> bool:
    """Tell whether an override is swept over several values: a choice may be of one."""
    single = override.is_choice_sweep() and len([*override.sweep_string_iterator()]) == 1
    return override.is_sweep_override() and not single


def _check_trainer(node: DictConfig) -> None:
    """Raise UserError for settings of the trainer with which a training would not end in a test."""
    interval = node.get("val_check_interval")
    if node.get("max_steps", -1) is None:
        raise UserError("trainer.max_steps: is missing; must be a whole number, or -1 for no limit")
    if interval == 0 and not isinstance(interval, float):  # by a reference, too
        raise UserError("trainer.val_check_interval=0: must be 1 or more steps, or a share")
    if isinstance(interval, float) and node.get("check_val_every_n_epoch") is None:
        raise UserError(
            f"trainer.val_check_interval={interval}: a share of an epoch needs "
            "trainer.check_val_every_n_epoch=1; a whole number is of batches"
        )
    for name in ("fast_dev_run", "barebones"):
        if node.get(name):
            raise UserError(
                f"trainer.{name}={node[name]}: writes no checkpoint, which the test needs; "
                "debug=smoke is a short run"
            )
    if node.get("gradient_clip_algorithm") not in (None, "norm"):
        raise UserError(
            f"trainer.gradient_clip_algorithm={node.gradient_clip_algorithm}: gradients are "
            "clipped by the norm of each network; leave it out"
        )


def _build_all(node: DictConfig, where: str, kind: type) -> list[Any]:
    """Build callbacks or loggers; raises UserError where one is another thing."""
    made = {name: one for name, one in (instantiate(node, where) or {}).items() if one}
    for name, one in made.items():
        if not isinstance(one, kind):
            what = kind.__name__.lower()
            raise UserError(f"{where}.{name}={one}: is no {what}; null leaves it out")
    return [*made.values()]


def make_trainer(
    node: DictConfig, callbacks: list[Callback], loggers: list[Logger] | None = None
) -> Trainer:
    """Build a trainer of its settings.

    Raises:
        UserError: They would blur poses, the results would stay in processes that end with the
            training, they have one process of several that were started train alone, or Lightning
            would test another checkpoint.
    """
    check_precision(node.get("precision", "32-true"))
    if node.get("accelerator") == "auto":  # Lightning's takes what has no float64, too
        node = node.copy()
        node.accelerator = choose_device()
    trainer = instantiate(
        node,
        "trainer",
        callbacks=[*callbacks, Stop()],
        logger=loggers or False,
        plugins=WholeCheckpoints(),
        enable_progress_bar=False,
    )
    assert isinstance(trainer, Trainer)
    if isinstance(trainer.strategy.launcher, _MultiProcessingLauncher):
        raise UserError(
            f"trainer.strategy={node.get('strategy', 'auto')}: its processes are copies of this "
            "one, and their results end with them; choose "
            "trainer.strategy=ddp_find_unused_parameters_true, or auto for one process"
        )
    if is_follower() and trainer.world_size == 1:
        raise UserError(
            f"trainer.devices={node.get('devices')}: this is one of several processes that srun or "
            "torchrun has started, and only the first writes results; give trainer.devices= their "
            "number, or, for runs that are independent, start each by itself (srun --ntasks=1)"
        )
    _keep_from_requeueing(trainer)
    return trainer


def check_share(trainer: Trainer, data: PoseDataModule, split: str) -> None:
    """Refuse a share of the batches of "train" or "test" that is none of them."""
    share = getattr(trainer, f"limit_{split}_batches")
    if not (isinstance(share, float) and share < 1):
        return
    there = len(getattr(data, f"{split}_dataloader")())
    if not count_batches(there, share):
        why = {"train": "there would be no step", "test": "nothing would be tested"}[split]
        raise UserError(
            f"trainer.limit_{split}_batches={share}: of {there} batches this is none, and {why}"
        )


def _keep_from_requeueing(trainer: Trainer) -> None:
    """Keep Lightning from its own way to go on with a job of Slurm: at SIGUSR1 it would have the
    command started anew, which is no resuming, and it would test what it had then written,
    `hpc_ckpt_1.ckpt`, in place of the method that it is given.

    Raises UserError where such a file is there.
    """
    environment = trainer._accelerator_connector.cluster_environment
    if isinstance(environment, SLURMEnvironment):
        environment.auto_requeue = False
    found = sorted(Path(trainer.default_root_dir).glob("hpc_ckpt_*"))
    if found and SLURMEnvironment.detect():
        raise UserError(
            f"{found[0]}: in a job of Slurm Lightning would test this checkpoint, whatever is to "
            "be tested; move it away"
        )


def quiet() -> None:
    """Silence advice that does not apply here."""
    for name in ("pytorch.utilities.rank_zero", "fabric.utilities.distributed"):
        logging.getLogger(f"lightning.{name}").setLevel(logging.WARNING)
    for text in (
        ".*does not have many workers.*",
        ".*LeafSpec.*",
        ".*Checkpoint directory.*",
        ".*log_every_n_steps.*",
        ".*sync_dist=True.*",  # each process validates all images
        ".*in eval mode at the start of training.*",  # the statistics of a frozen trunk
    ):
        warnings.filterwarnings("ignore", text)
    torch.set_float32_matmul_precision("highest")  # TF32 would cost a pose at 1 m half a millimeter
