"""Write tracks to a file that the Rerun viewer opens: optional, needs the extra `viz`."""

import importlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from posefilter.figures.canvas import ESTIMATE
from posefilter.figures.overlay import Shape
from posefilter.figures.recording import (
    check_viewer,
    make_box,
    make_camera,
    make_dots,
    make_textured,
    make_transform,
    open_stream,
)
from posefilter.figures.view_data import make_cloud, make_mesh

TIMELINE = "frame"
_EVERY = 4  # [px] between the cloud's points: a video has many frames
_QUALITY = 85  # of the photographs, JPEG
_TRAIL = 30  # frames of the past that a track's line shows


class Seen(NamedTuple):
    """An object in a frame."""

    object: str
    pose: np.ndarray | None  # (4, 4) camera_from_object [m]; None while it is lost
    center: np.ndarray  # (3,) of the object, in its own frame [m]
    presence: float  # NaN where it is not known


class TrackRecorder:
    """Write frames and the objects in them to a .rrd file as they come; use as a context.

    Everything is in the camera's frame (x right, y down, z ahead), in meters, on the time line
    `frame`.

    Args:
        path: The file; None to write nothing.
        shapes: By object: its mesh, or the vertices of its hull [m].

    Raises:
        UserError: The library is missing.
    """

    def __init__(self, path: Path | None, shapes: Mapping[str, Shape]) -> None:
        if path is not None:
            check_viewer()
        self.path, self._shapes = path, shapes
        self._stream: Any = None
        self._rr: Any = None
        self._number = 0
        self._shown: set[str] = set()
        self._trails: dict[str, list[np.ndarray]] = {}

    def __enter__(self) -> "TrackRecorder":
        """Open the file."""
        if self.path is not None:
            self._rr, self._stream = open_stream("posefilter tracks", self.path, _layout())
        return self

    def add(self, rgb: np.ndarray, depth: np.ndarray, K: np.ndarray, seen: Sequence[Seen]) -> None:
        """Add a frame.

        Args:
            rgb: (H, W, 3) uint8.
            depth: (H, W) z-depth [m], 0 where unknown.
            K: (3, 3) camera matrix [px].
            seen: The objects.
        """
        if self._stream is None:
            return
        rr, stream = self._rr, self._stream
        stream.set_time(TIMELINE, sequence=self._number)
        self._number += 1
        photograph = rr.Image(rgb, color_model="RGB").compress(jpeg_quality=_QUALITY)
        stream.log("photograph", make_camera(rr, K, *depth.shape), photograph)
        stream.log("cloud", make_dots(rr, make_cloud(rgb, depth, K, _EVERY)))
        for one in seen:
            self._add_object(one)

    def _add_object(self, one: Seen) -> None:
        rr, stream, name = self._rr, self._stream, one.object
        if np.isfinite(one.presence):
            stream.log(f"presence/{name}", rr.Scalars(one.presence))
        if one.pose is None:
            if name in self._shown:
                stream.log(f"objects/{name}", rr.Clear(recursive=True))
                stream.log(f"trails/{name}", rr.Clear(recursive=True))
            self._shown.discard(name)
            self._trails.pop(name, None)
            return
        stream.log(f"objects/{name}", make_transform(rr, one.pose))
        if name not in self._shown:
            mesh = make_mesh(self._shapes[name], name)
            stream.log(f"objects/{name}", make_textured(rr, mesh))
            stream.log(f"objects/{name}/box", make_box(rr, mesh, labels=[name]))
            self._shown.add(name)
        trail = self._trails.setdefault(name, [])
        trail.append(one.pose[:3, :3] @ one.center + one.pose[:3, 3])
        del trail[:-_TRAIL]
        if len(trail) > 1:
            stream.log(f"trails/{name}", rr.LineStrips3D([np.stack(trail)], colors=[ESTIMATE]))

    def __exit__(self, *_: object) -> None:
        """Finish the file."""
        if self._stream is not None:
            self._stream.flush()
            self._stream.disconnect()


def _layout() -> Any:
    """Return how the viewer lays it all out."""
    rrb: Any = importlib.import_module("rerun.blueprint")
    space = rrb.Spatial3DView(
        origin="/", contents=["+ /**", "- /presence/**"], name="Depth cloud and tracks"
    )
    image = rrb.Spatial2DView(
        origin="/photograph", contents=["+ /photograph", "+ /objects/**"], name="Photograph"
    )
    presence = rrb.TimeSeriesView(origin="/presence", name="Presence")
    time = rrb.TimePanel(timeline=TIMELINE, fps=10.0)
    side = rrb.Vertical(image, presence, row_shares=[3, 2])
    return rrb.Blueprint(
        rrb.Horizontal(space, side, column_shares=[3, 2]), time, collapse_panels=True
    )
