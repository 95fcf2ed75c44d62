"""End a training on time, with its learning rate fully decayed."""

import time
from typing import Any

from lightning import Callback, Trainer

from posefilter.errors import UserError

# looked up at each call
_CLOCKS = {"wall": lambda: time.perf_counter(), "cpu": lambda: time.process_time()}


class TimeBudget(Callback):
    """Let the learning-rate schedule keep pace with the clock, and stop when the time is up.

    The number of steps is chosen from a measured speed. On a machine that turns out slower, the
    schedule is advanced by more than one step at a time, so that it ends when the time does; a
    validation follows, as after the last step. A schedule that was advanced ends the training, too,
    if the machine becomes faster again: no step can be taken back. The stages of the losses keep
    the same pace (`PoseEstimator.time_spent`). Time of earlier sittings counts.

    Args:
        seconds: For all steps, validations not counted as steps but as time.
        clock: "wall", or "cpu" for the process's own processor time, the sum over its threads: on a
            machine that others use, too, it gives every training as much.
        fewest: Number of steps that are trained even where they take longer than `seconds`.

    Raises:
        UserError: `seconds` is not positive, or there is no such clock.
    """

    def __init__(self, seconds: float, clock: str = "wall", fewest: int = 0) -> None:
        if not seconds > 0:
            raise UserError(f"time budget of {seconds} s: must be positive")
        if clock not in _CLOCKS:
            raise UserError(f"time budget by the clock {clock}: choose {' or '.join(_CLOCKS)}")
        self.seconds, self.clock, self.fewest = seconds, clock, fewest
        self.spent = 0.0  # in earlier sittings [s]
        self.ended = False  # whether its time is up, or the schedule's
        self._began = self.now()

    def now(self) -> float:
        """Return what the clock says [s]."""
        return _CLOCKS[self.clock]()

    @property
    def elapsed(self) -> float:
        """Time of all sittings [s]."""
        return self.spent + self.now() - self._began

    def state_dict(self) -> dict[str, Any]:
        """Return the time that was spent."""
        return {"spent": self.elapsed}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Take over the time of earlier sittings."""
        self.spent = float(state_dict["spent"])

    def on_train_start(self, trainer: Trainer, pl_module: Any) -> None:
        """Start the clock."""
        self._began = self.now()
        pl_module.time_spent = self.spent / self.seconds

    def on_train_batch_end(self, trainer: Trainer, pl_module: Any, *_: Any) -> None:
        """Advance the schedule to where the clock is; stop if the time is up."""
        share = min(1.0, self.elapsed / self.seconds)
        if trainer.global_step < self.fewest:
            share = min(share, trainer.global_step / self.fewest)
        if trainer.world_size > 1:  # their clocks differ, and their weights must not
            share = trainer.strategy.broadcast(share)
        pl_module.time_spent = share
        self.ended = share == 1
        for config in trainer.lr_scheduler_configs:
            scheduler: Any = config.scheduler
            while scheduler.last_epoch < int(share * trainer.max_steps):
                scheduler.step()
            self.ended |= 0 < trainer.max_steps <= scheduler.last_epoch
        if self.ended:
            trainer.should_stop = True
