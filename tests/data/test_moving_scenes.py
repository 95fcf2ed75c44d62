"""Scenes whose frames follow each other: smooth paths, rigid worlds, and a cover for a while."""

import json
import math
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.data.test_scenes import H, K, W, draw
from tests.data.test_scenes import library as library
from tests.data.test_scenes import scene as scene

from posefilter.data.readers.registry import open_reader
from posefilter.data.sequences import SceneVideo, list_scenes
from posefilter.errors import UserError
from posefilter.synthetic.generate import generate
from posefilter.synthetic.motion import (
    MotionSettings,
    Scenario,
    draw_path,
    draw_scenario,
    is_possible,
)
from posefilter.synthetic.placing import View
from posefilter.synthetic.scenes import SceneSet, SceneSettings

TEXTURE = np.full((8, 8, 3), 90, np.uint8)
SETTINGS: dict[str, Any] = {
    "object": "carton",
    "seed": 2,
    "size": (160, 120),
    "distractors": (2, 4),
    "frames_per_scene": 14,
    "moving": "both",
    "fully_occluded_frames": 2,
    "workers": 1,
    "progress": False,
}


def test_a_path_is_smooth_and_as_fast_as_is_asked() -> None:
    paths = [draw_path(48, 8.0, 2.0, np.random.default_rng(seed)) for seed in range(200)]
    assert all((path[0] == 0).all() for path in paths)
    steps = np.diff(np.stack(paths), axis=1)
    shift = np.sqrt((steps[..., :3] ** 2).sum(-1).mean())
    turn = np.sqrt((steps[..., 3:] ** 2).sum(-1).mean())
    assert shift == pytest.approx(0.008, rel=0.05)
    assert math.degrees(turn) == pytest.approx(2, rel=0.05)
    bends = np.diff(steps, axis=1)  # of a sine of 16 frames at most 0.39 of the step
    assert np.sqrt((bends**2).mean()) < 0.39 * np.sqrt((steps**2).mean())


def draw_one(scene: SceneSet, moves: str, tabletop: float) -> Scenario:
    settings = SceneSettings(tabletop_fraction=tabletop, max_occlusion=0.3)
    rng, view = np.random.default_rng(1), View(K, H, W)
    for layout in draw(scene, settings, 12):
        found = draw_scenario(layout, MotionSettings(moves, 4.0, 1.0), 12, TEXTURE, rng)
        if is_possible(found, view, settings.largest_truncation):
            return found
    raise AssertionError("no path was possible")


def poses_of(scenario: Scenario, frame: int) -> np.ndarray:
    return np.stack([one.camera_from_object for one in scenario.at(frame).placed])


def test_a_moving_camera_leaves_the_world_rigid(scene: SceneSet) -> None:
    found = draw_one(scene, "camera", 1.0)
    first, last = poses_of(found, 0), poses_of(found, 11)
    assert np.array_equal(first, np.stack([p.camera_from_object for p in found.layout.placed]))
    assert np.abs(first - last).max() > 0.005
    motion = last @ np.linalg.inv(first)
    assert np.allclose(motion, motion[0], atol=1e-9)
    ends = [found.at(frame) for frame in (0, 11)]
    for one, other in zip(ends[0].planes, ends[1].planes, strict=True):
        assert np.allclose(motion[0] @ one.camera_from_plane, other.camera_from_plane)
    lights = [np.array(one.lights.directions) for one in ends]
    assert np.allclose(lights[0] @ motion[0, :3, :3].T, lights[1])


@pytest.mark.parametrize("tabletop", [0.0, 1.0])
def test_a_moving_object_leaves_all_else_where_it_is(scene: SceneSet, tabletop: float) -> None:
    found = draw_one(scene, "object", tabletop)
    first, last = poses_of(found, 0), poses_of(found, 11)
    assert np.array_equal(first[1:], last[1:])
    assert np.abs(first[0] - last[0]).max() > 0.005
    if tabletop:  # it slides, and turns about the table's normal
        up = found.layout.planes[0].camera_from_plane[:3, 2]
        centers = [found.at(frame).placed[0].center for frame in (0, 11)]
        assert up @ (centers[1] - centers[0]) == pytest.approx(0, abs=1e-9)
        assert np.allclose(last[0, :3, :3].T @ up, first[0, :3, :3].T @ up)


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("moving") / "scenes"
    assert generate(out, 14, **SETTINGS).rendered == 14
    return out


def test_a_sequence_is_read_in_its_order_and_hides_the_object_for_a_while(sequence: Path) -> None:
    records = sorted((sequence / "mixed/scene0000_0").glob("[0-9]*.json"))
    shares = [
        next(one for one in json.loads(path.read_text())["objects"] if "carton" in one["class"])
        for path in records
    ]
    seen = [one["visibility"] for one in shares]
    assert [n for n, share in enumerate(seen) if share == 0] == [6, 7]
    assert min(seen[:3] + seen[-3:]) > 0.2
    places = np.array([one["location"] for one in shares])  # [cm]
    steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
    assert 0.05 < np.sqrt((steps**2).mean()) < 3
    reader = open_reader("fat", sequence)
    (scene,) = list_scenes(reader)
    frames = list(SceneVideo(reader, scene, ["carton"]))
    assert [frame.im_id for frame in frames] == list(range(14))
    assert [n for n, frame in enumerate(frames) if not frame.truth] == [6, 7]


def test_a_frame_of_a_sequence_does_not_depend_on_the_others(
    sequence: Path, tmp_path: Path
) -> None:
    shutil.copytree(sequence, tmp_path / "again")
    folder = tmp_path / "again" / "mixed/scene0000_0"
    before = {path.name: path.read_bytes() for path in folder.glob("000009.*")}
    assert len(before) == 4
    for name in before:
        (folder / name).unlink()
    assert generate(tmp_path / "again", 14, **SETTINGS).rendered == 1
    assert {path.name: path.read_bytes() for path in folder.glob("000009.*")} == before


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"moving": "spin"}, "moving=spin: unknown; choose from none, camera, object, both"),
        ({"moving": "none"}, "fully_occluded_frames: frames that follow each other are needed"),
        ({"fully_occluded_frames": 99}, "fully_occluded_frames=99: a scene has 14 frames only"),
        ({"moving_mm": -1.0}, "moving_mm=-1"),
        ({"moving_mm": 900.0}, "no layout and path keep carton in view"),
    ],
)
def test_impossible_motions_end_in_one_line(
    tmp_path: Path, change: dict[str, Any], message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("posefilter.synthetic.frame_renderer.ATTEMPTS", 3)
    with pytest.raises(UserError, match=message) as caught:
        generate(tmp_path / "out", 1, **{**SETTINGS, **change})
    assert "\n" not in str(caught.value)
