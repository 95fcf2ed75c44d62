"""Validate after the last step of a training."""

from typing import Any

from lightning import Callback, Trainer


class FinalValidation(Callback):
    """Validate after the step that ends a training, too: Lightning validates at multiples of
    `val_check_interval` alone, so that the best checkpoint could hold no later step.
    """

    def on_train_batch_end(self, trainer: Trainer, *_: Any) -> None:
        """Stop at the last step, as Lightning would by itself; before a stop it validates."""
        if 0 < trainer.max_steps <= trainer.global_step:
            trainer.should_stop = True
