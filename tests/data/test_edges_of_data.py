"""Readers, splits, caches and augmentations where what they are given is unusual or wrong."""

import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from tests.data.dataset_trees import bop_scene, pose
from tests.data.test_moving_scenes import SETTINGS

from posefilter.data.absent import find_absent
from posefilter.data.augmentation import PasteOccluder, RandomErasing, RollAndZoom
from posefilter.data.frames import FrameRecord, NotShown
from posefilter.data.module import PoseDataModule
from posefilter.data.photometric import ColorResponse, Jpeg, Sticker
from posefilter.data.readers.fat import FatReader
from posefilter.data.splits import split_records
from posefilter.errors import UserError
from posefilter.limits import BadData, check_picture
from posefilter.synthetic.generate import generate


def record(name: str, kind: str) -> FrameRecord:
    return FrameRecord(name, name.split("/")[0], 0, 0, 1, kind, 0, ())


def test_an_image_of_two_that_cannot_be_told_apart_does_not_lack_the_object(tmp_path: Path) -> None:
    generate(
        tmp_path / "two", 2, object="carton", workers=1, size=(96, 72), instances=2,
        distractors=(1, 1), progress=False,
    )  # fmt: skip
    reader = FatReader(tmp_path / "two", meshes=None)  # which could tell them apart
    images = {image for image, name in reader.unlisted if name == "carton"}
    assert images
    assert not images & {one.name for one in reader.records() if one.object == "carton"}
    others = [one for one in reader.records() if one.name in images]
    assert others
    assert find_absent(others, [], "carton")
    assert not find_absent(others, [], "carton", reader.unlisted)


def test_a_broken_record_does_not_make_all_images_lack_the_object(tmp_path: Path) -> None:
    skewed = pose()
    skewed[:3, 0] *= 2
    bop_scene(tmp_path / "000001", [[(2, pose())], [(2, skewed)], [(1, pose())], [(1, pose())]])
    data = PoseDataModule(
        "bop", tmp_path, "003_cracker_box", split={"val": 1.0}, workers=0, progress=False
    )
    with pytest.raises(UserError, match="rotation"):
        data.absent_dataset("val")


@pytest.mark.parametrize(
    ("step", "key"),
    [
        (lambda: RollAndZoom(zoom=(2.6, 0.7)), r"zoom=\[2\.6, 0\.7\]"),
        (lambda: Jpeg(quality=(95, 40)), r"quality=\[95, 40\]"),
        (lambda: PasteOccluder(size=(0.18, 0.04)), r"size=\[0\.18, 0\.04\]"),
        (lambda: RandomErasing(size=(0.18, 0.02)), r"size=\[0\.18, 0\.02\]"),
        (lambda: RandomErasing(max_rectangles=-2), "max_rectangles=-2"),
        (lambda: Sticker(size=(0.5, 0.15)), r"size=\[0\.5, 0\.15\]"),
        (lambda: ColorResponse(gain=(0.0, 2.0)), r"gain=\[0\.0, 2\.0\]"),
    ],
)
def test_ranges_of_augmentations_are_checked_before_the_first_image(step: Any, key: str) -> None:
    with pytest.raises(UserError, match=f"data.augment: {key}"):
        step()


def test_a_share_that_is_none_is_refused(tmp_path: Path) -> None:
    records = [record(f"scene{number}/0", "box") for number in range(10)]
    for split in ({"train": True, "test": 0.2}, {"train": 0.5, "test": []}):
        with pytest.raises(UserError, match=r"data\.split\.(train|test)="):
            split_records(records, split, 0, tmp_path)


def test_both_cameras_see_the_cover_alone(tmp_path: Path) -> None:
    """A board before a small object hides it from the right camera, too."""
    wanted: dict[str, Any] = {
        **SETTINGS, "stereo": True, "distractors": (0, 0), "moving": "object", "size": (96, 72),
        "object": "tuna_can", "frames_per_scene": 8, "occluded_fraction": 0.0,
    }  # fmt: skip
    generate(tmp_path / "pair", 8, **wanted)
    seen = {}
    for camera in ("left", "right"):
        reader = FatReader(tmp_path / "pair", "tuna_can", cameras=(camera,))
        seen[camera] = len(reader.records())
        for i in range(len(reader.records())):
            try:
                reader.read(i)
            except NotShown:
                seen[camera] -= 1
    assert seen["left"] == seen["right"] == 6


def test_a_deleted_cache_ends_in_one_line(tmp_path: Path) -> None:
    bop_scene(tmp_path / "data" / "000001", [[(1, pose())], [(1, pose())], [(1, pose())]])
    data = PoseDataModule(
        "bop", tmp_path / "data", "obj_000001", split={"test": 1.0}, workers=0, progress=False,
        cache="disk", cache_dir=tmp_path / "cache",
    )  # fmt: skip
    frames = data.test_dataset
    assert len(frames) == 3
    shutil.rmtree(tmp_path / "cache")
    with pytest.raises(UserError, match="was deleted while it was in use"):
        frames[0]


def test_a_picture_that_is_cut_off_is_no_unknown_kind(tmp_path: Path) -> None:
    path = tmp_path / "depth.tif"
    cv2.imwrite(str(path), np.full((40, 60), 700, np.uint16))
    data = path.read_bytes()
    with pytest.raises(BadData, match="truncated or corrupt image"):
        check_picture(path, data[: len(data) // 2])
