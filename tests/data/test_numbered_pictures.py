"""The number of a frame is that in its file's name, where every file has one."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from posefilter.data.sequences import FolderVideo
from posefilter.errors import BadData, UserError


@pytest.mark.parametrize(
    ("names", "order", "numbers"),
    [
        (["000010", "000002"], ["000002", "000010"], [2, 10]),
        (["f10_rgb", "f9_rgb"], ["f9_rgb", "f10_rgb"], [9, 10]),
        (["2024_7", "2024_12"], ["2024_7", "2024_12"], [7, 12]),
        (["10_cam0", "9_cam0"], ["9_cam0", "10_cam0"], [9, 10]),
        (["2_cam1", "10_cam0"], ["10_cam0", "2_cam1"], [0, 1]),
        (["2.5", "1.75"], ["1.75", "2.5"], [0, 1]),  # seconds: two numbers
        (["b1", "a2"], ["a2", "b1"], [0, 1]),
        (["01", "1"], ["01", "1"], [0, 1]),
        (["a", "7"], ["7", "a"], [0, 1]),
    ],
)
def test_frames_are_in_the_order_of_their_numbers(
    names: list[str], order: list[str], numbers: list[int], tmp_path: Path
) -> None:
    for folder, picture in (
        ("rgb", np.zeros((4, 4, 3), np.uint8)),
        ("depth", np.ones((4, 4), np.uint16)),
    ):
        (tmp_path / folder).mkdir()
        for name in names:
            cv2.imwrite(str(tmp_path / folder / f"{name}.png"), picture)
    video = FolderVideo(tmp_path, np.eye(3), 1000.0)
    assert [(frame.name, frame.im_id) for frame in video] == [*zip(order, numbers, strict=True)]
    every_second = FolderVideo(tmp_path, np.eye(3), 1000.0, stride=2)
    assert [frame.im_id for frame in every_second] == numbers[::2]


def test_pictures_of_which_some_have_no_partner_are_named(tmp_path: Path) -> None:
    """Of names that agree in part, the place in the folder pairs the wrong ones."""
    for folder, numbers in (("rgb", (1, 2, 3)), ("depth", (2, 3, 4))):
        (tmp_path / folder).mkdir()
        for number in numbers:
            picture = np.ones((4, 4), np.uint16 if folder == "depth" else np.uint8)
            cv2.imwrite(str(tmp_path / folder / f"{number:06d}.png"), picture)
    with pytest.raises(UserError, match=r"rgb/000001\.png has no picture of its name in depth/"):
        FolderVideo(tmp_path, np.eye(3), 1000.0)


@pytest.mark.parametrize("shift", [0.004, -0.012])
def test_pictures_named_by_times_are_paired_by_order_where_that_is_nearest(
    shift: float, tmp_path: Path
) -> None:
    for folder, late in (("rgb", 0.0), ("depth", shift)):
        (tmp_path / folder).mkdir()
        for number in range(5):
            picture = np.ones((4, 4), np.uint16 if folder == "depth" else np.uint8)
            cv2.imwrite(str(tmp_path / folder / f"{1700.5 + number / 30 + late:.6f}.png"), picture)
    assert len(FolderVideo(tmp_path, np.eye(3), 1000.0)) == 5
    (tmp_path / "depth" / f"{1700.5 + shift:.6f}.png").rename(
        tmp_path / "depth" / "1712.000000.png"
    )
    with pytest.raises(UserError, match=r"rgb/1700\.5.* is paired by order .* is nearer in time"):
        FolderVideo(tmp_path, np.eye(3), 1000.0)


def test_pictures_that_are_counted_from_other_numbers_are_paired_by_order(tmp_path: Path) -> None:
    for folder, first in (("rgb", 0), ("depth", 10)):
        (tmp_path / folder).mkdir()
        for number in range(first, first + 5):
            picture = np.ones((4, 4), np.uint16 if folder == "depth" else np.uint8)
            cv2.imwrite(str(tmp_path / folder / f"{number}.png"), picture)
    assert [frame.im_id for frame in FolderVideo(tmp_path, np.eye(3), 1000.0)] == [*range(5)]


def write_pictures(root: Path, color: list[str], depth: list[str]) -> None:
    """Write pictures of these names."""
    for folder, names, kind in (("rgb", color, np.uint8), ("depth", depth, np.uint16)):
        (root / folder).mkdir()
        for name in names:
            cv2.imwrite(str(root / folder / name), np.ones((4, 4), kind))


def test_pictures_that_are_counted_alike_are_paired_wherever_counts_begin(tmp_path: Path) -> None:
    write_pictures(tmp_path, ["0_color.png", "1_color.png"], ["1_depth.png", "2_depth.png"])
    video = FolderVideo(tmp_path, np.eye(3), 1000.0)
    assert [frame.im_id for frame in video] == [0, 1]


def test_a_missing_number_is_told_and_not_paired_over(tmp_path: Path) -> None:
    """As of a recorder that dropped a picture of each: the number of pictures is the same."""
    color = [f"{number}_color.png" for number in (1, 2, 3)]
    write_pictures(tmp_path, color, [f"{number}_depth.png" for number in (1, 3, 4)])
    told = r"rgb/2_color\.png would be paired by order with number 3 in depth/: is number 2 missing"
    with pytest.raises(UserError, match=told):
        FolderVideo(tmp_path, np.eye(3), 1000.0)


@pytest.mark.parametrize("folder", ["rgb", "depth"])
def test_two_pictures_of_one_name_are_told(folder: str, tmp_path: Path) -> None:
    write_pictures(tmp_path, ["1.png", "2.png"], ["1.png", "2.png"])
    cv2.imwrite(str(tmp_path / folder / "1.tiff"), np.ones((4, 4), np.uint16))
    with pytest.raises(UserError, match=rf"{folder}/1\.png and {folder}/1\.tiff are of one name"):
        FolderVideo(tmp_path, np.eye(3), 1000.0)


def test_hidden_files_are_no_pictures_and_times_need_not_be_of_one_length(tmp_path: Path) -> None:
    names = [f"1700000000.{fraction}.png" for fraction in ("123", "25", "5")]
    write_pictures(tmp_path, names, names)
    (tmp_path / "rgb" / "._1700000000.123.png").write_bytes(b"of macOS")
    video = FolderVideo(tmp_path, np.eye(3), 1000.0)
    assert [(frame.name, frame.im_id) for frame in video] == [
        (Path(name).stem, place) for place, name in enumerate(names)
    ]


def test_depth_may_be_tiff_of_floats(tmp_path: Path) -> None:
    write_pictures(tmp_path, ["1.bmp"], [])
    cv2.imwrite(str(tmp_path / "depth" / "1.tiff"), np.full((4, 4), 1.5, np.float32))
    (frame,) = FolderVideo(tmp_path, np.eye(3), 1000.0)
    np.testing.assert_array_equal(frame.depth, np.full((4, 4), 1.5, np.float32))


def write_frames(folder: Path, sizes: list[tuple[int, int]]) -> None:
    """Write pictures 0.png, 1.png, ... of these heights and widths."""
    for name, kind in (("rgb", np.uint8), ("depth", np.uint16)):
        (folder / name).mkdir()
        for number, size in enumerate(sizes):
            cv2.imwrite(str(folder / name / f"{number}.png"), np.full(size, 100, kind))


def test_a_frame_of_another_size_than_the_first_is_named(tmp_path: Path) -> None:
    """The intrinsics are of one size: in a picture of another they would be wrong."""
    write_frames(tmp_path, [(24, 32), (24, 32), (12, 16)])
    video = FolderVideo(tmp_path, np.eye(3), 1000.0)
    assert [video.read(i).rgb.shape for i in range(2)] == [(24, 32, 3)] * 2
    with pytest.raises(UserError, match=r"2\.png: wrong image size \(16x12, but 0\.png says 32x24"):
        video.read(2)


def test_a_distortion_that_no_lens_has_is_named(tmp_path: Path) -> None:
    write_frames(tmp_path, [(24, 32)])
    K = np.array([[32.0, 0, 16], [0, 32, 12], [0, 0, 1]])
    assert FolderVideo(tmp_path, K, 1000.0, distortion=(0.1, 0, 0, 0)).read(0).depth.any()
    with pytest.raises(
        UserError, match=r"^frame .*: distortion=50,0,0,0: without it, .* % of the depth is"
    ):
        FolderVideo(tmp_path, K, 1000.0, distortion=(50, 0, 0, 0)).read(0)


def write_pair(folder: Path, name: str, depth_name: str, size: tuple[int, int]) -> None:
    """Write a color picture and its depth, whole numbers or floats by the name's ending."""
    for sub in ("rgb", "depth"):
        (folder / sub).mkdir(exist_ok=True)
    cv2.imwrite(str(folder / "rgb" / name), np.zeros((*size, 3), np.uint8))
    whole = np.full(size, 800, np.uint16)
    path = folder / "depth" / depth_name
    if path.suffix == ".npy":
        np.save(path, whole / np.float32(1000))
    else:
        cv2.imwrite(str(path), whole)


@pytest.mark.parametrize(
    ("depth", "meters"), [("0.png", False), ("0.tif", False), ("0.pgm", False), ("0.npy", True)]
)
def test_depth_is_in_meters_by_its_content_and_not_by_its_name(
    depth: str, meters: bool, tmp_path: Path
) -> None:
    write_pair(tmp_path, "0.png", depth, (4, 4))
    assert FolderVideo(tmp_path, np.eye(3), 1000.0).holds_meters is meters


def test_the_size_is_that_of_most_pictures_and_not_of_the_first(tmp_path: Path) -> None:
    for number, size in enumerate([(3, 4), (12, 16), (12, 16), (12, 16)]):
        write_pair(tmp_path, f"{number}.png", f"{number}.png", size)
    video = FolderVideo(tmp_path, np.eye(3), 1000.0)
    with pytest.raises(BadData, match=r"0\.png: wrong image size \(4x3, but 1\.png says 16x12\)"):
        video.read(0)
    assert [video.read(number).rgb.shape for number in (1, 2, 3)] == [(12, 16, 3)] * 3


def test_a_video_of_the_folder_one_stands_in_has_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_pair(tmp_path, "0.png", "0.png", (4, 4))
    monkeypatch.chdir(tmp_path)
    assert FolderVideo(Path(), np.eye(3), 1000.0).name == tmp_path.name
