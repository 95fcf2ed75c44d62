"""What the author of a plug-in gets wrong is told in one line, and what he typed is told again."""

import sys
from pathlib import Path

import pytest

from posefilter.cli import run_command, trust
from posefilter.cli.command import compose_job
from posefilter.cli.fit import check_fit
from posefilter.cli.trust import Scope
from posefilter.errors import UserError

HOME = Path(__file__).parents[2]
CONF = HOME / "conf"
METHOD = """
from posefilter.models.patch_pf import PatchPF
class OwnScore(PatchPF):
    pass
class Misspelt:
    requires = ("pixelspace",)
class Text:
    provides = "rollout"
"""


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the folder of a plug-in that is trusted."""
    folder = tmp_path / "site" / "ownpf"
    folder.mkdir(parents=True)
    (folder / "__init__.py").write_text("")
    (folder / "method.py").write_text(METHOD)
    (folder / "broken.py").write_text("import ownpf.method\n1 / 0\n")
    monkeypatch.syspath_prepend(folder.parent)
    monkeypatch.setattr(trust, "_trusted", {"ownpf"})
    for name in ("ownpf", "ownpf.method", "ownpf.broken", "ownpf.loss"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    return folder


TARGETS = {
    "ownpf.method.OwnScor": ("no 'OwnScor' defined in ownpf.method", "did you mean 'OwnScore'?"),
    "ownpf.metod.OwnScore": ("no module ownpf.metod", "did you mean 'ownpf.method'?"),
    "ownpf.broken.OwnScore": ("ownpf.broken could not be imported", "division by zero"),
    "posefilter.models.patch_pf.PatchP": ("no 'PatchP' defined", "did you mean 'PatchPF'?"),
}


@pytest.mark.parametrize("scope", Scope)
@pytest.mark.parametrize("target", TARGETS)
def test_a_class_that_is_not_there_is_told_before_what_does_not_fit(
    target: str, scope: Scope, package: Path, tmp_path: Path
) -> None:
    job = compose_job("train", CONF, ["model=patch_pf", f"model._target_={target}"], tmp_path)
    with pytest.raises(UserError) as told:
        check_fit(job.cfg, job.choices, scope)
    assert f"model._target_={target}" in str(told.value)
    assert "\n" not in str(told.value)
    for words in TARGETS[target]:
        assert words in str(told.value)
    own, there = target.startswith("ownpf"), "imported" in TARGETS[target][0]
    renamed = own and scope is Scope.RECIPE and not there
    assert ("was it renamed after the checkpoint?" in str(told.value)) is renamed


def test_a_draft_that_is_not_chosen_is_left_out(
    package: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    own = tmp_path / "own" / "loss"
    own.mkdir(parents=True)
    (own / "draft.yaml").write_text("_target_: ownpf.loss.NotWritten\n")
    (own / "strange.yaml").write_text("_target_: some.body.Elses\n")
    (own / "unreadable.yaml").write_text("_target_: [\n")
    typed = ["--config-dir", str(own.parent), "model=pose_pf", "loss=add", f"out={tmp_path}/run"]
    assert run_command("train", HOME, [*typed, "console=json"]) == 2
    (said,) = capfd.readouterr().err.strip().splitlines()
    assert "loss=add does not fit model=pose_pf" in said
    assert said.endswith("choose loss=contrastive")


@pytest.mark.parametrize(
    ("name", "told"),
    {
        "Misspelt": "ownpf.method.Misspelt.requires: there is no capability 'pixelspace'; did you "
        "mean 'pixel_space'?",
        "Text": "ownpf.method.Text.provides='rollout': must be a tuple, such as provides = "
        "('rollout',)",
    }.items(),
)
def test_a_capability_that_is_none_is_told(
    name: str, told: str, package: Path, tmp_path: Path
) -> None:
    job = compose_job("train", CONF, ["model=patch_pf"], tmp_path)
    job.cfg.loss = {"_target_": f"ownpf.method.{name}"}
    with pytest.raises(UserError) as error:
        check_fit(job.cfg, job.choices, Scope.CONFIG)
    assert str(error.value) == told
