"""Layouts keep their promises: things rest on tables, keep apart, and stand in front of the target
when asked.
"""

import json
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from posefilter.errors import UserError
from posefilter.geometry.rotation import fibonacci_sphere
from posefilter.meshes.mesh import Mesh
from posefilter.meshes.store import MeshStore
from posefilter.rendering.embree import EmbreeRenderer
from posefilter.synthetic import scenes
from posefilter.synthetic.generate import camera_matrix, generate
from posefilter.synthetic.lookalikes import box, make_lookalike
from posefilter.synthetic.placing import View
from posefilter.synthetic.scenes import (
    Layout,
    SceneSet,
    SceneSettings,
    SolidStore,
    draw_layout,
    draw_scene_set,
    shift_camera,
)
from posefilter.synthetic.solids import find_stable_rotations, make_solid, rotation_down, separated

H, W = 240, 320
K = camera_matrix("ycb_video", W, H)
SIDES = np.array([0.07, 0.16, 0.21])
BLANK = [np.zeros((4, 4, 3), np.uint8)] * 6


@pytest.fixture(scope="module")
def library() -> SolidStore:
    return SolidStore(MeshStore("builtin"))


@pytest.fixture(scope="module")
def scene(library: SolidStore) -> SceneSet:
    return draw_scene_set(library, "carton", SceneSettings(), np.random.default_rng(0))


def draw(scene: SceneSet, settings: SceneSettings, count: int, seed: int = 0) -> list[Layout]:
    out, rng = [], np.random.default_rng(seed)
    for _ in range(20 * count):
        layout = draw_layout(scene, settings, K, H, W, rng)
        if layout is not None:
            out.append(layout)
        if len(out) == count:
            return out
    raise AssertionError(f"only {len(out)} layouts of {20 * count} draws worked out")


def test_a_box_rests_on_its_six_faces_and_nowhere_else() -> None:
    rests, weights = find_stable_rotations(box("box", SIDES, BLANK).vertices)
    down = -rests[:, 2, :]
    assert len(down) == 6
    assert weights.sum() == pytest.approx(1)
    np.testing.assert_allclose(np.sort(np.abs(down), axis=1), np.tile([0, 0, 1], (6, 1)), atol=0.01)
    assert {tuple(d) for d in np.round(down)} == {tuple(s * e) for e in np.eye(3) for s in (1, -1)}
    flat = weights[np.abs(down[:, 0]) > 0.9].sum()
    upright = weights[np.abs(down[:, 2]) > 0.9].sum()
    assert flat > 3 * upright  # a tossed box ends on its widest faces


def test_a_tall_box_can_stand_although_a_tossed_one_seldom_does() -> None:
    """As a box of sugar, whose foot is narrow and whose sides are a little rounded."""
    hull = fibonacci_sphere(3000)
    hull = np.sign(hull) * np.abs(hull) ** 0.15 * (0.0245, 0.047, 0.088)
    rests, weights = find_stable_rotations(hull)
    down = -rests[:, 2, :]
    (standing,) = np.flatnonzero(down[:, 2] < -0.99)
    assert 0 < weights[standing] < 0.03
    tilted = -rotation_down(np.array([0.0, -0.8, -0.6]))[2]  # a frame in which it does not stand
    rests, _ = find_stable_rotations(hull @ rotation_down(tilted).T)
    assert (rests[:, 2, 2] < 0.99).all()


def test_turn_down_turns_down() -> None:
    for d in (*np.eye(3), *-np.eye(3), np.array([0.6, 0, 0.8])):
        R = rotation_down(d)
        np.testing.assert_allclose(R @ d, [0, 0, -1], atol=1e-9)
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-9)
        assert np.linalg.det(R) == pytest.approx(1)


def test_separated_never_calls_overlapping_boxes_apart() -> None:
    rng = np.random.default_rng(1)
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) / 2
    apart = 0
    for _ in range(300):
        turn = Rotation.random(rng=rng).as_matrix()
        shift = rng.normal(0, 1.2, 3)
        a, b = corners * SIDES, corners * SIDES * rng.uniform(0.5, 1.5) @ np.eye(3) + shift * SIDES
        # exact: axis-aligned before both are turned
        overlap = ((a.min(0) < b.max(0)) & (b.min(0) < a.max(0))).all()
        said = separated(a @ turn.T, b @ turn.T)
        assert not (said and overlap)
        apart += said
    assert apart > 100  # nor does it always say no


def test_objects_rest_on_the_table_keep_apart_and_stay_on_it(scene: SceneSet) -> None:
    for layout in draw(scene, SceneSettings(tabletop_fraction=1.0), 12):
        table = layout.planes[0]
        top_from_camera = np.linalg.inv(table.camera_from_plane)
        for k, one in enumerate(layout.placed):
            on_top = one.hull @ top_from_camera[:3, :3].T + top_from_camera[:3, 3]
            assert abs(on_top[:, 2].min()) < 1e-6
            center = top_from_camera[:3, :3] @ one.center + top_from_camera[:3, 3]
            assert k == 0 or (np.abs(center[:2]) < table.half_extent).all()
            R = one.camera_from_object[:3, :3]
            np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-9)
            assert np.linalg.det(R) == pytest.approx(1)
            assert all(separated(one.hull, other.hull) for other in layout.placed[:k])
        eye_height = top_from_camera[2, 3]
        assert eye_height > 0.02  # the camera looks down on the table
        assert (
            layout.planes[1].camera_from_plane[:3, 2] @ table.camera_from_plane[:3, 2]
        ) == pytest.approx(1)


def test_numbers_of_distractors_are_kept_and_no_class_comes_twice(scene: SceneSet) -> None:
    for layout in draw(scene, SceneSettings(distractors=(3, 4)), 15):
        names = [one.solid.mesh.name for one in layout.placed]
        assert names[0] == "carton"
        assert 4 <= len(names) <= 5
        assert len(set(names)) == len(names)


def visible_shares(layouts: list[Layout]) -> np.ndarray:
    renderer, out = EmbreeRenderer(), []
    for layout in layouts:
        seen = renderer.surfaces(layout.instances(), K, H, W)
        out.append((seen.index == 0).sum() / max(seen.unoccluded[0], 1))
        depth, _ = renderer.depth(layout.instances()[:1], K, H, W)
        hidden = (depth > 0) & (seen.index > 0)
        # whatever hides the target lies in front of it
        assert (seen.depth[hidden] <= depth[hidden]).all()
    return np.array(out)


@pytest.mark.parametrize("tabletop", [0.0, 1.0])
def test_occluders_stand_in_front_when_asked(scene: SceneSet, tabletop: float) -> None:
    asked = visible_shares(
        draw(scene, SceneSettings(occluded_fraction=1.0, tabletop_fraction=tabletop), 24)
    )
    free = visible_shares(
        draw(scene, SceneSettings(occluded_fraction=0.0, tabletop_fraction=tabletop), 24)
    )
    assert ((asked > 0.2) & (asked < 0.65)).mean() > 0.6
    assert (free > 0.6).mean() > 0.85
    assert np.median(free) > np.median(asked) + 0.25


def test_without_occlusion_nothing_hides_the_target(scene: SceneSet) -> None:
    layouts = draw(scene, SceneSettings(max_occlusion=0.0, occluded_fraction=0.0), 10)
    # the foreseen outlines are coarse; the generator rejects the rest
    assert visible_shares(layouts).min() > 0.85


def test_the_predicted_visibility_is_near_the_rendered_one(scene: SceneSet) -> None:
    layouts = draw(scene, SceneSettings(occluded_fraction=0.6), 20)
    foreseen = np.array([View(K, H, W).visible(list(layout.placed)) for layout in layouts])
    assert np.median(np.abs(foreseen - visible_shares(layouts))) < 0.06


@pytest.mark.parametrize("own_texture", [False, True])
def test_lookalikes_have_the_targets_texture_only_if_wanted(
    own_texture: bool, library: SolidStore
) -> None:
    """Neither as it is, nor with its channels swapped or inverted; all differ from the target."""
    target = library.store.load("carton")
    sides = target.bounds[1] - target.bounds[0]
    shapes, alike = set(), 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        other = make_lookalike(target, "lookalike_00", [], rng, own_texture)
        assert other.name == "lookalike_00"
        shapes.add(len(other.faces))
        if _has_texture(other, target):
            alike += 1
            reshaped = np.abs((other.bounds[1] - other.bounds[0]) / sides - 1).max() > 0.1
            assert reshaped or (other.texture != target.texture).any()
        np.testing.assert_allclose(np.linalg.norm(other.corner_normals, axis=-1), 1, atol=1e-4)
    assert shapes == {len(target.faces), 12}  # stretched ones and boxes
    assert (alike > 8) if own_texture else (alike == 0)


def _has_texture(mesh: Mesh, target: Mesh) -> bool:
    """Return whether a mesh has the target's texture, be its channels swapped or inverted."""
    if mesh.texture.shape != target.texture.shape:
        return False
    known = _channels(target.texture)
    both = (mesh.texture, 255 - mesh.texture)
    return any(np.abs(_channels(texture) - known).max() < 0.5 for texture in both)


def _channels(texture: np.ndarray) -> np.ndarray:
    """Return the means of the least, the middle and the largest channel: (3,)."""
    return np.asarray(np.sort(texture.reshape(-1, 3), axis=1).mean(0))


def test_lookalike_texture_is_checked_and_recorded(tmp_path: Path) -> None:
    with pytest.raises(
        UserError, match="lookalike_texture=none: unknown; choose different or same"
    ):
        generate(tmp_path / "a", 1, object="carton", lookalike_texture="none")
    render = partial(
        generate, tmp_path / "b", 1, object="carton", size=(96, 72), workers=1, progress=False
    )
    render()
    with pytest.raises(UserError, match=r"begun with other settings \(lookalike_texture\)"):
        render(lookalike_texture="same")
    with pytest.raises(UserError, match=r"other settings \(frames_per_scene, moving, moving_mm\)"):
        render(moving="camera", moving_mm=3.0)
    with pytest.raises(UserError, match=r"other settings \(size\)"):
        render(size=(160, 120))
    # what was rendered before the choice existed had the target's texture
    record = tmp_path / "b" / "_generator.json"
    plain = json.loads(record.read_text())
    del plain["settings"]["scenes"]["lookalike_texture"]
    record.write_text(json.dumps(plain))
    assert render(lookalike_texture="same").rendered == 0


def test_a_record_by_the_names_of_before_is_of_the_same_settings(tmp_path: Path) -> None:
    render = partial(
        generate, tmp_path, 1, object="carton", size=(96, 72), workers=1, progress=False
    )
    render()
    record = tmp_path / "_generator.json"
    plain = json.loads(record.read_text())
    scenes, motion = plain["settings"]["scenes"], plain["settings"]["motion"]
    scenes["occlusion"] = scenes.pop("max_occlusion")
    for name in ("occluded", "tabletop", "lookalike", "shadow", "absent"):
        scenes[f"{name}_share"] = scenes.pop(f"{name}_fraction")
    scenes["lookalike_texture"] = "other"
    motion["covered_frames"] = motion.pop("fully_occluded_frames")
    record.write_text(json.dumps(plain))
    assert render().rendered == 0


def test_the_second_camera_stands_to_the_right(scene: SceneSet) -> None:
    layout = draw(scene, SceneSettings(), 1)[0]
    right = shift_camera(layout, 0.06)
    for a, b in zip(layout.placed, right.placed, strict=True):
        np.testing.assert_allclose(b.center - a.center, [-0.06, 0, 0], atol=1e-12)
        left_u, right_u = (p.center[0] / p.center[2] * K[0, 0] for p in (a, b))
        assert left_u - right_u == pytest.approx(K[0, 0] * 0.06 / a.center[2])


def test_settled_objects_lie_on_the_table_and_touch_but_do_not_mix(scene: SceneSet) -> None:
    pytest.importorskip("mujoco", reason="the optional extra [sim] is not installed")
    layouts = draw(scene, SceneSettings(tabletop_fraction=1.0, settle=True, distractors=(4, 6)), 6)
    tilts = 0
    for layout in layouts:
        top_from_camera = np.linalg.inv(layout.planes[0].camera_from_plane)
        for k, one in enumerate(layout.placed):
            heights = one.hull @ top_from_camera[2, :3] + top_from_camera[2, 3]
            assert heights.min() > -0.004
            for other in layout.placed[:k]:  # contacts give way by a few millimeters at most
                a = one.center + 0.85 * (one.hull - one.center)
                b = other.center + 0.85 * (other.hull - other.center)
                assert separated(a, b)
            tilts += (
                np.abs(
                    one.camera_from_object[:3, :3].T @ layout.planes[0].camera_from_plane[:3, 2]
                ).max()
                < 0.98
            )
    assert tilts > 0  # placed by hand, boxes and cans only ever stand or lie square


def test_a_copy_that_rolls_off_the_table_is_another_draw(
    scene: SceneSet, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(scenes, "settle", lambda placed, table, rng: [placed[0], *placed[2:]])
    settings = SceneSettings(
        tabletop_fraction=1.0, settle=True, distractors=(2, 3), instances=2, occluded_fraction=0.0
    )
    for seed in range(6):
        rng = np.random.default_rng(seed)
        assert scenes.draw_layout(scene, settings, K, H, W, rng) is None


def test_occluders_are_aimed_at_the_occlusion_that_is_allowed(scene: SceneSet) -> None:
    settings = SceneSettings(max_occlusion=0.3, occluded_fraction=1.0, distractors=(3, 5))
    visible = [View(K, H, W).visible(layout.placed) for layout in draw(scene, settings, 24)]
    assert np.mean([0.68 < share < 0.9 for share in visible]) > 0.6


def test_solids_measure_their_mesh(library: SolidStore) -> None:
    mesh = library.store.load("carton")
    solid = make_solid(mesh)
    np.testing.assert_allclose(solid.center, mesh.bounds.mean(0))
    assert solid.radius == pytest.approx(
        np.linalg.norm(mesh.vertices - solid.center, axis=1).max(), rel=0.02
    )
    full, some = mesh.vertices, solid.hull
    for d in np.random.default_rng(0).normal(size=(50, 3)):
        assert (some @ d).max() >= (full @ d).max() - 0.003 * np.linalg.norm(d)
