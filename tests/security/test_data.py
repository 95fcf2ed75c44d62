"""Datasets, meshes and caches are data: none leads out of its folder, or promises more
than can be held.
"""

import json
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from posefilter.data.cache import DiskCache
from posefilter.data.points import read_model_points
from posefilter.data.readers.decode import read_color, read_depth, read_label
from posefilter.data.readers.registry import open_reader
from posefilter.errors import UserError
from posefilter.limits import read_json
from posefilter.meshes.files import read_mesh
from posefilter.report.gather import read_run
from posefilter.report.images import encode_image
from posefilter.synthetic.generate import generate


def png(width: int, height: int) -> bytes:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return (
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        )

    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", header)
        + chunk(b"IDAT", zlib.compress(b"\0" * 100))
        + chunk(b"IEND", b"")
    )


def jpeg(width: int, height: int) -> bytes:
    data = bytearray(cv2.imencode(".jpg", np.zeros((8, 8, 3), np.uint8))[1].tobytes())
    at = data.index(b"\xff\xc0")
    data[at + 5 : at + 9] = struct.pack(">HH", height, width)
    return bytes(data)


def bmp(width: int, height: int) -> bytes:
    data = bytearray(cv2.imencode(".bmp", np.zeros((8, 8, 3), np.uint8))[1].tobytes())
    data[18:26] = struct.pack("<ii", width, height)
    return bytes(data)


# PIL would have Ghostscript run it
PROGRAM = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 64 64\n%%EndComments\n" + b"%\n" * 50_000

PICTURES = {
    "png": png(100_000, 100_000),
    "wide png": png(1 << 30, 1),
    "png within the decoder's own bounds": png(30_000, 30_000),
    "jpeg": jpeg(65_000, 65_000),
    "bmp": bmp(100_000, 100_000),
    "no image": b"hostile",
    "a program for a printer": PROGRAM,
}


@pytest.mark.parametrize("kind", PICTURES)
@pytest.mark.parametrize(
    "read",
    [read_color, lambda path: read_depth(path, 1000), read_label],
    ids=["color", "depth", "label"],
)
def test_an_image_of_too_many_pixels_is_not_decoded(
    kind: str,
    read: Callable[[Path], Any],
    tmp_path: Path,
    watch: Any,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    path = tmp_path / "image.png"
    path.write_bytes(PICTURES[kind])
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("was decoded"))
    with watch, pytest.raises(UserError, match=r"image\.png") as told:
        read(path)
    assert "\n" not in str(told.value)


@pytest.mark.parametrize(
    "text", ["[" * 100_000, '{"a":' * 100_000, "\0", "[1"], ids=["lists", "mappings", "zero", "cut"]
)
def test_hostile_json_is_refused(text: str, tmp_path: Path, watch: Any) -> None:
    (tmp_path / "x.json").write_text(text)
    with watch, pytest.raises(UserError, match=r"x\.json") as told:
        read_json(tmp_path / "x.json")
    assert "\n" not in str(told.value)


def test_a_file_of_enormous_size_is_not_read(tmp_path: Path, watch: Any) -> None:
    with (tmp_path / "x.json").open("wb") as file:
        file.truncate(1 << 36)  # takes no space on disk
    with watch, pytest.raises(UserError, match="too large"):
        read_json(tmp_path / "x.json")
    with watch, pytest.raises(UserError, match="too large"):
        read_color(tmp_path / "x.json")


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("scenes") / "carton"
    generate(
        out,
        2,
        object="carton",
        workers=1,
        size=(64, 48),
        distractors=(0, 1),
        frames_per_scene=2,
        progress=False,
    )
    return out


@pytest.fixture
def scenes(rendered: Path, tmp_path: Path) -> Path:
    """Return a folder of scenes to be spoilt."""
    import shutil

    return Path(shutil.copytree(rendered, tmp_path / "scenes"))


def read_all(root: Path) -> None:
    reader = open_reader("fat", root)
    for i in range(len(reader.records())):
        reader.read(i)


@pytest.mark.parametrize(
    "ending", ["left.jpg", "left.depth.png", "left.seg.png", "left.json", "_object_settings.json"]
)
@pytest.mark.parametrize("way", ["absolute", "relative"])
def test_a_datasets_link_that_leads_out_is_not_followed(
    ending: str, way: str, scenes: Path, secret: Path, watch: Any
) -> None:
    victim = next(path for path in sorted(scenes.rglob("*")) if path.name.endswith(ending))
    victim.unlink()
    up = "../" * len(victim.parent.relative_to(scenes.parent).parts)
    victim.symlink_to(secret / "file.txt" if way == "absolute" else f"{up}secret/file.txt")
    with watch, pytest.raises(UserError, match="leads out of") as told:
        read_all(scenes)
    assert "\n" not in str(told.value)


def test_a_linked_folder_ofrendered_is_not_followed(
    scenes: Path, rendered: Path, watch: Any
) -> None:
    (scenes / "hostile").symlink_to(
        next(path.parent for path in rendered.rglob("_object_settings.json"))
    )
    with watch, pytest.raises(UserError, match="leads out of"):
        open_reader("fat", scenes)


def test_the_users_own_link_to_a_dataset_is_followed(scenes: Path, tmp_path: Path) -> None:
    (tmp_path / "mine").symlink_to(scenes)
    reader = open_reader("fat", tmp_path / "mine")
    assert reader.read(0).rgb.shape == (48, 64, 3)


@pytest.mark.parametrize("name", ["../../secret", "/etc", "a/b", "..", "a\nb", "~root"])
def test_a_class_is_no_path(name: str, scenes: Path, secret: Path, watch: Any) -> None:
    for path in scenes.rglob("*.json"):
        content = json.loads(path.read_text())
        for one in content.get("objects", []) + content.get("exported_objects", []):
            one["class"] = name
        path.write_text(json.dumps(content))
    with watch, pytest.raises(UserError) as told:
        open_reader("fat", scenes)
    assert "\n" not in str(told.value)
    with watch, pytest.raises(UserError):
        read_model_points(None, secret.parent / "scenes", name, np.eye(4))


def test_a_list_of_classes_is_no_list_of_paths(tmp_path: Path, watch: Any) -> None:
    (tmp_path / "data" / "0001").mkdir(parents=True)
    (tmp_path / "classes.txt").write_text("002_master_chef_can\n../../secret\n")
    with watch, pytest.raises(UserError, match=r"classes\.txt"):
        open_reader("ycb_video", tmp_path)


@pytest.mark.parametrize("stem", ["../../x", "x", "-1"])
def test_a_list_of_frames_names_frames(stem: str, tmp_path: Path, watch: Any) -> None:
    (tmp_path / "data" / "0001").mkdir(parents=True)
    (tmp_path / "list.txt").write_text(f"0001/{stem}\n")
    with watch, pytest.raises(UserError) as told:
        open_reader("ycb_video", tmp_path, frames="list.txt")
    assert "\n" not in str(told.value)


@pytest.mark.parametrize(
    "truth",
    [{"../../x": []}, {"-1": []}, [], {"١": 1, "x": 2}],
    ids=["path", "sign", "list", "word"],
)
def test_bop_records_are_by_number(truth: Any, tmp_path: Path, watch: Any) -> None:
    folder = tmp_path / "test" / "000001"
    folder.mkdir(parents=True)
    (folder / "scene_gt.json").write_text(json.dumps(truth))
    (folder / "scene_camera.json").write_text("{}")
    with watch, pytest.raises(UserError) as told:
        open_reader("bop", tmp_path / "test")
    assert "\n" not in str(told.value)


def test_a_link_for_a_cache_is_not_written_through(
    secret: Path, tmp_path: Path, watch: Any
) -> None:
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / ".cache").symlink_to(secret)
    with watch, pytest.raises(UserError, match="leads out of"):
        DiskCache(tmp_path / "data" / ".cache", "x")


OBJ = "mtllib {mtl}\nv 0 0 0\nv 0.1 0 0\nv 0 0.1 0\nusemtl a\nf 1 2 3\n"
MESHES = {
    "material above": ("../secret/file.txt", ""),
    "absolute material": ("{secret}/file.txt", ""),
    "texture above": ("own.mtl", "newmtl a\nmap_Kd ../secret/file.txt\n"),
    "absolute texture": ("own.mtl", "newmtl a\nmap_Kd {secret}/file.txt\n"),
    "linked texture": ("own.mtl", "newmtl a\nmap_Kd link.png\n"),
    "linked material": ("link.mtl", ""),
}


@pytest.mark.parametrize("what", MESHES)
def test_a_mesh_names_files_beside_it(what: str, secret: Path, tmp_path: Path, watch: Any) -> None:
    folder = tmp_path / "meshes"
    folder.mkdir()
    mtl, text = (part.format(secret=secret) for part in MESHES[what])
    (folder / "own.mtl").write_text(text)
    for link in ("link.png", "link.mtl"):
        (folder / link).symlink_to(secret / "file.txt")
    (folder / "x.obj").write_text(OBJ.format(mtl=mtl))
    with watch, pytest.raises(UserError, match="leads out of"):
        read_mesh(folder / "x.obj", "x")


def glb(change: dict[str, Any], binary: bytes = b"", count: int = 3) -> bytes:
    """A GLB file of one triangle, with some of its content changed."""
    corners = np.eye(3, dtype=np.float32).tobytes()
    content: dict[str, Any] = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": count, "type": "VEC3",
             "min": [0, 0, 0], "max": [1, 1, 1]}
        ],
        "bufferViews": [{"buffer": 0, "byteOffset": 0, "byteLength": 36}],
        "buffers": [{"byteLength": 36 + len(binary)}],
    }  # fmt: skip
    text = json.dumps({**content, **change}).encode()
    text += b" " * (-len(text) % 4)
    body = corners + binary + b"\0" * (-len(binary) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text
    chunks += struct.pack("<II", len(body), 0x004E4942) + body
    return b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks


LARGE = png(30_000, 30_000)
# 2^40 triangles: each node shows the next one twice
TWICE = [{"children": [i + 1, i + 1]} for i in range(40)] + [{"mesh": 0}]
GLBS = {
    "2^40 elements": (glb({}, count=1 << 40), "too large"),
    "2^40 zeros": (
        glb({"accessors": [{"componentType": 5126, "count": 1 << 40, "type": "VEC3"}]}),
        "too large",
    ),
    "a negative count": (glb({}, count=-1), "too large"),
    "nodes shown twice": (glb({"nodes": TWICE}), "no tree"),
    "a node below itself": (glb({"nodes": [{"children": [1]}, {"children": [1]}]}), "no tree"),
    "a mesh shown often": (
        glb({"nodes": [{"mesh": 0}] * 9_000, "accessors": [{"count": 1 << 20}]}),
        "too large",
    ),
    "another file's buffer": (
        glb({"buffers": [{"byteLength": 36, "uri": "../secret/file.txt"}]}),
        "in other files",
    ),
    "another file's image": (glb({"images": [{"uri": "/etc/passwd"}]}), "in other files"),
    "an image of 9 * 10^8 pixels": (
        glb(
            {
                "images": [{"bufferView": 1, "mimeType": "image/png"}],
                "bufferViews": [
                    {"buffer": 0, "byteLength": 36},
                    {"buffer": 0, "byteOffset": 36, "byteLength": len(LARGE)},
                ],
            },
            LARGE,
        ),
        "too large",
    ),
    "no header": (b"glTF" + b"\0" * 8, "no GLB file"),
    "lists for mappings": (glb({"nodes": [[1]]}), "broken GLB file"),
}


@pytest.mark.parametrize("what", GLBS)
def test_a_glb_file_is_not_believed(what: str, tmp_path: Path, watch: Any) -> None:
    data, told = GLBS[what]
    (tmp_path / "x.glb").write_bytes(data)
    with watch, pytest.raises(UserError, match=told) as refusal:
        read_mesh(tmp_path / "x.glb", "x")
    assert "\n" not in str(refusal.value)


def test_an_honest_glb_file_is_read(tmp_path: Path) -> None:
    (tmp_path / "x.glb").write_bytes(glb({}))
    mesh = read_mesh(tmp_path / "x.glb", "x")
    assert mesh.faces.shape == (1, 3)
    np.testing.assert_allclose(mesh.vertices, np.eye(3))


BOMB = "a: &a [x, x]\n" + "".join(
    f"{chr(98 + i)}: &{chr(98 + i)} [{', '.join([f'*{chr(97 + i)}'] * 9)}]\n" for i in range(9)
)


@pytest.mark.parametrize(
    ("text", "told"),
    [(BOMB, "alias"), ("a: &a [*a]", "alias"), ("a: !!python/name:os.system", "is no YAML"),
     ("a" * (1 << 21), "too large"), ("[" * 5_000, "is no YAML"),
     ("a: !!opencv-matrix [1]", "is no YAML"), ("a: !!opencv-matrix {" * 5_000, "is no YAML"),
     ("a: !!opencv-matrix {data: !!python/name:os.system }", "is no YAML"),
     ("%YAML:1.0\n---\na: &a !!opencv-matrix {data: *a}", "alias"),
     ("a: 1\n---\n" + BOMB, "alias"),
     ("a: " + ":".join(["1"] * 60_000), "a number of"),
     ("a: 1:" + ":".join(["1"] * 60_000) + ".5", "a number of"),
     *((f"a: {value}", "is no YAML") for value in ("!!int ''", "!!bool x", "!!timestamp x"))],
    ids=["alias bomb", "loop", "function", "large", "deep", "matrix of a list", "deep matrix",
         "matrix of a function", "matrix in a loop", "bomb in a second document",
         "base of 60", "fraction to the base of 60", "no number", "no truth", "no time"],
)  # fmt: skip
def test_a_runs_settings_are_plain(text: str, told: str, tmp_path: Path, watch: Any) -> None:
    (tmp_path / ".hydra").mkdir()
    (tmp_path / ".hydra" / "config.yaml").write_text(text)
    with watch, pytest.raises(UserError, match=told) as refusal:
        read_run(tmp_path)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("size", [(30_000, 30_000), (100_000, 100_000)])
def test_a_picture_of_too_many_pixels_is_not_packed_into_a_page(
    size: tuple[int, int], watch: Any
) -> None:
    with watch, pytest.raises(ValueError, match="too large"):
        encode_image(png(*size))


def test_a_program_for_a_printer_is_no_picture(
    tmp_path: Path, watch: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever its file is called: neither in a run's figures nor as a texture."""
    monkeypatch.setattr("PIL.EpsImagePlugin.gs_binary", None)  # which is looked for once
    corners = np.array([[0, 0], [1, 0], [0, 1]], np.float32).tobytes()
    change: dict[str, Any] = {
        "images": [{"bufferView": 1, "mimeType": "image/png"}],
        "textures": [{"source": 0}],
        "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
        "meshes": [
            {"primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "material": 0}]}
        ],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"},
            {"bufferView": 2, "componentType": 5126, "count": 3, "type": "VEC2"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteLength": 36},
            {"buffer": 0, "byteOffset": 60, "byteLength": len(PROGRAM)},
            {"buffer": 0, "byteOffset": 36, "byteLength": 24},
        ],
    }
    (tmp_path / "x.glb").write_bytes(glb(change, corners + PROGRAM))
    with watch, pytest.raises(ValueError, match="header cannot be read"):
        encode_image(PROGRAM)
    with watch, pytest.raises(UserError, match="header cannot be read"):
        read_mesh(tmp_path / "x.glb", "x")


def test_a_texture_of_too_many_pixels_is_not_decoded(tmp_path: Path, watch: Any) -> None:
    (tmp_path / "own.mtl").write_text("newmtl a\nmap_Kd large.png\n")
    (tmp_path / "large.png").write_bytes(png(30_000, 30_000))
    (tmp_path / "x.obj").write_text(OBJ.format(mtl="own.mtl"))
    with watch, pytest.raises(UserError, match="too large"):
        read_mesh(tmp_path / "x.obj", "x")
