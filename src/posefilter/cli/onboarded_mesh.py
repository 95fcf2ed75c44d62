"""The object that is onboarded: its mesh, what stands beside it, and its symmetries."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
from omegaconf import DictConfig

from posefilter.errors import UserError
from posefilter.figures.canvas import save_image
from posefilter.figures.symmetries import describe_turn, draw_symmetries, is_in_use
from posefilter.files import write_whole
from posefilter.meshes.builtin import catalog
from posefilter.meshes.files import read_mesh
from posefilter.meshes.find_symmetries import find_symmetries
from posefilter.meshes.inspect_mesh import MeshFacts, check_size, inspect_mesh
from posefilter.meshes.mesh import Mesh, diameter
from posefilter.meshes.rotational_symmetries import describe_symmetries, make_group, select
from posefilter.meshes.similarity import are_alike
from posefilter.meshes.store import BUILTIN, LARGEST, SMALLEST, MeshStore, WrongUnit
from posefilter.meshes.symmetries import read_symmetries
from posefilter.meshes.write import write_obj

_UNNAMED = ("textured", "mesh", "model", "google_16k", "meshes", "visual")
_MOST_CLUTTER = 20
_STEPS = 36  # that a continuous symmetry is cut into


def read_onboarded(cfg: DictConfig) -> Mesh:
    """Read the mesh that is to be onboarded, in meters.

    Raises:
        UserError: There is none, its name is no name, or its size is not one of an object.
    """
    source = str(cfg.mesh)
    if Path(source).is_file():
        scale = 1.0 if cfg.mesh_scale is None else float(cfg.mesh_scale)
        name = str(cfg.name or name_of(Path(source)))
        mesh = read_mesh(Path(source), name, scale)
        if cfg.mesh_scale is None:
            check_size(inspect_mesh(mesh), source)
        elif not SMALLEST <= (across := diameter(mesh.vertices)) <= LARGEST:
            raise UserError(
                f"mesh_scale={scale:g}: {source} would be {1000 * across:.3g} mm across; leave it "
                f"out where the file is in meters"
            )
    elif source in catalog.names():
        mesh = replace(catalog.build(source), name=str(cfg.name or source))
    elif Path(source).is_dir():
        raise UserError(f"mesh={source}: is a folder; name an .obj, .ply or .glb file in it")
    else:
        known = ", ".join(catalog.names())
        raise UserError(f"mesh={source}: no such file, and no builtin mesh ({known})")
    if not re.fullmatch(r"\w[\w\-]{0,63}", mesh.name):
        raise UserError(f"name={mesh.name}: letters, digits, - and _ alone; give name=...")
    return mesh


def name_of(path: Path) -> str:
    """Return an object's name: `035_power_drill/google_16k/textured.obj` is a 035_power_drill."""
    parts = [path.stem, *(parent.name for parent in path.absolute().parents)]
    name = next(part for part in parts if part.lower() not in _UNNAMED)
    return re.sub(r"[^\w\-]+", "_", name).strip("_") or "object"


def write_meshes(mesh: Mesh, cfg: DictConfig, folder: Path) -> tuple[MeshFacts, list[str]]:
    """Write the object, and what stands beside it, into a folder of meshes in meters.

    A builtin mesh that is like the object in size, shape and color is left out: the network would
    learn to reject the object. What a user gives as distractors stays.

    Returns:
        What is known of the object's mesh, and the names of the builtin ones that are left out.
    """
    if folder.is_dir():
        shutil.rmtree(folder)
    write_obj(mesh, folder / mesh.name)
    around = str(cfg.distractor_meshes)
    given = cfg.mesh_scale if cfg.distractor_scale is None else cfg.distractor_scale
    scale = 1.0 if given is None or around == BUILTIN else float(given)
    store = MeshStore(around, scale=scale)
    names = [name for name in store.names() if name != mesh.name]
    like = [name for name in names if around == BUILTIN and are_alike(store.load(name), mesh)]
    names = [name for name in names if name not in like]
    order = np.random.default_rng(cfg.seed).permutation(len(names))[:_MOST_CLUTTER]
    for index in sorted(order.tolist()):
        try:
            write_obj(store.load(names[index]), folder / names[index])
        except WrongUnit as error:
            raise UserError(f"{error.finding}; give distractor_scale={error.scale:g}") from error
    return inspect_mesh(mesh), like


def find_declared(mesh: Path, object_name: str, scale: float | None) -> tuple[Path, int] | None:
    """Return a file beside a mesh that declares symmetries of the object, and how many."""
    for name in ("symmetries.json", "models_info.json"):
        file = mesh.parent / name
        if mesh.is_file() and file.is_file():
            group = read_symmetries(file, object_name, scale or 1.0, _STEPS)
            if len(group) > 1:
                return file, len(group)
    return None


def find_and_draw(mesh: Mesh, wanted: str, scale: float | None, out: Path) -> str:
    """Write an object's symmetries beside its mesh, and draw them.

    Args:
        mesh: The object.
        wanted: `auto`, `geometry`, `none`, or a file in the BOP challenge's format.
        scale: Meters a unit of that file; None: 1.
        out: The folder that holds `meshes`; gets `symmetries.png`.

    Returns:
        What they are, in words.

    Raises:
        UserError: The file is not there or not in the format.
    """
    size, turns = diameter(mesh.vertices), find_symmetries(mesh)
    if wanted in ("auto", "geometry"):
        used = select(turns, texture=wanted == "auto")
        entry = describe_symmetries(used, size)
        group = make_group(used, size, _STEPS)
        own = [turn for turn in used if is_in_use(turn, group)]  # some may fit no group
        found = ", ".join(map(describe_turn, own)) or "no symmetries"
    elif wanted == "none":
        entry, group, found = {"symmetries_discrete": []}, np.eye(4)[None], "no symmetries"
    else:
        if not Path(wanted).is_file():
            raise UserError(f"symmetries={wanted}: no such file; or choose auto, geometry or none")
        group = read_symmetries(Path(wanted), mesh.name, scale or 1.0, _STEPS)
        if len(group) == 1:
            raise UserError(
                f"symmetries={wanted}: declares none of {mesh.name}; is the object named otherwise "
                f"there, or a key mistyped? (symmetries=none for an object without)"
            )
        entry = {"symmetries_discrete": [matrix.reshape(-1).tolist() for matrix in group[1:]]}
        found = f"{len(group)} symmetries of {wanted}"
    file = out / "meshes" / mesh.name / "symmetries.json"
    write_whole(file, json.dumps(entry, indent=1) + "\n")
    source = {
        "auto": "found on shape and texture",
        "geometry": "found on the shape alone",
        "none": "left out by symmetries=none",
    }.get(wanted, f"of {Path(wanted).name}")
    save_image(draw_symmetries(mesh, turns, group, source), out / "symmetries.png")
    return found
