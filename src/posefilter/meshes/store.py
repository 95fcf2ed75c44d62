"""Meshes by name: of a folder (YCB's layout, BOP's models, or any files), or the built-in ones."""

import difflib
import logging
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from posefilter.errors import UserError
from posefilter.files import stamp_files
from posefilter.meshes import ycb
from posefilter.meshes.builtin import catalog as builtin
from posefilter.meshes.files import SUFFIXES, read_mesh
from posefilter.meshes.mesh import Mesh, diameter, object_model
from posefilter.meshes.parts import (
    FILE,
    declares_parts,
    has_one_object,
    read_parts,
    split_part,
    take_faces,
)
from posefilter.meshes.symmetries import (
    declares,
    has_one_group,
    identity_first,
    read_symmetries,
    symmetry_group,
)

__all__ = ["Mesh", "MeshStore", "object_model", "symmetry_group"]

log = logging.getLogger(__name__)

# [m] the unit of an object that is larger or smaller must be wrong
LARGEST, SMALLEST = 10.0, 1e-3
BUILTIN = "builtin"
UNITS = {"millimeters": 0.001, "centimeters": 0.01, "inches": 0.0254}  # [m] of meshes, most first


class WrongUnit(UserError):  # noqa: N818
    """A mesh has an impossible size.

    Args:
        path: Its file.
        across: Its size [m].
        guess: What is probably wrong.
        scale: Meters in the file's unit, which are probably right.
        others: What else it may be.
    """

    def __init__(
        self, path: Path, across: float, guess: str, scale: float, others: str = ""
    ) -> None:
        self.finding, self.scale = f"{path}: {across:.3g} m across: {guess}", scale
        super().__init__(
            f"{self.finding}; give data.mesh_scale={scale:g} (generate, check_data, predict, "
            f"track: mesh_scale={scale:g}){others}"
        )


class MeshStore:
    """Meshes by name, each read once.

    Args:
        root: "builtin", or a folder with `<class>/google_16k/textured.obj` (YCB),
            `<class>/*.{obj,ply,glb}`, or `<name>.{obj,ply,glb}`.
        scale: Meters in the files' unit (0.001 for BOP).
        symmetries: (S, 4, 4) object_from_object [m] by name. They take precedence over
            `symmetries.json` or BOP's `models_info.json` in the folder, and these over the tables
            of YCB and of the built-in meshes.
        symmetry_steps: Steps in which a turn about an axis of any angle is sampled.

    Raises:
        UserError: The folder is missing or has no meshes, or the scale is impossible.
    """

    def __init__(
        self,
        root: str | Path,
        scale: float = 1.0,
        symmetries: Mapping[str, np.ndarray] | None = None,
        symmetry_steps: int = 36,
    ) -> None:
        self.root, self.scale, self.symmetry_steps = root, scale, symmetry_steps
        self._given = dict(symmetries or {})
        if not (isinstance(scale, int | float) and 0 < scale < math.inf):
            raise UserError(f"mesh_scale={scale}: meters a unit of the mesh files, such as 0.001")
        self._files: dict[str, Path] = {}
        self._ambiguous: dict[str, str] = {}  # messages of folders with several candidates
        if str(root) != BUILTIN:
            self._files, self._ambiguous = _find_meshes(Path(root))
        self._loaded: dict[str, Mesh] = {}

    def names(self) -> list[str]:
        """Return the names of all meshes, sorted."""
        return builtin.names() if str(self.root) == BUILTIN else sorted(self._files)

    def describe_files(self, names: Sequence[str]) -> str:
        """Return what changes when a file that decides the shape of one of some meshes does, or
        the unit.
        """
        whole = [name if name in self._files else split_part(name)[0] for name in names]
        own = [name for name in dict.fromkeys(whole) if name in self._files]
        meshes = [self._files[name] for name in own]
        beside = [folder / FILE for name in own for folder in self._folders_of(name)]
        return f"{self.scale} {stamp_files([*meshes, *beside])}"

    def load(self, name: str) -> Mesh:
        """Return a mesh, read on first use; of a part, `OBJECT.PART`, its faces alone.

        Raises:
            UserError: There is none of that name, its file is damaged, or its unit is wrong.
        """
        if name not in self._loaded:
            self._loaded[name] = self._load(name)
        return self._loaded[name]

    def _load(self, name: str) -> Mesh:
        if name in self._ambiguous:
            raise UserError(self._ambiguous[name])
        if self.is_part(name):
            return self._load_part(name)
        if name not in self.names():
            near = difflib.get_close_matches(name, self.names(), n=1, cutoff=0.3)
            hint = f"; did you mean '{near[0]}'?" if near else ""
            raise UserError(
                f"no mesh named '{name}' in {self.root}; there are {', '.join(self.names())} "
                f"(data.object=); other meshes: data.meshes=DIR (generate, check_data, predict, "
                f"track: meshes=DIR){hint}"
            )
        if str(self.root) == BUILTIN:
            mesh = builtin.build(name)
        else:
            mesh = read_mesh(self._files[name], name, self.scale)
            _check_unit(mesh, self._files[name], self.scale)
            mesh = replace(mesh, parts=self._parts(name, mesh))
        symmetries = self._symmetries(name, mesh)
        return mesh if symmetries is None else replace(mesh, symmetries=symmetries)

    def has(self, name: str) -> bool:
        """Return whether there is a mesh, or a part, of this name."""
        if self.is_part(name):
            base, part = split_part(name)
            return part in self.load(base).parts
        return name in self.names()

    def is_part(self, name: str) -> bool:
        """Return whether a name is `OBJECT.PART`, of an object that there is."""
        return name not in self.names() and split_part(name)[0] in self.names()

    def _load_part(self, name: str) -> Mesh:
        base, part = split_part(name)
        mesh = self.load(base)
        if part not in mesh.parts:
            declared = ", ".join(mesh.parts) or f"none (they would be in {FILE} beside the mesh)"
            raise UserError(f"no part '{part}' of {base} in {self.root}; there are: {declared}")
        return take_faces(mesh, mesh.parts[part], name)

    def _parts(self, name: str, mesh: Mesh) -> dict[str, np.ndarray]:
        """Return the declared parts of an object of a folder."""
        for folder in self._folders_of(name):
            if (folder / FILE).is_file() and declares_parts(folder / FILE, name):
                self._refuse_shared(folder / FILE, has_one_object)
                return read_parts(folder / FILE, name, self.scale, mesh)
        place = self._find_ycb_frame(name, mesh)
        if place is None:
            return {}
        return ycb.parts(name, replace(mesh, vertices=mesh.vertices - place[:3, 3]))

    def _find_ycb_frame(self, name: str, mesh: Mesh) -> np.ndarray | None:
        """Return the transform from the frame in which a class's symmetries and parts are known to
        a mesh's, (4, 4) [m]; None where it is not known, which the log says if it matters.
        """
        place = ycb.mesh_from_original(name, mesh)
        if place is None and (name in ycb.TOOLS or ycb.symmetries(name) is not None):
            log.warning(
                "%s: its frame is none of those that YCB, YCB-Video and BOP have for %s, so the "
                "known symmetries and parts are left out; declare them in symmetries.json and "
                "parts.json beside it",
                self._files[name],
                name,
            )
        return place

    def _refuse_shared(self, file: Path, holds_one: Callable[[Path], bool]) -> None:
        """Raise UserError where a file that does not say of which object it is lies in the folder
        of several.
        """
        if file.parent == Path(self.root) and len(self._files) > 1 and holds_one(file):
            raise UserError(
                f"{file}: does not say of which of {len(self._files)} objects it is; put it under "
                "the object's name, or into the object's own folder"
            )

    def _folders_of(self, name: str) -> list[Path]:
        """Return where files beside a mesh are looked for, nearest first."""
        file = self._files[name]
        return list(dict.fromkeys([file.parent, Path(self.root) / name, Path(self.root)]))

    def _symmetries(self, name: str, mesh: Mesh) -> np.ndarray | None:
        """Return the declared symmetries, None where there are none but the mesh's own."""
        if name in self._given:
            return identity_first(
                np.asarray(self._given[name], dtype=np.float64), f"symmetries of '{name}'"
            )
        if str(self.root) == BUILTIN:
            return None
        for folder in self._folders_of(name):
            for info in (folder / "symmetries.json", folder / "models_info.json"):
                if info.is_file() and declares(info, name):
                    self._refuse_shared(info, has_one_group)
                    return read_symmetries(info, name, self.scale, self.symmetry_steps)
        turns = ycb.symmetries(name, self.symmetry_steps)
        place = None if turns is None else self._find_ycb_frame(name, mesh)
        return None if place is None else place @ turns @ np.linalg.inv(place)


def _find_meshes(root: Path) -> tuple[dict[str, Path], dict[str, str]]:
    """Return the mesh file of each class, and a message for each class with several candidates."""
    if not root.is_dir():
        raise UserError(
            f"{root}: no such folder of meshes (use 'builtin' for those that the "
            f"project draws itself)"
        )
    files: dict[str, Path] = {}
    ambiguous: dict[str, str] = {}
    try:
        for entry in _list_visible(root):
            if not entry.is_dir():
                if entry.suffix.lower() in SUFFIXES:
                    known = files.get(entry.stem)
                    files[entry.stem] = entry if known is None else min(known, entry, key=_rank)
                continue
            found = _mesh_in(entry)
            if isinstance(found, Path):
                files.setdefault(entry.name, found)
            elif found is not None:
                ambiguous[entry.name] = found
    except OSError as error:
        raise UserError(f"{error.filename}: cannot be read ({error.strerror})") from error
    if not files and not ambiguous:
        kinds = "{obj,ply,glb}"
        raise UserError(
            f"{root}: no meshes here; expected <class>/google_16k/textured.obj, "
            f"<class>/*.{kinds} or *.{kinds}"
        )
    return files, {name: why for name, why in ambiguous.items() if name not in files}


def _list_visible(folder: Path) -> list[Path]:
    """Return what is in a folder, sorted, but hidden files: a Mac puts `._a.obj` beside `a.obj`."""
    return sorted(entry for entry in folder.iterdir() if not entry.name.startswith("."))


def _mesh_in(folder: Path) -> Path | str | None:
    """Return the mesh file of a class's folder, None, or a message where there are several."""
    preferred = [
        folder / "google_16k" / "textured.obj",
        *(folder / f"textured{suffix}" for suffix in SUFFIXES),
    ]
    for path in preferred:
        if path.is_file():
            return path
    others = [p for p in _list_visible(folder) if p.suffix.lower() in SUFFIXES]
    if len({p.stem for p in others}) > 1:
        return (
            f"{folder}: {len(others)} meshes and none named textured.*: cannot tell "
            f"which one is meant"
        )
    # one mesh in several formats
    return min(others, key=_rank, default=None)


def _rank(path: Path) -> int:
    """Return the place of a file among those of one mesh in several formats: the least is taken."""
    return SUFFIXES.index(path.suffix.lower()) if path.is_file() else len(SUFFIXES)


def _check_unit(mesh: Mesh, path: Path, scale: float) -> None:
    """Raise UserError, naming the setting to change, where an object has an impossible size."""
    try:
        across = diameter(mesh.vertices)
    except UserError as error:
        raise UserError(f"{path}: {str(error).removeprefix('mesh: ')}") from error
    if SMALLEST <= across <= LARGEST:
        return
    if across > LARGEST:
        usual, *rare = UNITS.items()
        others = "".join(f", {unit:g} of {name}" for name, unit in rare).replace(",", ", or", 1)
        raise WrongUnit(
            path, across, f"the mesh is probably in {usual[0]}", usual[1] * scale, others
        )
    guess = "in kilometers" if scale == 1 else f"in meters, and taken as {scale:g} m a unit"
    raise WrongUnit(path, across, f"the mesh is probably {guess}", 1000 * scale)
