"""Ctrl-C and SIGTERM: a training stops where it can go on from, with a checkpoint written there."""

import signal
import threading
from types import FrameType
from typing import Any

from lightning import Callback, LightningModule, Trainer

from posefilter.errors import Stopped


class Stop(Callback):
    """Take note of a signal, and stop before the next batch; at a second signal, stop at once.

    Between the two, `Last` writes its checkpoint.
    """

    def __init__(self) -> None:
        self.asked: int | None = None  # the signal that came

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Take the signals over from Lightning, whose own handlers save nothing.

        Lightning puts back those that were there before, when the training ends.
        """
        self._listen()

    def on_test_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Take the signals over."""
        self._listen()

    def on_train_batch_start(self, *_: Any) -> None:
        """Stop here."""
        self._stop()

    def on_validation_batch_start(self, *_: Any) -> None:
        """Stop here."""
        self._stop()

    def on_test_batch_start(self, *_: Any) -> None:
        """Stop here."""
        self._stop()

    def _listen(self) -> None:
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                signal.signal(number, self._note)

    def _note(self, number: int, frame: FrameType | None) -> None:
        if self.asked is not None:
            raise Stopped(number)
        self.asked = number

    def _stop(self) -> None:
        if self.asked is not None:
            raise Stopped(self.asked)


def asked_to_stop(trainer: Trainer) -> bool:
    """Tell whether a trainer's run was told to stop."""
    callbacks: list[Callback] = trainer.callbacks  # type: ignore[attr-defined]
    return any(isinstance(one, Stop) and one.asked is not None for one in callbacks)
