"""Read the points that a dataset defines ADD on."""

from pathlib import Path

import numpy as np

from posefilter.errors import UserError
from posefilter.geometry.rigid import move
from posefilter.limits import open_text
from posefilter.paths import is_plain_name


def read_model_points(
    folder: str | Path | None, root: Path, name: str, native_from_mesh: np.ndarray
) -> np.ndarray | None:
    """Return a class's points in the mesh file's frame, None where the dataset brings none.  -> (P,
    3) [m].

    They are looked for in `folder`/<class>/points.xyz, else in `models` beside the dataset, as
    YCB-Video has them.
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
    return move(native, np.linalg.inv(native_from_mesh))
