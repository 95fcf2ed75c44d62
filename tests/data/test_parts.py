"""Parts of objects: declared beside a mesh, read as objects of their own, and scored."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import trimesh
from dataset_trees import BOXES, K, bop_scene, pose, write_mesh

from posefilter.cli.archive import _check_object
from posefilter.data.dataset import to_batch
from posefilter.data.frames import NotShown, Sample
from posefilter.data.readers.registry import open_reader
from posefilter.errors import UserError
from posefilter.meshes.mesh import face_areas, object_model
from posefilter.meshes.parts import assign, read_parts, take_faces
from posefilter.meshes.store import MeshStore
from posefilter.metrics.parts import PartIoU, label_pixels
from posefilter.rendering.embree import render_depth
from posefilter.synthetic.generate import generate

PARTS = {"foot": {"vertices": [*range(8)]}, "post": {"vertices": [*range(8, 16)]}}  # of the L


@pytest.fixture
def meshes(tmp_path: Path) -> MeshStore:
    root = write_mesh(tmp_path / "meshes", "obj_000002")
    (root / "obj_000002" / "parts.json").write_text(json.dumps(PARTS))
    return MeshStore(root)


def test_vertices_are_counted_as_the_file_does(tmp_path: Path) -> None:
    """Some that no face uses come first."""
    box = trimesh.creation.box([0.1, 0.2, 0.06])
    rows = ["v 9 9 9", "v 8 8 8", *(f"v {x} {y} {z}" for x, y, z in box.vertices)]
    rows += [f"f {a} {b} {c}" for a, b, c in box.faces + 3]
    (tmp_path / "box.obj").write_text("\n".join(rows))
    listed = (np.flatnonzero(box.vertices[:, 0] < 0) + 2).tolist()
    (tmp_path / "parts.json").write_text(json.dumps({"box": {"left": {"vertices": listed}}}))
    mesh = MeshStore(tmp_path).load("box")
    left = (mesh.vertices[mesh.faces][..., 0] < 0).sum(axis=1) >= 2
    np.testing.assert_array_equal(mesh.parts["left"], left)


@pytest.mark.parametrize("form", ["glb", "ply"])
def test_vertices_of_formats_that_do_not_number_them_are_refused(form: str, tmp_path: Path) -> None:
    """A PLY of MeshLab has texture coordinates by face: trimesh divides its vertices."""
    if form == "glb":
        trimesh.creation.box([0.1, 0.2, 0.06]).export(tmp_path / "box.glb")
    else:
        points = ["0 0 0", "0.1 0 0", "0 0.1 0", "0 0 0.1"]
        faces = ["0 1 2", "0 3 1", "1 3 2", "0 2 3"]
        uv = ["0 0 1 0 0 1", "0.5 0.5 1 1 1 0.5", "0 0.5 1 0.5 0.5 1", "0.2 0.2 0.7 0.2 0.2 0.7"]
        header = ["ply", "format ascii 1.0", "comment TextureFile a.png", "element vertex 4"]
        header += [f"property float {axis}" for axis in "xyz"]
        header += ["element face 4", "property list uchar int vertex_indices"]
        header += ["property list uchar float texcoord", "end_header"]
        rows = [f"3 {face} 6 {one}" for face, one in zip(faces, uv, strict=True)]
        (tmp_path / "box.ply").write_text("\n".join([*header, *points, *rows]) + "\n")
        cv2.imwrite(str(tmp_path / "a.png"), np.zeros((4, 4, 3), np.uint8))
    (tmp_path / "parts.json").write_text(json.dumps({"box": {"tip": {"vertices": [0, 3]}}}))
    with pytest.raises(UserError, match="use a box"):
        MeshStore(tmp_path).load("box")


def test_a_list_of_vertices_has_the_faces_between_them(meshes: MeshStore) -> None:
    whole = meshes.load("obj_000002")
    assert [int(faces.sum()) for faces in whole.parts.values()] == [12, 12]
    post = meshes.load("obj_000002.post")
    assert post.name == "obj_000002.post"
    np.testing.assert_allclose(post.bounds, BOXES[1], atol=1e-9)
    areas = [face_areas(m.vertices, m.faces).sum() for m in (whole, post)]
    sides = np.ptp(BOXES[1], axis=0)
    assert areas[1] == pytest.approx(
        2 * (sides[0] * sides[1] + sides[1] * sides[2] + sides[2] * sides[0])
    )
    assert areas[0] > areas[1]
    assert meshes.names() == ["obj_000002"]  # a part is no clutter
    assert meshes.has("obj_000002.foot")
    assert not meshes.has("obj_000002.tail")
    with pytest.raises(UserError, match=r"no part 'tail' of obj_000002 .* foot, post"):
        meshes.load("obj_000002.tail")


def test_a_box_is_in_the_unit_of_the_mesh_file(tmp_path: Path, meshes: MeshStore) -> None:
    mesh, file = meshes.load("obj_000002"), tmp_path / "own.json"
    above = {"box": [[0, -100, 91], [200, 100, 200]]}  # millimeters: not the post's lowest face
    file.write_text(json.dumps({"obj_000002": {"post": above}}))
    parts = read_parts(file, "obj_000002", 0.001, mesh)
    assert int(parts["post"].sum()) == 10
    assert not (parts["post"] & ~mesh.parts["post"]).any()
    assert read_parts(file, "another", 0.001, mesh) == {}


@pytest.mark.parametrize("kind", ["box", "vertices"])
def test_a_part_may_have_the_name_of_a_kind(kind: str, tmp_path: Path) -> None:
    root = write_mesh(tmp_path / "meshes", "obj_000002")
    own = {kind: {"vertices": list(range(8))}, "rest": {"vertices": list(range(8, 16))}}
    (root / "parts.json").write_text(json.dumps({"obj_000002": own, "another": own}))
    parts = MeshStore(root).load("obj_000002").parts
    assert {part: int(faces.sum()) for part, faces in parts.items()} == {kind: 12, "rest": 12}


def test_a_vertex_that_no_face_uses_may_be_listed(tmp_path: Path) -> None:
    corners = "v 0 0 0\nv .1 0 0\nv 0 .1 0\nv 0 0 .1\nv .2 .2 .2\nv .3 .3 .3\n"
    faces = "f 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    (tmp_path / "a.obj").write_text(corners + faces)
    file = tmp_path / "parts.json"
    file.write_text(json.dumps({"a": {"tip": {"vertices": [0, 1, 5]}}}))
    assert MeshStore(tmp_path).load("a").parts["tip"].tolist() == [True, True, False, False]
    file.write_text(json.dumps({"a": {"tip": {"vertices": [0, 1, 6]}}}))
    with pytest.raises(UserError, match="the mesh has vertices 0 to 5"):
        MeshStore(tmp_path).load("a")


def test_a_face_belongs_to_the_first_part_that_has_it(meshes: MeshStore) -> None:
    mesh = meshes.load("obj_000002")
    everything = np.ones(len(mesh.faces), bool)
    parts = assign({"foot": mesh.parts["foot"], "rest": everything}, "here")
    np.testing.assert_array_equal(parts["rest"], mesh.parts["post"])


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("[1, 2]", "should map names to parts"),
        ("{", "not readable as JSON"),
        ('{"head": {"box": [[0, 0, 0]]}}', "head: cannot be read"),
        ('{"head": {"box": [[0, 0, NaN], [1, 1, 1]]}}', "not finite"),
        ('{"head": {"vertices": [99]}}', "the mesh has vertices 0 to 15"),
        ('{"head": {"vertices": [0.5, 1.5]}}', "counted from 0"),
        ('{"head": {"box": [[500, 0, 0], [900, 1, 1]]}}', "has no face of the mesh; mind the unit"),
        ('{"a/b": {"vertices": [0, 1, 2, 3]}}', "a name must consist of letters"),
        ('{"head": {"ball": 3, "box": 4}}', "a part is"),
        ('{"obj_000002": [1]}', "should map names of parts"),
    ],
)
def test_what_is_no_part_is_one_line(tmp_path: Path, content: str, said: str) -> None:
    mesh = MeshStore(write_mesh(tmp_path / "meshes", "obj_000002")).load("obj_000002")
    file = tmp_path / "parts.json"
    file.write_text(content)
    with pytest.raises(UserError, match=said) as caught:
        read_parts(file, "obj_000002", 0.001, mesh)
    assert str(file) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_part_is_read_as_an_object_of_its_own(tmp_path: Path, meshes: MeshStore) -> None:
    """The dataset's mask is of the whole; the part's pixels are those where its faces are seen."""
    bop_scene(tmp_path / "000048", [[(2, pose())]])
    whole = open_reader("bop", tmp_path, "obj_000002", meshes).read(0)
    seen = {}
    for part in ("foot", "post"):
        reader = open_reader("bop", tmp_path, f"obj_000002.{part}", meshes)
        assert reader.objects == (f"obj_000002.{part}",)
        assert [record.object for record in reader.records()] == [f"obj_000002.{part}"]
        sample = reader.read(0)
        np.testing.assert_array_equal(sample.camera_from_object, whole.camera_from_object)
        np.testing.assert_array_equal(reader.native_from_mesh(part), np.eye(4))
        assert not (sample.mask & ~whole.mask).any()
        assert (reader.others(0) & whole.mask).sum() == (whole.mask & ~sample.mask).sum()
        assert 0 < reader.visible_share(sample) <= 1
        seen[part] = sample.mask
    assert not (seen["foot"] & seen["post"]).any()
    with pytest.raises(UserError, match="no part 'tail'"):
        open_reader("bop", tmp_path, "obj_000002.tail", meshes)
    with pytest.raises(UserError, match="is a part, which is read by itself"):
        open_reader("bop", tmp_path, ["obj_000002.foot", "obj_000002"], meshes)


def test_a_part_that_nobody_sees_is_not_shown(tmp_path: Path, meshes: MeshStore) -> None:
    """From below, the post is behind the foot."""
    from_below = pose((0.0, 0.0, 0.0), (0.0, 0.0, 0.6))
    bop_scene(tmp_path / "000048", [[(2, from_below)]])
    assert open_reader("bop", tmp_path, "obj_000002.foot", meshes).read(0).mask.any()
    with pytest.raises(NotShown, match="the part is not seen"):
        open_reader("bop", tmp_path, "obj_000002.post", meshes).read(0)


def test_poses_of_the_camera_in_the_objects_frame_are_inverted(tmp_path: Path) -> None:
    bop_scene(tmp_path / "a" / "000048", [[(2, pose())]])
    bop_scene(tmp_path / "b" / "000048", [[(2, pose())]])
    file = tmp_path / "b" / "000048" / "scene_gt.json"
    truth = json.loads(file.read_text())
    inverse = np.linalg.inv(pose())
    truth["0"][0]["cam_R_m2c"] = inverse[:3, :3].ravel().tolist()
    truth["0"][0]["cam_t_m2c"] = (1000 * inverse[:3, 3]).tolist()
    file.write_text(json.dumps(truth))
    usual = open_reader("bop", tmp_path / "a", "obj_000002").read(0)
    other = open_reader("bop", tmp_path / "b", "obj_000002", inverted=True).read(0)
    np.testing.assert_allclose(other.camera_from_object, usual.camera_from_object, atol=1e-6)
    with pytest.raises(UserError, match="choose true or false"):
        open_reader("bop", tmp_path / "b", "obj_000002", inverted="yes")


def test_no_scenes_are_rendered_of_a_part_alone(tmp_path: Path, meshes: MeshStore) -> None:
    with pytest.raises(UserError, match=r"is a part; render the whole, object=obj_000002"):
        generate(tmp_path / "out", 2, tmp_path / "meshes", "obj_000002.foot", progress=False)
    assert not (tmp_path / "out").exists()


def _sample(meshes: MeshStore, at: np.ndarray) -> Sample:
    depth, index = render_depth([meshes.load("obj_000002")], [at], K, 120, 160)
    rgb = np.zeros((120, 160, 3), np.uint8)
    return Sample(rgb, depth.astype(np.float32), index == 0, K.astype(np.float32), at, 0, 0, 1.0)


def test_the_score_is_one_at_the_truth_and_falls_as_the_pose_is_wrong(meshes: MeshStore) -> None:
    model = object_model(meshes.load("obj_000002"))
    assert list(model.parts or {}) == ["foot", "post"]
    batch = to_batch(_sample(meshes, pose().astype(np.float32)))
    batch = type(batch)(*(x[None] for x in batch))
    truth, scores = batch.camera_from_object, []
    for shift in (0.0, 0.004, 0.02, 0.3):
        wrong = truth.clone()
        wrong[0, 0, 3] += shift
        metric = PartIoU(model)
        metric.update(wrong, batch)
        scores.append(metric.compute())
    assert scores[0]["box_iou"] == pytest.approx(1.0)
    assert scores[0]["mask_iou"] == pytest.approx(1.0)
    for name in ("box_iou", "mask_iou"):
        assert scores[1][name] > scores[2][name] > scores[3][name]
    # 0.3 m off, no pixel is near any part, and no box overlaps
    assert scores[3]["by_part"]["foot"] == {"box_iou": 0.0, "mask_iou": 0.0}


def test_parts_mistaken_for_each_other_score_little(meshes: MeshStore) -> None:
    """Two like parts that change places: the whole's box stays as it is."""
    whole = object_model(meshes.load("obj_000002"))
    left = torch.rand(400, 3, generator=torch.Generator().manual_seed(0)) * 0.04
    left = left - torch.tensor([0.04, 0.02, 0.02])
    right = left * torch.tensor([-1.0, 1.0, 1.0])
    model = whole._replace(
        parts={"left": left, "right": right}, hull=torch.cat([left, right]), diameter=0.1
    )
    at = torch.eye(4)
    at[2, 3] = 0.4
    inside = torch.zeros(1, 1, 120, 160, dtype=torch.bool)
    inside[..., 52:72, 59:98] = True
    batch = to_batch(_sample(meshes, pose().astype(np.float32)))
    batch = type(batch)(*(x[None] for x in batch))._replace(
        mask=inside, depth=torch.full((1, 1, 120, 160), 0.38), camera_from_object=at[None]
    )
    turned = at.clone()
    turned[:3, :3] = torch.diag(torch.tensor([-1.0, -1.0, 1.0]))
    scores = []
    for tried in (at, turned):
        metric = PartIoU(model)
        metric.update(tried[None], batch)
        scores.append(metric.compute())
    assert scores[0]["box_iou"] == pytest.approx(1.0)
    assert scores[0]["mask_iou"] == pytest.approx(1.0)
    assert scores[1]["box_iou"] < 0.05
    assert scores[1]["mask_iou"] < 0.1


def test_each_measured_point_belongs_to_the_nearest_part(meshes: MeshStore) -> None:
    model = object_model(meshes.load("obj_000002"))
    points = torch.tensor([[0.1, 0.0, 0.05], [0.03, 0.0, 0.15], [0.5, 0.0, 0.0]])
    assert label_pixels(points, torch.eye(4), model).tolist() == [0, 1, -1]


def test_poses_that_are_no_numbers_score_nothing(meshes: MeshStore) -> None:
    model = object_model(meshes.load("obj_000002"))
    batch = to_batch(_sample(meshes, pose().astype(np.float32)))
    batch = type(batch)(*(x[None] for x in batch))
    metric = PartIoU(model)
    metric.update(torch.full((1, 4, 4), torch.nan), batch)
    assert metric.compute()["by_part"]["post"] == {"box_iou": 0.0, "mask_iou": 0.0}


def test_a_checkpoint_keeps_the_parts_and_foreign_ones_are_checked(meshes: MeshStore) -> None:
    model = object_model(meshes.load("obj_000002"))._asdict()
    _check_object(model)
    for parts in ({"../x": model["hull"]}, {"foot": torch.zeros(3)}, {"foot": "x"}, [1]):
        with pytest.raises(UserError, match=r"^its object's "):
            _check_object({**model, "parts": parts})


def test_a_cut_part_keeps_color_and_normals(meshes: MeshStore) -> None:
    mesh = meshes.load("obj_000002")
    colored = replace(mesh, corner_colors=np.arange(24 * 9, dtype=np.float32).reshape(24, 3, 3))
    part = take_faces(colored, colored.parts["post"], "obj_000002.post")
    assert part.corner_colors is not None
    np.testing.assert_array_equal(part.corner_colors, colored.corner_colors[12:])
    np.testing.assert_array_equal(part.corner_normals, mesh.corner_normals[12:])
    np.testing.assert_array_equal(part.vertices[part.faces], mesh.vertices[mesh.faces[12:]])
