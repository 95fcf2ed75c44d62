"""Meshes to draw are in the checkpoint's own size, or refused in one line that names the unit."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from omegaconf import OmegaConf

from posefilter.cli.command import compose_job
from posefilter.cli.shapes import load_shape, open_shapes
from posefilter.errors import UserError
from posefilter.meshes.mesh import Mesh
from posefilter.meshes.store import MeshStore, object_model
from posefilter.meshes.write import write_obj

CONF = Path(__file__).parents[2] / "conf"
CARTON = MeshStore("builtin").load("carton")
MODEL = object_model(CARTON, count=100)


def write(folder: Path, unit: float, name: str = "carton") -> Path:
    """Write the carton in a unit [m]."""
    scaled = replace(CARTON, name=name, vertices=CARTON.vertices / unit)
    write_obj(scaled, folder / name)
    return folder


@pytest.mark.parametrize("unit", [0.01, 0.0254])
def test_a_mesh_in_another_unit_is_refused_with_the_unit_that_fits(
    unit: float, tmp_path: Path
) -> None:
    meshes = write(tmp_path, 10 * unit)  # so small a one that 10 m do not refuse it
    small = MODEL._replace(diameter=MODEL.diameter / 10)
    given = {"meshes": str(meshes), "mesh_scale": None}
    with pytest.raises(UserError) as refusal:
        load_shape(open_shapes(OmegaConf.create(given), ["carton"]), small)
    assert str(refusal.value).endswith(f"give mesh_scale={unit:g}")
    assert "\n" not in str(refusal.value)
    given["mesh_scale"] = unit
    drawn = load_shape(open_shapes(OmegaConf.create(given), ["carton"]), small)
    assert isinstance(drawn, Mesh)
    assert np.allclose(np.ptp(drawn.vertices, axis=0), np.ptp(CARTON.vertices, axis=0) / 10)


def test_a_unit_without_meshes_is_refused() -> None:
    with pytest.raises(UserError, match=r"mesh_scale=0\.001: is the unit of meshes="):
        open_shapes(OmegaConf.create({"meshes": None, "mesh_scale": 0.001}), ["carton"])


def test_a_mesh_of_no_unit_is_of_another_object(tmp_path: Path) -> None:
    given = OmegaConf.create({"meshes": str(write(tmp_path, 0.4)), "mesh_scale": None})
    with pytest.raises(UserError, match="another object"):
        load_shape(open_shapes(given, ["carton"]), MODEL)


def test_without_meshes_the_hull_is_drawn_and_bops_own_are_in_millimeters(tmp_path: Path) -> None:
    none = OmegaConf.create({"meshes": None, "mesh_scale": None})
    assert load_shape(open_shapes(none, ["carton"]), MODEL) is MODEL.hull
    meshes = write(tmp_path, 0.001, "obj_000002")
    given = OmegaConf.create({"meshes": str(meshes), "mesh_scale": None})
    store = open_shapes(given, ["obj_000002"])
    assert isinstance(load_shape(store, MODEL._replace(name="obj_000002")), Mesh)


@pytest.mark.parametrize("command", ["predict", "track", "check_data", "onboard", "generate"])
def test_every_command_has_the_same_default(command: str, tmp_path: Path) -> None:
    assert compose_job(command, CONF, [], tmp_path).cfg.mesh_scale is None
