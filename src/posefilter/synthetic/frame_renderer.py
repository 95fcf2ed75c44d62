"""Render the frames of a generated dataset; each depends on settings, seed and its number alone."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from posefilter.errors import BadData, UserError
from posefilter.limits import read_json
from posefilter.meshes.store import MeshStore
from posefilter.rendering.embree import EmbreeRenderer
from posefilter.rendering.renderer import Renderer
from posefilter.rendering.surfaces import Rendered, project
from posefilter.synthetic import fat_format as fat
from posefilter.synthetic.motion import MotionSettings, Scenario, draw_scenario, is_possible
from posefilter.synthetic.placing import View
from posefilter.synthetic.scenes import (
    Layout,
    SceneSet,
    SceneSettings,
    SolidStore,
    draw_layout,
    draw_scene_set,
    remove_target,
    shift_camera,
)
from posefilter.synthetic.sensor import simulate_sensor

ATTEMPTS = 400
RENDERERS = ("embree", "opengl")


@dataclass(frozen=True)
class Job:
    """All settings that decide what is rendered; saved with the frames."""

    object: str
    meshes: str
    seed: int
    width: int
    height: int
    K: tuple[tuple[float, ...], ...]
    stereo: bool
    sensor: str
    frames_per_scene: int
    renderer: str
    scenes: SceneSettings
    mesh_scale: float = 1.0  # meters a unit of the mesh files
    motion: MotionSettings = field(default_factory=MotionSettings)

    def view(self) -> View:
        """Return the camera."""
        return View(np.array(self.K), self.height, self.width)

    def least_pixels(self) -> float:
        """Return how many pixels the target has to cover, were nothing in front of it."""
        return 0.002 * self.width * self.height

    def folder(self, frame: int) -> str:
        """Return the folder of a frame."""
        return f"mixed/scene{frame // self.frames_per_scene:04d}_0"

    def cameras(self) -> tuple[tuple[str, float], ...]:
        """Return the cameras' names, and how far right of the left one each stands [m]."""
        return (("left", 0.0), ("right", fat.BASELINE)) if self.stereo else (("left", 0.0),)

    def scene_generator(self, number: int) -> np.random.Generator:
        """Return the random generator of a folder's scene set."""
        return np.random.default_rng([self.seed, 1, number])

    def lacks_target(self, frame: int) -> bool:
        """Tell whether the target is taken out of a frame; where frames follow each other, out of
        all of a scene's.
        """
        share = self.scenes.absent_fraction
        number = frame if self.motion.moves == "none" else frame // self.frames_per_scene
        return share > 0 and bool(np.random.default_rng([self.seed, 3, number]).random() < share)

    def files(self, out: Path, frame: int) -> list[Path]:
        """Return the files of a frame in the order of writing."""
        stem = out / self.folder(frame) / f"{frame % self.frames_per_scene:06d}"
        endings = ("jpg", "depth.png", "seg.png", "json")
        return [
            stem.with_name(f"{stem.name}.{camera}.{ending}")
            for camera, _ in reversed(self.cameras())
            for ending in endings
        ]


def make_renderer(name: str) -> Renderer:
    """Return a renderer by its name.

    Raises:
        UserError: There is none of that name, or it cannot run on this machine.
    """
    if name == "embree":
        return EmbreeRenderer()
    if name == "opengl":
        from posefilter.rendering.opengl import GLRenderer

        return GLRenderer()
    if name == "moderngl":
        raise UserError("renderer=moderngl: is now called opengl")
    raise UserError(f"renderer={name}: unknown; choose from {', '.join(RENDERERS)}")


class FrameRenderer:
    """Renders frames of one job; each process has its own, with renderer and meshes."""

    def __init__(self, job: Job, out: Path, store: MeshStore | None = None) -> None:
        """Set up the renderer, the meshes and the sensor.

        Args:
            job: What to render.
            out: The dataset's folder.
            store: The job's meshes, where they are open already.
        """
        self.job, self.out = job, out
        self.K = np.array(job.K)
        self.library = SolidStore(store or MeshStore(job.meshes, scale=job.mesh_scale))
        self.renderer = make_renderer(job.renderer)
        # frames of one scene are rendered one after another
        self.scene = lru_cache(maxsize=1)(self._draw_scene)
        self.scenario = lru_cache(maxsize=1)(self._draw_scenario)

    def _draw_scene(self, number: int) -> tuple[SceneSet, dict[str, fat.ExportedObject]]:
        """Return a folder's scene set and its classes by name; write the folder's settings.

        Raises:
            UserError: The folder has frames of other classes.
        """
        rng = self.job.scene_generator(number)
        scene = draw_scene_set(self.library, self.job.object, self.job.scenes, rng)
        solids = (scene.target, *scene.distractors, *scene.lookalikes)
        step = min(12, 255 // len(solids))
        exported = [fat.export_object(s.mesh, step * (k + 1)) for k, s in enumerate(solids)]
        folder = self.out / self.job.folder(number * self.job.frames_per_scene)
        folder.mkdir(parents=True, exist_ok=True)
        names = [name for name, _ in self.job.cameras()]
        settings = fat.object_settings(exported)
        _check_begun(folder, settings)
        fat.write_json(folder / fat.OBJECT_SETTINGS, settings)
        camera = fat.camera_settings(self.K, self.job.height, self.job.width, names)
        fat.write_json(folder / fat.CAMERA_SETTINGS, camera)
        return scene, {one.name: one for one in exported}

    def draw(self, frame: int) -> tuple[Layout, Rendered, np.random.Generator]:
        """Draw and render a frame.

        Returns:
            Its layout, the image, and its random generator, for what is drawn afterwards.

        Raises:
            UserError: No layout shows enough of the target.
        """
        absent = self.job.lacks_target(frame)
        scene, _ = self.scene(frame // self.job.frames_per_scene)
        rng = np.random.default_rng([self.job.seed, 2, frame])
        if self.job.motion.moves != "none":
            number, k = divmod(frame, self.job.frames_per_scene)
            layout = self.scenario(number).at(k)
            layout = remove_target(layout) if absent else layout
            return layout, self._render(layout), rng
        first = next(self._draw_layouts(scene, rng, absent), None)
        if first is not None:
            return *first, rng
        raise UserError(
            f"frame {frame}: no layout of {self.job.object} fits after {ATTEMPTS} tries; "
            "the object may be too large or small for this camera, or occlusion and distractors "
            "leave no room"
        )

    def _draw_scenario(self, number: int) -> Scenario:
        """Return what happens in a scene whose frames follow each other.

        Raises:
            UserError: No layout and path keep the target in view.
        """
        scene, _ = self.scene(number)
        rng = np.random.default_rng([self.job.seed, 4, number])
        view = self.job.view()
        for layout, _ in self._draw_layouts(scene, rng):
            for _ in range(8):
                found = draw_scenario(
                    layout,
                    self.job.motion,
                    self.job.frames_per_scene,
                    scene.textures[1],
                    rng,
                    self.job.cameras()[-1][1],
                )
                if is_possible(found, view, self.job.scenes.largest_truncation):
                    return found
        raise UserError(
            f"scene {number}: no layout and path keep {self.job.object} in view after {ATTEMPTS} "
            f"tries; choose fewer frames_per_scene, or less of moving_mm and moving_deg"
        )

    def _draw_layouts(
        self, scene: SceneSet, rng: np.random.Generator, absent: bool = False
    ) -> Iterator[tuple[Layout, Rendered]]:
        """Yield layouts that show enough of the target, unless it is to be absent, and images."""
        size = self.job.height, self.job.width
        for _ in range(ATTEMPTS):
            drawn = draw_layout(scene, self.job.scenes, self.K, *size, rng)
            if drawn is None:
                continue
            layout = remove_target(drawn) if absent else drawn
            if not self._may_show(layout):  # so that it need not be rendered
                continue
            picture = self._render(layout)
            if all(self._shows(picture, k) for k in range(layout.targets)):
                yield layout, picture

    def _render(self, layout: Layout) -> Rendered:
        size = self.job.height, self.job.width
        return self.renderer.render(layout.instances(), self.K, *size, layout.lights, layout.planes)

    def write(self, frame: int) -> None:
        """Render a frame and write its files."""
        layout, picture, rng = self.draw(frame)
        _, exported = self.scene(frame // self.job.frames_per_scene)
        pending = [self._images(layout, picture, exported, 0.0, rng)]
        for _, right in self.job.cameras()[1:]:
            shifted = shift_camera(layout, right)
            picture = self._render(shifted)
            pending.append(self._images(shifted, picture, exported, right, rng))
        files = iter(self.job.files(self.out, frame))
        for images, record in reversed(pending):
            for image in images:
                fat.write_image(next(files), image)
            fat.write_json(next(files), record)

    def _may_show(self, layout: Layout) -> bool:
        """Return whether each instance of the target may be large enough, by an upper bound."""
        view = self.job.view()
        for one in layout.placed[: layout.targets]:
            mesh = one.solid.mesh
            if view.most_pixels(mesh, one.center[2] - mesh.reach) < self.job.least_pixels():
                return False
        return True

    def _shows(self, picture: Rendered, instance: int) -> bool:
        """Return whether enough of an instance of the target is visible."""
        seen, alone = int((picture.index == instance).sum()), int(picture.unoccluded[instance])
        least = self.job.least_pixels()
        return alone >= least and seen >= (1 - self.job.scenes.max_occlusion) * alone

    def _images(
        self,
        layout: Layout,
        picture: Rendered,
        exported: dict[str, fat.ExportedObject],
        right: float,
        rng: np.random.Generator,
    ) -> tuple[list[np.ndarray], dict[str, Any]]:
        """Return a camera's color, depth and segmentation images, and its JSON record."""
        photo, depth = simulate_sensor(picture.rgb, picture.depth, self.job.sensor, rng)
        ids = np.array([*(exported[p.solid.mesh.name].seg_id for p in layout.placed), 0], np.uint8)
        seen = np.bincount(picture.index.reshape(-1) + 1, minlength=len(layout.placed) + 1)[1:]
        objects = []
        for k, one in enumerate(layout.placed):
            name, pose = one.solid.mesh.name, one.camera_from_object
            if name == self.job.object or seen[k] > 0:
                share = float(seen[k] / max(int(picture.unoccluded[k]), 1))
                truncated = self._truncated(one.hull)
                objects.append(fat.ObjectInFrame(exported[name], pose, share, truncated))
        images = [photo, fat.depth_units(depth), ids[picture.index]]
        return images, fat.frame_record(objects, self.K, right)

    def _truncated(self, hull: np.ndarray) -> float:
        """Return the fraction of a hull's outline, by area, that is out of the frame."""
        outline = cv2.convexHull(project(hull, self.K).astype(np.float32))
        w, h = self.job.width - 0.5, self.job.height - 0.5
        frame = np.array([[[-0.5, -0.5]], [[w, -0.5]], [[w, h]], [[-0.5, h]]], np.float32)
        inside, _ = cv2.intersectConvexConvex(outline, frame)
        return float(np.clip(1 - inside / max(cv2.contourArea(outline), 1e-6), 0, 1))


def _check_begun(folder: Path, settings: dict[str, Any]) -> None:
    """Raise UserError where a folder has frames of other classes than its settings would name."""
    path = folder / fat.OBJECT_SETTINGS
    if not path.is_file() or not any(folder.glob("[0-9]*.json")):
        return
    try:
        there = read_json(path)
    except BadData:
        there = None
    if there != settings:
        raise UserError(
            f"{folder}: begun with other meshes, which were added or changed since; delete this "
            f"folder, and it is rendered anew"
        )
