"""What is built in Python, in a Trainer of the caller's own."""

import pickle
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from lightning import Trainer
from tests.smoke.conftest import SMALL_POSE_PF, TINY

import posefilter
from posefilter.cli.choices import list_choices
from posefilter.data.module import PoseDataModule
from posefilter.models.base import PoseEstimator
from posefilter.paths import find_conf
from posefilter.types import Trace

Pair = tuple[PoseEstimator, PoseDataModule]


@pytest.fixture(scope="module")
def pair(tiny_scenes: Path) -> Callable[[str], Pair]:
    """Return a function that builds a method of a name, and the data that it learns.

    The object's halves are parts, which one method needs.
    """

    def build(model: str) -> Pair:
        words = [f"model={model}", f"data.root={tiny_scenes}", "data.limit_test=2", *TINY]
        config = posefilter.compose([*words, *(SMALL_POSE_PF if model == "pose_pf" else [])])
        data = posefilter.build_data(config)
        data.prepare_data()
        data.setup("fit")
        whole = data.object_to_learn()
        left = whole.points[:, 0] < whole.center[0]
        parts = {"left": whole.points[left], "right": whole.points[~left]}
        method = posefilter.build(config)
        method.set_object(whole._replace(parts=parts))
        return method, data

    return build


def make_trainer(folder: Path, **settings: Any) -> Trainer:
    return Trainer(
        default_root_dir=folder,
        logger=False,
        accelerator="cpu",
        enable_progress_bar=False,
        enable_model_summary=False,
        **settings,
    )


@pytest.mark.parametrize("model", list_choices(find_conf() / "model"))
def test_a_trainer_predicts(model: str, pair: Callable[[str], Pair], tmp_path: Path) -> None:
    """It moves what each method found to the CPU, whatever that is made of."""
    found = make_trainer(tmp_path).predict(*pair(model))
    assert found is not None
    assert all(isinstance(one, Trace) for one in found)
    assert sum(len(one.belief.best) for one in found) == 2  # type: ignore[union-attr]


def test_what_a_trainer_has_trained_is_pickled(pair: Callable[[str], Pair], tmp_path: Path) -> None:
    """With the data, which know the trainer, and all that it has made."""
    method, data = pair("cnn_patch")
    make_trainer(tmp_path, max_steps=1, limit_val_batches=1).fit(method, data)
    again = pickle.loads(pickle.dumps(data))
    assert again.split_record() == data.split_record()
    assert type(again.trainer.lightning_module) is type(method)
    weights = again.trainer.lightning_module.state_dict()
    assert all(torch.equal(value, weights[key]) for key, value in method.state_dict().items())


def test_a_method_that_detects_is_read_back(pair: Callable[[str], Pair], tmp_path: Path) -> None:
    """Of what a trainer of one's own has written; its class alone does not know its settings."""
    method, data = pair("cnn_patch")
    trainer = make_trainer(tmp_path, max_steps=1, limit_val_batches=1)
    trainer.fit(method, data)
    file = tmp_path / "own.ckpt"
    trainer.save_checkpoint(file, weights_only=False)
    again = posefilter.load_method(file)
    assert type(again) is type(method)
    assert again.object_model.name == "carton"
    weights = again.state_dict()
    assert all(torch.equal(value, weights[key]) for key, value in method.state_dict().items())
    with pytest.raises(posefilter.UserError, match=r"own\.ckpt: .*posefilter\.load_method"):
        type(method).load_from_checkpoint(file, weights_only=True)
    trainer = make_trainer(tmp_path / "more", max_steps=2, limit_val_batches=1)
    trainer.fit(again.train(), data, ckpt_path=file, weights_only=True)
    assert trainer.global_step == 2


def test_what_was_trained_with_a_compiled_network_is_read_back(
    pair: Callable[[str], Pair], tmp_path: Path
) -> None:
    """`torch.compile` has the names of its weights in the checkpoint begin with another."""
    method, data = pair("cnn_patch")
    plain = {*method.state_dict()}
    method.encoder = torch.compile(method.encoder, backend="eager")
    trainer = make_trainer(tmp_path, max_steps=1, limit_val_batches=0)
    trainer.fit(method, data)
    trainer.save_checkpoint(tmp_path / "own.ckpt", weights_only=False)
    assert {*method.state_dict()} != plain
    again = posefilter.load_method(tmp_path / "own.ckpt").state_dict()
    assert {*again} == plain
    for key, value in method.state_dict().items():
        assert torch.equal(value, again[key.replace("_orig_mod.", "")])


def test_a_fit_that_goes_on_for_longer_than_its_schedule_is_refused(
    pair: Callable[[str], Pair], tmp_path: Path
) -> None:
    method, data = pair("cnn_patch")
    method.make_scheduler = partial(torch.optim.lr_scheduler.OneCycleLR, max_lr=1e-3)
    trainer = make_trainer(tmp_path, max_steps=2, limit_val_batches=0)
    trainer.fit(method, data)
    file = tmp_path / "own.ckpt"
    trainer.save_checkpoint(file, weights_only=False)

    def go_on(steps: int) -> None:
        again = make_trainer(tmp_path / "more", max_steps=steps, limit_val_batches=0)
        again.fit(method, data, ckpt_path=file, weights_only=True)

    go_on(2)
    with pytest.raises(posefilter.UserError, match=r"^trainer\.max_steps=3: .* ends after 2, "):
        go_on(3)


@pytest.mark.parametrize("precision", ["bf16-mixed", "64-true"])
def test_a_precision_that_blurs_poses_is_refused_in_python_too(
    precision: Any, pair: Callable[[str], Pair], tmp_path: Path
) -> None:
    trainer = make_trainer(tmp_path, max_steps=1, precision=precision)
    for run in (trainer.fit, trainer.validate, trainer.test, trainer.predict):
        with pytest.raises(
            posefilter.UserError, match=rf"^trainer\.precision={precision}: .*32-tr"
        ):
            run(*pair("cnn_patch"))
