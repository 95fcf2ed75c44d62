"""Which checkpoint of a run is tested, and which one it goes on from."""

import os
from pathlib import Path
from typing import Any

from lightning import Trainer
from lightning.pytorch.callbacks import ModelCheckpoint
from torch import Tensor


class Last(ModelCheckpoint):
    """Lightning's own; of the files that a checkpoint says it replaces, it believes in those of its
    own folder alone.

    Lightning deletes them, so that a foreign checkpoint could name any file.
    """

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Take over what a checkpoint says of the files that were kept."""
        kept = {
            str(path): score
            for path, score in dict(state_dict.get("best_k_models") or {}).items()
            if self._own(path)
        }
        paths = {
            key: state_dict.get(key, "") if self._own(state_dict.get(key)) else ""
            for key in ("best_model_path", "last_model_path", "kth_best_model_path")
        }
        super().load_state_dict({**state_dict, **paths, "best_k_models": kept})

    def _own(self, path: Any) -> bool:
        """Tell whether a path is that of a checkpoint in the folder that this run writes to."""
        if not (isinstance(path, str) and path and self.dirpath) or Path(path).suffix != ".ckpt":
            return False
        return os.path.realpath(Path(path).parent) == os.path.realpath(self.dirpath)


class Best(Last):
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
