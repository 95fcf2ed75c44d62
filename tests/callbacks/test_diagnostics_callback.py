"""The callback must draw what the run did, and keep quiet where it does not apply."""

import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import torch
from PIL import Image

sys.path.insert(0, str(Path(__file__).parents[1] / "models"))
from toy import scenes

from posefilter.callbacks.diagnostics import (
    LISTS,
    NUMBERS,
    Diagnostics,
    draw_diagnostics,
    has_pixel_particles,
)
from posefilter.figures.canvas import AXES
from posefilter.geometry.spaces import PixelSpace
from posefilter.metrics.diagnostics import FilterDiagnostics
from posefilter.models.base import Trained
from posefilter.types import BeliefBatch, ParticleOutput, Particles, Step, Trace


def trace(steps: int = 3) -> Trace:
    g = torch.Generator().manual_seed(0)
    state = torch.rand(2, 20, 2, generator=g) * 40
    even = torch.full((2, 20), -3.0)
    pose = torch.eye(4).expand(2, 20, 4, 4)
    history = tuple(
        Particles(state + 30 * t, torch.zeros(2, 20, 0), even, torch.arange(20).expand(2, 20))
        for t in range(steps)
    )
    outputs = tuple(
        ParticleOutput(even, torch.full((2, 20, 2), 30.0), pose, torch.zeros(2, 20, 0))
        for _ in range(steps)
    )
    belief = BeliefBatch(pose, even, pose[:, 0], even[:, 0])
    return Trace(
        history, outputs, tuple(Step(t, steps, torch.tensor(0.0)) for t in range(steps)), belief
    )


def test_drift_is_seen_in_numbers_curves_and_files(tmp_path: Path) -> None:
    batch, run = scenes(2), trace()
    logged: dict[str, float] = {}
    logger = SimpleNamespace(log_metrics=lambda values, step: logged.update(values))
    trainer = SimpleNamespace(
        loggers=[logger], global_step=7, sanity_checking=False, is_global_zero=True
    )
    signs = FilterDiagnostics()
    signs.update(run, batch)
    hull = torch.zeros(4, 3)
    method = SimpleNamespace(
        scores={"diagnostics": signs},
        space=PixelSpace(),
        object_model=SimpleNamespace(hull=hull),
        trained=Trained(7, 0),
    )
    callback = Diagnostics(tmp_path, images=1)
    callback.on_validation_epoch_start(trainer, method)  # type: ignore[arg-type]
    callback.on_validation_epoch_end(trainer, method)  # type: ignore[arg-type]
    callback.on_test_batch_end(trainer, method, run, batch, 0)  # type: ignore[arg-type]
    callback.on_test_epoch_end(trainer, method)  # type: ignore[arg-type]
    assert logged["diagnostics/off_frame/last"] > 0.9
    assert logged["diagnostics/on_object/last"] == 0
    files = sorted(path.name for path in tmp_path.iterdir())
    assert files == [
        "test_animation_0.gif",
        "test_diagnostics.jpg",
        "test_trajectories_0.jpg",
        "validation_diagnostics.jpg",
    ]
    with Image.open(tmp_path / "test_animation_0.gif") as animation:
        assert animation.n_frames == 5  # three clouds, two frames from one to the next
    picture = draw_diagnostics(signs.compute(), "signs")
    red = np.argwhere((picture == AXES[0]).all(-1) & (np.arange(len(picture)) < 360)[:, None])
    # off the frame, at last: nearly all, at the top
    assert red[red[:, 1] > red[:, 1].max() - 3][:, 0].mean() < 110
    green = np.argwhere((picture == AXES[1]).all(-1) & (np.arange(len(picture)) < 400)[:, None])
    assert green[green[:, 1] > green[:, 1].max() - 3][:, 0].mean() > 340  # on the object: none


def test_particles_that_coincide_have_no_line_to_draw() -> None:
    shares = {name: [0.5, 0.5] for name in LISTS}
    numbers = dict.fromkeys(NUMBERS, 0.5)
    violet = LISTS["first_axis_share"]
    for values, drawn in (([0.9, 0.9], True), ([0.9, float("nan")], False)):
        picture = draw_diagnostics(shares | numbers | {"first_axis_share": values}, "signs")
        assert bool((picture == violet).all(-1).any()) is drawn


def test_methods_on_poses_are_left_alone(tmp_path: Path) -> None:
    run = trace()
    poses = run._replace(
        particles=tuple(c._replace(state=torch.eye(4).expand(2, 20, 4, 4)) for c in run.particles)
    )
    assert has_pixel_particles(run)
    assert not has_pixel_particles(poses)
    callback = Diagnostics(tmp_path)
    trainer = SimpleNamespace(loggers=[], global_step=0, sanity_checking=False, is_global_zero=True)
    callback.on_test_batch_end(trainer, None, poses, scenes(2), 0)  # type: ignore[arg-type]
    callback.on_validation_epoch_end(trainer, SimpleNamespace(scores={}))  # type: ignore[arg-type]
    assert not list(tmp_path.iterdir())
