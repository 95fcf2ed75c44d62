"""Small files that ask for much: each is refused in one line, within 5 s and 1 GB.

Each is read in a process of its own, which is ended where it takes more.
"""

import io
import json
import os
import pickle
import resource
import signal
import struct
import time
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from posefilter.belief.storage import read_arrays
from posefilter.cli.checkpoints import method_of, read_checkpoint
from posefilter.cli.resume import overrides_of
from posefilter.data.generated_scenes import ensure_scenes
from posefilter.data.points import read_model_points
from posefilter.data.readers.decode import read_color, read_size
from posefilter.data.readers.ycb_video_files import read_meta
from posefilter.errors import BadData, UserError
from posefilter.limits import read_bytes
from posefilter.meshes import obj, polygons
from posefilter.meshes.files import read_mesh
from posefilter.meshes.symmetries import read_symmetries
from posefilter.metrics.bop_results import read_poses_csv
from posefilter.report.gather import read_run
from posefilter.report.sweeps import read_sweep
from posefilter.synthetic.generate import generate

SECONDS, BYTES = 5, 1 << 30
Save = Callable[[dict[str, Any]], Path]


def refuse(read: Callable[[], Any]) -> str:
    """Return the line by which a process of its own refuses to read something."""
    told, tell = os.pipe()
    number = os.fork()
    if not number:
        os.close(told)
        os._exit(_read_bounded(read, tell))
    os.close(tell)
    with os.fdopen(told, "rb") as pipe:
        said = pipe.read().decode()
    status = os.waitstatus_to_exitcode(os.waitpid(number, 0)[1])
    assert status == 0, said or f"ended with {status}, {signal.Signals(-status).name}"
    return said


def _read_bounded(read: Callable[[], Any], tell: int) -> int:
    """Read under bounds; return an exit status, 0 for one line in time."""
    torch.set_num_threads(1)  # a fork lacks the threads that torch would wait for
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        most = pages * resource.getpagesize() + 4 * BYTES  # that the machine is left alone
        resource.setrlimit(resource.RLIMIT_AS, (most, most))
        seconds = int(time.process_time()) + 1 + SECONDS
        resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds))
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        try:
            said, status = f"was accepted: {read()!r:.200}", 1
        except UserError as error:
            said, status = str(error), 0
        grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024
        if "\n" in said or grown > BYTES:
            status = 2
        os.write(tell, f"{said} [{grown >> 20} MB]".encode(errors="replace")[:4000])
        return status
    except BaseException as error:
        os.write(tell, f"{type(error).__name__}: {error}".encode(errors="replace")[:4000])
        return 3


def pickled(code: bytes) -> Callable[[Path], None]:
    """Return what gives a checkpoint another pickle."""

    def change(path: Path) -> None:
        with zipfile.ZipFile(path) as archive:
            parts = [(info, archive.read(info)) for info in archive.infolist()]
        with zipfile.ZipFile(path, "w") as archive:
            for info, data in parts:
                archive.writestr(info, code if info.filename.endswith("data.pkl") else data)

    return change


def whole(number: int) -> bytes:
    return pickle.LONG1 + b"\x05" + number.to_bytes(5, "little")


TWICE = b"K\x01" + b"q\x01h\x01\x86" * 40  # a tuple of 2^40 values
SAME_HASH = b"".join(  # keys that differ, and have one hash
    pickle.LONG1 + b"\x0a" + (i * (2**61 - 1)).to_bytes(10, "little") + b"N" for i in range(60_000)
)
PICKLES = {
    "a key that hashes for years": b"\x80\x02}" + TWICE + b"Ns.",
    "a storage's name that hashes for years": b"\x80\x02X\x07\0\0\0storage" + TWICE + b"\x86Q.",
    "tuples in an ordered dictionary": b"\x80\x02ccollections\nOrderedDict\n]]("
    + TWICE + b"K\x01eaa\x85R.",
    "keys of one hash": b"\x80\x02}(" + SAME_HASH + b"u.",
    "5 GB of bytes": b"\x80\x02cbuiltins\nbytearray\n" + whole(5 << 30) + b"\x85R.",
    "a tensor of the old kind": b"\x80\x02ctorch\nFloatTensor\n" + whole(5 << 30) + b"\x85R.",
    "a stack that is not there": b"\x80\x02\x86.",
    "no mark": b"\x80\x02]e.",
    "a half": b"\x80\x02X\xff\xff\xff\x7fx",
    "many steps": b"\x80\x02]" + b"]a" * (1 << 21) + b".",
}  # fmt: skip


@pytest.mark.parametrize("what", PICKLES)
def test_a_pickle_is_read_before_it_is_obeyed(what: str, good: Path, tmp_path: Path) -> None:
    path = tmp_path / "hostile.ckpt"
    path.write_bytes(good.read_bytes())
    pickled(PICKLES[what])(path)
    assert "checkpoint=" in refuse(lambda: read_checkpoint(path))


def test_what_training_keeps_is_no_attack(content: dict[str, Any], save: Save) -> None:
    """States of optimizers, schedules and callbacks: counters, sets, numbers of 64 bits."""
    weight = torch.nn.Parameter(torch.zeros(3, 2, 2, 2, 2, 2, dtype=torch.bfloat16))
    optimizer = torch.optim.AdamW([weight], betas=(0.9, 0.99))
    weight.sum().backward()
    optimizer.step()
    schedule = torch.optim.lr_scheduler.MultiStepLR(optimizer, [1, 2, 2])
    kept = {"optimizer": optimizer.state_dict(), "schedule": schedule.state_dict()}
    kept |= {"seen": {"a", "b"}, "seed": 2**63 - 1, 2: None, "kind": torch.float16, "a": weight}
    content.update(kept)
    read = read_checkpoint(save(content))
    assert read["schedule"]["milestones"] == schedule.state_dict()["milestones"]
    assert (read["seen"], read["seed"]) == (kept["seen"], kept["seed"])


def laughing(way: str) -> dict[str, Any]:
    """Settings that refer to each other, ten times each, in a way that a count may overlook."""
    first: dict[str, Any] = {"l0": "x" * 900 if way == "select" else [[1]]}
    for i in range(1, 9):
        if way == "select":
            first[f"l{i}"] = f"${{oc.select:l{i - 1},0}}" * 40
        else:
            first[f"l{i}"] = [[f"${{l{i - 1}.{'0' if way == 'list' else '0_0'}}}"] * 10]
    return {**first, "loss": {"a": "${l8}"}}


def update(part: str, **changes: Any) -> Callable[[dict[str, Any]], None]:
    def change(content: dict[str, Any]) -> None:
        (content["recipe"]["settings"] if part == "settings" else content[part]).update(changes)

    return change


def spread(content: dict[str, Any]) -> None:
    scale = {"x#scale": torch.zeros(1, 60_000)}
    content["state_dict"].update({"x": torch.zeros(60_000, 1, dtype=torch.int8), **scale})


def share(content: dict[str, Any]) -> None:
    """Have 3,000 weights be one storage of 2 MB: 6 GB, and 12 in full precision."""
    one = torch.zeros(1 << 20, dtype=torch.half)
    content["state_dict"].update({f"x{i}": one[:] for i in range(3000)})


def complexes(content: dict[str, Any]) -> None:
    state = content["state_dict"]
    state.update({k: v.to(torch.complex64) for k, v in state.items() if v.is_floating_point()})


def calibrate(content: dict[str, Any]) -> None:
    one = {"weights": [1.0], "bias": 0.0}
    content["calibration"] = {
        "features": ["a"], "center": [1 << 2000], "scale": [1.0], "presence": one, "success": one,
        "counts": {"right": 1, "wrong": 1, "absent": 1}, "source": "fat", "quality": {},
    }  # fmt: skip


CHANGES: dict[str, Callable[[dict[str, Any]], None]] = {
    "texts that select each other": update("settings", **laughing("select")),
    "a text that selects itself": update("settings", variant="x${oc.select:variant,0}"),
    "lists that refer by number": update("settings", **laughing("list")),
    "lists that refer by odd numbers": update("settings", **laughing("odd")),
    "a list within itself": update("settings", loss=["${loss.0}"]),
    "a reference to nothing": update("settings", loss="${nope}"),
    "a value that is missing": update("settings", filter="???"),
    "a scale that spreads its kernel": spread,
    "weights that share a storage": share,
    "complex weights": complexes,
    "a number too large for a float": calibrate,
    "a name of 400 bytes": update("object_model", name="\U0001f600" * 100),
    "a path in wide letters": update("object_model", name="\uff0e\uff0e\uff0fsecret"),
    "a name that turns its line round": update("object_model", name="car\u202eton"),
    "a name of blanks": update("object_model", name=" "),
    "200,000 symmetries": update("object_model", symmetries=torch.eye(4).repeat(200_000, 1, 1)),
    "symmetries that stretch": update("object_model", symmetries=2 * torch.eye(4)[None]),
    "2,000 symmetries of the shape": update(
        "object_model", shape_symmetries=torch.eye(4).repeat(2_000, 1, 1)
    ),
    "a shape's symmetry that stretches": update(
        "object_model", shape_symmetries=2 * torch.eye(4)[None]
    ),
    "a texture of eight columns": update("object_model", texture=torch.zeros(5, 8)),
    "a texture that is not finite": update("object_model", texture=torch.full((5, 9), torch.nan)),
    "a texture of negative colors": update("object_model", texture=-torch.ones(5, 9)),
    "30,000 textured points": update("object_model", texture=torch.zeros(30_000, 9)),
    "bytes of no texture": update("object_model", texture_look=torch.zeros(5, 6).byte()),
    "bytes of another texture": update(
        "object_model", texture=torch.zeros(5, 3), texture_look=torch.zeros(4, 6).byte()
    ),
    "bytes beside a whole texture": update(
        "object_model", texture=torch.zeros(5, 9), texture_look=torch.zeros(5, 6).byte()
    ),
    "no hull": update("object_model", hull=None),
    "no symmetry": update("object_model", symmetries=torch.zeros(0, 4, 4)),
    "points at the end of numbers": update("object_model", points=torch.full((5, 3), 3e38)),
}  # fmt: skip


@pytest.mark.parametrize("what", CHANGES)
def test_contents_that_grow_are_refused(what: str, content: dict[str, Any], save: Save) -> None:
    CHANGES[what](content)
    path = save(content)
    told = refuse(lambda: method_of(read_checkpoint(path)))
    assert told.startswith(("checkpoint", "model: its settings refer to what is not there"))


def array(shape: tuple[int, ...], data: bytes = b"", kind: str = "<f8") -> bytes:
    """An array's file whose header says what it likes."""
    head = f"{{'descr': {kind!r}, 'fortran_order': False, 'shape': {shape!r}, }}"
    head += " " * (63 - (10 + len(head)) % 64) + "\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(head)) + head.encode() + data


def encrypted(data: bytes) -> bytes:
    out, at = bytearray(data), data.index(b"PK\x01\x02")
    out[6] |= 1
    while at >= 0:
        out[at + 8] |= 1
        at = out.find(b"PK\x01\x02", at + 4)
    return bytes(out)


ONE = array((1,), struct.pack("<d", 1))
BELIEFS: dict[str, tuple[bytes, bytes, Callable[[bytes], bytes]]] = {
    "2^58 numbers": (array((1 << 58,)), ONE, bytes),
    "2^40 numbers": (array((1 << 40,)), ONE, bytes),
    "a header without an end": (b"\x93NUMPY\x01\x00\xff\x00" + b"(" * 255, ONE, bytes),
    "objects": (array((1,), kind="|O"), ONE, bytes),
    "encrypted": (ONE, ONE, encrypted),
    "a method of packing that there is not": (
        ONE, ONE, lambda data: data.replace(b"\x14\0\0\0\x08\0", b"\x14\0\0\0\x63\0"),
    ),
    "weights of zero": (array((1,), bytes(8)), array((1, 4, 4), bytes(128)), bytes),
    "poses that are none": (ONE, array((7,), bytes(56)), bytes),
}  # fmt: skip


@pytest.mark.parametrize("what", BELIEFS)
def test_a_beliefs_file_is_not_believed(what: str, tmp_path: Path) -> None:
    weights, poses, change = BELIEFS[what]
    numbers = {"center": array((3,), bytes(24)), "radius": ONE, "diameter": ONE}
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in {"weights": weights, "poses": poses, **numbers}.items():
            archive.writestr(f"{name}.npy", data)
        archive.writestr("object.npy", array((), b"a\0\0\0", "<U1"))
    (tmp_path / "b.npz").write_bytes(change(packed.getvalue()))
    assert "holds no belief" in refuse(lambda: read_arrays(tmp_path / "b.npz"))


MERGED = "- &a {k0: v}\n" + "".join(
    f"- &{chr(98 + i)} {{<<: [{', '.join(['*' + chr(97 + i)] * 9)}]}}\n" for i in range(9)
)


def test_merged_mappings_do_not_multiply(tmp_path: Path) -> None:
    """A run's own settings, which it is gone on with: 9^9 pairs in a few lines."""
    (tmp_path / ".hydra").mkdir()
    (tmp_path / ".hydra" / "overrides.yaml").write_text(MERGED)
    assert "should be a list of settings" in refuse(lambda: overrides_of(tmp_path))


RUNS = {
    "a number of 5,000 digits": ("metrics.json", '{"a": ' + "9" * 5000 + "}"),
    "a list for a mapping": (".hydra/hydra.yaml", "hydra: [1]"),
    "a number for choices": (".hydra/hydra.yaml", "hydra: {runtime: {choices: 5}}"),
    "a number for a list": (".hydra/hydra.yaml", "hydra: {overrides: {task: 5}}"),
    "settings that are a number": ("metrics.json", '{"overrides": 5}'),
    "a day that there is not": (".hydra/config.yaml", "a: 2001-99-99"),
    "a number of 5,000 digits in YAML": (".hydra/config.yaml", "a: " + "9" * 5000),
    "a cell without an end": ("errors.csv", "scene_id\n" + "x" * 200_000),
    "an event of 2^60 bytes": ("events.out.tfevents.1", "\0" * 7 + "\x10" + "\0" * 4),
    "one of a name that TensorBoard takes": ("a.tfevents", "\0" * 7 + "\x10" + "\0" * 4),
}


@pytest.mark.parametrize("what", RUNS)
def test_a_run_of_somebody_else_is_no_traceback(what: str, tmp_path: Path) -> None:
    (tmp_path / ".hydra").mkdir()
    (tmp_path / "metrics.json").write_text("{}")
    (tmp_path / RUNS[what][0]).write_text(RUNS[what][1])
    assert str(tmp_path) in refuse(lambda: read_run(tmp_path))


def test_a_file_without_an_end_is_not_read(tmp_path: Path) -> None:
    names = ("metrics.json", "x.obj", "x.ply", "models_info.json", "a/errors.csv", "poses.csv")
    for name in (*names, "b/summary.csv", "c/_generator.json", "d/figures/x.png", "m/points.xyz"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        with (tmp_path / name).open("wb") as file:
            file.truncate(1 << 36)  # takes no space on disk
    for name in ("a/metrics.json", "d/metrics.json", "c/0.left.json"):
        (tmp_path / name).write_text("{}")
    info = tmp_path / "models_info.json"
    reads: list[Callable[[], Any]] = [
        lambda: read_run(tmp_path),
        lambda: read_run(tmp_path / "a"),
        lambda: read_run(tmp_path / "d"),
        lambda: read_sweep(tmp_path / "b"),
        lambda: read_poses_csv(tmp_path / "poses.csv"),
        lambda: ensure_scenes(tmp_path / "c", None),
        lambda: read_model_points(tmp_path, tmp_path, "m", np.eye(4)),
        lambda: read_mesh(tmp_path / "x.obj", "x"),
        lambda: read_mesh(tmp_path / "x.ply", "x"),
        lambda: read_symmetries(info, "x", 1.0, 36),
    ]
    for read in reads:
        assert "too large" in refuse(read)


@pytest.mark.parametrize("name", ["figures/x.png", "events.out.tfevents.1"])
@pytest.mark.parametrize("kind", ["pipe", "device", "folder", "nothing"])
def test_what_is_no_file_is_not_waited_for(name: str, kind: str, tmp_path: Path) -> None:
    place = tmp_path / name
    place.parent.mkdir(exist_ok=True)
    (tmp_path / "metrics.json").write_text("{}")
    if kind == "pipe":
        os.mkfifo(place)
    elif kind == "folder":
        place.mkdir()
    else:
        place.symlink_to({"device": "/dev/zero", "nothing": tmp_path / "gone"}[kind])
    if place.suffix == ".png":
        assert read_run(tmp_path).pictures == []  # left out, as what a run lacks
    else:
        assert "is no event file" in refuse(lambda: read_run(tmp_path))


@pytest.mark.parametrize("text", ["[" * 100_000, '{"frames": 1e999, "settings": {}}'])
def test_a_record_of_rendered_scenes_is_no_traceback(text: str, tmp_path: Path) -> None:
    (tmp_path / "0.left.json").write_text("{}")
    (tmp_path / "_generator.json").write_text(text)
    assert "not a generator's record" in refuse(lambda: ensure_scenes(tmp_path, None))
    assert "not a generator's record" in refuse(lambda: generate(tmp_path, 1, object="carton"))


SWEEPS = {
    "a cell without an end": ("summary.csv", "folder,a\n" + "x" * 200_000),
    "no text": ("summary.csv", "folder,a\n\xff"),
    "a number for settings": ("multirun.yaml", "hydra: 5"),
    "a number for a list": ("multirun.yaml", "hydra: {overrides: {task: 5}}"),
    "settings that are none": ("a/metrics.json", '{"overrides": {"a": 1}}'),
}


@pytest.mark.parametrize("what", SWEEPS)
def test_a_sweep_of_somebody_else_is_no_traceback(what: str, tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "summary.csv").write_text("folder,a\nx,1\n")
    (tmp_path / SWEEPS[what][0]).write_bytes(SWEEPS[what][1].encode("latin-1"))
    assert str(tmp_path) in refuse(lambda: read_sweep(tmp_path))


def test_a_summary_with_a_short_row_is_read(tmp_path: Path) -> None:
    (tmp_path / "summary.csv").write_text("folder,a,b\nx,1\n")
    (job,) = read_sweep(tmp_path).jobs
    assert job.place == {"a": 1, "b": ""}


CORNERS = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\n"
MESHES = {
    "faces that all meet": (CORNERS + "f " + "1 2 3 " * 30_000, "meet in one place"),
    "corners at the end of numbers": ("v 0 0 0\nv 1e308 0 0\nv 0 1 0\nf 1 2 3\n", "mind the unit"),
    "an index of 30 digits": (CORNERS + f"f 1 2 {'9' * 30}\n", "not a readable mesh"),
    "one picture 8,100 times": (
        f"mtllib x.mtl\n{CORNERS}vt 90 0\nvt 0 90\n"
        "usemtl m0\nf 1/1 2/2 3/3\nusemtl m1\nf 1/1 2/1 3/1\n",
        "repeated 8100 times",
    ),
    "twenty pictures": ("mtllib many.mtl\n" + CORNERS + "f 1/1 2/1 3/1\n", "scale them down"),
}


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with large pictures, and materials that name them."""
    folder = tmp_path_factory.mktemp("pictures")
    cv2.imwrite(str(folder / "p0.png"), np.eye(4000, dtype=np.uint8))
    for i in range(1, 20):
        (folder / f"p{i}.png").write_bytes((folder / "p0.png").read_bytes())
    for name, same in (("x", True), ("many", False)):
        lines = [f"newmtl m{i}\nmap_Kd p{0 if same else i % 20}.png\n" for i in range(60)]
        (folder / f"{name}.mtl").write_text("".join(lines))
    return folder


@pytest.mark.parametrize("what", MESHES)
def test_a_mesh_that_grows_is_refused(
    what: str, pictures: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if what == "twenty pictures":  # as many as the bound allows take seconds to decode
        monkeypatch.setattr(obj, "MOST_TEXELS", 1 << 25)
    text, told = MESHES[what]
    path = pictures / "x.obj"
    path.write_text(text)
    assert told in refuse(lambda: read_mesh(path, "x"))


def spiral(corners: int) -> str:
    """A face whose ears are found last: splitting it takes the cube of its corners."""
    turns = 0.1 * np.arange(corners // 2)
    inner = (1 + 0.1 * turns) * np.exp(1j * turns)
    outline = [*(inner * (1 + 0.005 / abs(inner))), *inner[::-1]]
    rows = [f"v {z.real} {z.imag} 0" for z in outline]
    return "\n".join([*rows, "f " + " ".join(map(str, range(1, len(rows) + 1))), ""])


def test_a_face_that_takes_hours_to_split_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(polygons, "_MOST_TRIED", 5e6)  # of half a minute
    path = tmp_path / "x.obj"
    path.write_text(spiral(1000))
    assert "take too long to split" in refuse(lambda: read_mesh(path, "x"))
    path.write_text(spiral(100))
    assert len(read_mesh(path, "x").faces) == 98


def test_many_faces_that_take_their_time_are_refused_together(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(polygons, "_MOST_TRIED", 5e6)
    corners = [spiral(size).splitlines() for size in range(200, 240, 2)]
    rows = [row for own in corners for row in own[:-1]]
    faces, first = list[str](), 0
    for own in corners:
        numbers = range(first, first + len(own) - 1)
        faces.append(f"{len(numbers)} {' '.join(map(str, numbers))}")
        first += len(numbers)
    path = tmp_path / "x.obj"
    text = "\n".join(["f " + " ".join(str(int(i) + 1) for i in f.split()[1:]) for f in faces])
    path.write_text("\n".join(rows) + "\n" + text + "\n")
    assert "take too long to split" in refuse(lambda: read_mesh(path, "x"))
    head = (
        f"ply\nformat ascii 1.0\nelement vertex {first}\nproperty float x\nproperty float y\n"
        f"property float z\nelement face {len(faces)}\nproperty list int int vertex_indices\n"
        "end_header\n"
    )
    path = tmp_path / "x.ply"
    path.write_text(head + "\n".join([*(row[2:] for row in rows), *faces]) + "\n")
    assert "take too long to split" in refuse(lambda: read_mesh(path, "x"))


LINES = {
    "a library named often": ("mtllib x.mtl\n" * 100_000, "Kd 1 0 0\n" * 50_000),
    "a library named often in a line": ("mtllib " + "x.mtl " * 100_000, "Kd 1 0 0\n" * 50_000),
    "a library named in many ways": (
        "\n".join(f"mtllib {'a/../' * i}x.mtl" for i in range(200)), "Kd 1 0 0\n" * 50_000,
    ),
    "many options of a picture": ("mtllib x.mtl\n", f"map_Kd {'-clamp on ' * 200_000}x.png"),
    "a picture moved often": ("mtllib x.mtl\n", f"map_Kd {'-s 1 ' * 200_000}x.png"),
}  # fmt: skip


@pytest.mark.parametrize("what", LINES)
def test_a_line_of_a_mesh_is_not_read_over_and_over(what: str, tmp_path: Path) -> None:
    text, materials = LINES[what]
    (tmp_path / "a").mkdir()
    (tmp_path / "x.mtl").write_text(f"newmtl a\n{materials}\n")
    path = tmp_path / "x.obj"
    path.write_text(f"{text}\n{CORNERS}usemtl a\nf 1 2 9\n")
    told = "x.png: missing texture" if "map_Kd" in materials else "names a vertex that is not there"
    assert told in refuse(lambda: read_mesh(path, "x"))


@pytest.mark.parametrize("filling", ["\n", " \n", " ", "property ", "property\n", "a ", "a"])
@pytest.mark.parametrize("start", ["", "property ", "element face ", "comment "])
def test_a_long_header_of_a_ply_file_is_read_once(start: str, filling: str, tmp_path: Path) -> None:
    path = tmp_path / "x.ply"
    long = start + filling * (500_000 // len(filling))
    path.write_text(f"ply\nformat ascii 1.0\n{long}!\nelement vertex 3\nend_header\n")
    assert "x.ply" in refuse(lambda: read_mesh(path, "x"))


def scans(count: int, read: Callable[[Path], Any], path: Path) -> Any:
    """Read a JPEG that repeats its last scan."""
    image, options = np.zeros((512, 512, 3), np.uint8), [cv2.IMWRITE_JPEG_PROGRESSIVE, 1]
    data = cv2.imencode(".jpg", image, options)[1].tobytes()
    path.write_bytes(data[:-2] + data[data.rindex(b"\xff\xda") : -2] * count + b"\xff\xd9")
    return read(path)


@pytest.mark.parametrize("read", [read_color, read_size, lambda path: obj.read_image(path, path)])
def test_a_jpeg_without_an_end_of_scans_is_not_decoded(
    read: Callable[[Path], Any], tmp_path: Path
) -> None:
    """Each goes through the whole image: 1 MB of them through 64 megapixels for ten minutes."""
    assert "more than 100 scans" in refuse(lambda: scans(20_000, read, tmp_path / "x.jpg"))
    assert scans(50, read, tmp_path / "x.jpg") is not None


AXES = [{"axis": [0, 0, 1], "offset": [x, 0, 0]} for x in (0, 1, 2, 3)]
TABLES = {
    "36^4 symmetries": (json.dumps({"x": {"symmetries_continuous": AXES}}), "more than"),
    "depth": ("[" * 100_000, "not readable as JSON"),
    "a list": ("[1, 2]", "no mapping"),
}


@pytest.mark.parametrize("what", TABLES)
def test_symmetries_that_multiply_are_refused(what: str, tmp_path: Path) -> None:
    text, told = TABLES[what]
    (tmp_path / "models_info.json").write_text(text)
    assert told in refuse(lambda: read_symmetries(tmp_path / "models_info.json", "x", 1.0, 36))


@pytest.mark.parametrize("order", ["<", ">"])
def test_a_packed_array_is_not_unpacked_without_end(order: str, tmp_path: Path) -> None:
    """256 MB of zeros in a MATLAB file of 1 MB."""
    size = 1 << 28
    parts = (6, 8, 6, 0, 5, 8, size // 8, 1, 1, 5)  # flags (double), dimensions, a name's length
    head = struct.pack(f"{order}2I", 14, size + 56) + struct.pack(f"{order}10I", *parts)
    head += b"poses\0\0\0" + struct.pack(f"{order}2I", 9, size - 8)
    packing = zlib.compressobj(1)
    packed = packing.compress(head)
    for _ in range(size >> 26):
        packed += packing.compress(bytes(1 << 26))
    packed += packing.flush()
    mark = struct.pack(f"{order}H", 0x0100) + (b"IM" if order == "<" else b"MI")
    text = b"MATLAB 5.0 MAT-file".ljust(124) + mark
    path = tmp_path / "000001-meta.mat"
    path.write_bytes(text + struct.pack(f"{order}2I", 15, len(packed)) + packed)
    assert "not readable as a MATLAB file" in refuse(lambda: read_meta(path))


def test_no_more_is_read_of_a_file_that_tells_no_size() -> None:
    path = Path("/proc/self/environ")  # its size is told as 0, as that of a file which grows later
    if not path.is_file() or len(path.read_bytes()) < 3:
        pytest.skip("there is no such file on this system")
    with pytest.raises(BadData, match=r"file too large .at most 2 bytes"):
        read_bytes(path, 2)
