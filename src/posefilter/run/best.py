"""Which checkpoint of a run is tested."""

from lightning import Trainer
from lightning.pytorch.callbacks import ModelCheckpoint
from torch import Tensor


class Best(ModelCheckpoint):
    """Keep the checkpoint of the best validation; of equal ones the latest, which has learned for longest.

    Lightning's own keeps the first. Where nothing finds the object yet all scores are 0, and a run would be tested on what
    it had learned by its first validation.
    """

    def check_monitor_top_k(self, trainer: Trainer, current: Tensor | None = None) -> bool:
        """Tell whether a validation is to be kept."""
        equal = current is not None and self.best_model_score is not None and bool(current == self.best_model_score)
        return trainer.strategy.reduce_boolean_decision(equal) or super().check_monitor_top_k(trainer, current)
