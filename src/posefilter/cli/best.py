"""Which checkpoint of a run is tested, and which one it is resumed from."""

import math
import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from lightning import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import Checkpoint, EarlyStopping, ModelCheckpoint
from torch import Tensor

from posefilter.cli.resume import BEFORE, LAST
from posefilter.cli.stopping import (
    any_process,
    asked_to_stop,
    is_accumulating,
    is_over,
    is_validated,
)
from posefilter.errors import UserError
from posefilter.metrics.registry import HIGHER, LOWER, find_metric

_KEPT = {"filename": "best", "save_top_k": 1}  # as the test and later commands expect them
_NONE_DONE = {"ready": 0, "started": 0, "processed": 0, "completed": 0}


class Best(ModelCheckpoint):
    """Keep the checkpoint of the best validation; of equal ones the latest, which has learned for
    longest.

    Lightning's own keeps the first. Where nothing finds the object yet all scores are 0, and a run
    would be tested on what it had learned by its first validation.
    """

    def check_monitor_top_k(self, trainer: Trainer, current: Tensor | None = None) -> bool:
        """Tell whether a validation is to be kept."""
        equal = (
            current is not None
            and self.best_model_score is not None
            and bool(current == self.best_model_score)
        )
        return trainer.strategy.reduce_boolean_decision(equal) or super().check_monitor_top_k(
            trainer, current
        )

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Take over what a checkpoint says of the files that were kept, of those in this run's own
        folder alone, also where that was moved.

        Lightning deletes what it replaces, so that a foreign checkpoint could name any file. And it
        forgets the best score of a folder of another name, so that any validation would replace it.
        """
        folder = state_dict.get("dirpath")
        scores = dict(state_dict.get("best_k_models") or {})
        kept = {here: one for path, one in scores.items() if (here := self._find(path, folder))}
        paths = {
            key: self._find(state_dict.get(key), folder)
            for key in ("best_model_path", "last_model_path", "kth_best_model_path")
        }
        place = {"dirpath": self.dirpath} if kept else {}
        super().load_state_dict({**state_dict, **paths, **place, "best_k_models": kept})

    def _find(self, path: Any, folder: Any) -> str:
        """Return the path of a kept checkpoint in the folder that this run writes to, "" if it is
        elsewhere.

        Args:
            path: What a state says.
            folder: The folder that was written to then; it may have been moved to today's.
        """
        if not (isinstance(path, str) and path and self.dirpath) or Path(path).suffix != ".ckpt":
            return ""
        parent, today = os.path.realpath(Path(path).parent), os.path.realpath(self.dirpath)
        if parent == today:
            return path
        own = Path(self.dirpath) / Path(path).name
        was_there = isinstance(folder, str) and parent == os.path.realpath(folder)
        moved = was_there and not Path(path).exists() and own.is_file()
        return str(own) if moved else ""


class Last(Checkpoint):
    """Write what a run is resumed from: at each validation, every few minutes, and when it is
    interrupted; where gradients are accumulated, once the step is complete.

    The checkpoint before it is kept as last.previous.ckpt, for the day on which the last is broken.

    Args:
        dirpath: The folder of the run's checkpoints.
        minutes: Between two checkpoints, about [min]; null: at validations alone.
    """

    def __init__(self, dirpath: str, minutes: float | None = 3.0) -> None:
        self.path = Path(dirpath) / LAST
        self._pause = math.inf if minutes is None else 60 * minutes
        self._saved_at = 0.0
        self._whole = False  # whether the file there is one that a run can go on from
        self._validation_due = False

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Start the clock."""
        self._saved_at = time.monotonic()
        start = trainer.ckpt_path
        self._whole = start is not None and Path(start).resolve() == self.path.resolve()

    def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, *_: Any) -> None:
        """Write it where it is time, unless a validation follows: that looks at the time, too."""
        if self._due(trainer) and not is_validated(trainer):
            self._save(trainer)

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Write it."""
        if not trainer.sanity_checking:
            self._save(trainer)

    def on_save_checkpoint(
        self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """Have a run that goes on from amid a validation do the whole of it again: what the
        validation had collected is not kept.
        """
        if self._validation_due:
            # Lightning's sign for a validation that was cut short: one batch begun, none done
            begun = {**_NONE_DONE, "ready": 1, "started": 1}
            progress = checkpoint["loops"]["fit_loop"]["epoch_loop.val_loop.batch_progress"]
            progress |= {"total": begun, "current": dict(_NONE_DONE), "is_last_batch": False}

    def _save_amid_validation(self, trainer: Trainer, *_: Any, **__: Any) -> None:
        # a run that has all its steps would not go on with its validation
        if self._due(trainer) and not trainer.sanity_checking and not is_over(trainer):
            self._validation_due = True
            self._save(trainer)
            self._validation_due = False

    on_validation_start = on_validation_batch_end = _save_amid_validation

    def _due(self, trainer: Trainer) -> bool:
        # the processes of one training write it together, but their clocks differ
        late = any_process(trainer, time.monotonic() - self._saved_at >= self._pause)
        return late or asked_to_stop(trainer)

    def _save(self, trainer: Trainer) -> None:
        if is_accumulating(trainer):
            self._saved_at = -math.inf  # as soon as the step is complete
            return
        new = self.path.with_name(f"new_{LAST}")
        trainer.save_checkpoint(new, weights_only=False)  # unset, Lightning logs that it is False
        if trainer.is_global_zero:
            if self._whole:
                self.path.replace(self.path.with_name(BEFORE))
            new.replace(self.path)
        self._saved_at, self._whole = time.monotonic(), True


def check_kept(callbacks: Sequence[Callback], folder: Path) -> None:
    """Refuse settings by which a run's checkpoints would not be where its test, `resume=` and
    reports look for them, or it would end while it gets better: now, not after the training.

    Raises:
        UserError: The key, and what it has to be.
    """
    best = [one for one in callbacks if isinstance(one, Best)]
    if not best:
        raise UserError("callbacks.best: is missing; a run is tested on its best checkpoint")
    places = {f"best.dirpath={one.dirpath}": one.dirpath for one in best}
    last = (one.path.parent for one in callbacks if isinstance(one, Last))
    places |= {f"last.dirpath={path}": path for path in last}
    for setting, path in places.items():
        if os.path.realpath(path or "") != os.path.realpath(folder / "checkpoints"):
            raise UserError(
                f"callbacks.{setting}: a run's checkpoints lie in {folder / 'checkpoints'}; out= "
                "names another run's folder"
            )
    for one in best:
        for name, due in _KEPT.items():
            if getattr(one, name) != due:
                raise UserError(f"callbacks.best.{name}={getattr(one, name)}: must be {due}")
        if not str(one.monitor).startswith("val/"):
            raise UserError(
                f"callbacks.best.monitor={one.monitor}: must be a number of the validation, such "
                "as val/score"
            )
        _check_mode(f"callbacks.best.mode={one.mode}", one, "would keep the worst")
    for stop in callbacks:
        if isinstance(stop, EarlyStopping):
            key = f"callbacks.<{type(stop).__name__}>.mode={stop.mode}"
            _check_mode(key, stop, "would end the training for a better")


def _check_mode(setting: str, callback: Best | EarlyStopping, what: str) -> None:
    """Raise UserError where a callback takes the worse of a number for the better."""
    try:
        direction = find_metric(str(callback.monitor)).direction
    except UserError:  # a number of one's own
        return
    better = {HIGHER: "max", LOWER: "min"}.get(direction, callback.mode)
    if better != callback.mode:
        raise UserError(f"{setting}: {what} {callback.monitor}; must be {better}")
