"""`--help` shows a command's own settings and choices on a page, from the files as they stand."""

from pathlib import Path

import pytest
from tests.cli.conftest import Cold

from posefilter.cli.command import register_resolvers, run_command
from posefilter.cli.main import COMMANDS
from posefilter.cli.usage import describe_command, list_groups

CONF = Path(__file__).parents[2] / "conf"


@pytest.fixture(autouse=True)
def _width(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "100")
    register_resolvers()


@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_is_described_on_a_page(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_command(name, arguments=["--help"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) <= (70 if name == "train" else 45)
    assert max(map(len, lines)) <= 100
    assert lines[0].startswith(f"{name}: ")
    assert any(line.strip().startswith("console=") for line in lines)


def test_every_choice_of_a_training_is_listed() -> None:
    shown = describe_command("train", CONF).replace("[", "").replace("]", "").split()
    files = [file for file in CONF.rglob("*/*.yaml") if not file.name.startswith("_")]
    for file in files:
        group = file.parent.relative_to(CONF).as_posix()
        if group != "trainer" and not group.startswith("preset/"):
            assert group in shown, group
            assert file.stem in shown, file
    assert "[pose_pf]" in describe_command("train", CONF)  # the default is marked
    for listed in list_groups("train", [CONF]):
        own = [file for file in files if file.parent == CONF / listed.name]
        if not str(listed.choices[-1]).startswith("..."):  # too many to be listed
            assert {file.stem for file in own} <= {*listed.choices}, listed.name


def test_what_is_listed_is_what_is_typed() -> None:
    shown = describe_command("report", CONF)
    assert "sweep=null" in shown
    assert "sweep_folder" not in shown


def test_the_variants_are_told_apart() -> None:
    shown = " ".join(describe_command("train", CONF).split())
    assert "variant paper [working] (paper: as published; working: with" in shown


def test_only_what_a_command_has_is_listed() -> None:
    shown = describe_command("predict", CONF)
    assert "filter/refine" in shown
    assert "depth_scale=10000" in shown
    assert "loss" not in shown.split()
    assert "model" not in shown.split()


@pytest.mark.parametrize("name", COMMANDS)
def test_weights_are_named_as_they_are_found_outside_of_a_clone_too(name: str) -> None:
    assert "weights/" not in describe_command(name, CONF).replace("out=weights/", "")


def test_what_is_right_and_what_an_error_does_can_be_told() -> None:
    for name in ("predict", "evaluate"):
        assert "pose_tolerance.add_s" in describe_command(name, CONF)
    for name in ("track", "convert_bag"):
        shown = " ".join(describe_command(name, CONF).split())
        assert "on_error=raise raise ends at a" in shown
        assert "skip leaves it out" in shown
    assert "least standard deviation of a frame's motion" in describe_command("track", CONF)


def test_a_folder_of_ones_own_adds_its_choices(tmp_path: Path) -> None:
    (tmp_path / "loss").mkdir()
    (tmp_path / "loss" / "brier.yaml").write_text("_target_: mine.Brier\n")
    typed = ["--config-dir", str(tmp_path), "--help"]
    assert "brier" in describe_command("train", CONF, typed).split()
    assert "brier" not in describe_command("train", CONF).split()


def test_torch_is_not_imported_for_it(cold: Cold, tmp_path: Path) -> None:
    code = (
        "import sys; from posefilter.cli.command import run_command;"
        "sys.exit(run_command('train', arguments=['--help']) or 'torch' in sys.modules)"
    )
    assert cold.run(code, tmp_path).returncode == 0
