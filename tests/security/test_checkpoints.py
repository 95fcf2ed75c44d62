"""A checkpoint's file is data: nothing in it runs, and what it claims to hold must be in it."""

import io
import os
import pickle
import tarfile
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from posefilter.cli.checkpoints import method_of, read_checkpoint
from posefilter.errors import UserError

Save = Callable[[dict[str, Any]], Path]


class Harm:
    """Runs a command when it is unpickled."""

    def __init__(self, command: str) -> None:
        self.command = command

    def __reduce__(self) -> tuple[Any, ...]:
        return os.system, (self.command,)


def rewritten(
    path: Path, change: Callable[[zipfile.ZipFile, zipfile.ZipInfo, bytes], None]
) -> Path:
    """Write an archive anew, part by part."""
    with zipfile.ZipFile(path) as archive:
        parts = [(info, archive.read(info)) for info in archive.infolist()]
    with zipfile.ZipFile(path, "w") as archive:
        for info, data in parts:
            change(archive, info, data)
    return path


def pickled(path: Path, secret: Path) -> Path:
    def change(archive: zipfile.ZipFile, info: zipfile.ZipInfo, data: bytes) -> None:
        harm = pickle.dumps(Harm(f"touch {secret}/x"), 2)
        archive.writestr(info.filename, harm if info.filename.endswith("data.pkl") else data)

    return rewritten(path, change)


def compressed(path: Path, secret: Path) -> Path:
    def change(archive: zipfile.ZipFile, info: zipfile.ZipInfo, data: bytes) -> None:
        large = b"\0" * (200 << 20) if info.filename.endswith("/0") else data
        archive.writestr(info.filename, large, zipfile.ZIP_DEFLATED)

    return rewritten(path, change)


def linked(path: Path, secret: Path) -> Path:
    with zipfile.ZipFile(path, "a") as archive:
        info = zipfile.ZipInfo("archive/link")
        info.external_attr = 0o120777 << 16
        archive.writestr(info, str(secret))
    return path


def above(path: Path, secret: Path) -> Path:
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("archive/../../secret/x", "x")
    return path


def absolute(path: Path, secret: Path) -> Path:
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr(f"{secret}/x", "x")
    return path


def twice(path: Path, secret: Path) -> Path:
    with zipfile.ZipFile(path, "a") as archive, pytest.warns(UserWarning, match="Duplicate"):
        archive.writestr(archive.infolist()[0].filename, "x")
    return path


def overlapping(path: Path, secret: Path) -> Path:
    """Have every entry of the directory point at the largest part: small on disk, large in sum."""
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("archive/large", b"x" * (1 << 20))
        large = archive.getinfo("archive/large")
        for i in range(50):
            twin = zipfile.ZipInfo(f"archive/twin{i}")
            for name in ("header_offset", "file_size", "compress_size", "CRC"):
                setattr(twin, name, getattr(large, name))
            archive.filelist.append(twin)
            archive.NameToInfo[twin.filename] = twin
    return path


def legacy(path: Path, secret: Path) -> Path:
    path.write_bytes(pickle.dumps(Harm(f"touch {secret}/x")))
    return path


def old_tar(path: Path, secret: Path) -> Path:
    with tarfile.open(path, "w") as archive:
        data = pickle.dumps(Harm(f"touch {secret}/x"))
        info = tarfile.TarInfo("storages")
        info.size = len(data)
        archive.addfile(info, io.BytesIO(data))
    return path


def cut(path: Path, secret: Path) -> Path:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    return path


ARCHIVES = (pickled, compressed, linked, above, absolute, twice, overlapping, legacy, old_tar, cut)


@pytest.mark.parametrize("make", ARCHIVES, ids=lambda make: make.__name__)
def test_a_hostile_archive_is_refused(
    make: Callable[[Path, Path], Path],
    content: dict[str, Any],
    save: Save,
    secret: Path,
    watch: Any,
) -> None:
    path = make(save(content), secret)
    with watch, pytest.raises(UserError, match="checkpoint=") as told:
        read_checkpoint(path)
    assert "\n" not in str(told.value)


def large_by_strides() -> torch.Tensor:
    return torch.zeros(1).expand(1 << 20, 1 << 20)


def claims_more(path: Path) -> Path:
    """Have the pickle state a storage of 2^40 elements where the file holds 4242."""
    old, new = b"\x4d" + (4242).to_bytes(2, "little"), b"\x8a\x06" + (1 << 40).to_bytes(6, "little")

    def change(archive: zipfile.ZipFile, info: zipfile.ZipInfo, data: bytes) -> None:
        archive.writestr(
            info.filename, data.replace(old, new) if info.filename.endswith("data.pkl") else data
        )

    return rewritten(path, change)


def laughs() -> list[Any]:
    node: list[Any] = [0]
    for _ in range(30):
        node = [node] * 10
    return node


def calibrated(**changes: Any) -> Callable[[dict[str, Any]], Any]:
    """Return what gives a checkpoint a calibration, with some of it changed."""
    one = {"weights": [1.0, 0.5], "bias": 0.0}
    plain = {
        "features": ["a", "b"],
        "center": [0.0, 0.0],
        "scale": [1.0, 1.0],
        "presence": one,
        "success": one,
        "counts": {"right": 20, "wrong": 5, "absent": 20},
        "source": "fat",
        "quality": {"auroc": 0.9},
    }
    return lambda content: content.update(calibration={**plain, **changes})


CONTENTS: dict[str, Callable[[dict[str, Any]], Any]] = {
    "strides": lambda c: c["state_dict"].update({"x": large_by_strides()}),
    "strides in the object": lambda c: c["object_model"].update(
        points=torch.zeros(1).expand(1 << 40, 3)
    ),
    "strides in the optimizer": lambda c: c.update(
        optimizer_states=[{"state": {0: large_by_strides()}}]
    ),
    "sparse": lambda c: c["state_dict"].update(
        x=torch.sparse_coo_tensor(torch.zeros(1, 1).long(), [1.0], (1 << 40,))
    ),
    "no storage": lambda c: c["state_dict"].update(x=torch.empty(1 << 40, device="meta")),
    "8-bit floats": lambda c: c["object_model"].update(
        points=torch.zeros(5, 3).to(torch.float8_e4m3fn)
    ),
    "pairs of 4-bit floats": lambda c: c["state_dict"].update(
        x=torch.zeros(4, dtype=torch.uint8).view(torch.float4_e2m1fn_x2)
    ),
    "no elements of a large shape": lambda c: c["state_dict"].update(x=torch.empty(0, 1 << 60)),
    "a weight's name of two lines": lambda c: c["state_dict"].update({"a\nb": torch.zeros(1)}),
    "a weight's name that a terminal obeys": lambda c: c["state_dict"].update(
        {"a\x1b[2J": torch.zeros(1)}
    ),
    "a weight's name of 10 MB": lambda c: c["state_dict"].update({"a" * 10**7: torch.zeros(1)}),
    "no tensor": lambda c: c["state_dict"].update(x=[1]),
    "many values": lambda c: c.update(loops=laughs()),
    "a path for a name": lambda c: c["object_model"].update(name="../../secret"),
    "an absolute name": lambda c: c["object_model"].update(name="/etc"),
    "a name with a line": lambda c: c["object_model"].update(name="a\nb"),
    "another object": lambda c: c["object_model"].update(extra=1),
    "points that are none": lambda c: c["object_model"].update(points=torch.zeros(5, 2)),
    "a size that is none": lambda c: c["object_model"].update(radius=float("nan")),
    "no object": lambda c: c.update(object_model=[]),
    "no recipe": lambda c: c.update(recipe=[]),
    "more than a recipe": lambda c: c["recipe"].update(plugins=["os"]),
    "a calibration that is none": lambda c: c.update(calibration=[1]),
    "more than a calibration": calibrated(plugins=["os"]),
    "a calibration without end": calibrated(features=["a"] * 1000),
    "a feature twice": calibrated(features=["a", "a"]),
    "a feature with a path": calibrated(features=["a", "../b"]),
    "features that are no names": calibrated(features=["a", 1]),
    "a center that is too short": calibrated(center=[0.0]),
    "a center that is not finite": calibrated(center=[0.0, float("nan")]),
    "a center that is a tensor": calibrated(center=torch.zeros(2)),
    "a scale of zero": calibrated(scale=[1.0, 0.0]),
    "weights below zero": calibrated(presence={"weights": [1.0, -0.5], "bias": 0.0}),
    "weights without end": calibrated(success={"weights": [1.0, 1e30], "bias": 0.0}),
    "a bias that is a text": calibrated(presence={"weights": [1.0, 1.0], "bias": "0"}),
    "a regression with more": calibrated(presence={"weights": [1.0, 1.0], "bias": 0.0, "x": 1}),
    "counts below zero": calibrated(counts={"right": -1, "wrong": 5, "absent": 20}),
    "counts of other things": calibrated(counts={"right": 20}),
    "a source with a line": calibrated(source="a\nb"),
    "a quality that is none": calibrated(quality={"auroc": float("inf")}),
    "choices that are none": lambda c: c["recipe"]["choices"].update(model="a\nb"),
}


@pytest.mark.parametrize("what", CONTENTS)
def test_hostile_contents_are_refused(
    what: str, content: dict[str, Any], save: Save, watch: Any
) -> None:
    CONTENTS[what](content)
    path = save(content)
    with watch, pytest.raises(UserError, match="checkpoint") as told:
        method_of(read_checkpoint(path))
    assert "\n" not in str(told.value)
    assert str(told.value).isprintable()
    assert len(str(told.value)) < 1000


def test_a_storage_is_as_large_as_its_part(content: dict[str, Any], save: Save, watch: Any) -> None:
    content["state_dict"]["x"] = torch.zeros(4242)
    path = claims_more(save(content))
    with watch, pytest.raises(UserError, match="checkpoint=") as told:
        read_checkpoint(path)
    assert "\n" not in str(told.value)


def test_a_calibration_as_it_should_be_is_read(content: dict[str, Any], save: Save) -> None:
    """So that the others are refused for what was changed in them."""
    calibrated()(content)
    method = method_of(read_checkpoint(save(content)))
    assert method.calibration is not None
    assert method.calibration.features == ("a", "b")
    other = method_of(read_checkpoint(save(content)), {"filter": {"particles": 5}})
    assert other.calibration is None
    assert "another filter" in other.calibration_note


@pytest.mark.parametrize("share", [0.3, 0.5, 0.8])
def test_a_byte_that_is_not_what_was_written_is_told(share: float, tmp_path: Path) -> None:
    """As of a copy that failed: torch looks at no checksum, and would load other numbers."""
    shipped = Path(__file__).parents[2] / "weights" / "025_mug.ckpt"
    content = bytearray(shipped.read_bytes())
    content[int(share * len(content))] ^= 255
    path = tmp_path / "a.ckpt"
    path.write_bytes(content)
    with pytest.raises(UserError, match=r"a\.ckpt: is damaged: its part '.*' is not what was"):
        read_checkpoint(path)
    assert read_checkpoint(shipped)["object_model"]["name"] == "025_mug"
