"""Frames as torch sees them: an indexable dataset, and a shuffle that depends on (seed, epoch)
alone.
"""

import atexit
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING
from weakref import WeakSet

import numpy as np
import torch
from numpy.random import Generator
from torch.utils.data import DataLoader, Dataset, Sampler

from posefilter.data.cache import FrameCache
from posefilter.data.frames import FrameRecord, Sample
from posefilter.data.readers.checked import check_augmented
from posefilter.errors import UserError
from posefilter.types import Batch

if TYPE_CHECKING:
    from posefilter.data.augmentation import Augment


def to_batch(sample: Sample) -> Batch:
    """Return a sample as tensors, with no batch dimension: the default collate adds it."""
    return Batch(
        rgb=torch.from_numpy(np.ascontiguousarray(sample.rgb.transpose(2, 0, 1))).float() / 255,
        depth=torch.from_numpy(sample.depth.astype(np.float32, copy=False))[None],
        mask=torch.from_numpy(sample.mask.astype(bool, copy=False))[None],
        intrinsics=torch.from_numpy(sample.intrinsics.astype(np.float32)),
        camera_from_object=torch.from_numpy(sample.camera_from_object.astype(np.float32)),
        object_id=torch.tensor(sample.object_id, dtype=torch.int64),
        frame_id=torch.tensor(sample.frame_id, dtype=torch.int64),
        visibility=torch.tensor(sample.visibility, dtype=torch.float32),
    )


class FrameDataset(Dataset[Batch]):
    """The frames of one split.

    Augmentation of sample i draws from a generator of (seed, epoch, i): whatever the workers, the
    order or the batch.
    """

    def __init__(
        self,
        records: Sequence[FrameRecord],
        cache: FrameCache,
        augment: "Augment | None" = None,
        seed: int = 0,
    ) -> None:
        self.records, self._cache, self._augment, self._seed = list(records), cache, augment, seed
        # workers that persist must see it change
        self._epoch = torch.zeros((), dtype=torch.int64).share_memory_()

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.records)

    def __getitem__(self, i: int) -> Batch:
        """Return frame i, augmented where the split is."""
        sample = self.sample(i)
        if self._augment is not None:
            rng = np.random.default_rng([self._seed, int(self._epoch), i])
            sample = check_augmented(self._augment(sample, self._draw, rng), sample)
        return to_batch(sample)

    def sample(self, i: int) -> Sample:
        """Return frame i as it is."""
        return self._cache.load(self.records[i], i)

    def sizes(self) -> dict[tuple[int, ...], str]:
        """Return the (height, width) of its images, each with the name of one that has it."""
        kept = [self._cache.find(record) for record in self.records]
        one_of_each: dict[tuple[int, ...], int] = {
            one.shape: i for i, one in enumerate(kept) if one is not None
        }
        if len(one_of_each) > 1:
            # augmentation may cut them to one size, or fail where it draws one of another size
            with suppress(Exception):
                one_of_each = {tuple(self[i].rgb.shape[1:]): i for i in one_of_each.values()}
        return {size: self.records[i].name for size, i in one_of_each.items()}

    def find_batch_size(self, most: int) -> int:
        """Return how many images a batch may have: so many, or one where they differ in size."""
        return most if len(self.sizes()) < 2 else 1

    def set_epoch(self, epoch: int) -> None:
        """Choose the epoch whose augmentation is drawn."""
        self._epoch.fill_(epoch)

    def _draw(self, rng: Generator) -> Sample:
        """Return some frame of the split: occluders are cut from it."""
        return self.sample(int(rng.integers(len(self))))


class EpochShuffle(Sampler[int]):
    """Shuffle by (seed, epoch).  Lightning tells samplers the epoch; this one passes it on.

    Args:
        length: Number of frames.
        seed: Decides the orders.
        tell: Given each epoch.
        rank: Of this process, if several train together: each has its own frames of an epoch, and
            as many as the others.
        processes: How many train together.

    Raises:
        UserError: There are fewer frames than processes.
    """

    def __init__(
        self, length: int, seed: int, tell: Callable[[int], None], rank: int = 0, processes: int = 1
    ) -> None:
        if length == 0:
            raise UserError(
                "no training frames are left: see data.split, data.min_visibility and data.object"
            )
        if length < processes:
            raise UserError(f"trainer.devices={processes}: there are only {length} training frames")
        self._length, self._seed, self._tell, self._epoch = length, seed, tell, 0
        self._rank, self._processes = rank, processes
        self._skip = 0

    def __len__(self) -> int:
        """Return the number of frames of this process."""
        return self._length // self._processes

    def __iter__(self) -> Iterator[int]:
        """Yield the epoch's order."""
        rng = np.random.default_rng([self._seed, self._epoch, 1 << 20])
        order = rng.permutation(self._length).tolist()
        skip, self._skip = self._skip, 0
        own = order[self._rank :: self._processes][: len(self)]
        return iter(own[skip:])

    def skip(self, frames: int) -> None:
        """Leave out the first frames of the next epoch: a run that was cut short has seen them."""
        self._skip = frames

    def set_epoch(self, epoch: int) -> None:
        """Choose the epoch."""
        self._epoch = epoch
        self._tell(epoch)


class ResumableLoader(DataLoader[Batch]):
    """A loader that knows how many batches it has given; Lightning keeps that in checkpoints, and
    hands it back.

    Attributes:
        batches: That an epoch takes of it; None: all.
    """

    batches: int | None = None
    _given = 0
    _start = 0

    def __iter__(self) -> Iterator[Batch]:  # type: ignore[override]
        """Yield the epoch's batches; those that follow the last one given, where the loader was
        handed its state.
        """
        start, self._start = self._start, 0
        if isinstance(self.sampler, EpochShuffle):
            self.sampler.skip(start * int(self.batch_size or 1))
            self._given = start
        _ITERATED.add(self)
        try:
            for batch in super().__iter__():
                self._given += 1
                yield batch
        except Exception as error:
            self.end_workers()
            message = _find_mistake_of_worker(error)
            if not message:
                raise
            raise UserError(message) from error

    def end_workers(self) -> None:
        """End the processes, if there are any; the next epoch starts others.

        Where the loader is left to Python's collector of cycles, as an error's traceback is part
        of, their queues are closed before they are told to end, and they stay.
        """
        if self._iterator is not None:
            self._iterator._shutdown_workers()  # type: ignore[attr-defined]
            self._iterator = None

    def state_dict(self) -> dict[str, int]:
        """Return how far the epoch is."""
        return {"given": self._given}

    def load_state_dict(self, state: dict[str, int]) -> None:
        """Go on from there; after a whole epoch, from the start of the next."""
        self._start = state["given"] % max(self.batches or len(self), 1)


def _find_mistake_of_worker(error: Exception) -> str:
    """Return the message of a mistake in a loader's process, "" for other errors.

    Torch hands its traceback on as a message, by a RuntimeError where it cannot make such an error.
    """
    lines = str(error).splitlines() or [""]
    is_workers = lines[0].startswith("Caught ") and "worker process" in lines[0]
    kind, _, message = lines[-1].partition(": ")
    own = isinstance(error, UserError | OSError) or (
        isinstance(error, RuntimeError) and kind.startswith("posefilter.")
    )
    return message if is_workers and own else ""


_ITERATED: WeakSet[ResumableLoader] = WeakSet()


@atexit.register
def _end_workers() -> None:
    """End the workers of loaders that are still referred to.

    Multiprocessing would tell each once to terminate, which they leave to their parent, and wait.
    """
    for loader in _ITERATED:
        loader.end_workers()
