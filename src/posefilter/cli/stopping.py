"""When a training stops: after its last step, which is validated, too; and at Ctrl-C or SIGTERM
where it can go on from, with a checkpoint written there.
"""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

from lightning import Callback, Trainer

from posefilter.errors import Stopped


class FinalValidation(Callback):
    """Validate after the step that ends a training, too: Lightning validates at multiples of
    `val_check_interval` alone, so that the best checkpoint could hold no later step. Epochs that
    `check_val_every_n_epoch` leaves out stay without.
    """

    def on_train_start(self, trainer: Trainer, *_: Any) -> None:
        """Do no more where a run goes on from the validation after its last batch: Lightning, which
        had none planned there, would begin another.
        """
        if is_over(trainer) and not is_validated(trainer):
            _stop(trainer)

    def on_train_batch_end(self, trainer: Trainer, *_: Any) -> None:
        """Stop at the last step, as Lightning would by itself; before a stop it validates."""
        if is_over(trainer):
            _stop(trainer)


def _stop(trainer: Trainer) -> None:
    loop = trainer.fit_loop
    # the last epoch counts as done only later: it would hold up the stop, and its validation
    loop.min_epochs = loop.epoch_loop.min_steps = None
    trainer.should_stop = True


class Stop(Callback):
    """Take note of a signal, and stop after a batch; at a second signal, stop at once.

    A signal is acted on at the end of a batch, where `Last`, which comes after this, writes its
    checkpoint; the next batch is not begun. Where gradients are accumulated it is the batch that
    completes a step. There the processes of one training agree on it, since
    a signal reaches them at different steps, and one that stopped alone would leave the others
    waiting for it.
    """

    def __init__(self) -> None:
        self.asked: int | None = None  # the signal that came
        self.agreed: int | None = None  # the one that all processes stop for
        self._waits = False  # for the end of a step

    def _listen(self, *_: Any, **__: Any) -> None:
        # Lightning's own handlers save nothing; it puts back those before when the training ends
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                signal.signal(number, self._note)

    def _note(self, number: int, frame: FrameType | None) -> None:
        if self.asked is not None:
            raise Stopped(number)
        self.asked = number

    def _agree(self, trainer: Trainer, *_: Any, **__: Any) -> None:
        if any_process(trainer, self.asked is not None):
            self.agreed = self.asked or signal.SIGTERM

    def on_train_batch_end(self, trainer: Trainer, *_: Any) -> None:
        """Agree on a signal; note whether the step is complete."""
        self._agree(trainer)
        self._waits = is_accumulating(trainer)

    def on_train_batch_start(self, *_: Any) -> None:
        """Stop, unless the batch belongs to a step that has begun."""
        if not self._waits:
            self._stop()

    def _stop(self, *_: Any, **__: Any) -> None:
        if self.agreed is not None:
            raise Stopped(self.agreed)

    on_sanity_check_start = on_train_start = on_test_start = _listen
    on_validation_batch_start = _stop
    on_validation_start = on_validation_batch_end = _agree

    def on_test_batch_start(self, *_: Any) -> None:
        """Stop at once: a test has no checkpoint to write, and no other process waits for it."""
        if self.asked is not None:
            raise Stopped(self.asked)


@contextmanager
def stopped_by_interrupt() -> Iterator[None]:
    """Raise Stopped where Lightning has made an exit with status 1 of a Ctrl-C, as it does before
    `Stop` listens.
    """
    try:
        yield
    except SystemExit as ended:
        if isinstance(ended.__context__, KeyboardInterrupt):
            raise Stopped(signal.SIGINT) from ended
        raise


def is_over(trainer: Trainer) -> bool:
    """Tell whether a training has had its last batch, by its steps or by its epochs."""
    by_steps = 0 < trainer.max_steps <= trainer.global_step
    epochs = trainer.max_epochs or -1
    return by_steps or (trainer.is_last_batch and 0 < epochs <= trainer.current_epoch + 1)


def is_validated(trainer: Trainer) -> bool:
    """Tell whether a validation follows the batch that a training is at."""
    loop = trainer.fit_loop
    assert loop._data_fetcher is not None
    return loop.epoch_loop._should_check_val_fx(loop._data_fetcher)


def is_accumulating(trainer: Trainer) -> bool:
    """Tell whether gradients of the last batches wait for those of others: no checkpoint has them,
    so that a run that went on from here would lose them.
    """
    several = trainer.accumulate_grad_batches > 1
    return several and trainer.fit_loop.epoch_loop._should_accumulate()


def asked_to_stop(trainer: Trainer) -> bool:
    """Tell whether all processes of a trainer's run are about to stop."""
    callbacks: list[Callback] = trainer.callbacks  # type: ignore[attr-defined]
    return any(isinstance(one, Stop) and one.agreed is not None for one in callbacks)


def any_process(trainer: Trainer, decision: bool) -> bool:
    """Tell whether any process of a training decides so; each has to ask, at the same place."""
    if trainer.world_size == 1:
        return decision
    return bool(trainer.strategy.reduce_boolean_decision(decision, all=False))
