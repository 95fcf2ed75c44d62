"""The table of accuracy against what is read: whose tests are of which choice, and how many pixels
a particle reads.
"""

import json
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest
import torch

from posefilter.geometry.camera import intrinsics
from posefilter.nets.encoders import FoveatedEncoder, NoEncoder, PyramidEncoder
from posefilter.nets.glimpse import BilinearGlimpse


@pytest.fixture
def bench(load_script: Callable[[str], ModuleType]) -> ModuleType:
    """Return the script."""
    return load_script("bench/sparse.py")


def write(folder: Path, checkpoint: Path, *overrides: str) -> None:
    folder.mkdir(parents=True)
    metrics = {"checkpoint": str(checkpoint), "overrides": [*overrides, "console=json"]}
    (folder / "metrics.json").write_text(json.dumps(metrics))


def test_a_test_of_few_particles_is_of_the_choice_of_the_run_that_it_tests(
    bench: ModuleType, tmp_path: Path
) -> None:
    for name in ("foveated", "unet"):
        for seed in range(2):
            run = tmp_path / "runs" / f"{name}{seed}"
            best = run / "checkpoints" / "best.ckpt"
            write(run, best, f"model/encoder={name}", f"seed={seed}")
            write(tmp_path / "few" / run.name, best, "++filter.particles=8")
    narrow = tmp_path / "runs" / "narrow"
    chosen = ("model/encoder=unet", "model.encoder.max_width_px=40")
    write(narrow, narrow / "checkpoints" / "best.ckpt", *chosen)
    trained, few = (bench.find_kinds(tmp_path / part) for part in ("runs", "few"))
    assert [(kind.name, kind.particles, len(kind.runs)) for kind in trained] == [
        ("network over the image", 128, 2),
        ("the same at a quarter of the width", 128, 1),
        ("foveated patches", 128, 2),
    ]
    assert [(kind.name, kind.particles) for kind in few] == [
        ("network over the image", 8),
        ("foveated patches", 8),
    ]
    assert few[1].tests == [tmp_path / "few" / f"foveated{seed}" for seed in range(2)]
    assert few[1].runs == [tmp_path / "runs" / f"foveated{seed}" for seed in range(2)]


def test_pixels_are_counted_once_and_within_the_image(bench: ModuleType) -> None:
    batch = SimpleNamespace(rgb=torch.rand(1, 3, 60, 80))
    camera = intrinsics(100.0, 100.0, 39.5, 29.5)[None]
    state = torch.tensor([[[40.5, 30.5], [40.5, 30.5], [0.0, 0.0], [-9.0, 30.0]]])

    def count(encoder: torch.nn.Module) -> int:
        method = SimpleNamespace(glimpse=BilinearGlimpse(3), encoder=encoder)
        context = encoder(batch.rgb, torch.ones(1, 1, 60, 80), camera)
        steps = [(SimpleNamespace(context=context), state)] * 2
        found: int = bench.count_pixels(method, batch, steps)
        return found

    # between pixels 4 x 4; in the corner 3 x 3, a whole row and column of them beyond the frame,
    # and the samples at whole pixels count their neighbors on one side
    assert count(NoEncoder()) == 16 + 9
    # 10 px apart at 1 m: 5 x 5 around (41, 31), rounded, 3 x 3 in the corner, and of the particle
    # off the frame, at depth of its nearest pixel, columns 1 and 11 at 5 rows; the own patches
    # hold 1 of each of the first two
    fovea = FoveatedEncoder((0.1,), size=5)
    assert count(fovea) == (16 + 25 - 1) + (9 + 9 - 1) + 2 * 5
    assert count(PyramidEncoder(levels=2)) == 60 * 80
