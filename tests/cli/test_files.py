"""Files are whole or not there, and a run goes on from the checkpoint before where the last is
broken.
"""

import os
import resource
import shutil
import signal
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Barrier

import pytest
import torch
from lightning import LightningModule, Trainer
from torch import Tensor, nn
from torch.utils.data import DataLoader

from posefilter.cli.best import Last
from posefilter.cli.files import WholeCheckpoints, save_whole
from posefilter.errors import UserError
from posefilter.files import open_whole


class Small(LightningModule):
    """A module with one weight."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(()))

    def training_step(self, batch: Tensor, index: int) -> Tensor:
        return self.weight.square()

    def configure_optimizers(self) -> torch.optim.Optimizer:
        return torch.optim.SGD(self.parameters(), lr=0.1)


def fit(folder: Path, steps: int, minutes: float | None, start: Path | None = None) -> list[str]:
    """Train without validations; return the files that are there at the end."""
    trainer = Trainer(
        max_steps=steps,
        callbacks=[Last(str(folder), minutes)],
        plugins=WholeCheckpoints(),
        logger=False,
        accelerator="cpu",
        enable_progress_bar=False,
        enable_model_summary=False,
    )
    trainer.fit(Small(), DataLoader([torch.zeros(1)] * 10), ckpt_path=start, weights_only=True)
    return sorted(file.name for file in folder.glob("*"))


def step(file: Path) -> int:
    return int(torch.load(file, weights_only=True)["global_step"])


def test_a_checkpoint_is_written_by_time_too_and_the_one_before_is_kept(tmp_path: Path) -> None:
    assert fit(tmp_path / "never", 3, None) == []
    run = tmp_path / "run"
    assert fit(run, 3, 0.0) == ["last.ckpt", "last.previous.ckpt"]
    assert [step(run / name) for name in ("last.ckpt", "last.previous.ckpt")] == [3, 2]


def test_a_broken_checkpoint_does_not_replace_the_one_before(tmp_path: Path) -> None:
    fit(tmp_path, 3, 0.0)
    (tmp_path / "last.ckpt").write_bytes(b"broken")
    fit(tmp_path, 3, 0.0, start=shutil.copy(tmp_path / "last.previous.ckpt", tmp_path / "it.ckpt"))
    assert step(tmp_path / "last.ckpt") == 3
    assert step(tmp_path / "last.previous.ckpt") == 2


def test_many_small_tensors_are_written_without_gaps(tmp_path: Path) -> None:
    many = {f"tensor_{number}": torch.full((2,), float(number)) for number in range(200)}
    torch.save(many, tmp_path / "plain.ckpt")
    save_whole(many, tmp_path / "whole.ckpt")
    sizes = [(tmp_path / f"{name}.ckpt").stat().st_size for name in ("plain", "whole")]
    assert sizes[0] - sizes[1] > 200 * 20
    kept = torch.load(tmp_path / "whole.ckpt", weights_only=True)
    assert all(torch.equal(kept[name], value) for name, value in many.items())


def test_what_cannot_be_written_whole_leaves_what_was_there(tmp_path: Path) -> None:
    """A process that may write no more than some bytes, as on a full disk."""
    file = tmp_path / "last.ckpt"
    save_whole({"weight": torch.ones(3)}, file)
    many = torch.ones(100_000)  # made here: a fork lacks the threads that torch would wait for
    reader, writer = os.pipe()
    number = os.fork()
    if not number:
        try:
            signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
            resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))
            save_whole({"weight": many}, file)
        except UserError as error:
            os.write(writer, str(error).encode())
        finally:
            os._exit(0)
    os.close(writer)
    with os.fdopen(reader) as said:
        assert said.read() == f"{file}: cannot be written (File too large)"
    os.waitpid(number, 0)
    assert torch.load(file, weights_only=True)["weight"].tolist() == [1, 1, 1]
    assert [path.name for path in tmp_path.iterdir()] == ["last.ckpt"]


def test_two_threads_may_write_one_file(tmp_path: Path) -> None:
    together = Barrier(2)

    def write(content: bytes) -> None:
        with open_whole(tmp_path / "a") as file:
            file.write(content)
            together.wait(20)  # both are open

    with ThreadPoolExecutor(2) as pool:
        list(pool.map(write, [b"one", b"two"]))  # which raises what a thread has raised
    assert (tmp_path / "a").read_bytes() in (b"one", b"two")
    assert [path.name for path in tmp_path.iterdir()] == ["a"]


def test_a_file_that_was_given_up_leaves_nothing(tmp_path: Path) -> None:
    def give_up() -> None:
        with open_whole(tmp_path / "a") as file:
            file.write(b"half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        give_up()
    assert not list(tmp_path.iterdir())
