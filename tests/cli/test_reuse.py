"""Which jobs of a sweep learn the same."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from posefilter.cli import reuse
from posefilter.cli.checkpoints import recipe
from posefilter.cli.command import compose_job
from posefilter.cli.job import Job
from posefilter.cli.reuse import learned_from, start_from, take_over
from posefilter.errors import UserError

CONF = Path(__file__).parents[2] / "conf"


@pytest.mark.parametrize(
    ("common", "changed", "same"),
    [
        ([], ["filter.particles=50"], True),
        ([], ["filter/refine=none", "data.limit_test=3", "data.workers=2", "out=elsewhere"], True),
        ([], ["threads=2"], False),  # null is the machine's number
        (["threads=2"], ["filter.particles=50"], True),
        ([], ["train_pixels=32"], False),
        ([], ["seed=1"], False),
        ([], ["trainer.max_steps=7"], False),
        ([], ["data.limit_train=100"], False),
        (["model=patch_pf"], ["filter.particles=50"], False),
        (["model=patch_pf", "model/train_rollout=short"], ["filter/refine=mean_shift"], True),
        (["model=patch_pf", "model/train_rollout=short"], ["filter.particles=50"], False),
    ],
    ids=lambda value: ",".join(value) if isinstance(value, list) else None,
)
def test_training_is_shared_where_no_setting_of_it_differs(
    common: list[str], changed: list[str], same: bool, tmp_path: Path
) -> None:
    """pose_pf scores candidates and rolls out no filter; a short roll-out has as many
    particles.
    """
    changed = [f"model.{c}" if c.startswith("train_pixels") else c for c in changed]
    one = compose_job("train", CONF, common, tmp_path / "one")
    other = compose_job("train", CONF, [*common, *changed], tmp_path / "other")
    assert (learned_from(one) == learned_from(other)) == same


def test_an_interrupted_training_goes_on_where_only_its_test_is_another(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def make_job(*words: str) -> Job:
        return replace(compose_job("train", CONF, list(words), tmp_path), swept=True)

    (tmp_path / "checkpoints").mkdir()
    begun = make_job("data.limit_test=60")
    checkpoint = {"recipe": recipe(begun), "global_step": 7}
    (tmp_path / "checkpoints" / "last.ckpt").touch()
    monkeypatch.setattr(reuse, "read_checkpoint", lambda file: checkpoint)
    assert start_from(begun)[1] == 7
    assert start_from(make_job("data.limit_test=30"))[1] == 7
    with pytest.raises(UserError, match=r"data\.limit_train"):
        start_from(make_job("data.limit_train=9"))


@pytest.mark.parametrize("step", [None, "7", -1, 1 << 70])
def test_weights_alone_are_no_training_to_go_on_with(
    step: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As export.py writes them; or of somebody else, who has put anything there."""
    job = replace(compose_job("train", CONF, [], tmp_path), swept=True)
    checkpoint = {"recipe": recipe(job)} | ({} if step is None else {"global_step": step})
    (tmp_path / "checkpoints").mkdir()
    (tmp_path / "checkpoints" / "last.ckpt").touch()
    monkeypatch.setattr(reuse, "read_checkpoint", lambda file: checkpoint)
    with pytest.raises(
        UserError, match=r"last\.ckpt: is of no training that can go on .* warm_start="
    ):
        start_from(job)


def test_what_another_job_has_learned_comes_without_its_calibration(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is of the other's filter, which the recipe alone says."""
    for name in ("0_a", "1_b"):
        (tmp_path / name / "checkpoints").mkdir(parents=True)
    other = {"state_dict": {}, "recipe": {"settings": {}}, "calibration": {"features": []}}
    torch.save(other, tmp_path / "0_a" / "checkpoints" / "best.ckpt")
    known = {tmp_path / "0_a": {"training": {"learned_from": "this"}}}
    monkeypatch.setattr(reuse, "own_metrics", lambda folder: known.get(folder, {}))
    monkeypatch.setattr(reuse, "learned_from", lambda job: "this")
    monkeypatch.setattr(reuse, "recipe", lambda job: {"settings": {"filter": {"particles": 9}}})
    monkeypatch.setattr(reuse, "differing", lambda a, b: ["filter.particles"])
    monkeypatch.setattr(reuse, "read_checkpoint", lambda file: dict(other))
    job = SimpleNamespace(swept=True, folder=tmp_path / "1_b", cfg=SimpleNamespace(console="json"))
    assert take_over(job) == {"learned_from": "this", "trained_as": "0_a"}  # type: ignore[arg-type]
    kept = torch.load(tmp_path / "1_b" / "checkpoints" / "best.ckpt", weights_only=True)
    assert kept == {
        "state_dict": {},
        "recipe": {"settings": {"filter": {"particles": 9}}},
    }
    monkeypatch.setattr(reuse, "recipe", lambda job: {"settings": {}})  # of the same filter
    assert take_over(job) is not None  # type: ignore[arg-type]
    assert torch.load(tmp_path / "1_b" / "checkpoints" / "best.ckpt", weights_only=True) == other


@pytest.mark.parametrize(
    ("changed", "reason", "seconds"),
    [
        ({"data": {"workers": 2}}, "training does not depend on data.workers, but its best", None),
        ({"logger": {"csv": None}}, "learned; its best", 3.0),
        (
            {"data": {"workers": 2, "limit_test": 3}},
            "training does not depend on data.limit_test, data.workers, but its best",
            None,
        ),
    ],
)
def test_what_is_taken_over_leaves_out_the_speed_of_other_workers(
    changed: dict[str, Any], reason: str, seconds: float | None,
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    """And says on which settings the training does not depend, where there are any."""
    for name in ("0_a", "1_b"):
        (tmp_path / name / "checkpoints").mkdir(parents=True)
    settings: dict[str, Any] = {"data": {"workers": 0}}
    then, now = ({"choices": {}, "settings": one} for one in (settings, settings | changed))
    torch.save({"recipe": then}, tmp_path / "0_a" / "checkpoints" / "best.ckpt")
    known = {"learned_from": "this", "seconds_per_step": 3.0, "cpu_seconds_per_step": 3.0}
    monkeypatch.setattr(reuse, "own_metrics", lambda folder: {"training": known})
    monkeypatch.setattr(reuse, "learned_from", lambda job: "this")
    monkeypatch.setattr(reuse, "recipe", lambda job: now)
    monkeypatch.setattr(reuse, "read_checkpoint", lambda file: {"recipe": then})
    job = SimpleNamespace(swept=True, folder=tmp_path / "1_b", cfg=SimpleNamespace(console="rich"))
    taken = take_over(job)  # type: ignore[arg-type]
    assert taken is not None
    assert [taken[key] for key in ("seconds_per_step", "cpu_seconds_per_step")] == [seconds] * 2
    assert reason in " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize("is_kept", [True, False])
def test_what_is_taken_over_is_of_the_job_that_was_trained(
    is_kept: bool,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """`filter.particles=100` stands before `=50` in the order of names, and holds its weights."""
    checkpoints = {}
    known = {}
    for particles in (50, 100, 1000):
        folder = tmp_path / f"filter.particles={particles}"
        (folder / "checkpoints").mkdir(parents=True)
        (folder / "checkpoints" / "best.ckpt").touch()
        checkpoints[folder / "checkpoints" / "best.ckpt"] = {
            "recipe": {"choices": {}, "settings": {"filter": {"particles": particles}}}
        }
        known[folder] = {"training": {"learned_from": "this"}}
    known[tmp_path / "filter.particles=100"]["training"]["trained_as"] = "filter.particles=50"
    known[tmp_path / "filter.particles=1000"] = {}
    if not is_kept:
        known[tmp_path / "filter.particles=50"] = {}
    now = checkpoints[tmp_path / "filter.particles=1000" / "checkpoints" / "best.ckpt"]["recipe"]
    monkeypatch.setattr(reuse, "own_metrics", lambda folder: known[folder])
    monkeypatch.setattr(reuse, "learned_from", lambda job: "this")
    monkeypatch.setattr(reuse, "recipe", lambda job: now)
    monkeypatch.setattr(reuse, "read_checkpoint", lambda file: dict(checkpoints[file]))
    cfg = SimpleNamespace(console="rich")
    job = SimpleNamespace(swept=True, folder=tmp_path / "filter.particles=1000", cfg=cfg)
    taken = take_over(job)  # type: ignore[arg-type]
    assert taken is not None
    assert taken["trained_as"] == "filter.particles=50"
    said = " ".join(capsys.readouterr().out.split())
    assert "with what filter.particles=50 has learned" in said
    assert said.endswith("was chosen by validations of filter.particles=50")
