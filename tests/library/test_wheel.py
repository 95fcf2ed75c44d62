"""The wheel holds all that an installed copy needs; `.ci/wheel` runs it."""

import shutil
import subprocess
import sys
import tomllib
import zipfile
from importlib.metadata import version
from pathlib import Path

import pytest

HOME = Path(__file__).parents[2]


def build(source: Path, out: Path) -> set[str]:
    """Build a wheel, and return what is in it."""
    command = [sys.executable, "-m", "pip", "wheel", str(source), "--no-deps", "--quiet"]
    subprocess.run([*command, "--no-build-isolation", "-w", str(out)], check=True)
    (wheel,) = out.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        return set(archive.namelist())


@pytest.fixture(scope="module")
def names(tmp_path_factory: pytest.TempPathFactory) -> set[str]:
    """Build the wheel from a copy of the sources, and return what is in it."""
    pytest.importorskip("setuptools", minversion="69")
    source, out = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("wheel")
    for folder in ("src", "conf", "weights"):
        ignored = shutil.ignore_patterns("*.egg-info", "__pycache__")
        shutil.copytree(HOME / folder, source / folder, ignore=ignored)
    for file in ("setup.py", "pyproject.toml", "MANIFEST.in", "README.md", "LICENSE"):
        shutil.copy(HOME / file, source)
    return build(source, out)


def test_every_file_that_is_read_is_in_the_wheel(names: set[str]) -> None:
    expected = {
        f"posefilter/{file.relative_to(HOME)}"
        for pattern in ("conf/**/*.yaml", "weights/*.ckpt")
        for file in HOME.glob(pattern)
    }
    assert len(expected) > 50
    package = HOME / "src"
    expected |= {
        str(file.relative_to(package))
        for pattern in ("*.py", "py.typed", "templates/*")
        for file in (package / "posefilter").rglob(pattern)
    }
    assert expected <= names


def test_nothing_else_is_installed(names: set[str]) -> None:
    assert {name.split("/")[0] for name in names} == {
        "posefilter",
        f"posefilter-{version('posefilter')}.dist-info",
    }


def test_the_examples_wheel_has_its_choices(tmp_path: Path) -> None:
    pytest.importorskip("setuptools", minversion="69")
    shutil.copytree(HOME / "examples" / "plugin", tmp_path / "source")
    names = build(tmp_path / "source", tmp_path / "out")
    package = HOME / "examples" / "plugin"
    choices = {str(f.relative_to(package)) for f in package.rglob("conf/**/*.yaml")}
    assert len(choices) >= 4
    assert choices <= names


@pytest.mark.parametrize(
    ("system", "machine", "needed"),
    [("linux", "x86_64", True), ("linux", "aarch64", False), ("darwin", "arm64", True)],
)
def test_embree_is_needed_where_it_has_a_package(system: str, machine: str, needed: bool) -> None:
    requirements = pytest.importorskip("packaging.requirements")
    project = tomllib.loads((HOME / "pyproject.toml").read_text())["project"]
    (own,) = [one for one in project["dependencies"] if one.startswith("embreex")]
    marker = requirements.Requirement(own).marker
    assert marker.evaluate({"sys_platform": system, "platform_machine": machine}) == needed


def test_the_container_has_the_torch_that_the_wheel_takes() -> None:
    """Another one would be replaced by that of PyPI, with CUDA."""
    project = tomllib.loads((HOME / "pyproject.toml").read_text())["project"]
    (torch,) = [one for one in project["dependencies"] if one.startswith("torch>")]
    assert f"pip install --no-cache-dir '{torch}' --index-url" in (HOME / "Dockerfile").read_text()
