"""Sweeps by Hydra's launchers come to the same bits as one job after another; Slurm, which is
stood in for by three scripts, is asked for what was typed.
"""

import csv
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from tests.smoke.conftest import HOME, TINY

LAUNCHERS = {
    "joblib": ["hydra.launcher.n_jobs=2"],
    "submitit_local": ["hydra.launcher.timeout_min=10"],
    "submitit_slurm": [
        "hydra.launcher.partition=gpu", "hydra.launcher.gpus_per_node=1",
        "hydra.launcher.cpus_per_task=8", "hydra.launcher.timeout_min=240",
    ],
}  # fmt: skip
ASKED = {  # of a script that Slurm gets, by the settings above
    "--array=0-1%2", "--partition=gpu", "--gpus-per-node=1", "--cpus-per-task=8", "--time=240",
    "--nodes=1", "--ntasks-per-node=1",
}  # fmt: skip
SBATCH = """#!/bin/bash
# keeps the script, and runs its two tasks one after another
cp "${@: -1}" FOLDER/script
(
  for task in 0 1; do
    export SLURM_JOB_ID=7 SLURM_ARRAY_JOB_ID=7 SLURM_ARRAY_TASK_ID=$task SLURM_JOB_NUM_NODES=1
    export SLURM_NTASKS=1 SLURM_PROCID=0 SLURM_LOCALID=0 SLURM_NODEID=0
    export SLURM_JOB_NODELIST=here SLURM_NODELIST=here
    bash FOLDER/script
  done
) > FOLDER/log 2>&1 < /dev/null &
echo "Submitted batch job 7"
"""
SRUN = """#!/bin/bash
while [[ $1 == -* ]]; do
  if [[ $1 == --output || $1 == --error ]]; then shift; fi
  shift
done
exec "$@"
"""
SACCT = """#!/bin/bash
printf 'JobID|State|NodeList\\n7_0|RUNNING|here\\n7_1|RUNNING|here\\n'
"""


def sweep(out: Path, data: Path, more: list[str], path: str = "") -> None:
    typed = [*TINY, f"data.root={data}", "model=cnn_patch", "callbacks=checkpoints"]
    typed += ["trainer.max_steps=2", "trainer.val_check_interval=2", "data.limit_test=2"]
    command = [sys.executable, str(HOME / "train.py"), "-m", *typed, "seed=0,1", *more]
    done = subprocess.run(
        [*command, f"out={out}"],
        capture_output=True,
        text=True,
        timeout=250,
        env={**os.environ, "PATH": f"{path}{os.environ['PATH']}"},
    )
    assert done.returncode == 0, done.stderr


def read_weights(out: Path) -> list[dict[str, torch.Tensor]]:
    """Return the weights of each job, in the order of the summary."""
    with (out / "summary.csv").open() as file:
        rows = sorted(csv.DictReader(file), key=lambda row: row["seed"])
    assert [row["seed"] for row in rows] == ["0", "1"]
    files = [out / row["folder"] / "checkpoints" / "best.ckpt" for row in rows]
    return [torch.load(file, weights_only=True)["state_dict"] for file in files]


@pytest.fixture(scope="module")
def one_after_another(
    tiny_scenes: Path, tmp_path_factory: pytest.TempPathFactory
) -> list[dict[str, torch.Tensor]]:
    out = tmp_path_factory.mktemp("sweep") / "sweep"
    sweep(out, tiny_scenes, [])
    return read_weights(out)


@pytest.mark.slow
@pytest.mark.parametrize("launcher", LAUNCHERS)
def test_a_launcher_changes_no_bit(
    launcher: str,
    tiny_scenes: Path,
    tmp_path: Path,
    one_after_another: list[dict[str, torch.Tensor]],
) -> None:
    pytest.importorskip(f"hydra_plugins.hydra_{launcher.partition('_')[0]}_launcher")
    if launcher == "submitit_slurm":
        for name, text in (("sbatch", SBATCH), ("srun", SRUN), ("sacct", SACCT)):
            (tmp_path / name).write_text(text.replace("FOLDER", str(tmp_path)))
            (tmp_path / name).chmod(0o755)
    more = [f"hydra/launcher={launcher}", *LAUNCHERS[launcher]]
    sweep(tmp_path / "sweep", tiny_scenes, more, f"{tmp_path}:")
    found = read_weights(tmp_path / "sweep")
    for one, other in zip(found, one_after_another, strict=True):
        assert one.keys() == other.keys()
        assert all(torch.equal(value, other[key]) for key, value in one.items())
    assert not all(torch.equal(value, found[1][key]) for key, value in found[0].items())
    if launcher == "submitit_slurm":
        lines = (tmp_path / "script").read_text().splitlines()
        asked = {line.removeprefix("#SBATCH ") for line in lines if line.startswith("#SBATCH ")}
        assert asked >= ASKED
        (call,) = [line for line in lines if line.startswith("srun ")]
        assert "submitit.core._submit" in call
