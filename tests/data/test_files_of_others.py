"""Files as other tools write them: what is meant is read, and what is not is told with a remedy."""

import io
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import ExifTags, Image

from posefilter.data.readers.decode import read_color, read_depth, read_label
from posefilter.errors import BadData

DEPTH = np.array([[0.5, 0.0, 1.25], [2.0, 0.75, 3.0]], np.float32)


def write_jpeg(path: Path, orientation: int | None) -> None:
    """Write a JPEG, with EXIF that says how it is turned unless that is None."""
    exif = Image.Exif()
    if orientation is not None:
        exif[ExifTags.Base.Orientation] = orientation
    Image.fromarray(np.full((8, 6, 3), 90, np.uint8)).save(path, exif=exif)


@pytest.mark.parametrize("orientation", [2, 3, 6, 8])
def test_a_picture_that_is_stored_turned_is_told(orientation: int, tmp_path: Path) -> None:
    path = tmp_path / "a.jpg"
    write_jpeg(path, orientation)
    told = rf"a\.jpg: is stored turned \(EXIF orientation {orientation}\) \(save it as it is shown"
    with pytest.raises(BadData, match=told):
        read_color(path)


@pytest.mark.parametrize("orientation", [None, 1, 0])
def test_a_picture_that_is_stored_upright_is_read(orientation: int | None, tmp_path: Path) -> None:
    path = tmp_path / "a.jpg"
    write_jpeg(path, orientation)
    assert read_color(path).shape == (8, 6, 3)


def test_depth_is_read_of_arrays_and_pictures_of_any_shape_and_case(tmp_path: Path) -> None:
    for name, array in (
        ("a.NPY", DEPTH),
        ("first.npy", DEPTH[None]),
        ("last.npy", DEPTH[..., None]),
        ("double.npy", DEPTH.astype(np.float64)),
    ):
        with (tmp_path / name).open("wb") as file:
            np.save(file, array)
        np.testing.assert_array_equal(read_depth(tmp_path / name, 1.0), DEPTH)
    Image.fromarray((1000 * DEPTH).astype(np.int32)).save(tmp_path / "a.tiff")
    np.testing.assert_allclose(read_depth(tmp_path / "a.tiff", 1000.0), DEPTH, rtol=1e-6)


def test_negative_depth_is_unknown_unless_most_is(tmp_path: Path) -> None:
    path = tmp_path / "a.npy"
    np.save(path, np.where(DEPTH == 0, -1, DEPTH))
    np.testing.assert_array_equal(read_depth(path, 1.0), DEPTH)
    np.save(path, -DEPTH)
    with pytest.raises(BadData, match=r"depth is negative \(-3.0; along -z\?\)"):
        read_depth(path, 1.0)


def make_double_tiff() -> bytes:
    """Return a TIFF of 64-bit floats, as OpenCV writes them."""
    return cv2.imencode(".tiff", DEPTH.astype(np.float64))[1].tobytes()


def make_archive() -> bytes:
    """Return what np.savez writes."""
    file = io.BytesIO()
    np.savez(file, DEPTH)
    return file.getvalue()


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (make_double_tiff(), "save 32-bit floats"),
        (make_archive(), r"as \.npz is: save the array by np\.save"),
        (b"version https://git-lfs.github.com/spec/v1\n", "run git lfs pull"),
        (b"<!DOCTYPE html><html>404</html>", "a page of the web"),
        (b"v/1\x01\x02\x00\x00\x00", "it is an EXR"),
    ],
    ids=["64-bit TIFF", "npz", "Git LFS", "HTML", "EXR"],
)
def test_what_is_no_picture_is_called_what_it_is(content: bytes, told: str, tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    path.write_bytes(content)
    with pytest.raises(BadData, match=rf"a\.png: is no image that can be read \(.*{told}"):
        read_depth(path, 1000.0)


def test_a_folder_is_told_as_one(tmp_path: Path) -> None:
    with pytest.raises(BadData, match="is a folder, not a file"):
        read_color(tmp_path)


def test_arrays_that_are_no_depth_are_told(tmp_path: Path) -> None:
    path = tmp_path / "a.npy"
    np.save(path, np.zeros((2, 3, 3)))
    with pytest.raises(BadData, match=r"no array \(H, W\) of numbers \(found float64 \(2, 3, 3\)"):
        read_depth(path, 1.0)


def test_depth_given_as_color_is_told(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    cv2.imwrite(str(path), np.ones((4, 4), np.uint16))
    with pytest.raises(BadData, match=r"not 8-bit \(found uint16; is it the depth\?"):
        read_color(path)


@pytest.mark.parametrize("name", ["a.npy", "a.npz", "a.exr"])
def test_color_that_is_no_image_is_not_advised_what_depth_is(name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    if name == "a.exr":
        path.write_bytes(b"v/1\x01\x02")
    else:
        (np.save if name == "a.npy" else np.savez)(path, np.zeros((4, 4, 3), np.uint8))
    with pytest.raises(BadData, match=r"color is read of images alone.*\(save a PNG\)"):
        read_color(path)


@pytest.mark.parametrize("form", ["PNG", "TIFF", "WEBP"])
def test_alpha_is_dropped_and_not_multiplied_with(form: str, tmp_path: Path) -> None:
    picture = np.full((8, 8, 4), 200, np.uint8)
    picture[:4, :, 3], picture[4:, :, 3] = 128, 1
    path = tmp_path / f"a.{form.lower()}"
    options = {"lossless": True, "exact": True} if form == "WEBP" else {}
    Image.fromarray(picture).save(path, form, **options)
    np.testing.assert_array_equal(read_color(path), picture[..., :3])


def test_of_a_palette_the_indices_are_the_classes(tmp_path: Path) -> None:
    ids = np.array([[0, 1], [2, 3]], np.uint8)
    image = Image.fromarray(ids, "P")
    image.putpalette([0, 0, 0, 128, 0, 0, 0, 128, 0, 90, 90, 90])
    image.save(tmp_path / "label.png")
    np.testing.assert_array_equal(read_label(tmp_path / "label.png"), ids)
