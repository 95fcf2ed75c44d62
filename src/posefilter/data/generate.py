"""Render datasets of cluttered scenes in the FAT format: the same for a seed whatever the number of processes, resumable after a kill."""

import importlib.metadata
import json
import multiprocessing
import os
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from posefilter.data import fat_format as fat
from posefilter.data.meshes import MeshStore
from posefilter.data.render import EmbreeRenderer, Rendered
from posefilter.data.scenes import Layout, Library, SceneSet, SceneSettings, draw_layout, draw_set, shift_camera
from posefilter.data.sensor import sense, sensor_model
from posefilter.errors import UserError

GENERATOR = "_generator.json"
VERSION = 2  # of the scenes that a seed gives: raise it when they change
FRAMES_PER_TASK = 5
ATTEMPTS = 400
_YCB_VIDEO = (1066.778, 1067.487, 312.9869, 241.3109, 640, 480)
_FAT = (768.16058349609375, 768.16058349609375, 480.0, 270.0, 960, 540)


@dataclass(frozen=True)
class Summary:
    """What a run did."""

    out: Path
    frames: int  # that the dataset holds now
    rendered: int  # of them by this run
    folders: int
    seconds: float

    @property
    def frames_per_second(self) -> float:
        """Return this run's speed."""
        return self.rendered / max(self.seconds, 1e-9)


@dataclass(frozen=True)
class Job:
    """Everything that decides what is rendered; written beside the frames."""

    object: str
    meshes: str
    seed: int
    width: int
    height: int
    K: tuple[tuple[float, ...], ...]
    stereo: bool
    sensor: str
    frames_per_scene: int
    settle: bool
    scenes: SceneSettings

    def folder(self, frame: int) -> str:
        """Return the folder of a frame."""
        return f"mixed/scene{frame // self.frames_per_scene:04d}_0"

    def eyes(self) -> tuple[tuple[str, float], ...]:
        """Return the cameras, and how far right of the left one they stand [m]."""
        return (("left", 0.0), ("right", fat.BASELINE)) if self.stereo else (("left", 0.0),)

    def files(self, out: Path, frame: int) -> list[Path]:
        """Return the files of a frame, the one that is written last at the end."""
        stem = out / self.folder(frame) / f"{frame % self.frames_per_scene:06d}"
        endings = ("jpg", "depth.png", "seg.png", "json")
        return [stem.with_name(f"{stem.name}.{eye}.{ending}") for eye, _ in reversed(self.eyes()) for ending in endings]


def generate(
    out: Path | str,
    frames: int,
    meshes: str | Path = "builtin",
    object: str = "003_cracker_box",
    seed: int = 0,
    workers: int = 2,
    size: tuple[int, int] = (640, 480),
    stereo: bool = False,
    sensor: str = "kinect",
    camera: str | Sequence[float] = "ycb_video",
    occlusion: float = 0.75,
    occluded_share: float = 0.35,
    distractors: tuple[int, int] = (2, 8),
    tabletop_share: float = 0.65,
    frames_per_scene: int = 50,
    settle: bool = False,
    progress: bool = True,
) -> Summary:
    """Render `frames` frames of `object` into a FAT dataset at `out`, or go on with one that was begun.

    size: (width, height) [px]. camera: "ycb_video", "fat", or (fx, fy, cx, cy) [px] for that size. sensor: "kinect" or "ideal".
    occlusion: largest share of the target that may be hidden; occluded_share: of frames in which something stands right in front.
    Frame i depends on the settings, the seed and i alone. Raises UserError for bad values, and where `out` holds other settings.
    """
    out = Path(out)
    scenes = SceneSettings(
        distractors=(int(distractors[0]), int(distractors[1])),
        occlusion=float(occlusion),
        occluded_share=float(occluded_share),
        tabletop_share=float(tabletop_share),
    )
    width, height = (int(n) for n in size)
    K = camera_matrix(camera, width, height)
    rows = tuple(tuple(float(x) for x in row) for row in K)
    job = Job(object, str(meshes), int(seed), width, height, rows, stereo, sensor, int(frames_per_scene), settle, scenes)
    _check(job, frames, workers)
    store = MeshStore(meshes)
    if object not in store.names():
        store.load(object)  # says what is wrong with the name
    _claim(out, job, frames)
    todo = [i for i in range(frames) if not all(path.is_file() for path in job.files(out, i))]
    began = time.perf_counter()
    for _ in _run(job, out, todo, workers, progress):
        pass
    folders = len({job.folder(i) for i in range(frames)})
    return Summary(out, frames, len(todo), folders, time.perf_counter() - began)


def camera_matrix(camera: str | Sequence[float], width: int, height: int) -> np.ndarray:
    """Return K (3, 3) [px] of a named camera, scaled to the size, or of (fx, fy, cx, cy) as given.  Raises UserError."""
    named = {"ycb_video": _YCB_VIDEO, "fat": _FAT}
    if isinstance(camera, str):
        if camera not in named:
            raise UserError(f"camera={camera}: unknown; choose from {', '.join(named)}, or give fx,fy,cx,cy")
        fx, fy, cx, cy, w, h = named[camera]
        scale = width / w
        if abs(height / h - scale) > 0.01 * scale:  # another shape of picture: same field of view across, centred
            cy = (h - 1) / 2 + ((height / scale) - h) / 2
        fx, fy, cx, cy = fx * scale, fy * scale, (cx + 0.5) * scale - 0.5, (cy + 0.5) * scale - 0.5
    else:
        if len(camera) != 4:
            raise UserError(f"camera={list(camera)}: needs four numbers, fx,fy,cx,cy [px]")
        fx, fy, cx, cy = (float(x) for x in camera)
        if min(fx, fy) <= 0:
            raise UserError(f"camera={list(camera)}: focal lengths must be positive [px]")
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])


class Painter:
    """Draw frames of one job.  One a process: it keeps the renderer and the meshes."""

    def __init__(self, job: Job, out: Path) -> None:
        self.job, self.out = job, out
        self.K = np.array(job.K)
        self.library = Library(MeshStore(job.meshes))
        self.renderer = EmbreeRenderer()
        self.sensor = sensor_model(job.sensor)
        self._scene: tuple[int, SceneSet, dict[str, fat.ExportedObject]] | None = None

    def scene(self, number: int) -> tuple[SceneSet, dict[str, fat.ExportedObject]]:
        """Return a folder's set, and its classes by name; write the folder's settings."""
        if self._scene is None or self._scene[0] != number:
            rng = np.random.default_rng([self.job.seed, 1, number])
            scene = draw_set(self.library, self.job.object, self.job.scenes, rng)
            solids = (scene.target, *scene.distractors, *scene.lookalikes)
            step = min(12, 255 // len(solids))
            exported = [fat.export_object(s.mesh, step * (k + 1)) for k, s in enumerate(solids)]
            folder = self.out / self.job.folder(number * self.job.frames_per_scene)
            folder.mkdir(parents=True, exist_ok=True)
            cameras = [name for name, _ in self.job.eyes()]
            fat.write_json(folder / fat.OBJECT_SETTINGS, fat.object_settings(exported))
            fat.write_json(folder / fat.CAMERA_SETTINGS, fat.camera_settings(self.K, self.job.height, self.job.width, cameras))
            self._scene = number, scene, {one.name: one for one in exported}
        return self._scene[1], self._scene[2]

    def draw(self, frame: int) -> tuple[Layout, Rendered, np.random.Generator]:
        """Return a frame's layout and picture, and its generator as the drawing left it."""
        scene, _ = self.scene(frame // self.job.frames_per_scene)
        rng = np.random.default_rng([self.job.seed, 2, frame])
        height, width = self.job.height, self.job.width
        for _ in range(ATTEMPTS):
            layout = draw_layout(scene, self.job.scenes, self.K, height, width, rng)
            if layout is None:
                continue
            picture = self.renderer.render(layout.instances(), self.K, height, width, layout.lights, layout.planes)
            if self._shows_target(picture):
                return layout, picture, rng
        raise UserError(
            f"frame {frame}: no layout of {self.job.object} fits after {ATTEMPTS} tries; "
            "the object may be too large or small for this camera, or occlusion and distractors leave no room"
        )

    def write(self, frame: int) -> None:
        """Render a frame and write its files."""
        layout, picture, rng = self.draw(frame)
        _, exported = self.scene(frame // self.job.frames_per_scene)
        pending = []
        for k, (_, eye) in enumerate(self.job.eyes()):
            if k > 0:
                layout_here = shift_camera(layout, eye)
                picture = self.renderer.render(
                    layout_here.instances(), self.K, self.job.height, self.job.width, layout_here.lights, layout_here.planes
                )
            else:
                layout_here = layout
            pending.append(self._images(layout_here, picture, exported, eye, rng))
        files = iter(self.job.files(self.out, frame))
        for images, record in reversed(pending):
            for image in images:
                fat.write_image(next(files), image)
            fat.write_json(next(files), record)

    def _shows_target(self, picture: Rendered) -> bool:
        """Tell whether enough of the target is seen."""
        seen, alone = int((picture.index == 0).sum()), int(picture.alone[0])
        least = 0.002 * self.job.width * self.job.height
        return alone >= least and seen >= (1 - self.job.scenes.occlusion) * alone

    def _images(
        self, layout: Layout, picture: Rendered, exported: dict[str, fat.ExportedObject], eye: float, rng: np.random.Generator
    ) -> tuple[list[np.ndarray], dict[str, Any]]:
        """Return a camera's colour, depth and segment images, and its record."""
        photo, depth = sense(picture.rgb, picture.depth, self.sensor, rng)
        ids = np.array([*(exported[p.solid.mesh.name].seg_id for p in layout.placed), 0], np.uint8)
        seen = np.bincount(picture.index.reshape(-1) + 1, minlength=len(layout.placed) + 1)[1:]
        objects = []
        for k, one in enumerate(layout.placed):
            if k == 0 or seen[k] > 0:
                share = float(seen[k] / max(int(picture.alone[k]), 1))
                truncated = self._truncated(one.hull)
                objects.append(fat.ObjectInFrame(exported[one.solid.mesh.name], one.camera_from_object, share, truncated))
        return [photo, fat.depth_units(depth), ids[picture.index]], fat.frame_record(objects, self.K, eye)

    def _truncated(self, hull: np.ndarray) -> float:
        """Return the share of a hull's outline, by area, that leaves the frame."""
        pixels = (hull[:, :2] / hull[:, 2:] * [self.K[0, 0], self.K[1, 1]] + [self.K[0, 2], self.K[1, 2]]).astype(np.float32)
        outline = cv2.convexHull(pixels)
        w, h = self.job.width - 0.5, self.job.height - 0.5
        frame = np.array([[[-0.5, -0.5]], [[w, -0.5]], [[w, h]], [[-0.5, h]]], np.float32)
        inside, _ = cv2.intersectConvexConvex(outline, frame)
        return float(np.clip(1 - inside / max(cv2.contourArea(outline), 1e-6), 0, 1))


def _check(job: Job, frames: int, workers: int) -> None:
    """Raise UserError for values that cannot be meant."""
    low, high = job.scenes.distractors
    rules = [
        (frames < 1, f"frames={frames}: must be at least 1"),
        (workers < 1, f"workers={workers}: must be at least 1"),
        (job.frames_per_scene < 1, f"frames_per_scene={job.frames_per_scene}: must be at least 1"),
        (min(job.width, job.height) < 32, f"size={job.width},{job.height}: at least 32 pixels a side"),
        (low < 0 or high < low, f"distractors={low},{high}: needs 0 <= least <= most"),
        (not 0 <= job.scenes.occlusion < 1, f"occlusion={job.scenes.occlusion}: a share in [0, 1)"),
        (not 0 <= job.scenes.occluded_share <= 1, f"occluded_share={job.scenes.occluded_share}: a share in [0, 1]"),
        (not 0 <= job.scenes.tabletop_share <= 1, f"tabletop_share={job.scenes.tabletop_share}: a share in [0, 1]"),
    ]
    for wrong, message in rules:
        if wrong:
            raise UserError(message)
    sensor_model(job.sensor)


def _claim(out: Path, job: Job, frames: int) -> None:
    """Write the settings into a new dataset, or make sure that the one there has the same."""
    settings = json.loads(json.dumps({"version": VERSION, **asdict(job)}))
    path = out / GENERATOR
    if path.is_file():
        try:
            there = json.loads(path.read_text())["settings"]
        except (json.JSONDecodeError, KeyError, TypeError) as error:
            raise UserError(f"{path}: not a generator's record any more ({error}); choose another out=") from error
        differing = sorted(k for k in {*there, *settings} if there.get(k) != settings.get(k))
        if differing:
            raise UserError(f"{path}: this dataset was begun with other settings ({', '.join(differing)}); choose another out=")
        for partial in out.glob("mixed/*/.*.part"):
            partial.unlink(missing_ok=True)
    elif out.is_dir() and any(out.iterdir()):
        raise UserError(f"{out}: not empty, and not begun by this generator (no {GENERATOR}); choose another out=")
    out.mkdir(parents=True, exist_ok=True)
    versions = {name: importlib.metadata.version(name) for name in ("posefilter", "numpy", "embreex", "opencv-python-headless")}
    fat.write_json(path, {"settings": settings, "frames": frames, "versions": versions})


def _run(job: Job, out: Path, todo: list[int], workers: int, progress: bool) -> Iterator[int]:
    """Render frames, here or in processes; yield the number done after each lot."""
    lots: dict[tuple[int, int], list[int]] = {}
    for i in todo:
        lots.setdefault((i // job.frames_per_scene, i // FRAMES_PER_TASK), []).append(i)
    columns = (TextColumn("rendering"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(), TextColumn("{task.fields[rate]}"))
    with Progress(*columns, disable=not progress) as bar:
        task = bar.add_task("frames", total=len(todo), rate="")
        began, done = time.perf_counter(), 0
        for count in _results(job, out, list(lots.values()), workers):
            done += count
            bar.update(task, completed=done, rate=f"{done / (time.perf_counter() - began):.1f} frames/s")
            yield done


def _results(job: Job, out: Path, lots: list[list[int]], workers: int) -> Iterator[int]:
    """Yield how many frames each lot had, as they finish."""
    if workers == 1 or len(lots) <= 1:
        painter = Painter(job, out)
        for lot in lots:
            for frame in lot:
                painter.write(frame)
            yield len(lot)
        return
    context = multiprocessing.get_context("spawn")
    with _single_threaded_children():
        pool = ProcessPoolExecutor(min(workers, len(lots)), context, _start_worker, (job, out))
        with pool:
            futures = [pool.submit(_paint_lot, lot) for lot in lots]
            try:
                for future in as_completed(futures):
                    yield future.result()
            finally:
                pool.shutdown(cancel_futures=True)


_painter: Painter | None = None  # one a worker process


def _start_worker(job: Job, out: Path) -> None:
    """Set up a worker process."""
    global _painter
    cv2.setNumThreads(1)
    torch.set_num_threads(1)
    _painter = Painter(job, out)


def _paint_lot(lot: list[int]) -> int:
    """Render some frames in a worker."""
    assert _painter is not None
    for frame in lot:
        _painter.write(frame)
    return len(lot)


@contextmanager
def _single_threaded_children() -> Iterator[None]:
    """Have processes started meanwhile compute with one thread each: as many threads as cores in each would fight."""
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    before = {name: os.environ.get(name) for name in names}
    os.environ.update(dict.fromkeys(names, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
