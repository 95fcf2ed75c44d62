"""A tiny rendered dataset, made once a test session, and the settings that make a run of any method
tiny.
"""

from pathlib import Path

import pytest

from posefilter.cli.command import compose_job
from posefilter.cli.job import Job
from posefilter.synthetic.generate import generate

HOME = Path(__file__).parents[2]
TINY = ["debug=smoke", "console=json", "threads=1", "logger=none", "data.progress=false"]
SMALL_POSE_PF = [  # pose_pf with a small proposal network and hardly a refinement
    "model.proposals.widths=[16,24,32,32]",
    "filter.refine.components.0.pixels=64",
    "filter.refine.components.1.iterations=1",
]


@pytest.fixture(scope="session")
def tiny_scenes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with 24 frames of the carton in 6 scenes, 160 x 120."""
    out = tmp_path_factory.mktemp("scenes") / "carton"
    size, few = (160, 120), (1, 2)
    generate(
        out,
        24,
        object="carton",
        workers=1,
        size=size,
        distractors=few,
        frames_per_scene=4,
        progress=False,
    )
    return out


@pytest.fixture
def tiny_job(tiny_scenes: Path):  # type: ignore[no-untyped-def]
    """Return a function that composes a tiny training."""

    def compose(folder: Path, *overrides: str) -> Job:
        folder.mkdir(parents=True, exist_ok=True)
        return compose_job(
            "train", HOME / "conf", [*TINY, f"data.root={tiny_scenes}", *overrides], folder
        )

    return compose
