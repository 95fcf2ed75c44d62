"""The generator: the same files for a seed, whatever it takes to write them, in the format as real
files show it.
"""

import json
import math
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from posefilter.data.generated_scenes import ensure_scenes
from posefilter.errors import UserError
from posefilter.meshes.mesh import Mesh, creased_normals
from posefilter.meshes.store import MeshStore
from posefilter.rendering.embree import EmbreeRenderer, render_depth
from posefilter.rendering.surfaces import Instance, Rendered
from posefilter.synthetic import fat_format
from posefilter.synthetic.frame_renderer import FrameRenderer, make_renderer
from posefilter.synthetic.generate import camera_matrix, generate
from posefilter.synthetic.placing import View
from posefilter.synthetic.scenes import Layout

SIZE = (160, 120)
SETTINGS: dict[str, Any] = {
    "meshes": "builtin",
    "object": "carton",
    "seed": 5,
    "size": SIZE,
    "distractors": (2, 4),
    "frames_per_scene": 4,
    "workers": 1,
    "progress": False,
}


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six ideal stereo frames in two folders."""
    out = tmp_path_factory.mktemp("fat") / "scenes"
    summary = generate(out, 6, sensor="ideal", stereo=True, **SETTINGS)
    assert (summary.frames, summary.rendered, summary.folders) == (6, 6, 2)
    return out


def contents(root: Path) -> dict[str, bytes]:
    return {
        str(p.relative_to(root)): p.read_bytes() for p in sorted(root.rglob("*")) if p.is_file()
    }


def load(path: Path) -> Any:
    return json.loads(path.read_text())


def camera_from_mesh(record: dict[str, Any], exported: dict[str, Any]) -> np.ndarray:
    """The format's chain, written down once more: p_camera_cm = R(q) ([x y z 1] F) + location."""
    F = np.array(exported["fixed_model_transform"])
    R = Rotation.from_quat(record["quaternion_xyzw"]).as_matrix()
    out = np.eye(4)
    out[:3, :3] = R @ F[:3, :3].T / 100
    out[:3, 3] = (R @ F[3, :3] + record["location"]) / 100
    return out


def intrinsics(folder: Path) -> np.ndarray:
    one = load(folder / "_camera_settings.json")["camera_settings"][0]["intrinsic_settings"]
    return np.array([[one["fx"], 0, one["cx"]], [0, one["fy"], one["cy"]], [0, 0, 1]])


def test_the_layout_is_fats(dataset: Path) -> None:
    names = set(contents(dataset))
    endings = ("jpg", "json", "depth.png", "seg.png")
    frames = [(0, k) for k in range(4)] + [(1, k) for k in range(2)]
    expected = {
        f"mixed/scene{s:04d}_0/{k:06d}.{eye}.{e}"
        for s, k in frames
        for eye in ("left", "right")
        for e in endings
    }
    expected |= {
        f"mixed/scene{s:04d}_0/{n}"
        for s in (0, 1)
        for n in ("_object_settings.json", "_camera_settings.json")
    }
    assert names == expected | {"_generator.json"}


def test_truth_rendered_again_is_what_the_images_show(dataset: Path) -> None:
    mesh, renderer = MeshStore("builtin").load("carton"), EmbreeRenderer()
    count = 0
    for path in sorted(dataset.glob("mixed/*/*.json")):
        if path.name.startswith("_"):
            continue
        K = intrinsics(path.parent)
        exported = load(path.parent / "_object_settings.json")["exported_objects"][0]
        assert exported["class"] == "carton_16k"
        record = load(path)["objects"][0]
        T = camera_from_mesh(record, exported)
        depth, index = render_depth([mesh], [T], K, SIZE[1], SIZE[0], renderer)
        stem = path.name.removesuffix(".json")
        stored = cv2.imread(str(path.with_name(f"{stem}.depth.png")), cv2.IMREAD_UNCHANGED)
        seg = cv2.imread(str(path.with_name(f"{stem}.seg.png")), cv2.IMREAD_UNCHANGED)
        assert stored.dtype == np.uint16
        assert seg.dtype == np.uint8
        mask = seg == exported["segmentation_class_id"]
        assert mask.sum() > 30
        outside = mask & (index < 0)
        assert outside.sum() <= 1
        assert (
            np.abs(stored[mask & ~outside] / 1e4 - depth[mask & ~outside]).max() < 1e-4
        )  # half a unit, and the pose's digits
        assert (
            stored[(index == 0) & ~mask] / 1e4 <= depth[(index == 0) & ~mask] + 1e-4
        ).all()  # what hides it lies in front
        assert record["visibility"] == pytest.approx(mask.sum() / (index == 0).sum(), abs=0.02)
        moved = T.copy()
        moved[0, 3] += 0.004  # the canary: 4 mm aside no longer fits
        shifted = render_depth([mesh], [moved], K, SIZE[1], SIZE[0], renderer)[0]
        assert np.abs(stored[mask] / 1e4 - shifted[mask]).max() > 1e-3
        count += 1
    assert count == 12


def test_records_hold_together(dataset: Path) -> None:
    for path in sorted(dataset.glob("mixed/*/??????.left.json")):
        K = intrinsics(path.parent)
        settings = {
            e["class"]: e for e in load(path.parent / "_object_settings.json")["exported_objects"]
        }
        ids = [e["segmentation_class_id"] for e in settings.values()]
        assert len(set(ids)) == len(ids)
        assert all(0 < i < 255 for i in ids)
        objects = load(path)["objects"]
        assert len({o["class"] for o in objects}) == len(objects)
        seg = cv2.imread(
            str(path.with_name(path.name.replace(".json", ".seg.png"))), cv2.IMREAD_UNCHANGED
        )
        assert set(np.unique(seg)) - {0} <= {
            settings[o["class"]]["segmentation_class_id"] for o in objects
        }
        for one in objects:
            assert len(one["quaternion_xyzw"]) == 4
            assert np.linalg.norm(one["quaternion_xyzw"]) == pytest.approx(1, abs=1e-6)
            R = Rotation.from_quat(one["quaternion_xyzw"]).as_matrix()
            size = np.array(settings[one["class"]]["cuboid_dimensions"])
            local = (np.array(one["cuboid"]) - one["location"]) @ R / (size / 2)
            expected = [
                [1, -1, 1],
                [-1, -1, 1],
                [-1, 1, 1],
                [1, 1, 1],
                [1, -1, -1],
                [-1, -1, -1],
                [-1, 1, -1],
                [1, 1, -1],
            ]
            np.testing.assert_allclose(local, expected, atol=1e-4)
            cuboid = np.array(one["cuboid"])
            pixels = cuboid[:, :2] / cuboid[:, 2:] * [K[0, 0], K[1, 1]] + [K[0, 2], K[1, 2]]
            np.testing.assert_allclose(one["projected_cuboid"], pixels, atol=0.01)
            top, left = one["bounding_box"]["top_left"]
            bottom, right = one["bounding_box"]["bottom_right"]
            np.testing.assert_allclose([left, top], pixels.min(0), atol=0.01)
            np.testing.assert_allclose([right, bottom], pixels.max(0), atol=0.01)


def test_the_cuboid_is_the_meshs_box(dataset: Path) -> None:
    exported = load(dataset / "mixed/scene0000_0/_object_settings.json")["exported_objects"][0]
    mesh = MeshStore("builtin").load("carton")
    F = np.array(exported["fixed_model_transform"])
    aligned = np.concatenate([mesh.vertices, np.ones((len(mesh.vertices), 1))], 1) @ F
    np.testing.assert_allclose(
        aligned[:, :3].max(0), np.array(exported["cuboid_dimensions"]) / 2, atol=1e-5
    )
    np.testing.assert_allclose(
        aligned[:, :3].min(0), -np.array(exported["cuboid_dimensions"]) / 2, atol=1e-5
    )
    np.testing.assert_allclose(F[:3, :3] @ F[:3, :3].T, 1e4 * np.eye(3), atol=1e-6)
    assert np.linalg.det(F[:3, :3]) == pytest.approx(1e6)
    assert aligned[mesh.vertices[:, 2].argmax(), 1] < 0  # y points down


def test_the_right_camera_stands_six_centimeters_to_the_right(dataset: Path) -> None:
    for path in sorted(dataset.glob("mixed/*/??????.left.json")):
        left = {o["class"]: o for o in load(path)["objects"]}
        right = {
            o["class"]: o
            for o in load(path.with_name(path.name.replace("left", "right")))["objects"]
        }
        assert "carton_16k" in right
        for name in left.keys() & right.keys():
            np.testing.assert_allclose(
                np.subtract(right[name]["location"], left[name]["location"]), [-6, 0, 0], atol=1e-5
            )
            assert left[name]["quaternion_xyzw"] == right[name]["quaternion_xyzw"]


def test_keys_are_those_of_a_real_frame(dataset: Path, real_data: Path) -> None:
    folder = dataset / "mixed/scene0000_0"
    pairs = (
        ("left", "000000.left.json"),
        ("object", "_object_settings.json"),
        ("camera", "_camera_settings.json"),
    )
    for real, ours in pairs:
        assert_covers(
            load(folder / ours), load(real_data / "fat" / f"real_fat_single_banana.{real}.json")
        )


def assert_covers(ours: Any, real: Any) -> None:
    """Everything that the real file says somewhere, ours says too, with values of the same kind."""
    if isinstance(real, dict):
        for key, value in real.items():
            assert key in ours
            assert_covers(ours[key], value)
    elif isinstance(real, list):
        assert isinstance(ours, list)
        if real and not isinstance(real[0], str):
            assert len(ours) >= 1
            assert_covers(ours[0], real[0])
            assert isinstance(real[0], dict) or len(ours) == len(real)
    else:
        assert isinstance(ours, str) == isinstance(real, str)


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("alone") / "scenes"
    generate(out, 7, **SETTINGS)
    return out


@pytest.mark.slow
def test_processes_do_not_change_what_is_written(alone: Path, tmp_path: Path) -> None:
    generate(tmp_path / "two", 7, **{**SETTINGS, "workers": 2})
    assert contents(tmp_path / "two") == contents(alone)


def test_a_seed_changes_everything(alone: Path, tmp_path: Path) -> None:
    generate(tmp_path / "other", 1, **{**SETTINGS, "seed": 6})
    frame = "mixed/scene0000_0/000000.left.jpg"
    assert (tmp_path / "other" / frame).read_bytes() != (alone / frame).read_bytes()


def test_a_killed_run_goes_on_and_ends_the_same(alone: Path, tmp_path: Path) -> None:
    out = tmp_path / "scenes"
    generate(out, 3, **SETTINGS)
    folder = out / "mixed/scene0000_0"
    (folder / "000001.left.json").unlink()
    (folder / "000002.left.depth.png").unlink()
    (folder / ".000003.left.jpg.123.part").write_bytes(b"half a pic")
    kept = (folder / "000000.left.jpg").stat().st_mtime_ns
    summary = generate(out, 7, **SETTINGS)
    assert summary.rendered == 6
    assert (folder / "000000.left.jpg").stat().st_mtime_ns == kept
    assert contents(out) == contents(alone)
    assert generate(out, 7, **SETTINGS).rendered == 0


def test_other_settings_are_refused_by_name(alone: Path) -> None:
    with pytest.raises(UserError, match=r"_generator\.json.*other settings \(seed, sensor\)"):
        generate(alone, 7, **{**SETTINGS, "seed": 6, "sensor": "ideal"})


def write_meshes(folder: Path, unit: float = 1.0) -> Path:
    """Write three boxes in meters, or in another unit; return their folder."""
    folder.mkdir(parents=True, exist_ok=True)
    for k in range(3):
        mesh = trimesh.creation.box(np.array([0.1, 0.12, 0.14 + 0.02 * k]) / unit)
        mesh.export(folder / f"box{k}.ply")
    return folder


def test_meshes_in_millimeters_take_a_scale_and_a_failed_start_blocks_nothing(
    tmp_path: Path,
) -> None:
    meshes, out = write_meshes(tmp_path / "meshes", 0.001), tmp_path / "out"
    how = {"meshes": meshes, "object": "box0", "distractors": (0, 1), "progress": False}
    how |= {"size": (96, 72), "workers": 1}
    with pytest.raises(UserError, match=r"box0\.ply.* mesh_scale=0\.001"):
        generate(out, 2, **how)
    assert not out.exists()  # nothing was written before the meshes were looked at
    write_meshes(tmp_path / "meshes")
    # a distractor that the frames take is looked at too, another mesh is not
    (meshes / "box1.ply").write_bytes(b"ply")
    with pytest.raises(UserError, match=r"box1\.ply"):
        generate(out, 2, **how)
    assert not out.exists()
    write_meshes(tmp_path / "meshes", 0.001)
    # as left by a start that failed before its first frame
    (out / "mixed" / "scene0000_0").mkdir(parents=True)
    (out / "mixed" / "scene0000_0" / "_object_settings.json").write_text("{}")
    (out / "_generator.json").write_text(
        json.dumps({"settings": {"object": "another"}, "frames": 400})
    )
    assert generate(out, 2, mesh_scale=0.001, **how).rendered == 2
    assert json.loads((out / "_generator.json").read_text())["frames"] == 2
    in_meters = tmp_path / "in_meters"
    generate(in_meters, 2, **{**how, "meshes": write_meshes(tmp_path / "m")})
    for name in ("000001.left.seg.png", "000001.left.depth.png"):
        scaled, plain = (
            cv2.imread(str(folder / "mixed" / "scene0000_0" / name), cv2.IMREAD_UNCHANGED)
            for folder in (out, in_meters)
        )
        assert (scaled == plain).mean() > 0.99


def test_a_dataset_that_was_begun_with_too_many_frames_may_have_fewer(tmp_path: Path) -> None:
    how = {"object": "brick", "distractors": (0, 0), "progress": False}
    how |= {"size": (96, 72), "workers": 1}
    generate(tmp_path / "out", 2, **how)
    file = tmp_path / "out" / "_generator.json"
    record = json.loads(file.read_text())
    file.write_text(json.dumps({**record, "frames": 10}))  # as if it had been stopped
    with pytest.raises(UserError, match="only 2 of 10 scenes' frames"):
        ensure_scenes(tmp_path / "out", None)
    generate(tmp_path / "out", 2, **how)
    ensure_scenes(tmp_path / "out", None)
    generate(tmp_path / "out", 1, **how)  # those that are there stay
    assert json.loads(file.read_text())["frames"] == 2


def test_a_dataset_is_not_gone_on_with_once_its_mesh_has_changed(tmp_path: Path) -> None:
    meshes, out = write_meshes(tmp_path / "meshes"), tmp_path / "out"
    how = {"meshes": meshes, "object": "box0", "distractors": (0, 1), "progress": False}
    how |= {"size": (96, 72), "workers": 1}
    assert generate(out, 2, **how).rendered == 2
    before = (meshes / "box0.ply").read_bytes()
    trimesh.creation.box([0.1, 0.12, 0.2]).export(meshes / "box0.ply")
    record = (out / "_generator.json").read_bytes()
    with pytest.raises(UserError, match="another mesh of box0, whose file was changed since"):
        generate(out, 3, **how)
    assert (out / "_generator.json").read_bytes() == record
    with pytest.raises(UserError, match="another mesh of box0"):  # also with nothing left to render
        generate(out, 2, **how)
    assert (out / "_generator.json").read_bytes() == record
    (meshes / "box0.ply").write_bytes(before)
    assert generate(out, 3, **how).rendered == 1


def test_a_scene_is_not_gone_on_with_once_what_stands_beside_the_object_has_changed(
    tmp_path: Path,
) -> None:
    """The numbers in the images of its frames would mean other classes."""
    meshes, out = write_meshes(tmp_path / "meshes"), tmp_path / "out"
    how = {"object": "box0", "distractors": (0, 1), "progress": False}
    how |= {"size": (96, 72), "workers": 1}
    assert generate(out, 3, meshes=meshes, **how).rendered == 3
    begun = out / "mixed" / "scene0001_0"
    before = contents(begun)
    trimesh.creation.box([0.1, 0.1, 0.1]).export(meshes / "a_box.ply")
    with pytest.raises(UserError, match=r"scene0001_0: .*other meshes.*delete this folder"):
        generate(out, 4, meshes=meshes, **how)
    assert contents(begun) == before
    shutil.rmtree(begun)
    # a slash behind a folder's name, as shells complete it, is no other folder
    assert generate(out, 4, meshes=f"{meshes}/", **how).rendered == 2
    summary = generate(out, 1, meshes=meshes, **how)  # fewer than there are
    assert (summary.frames, summary.rendered, summary.folders) == (4, 0, 2)


def test_a_record_from_before_meshes_had_a_scale_goes_on(alone: Path, tmp_path: Path) -> None:
    out = tmp_path / "copy"
    shutil.copytree(alone, out)
    record = json.loads((out / "_generator.json").read_text())
    del record["settings"]["mesh_scale"], record["mesh"]
    (out / "_generator.json").write_text(json.dumps(record))
    assert generate(out, 7, **SETTINGS).rendered == 0


def _write_cube(folder: Path, side: float) -> Path:
    folder.mkdir()
    trimesh.creation.box([side] * 3).export(folder / "cube.obj")
    return folder


def test_an_object_that_is_too_small_is_refused_before_anything_is_rendered(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(FrameRenderer, "draw", lambda self, frame: pytest.fail("drawn"))
    meshes = _write_cube(tmp_path / "meshes", 0.005)
    with pytest.raises(UserError, match=r"object=cube: is too small .* covers \d+ of 19,200 pix"):
        generate(tmp_path / "out", 1, meshes, "cube", size=(160, 120), progress=False)
    assert not (tmp_path / "out").exists()


def test_layouts_that_cannot_show_the_object_are_not_rendered_and_the_others_stay(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Frames are the same bytes as where each layout is rendered, in fewer renders."""
    meshes = _write_cube(tmp_path / "meshes", 0.01)
    render, counts, found = FrameRenderer._render, [], []

    def count(self: FrameRenderer, layout: Layout) -> Rendered:
        counts[-1] += 1
        return render(self, layout)

    monkeypatch.setattr(FrameRenderer, "_render", count)
    for name in ("a", "b"):
        counts.append(0)
        generate(
            tmp_path / name, 2, meshes, "cube", size=(160, 120), distractors=(0, 1),
            workers=1, progress=False,
        )  # fmt: skip
        found.append(contents(tmp_path / name))
        monkeypatch.setattr(View, "most_pixels", lambda self, mesh, nearest: np.inf)
    assert found[0] == found[1]
    assert counts[0] < counts[1]


@pytest.mark.parametrize("sides", [(0.1, 0.1, 0.1), (0.3, 0.004, 0.004), (0.2, 0.3, 0.001)])
def test_no_object_covers_more_pixels_than_it_may(sides: tuple[float, float, float]) -> None:
    body = trimesh.creation.box(sides)
    vertices, faces = np.array(body.vertices), np.array(body.faces)
    gray, normals = np.full((1, 1, 3), 90, np.uint8), creased_normals(vertices, faces)
    mesh = Mesh("box", vertices, faces, None, gray, None, normals)
    K, rng = np.array(camera_matrix("ycb_video", 160, 120)), np.random.default_rng(0)
    view, renderer, shares = View(K, 120, 160), EmbreeRenderer(), []
    for _ in range(60):
        pose = np.eye(4)
        pose[:3, :3] = Rotation.random(rng=rng).as_matrix()
        pose[:3, 3] = view.ray(*rng.random(2)) * rng.uniform(0.4, 0.8)
        nearest = float((vertices @ pose[:3, :3].T + pose[:3, 3])[:, 2].min())
        _, index = renderer.depth([Instance(mesh, pose)], K, 120, 160)
        shares.append((index == 0).sum() / view.most_pixels(mesh, nearest))
    assert max(shares) <= 1
    assert max(shares) > 0.2


def test_the_renderers_names(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="renderer=moderngl: is now called opengl"):
        make_renderer("moderngl")
    with pytest.raises(UserError, match="choose from embree, opengl"):
        make_renderer("raster")
    offered = (Path(__file__).parents[2] / "conf" / "generate.yaml").read_text()
    assert re.search(r"^renderer: embree # or opengl", offered, re.MULTILINE)


def test_a_strangers_folder_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "holiday.jpg").write_bytes(b"")
    with pytest.raises(UserError, match="not empty"):
        generate(tmp_path, 1, **SETTINGS)
    assert [p.name for p in tmp_path.iterdir()] == ["holiday.jpg"]


def test_a_spoilt_record_is_named(tmp_path: Path) -> None:
    (tmp_path / "_generator.json").write_text('{"settings": {}, "fra')
    with pytest.raises(UserError, match=r"_generator\.json: not a generator's record"):
        generate(tmp_path, 1, **SETTINGS)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"object": "carrton"}, "carton"),
        ({"sensor": "lidar"}, "sensor=lidar.*ideal, kinect"),
        ({"camera": "gopro"}, "camera=gopro"),
        ({"camera": (1, 2, 3)}, "four numbers"),
        ({"camera": (600, 600, 4000, 60)}, "principal point is outside of size=.* another size"),
        ({"camera": (600, 600, math.nan, 60)}, "camera="),
        ({"instances": 2, "moving": "object"}, "moving=object: one object alone can move"),
        ({"distractors": (5, 2)}, "distractors=5,2"),
        ({"max_occlusion": 1.5}, "max_occlusion=1.5"),
        ({"workers": 0}, "workers=0"),
        ({"size": (8, 8)}, "size=8: must be a whole number, at least 32"),
        ({"renderer": "blender"}, "renderer=blender"),
    ],
)
def test_bad_values_end_in_one_line_that_names_them(
    tmp_path: Path, change: dict[str, Any], message: str
) -> None:
    with pytest.raises(UserError, match=message) as caught:
        generate(tmp_path / "out", 1, **{**SETTINGS, **change})
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "out").exists()


def test_named_cameras_are_the_published_ones() -> None:
    fat = camera_matrix("fat", 960, 540)
    np.testing.assert_allclose(
        fat, [[768.16058349609375, 0, 480], [0, 768.16058349609375, 270], [0, 0, 1]]
    )
    ycb = camera_matrix("ycb_video", 640, 480)
    np.testing.assert_allclose(ycb, [[1066.778, 0, 312.9869], [0, 1067.487, 241.3109], [0, 0, 1]])
    half = camera_matrix("ycb_video", 320, 240)
    point = np.array([0.07, -0.03, 0.9])
    whole, small = ((K @ point)[:2] / point[2] for K in (ycb, half))
    np.testing.assert_allclose(small, (whole + 0.5) / 2 - 0.5)  # pixel centers at integers in both
    np.testing.assert_allclose(camera_matrix((500, 510, 300, 200), 640, 480)[:2, 2], [300, 200])


def test_depth_is_stored_in_tenths_of_millimeters_and_never_wraps() -> None:
    units = fat_format.depth_units(np.array([[0.0, 0.5, 6.5535, 6.6]], np.float32))
    np.testing.assert_array_equal(units, [[0, 5000, 65535, 0]])


@pytest.mark.slow
def test_a_script_needs_no_guard_to_render_with_workers(tmp_path: Path) -> None:
    """Spawned processes run a script once more; one that renders would wait for its own lock."""
    script = tmp_path / "script.py"
    script.write_text(
        "from pathlib import Path\n"
        "from posefilter.synthetic.generate import generate\n"
        "print('once')\n"
        f"generate(Path({str(tmp_path / 'out')!r}), 2, object='carton', frames_per_scene=1, "
        "workers=2, progress=False)\n"
    )
    done = subprocess.run(
        [sys.executable, script], capture_output=True, text=True, timeout=100, check=True
    )
    assert done.stdout.split() == ["once"]
    assert len(list((tmp_path / "out").glob("mixed/*/*.left.jpg"))) == 2
