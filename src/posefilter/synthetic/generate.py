"""Generate cluttered scenes in the FAT format.

The result does not depend on the number of processes, and an interrupted run can be resumed.
"""

import inspect
import json
import logging
import shutil
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from hashlib import sha256
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from posefilter.errors import BadData, UserError
from posefilter.files import remove_parts
from posefilter.limits import read_json
from posefilter.locks import LOCK, hold, release
from posefilter.meshes.mesh import Mesh
from posefilter.meshes.parts import split_part
from posefilter.meshes.store import BUILTIN, MeshStore
from posefilter.paths import check_links
from posefilter.ranges import check_ranges
from posefilter.synthetic import fat_format as fat
from posefilter.synthetic.frame_renderer import Job, make_renderer
from posefilter.synthetic.motion import MotionSettings
from posefilter.synthetic.scenes import SceneSettings, choose_distractors
from posefilter.synthetic.sensor import SENSORS
from posefilter.synthetic.settle import load_mujoco
from posefilter.synthetic.workers import render_frames

log = logging.getLogger(__name__)

GENERATOR = "_generator.json"
VERSION = 4  # of the scenes that a seed gives: raise it when they change
_YCB_VIDEO = (1066.778, 1067.487, 312.9869, 241.3109, 640, 480)
_FAT = (768.16058349609375, 768.16058349609375, 480.0, 270.0, 960, 540)
# settings as they are typed, by how a dataset records them
_TYPED = {
    "width": "size",
    "height": "size",
    "K": "camera",
    "moves": "moving",
    "translation_mm": "moving_mm",
    "rotation_deg": "moving_deg",
}
# names in records of earlier versions
_RENAMED = {
    "occlusion": "max_occlusion",
    "occluded_share": "occluded_fraction",
    "tabletop_share": "tabletop_fraction",
    "lookalike_share": "lookalike_fraction",
    "shadow_share": "shadow_fraction",
    "absent_share": "absent_fraction",
    "covered_frames": "fully_occluded_frames",
}


_SAME_COLOR = 6  # by how much decoders of one texture may differ, of 255


class _Record(NamedTuple):
    """How a dataset was begun."""

    settings: dict[str, Any]
    frames: int
    mesh: str | None  # digest of the object's mesh
    colors: list[int] | None = None  # see `summarize_print`; None: not recorded


@dataclass(frozen=True)
class Summary:
    """What a call of `generate` did."""

    out: Path
    frames: int  # that the dataset holds now
    rendered: int  # of them by this run
    folders: int
    seconds: float

    @property
    def frames_per_second(self) -> float:
        """Frames that were rendered for each second."""
        return self.rendered / max(self.seconds, 1e-9)


def generate(
    out: Path | str,
    frames: int,
    meshes: str | Path = BUILTIN,
    object: str = "003_cracker_box",
    seed: int = 0,
    workers: int = 2,
    size: tuple[int, int] = (640, 480),
    stereo: bool = False,
    sensor: str = "kinect",
    camera: str | Sequence[float] = "ycb_video",
    max_occlusion: float = 0.75,
    occluded_fraction: float = 0.4,
    distractors: tuple[int, int] = (2, 8),
    tabletop_fraction: float = 0.65,
    frames_per_scene: int | None = None,
    settle: bool = False,
    renderer: str = "embree",
    progress: bool = True,
    mesh_scale: float | None = None,
    absent_fraction: float = 0.0,
    instances: int = 1,
    moving: str = "none",
    moving_mm: float = 5.0,
    moving_deg: float = 1.0,
    fully_occluded_frames: int = 0,
    lookalike_texture: str = "different",
) -> Summary:
    """Render frames of an object into a FAT dataset, or resume one that was begun.

    Frame i depends on the settings, the seed and i alone. Settings and the meshes that the frames
    take are checked before anything is written.

    Args:
        out: The dataset's folder.
        frames: How many frames it is to hold.
        meshes: "builtin" or a folder.
        object: The mesh that every frame shows, but for those of `absent_fraction`.
        seed: Decides every draw.
        workers: Processes that render.
        size: Width and height [px].
        stereo: Also render a right camera.
        sensor: "kinect" or "ideal".
        camera: "ycb_video", "fat", or (fx, fy, cx, cy) [px] for that size.
        max_occlusion: The largest share of the object that may be hidden.
        occluded_fraction: The share of frames in which something stands right in front of it.
        distractors: The least and most objects beside it.
        tabletop_fraction: The share of frames on a table; in the rest objects float.
        frames_per_scene: Frames that share surroundings and distractors. None: 2, since filters
            learn few scenes by heart; 30 where something moves from frame to frame.
        settle: Let objects fall and come to rest (mujoco).
        renderer: "embree" or "opengl".
        progress: Draw a bar.
        mesh_scale: Meters a unit of the mesh files; None: 1.
        absent_fraction: The share of frames that the object is taken out of, once all else is
            placed: so that a filter can be told to say that it is not there.
        instances: How many of the object a frame shows.
        moving: "none": each frame is arranged anew; "camera", "object" or "both": the frames of a
            scene follow each other, and that moves smoothly.
        moving_mm: Its shift from frame to frame, root mean square [mm].
        moving_deg: Its turn likewise [degrees].
        fully_occluded_frames: Frames in a row of each scene in which something hides the object
            wholly.
        lookalike_texture: "different": distractors of the object's shape have another texture than
            it; "same": some have its own, stretched or recolored.

    Returns:
        What was done.

    Raises:
        UserError: A value or mesh is wrong, or `out` was begun with other settings.
    """
    given = dict(locals())
    check_ranges({name: value for name, value in given.items() if name != "camera"}, "generate")
    out, job = Path(out), _make_job(given)
    _check(job)
    store = MeshStore(meshes, scale=job.mesh_scale)
    todo = [i for i in range(frames) if not all(path.is_file() for path in job.files(out, i))]
    check_meshes(job, store, todo)
    held = hold(out, wait=True)
    try:
        if held:  # another process may have rendered meanwhile
            todo = [i for i in todo if not all(path.is_file() for path in job.files(out, i))]
        known = todo or object in store.names()
        _open_dataset(out, job, frames, store.load(object) if known else None)
        if todo:
            log.info("rendering %d frames of %s into %s", len(todo), object, out)
        began = time.perf_counter()
        render_frames(job, out, todo, workers, progress, store)
    finally:
        if held:
            release(out)
    there = [path.parent for path in _list_rendered(out)]  # of earlier runs too
    seconds = time.perf_counter() - began
    return Summary(out, len(there), len(todo), len(set(there)), seconds)


def list_changed(out: Path, **settings: Any) -> list[str]:
    """Return the settings, as they are typed, with which a dataset that is there was not rendered.

    Args:
        out: The dataset's folder.
        **settings: Those of `generate`; one that is left out has its default.

    Returns:
        Their names; none where no dataset of this generator is there.

    Raises:
        UserError: Its record is damaged.
    """
    record = _read_record(out)
    if record is None:
        return []
    bound = inspect.signature(generate).bind(out, **settings)
    bound.apply_defaults()
    names = _list_differing(record.settings, _describe(_make_job(bound.arguments)))
    return _as_typed([*names, *(["frames"] if record.frames != settings["frames"] else [])])


def _list_rendered(out: Path) -> list[Path]:
    """Return the label file of each frame that a dataset holds."""
    return list(out.glob("mixed/*/[0-9]*.left.json"))


def shows_another_mesh(out: Path, store: MeshStore, name: str) -> bool:
    """Tell whether the scenes of a dataset were rendered of another mesh of an object than a store
    of meshes has; False where its record does not say, or is of another object.

    Raises:
        UserError: Its record, or the mesh, is damaged.
    """
    record = _read_record(out)
    name = split_part(name)[0] if store.is_part(name) else name  # scenes are of whole objects
    if record is None or record.settings.get("object") != name:
        return False
    mesh = store.load(name)
    return _is_another(digest_mesh(mesh), summarize_print(mesh), record)


def _is_another(digest: str, colors: list[int], record: _Record) -> bool:
    """Tell whether a mesh is another than a dataset's record has."""
    if record.mesh not in (None, digest):
        return True
    if record.colors is None:
        return False
    pairs = zip(colors, record.colors, strict=False)
    return len(colors) != len(record.colors) or any(abs(a - b) > _SAME_COLOR for a, b in pairs)


def summarize_print(mesh: Mesh) -> list[int]:
    """Return the mean colors of a texture's parts, 8 x 8 of them, in 0 to 255: another one of the
    same size shows in them, and another decoder of JPEGs does not.
    """
    few = cv2.resize(mesh.texture, (8, 8), interpolation=cv2.INTER_AREA)
    return [int(value) for value in few.ravel()]


def _make_job(given: Mapping[str, Any]) -> Job:
    """Return what is rendered for the arguments of `generate`, by name."""
    low, high = given["distractors"]
    scenes = SceneSettings(
        distractors=(int(low), int(high)),
        max_occlusion=float(given["max_occlusion"]),
        occluded_fraction=float(given["occluded_fraction"]),
        tabletop_fraction=float(given["tabletop_fraction"]),
        settle=bool(given["settle"]),
        absent_fraction=float(given["absent_fraction"]),
        instances=int(given["instances"]),
        lookalike_texture=str(given["lookalike_texture"]),
    )
    moving, frames_per_scene = given["moving"], given["frames_per_scene"]
    if frames_per_scene is None:  # what suits still or moving scenes
        frames_per_scene = 2 if moving == "none" else 30
    width, height = (int(n) for n in given["size"])
    K = camera_matrix(given["camera"], width, height)
    rows = tuple(tuple(float(x) for x in row) for row in K)
    shift, turn = float(given["moving_mm"]), float(given["moving_deg"])
    return Job(
        given["object"],
        _plain_folder(given["meshes"]),
        int(given["seed"]),
        width,
        height,
        rows,
        given["stereo"],
        given["sensor"],
        int(frames_per_scene),
        given["renderer"],
        scenes,
        1.0 if given["mesh_scale"] is None else float(given["mesh_scale"]),
        MotionSettings(moving, shift, turn, int(given["fully_occluded_frames"])),
    )


def _plain_folder(meshes: str | Path) -> str:
    """Return a folder without the slash that shells put behind its name."""
    return str(meshes).rstrip("/") or "/"


def camera_matrix(camera: str | Sequence[float], width: int, height: int) -> np.ndarray:
    """Return a camera matrix.

    Args:
        camera: "ycb_video" or "fat", scaled to the size, or (fx, fy, cx, cy) [px] as given.
        width: Of the image [px].
        height: Of the image [px].

    Returns:
        K (3, 3) [px].

    Raises:
        UserError: The name is unknown, or the numbers are impossible.
    """
    named = {"ycb_video": _YCB_VIDEO, "fat": _FAT}
    if isinstance(camera, str):
        if camera not in named:
            raise UserError(
                f"camera={camera}: unknown; choose from {', '.join(named)}, or give fx,fy,cx,cy"
            )
        fx, fy, cx, cy, w, h = named[camera]
        scale = width / w
        # another aspect ratio: the same horizontal field of view, centered
        if abs(height / h - scale) > 0.01 * scale:
            cy = (h - 1) / 2 + ((height / scale) - h) / 2
        fx, fy, cx, cy = fx * scale, fy * scale, (cx + 0.5) * scale - 0.5, (cy + 0.5) * scale - 0.5
    else:
        if len(camera) != 4:
            raise UserError(f"camera={list(camera)}: needs four numbers, fx,fy,cx,cy [px]")
        fx, fy, cx, cy = (float(x) for x in camera)
        if not (min(fx, fy) > 0 and np.isfinite([fx, fy, cx, cy]).all()):
            raise UserError(f"camera={list(camera)}: focal lengths must be positive [px]")
        if not (0 <= cx < width and 0 <= cy < height):
            raise UserError(
                f"camera={list(camera)}: the principal point is outside of size={width},{height}; "
                "are the numbers of another size?"
            )
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])


def _check(job: Job) -> None:
    """Raise UserError for settings that do not fit each other, or name what there is not."""
    low, high = job.scenes.distractors
    if high < low:
        raise UserError(f"distractors={low},{high}: needs 0 <= min <= max")
    if job.motion.moves != "none" and job.scenes.instances > 1:
        raise UserError(
            f"moving={job.motion.moves}: one object alone can move; leave instances= out"
        )
    if job.motion.fully_occluded_frames > job.frames_per_scene:
        raise UserError(
            f"fully_occluded_frames={job.motion.fully_occluded_frames}: a scene has "
            f"{job.frames_per_scene} frames only (frames_per_scene)"
        )
    if job.scenes.lookalike_texture not in ("different", "same"):
        raise UserError(
            f"lookalike_texture={job.scenes.lookalike_texture}: unknown; choose different or same"
        )
    if job.sensor not in SENSORS:
        raise UserError(f"sensor={job.sensor}: unknown; choose from {', '.join(SENSORS)}")
    make_renderer(job.renderer)
    if job.scenes.settle:
        load_mujoco()


def check_meshes(job: Job, store: MeshStore, frames: Sequence[int]) -> None:
    """Read the meshes of frames: the object and the distractors of their scenes, no others.

    Args:
        job: What to render.
        store: The meshes.
        frames: Numbers of the frames.

    Raises:
        UserError: One is missing, cannot be read, or is in another unit, or the object is too small
            for the camera.
    """
    if store.is_part(job.object):
        base = split_part(job.object)[0]
        raise UserError(
            f"object={job.object}: is a part; render the whole, object={base}, and train with "
            f"data.object={job.object}"
        )
    if job.object not in store.names() or frames:
        mesh = store.load(job.object)
        if job.motion.moves != "none" or not all(map(job.lacks_target, frames)):
            _check_apparent_size(job, mesh)
    if job.meshes == BUILTIN:
        return
    for number in sorted({frame // job.frames_per_scene for frame in frames}):
        rng = job.scene_generator(number)
        for name in choose_distractors(store, job.object, job.scenes, rng):
            store.load(name)


def _check_apparent_size(job: Job, mesh: Mesh) -> None:
    """Raise UserError where no frame can show enough of an object, before hundreds are tried."""
    if job.scenes.settle:  # what falls may come nearer
        return
    most = job.view().most_pixels(mesh, job.scenes.distance[0] - mesh.reach)
    least = job.least_pixels()
    if most < least:
        raise UserError(
            f"object={job.object}: is too small for this camera: covers {most:.0f} of "
            f"{job.width * job.height:,} pixels at most, {least:.0f} are the least; mind its unit "
            "(mesh_scale), or choose a longer focal length (camera)"
        )


def digest_mesh(mesh: Mesh) -> str:
    """Return what differs between meshes of another shape, frame, texture mapping or texture size.

    The texture's pixels are left out: what a JPEG is read as depends on the library.
    """
    arrays = (mesh.vertices, mesh.faces, mesh.corner_uv, mesh.corner_colors)
    digest = sha256(str(mesh.texture.shape).encode())
    for array in arrays:
        digest.update(b"" if array is None else np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def _open_dataset(out: Path, job: Job, frames: int, mesh: Mesh | None) -> None:
    """Write the settings into a new dataset, or check that an existing one has the same.

    Args:
        out: The dataset's folder.
        job: What to render.
        frames: How many frames it is to hold.
        mesh: The object's mesh; None where it is not there, and nothing is left to render.
    """
    settings = _describe(job)
    path, record = out / GENERATOR, _read_record(out)
    digest = None if mesh is None else digest_mesh(mesh)
    colors = None if mesh is None else summarize_print(mesh)
    if record is not None:
        check_links(out)  # before anything is removed: somebody else may have begun it
        differing = _list_differing(record.settings, settings)
        if not any(out.glob("mixed/*/[0-9]*.json")):
            # an earlier start failed before its first frame: nothing is kept of it
            for folder in out.glob("mixed/scene*_0"):
                shutil.rmtree(folder)
        elif differing:
            keys = ", ".join(_as_typed(differing))
            raise UserError(
                f"{path}: this dataset was begun with other settings ({keys}); choose another out="
            )
        elif digest and colors and _is_another(digest, colors, record):
            raise UserError(
                f"{path}: this dataset was begun with another mesh of {job.object}, whose file was "
                "changed since; choose another out="
            )
        else:
            frames = max(frames, len(_list_rendered(out)))
            digest = digest or record.mesh
            colors = record.colors  # of the texture that is there; None of earlier versions
        remove_parts(out, [".", "mixed/*"])
    elif out.is_dir() and any(path.name != LOCK for path in out.iterdir()):
        raise UserError(
            f"{out}: not empty, and not begun by this generator (no {GENERATOR}); render into "
            "another folder, or, for images of your own, name their format (data=fat, ycb_video or "
            "bop)"
        )
    out.mkdir(parents=True, exist_ok=True)
    packages = ("posefilter", "numpy", "embreex", "opencv-python-headless")
    versions = {name: _find_version(name) for name in packages}
    content = {"settings": settings, "frames": frames, "mesh": digest, "colors": colors}
    content["versions"] = versions
    fat.write_json(path, content)


def _describe(job: Job) -> dict[str, Any]:
    """Return the settings of what is rendered, as a record has them."""
    described: dict[str, Any] = json.loads(json.dumps({"version": VERSION, **asdict(job)}))
    return described


def _read_record(out: Path) -> _Record | None:
    """Return what a dataset's folder says of how it was begun, None where none was.

    Raises:
        UserError: The record is damaged.
    """
    path = out / GENERATOR
    if not path.is_file():
        return None
    try:
        content = read_json(path)
        settings, frames = _with_defaults(content["settings"]), int(content["frames"])
        colors = content.get("colors")
        colors = None if colors is None else [int(value) for value in colors]
        return _Record(settings, frames, content.get("mesh"), colors)
    except (BadData, ValueError, KeyError, TypeError, AttributeError, OverflowError) as error:
        raise UserError(
            f"{path}: not a generator's record any more ({error}); choose another out="
        ) from error


def _find_version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:  # OpenCV has several names; Embree may be missing
        return None


def _list_differing(one: dict[str, Any], other: dict[str, Any]) -> list[str]:
    """Return the names of settings that differ, of sections those within."""
    names: list[str] = []
    for key in sorted({*one, *other}):
        first, second = one.get(key), other.get(key)
        if isinstance(first, dict) and isinstance(second, dict):
            names += _list_differing(first, second)
        elif first != second:
            names.append(key)
    return names


def _as_typed(names: list[str]) -> list[str]:
    """Return settings as they are typed; a size, which changes the intrinsics, without these."""
    typed = {_TYPED.get(name, name) for name in names}
    return sorted(typed - {"camera"} if "size" in typed else typed)


def _by_todays_names(settings: dict[str, Any]) -> dict[str, Any]:
    return {_RENAMED.get(name, name): value for name, value in settings.items()}


def _with_defaults(settings: dict[str, Any]) -> dict[str, Any]:
    """Return recorded settings by today's names, with defaults of later ones."""
    defaults = {"absent_fraction": 0.0, "instances": 1, "lookalike_texture": "same"}
    scenes = {**defaults, **_by_todays_names(settings.get("scenes", {}))}
    texture = scenes["lookalike_texture"]
    scenes["lookalike_texture"] = {"other": "different", "own": "same"}.get(texture, texture)
    motion = {**asdict(MotionSettings()), **_by_todays_names(settings.get("motion", {}))}
    meshes = _plain_folder(settings.get("meshes", BUILTIN))
    out = {"mesh_scale": 1.0, **settings, "meshes": meshes, "scenes": scenes, "motion": motion}
    return {**out, "renderer": "opengl"} if out.get("renderer") == "moderngl" else out
