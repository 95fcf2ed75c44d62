"""Read a camera's intrinsics from the files that cameras, calibrations and datasets come with."""

import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from posefilter.data.readers.decode import numbers, read_array, whole_number
from posefilter.errors import BadData, find_reason
from posefilter.limits import read_bytes, read_json, read_lines, read_yaml

_LARGEST = 1 << 24  # bytes of JSON
# of the focal lengths and the principal point: BOP's, RealSense's, NeRF's
_SINGLE = (("fx", "fy", "cx", "cy"), ("fx", "fy", "ppx", "ppy"), ("fl_x", "fl_y", "cx", "cy"))
_FOURS = ("intrinsics", "intrinsic")  # fx, fy, cx, cy in a list: Kalibr's
_MATRICES = ("camera_matrix", "intrinsic_matrix", "cam_K", "K", "k")
# that of the color image first: depth is aligned to it
_INNER = ("intrinsic", "intrinsics", "camera", "color_intrinsics", "depth_intrinsics")
# keys of a list of coefficients, as `_plain` has them: everyone abbreviates them otherwise
_DISTORTION = re.compile(
    "(lens|camera)?dist(ortion)?(coef[a-z]*|param(eter)?s|vec(tor)?)?|coef[a-z]*|d"
)
_NAMES = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")  # of coefficients, in OpenCV's order
_PROJECTIONS = ("projection_matrix", "P", "p")
_MODELS = ("distortion_model", "model", "camera_model")  # keys of the kind of distortion
# kinds that are OpenCV's polynomial, as `distortion=` takes it
_POLYNOMIALS = (
    "", "none", "plumb_bob", "rational_polynomial", "brown_conrady", "radtan",
    "radial-tangential", "opencv", "pinhole",
)  # fmt: skip
# kinds whose images are no pinhole's even where all coefficients are 0
_WIDE = re.compile(
    ".*(fisheye|equi(dist|rect|solid)|kannala|spherical|panora|f_?theta).*"
    "|omni(directional)?|e?ucm|mei|ds|fov"
)
# parameters of COLMAP's models; f stands for fx and fy
_COLMAP = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    "FULL_OPENCV": ("fx", "fy", "cx", "cy", *_NAMES),
}
_COLMAP_LINE = re.compile(r"\s*\d+\s+[A-Z][A-Z_0-9]+\s+\d+\s+\d+\s.*")
# keys of an image's size, as `_plain` has them
_SIZES = (("width", "height"), ("imagewidth", "imageheight"), ("imgwidth", "imgheight"), ("w", "h"))
_BOTH_SIDES = ("imagesize", "imgsize", "resolution", "imageresolution", "size")


class CameraFile(NamedTuple):
    """What a file says of a camera."""

    K: np.ndarray  # camera matrix (3, 3), float64 [px]
    size: tuple[int, int] | None = None  # height and width of its images [px], if they are told
    distortion: tuple[float, ...] = ()  # of its lens, in OpenCV's order
    other_model: str = ""  # the distortion's kind, where that is not OpenCV's polynomial
    rectified: np.ndarray | None = None  # (3, 3) of its rectified images, where the file has one
    # as the file has them, whose unit differs between formats; several where images differ
    depth_scales: tuple[float, ...] = ()


def read_camera_file(path: Path) -> CameraFile:
    """Read JSON, YAML, XML, or a text or `.npy` of a matrix (3, 3) or of fx, fy, cx, cy; of a text,
    lines that begin with # are none of it.

    Known are fx, fy, cx, cy by name (BOP's `camera.json`, RealSense with ppx, ppy), a matrix of
    nine numbers, by rows or by columns (Open3D), ROS's camera_info and its calibration files,
    OpenCV's FileStorage (YAML, JSON, XML), Kalibr's and EuRoC's YAML of one pinhole camera, NeRF's
    `transforms.json` with fl_x, fl_y, cx, cy, COLMAP's `cameras.txt` of one camera, and BOP's
    `scene_camera.json` where all images have one camera.

    Raises:
        BadData: The file is missing, of none of these forms, or no camera's.
    """
    ending = path.suffix.lower()
    if ending in (".yaml", ".yml"):
        return _of_mapping(read_yaml(path), path)
    if ending == ".json":
        return _of_mapping(read_json(path, _LARGEST), path)
    if ending == ".xml":
        return _of_mapping(_read_xml(path), path)
    if ending == ".npz":
        raise BadData(path, "is an archive of arrays", "save the camera matrix alone, as .npy")
    words: Any
    if ending == ".npy":
        words = read_array(path).ravel()
    else:
        lines = [line for line in read_lines(path) if not line.startswith("#")]
        if any(map(_COLMAP_LINE.fullmatch, lines)):
            return _of_colmap(lines, path)
        words = " ".join(lines).translate(str.maketrans(",;[]()", "      ")).split()
    found = {"numbers": words}
    if len(words) == 4:
        return CameraFile(_matrix(numbers(found, "numbers", path, (4,)).tolist(), path))
    if len(words) == 9:
        return CameraFile(_orient(numbers(found, "numbers", path, (3, 3)), path))
    expected = "a matrix (3, 3), or fx, fy, cx, cy"
    raise BadData(path, "holds no camera", f"{len(words)} words; expected {expected}")


def _of_colmap(lines: list[str], path: Path) -> CameraFile:
    """Return the camera of a line `ID MODEL WIDTH HEIGHT PARAMETERS` of COLMAP's file."""
    cameras = [line.split() for line in lines if line.strip()]
    if len(cameras) > 1:
        raise BadData(path, f"holds several cameras: {len(cameras)} lines", "keep one of them")
    _, model, width, height, *values = cameras[0]
    names = _COLMAP.get(model)
    if names is None:
        advice = "rectify the images, and type fx,fy,cx,cy of the rectified"
        raise BadData(path, f"COLMAP's camera model {model[:40]} is not read", advice)
    found = numbers({"parameters": values}, "parameters", path, (len(names),)).tolist()
    content = dict(zip(names, found, strict=True)) | {"width": width, "height": height}
    if "f" in content:
        content["fx"] = content["fy"] = content.pop("f")
    # COLMAP has the center of the first pixel at 0.5, OpenCV has it at 0
    content |= {"cx": content["cx"] - 0.5, "cy": content["cy"] - 0.5}
    return _of_mapping(content, path)


def _read_xml(path: Path) -> dict[str, Any]:
    """Return what OpenCV's FileStorage has written as XML, as its YAML would be read."""
    data = read_bytes(path, _LARGEST)
    if b"<!" in data.replace(b"<!--", b""):  # entities multiply, and name other files
        raise BadData(path, "has XML's declarations (<!...>), which no camera file needs")
    try:
        root = ElementTree.fromstring(data)
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise BadData(path, "is no XML", find_reason(error)) from error
    if root.tag != "opencv_storage":
        raise BadData(path, "holds no camera", f"expected opencv_storage, found {root.tag[:40]}")
    content = dict[str, Any]()
    for one in root:
        words = (one.findtext("data") or "").split()
        text = (one.text or "").strip()
        content[one.tag] = {"data": [_number(x) for x in words]} if words else _number(text)
    return content


def _number(word: str) -> float | int | str:
    """Return a word as the number that it is, or as it is."""
    for kind in (int, float):
        with suppress(ValueError):
            return kind(word)
    return word


def _of_mapping(content: Any, path: Path) -> CameraFile:
    if (
        isinstance(content, list)
        and [len(row) for row in content if isinstance(row, list)] == [3] * 3
    ):
        content = {"K": content}
    if isinstance(content, list) and len(content) == 4:
        content = {"intrinsics": content}
    if not isinstance(content, Mapping):
        raise BadData(path, "holds no camera", "expected fx, fy, cx, cy or a matrix by name")
    kalibr = [key for key in content if re.fullmatch(r"cam\d+", str(key))]
    if len(kalibr) > 1:
        raise BadData(path, f"holds several cameras: {', '.join(kalibr)}", "keep one of them")
    _refuse_cameras_of_frames(content, path)
    names = (*kalibr, *_INNER)
    inner = (content[key] for key in names if isinstance(content.get(key), Mapping))
    for one in (content, *inner):
        K = _find_matrix(one, path)
        if K is not None:  # size and distortion may be beside the inner mapping
            return _of_camera({**content, **one}, K, path)
    images = [one for one in content.values() if isinstance(one, Mapping) and "cam_K" in one]
    if images and len(images) == len(content):
        cameras = np.stack([numbers(one, "cam_K", path, (3, 3)) for one in images])
        if np.ptp(cameras, axis=0).max() > 1e-6:
            raise BadData(path, "has another camera for each image", "type its numbers")
        scales = {scale for one in images for scale in _find_scale(one, path)}
        return CameraFile(_orient(cameras[0], path), depth_scales=(*sorted(scales),))
    some = ", ".join(map(str, [*content][:6]))
    raise BadData(path, "holds no camera", f"expected fx, fy, cx, cy or a matrix; it has {some}")


def _refuse_cameras_of_frames(content: Mapping[str, Any], path: Path) -> None:
    """Raise BadData where a `transforms.json` has cameras in its frames, or an angle alone."""
    frames, focal = content.get("frames"), {"fl_x", "fl_y", "fx", "fy"}
    if isinstance(frames, list) and any(
        isinstance(one, Mapping) and focal & one.keys() for one in frames
    ):
        raise BadData(path, "has another camera for each image", "type its numbers")
    if "camera_angle_x" in content and not focal & content.keys():
        advice = "fx is w / 2 / tan(camera_angle_x / 2): type fx,fy,cx,cy"
        raise BadData(path, "has an angle of view, and no fx, fy, cx, cy", advice)


def _of_camera(content: Mapping[str, Any], K: np.ndarray, path: Path) -> CameraFile:
    """Return a camera with what a mapping says beside its matrix."""
    size = _find_image_size(content, K, path)
    distortion = _listed(content, [key for key in content if _DISTORTION.fullmatch(_plain(key))])
    if distortion is None:
        coefficients = _find_named(content, path)
        if not any(coefficients):
            _refuse_other_distortion(content, path)
    else:
        count = np.asarray(distortion["data"], dtype=object).size
        coefficients = tuple(numbers(distortion, "data", path, (count,)).tolist())
    projection = _listed(content, _PROJECTIONS)
    P = None if projection is None else numbers(projection, "data", path, (3, 4))
    rectified = None if P is None or P[0, 0] <= 0 else P[:, :3]
    scale = _find_scale(content, path)
    other = _find_other_model(content)
    if not any(coefficients) and not _WIDE.fullmatch(other.lower()):
        return CameraFile(K, size, rectified=rectified, depth_scales=scale)
    return CameraFile(K, size, coefficients or (0.0,), other, rectified, scale)


def _plain(key: Any) -> str:
    """Return a key in lower case, without what parts its words."""
    return re.sub("[^a-z0-9]", "", str(key).lower())


def _find_image_size(
    content: Mapping[str, Any], K: np.ndarray, path: Path
) -> tuple[int, int] | None:
    """Return height and width of the images [px]; None where a mapping has neither."""
    keys = {_plain(key): key for key in content}
    for width, height in _SIZES:
        if width in keys and height in keys:
            high, wide = (whole_number(content, keys[side], path) for side in (height, width))
            return high, wide
    for name in (name for name in _BOTH_SIDES if name in keys):
        value = content[keys[name]]
        if isinstance(value, Mapping):
            return _find_image_size(value, K, path)
        if isinstance(value, list) and len(value) == 2:
            sides = numbers(content, keys[name], path, (2,))
            # formats differ in the order: the principal point is near the middle in one of them
            off = [
                np.abs(K[:2, 2] / np.maximum(one, 1) - 0.5).max() for one in (sides, sides[::-1])
            ]
            wide, high = sides if off[0] <= off[1] else sides[::-1]
            return int(high), int(wide)
    return None


def _refuse_other_distortion(content: Mapping[str, Any], path: Path) -> None:
    """Raise BadData where a mapping has numbers of a distortion in a form that is not read."""
    for key, value in content.items():
        plain = _plain(key)
        # k0 is the first coefficient of formats that count from 0
        is_distortion = "distortion" in plain or _DISTORTION.fullmatch(plain) or plain == "k0"
        if is_distortion and _has_number(value):
            advice = "of rectified images type fx,fy,cx,cy, of raw ones distortion=, too"
            raise BadData(path, f"'{key}' is a distortion in a form that is not read", advice)


def _has_number(value: Any) -> bool:
    """Tell whether a value, or one within it, is a number other than 0."""
    left = [value]  # without recursion, however deep a file is
    while left:
        one = left.pop()
        if isinstance(one, Mapping):
            left += one.values()
        elif isinstance(one, list):
            left += one
        elif isinstance(one, int | float) and not isinstance(one, bool) and one != 0:
            return True
    return False


def _find_scale(content: Mapping[str, Any], path: Path) -> tuple[float, ...]:
    """Return the depth scale of a mapping; () where it has none."""
    if content.get("depth_scale") is None:
        return ()
    scale = float(numbers(content, "depth_scale", path, ()))
    return (scale,) if scale > 0 else ()


def _find_named(content: Mapping[str, Any], path: Path) -> tuple[float, ...]:
    """Return the coefficients of a distortion that are given one by one, () where none is."""
    inner = (
        value
        for key, value in content.items()
        if _DISTORTION.fullmatch(_plain(key)) and isinstance(value, Mapping)
    )
    for one in (content, *inner):
        # lists by such names are other things: P1 is a projection of KITTI's, K1 a matrix
        keys = {
            _plain(key): key
            for key, value in one.items()
            if key in _NAMES or not isinstance(value, list | Mapping)
        }
        if not keys.keys().isdisjoint(_NAMES):
            own = {name: one[keys[name]] if name in keys else 0.0 for name in _NAMES}
            found = tuple(float(numbers(own, name, path, ())) for name in _NAMES)
            return found if any(found[5:]) else found[:5]
    return ()


def _find_other_model(content: Mapping[str, Any]) -> str:
    """Return the kind of distortion that a mapping names, "" where it is OpenCV's polynomial, or
    names none.
    """
    camera = str(content.get("camera_model", ""))
    if _WIDE.fullmatch(camera.lower()):  # whatever the distortion on top of it is
        return camera
    if "fl_x" in content and _has_number(content.get("k4")):
        return "NeRF's k4"  # the factor of r^8; OpenCV's k4 is of a denominator
    named = next((str(content[key]) for key in _MODELS if content.get(key) is not None), "")
    plain = named.lower().removeprefix("distortion.").replace(" ", "_")  # as RealSense's tools do
    return "" if plain in _POLYNOMIALS else named


def _find_matrix(content: Mapping[str, Any], path: Path) -> np.ndarray | None:
    """Return the camera matrix (3, 3) of a mapping; None where it has none."""
    for keys in _SINGLE:
        if all(key in content for key in keys):
            four = [float(numbers(content, key, path, ())) for key in keys]
            return _matrix(four, path)
    for key in _FOURS:
        if isinstance(content.get(key), list) and len(content[key]) == 4:
            model = str(content.get("camera_model", "pinhole")).lower()
            if model != "pinhole":
                raise BadData(path, f"its camera_model is {model[:40]}", "only pinhole is read")
            return _matrix(numbers(content, key, path, (4,)).tolist(), path)
    found = _listed(content, _MATRICES)
    return None if found is None else _orient(numbers(found, "data", path, (3, 3)), path)


def _listed(content: Mapping[str, Any], keys: Iterable[str]) -> dict[str, Any] | None:
    """Return a list of numbers by the first of the keys that is there, as {"data": ...}."""
    for key in keys:
        value = content.get(key)
        value = value.get("data") if isinstance(value, Mapping) else value
        if isinstance(value, list):
            return {"data": value}
    return None


def _matrix(four: list[float], path: Path) -> np.ndarray:
    fx, fy, cx, cy = four
    return _orient(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]), path)


def _orient(matrix: np.ndarray, path: Path) -> np.ndarray:
    """Return a camera matrix that is written by rows or by columns; only one of them ends in the
    row 0, 0, 1.
    """
    K = matrix if np.allclose(matrix[2], (0, 0, 1)) else matrix.T
    if not np.allclose(K[2], (0, 0, 1)) or min(K[0, 0], K[1, 1]) <= 0:
        raise BadData(path, "holds no camera matrix", f"found {matrix.tolist()}")
    return np.array(K)
