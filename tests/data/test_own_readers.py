"""A reader of a plug-in that breaks its protocol is refused in one line that names it, the frame
and the field.
"""

import dataclasses
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from dataset_trees import K, fat_tree, pose, truth, write_mesh

from posefilter.checking.check import check_dataset
from posefilter.data.frames import FrameRecord, Sample
from posefilter.data.module import PoseDataModule
from posefilter.data.readers.base import BaseReader
from posefilter.data.readers.checked import index_records, read_checked
from posefilter.data.readers.fat import FatReader
from posefilter.data.readers.registry import READERS, open_reader, register_reader
from posefilter.errors import UserError
from posefilter.meshes.store import MeshStore


def good() -> Sample:
    """Return a sample as a reader should."""
    depth = truth(pose()).astype(np.float32)
    rgb, T = np.full((*depth.shape, 3), 90, np.uint8), pose().astype(np.float32)
    return Sample(rgb, depth, depth > 0, K.astype(np.float32), T, 0, 0, float("nan"))


class OwnReader(BaseReader):
    """Six scenes of one frame, each the same."""

    change: Callable[[Sample], Sample] = staticmethod(lambda sample: sample)
    rename: Callable[[FrameRecord], FrameRecord] = staticmethod(lambda record: record)

    def __init__(
        self,
        root: Path,
        objects: str | None = None,
        meshes: MeshStore | None = None,
        on_error: str = "raise",
    ) -> None:
        super().__init__(root, meshes, on_error)
        self.objects = ("toy",)

    def records(self) -> Sequence[FrameRecord]:
        names = [(f"s{i}", f"s{i}/0", i) for i in range(6)]
        return [
            self.rename(FrameRecord(name, group, i, 0, 1, "toy", 0, (self.root / f"{i}.png",)))
            for group, name, i in names
        ]

    def read(self, i: int) -> Sample:
        return self.change(good())

    def others(self, i: int) -> np.ndarray:
        return np.zeros_like(good().mask)

    def native_from_mesh(self, name: str) -> np.ndarray:
        return np.eye(4)


@pytest.fixture
def root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    write_mesh(tmp_path / "meshes", "toy")
    monkeypatch.setitem(READERS, "own", OwnReader)
    return tmp_path


def open_data(root: Path, **how: str) -> PoseDataModule:
    settings = {"meshes": root / "meshes", "progress": False, "cache": "memory"} | how
    data = PoseDataModule("own", root, "toy", **settings)
    data.setup()
    return data


def replaced(**how: Callable[[Sample], object]) -> Callable[[Sample], Sample]:
    return lambda sample: dataclasses.replace(
        sample, **{name: change(sample) for name, change in how.items()}
    )


def scaled(factor: float) -> Callable[[Sample], np.ndarray]:
    scale = np.diag([factor, factor, factor, 1]).astype(np.float32)
    return lambda sample: sample.camera_from_object @ scale


def moved(sample: Sample) -> np.ndarray:
    out = sample.camera_from_object.copy()
    out[:3, 3] *= 1000
    return out


def mirrored(sample: Sample) -> np.ndarray:
    return sample.camera_from_object @ np.diag([1, 1, -1, 1]).astype(np.float32)


TYPES = {
    "tuple": (lambda sample: (sample.rgb, sample.depth), "returned a tuple"),
    "float rgb": (replaced(rgb=lambda s: s.rgb / np.float32(255)), "rgb is float32"),
    "channels first": (replaced(rgb=lambda s: s.rgb.transpose(2, 0, 1)), "channels first?"),
    "alpha": (replaced(rgb=lambda s: np.dstack([s.rgb, s.rgb[..., :1]])), "rgb is uint8"),
    "no depth": (replaced(depth=lambda s: None), "depth is of type NoneType"),
    "whole depth": (replaced(depth=lambda s: (s.depth * 1e3).astype(np.uint16)), "millimeters?"),
    "half the depth": (replaced(depth=lambda s: s.depth[::2, ::2]), "depth is float32"),
    "mask of 255": (replaced(mask=lambda s: s.mask.astype(np.uint8) * 255), "mask is uint8"),
    "list": (replaced(intrinsics=lambda s: [190, 188, 78, 61]), "intrinsics is of type list"),
    "3 x 4": (replaced(camera_from_object=lambda s: s.camera_from_object[:3]), "(3, 4)"),
    "object": (replaced(object_id=lambda s: 7), "object_id is 7"),
}
NUMBERS = {
    "depth in mm": (replaced(depth=lambda s: s.depth * 1000), "depth is not plausible"),
    "NaN": (replaced(depth=lambda s: np.where(s.depth > 0, s.depth, np.nan)), "depth holds NaN"),
    "negative": (replaced(depth=lambda s: -s.depth), "depth is negative"),
    "no camera": (replaced(intrinsics=lambda s: s.intrinsics.T), "transposed?"),
    "NaN pose": (
        replaced(camera_from_object=lambda s: s.camera_from_object * np.nan),
        "camera_from_object holds NaN",
    ),
    "transposed": (
        replaced(camera_from_object=lambda s: s.camera_from_object.T),
        "camera_from_object is no rotation.*transposed?",
    ),
    "scaled": (replaced(camera_from_object=scaled(1.1)), "its scale is 1.1"),
    "mirrored": (replaced(camera_from_object=mirrored), "a mirror image"),
    "pose in mm": (replaced(camera_from_object=moved), "millimeters instead of meters"),
}


@pytest.mark.parametrize("mistake", [*TYPES, *NUMBERS])
@pytest.mark.parametrize("cache", ["memory", "none"])
def test_a_wrong_sample_is_one_line_with_reader_frame_and_field(
    root: Path, monkeypatch: pytest.MonkeyPatch, mistake: str, cache: str
) -> None:
    change, words = (TYPES | NUMBERS)[mistake]
    monkeypatch.setattr(OwnReader, "change", staticmethod(change))
    with pytest.raises(UserError, match=words) as refusal:
        open_data(root, cache=cache)
    said = str(refusal.value)
    assert "\n" not in said
    assert "OwnReader.read" in said
    assert re.search(r"s[0-5]/0", said)


@pytest.mark.parametrize("mistake", NUMBERS)
def test_frames_with_wrong_numbers_can_be_skipped_those_of_wrong_types_cannot(
    root: Path, monkeypatch: pytest.MonkeyPatch, mistake: str
) -> None:
    change, calls = NUMBERS[mistake][0], []

    def once(sample: Sample) -> Sample:
        calls.append(sample)
        return change(sample) if len(calls) == 1 else sample

    monkeypatch.setattr(OwnReader, "change", staticmethod(once))
    data = open_data(root, on_error="skip", split={"train": 1.0}, workers=0)
    assert len(data.train_dataset) == 5
    monkeypatch.setattr(OwnReader, "change", staticmethod(TYPES["alpha"][0]))
    with pytest.raises(UserError, match="rgb is uint8"):
        open_data(root, on_error="skip")


def test_what_a_reader_may_leave_open(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Doubles, depth that is unknown everywhere, and a far wall."""
    for change in (
        replaced(depth=lambda s: s.depth.astype(np.float64)),
        replaced(camera_from_object=lambda s: s.camera_from_object.astype(np.float64)),
        replaced(depth=lambda s: np.zeros_like(s.depth)),
        replaced(depth=lambda s: np.where(s.depth > 0, s.depth, np.float32(90))),
    ):
        monkeypatch.setattr(OwnReader, "change", staticmethod(change))
        assert len(open_data(root).train_dataset) == 4


def test_two_records_of_one_key_are_named(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    same = staticmethod(lambda record: dataclasses.replace(record, name="same/0"))
    monkeypatch.setattr(OwnReader, "rename", same)
    with pytest.raises(UserError) as refusal:
        open_data(root)
    said = str(refusal.value)
    assert said.startswith("OwnReader.records: record 0 'same/0#0' (")
    assert "and record 1 'same/0#0' (" in said
    assert "same name and instance" in said
    assert "\n" not in said


def test_two_images_of_one_name_are_named(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A cache would show the first image for both."""
    same = staticmethod(lambda one: dataclasses.replace(one, name="s/0", instance=one.scene_id))
    monkeypatch.setattr(OwnReader, "rename", same)
    with pytest.raises(UserError, match="have the same name;"):
        open_data(root)


def test_the_check_of_a_dataset_tells_too(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    reader, meshes = OwnReader(root), MeshStore(root / "meshes")
    monkeypatch.setattr(OwnReader, "change", staticmethod(NUMBERS["NaN"][0]))
    problems = check_dataset(reader, meshes)["problems"]
    assert any("OwnReader.read: depth holds NaN" in problem for problem in problems)
    monkeypatch.setattr(OwnReader, "change", staticmethod(TYPES["alpha"][0]))
    with pytest.raises(UserError, match=r"OwnReader\.read, frame s0/0: rgb is uint8"):
        check_dataset(reader, meshes)


def test_a_class_that_is_defined_again_takes_its_own_place_and_no_other(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def define() -> type[BaseReader]:
        class Mine(OwnReader):
            pass

        return Mine

    monkeypatch.setitem(READERS, "mine", define())
    again = define()
    register_reader("mine", again)
    assert READERS["mine"] is again
    with pytest.raises(UserError, match=r"data.source=fat: a reader .* exists, .*\.FatReader$"):
        register_reader("fat", OwnReader)


class WithoutMeshes(BaseReader):
    def __init__(self, root: Path, objects: str | None = None) -> None:
        super().__init__(root, None, "raise")


class Failing(OwnReader):
    def __init__(self, *args: Any, stride: int, **given: Any) -> None:
        super().__init__(*args, **given)
        sorted([stride], by=3)  # type: ignore[call-overload]


def test_a_reader_that_takes_other_arguments_is_named(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(READERS, "mine", WithoutMeshes)
    with pytest.raises(UserError) as refusal:
        open_reader("mine", root, stride=2)
    said = str(refusal.value)
    assert said.startswith(f"data.source=mine: {__name__}.WithoutMeshes must take (root, objects, ")
    assert said.endswith("(got an unexpected keyword argument 'meshes')")


def test_what_is_wrong_with_the_options_is_told_and_an_error_of_the_readers_own_is_left(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(READERS, "mine", Failing)
    with pytest.raises(
        UserError, match=r"^data\.options: missing a required .* of the mine reader"
    ):
        open_reader("mine", root)
    with pytest.raises(UserError, match=r"^data\.options: got .* 'strid' of the own reader"):
        open_reader("own", root, strid=2)
    with pytest.raises(TypeError, match="sort"):
        open_reader("mine", root, stride=2)


@pytest.mark.parametrize("name", ["records", "read", "others", "native_from_mesh"])
def test_a_function_that_a_reader_lacks_is_named(root: Path, name: str) -> None:
    class Lacks(BaseReader):
        pass

    reader = Lacks(root, None, "raise")
    given = {"records": (), "native_from_mesh": ("toy",)}.get(name, (0,))
    with pytest.raises(NotImplementedError, match=rf"^Lacks must implement {name}\(\)$"):
        getattr(reader, name)(*given)


def test_what_a_builtin_reader_reads_passes(tmp_path: Path) -> None:
    fat_tree(tmp_path, scenes=2, frames=2)
    reader = FatReader(tmp_path, "toy")
    records = reader.records()
    assert len(index_records(reader, records)) == len(records)
    for i, record in enumerate(records):
        assert read_checked(reader, i, record).frame_id == i
