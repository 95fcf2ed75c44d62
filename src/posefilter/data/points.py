"""Read the points that a dataset defines ADD on."""

from pathlib import Path

import numpy as np

from posefilter.errors import UserError
from posefilter.geometry.rigid import move
from posefilter.limits import open_text
from posefilter.paths import is_plain_name

_MOST_OFF = 0.1  # diagonals of the mesh's box, that the points' box may differ by
_FACTOR = 5.0  # by which points in another unit than meters are larger or smaller, at least


def read_model_points(
    folder: str | Path | None,
    root: Path,
    name: str,
    native_from_mesh: np.ndarray,
    bounds: np.ndarray | None = None,
) -> np.ndarray | None:
    """Return a class's points in the mesh file's frame, None where the dataset brings none.  -> (P,
    3) [m].

    They are looked for in `folder`/<class>/points.xyz, else in `models` beside the dataset, as
    YCB-Video has them.

    Args:
        folder: Where the points are; None: beside the dataset.
        root: The dataset's folder.
        name: The class.
        native_from_mesh: (4, 4) [m].
        bounds: (2, 3) least and greatest corner of the mesh's bounding box [m]; None: it is not
            compared with the points'.

    Raises:
        UserError: There are none in `folder`, or the file holds something else, or points in
            another unit, or of another frame than the dataset's.
    """
    folders = [Path(folder)] if folder is not None else [root / "models", root.parent / "models"]
    if not is_plain_name(name):
        raise UserError(f"{root}: class with an impossible name {name[:40]!r}")
    path = next(
        (f / name / "points.xyz" for f in folders if (f / name / "points.xyz").is_file()), None
    )
    if path is None:
        if folder is not None:
            raise UserError(f"{folder}: no {name}/points.xyz here (data.model_points_dir)")
        return None
    try:
        native = np.loadtxt(open_text(path), dtype=np.float64, ndmin=2)
    except ValueError as error:
        raise UserError(f"{path}: not rows of three numbers ({error})") from error
    if native.shape[1] != 3 or len(native) < 4 or not np.isfinite(native).all():
        raise UserError(f"{path}: not rows of three numbers (found {native.shape})")
    own = float(np.linalg.norm(np.ptp(native, axis=0)))
    points = move(native, np.linalg.inv(native_from_mesh))
    if bounds is None:
        return points
    size = float(np.linalg.norm(bounds[1] - bounds[0]))
    if not 1 / _FACTOR < own / size < _FACTOR:
        raise UserError(
            f"{path}: its points are {own:.3g} m across, and the mesh of {name} is {size:.3g} m; "
            "they should be in meters"
        )
    off = float(np.abs(np.stack([points.min(0), points.max(0)]) - bounds).max())
    if off > _MOST_OFF * size:
        raise UserError(
            f"{path}: the box of its points is {1000 * off:.0f} mm off that of the mesh of {name}; "
            "are they of another object, or in another frame than the dataset's?"
        )
    return points
