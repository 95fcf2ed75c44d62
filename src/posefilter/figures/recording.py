"""Write the 3-D view to a file that the Rerun viewer opens: optional, needs the extra `viz`."""

import importlib
import importlib.util
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from posefilter.errors import missing_package
from posefilter.figures.canvas import AXES, ESTIMATE
from posefilter.figures.particles import choose_by_weight, color_by_weight
from posefilter.figures.view_data import Cloud, Hypothesis, Moment, ViewData
from posefilter.geometry.rigid import move
from posefilter.meshes.mesh import Mesh
from posefilter.meshes.rotational_symmetries import measure_angle

TIMELINE = "step"
_FAINT = 70  # opacity of the modes that are not the estimate, of 255
_WITH_AXES = 64  # particles whose axes are drawn, by weight
_TEXTURE = 1024  # [px] at most
_OTHER = (120, 150, 255)


def check_viewer() -> None:
    """Raise UserError where the library that writes the view is missing."""
    if importlib.util.find_spec("rerun") is None:
        raise missing_package("save_rerun=true", "rerun-sdk", "viz")


def record(shown: ViewData, path: Path) -> None:
    """Write a .rrd file: photograph, depth cloud and estimate's box throughout; particles over the
    steps; modes at the end.

    Everything is in the camera's frame (x right, y down, z ahead), in meters. On the time line
    `step`, one a step of the filter, the one after the last is the belief. Raises UserError where
    the library is missing.
    """
    check_viewer()
    rr, stream = open_stream("posefilter", path, _layout(shown))
    stream.send_recording_name(shown.name)
    _log_scene(rr, stream, shown)
    for number, moment in enumerate(shown.moments):
        stream.set_time(TIMELINE, sequence=number)
        _log_particles(rr, stream, shown, moment)
    mesh = make_textured(rr, shown.mesh)
    _log_hypothesis(rr, stream, "estimate", shown.estimate, shown, mesh, ESTIMATE)
    for number, other in enumerate(shown.others, start=1):
        mesh = make_faint(rr, shown.mesh)
        _log_hypothesis(rr, stream, f"modes/{number}", other, shown, mesh, _OTHER)
    stream.flush()
    stream.disconnect()


def open_stream(name: str, path: Path, layout: Any) -> tuple[Any, Any]:
    """Return the library, and a recording that it writes to a file, in the camera's frame."""
    rr: Any = importlib.import_module("rerun")
    stream = rr.RecordingStream(name)
    stream.set_log_time_enabled(False)
    stream.set_log_tick_enabled(False)
    stream.save(path, default_blueprint=layout)
    stream.log("/", rr.ViewCoordinates.RDF, static=True)
    return rr, stream


def _log_scene(rr: Any, stream: Any, shown: ViewData) -> None:
    """Log what does not change: the photograph and its camera, the cloud, the estimate's box, and
    what it all is.
    """
    camera = make_camera(rr, shown.K, *shown.rgb.shape[:2])
    stream.log("photograph", camera, rr.Image(shown.rgb, color_model="RGB"), static=True)
    stream.log("cloud", make_dots(rr, shown.cloud), static=True)
    placed, box = make_transform(rr, shown.estimate.pose), make_box(rr, shown.mesh)
    stream.log("estimate_box", placed, box, static=True)
    stream.log("about", rr.TextDocument(describe(shown), media_type="text/markdown"), static=True)
    stream.log("filter/noise", rr.SeriesLines(names=[f"noise level [{shown.unit}]"]), static=True)
    stream.log("filter/effective", rr.SeriesLines(names=["effective sample size [%]"]), static=True)


def _log_particles(rr: Any, stream: Any, shown: ViewData, moment: Moment) -> None:
    """Log the particles of one step, in space and on the photograph, in the color of their
    weight.
    """
    colors = color_by_weight(moment.weights)
    dots = rr.Points3D(moment.centers, colors=colors, radii=[shown.radius / 40])
    stream.log("particles/centers", dots, rr.AnyValues(weight=moment.weights))
    chosen = choose_by_weight(torch.from_numpy(moment.weights), _WITH_AXES).unique().numpy()
    lines, line_colors = _axes(moment.poses[chosen], shown)
    stream.log(
        "particles/axes", rr.LineStrips3D(lines, colors=line_colors, radii=[shown.radius / 150])
    )
    on_image = rr.Points2D(moment.pixels + 0.5, colors=colors, radii=[shown.rgb.shape[1] / 250])
    stream.log("photograph/particles", on_image, rr.AnyValues(weight=moment.weights))
    stream.log("filter/effective", rr.Scalars(100 * moment.effective))
    if moment.sigma is not None:
        stream.log("filter/noise", rr.Scalars(moment.sigma))


def _axes(
    poses: np.ndarray, shown: ViewData
) -> tuple[list[np.ndarray], list[tuple[int, int, int]]]:
    """Return the axes of poses (M, 4, 4) as 3 M lines from the object's center, and their
    colors.
    """
    ends = shown.center + 0.35 * shown.radius * np.concatenate([np.zeros((1, 3)), np.eye(3)])
    camera = ends @ poses[:, :3, :3].transpose(0, 2, 1) + poses[:, None, :3, 3]
    return [one[[0, k]] for one in camera for k in (1, 2, 3)], list(AXES) * len(poses)


def _log_hypothesis(
    rr: Any,
    stream: Any,
    entity: str,
    one: Hypothesis,
    shown: ViewData,
    mesh: Any,
    color: tuple[int, int, int],
) -> None:
    """Log the mesh where a hypothesis puts it, with its weight."""
    stream.log(entity, make_transform(rr, one.pose), mesh, rr.AnyValues(weight=one.weight))
    text = f"{entity.replace('modes/', 'mode ')}: {one.weight:.0%} of the belief"
    label = rr.Points3D(
        [shown.center], labels=[text], colors=[color], radii=[shown.radius / 100], show_labels=True
    )
    stream.log(f"{entity}/weight", label)


def make_transform(rr: Any, pose: np.ndarray) -> Any:
    """Return a pose (4, 4) as the viewer takes it."""
    return rr.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3])


def make_camera(rr: Any, K: np.ndarray, height: int, width: int) -> Any:
    """Return a camera; its pixels' corners, not their centers, have integer coordinates there."""
    corners = np.array(K, np.float64)
    corners[:2, 2] += 0.5
    size = [width, height]
    return rr.Pinhole(image_from_camera=corners, resolution=size, image_plane_distance=0.1)


def make_dots(rr: Any, cloud: Cloud) -> Any:
    """Return a cloud of points that touch each other."""
    return rr.Points3D(cloud.points, colors=cloud.colors, radii=0.6 * cloud.footprints)


def make_box(rr: Any, mesh: Mesh, **more: Any) -> Any:
    """Return the box round a mesh."""
    low, high = mesh.bounds
    size = {"centers": [(low + high) / 2], "half_sizes": [(high - low) / 2]}
    return rr.Boxes3D(**size, colors=[ESTIMATE], fill_mode="majorwireframe", **more)


def make_textured(rr: Any, mesh: Mesh) -> Any:
    """Return the mesh as it looks: corner by corner, since seams give one vertex several texture
    coordinates.
    """
    parts: dict[str, Any] = {
        "vertex_positions": mesh.vertices[mesh.faces].reshape(-1, 3),
        "triangle_indices": np.arange(3 * len(mesh.faces)).reshape(-1, 3),
        "vertex_normals": mesh.corner_normals.reshape(-1, 3),
    }
    if mesh.corner_colors is not None:
        parts["vertex_colors"] = (mesh.corner_colors.reshape(-1, 3) * 255).round().astype(np.uint8)
    if mesh.corner_uv is None:
        return rr.Mesh3D(**parts, albedo_factor=[*mesh.texture[0, 0].tolist(), 255])
    texture, size = mesh.texture, max(mesh.texture.shape[:2])
    if size > _TEXTURE:
        texture = cv2.resize(
            texture, None, fx=_TEXTURE / size, fy=_TEXTURE / size, interpolation=cv2.INTER_AREA
        )
    # ours count from the bottom, as in OBJ
    from_top = mesh.corner_uv.reshape(-1, 2) * [1, -1] + [0, 1]
    return rr.Mesh3D(**parts, vertex_texcoords=from_top, albedo_texture=texture)


def make_faint(rr: Any, mesh: Mesh) -> Any:
    """Return the mesh in one transparent color."""
    normals = np.zeros_like(mesh.vertices)
    np.add.at(normals, mesh.faces.reshape(-1), mesh.corner_normals.reshape(-1, 3))
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    parts = {"vertex_positions": mesh.vertices, "triangle_indices": mesh.faces}
    return rr.Mesh3D(**parts, vertex_normals=normals, albedo_factor=[*_OTHER, _FAINT])


def describe(shown: ViewData) -> str:
    """Return in words what is seen, as Markdown."""
    steps = len(shown.moments) - 1
    lines = [
        f"# {shown.name}, score {shown.score:.2f}",
        "",
        "| pose | weight | center x, y, z [mm] | from the estimate [mm] | rotated by |",
        "|---|---|---|---|---|",
    ]
    modes = ((f"mode {i}", mode) for i, mode in enumerate(shown.others, start=1))
    for name, one in [("estimate", shown.estimate), *modes]:
        center, best = (move(shown.center, pose) for pose in (one.pose, shown.estimate.pose))
        place = ", ".join(f"{1000 * x:.0f}" for x in center)
        turn = np.rad2deg(measure_angle(one.pose[:3, :3].T @ shown.estimate.pose[:3, :3]))
        lines.append(
            f"| {name} | {one.weight:.1%} | {place} | "
            f"{1000 * np.linalg.norm(center - best):.1f} | {turn:.1f}° |"
        )
    if shown.left_out > 0:
        lines += ["", f"Lighter modes, not drawn: {shown.left_out:.1%} of the weight."]
    lines += [
        "",
        f"Time line `{TIMELINE}`: 0 to {steps - 1} are the filter's steps, {steps} is the belief "
        "that it ends with. A dot is where a particle puts the object's center, dark for light "
        "weights and yellow for heavy ones; red, green and blue are the object's x, y and z. The "
        "box is the estimate's, at every step. Camera frame: x right, y down, z ahead, meters.",
    ]
    return "\n".join(lines)


def _layout(shown: ViewData) -> Any:
    """Return how the viewer lays it all out: space on the left, seen from beside the camera; the
    rest on the right.
    """
    rrb: Any = importlib.import_module("rerun.blueprint")
    target = move(shown.center, shown.estimate.pose)
    aside = np.array([-0.3, -0.25, -0.6]) * np.linalg.norm(target)
    eye = rrb.EyeControls3D(position=target + aside, look_target=target, eye_up=[0, -1, 0])
    contents = ["+ /**", "- /photograph/**", "+ /photograph", "- /filter/**", "- /about"]
    name = "Depth cloud, particles and modes"
    space = rrb.Spatial3DView(origin="/", contents=contents, name=name, eye_controls=eye)
    height, width = shown.rgb.shape[:2]
    bounds = rrb.VisualBounds2D(x_range=[0, width], y_range=[0, height])
    image = rrb.Spatial2DView(
        origin="/photograph", name="Particles on the photograph", visual_bounds=bounds
    )
    noise = rrb.TimeSeriesView(origin="/filter/noise", name="Noise level")
    effective = rrb.TimeSeriesView(origin="/filter/effective", name="Effective sample size")
    words = rrb.TextDocumentView(origin="/about", name="What is shown")
    side = rrb.Vertical(image, rrb.Horizontal(noise, effective), words, row_shares=[6, 3, 4])
    time = rrb.TimePanel(timeline=TIMELINE, fps=2.0, state="collapsed")
    return rrb.Blueprint(
        rrb.Horizontal(space, side, column_shares=[3, 2]), time, collapse_panels=True
    )
