"""The console command: the same commands by another name; a mistake is told before torch is
imported.
"""

import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from tests.cli.conftest import Cold

import posefilter
from posefilter.cli.command import run_command
from posefilter.cli.main import COMMANDS, main
from posefilter.cli.ranks import STARTED, is_follower
from posefilter.cli.running import finish_wandb
from posefilter.errors import MISTAKE

HOME = Path(__file__).parents[2]
# what takes seconds to import, and is not needed to refuse a setting
HEAVY = ("torch", "lightning", "torchmetrics", "matplotlib", "scipy", "cv2", "trimesh")
REFUSED = {
    "train filter.particels=5": "filter.particels: there is no such setting; did you mean",
    "train model=pose_fp": "model=pose_fp: there is no such choice; did you mean",
    "train data=fat data.root=nowhere": "data.root=nowhere: no such folder",
    "train resume=nowhere": "resume=nowhere: not a run's folder",
    "train seed=many": "seed=many: must be a whole number",
    "train plugins=[no_such_package]": "there is no package 'no_such_package'",
    "train plugins=[no_such_package] loss=mine": "there is no package 'no_such_package'",
    "evaluate checkpoint=nowhere.ckpt": "checkpoint=nowhere.ckpt: no such file",
    "evaluate checkpoint=[003_cracker_box,025_mug]": "checkpoint=[003_cracker_box,025_mug]: "
    "evaluate takes one; give them one by one, in a sweep: -m checkpoint=A,B",
    "export checkpoint=all": "checkpoint=all: export takes one; give them one by one",
    "evaluate estimates=nowhere.csv": "estimates=nowhere.csv: no such file",
    "predict": "checkpoint: is missing",
    "predict checkpoint=003_cracker_box": "rgb: is missing",
    "predict checkpoint=003_cracker_box rgb=a.png depth=b.png intrinsics=1,1,1,1": "rgb=a.png: no",
    "predict checkpoint=003_cracker_box rgb=a depth=b intrinsics=no.json": "intrinsics=no.json: no "
    "such file",
    "track checkpoint=003_cracker_box frames=. intrinsics=1,2,3": "intrinsics=[1, 2, 3]: expected "
    "four numbers, fx,fy,cx,cy",
    "predict checkpoint=003_cracker_box rgb=. depth=. intrinsics=1,1,1,1": "rgb=.: is a folder; "
    "predict takes one image, and track frames=DIR a folder of them",
    "evaluate estimates=.": "estimates=.: is a folder",
    "track": "checkpoint: is missing; give checkpoint=RUN/checkpoints/best.ckpt, or a name such as",
    "track checkpoint=003_cracker_box frames=nowhere intrinsics=1,1,1,1": "frames=nowhere: no such",
    "track checkpoint=[003_cracker_box,nowhere.ckpt]": "checkpoint=nowhere.ckpt: no such file",
    "generate meshes=nowhere": "meshes=nowhere: no such folder",
    "check_data meshes=nowhere": "meshes=nowhere: no such folder",
    "onboard": "mesh: is missing; name an .obj, .ply or .glb file",
    "onboard mesh=nowhere.obj": "mesh=nowhere.obj: no such file",
    "report run=nowhere": "run=nowhere: no such folder",
    "export checkpoint=999_nothing": "no weights of that name (002_master_chef_can, "
    "003_cracker_box",
    "export checkpoint=weights/025_mug.ckpt": "did you mean checkpoint=025_mug?",
    "export checkpoint=003_cracker_box": "out: is missing; name the file to write",
    "fly": "fly: there is no such command; choose train, evaluate",
}
OWN = {**os.environ, "PYTHONPATH": str(HOME / "src")}  # wherever it is started
_PROGRAM = """
import sys
from posefilter.cli.main import main
status = main({arguments!r}.split())
heavy = set({heavy!r}) & set(sys.modules)
assert status == 2, status
assert not heavy, heavy
"""


@pytest.mark.parametrize("arguments", REFUSED)
def test_a_mistake_is_one_line_before_torch_is_imported(
    arguments: str, cold: Cold, tmp_path: Path
) -> None:
    done = cold.run(_PROGRAM.format(arguments=arguments, heavy=HEAVY), tmp_path)
    assert done.returncode == 0, done.stderr
    lines = done.stderr.splitlines()
    assert len(lines) == 1
    assert REFUSED[arguments] in lines[0]
    assert done.stdout == ""


def test_commands_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    for arguments in ([], ["--help"]):
        assert main(arguments) == 0
        lines = capsys.readouterr().out.splitlines()
        assert [line.split()[0] for line in lines[1:]] == list(COMMANDS)
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"posefilter {posefilter.__version__}\n"
    assert main(["predict", "--version"]) == 0  # and not Hydra's
    assert capsys.readouterr().out == f"posefilter {posefilter.__version__}\n"


@pytest.mark.parametrize(
    ("line", "told"),
    [
        ("posefilter pre", "predict"),
        ("posefilter train model=pose", "model=pose_pf"),
        ("posefilter train model/prop", "model/proposals="),
        ("posefilter predict depth_s", "depth_scale="),
    ],
)
def test_a_shell_completes_what_is_typed(
    line: str, told: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COMP_LINE", line)
    assert main(["-sc", "query=bash"]) == 0
    assert told in capsys.readouterr().out.split()


def test_bash_completes_a_script(tmp_path: Path) -> None:
    """As docs/architecture.md says, with the function that Hydra writes for it."""
    program = (
        f"cd {HOME}; PATH={Path(sys.executable).parent}:$PATH\n"
        'eval "$(python train.py -sc install=bash)"\n'
        'COMP_LINE="python train.py model=pose"; COMP_POINT=${#COMP_LINE}; COMP_CWORD=2\n'
        'hydra_bash_completion; echo "${COMPREPLY[@]}"'
    )
    done = subprocess.run(
        ["bash", "-c", program], env=OWN, capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == ["model=pose_pf"]


def test_each_command_has_its_script_and_its_settings() -> None:
    for name in COMMANDS:
        script = (HOME / f"{name}.py").read_text()
        assert f'run_command("{name}")' in script
        assert len(script.splitlines()) <= 12
        assert (HOME / "conf" / f"{name}.yaml").is_file()


def test_a_command_says_something_before_torch_is_imported(cold: Cold, tmp_path: Path) -> None:
    """The first line of a report, which fails later: its folder holds no run."""
    program = (
        "import sys\n"
        "class Out:\n"
        "    def write(self, text):\n"
        "        assert 'torch' not in sys.modules or not text.startswith('report: starting')\n"
        "        sys.stderr.write(text)\n"
        "    def flush(self): pass\n"
        "sys.stdout = Out()\n"
        "from posefilter.cli.main import main\n"
        f"main(['report', 'run={tmp_path}'])\n"
    )
    done = cold.run(program, tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stderr.splitlines()[0] == "report: starting"


def test_another_process_of_a_training_goes_on_with_its_command(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Lightning starts it with the settings alone."""
    ran: list[tuple[str, list[str]]] = []
    monkeypatch.setattr(
        "posefilter.cli.command.run_command",
        lambda name, arguments: ran.append((name, arguments)) or 0,
    )
    monkeypatch.setenv("POSEFILTER_COMMAND", "train")
    assert main(["seed=1"]) == MISTAKE  # the first process, typed so
    monkeypatch.setattr("posefilter.cli.main.is_follower", lambda: True)
    for words in (["seed=1", "out=x"], ["-m", "seed=1,2"]):
        assert main(words) == 0
    assert ran == [("train", ["seed=1", "out=x"]), ("train", ["-m", "seed=1,2"])]


@pytest.mark.parametrize(
    ("variables", "follower"),
    [
        ({}, False),
        ({"RANK": "3"}, False),
        ({"SLURM_PROCID": "2", "SLURM_NTASKS": "1"}, False),
        ({"SLURM_PROCID": "2", "SLURM_NTASKS": "4"}, True),
        ({"SLURM_PROCID": "0", "SLURM_NTASKS": "4"}, False),
        ({"RANK": "1", "LOCAL_RANK": "0", "WORLD_SIZE": "2"}, True),
    ],
)
def test_a_number_alone_makes_no_process_of_several(
    variables: dict[str, str], follower: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("RANK", "LOCAL_RANK", "WORLD_SIZE", "SLURM_PROCID", "SLURM_NTASKS"):
        monkeypatch.delenv(name, raising=False)
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    assert is_follower.__wrapped__() is follower


def test_a_command_that_is_no_training_works_in_the_first_of_several_processes_alone(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    typed = ["predict", "checkpoint=none.ckpt", "rgb=a.png", "depth=a.png", "intrinsics=1,1,1,1"]
    assert main(typed) == MISTAKE
    assert "none.ckpt" in capfd.readouterr().err
    monkeypatch.setattr("posefilter.cli.command.is_follower", lambda: True)
    assert main(typed) == MISTAKE
    told = capfd.readouterr().err
    assert told.startswith("predict: this is one of several processes")
    assert len(told.splitlines()) == 1


def test_a_job_of_wandb_ends_with_its_job(monkeypatch: pytest.MonkeyPatch) -> None:
    finished: list[bool] = []
    wandb = SimpleNamespace(run=None, finish=lambda: finished.append(True))
    finish_wandb()  # not imported
    monkeypatch.setitem(sys.modules, "wandb", wandb)  # type: ignore[arg-type]
    finish_wandb()
    assert not finished
    wandb.run = "a run"
    finish_wandb()
    assert finished == [True]


def test_a_command_leaves_the_environment_as_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for before in (None, "evaluate"):
        if before is not None:
            monkeypatch.setenv(STARTED, before)
        assert run_command("report", HOME, [f"run={tmp_path / 'nowhere'}"]) == MISTAKE
        assert os.environ.get(STARTED) == before


def test_a_tolerance_without_a_probability_is_refused(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "poses.csv").write_text("")
    typed = [
        f"estimates={tmp_path / 'poses.csv'}",
        "pose_tolerance.add=0.2",
        f"out={tmp_path / 'o'}",
    ]
    assert run_command("evaluate", HOME, typed) == MISTAKE
    assert "pose_tolerance: is of a checkpoint's probability" in capfd.readouterr().err


def test_of_a_changed_filter_it_is_said_why_there_is_no_probability(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    typed = ["checkpoint=003_cracker_box", "filter.particles=50", "pose_tolerance.add=0.2"]
    assert run_command("evaluate", HOME, [*typed, f"out={tmp_path / 'o'}"]) == MISTAKE
    (line,) = capfd.readouterr().err.splitlines()
    assert line.endswith("to be within one: the checkpoint was calibrated for another filter")
