"""Tell TensorBoard how to show a run: a layout of charts that tells its layout, and settings by which runs are compared."""

from collections.abc import Mapping
from pathlib import Path

from lightning import Callback, LightningModule, Trainer
from lightning.pytorch.loggers import TensorBoardLogger
from torch.utils.tensorboard import SummaryWriter
from torch.utils.tensorboard.summary import custom_scalars, hparams

from posefilter.callbacks.tensorboard import get_writers

Setting = bool | int | float | str

Chart = tuple[str, list[str]]
# Regular expressions of tags, one line each in a chart. What a method does not log, its charts leave out.
LAYOUT: dict[str, dict[str, Chart]] = {
    "1  Does it work?": {
        "score on validation (ADD AUC, or mean of box IoU and particles on the object)": ("Multiline", ["val/score$"]),
        "AUC of ADD and ADD-S": ("Multiline", [r"val/add/auc$", r"val/add_s/auc$"]),
        "median error [mm]": ("Multiline", [r"val/add/median_mm$", r"val/add_s/median_mm$"]),
        "found: share of the images [%]": ("Multiline", [r"val/add/recall_01d$", r"val/add/recall_2cm$"]),
        "box IoU, and share of the particles on the object": ("Multiline", [r"val/iou$", r"val/particles_on_object$"]),
    },
    "2  Does it learn?": {
        "losses": ("Multiline", [r"train/(?!learning_rate|coordinate).*"]),
        "error of the proposed coordinates [mm]": ("Multiline", [r"train/coordinate_error_mm$"]),
        "learning rate": ("Multiline", [r"train/learning_rate$"]),
    },
    "3  What do the particles do?": {
        "effective particles, by iteration": ("Multiline", [r"filter/ess/step_\d+$"]),
        "spread of the centers [m], by iteration": ("Multiline", [r"filter/spread_m/step_\d+$"]),
        "spread of the rotations [rad], by iteration": ("Multiline", [r"filter/spread_rad/step_\d+$"]),
        "spread [px], by iteration": ("Multiline", [r"filter/spread_px/step_\d+$"]),
        "noise level [m] or [px], by iteration": ("Multiline", [r"filter/sigma_(m|px)/step_\d+$"]),
        "where they end": ("Multiline", [r"signs/.*/last$"]),
    },
    "4  Is the belief honest?": {
        "truths within the region that holds 50 % and 90 % of the belief [%]": ("Multiline", [r"val/belief/coverage_\d+$"]),
        "weight near the truth": ("Multiline", [r"val/belief/mass_.*"]),
        "the truth outscored: share of the images": ("Multiline", [r"val/belief/truth_outscored.*"]),
    },
    "5  How fast?": {
        "images a second, in training and in validation": ("Multiline", [r"speed/(train|validation)_images_per_second$"]),
        "share of the training that waits for data": ("Multiline", [r"speed/waiting_share$"]),
        "validation: seconds, and the share of them that is drawing": (
            "Multiline",
            [r"speed/(validation_seconds|drawing_share)$"],
        ),
    },
}


FINAL = (
    "add/auc", "add/recall_01d", "add/recall_2cm", "add/median_mm", "add_s/auc", "add_s/median_mm",
    "iou", "particles_on_object", "seconds_per_image", "belief/mass_2cm", "belief/coverage_90",
)  # fmt: skip


class TensorBoardLayout(Callback):
    """Write the layout of the tab Custom Scalars, and the run's line in the tab HParams.

    settings: by name, what runs are told apart by; the command that trains fills them in. The line is a board of its own, in
    the folder `hparams` beside the run's: its columns are the settings, those that differ between runs first, and a few
    metrics: the validation's score so far, its best, and what the test found (as in metrics.json), rather than every scalar
    there is.
    """

    def __init__(self) -> None:
        self.settings: dict[str, Setting] = {}
        self._best = float("-inf")

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Write layout and settings."""
        if not trainer.is_global_zero:
            return
        for writer in get_writers(trainer):
            writer.add_summary(custom_scalars(LAYOUT))
        _, start, _ = hparams({key: shown(value) for key, value in self.settings.items()}, {})
        for line in lines(trainer):
            line._get_file_writer().add_summary(start)
            line.close()

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Tell how the run stands."""
        score = trainer.callback_metrics.get("val/score")
        if trainer.sanity_checking or score is None or not trainer.is_global_zero:
            return
        self._best = max(self._best, float(score))
        write(trainer, {"validation/score": float(score), "validation/best_score": self._best})

    def on_test_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Tell how the run ended."""
        found = {name: trainer.callback_metrics.get(f"test/{name}") for name in FINAL}
        if trainer.is_global_zero:
            write(trainer, {f"test/{name}": float(value) for name, value in found.items() if value is not None})


def shown(value: Setting) -> float | str:
    """Return a setting as the board can show it: numbers as such, the rest in words."""
    return str(value).lower() if isinstance(value, bool) else value


def lines(trainer: Trainer) -> list[SummaryWriter]:
    """Open the boards that hold the run's line, one for each of its TensorBoards."""
    folders = [logger.log_dir for logger in trainer.loggers if isinstance(logger, TensorBoardLogger)]
    return [SummaryWriter(Path(folder) / "hparams") for folder in folders]


def write(trainer: Trainer, metrics: Mapping[str, float]) -> None:
    """Add metrics to the run's line."""
    for line in lines(trainer):
        for name, value in metrics.items():
            line.add_scalar(name, value, trainer.global_step)
        line.close()
