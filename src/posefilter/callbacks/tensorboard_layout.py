"""Tell TensorBoard how to show a run: a layout of charts that tells its layout, and settings by
which runs are compared.
"""

from collections.abc import Mapping, Sequence
from typing import Any

from lightning import Callback, LightningModule, Trainer
from tensorboard.compat.proto.summary_pb2 import Summary
from tensorboard.plugins.hparams.api_pb2 import (
    DATA_TYPE_FLOAT64,
    DATA_TYPE_STRING,
    Experiment,
    HParamInfo,
    MetricName,
)
from tensorboard.plugins.hparams.api_pb2 import MetricInfo as MetricColumn
from tensorboard.plugins.hparams.metadata import (
    EXPERIMENT_TAG,
    NULL_TENSOR,
    PLUGIN_DATA_VERSION,
    create_summary_metadata,
)
from tensorboard.plugins.hparams.plugin_data_pb2 import HParamsPluginData
from tensorboard.plugins.hparams.summary_v2 import hparams_pb
from torch.utils.tensorboard.summary import custom_scalars

from posefilter.callbacks.tensorboard import get_boards, get_writers, log_numbers
from posefilter.metrics.registry import MetricInfo, find_metric

Setting = bool | int | float | str

# By category and title of a chart, regular expressions of the tags whose lines it shows. What a
# method does not log, its charts leave out.
LAYOUT: dict[str, dict[str, list[str]]] = {
    "1  Does it work?": {
        "score on validation (ADD AUC, up to the object's symmetries; of detectors, mean of box "
        "IoU and particles on the object)":
            ["val/score$"],
        "AUC of ADD and ADD-S": [r"val/add/auc$", r"val/add_s/auc$"],
        "median error [mm]": [r"val/add/median_mm$", r"val/add_s/median_mm$"],
        "found: share of the images [%]": [r"val/add/recall_01d$", r"val/add/recall_2cm$"],
        "box IoU, and share of the particles on the object":
            [r"val/iou$", r"val/particles_on_object$"],
    },
    "2  Does it learn?": {
        "losses": [r"train/loss(_.*)?$"],
        "error of the proposed coordinates [mm]": [r"train/coordinate_error_mm$"],
        "learning rate": [r"train/learning_rate$"],
    },
    "3  What do the particles do?": {
        "effective sample size over the number of particles, by iteration":
            [r"filter/ess/step_\d+$"],
        "spread of the centers [m], by iteration": [r"filter/spread_m/step_\d+$"],
        "spread of the rotations [rad], by iteration": [r"filter/spread_rad/step_\d+$"],
        "spread [px], by iteration": [r"filter/spread_px/step_\d+$"],
        "noise level [m] or [px], by iteration": [r"filter/sigma_(m|px)/step_\d+$"],
        "diagnostics at the last iteration": [r"diagnostics/.*/last$"],
    },
    "4  Is the belief calibrated?": {
        "coverage of the 50 % and 90 % mean-distance regions [%]":  # both: a run begun before
            [r"val/belief/(distance_)?coverage_\d+$"],
        "coverage of the 50 % and 90 % credible sets [%]": [r"val/credibility/coverage_(50|90)$"],
        "weight near the truth": [r"val/belief/mass_.*"],
        "share of the images in which a particle outscores the truth":
            [r"val/belief/truth_outscored.*"],
    },
    "5  How fast?": {
        "images a second, in training and in validation":
            [r"speed/(train|validation)_images_per_second$"],
        "share of the training that waits for data": [r"speed/waiting_fraction$"],
        "validation: seconds, and the share of them that is drawing":
            [r"speed/(validation_seconds|drawing_fraction)$"],
    },
}  # fmt: skip

# What the tab HParams shows of a run, in this order: the validation's score so far and its best,
# and what the test found.
METRICS = (
    "val/score", "val/best_score",
    "test/add/auc", "test/add/recall_01d", "test/add/median_mm", "test/add_s/auc", "test/iou",
    "test/particles_on_object",
    "test/seconds_per_image", "test/belief/mass_2cm", "test/belief/distance_coverage_90",
)  # fmt: skip
# TensorBoard shows the settings that differ first, five of them unless asked for more; these always
# count as such.
FIRST = ("filter.particles", "loss", "model", "seed", "variant")
BEST = "val/best_score"


class TensorBoardLayout(Callback):
    """Write the layout of the tab Custom Scalars, and the run's line in the tab HParams.

    The line goes into the run's own event file, so that each run is listed once.

    Attributes:
        settings: By name, what runs are told apart by; the command that trains fills them in.
        swept: Those of them in which the runs of its sweep differ; they are shown first too.
    """

    def __init__(self) -> None:
        self.settings: dict[str, Setting] = {}
        self.swept: tuple[str, ...] = ()
        self._best = float("-inf")
        self._written = False

    def state_dict(self) -> dict[str, Any]:
        """Return what a resumed run goes on with."""
        return {"best": self._best}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Go on with the best score of the run that is resumed."""
        self._best = float(state_dict["best"])

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Write layout and settings of a run that is only tested, as a sweep's job may be: before
        Lightning writes hparams.yaml.
        """
        if stage == "test" and not self._written:
            self._write(trainer)

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Write layout and settings."""
        self._write(trainer)

    def _write(self, trainer: Trainer) -> None:
        self._written = True
        if not trainer.is_global_zero:
            return
        for board in get_boards(trainer):
            board.hparams.update(self.settings)  # which Lightning writes to hparams.yaml
        layout = {
            category: {title: ("Multiline", tags) for title, tags in charts.items()}
            for category, charts in LAYOUT.items()
        }
        for writer in get_writers(trainer):
            writer.add_summary(custom_scalars(layout))
            for summary in describe_run(self.settings, self.swept, str(writer.get_logdir())):
                writer.add_summary(summary)

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Log the best score so far."""
        score = trainer.callback_metrics.get("val/score")
        if trainer.sanity_checking or score is None or not trainer.is_global_zero:
            return
        self._best = max(self._best, float(score))
        log_numbers(trainer, {BEST: self._best})


def describe_run(
    settings: Mapping[str, Setting], swept: Sequence[str], name: str
) -> tuple[Summary, Summary]:
    """Return what the tab HParams shows, and the settings of one run.

    Args:
        settings: Of the run, by name.
        swept: Those in which it differs from its sweep's other runs.
        name: Of the run; runs of one name would become one line.

    Returns:
        The columns of the table, and the run's line.
    """
    # numbers as such, the rest in words
    values = {k: str(v).lower() if isinstance(v, bool) else v for k, v in settings.items()}
    first = {*FIRST, *swept}
    columns = [
        HParamInfo(
            name=name,
            type=DATA_TYPE_STRING if isinstance(value, str) else DATA_TYPE_FLOAT64,
            differs=name in first,  # shown without being asked for
        )
        for name, value in values.items()
    ]
    metrics = [
        MetricColumn(
            name=MetricName(tag=tag),
            display_name=f"{tag.split('/')[0]}: {name_stored(find_metric(tag))}",
        )
        for tag in METRICS
    ]
    experiment = Experiment(hparam_infos=columns, metric_infos=metrics)
    start = hparams_pb(values, trial_id=name)
    content = HParamsPluginData(experiment=experiment, version=PLUGIN_DATA_VERSION)
    metadata = create_summary_metadata(content)
    value = Summary.Value(tag=EXPERIMENT_TAG, metadata=metadata, tensor=NULL_TENSOR)
    return Summary(value=[value]), start


def name_stored(info: MetricInfo) -> str:
    """Return what TensorBoard, which shows numbers as they are stored, calls one."""
    return info.title if info.factor == 1 else f"{info.label} [share]"
