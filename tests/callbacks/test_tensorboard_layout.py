"""TensorBoard reads back what was written for it: layout, settings, final metrics."""

import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import torch
from lightning import LightningModule, Trainer
from lightning.pytorch.loggers import TensorBoardLogger
from omegaconf import OmegaConf
from tensorboard.backend.event_processing.data_provider import MultiplexerDataProvider
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.backend.event_processing.plugin_event_multiplexer import EventMultiplexer
from tensorboard.context import RequestContext
from tensorboard.plugins.base_plugin import TBContext
from tensorboard.plugins.custom_scalar.layout_pb2 import Layout
from tensorboard.plugins.hparams.backend_context import Context
from tensorboard.plugins.hparams.plugin_data_pb2 import HParamsPluginData
from tensorboard.util.tensor_util import make_ndarray
from torch.utils.data import DataLoader

from posefilter.callbacks.tensorboard_layout import LAYOUT, TensorBoardLayout


def run(
    folder: Path, particles: int, refine: str = "none", more: Any = None, swept: Any = ()
) -> None:
    """Go through a run's hooks, with the numbers that a training and a test would have left."""
    logger = TensorBoardLogger(folder, name="", version="")
    trainer: Any = SimpleNamespace(
        loggers=[logger], global_step=10, is_global_zero=True, sanity_checking=False
    )
    layout, method = TensorBoardLayout(), torch.nn.Module()
    layout.settings = {
        "refine": refine,
        "filter.particles": particles,
        "data.settle": False,
        "seed": 0,
        **(more or {}),
    }
    layout.swept = swept
    trainer.callback_metrics = {}
    layout.on_fit_start(trainer, method)  # type: ignore[arg-type]
    for step, score in ((10, 40.0), (20, 35.0)):
        trainer.global_step, trainer.callback_metrics = step, {"val/score": torch.tensor(score)}
        layout.on_validation_end(trainer, method)  # type: ignore[arg-type]
    logger.finalize("success")


def test_settings_and_metrics_are_read_back(tmp_path: Path) -> None:
    run(tmp_path, 50, "gradient")
    board = EventAccumulator(str(tmp_path))
    board.Reload()
    plugin = board.SummaryMetadata("_hparams_/session_start_info").plugin_data
    start = HParamsPluginData.FromString(plugin.content).session_start_info.hparams
    assert plugin.plugin_name == "hparams"
    assert start["filter.particles"].number_value == 50
    assert start["refine"].string_value == "gradient"
    assert start["data.settle"].string_value == "false"
    told = OmegaConf.load(tmp_path / "hparams.yaml")
    assert told == {"refine": "gradient", "filter.particles": 50, "data.settle": False, "seed": 0}
    assert [e.value for e in board.Scalars("val/best_score")] == [40.0, 40.0]
    assert set(board.Tags()["scalars"]) - {"hp_metric"} == {"val/best_score"}


def test_a_resumed_run_goes_on_with_its_best_score(tmp_path: Path) -> None:
    before, after = TensorBoardLayout(), TensorBoardLayout()
    after.load_state_dict(before.state_dict())  # before any validation
    logged: list[dict[str, float]] = []
    trainer: Any = SimpleNamespace(
        loggers=[SimpleNamespace(log_metrics=lambda metrics, step: logged.append(metrics))],
        global_step=10,
        is_global_zero=True,
        sanity_checking=False,
    )
    for layout, score in ((before, 80.0), (after, 70.0)):
        after.load_state_dict(before.state_dict())
        trainer.callback_metrics = {"val/score": torch.tensor(score)}
        layout.on_validation_end(trainer, torch.nn.Module())  # type: ignore[arg-type]
    assert [one["val/best_score"] for one in logged] == [80.0, 80.0]


def read_experiment(folder: Path) -> tuple[list[str], Any, list[str]]:
    """Return TensorBoard's runs below a folder, the table of the tab HParams, and the names of its
    lines.
    """
    runs = EventMultiplexer().AddRunsFromDirectory(str(folder))
    runs.Reload()
    context = Context(TBContext(data_provider=MultiplexerDataProvider(runs, str(folder))))
    found = context.hparams_metadata(RequestContext(), "")
    data = context.hparams_from_data_provider(RequestContext(), "", 100)
    experiment = context.experiment_from_metadata(RequestContext(), "", True, found, data)
    lines = [name for name, tags in found.items() if "_hparams_/session_start_info" in tags]
    return list(runs.Runs()), experiment, lines


def test_each_run_is_listed_once(tmp_path: Path) -> None:
    """The settings are in the run's own event file: a folder of their own would be another run."""
    run(tmp_path / "a", 50)
    run(tmp_path / "b", 50)  # with the same settings, and still a line of its own
    runs, _, lines = read_experiment(tmp_path)
    assert sorted(runs) == sorted(lines) == ["a", "b"]
    assert not [path for path in tmp_path.rglob("hparams*") if path.is_dir()]


def test_a_run_that_is_only_tested_is_listed_with_its_settings(tmp_path: Path) -> None:
    """As a sweep's job is whose weights another job has learned; once, where it was trained."""
    logger = TensorBoardLogger(tmp_path / "a", name="", version="")
    layout, method = TensorBoardLayout(), LightningModule()
    layout.settings = {"filter.particles": 50}
    trainer = Trainer(
        logger=logger,
        callbacks=[layout],
        accelerator="cpu",
        enable_progress_bar=False,
        enable_checkpointing=False,
        limit_test_batches=1,
    )
    method.test_step = lambda *_: None  # type: ignore[assignment, method-assign]
    for _ in range(2):
        trainer.test(method, DataLoader([torch.zeros(1)]), verbose=False)
    logger.finalize("success")
    _, _, lines = read_experiment(tmp_path)
    assert lines == ["a"]
    assert OmegaConf.load(tmp_path / "a" / "hparams.yaml") == layout.settings
    board = EventAccumulator(str(tmp_path / "a"), size_guidance={"tensors": 0}).Reload()
    assert len(board.Tensors("custom_scalars__config__")) == 1


def test_what_matters_is_shown_first(tmp_path: Path) -> None:
    """TensorBoard shows five settings unless asked: model, loss, particles and seed are always
    among them.
    """
    many = {
        "augment": "none",
        "budget": "short",
        "data.batch_size": 4,
        "model": "patch_pf",
        "loss": "bce",
        "variant": "paper",
    }
    run(tmp_path / "a", 50, more=many)
    _, experiment, _ = read_experiment(tmp_path)
    names = [info.name for info in experiment.hparam_infos]
    assert names[:5] == ["filter.particles", "loss", "model", "seed", "variant"]
    assert set(names) == {*many, "filter.particles", "seed", "refine", "data.settle"}
    assert [metric.name.tag for metric in experiment.metric_infos[:3]] == [
        "val/score",
        "val/best_score",
        "test/add/auc",
    ]
    assert experiment.metric_infos[2].display_name == "test: ADD AUC"
    run(tmp_path / "b" / "a", 50, more=many, swept=("augment",))
    _, experiment, _ = read_experiment(tmp_path / "b")
    assert [info.name for info in experiment.hparam_infos][:6] == ["augment", *names[:5]]


def test_layout_is_loaded_in_its_order(tmp_path: Path) -> None:
    run(tmp_path, 50)
    board = EventAccumulator(str(tmp_path))
    board.Reload()
    layout = Layout.FromString(
        make_ndarray(board.Tensors("custom_scalars__config__")[0].tensor_proto).item()
    )
    assert [category.title for category in layout.category] == list(LAYOUT)
    assert layout.category[0].chart[0].multiline.tag == ["val/score$"]


def test_every_chart_finds_what_methods_log() -> None:
    logged = [
        "val/score", "val/add/auc", "val/add_s/auc", "val/add/median_mm", "val/add/recall_01d",
        "val/iou",
        "val/particles_on_object", "train/loss", "train/loss_likelihood", "train/learning_rate",
        "train/coordinate_error_mm",
        "filter/ess/step_00", "filter/spread_m/step_13", "filter/spread_rad/step_00",
        "filter/spread_px/step_00",
        "filter/sigma_px/step_00", "diagnostics/off_frame/last", "val/belief/distance_coverage_50",
        "val/belief/mass_2cm", "val/credibility/coverage_90",
        "val/belief/truth_outscored", "speed/train_images_per_second", "speed/waiting_fraction",
        "speed/drawing_fraction",
    ]  # fmt: skip
    for charts in LAYOUT.values():
        for title, tags in charts.items():
            assert any(re.match(tag, name) for tag in tags for name in logged), title
    losses = LAYOUT["2  Does it learn?"]["losses"][0]
    assert [name for name in logged if re.match(losses, name)] == [
        "train/loss",
        "train/loss_likelihood",
    ]
