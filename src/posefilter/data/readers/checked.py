"""Whether readers and augmentations keep to their protocols: what a reader lists, and the samples
of both.

One of a plug-in is its author's work: one mistake of it, such as depth in millimeters, would else
be learned without a word.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch

from posefilter.data.frames import FrameRecord, Implausible, Sample
from posefilter.data.readers.base import BaseReader
from posefilter.data.readers.plausible import FARTHEST
from posefilter.errors import BadData, UserError
from posefilter.geometry.camera import find_matrix_flaw
from posefilter.geometry.pose import is_rigid

_RIGID = 5e-3  # of a rotation's entries; datasets round them
_THINNED = 8  # of the rows and columns that the median of a depth image is first taken from


def index_records(reader: BaseReader, records: Sequence[FrameRecord]) -> dict[str, int]:
    """Return the place of each record by its key.

    Raises:
        UserError: Two records have one key, or one name and two color images: a cache would show
            one for the other.
    """
    places: dict[str, int] = {}
    images: dict[str, int] = {}
    for i, record in enumerate(records):
        first = places.setdefault(record.key, i)
        alike = "name and instance"
        if first == i:
            first = images.setdefault(record.name, i)
            alike = "name"
            if records[first].files[:1] == record.files[:1]:
                continue
        one, other = (_describe_place(records[k], k) for k in (first, i))
        raise UserError(
            f"{type(reader).__name__}.records: {one} and {other} have the same {alike}; `name` "
            "must differ between images, `instance` between the objects of one image"
        )
    return places


def _describe_place(record: FrameRecord, i: int) -> str:
    file = f" ({record.files[0]})" if record.files else ""
    return f"record {i} '{record.key}'{file}"


def read_checked(reader: BaseReader, i: int, record: FrameRecord) -> Sample:
    """Return what a reader reads of record i.

    Raises:
        UserError: It is no `Sample`, or one of other types or shapes.
        BadData: Its numbers cannot be right, or whatever the reader raises.
        Implausible: Depth or pose cannot be: most likely they are in millimeters.
    """
    sample = reader.read(i)
    named = f"{type(reader).__name__}.read, frame {record.name}"
    if wrong := _find_type_flaw(sample, len(reader.objects)):
        raise UserError(f"{named}: {wrong}")
    file = record.files[0] if record.files else Path(record.name)
    flaw, unit = _find_number_flaw(sample), False
    if flaw is None:
        flaw, unit = _find_unit_flaw(sample), True
    if flaw is None:
        return sample
    cause, detail = f"{type(reader).__name__}.read: {flaw[0]}", f"{flaw[1]}; frame {record.name}"
    if unit:
        raise Implausible(file, cause, detail, sample)
    raise BadData(file, cause, detail)


def check_augmented(sample: Any, before: Sample) -> Sample:
    """Return what an augmentation has made of a sample.

    Raises:
        UserError: It is no `Sample`, or has other types, shapes or numbers than one has: colors of
            0 to 1 would else be learned as black.
    """
    wrong = _find_type_flaw(sample, before.object_id + 1)
    if not wrong and (flaw := _find_number_flaw(sample)) is not None:
        wrong = f"{flaw[0]} ({flaw[1]})"
    if wrong:
        raise UserError(f"data.augment: {wrong}")
    return cast(Sample, sample)


def _find_type_flaw(sample: Any, objects: int) -> str:
    """Return what has another type or shape than a `Sample` says, "" where nothing has."""
    if not isinstance(sample, Sample):
        return f"returned a {type(sample).__name__}, not a posefilter.data.frames.Sample"
    size = sample.rgb.shape if isinstance(sample.rgb, np.ndarray) else ()
    height, width = size[:2] if len(size) == 3 and size[2] == 3 else (0, 0)
    wanted = {
        "rgb": ("u1", (height, width, 3), "uint8 (H, W, 3), red first, 0 to 255"),
        "depth": ("f", (height, width), "floats (H, W) [m], as large as rgb, 0 where unknown"),
        "mask": ("b", (height, width), "bool (H, W), as large as rgb"),
        "intrinsics": ("f", (3, 3), "floats (3, 3) [px]"),
        "camera_from_object": ("f", (4, 4), "floats (4, 4) [m]"),
    }
    for name, (kind, shape, words) in wanted.items():
        value = getattr(sample, name)
        if not isinstance(value, np.ndarray):
            return f"{name} is of type {type(value).__name__}; wanted is an array, {words}"
        known = value.dtype == np.uint8 if kind == "u1" else value.dtype.kind == kind
        if not known or value.shape != shape:
            hint = ""
            if name == "rgb" and value.ndim == 3 and value.shape[0] == 3:
                hint = " (channels first?)"
            if name == "depth" and value.dtype.kind in "iu":
                hint = " (millimeters?)"
            return f"{name} is {value.dtype} {value.shape}{hint}; wanted is {words}"
    number = sample.object_id
    if not isinstance(number, int | np.integer) or not 0 <= number < objects:
        return f"object_id is {number}; wanted is an index into the reader's {objects} `objects`"
    return ""


def _find_number_flaw(sample: Sample) -> tuple[str, str] | None:
    """Return what numbers cannot be right, and how they are; None where all may be."""
    with np.errstate(invalid="ignore"):
        least, most = float(sample.depth.min()), float(sample.depth.max())
    if not np.isfinite([least, most]).all():
        return "depth holds NaN or infinity", "0 is what says that it is unknown"
    if least < 0:
        return "depth is negative", f"{least:.3g} m"
    K, pose = sample.intrinsics, sample.camera_from_object
    for name, matrix in (("intrinsics", K), ("camera_from_object", pose)):
        if not np.isfinite(matrix).all():
            return f"{name} holds NaN or infinity", str(matrix.tolist())
    if flaw := find_matrix_flaw(K):
        return "intrinsics are no camera matrix", flaw
    if not is_rigid(torch.from_numpy(pose.astype(np.float64)), _RIGID):
        return "camera_from_object is no rotation and translation", _explain_pose(pose)
    return None


def _explain_pose(pose: np.ndarray) -> str:
    """Return why a matrix (4, 4) may be no pose."""
    R, last = pose[:3, :3].astype(np.float64), pose[3]
    if not np.allclose(last, [0, 0, 0, 1], atol=_RIGID):
        transposed = np.allclose(pose[:, 3], [0, 0, 0, 1], atol=_RIGID)
        return f"last row {last.tolist()}: {'transposed?' if transposed else 'not [0, 0, 0, 1]'}"
    size = float(np.cbrt(np.linalg.det(R)))
    if size < 0:
        return "the rotation is a mirror image: an axis flipped?"
    return f"the columns of the rotation are not orthonormal; its scale is {size:.3g}"


def _find_unit_flaw(sample: Sample) -> tuple[str, str] | None:
    """Return what is farther than an object can be; None where nothing is."""
    distance = float(np.linalg.norm(sample.camera_from_object[:3, 3].astype(np.float64)))
    if distance > FARTHEST:
        told = f"its translation is {distance:.3g} m long; millimeters instead of meters?"
        return "camera_from_object is not plausible", told
    middle = 0.0
    for part in (sample.depth[::_THINNED, ::_THINNED], sample.depth):
        known = part[part > 0]
        middle = float(np.median(known)) if known.size else 0.0
        if middle <= FARTHEST:
            return None
    told = f"its median is {middle:.3g} m; millimeters instead of meters?"
    return "depth is not plausible", told
