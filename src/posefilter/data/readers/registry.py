"""Open a dataset by the name of its format."""

import inspect
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from posefilter.data.readers.base import BaseReader
from posefilter.data.readers.bop import BopReader
from posefilter.data.readers.fat import FatReader
from posefilter.data.readers.part import PartReader
from posefilter.data.readers.ycb_video import YCBVideoReader
from posefilter.errors import UserError
from posefilter.meshes import ycb
from posefilter.meshes.parts import split_part
from posefilter.meshes.store import MeshStore

READERS: dict[str, Callable[..., BaseReader]] = {
    "scenes": FatReader,
    "fat": FatReader,
    "ycb_video": YCBVideoReader,
    "bop": BopReader,
}
_BUILTIN = tuple(READERS)


def register_reader(source: str, reader: Callable[..., BaseReader]) -> None:
    """Make a reader known by the name that `data.source` gives, for plug-ins.

    Args:
        source: The name.
        reader: Called with the dataset's folder, the wanted classes, `meshes`, `on_error` and the
            settings of `data.options`.

    Raises:
        UserError: Another reader has the name.
    """
    known = READERS.get(source, reader)
    # a class that is defined again, as in a notebook, takes the place of the one before
    again = isinstance(known, type) and _find_home(known) == _find_home(reader)
    if known is not reader and not again:
        raise UserError(
            f"data.source={source}: a reader of this name already exists, {_find_home(known)}"
        )
    READERS[source] = reader


def _find_home(reader: Callable[..., BaseReader]) -> str:
    """Return the module and the name of a reader's class or function."""
    return f"{reader.__module__}.{getattr(reader, '__qualname__', '')}"


def open_reader(
    source: str,
    root: str | Path,
    objects: str | Sequence[str] | None = None,
    meshes: MeshStore | None = None,
    on_error: str = "raise",
    **options: Any,
) -> BaseReader:
    """Return the reader of a dataset: source "scenes" (rendered here), "fat", "ycb_video" or "bop".

    An object may be a part, `hammer.head`: see `PartReader`. options: the format's own, see the
    readers. Raises UserError for a source, class, folder or
    option that there is not.
    """
    if source not in READERS:
        raise UserError(f"data.source={source}: unknown; choose from {', '.join(READERS)}")
    if on_error not in ("raise", "skip"):
        raise UserError(f"data.on_error={on_error}: choose raise or skip")
    part = _asked_part(objects, meshes)
    if part is not None and meshes is not None:
        meshes.load(part)  # it may be no part of the object
        base = split_part(part)[0]
        whole = open_reader(source, root, base, meshes, on_error, **options)
        return PartReader(whole, part, meshes)
    renamed = {"eyes": "cameras"}
    if source in _BUILTIN:
        renamed |= {"part": "split"} if source == "bop" else {"parts": "subsets"}
    for old, new in renamed.items():
        if old in options:
            raise UserError(f"data.options.{old}: is now data.options.{new}")
    reader = READERS[source]
    given: dict[str, Any] = {"meshes": meshes, "on_error": on_error}
    signature = inspect.signature(reader)
    try:
        signature.bind_partial(root, objects, **given)
    except TypeError as error:
        raise UserError(
            f"data.source={source}: {_find_home(reader)} must take (root, objects, meshes=, "
            f"on_error=), as BaseReader's readers do ({error})"
        ) from error
    try:
        signature.bind(root, objects, **given, **options)
    except TypeError as error:
        raise UserError(f"data.options: {error} of the {source} reader") from error
    try:
        return reader(root, objects, **given, **options)
    except OSError as error:
        raise UserError(f"{error.filename or root}: cannot be read ({error.strerror})") from error


def open_whole(
    source: str,
    root: str | Path,
    names: Sequence[str],
    meshes: MeshStore | None,
    on_error: str = "raise",
    **options: Any,
) -> BaseReader:
    """Return the reader of all classes of a dataset, which are called as some of them are: a BOP
    dataset of YCB's objects by YCB's names, where these are. A part is read by itself.

    Raises UserError as `open_reader` does.
    """
    part = _asked_part(names, meshes)
    if source == "bop" and all(name in ycb.CLASSES for name in names):
        options["mesh_frame"] = options.get("mesh_frame") or "original"
    return open_reader(source, root, part, meshes, on_error, **options)


def _names(objects: str | Sequence[str] | None) -> list[str]:
    """Return the classes asked for, none where all are.

    Raises UserError for what is no text, such as a name that YAML reads as a number.
    """
    names = [objects] if isinstance(objects, str) else objects or []
    if not isinstance(names, Sequence) or not all(isinstance(name, str) for name in names):
        raise UserError(f"data.object={objects}: must be a name, or a list of names, or null")
    return list(names)


def _asked_part(objects: str | Sequence[str] | None, meshes: MeshStore | None) -> str | None:
    """Return the part of an object (`hammer.head`) that is asked for; None for whole objects.

    Raises UserError for a part beside other objects.
    """
    names = _names(objects)
    parts = [] if meshes is None else [name for name in names if meshes.is_part(name)]
    if parts and len(names) > 1:
        raise UserError(f"data.object: '{parts[0]}' is a part, which is read by itself")
    return parts[0] if parts else None


def default_mesh_scale(
    source: str, objects: str | Sequence[str] | None, mesh_frame: str | None = None
) -> float:
    """Return meters a unit of the mesh files that belong to a dataset: BOP's own models are in
    millimeters, YCB's original ones, whose frame the option `mesh_frame` names, in meters.
    """
    own = all(name.startswith("obj_") for name in _names(objects))
    return 0.001 if source == "bop" and own and mesh_frame != "original" else 1.0


def open_meshes(
    root: str | Path,
    scale: float | None,
    source: str,
    objects: str | Sequence[str] | None,
    mesh_frame: str | None = None,
) -> MeshStore:
    """Open the meshes of a dataset.

    Args:
        root: "builtin" or a folder.
        scale: Meters a unit of the mesh files; None: as `default_mesh_scale` has it.
        source: The dataset's format.
        objects: The classes asked for.
        mesh_frame: BOP's option of that name.
    """
    if scale is None:
        scale = default_mesh_scale(source, objects, mesh_frame)
    return MeshStore(root, scale=scale)
