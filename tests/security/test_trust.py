"""Plug-ins: trusted by the user, and by nobody else."""

import re
import sys
from pathlib import Path
from typing import Any

import pytest
from omegaconf import OmegaConf

from posefilter.cli import command, run_command, running, trust
from posefilter.cli.instantiate import instantiate, instantiate_recipe, locate
from posefilter.errors import UserError

HOME = Path(__file__).parents[2]
SOURCE = """
import os
from torch.nn import Linear
class Own:
    def __init__(self, size: int = 1) -> None:
        self.size = size
def make(size: int = 2) -> Own:
    return Own(size)
"""


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    (tmp_path / "my_plugin").mkdir()
    (tmp_path / "my_plugin" / "__init__.py").write_text("")
    (tmp_path / "my_plugin" / "pieces.py").write_text(SOURCE)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(trust, "_trusted", set())
    for name in ("my_plugin", "my_plugin.pieces"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    return "my_plugin"


def test_what_a_trusted_package_defines_is_built(package: str) -> None:
    node = {"_target_": "my_plugin.pieces.Own", "size": 3}
    for build in (instantiate, instantiate_recipe):
        with pytest.raises(UserError, match="plugins="):
            build(node, "loss")
    assert package not in sys.modules
    trust.trust(package)
    assert instantiate(node, "loss").size == instantiate_recipe(node, "loss").size == 3
    assert instantiate({"_target_": "my_plugin.pieces.make"}, "loss").size == 2
    with pytest.raises(UserError, match=r"did you mean 'Own'"):
        instantiate({"_target_": "my_plugin.pieces.Owm"}, "loss")


@pytest.mark.parametrize(
    "name", ["my_plugin.pieces.os.system", "my_plugin.pieces.Linear", "my_plugin_two.x.Own"]
)
def test_what_it_imports_is_not(name: str, package: str) -> None:
    trust.trust(package)
    with pytest.raises(UserError):
        locate(name, "loss")


def test_what_it_imports_from_itself_is_told_by_its_own_name(package: str, tmp_path: Path) -> None:
    source = "from my_plugin.pieces import Own, make\nOther = Own\nthing = Own()\n"
    (tmp_path / package / "__init__.py").write_text(source)
    trust.trust(package)
    for name, own in {"Own": "Own", "make": "make", "Other": "Own"}.items():
        told = rf"^loss\._target_=my_plugin\.{name}: is defined as my_plugin\.pieces\.{own}; name"
        with pytest.raises(UserError, match=told):
            locate(f"my_plugin.{name}", "loss")
    with pytest.raises(UserError, match="there is no 'thing' defined in my_plugin"):
        locate("my_plugin.thing", "loss")


@pytest.mark.parametrize(
    "name", ["os", "subprocess", "torch", "posefilter.cli", "not a name", "", "../x"]
)
def test_some_packages_cannot_be_plug_ins(name: str, package: str) -> None:
    with pytest.raises(UserError, match="plugins="):
        trust.trust(name)
    assert trust.trusted() == {*trust.installed()}


@pytest.mark.parametrize("name", ["my_plugni", "nowhere_at_all.inside", "my_plugin.nothing"])
def test_a_package_that_is_not_there_is_told_at_once(name: str, package: str) -> None:
    with pytest.raises(UserError, match=f"^plugins={name}: there is no package '{name}'"):
        trust.trust(name)
    trust.trust("my_plugin.pieces")
    assert trust.named() == {"my_plugin.pieces"}
    assert "my_plugin.pieces" not in sys.modules


def test_an_installed_entry_point_is_trusted(package: str, monkeypatch: pytest.MonkeyPatch) -> None:
    class Point:
        name, value = "own", "my_plugin"

    trust.installed.cache_clear()
    monkeypatch.setattr(
        trust, "entry_points", lambda group: [Point()] if group == "posefilter.plugins" else []
    )
    assert trust.is_plugin("my_plugin.pieces.Own")
    trust.installed.cache_clear()


def test_the_command_line_names_them(
    package: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    for wanted, told in (
        (["nowhere_at_all"], "there is no package"),
        (["os"], "of your own"),
        (7, "must be a list"),
    ):
        with pytest.raises(UserError, match=told):
            running.use_plugins(OmegaConf.create({"plugins": wanted}))
    report = [f"run={tmp_path}/none", "plugins=[my_plugin]", "console=json"]
    assert run_command("report", HOME, report) == 2
    assert len(capfd.readouterr().err.strip().splitlines()) == 1
    assert "my_plugin" in trust.trusted()
    assert "my_plugin" in sys.modules


def test_every_target_of_the_configuration_is_allowed_and_located() -> None:
    files = (HOME / "conf").rglob("*.yaml")
    names = {
        name
        for file in files
        for name in re.findall(r"_target_: *[\"']?([\w.]+)", file.read_text())
    }
    names -= {
        "posefilter.cli.sweeps.SweepSummary",
        "posefilter.cli.folders.KeepResults",
    }  # that Hydra builds itself
    assert len(names) > 80
    for name in names:
        assert callable(locate(name, "x"))


def test_a_recipe_does_not_keep_them(package: str, tmp_path: Path) -> None:
    from posefilter.cli.checkpoints import recipe

    job = command.compose_job("train", HOME / "conf", ["plugins=[my_plugin]"], tmp_path)
    settings: dict[str, Any] = recipe(job)["settings"]
    assert "plugins" not in settings
    assert "my_plugin" not in str(settings)
