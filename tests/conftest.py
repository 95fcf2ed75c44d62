"""Fixtures shared by every test."""

import os
from pathlib import Path

import pytest
import torch


@pytest.fixture(autouse=True)
def seeded() -> None:
    """Let every test draw the same numbers each time, and whatever ran before it."""
    torch.manual_seed(0)


@pytest.fixture(scope="session")
def real_data() -> Path:
    """Return the folder of real frames and meshes, or skip: users of the project do not have it."""
    root = Path(os.environ.get("POSEFILTER_DATA", Path(__file__).parents[2] / "shared" / "data"))
    if not root.is_dir():
        pytest.skip(f"no real data at {root}: set POSEFILTER_DATA to a folder with ycb/, ycbv/ and fat/")
    return root
