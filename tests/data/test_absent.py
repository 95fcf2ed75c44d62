"""Frames without the object: rendered by leaving it out, and found in a dataset."""

import json
from pathlib import Path

import numpy as np
import pytest
from tests.data.dataset_trees import bop_scene, pose, write_mesh, ycb_frame

from posefilter.data.absent import deal_images, find_absent, hide_annotation
from posefilter.data.frames import FrameRecord
from posefilter.data.loaders import make_loader
from posefilter.data.module import PoseDataModule
from posefilter.errors import UserError
from posefilter.synthetic.generate import generate

SIZE = (96, 72)
CARTON = "003_cracker_box"


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return twelve frames in six scenes, of which some lack the carton."""
    out = tmp_path_factory.mktemp("absent") / "scenes"
    generate(
        out,
        12,
        object="carton",
        workers=1,
        size=SIZE,
        distractors=(1, 2),
        frames_per_scene=2,
        progress=False,
        absent_fraction=0.5,
    )
    return out


def list_classes(path: Path) -> set[str]:
    return {one["class"] for one in json.loads(path.read_text())["objects"]}


def test_some_frames_lack_the_object_and_the_rest_is_as_it_was(
    scenes: Path, tmp_path: Path
) -> None:
    files = sorted(scenes.glob("mixed/*/[0-9]*.left.json"))
    lacking = [file for file in files if "carton_16k" not in list_classes(file)]
    assert 2 <= len(lacking) <= 10
    generate(
        tmp_path / "whole",
        12,
        object="carton",
        workers=1,
        size=SIZE,
        distractors=(1, 2),
        frames_per_scene=2,
        progress=False,
    )
    for file in files:
        twin = tmp_path / "whole" / file.relative_to(scenes)
        picture, other = (one.with_name(one.name.replace("json", "jpg")) for one in (file, twin))
        assert (picture.read_bytes() == other.read_bytes()) == (file not in lacking)
    with pytest.raises(UserError, match="absent_fraction=2"):
        generate(tmp_path / "no", 1, object="carton", absent_fraction=2, progress=False)


def test_the_dataset_tells_them_apart(scenes: Path) -> None:
    split = {"train": 0.4, "val": 0.2, "test": 0.4}
    data = PoseDataModule("scenes", scenes, "carton", split=split, workers=0, progress=False)
    shown = {record.name for part in ("train", "val", "test") for record in data.records(part)}
    seen: list[str] = []
    for part in ("val", "test"):
        frames = data.absent_dataset(part)
        names = {record.name for record in frames.records}
        assert not names & shown
        others = {
            record.group
            for other in ("train", "val", "test")
            for record in data.records(other)
            if other != part
        }
        assert not others & {record.group for record in frames.records}
        seen += names
        for batch in make_loader(frames, 4, 0):
            hidden = hide_annotation(batch)
            assert not bool(hidden.mask.any())
            assert bool((hidden.camera_from_object == np.eye(4)).all())
            assert bool((hidden.rgb == batch.rgb).all())
    assert seen
    assert len({*seen}) == len(seen)  # none in two splits
    part = max(("val", "test"), key=lambda part: len(data.absent_dataset(part)))
    assert len(data.absent_dataset(part, 1)) == 1


def test_a_dataset_may_lack_the_object_altogether(tmp_path: Path) -> None:
    bop_scene(tmp_path / "000001", [[(2, pose())], [(2, pose())]])
    split = {"val": 1.0}
    data = PoseDataModule("bop", tmp_path, "obj_000001", split=split, workers=0, progress=False)
    assert len(data.absent_dataset("val")) == 2
    own = PoseDataModule("bop", tmp_path, "obj_000002", split=split, workers=0, progress=False)
    assert len(own.absent_dataset("val")) == 0


def test_an_image_that_is_annotated_as_empty_lacks_the_object(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    root, data = write_mesh(tmp_path / "meshes", "obj_000001"), tmp_path / "data"
    for number in range(4):
        bop_scene(data / f"{number:06d}", [[(1, pose())], [], [(1, pose())], []])
    how = {"meshes": root, "mesh_scale": 1.0, "progress": False, "split": {"val": 0.5, "test": 0.5}}
    module = PoseDataModule("bop", data, "obj_000001", **how)
    assert len(module.records("val")) == 4, "others are not listed"
    empty = {part: module.absent_dataset(part) for part in ("val", "test")}
    names = {part: {record.name for record in found.records} for part, found in empty.items()}
    assert [len(found) for found in names.values()] == [4, 4]
    assert not names["val"] & names["test"]
    assert {name[-1] for found in names.values() for name in found} == {"1", "3"}
    (batch,) = make_loader(empty["val"], 8, 0)
    assert not batch.mask.any()
    assert batch.depth.max() > 0.5
    assert "annotates one class" not in caplog.text


def test_images_without_the_object_that_cannot_be_read_are_told_or_counted(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    scene = tmp_path / "000001"
    bop_scene(scene, [[(1, pose())], [], [(1, pose())], [], []])
    (scene / "depth" / "000001.png").unlink()
    (scene / "rgb" / "000003.png").write_bytes(b"")
    how = {"split": {"test": 1.0}, "workers": 0, "progress": False}
    data = PoseDataModule("bop", tmp_path, "obj_000001", **how)
    with pytest.raises(UserError, match=r"00000[13]\.png: .* data\.on_error=skip"):
        data.absent_dataset("test")
    skipping = PoseDataModule("bop", tmp_path, "obj_000001", on_error="skip", **how)
    assert [one.im_id for one in skipping.absent_dataset("test").records] == [4]
    told = "left out of the frames without obj_000001: {}.png: {} (1 such)"
    assert told.format(scene / "depth" / "000001", "missing file") in caplog.text
    empty = "truncated or corrupt image (the file is empty)"
    assert told.format(scene / "rgb" / "000003", empty) in caplog.text


def test_masks_of_other_objects_are_not_needed(tmp_path: Path) -> None:
    far = pose(position=(0, 0, 7.0))  # beyond what depth is kept, and hidden
    bop_scene(tmp_path / "bop" / "000001", [[(1, pose())], [(2, pose())], [(2, far), (3, far)]])
    for file in (tmp_path / "bop" / "000001" / "mask_visib").glob("00000[12]_*"):
        file.unlink()
    twice = [(3, pose()), (3, pose(position=(0.05, 0.05, 0.5)))]
    for number, shown in enumerate([[(2, pose())], twice, twice]):
        ycb_frame(tmp_path / "ycb" / "0001" / f"{number:06d}", shown, np.eye(4))
    for source, name, root in (("bop", "obj_000001", "bop"), ("ycb_video", CARTON, "ycb")):
        how = {"split": {"test": 1.0}, "workers": 0, "progress": False}
        frames = PoseDataModule(source, tmp_path / root, name, **how).absent_dataset("test")
        assert {one.im_id for one in frames.records} == {1, 2}
        (batch,) = make_loader(frames, 2, 0)
        assert not batch.mask.any()
        assert batch.depth.max() > 0.5


def test_an_image_counts_once_and_only_where_the_object_is_not_listed() -> None:
    def record(name: str, group: str, kind: str, number: int = 0) -> FrameRecord:
        return FrameRecord(name, group, 0, number, 1, kind, number, ())

    own = [record("a/0", "a", "box")]
    everything = [
        record("a/0", "a", "can", 1),  # the box is here
        record("a/1", "a", "can"),
        record("a/1", "a", "mug", 1),
        record("b/0", "b", "can"),  # a scene of the training
        record("c/0", "c", "can"),  # of no split
        record("c/1", "c", "box"),
    ]
    unlisted = {("c/2", "box")}
    everything.append(record("c/2", "c", "can"))
    found = find_absent(everything, own, "box", unlisted)
    assert [one.name for one in found] == ["a/1", "b/0", "c/0"]
    splits = {"train": [record("b/9", "b", "box", 9)], "val": own, "test": []}
    assert [one.name for one in deal_images(found, splits, "val")] == ["a/1", "c/0"]
    splits["test"] = [record("f/0", "f", "box")]
    found += [record(f"{group}/0", group, "can") for group in "de"]
    names = {part: [one.name for one in deal_images(found, splits, part)] for part in splits}
    assert names["val"] == ["a/1", "c/0", "e/0"]
    assert names["test"] == ["d/0"]


def frames(group: str, numbers: range, cameras: str = "") -> list[FrameRecord]:
    """Return a record of each image of a scene; of a pair `cameras` has a letter of each."""
    return [
        FrameRecord(f"{group}/{n:02d}{camera}", group, 0, n, 1, "can", n, ())
        for camera in cameras or [""]
        for n in numbers
    ]


def deal(
    found: list[FrameRecord], parts: dict[str, list[FrameRecord]], splits: tuple[str, ...]
) -> list[set[str]]:
    """Return the names of the images that each of the splits gets."""
    return [{one.name for one in deal_images(found, parts, split)} for split in splits]


@pytest.mark.parametrize("parts", [("train", "val", "test"), ("val", "test")])
def test_splits_of_one_scene_share_no_image_without_the_object(parts: tuple[str, ...]) -> None:
    found = frames("a", range(20, 40))
    sizes = {"train": 5, "val": 3, "test": 2}
    cut, first = {part: list[FrameRecord]() for part in sizes}, 0
    for part in parts:
        cut[part] = frames("a", range(first, first + sizes[part]))
        first += sizes[part]
    dealt = deal(found, cut, parts)
    assert set().union(*dealt) == {one.name for one in found}
    whole = sum(sizes[part] for part in parts)
    assert [len(names) for names in dealt] == [20 * sizes[part] // whole for part in parts]


def test_a_part_that_stands_for_another_has_its_images() -> None:
    found = frames("a", range(20, 40)) + frames("b", range(3)) + frames("c", range(3))
    first, second = frames("a", range(3)), frames("a", range(3, 5))
    everything = {one.name for one in found}
    val, test = deal(found, {"train": second, "val": first, "test": second}, ("val", "test"))
    assert (len(val), len(test)) == (12 + 3, 8 + 3)
    assert val | test == everything, "data.split={train: test}"
    val, test = deal(found, {"train": first, "val": second, "test": second}, ("val", "test"))
    assert val == test, "data.split={val: test}"
    assert len(val) == 8 + 6


def test_scenes_of_no_split_are_dealt_also_where_scenes_were_cut_by_images() -> None:
    cut = {"train": [], "val": frames("a", range(3)), "test": frames("a", range(3, 6))}
    found = [one for group in "bcd" for one in frames(group, range(4))]
    val, test = deal(found, cut, ("val", "test"))
    assert {name[0] for name in val} == {"b", "d"}
    assert {name[0] for name in test} == {"c"}
    whole = {**cut, "test": frames("e", range(3))}
    assert [len(names) for names in deal(found[:4], whole, ("val", "test"))] == [4, 0]


def test_one_scene_with_the_object_and_one_without_are_both_cut(tmp_path: Path) -> None:
    root, data = write_mesh(tmp_path / "meshes", "obj_000001"), tmp_path / "data"
    for number, kind in enumerate((1, 2)):
        bop_scene(data / f"{number:06d}", [[(kind, pose())] for _ in range(6)])
    how = {"meshes": root, "mesh_scale": 1.0, "progress": False, "split": {"val": 0.5, "test": 0.5}}
    module = PoseDataModule("bop", data, "obj_000001", **how)
    names = [{one.name[-1] for one in module.absent_dataset(part).records} for part in how["split"]]
    assert names == [{*"012"}, {*"345"}]


def test_no_stereo_pair_is_cut() -> None:
    cut = {"train": [], "val": frames("a", range(3)), "test": frames("a", range(3, 6))}
    for group in "ab":  # a scene that was cut, and one of no split
        found = frames(group, range(10, 15), cameras="lr")
        val, test = ({name[:4] for name in names} for names in deal(found, cut, ("val", "test")))
        assert val | test == {f"{group}/{n}" for n in range(10, 15)}
        assert not val & test
    right = frames("a", range(6), cameras="r")  # its twin shows the object
    val, test = deal(right, cut, ("val", "test"))
    assert val == {"a/00r", "a/01r", "a/02r"}
    twin = frames("a", range(2, 3), cameras="r")
    assert deal(twin, cut, ("val", "test")) == [{"a/02r"}, set()]


def test_images_that_annotate_one_class_each_may_show_others(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """LINEMOD's, for one: what is not annotated is not known to be away."""

    def told(frames: list[list[tuple[int, np.ndarray]]], name: str) -> bool:
        root = write_mesh(tmp_path / name / "meshes", "obj_000001")
        for number, frame in enumerate(frames):
            bop_scene(tmp_path / name / "data" / f"{number:06d}", [frame])
        caplog.clear()
        how = {"meshes": root, "mesh_scale": 1.0, "progress": False, "split": {"test": 1.0}}
        data = PoseDataModule("bop", tmp_path / name / "data", "obj_000001", **how)
        data.absent_dataset("test")
        return "annotates one class" in caplog.text

    other = pose(position=(0.1, 0.05, 0.6))
    assert told([[(1, pose())], [(2, pose())]], "one")
    assert not told([[(1, pose()), (2, other)], [(2, pose())]], "both")
