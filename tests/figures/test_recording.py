"""The file of the 3-D view holds what is shown, read back entity by entity; without the library, a
line says what to do.
"""

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent))
from rrd_files import read_back
from views import FIRST, STEPS, H, N, W, box, run, two_images

from posefilter.errors import UserError
from posefilter.figures.particles import color_by_weight
from posefilter.figures.recording import check_viewer, describe, record
from posefilter.figures.view_data import ViewData, collect_view_data
from posefilter.geometry.spaces import PixelSpace, PoseSpace
from posefilter.meshes.builtin import catalog as builtin
from posefilter.meshes.mesh import Mesh, surface_colors

SPACE = PoseSpace((0.0, 0.0, 0.105), 0.136)
needs_rerun = pytest.mark.skipif(
    importlib.util.find_spec("rerun") is None, reason="the optional extra [viz] is not installed"
)


def shown(pixels: bool = False, shape: Mesh | None = None) -> ViewData:
    space = PixelSpace() if pixels else SPACE
    return collect_view_data(
        run(pixels), two_images(), box(), space, box().hull if shape is None else shape, image=1
    )


def placed(entity: dict[str, dict[int | None, np.ndarray]], step: int | None) -> np.ndarray:
    """Return an entity's pose (4, 4)."""
    pose = np.eye(4)
    pose[:3, :3] = entity["Transform3D:mat3x3"][step].reshape(3, 3).T  # stored column by column
    pose[:3, 3] = entity["Transform3D:translation"][step][0]
    return pose


def rgba(packed: np.ndarray) -> np.ndarray:
    return np.stack([packed >> shift & 255 for shift in (24, 16, 8, 0)], -1)


def test_without_the_library_one_line_says_how_to_get_it(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(UserError, match=r"save_rerun=true: .* pip install -e '\.\[viz\]'\)$"):
        check_viewer()
    with pytest.raises(UserError, match="rerun-sdk is missing"):
        record(shown(), tmp_path / "view.rrd")
    assert not list(tmp_path.iterdir())


def test_words_tell_the_hypotheses() -> None:
    text = describe(shown())
    rows = [line for line in text.splitlines() if line.startswith("| ")][1:]
    assert [row.split(" | ")[:2] for row in rows] == [
        ["| estimate", "70.0%"],
        ["| mode 1", "25.0%"],
        ["| mode 2", "4.5%"],
    ]
    assert "Lighter modes, not drawn: 0.5% of the weight" in text
    assert "0 to 2 are the filter's steps, 3 is the belief" in text


@needs_rerun
def test_the_cloud_and_the_photograph_are_there_at_every_step(tmp_path: Path) -> None:
    scene = shown()
    record(scene, tmp_path / "view.rrd")
    found = read_back(tmp_path / "view.rrd", "step")
    assert np.allclose(found["/cloud"]["Points3D:positions"][None], scene.cloud.points, atol=1e-6)
    assert (rgba(found["/cloud"]["Points3D:colors"][None])[:, :3] == scene.cloud.colors).all()
    assert (found["/photograph"]["Image:buffer"][None].reshape(H, W, 3) == scene.rgb).all()
    K = found["/photograph"]["Pinhole:image_from_camera"][None].reshape(3, 3).T
    # its pixels' corners are whole
    assert np.allclose(K - scene.K, [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]], atol=1e-5)
    assert np.allclose(placed(found["/estimate_box"], None), scene.estimate.pose, atol=1e-6)
    assert np.allclose(found["/estimate_box"]["Boxes3D:half_sizes"][None], [[0.03, 0.08, 0.105]])
    assert "| mode 1 |" in found["/about"]["TextDocument:text"][None][0]


@needs_rerun
@pytest.mark.parametrize("pixels", [False, True], ids=["poses", "pixels"])
def test_the_time_line_is_the_filters_steps_and_the_belief(pixels: bool, tmp_path: Path) -> None:
    scene = shown(pixels)
    record(scene, tmp_path / "view.rrd")
    found = read_back(tmp_path / "view.rrd", "step")
    inside, on_image = found["/particles/centers"], found["/photograph/particles"]
    assert (
        list(inside["Points3D:positions"])
        == list(on_image["Points2D:positions"])
        == list(range(STEPS + 1))
    )
    assert [len(inside["weight"][t]) for t in range(STEPS + 1)] == [FIRST, N, N, N]
    for t, moment in enumerate(scene.moments):
        assert np.allclose(inside["Points3D:positions"][t], moment.centers, atol=1e-6)
        assert np.allclose(on_image["Points2D:positions"][t], moment.pixels + 0.5, atol=1e-4)
        assert np.allclose(inside["weight"][t], moment.weights)
        assert (rgba(inside["Points3D:colors"][t])[:, :3] == color_by_weight(moment.weights)).all()
        starts = np.array([one[0] for one in found["/particles/axes"]["LineStrips3D:strips"][t]])
        nearest = np.linalg.norm(starts[:, None] - moment.centers[None], axis=-1).min(1)
        assert nearest.max() < 1e-6
    noise = found["/filter/noise"]["Scalars:scalars"]
    assert [float(noise[t][0]) for t in range(STEPS)] == pytest.approx(
        [0.04, 0.02, 0.01] if pixels else [40, 20, 10]
    )
    assert STEPS not in noise


@needs_rerun
def test_the_mesh_is_where_the_estimate_puts_it_and_fainter_at_the_other_modes(
    tmp_path: Path,
) -> None:
    mesh = builtin.build("carton")
    scene = shown(shape=mesh)
    record(scene, tmp_path / "view.rrd")
    found = read_back(tmp_path / "view.rrd", "step")
    named = ["/estimate", *(f"/modes/{i}" for i in range(1, len(scene.others) + 1))]
    assert (
        sorted(
            e
            for e in found
            if e.startswith(("/estimate", "/modes")) and "Mesh3D:vertex_positions" in found[e]
        )
        == named
    )
    for entity, one in zip(named, [scene.estimate, *scene.others], strict=True):
        # with the belief, not before
        assert list(found[entity]["Mesh3D:vertex_positions"]) == [STEPS]
        assert np.allclose(placed(found[entity], STEPS), one.pose, atol=1e-6)
        assert found[entity]["weight"][STEPS] == pytest.approx(one.weight)
        label = str(found[f"{entity}/weight"]["Points3D:labels"][STEPS][0])
        assert label.endswith(f": {one.weight:.0%} of the belief")
        corners = found[entity]["Mesh3D:vertex_positions"][STEPS][
            found[entity]["Mesh3D:triangle_indices"][STEPS]
        ]
        assert np.allclose(corners, mesh.vertices[mesh.faces], atol=1e-6)
    assert "Mesh3D:albedo_factor" not in found["/estimate"]  # as it is: opaque
    assert [int(rgba(found[e]["Mesh3D:albedo_factor"][STEPS])[0, 3]) for e in named[1:]] == [
        70
    ] * len(scene.others)


@needs_rerun
def test_the_texture_lies_on_the_estimate_the_right_way_up(tmp_path: Path) -> None:
    mesh = builtin.build("carton")
    assert mesh.corner_uv is not None
    record(shown(shape=mesh), tmp_path / "view.rrd")
    entity = read_back(tmp_path / "view.rrd", "step")["/estimate"]
    form = entity["Mesh3D:albedo_texture_format"][STEPS][0]
    texture = entity["Mesh3D:albedo_texture_buffer"][STEPS].reshape(
        form["height"], form["width"], 3
    )
    face = np.arange(0, len(mesh.faces), 7)
    own = surface_colors(mesh, face, np.full((len(face), 3), 1 / 3)) * 255
    uv = entity["Mesh3D:vertex_texcoords"][STEPS].reshape(-1, 3, 2)[face].mean(1)
    size = [form["width"], form["height"]]
    u, v = np.clip((uv * size).astype(int), 0, np.subtract(size, 1)).T
    assert np.median(np.abs(texture[v, u] - own)) < 8
    assert np.median(np.abs(texture[size[1] - 1 - v, u] - own)) > 8  # upside down it would not fit
