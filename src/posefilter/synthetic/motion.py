"""Motion: the frames of a scene follow each other, as those of a video do.

A scene is laid out once. From frame to frame the camera goes round the object, the object moves
through the scene, or both, on smooth paths; and for a while something may pass before the object
that hides it wholly.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from posefilter.errors import UserError
from posefilter.geometry.rigid import rigid
from posefilter.rendering.surfaces import Plane
from posefilter.synthetic.placing import Placed, View, are_separate
from posefilter.synthetic.scenes import Layout, move_all

MOTIONS = ("none", "camera", "object", "both")
_PERIODS = (16.0, 48.0)  # [frames] of the sine along each axis
_DEPTH = 0.6  # of the cover, as a share of the object's
_MARGIN = 1.3  # the cover's half sides, over what hides the object's ball
_SLIDE = 3  # frames in which the cover comes before the object, and in which it leaves


@dataclass(frozen=True)
class MotionSettings:
    """How the frames of a scene follow each other.

    Raises:
        UserError: A value is wrong.
    """

    moves: str = "none"  # each frame is arranged anew; or "camera", "object", "both"
    translation_mm: float = 5.0  # root mean square, from one frame to the next, of what moves
    rotation_deg: float = 1.0  # the same
    fully_occluded_frames: int = 0  # in a row, in the middle of each scene: the object is hidden

    def __post_init__(self) -> None:
        """Check the choice."""
        if self.moves not in MOTIONS:
            raise UserError(f"moving={self.moves}: unknown; choose from {', '.join(MOTIONS)}")
        if self.fully_occluded_frames and self.moves == "none":
            raise UserError(
                "fully_occluded_frames: frames that follow each other are needed; choose "
                "moving=camera, object or both"
            )


@dataclass(frozen=True, eq=False)
class Scenario:
    """A scene's layout, and what becomes of it."""

    layout: Layout  # of frame 0
    camera: np.ndarray  # (T, 6) how all has moved since then, relative to the camera
    target: np.ndarray  # (T, 6) how the target has moved, relative to all else
    cover: Plane | None  # its texture and tile; where it stands follows from the frame
    covered: range  # the frames that it covers the target in
    side: np.ndarray  # (2,) unit, from where it comes, in the image's axes
    baseline: float = 0.0  # to a second camera, that it hides the target from, too [m]

    def at(self, frame: int) -> Layout:
        """Return the layout of a frame."""
        first, *others = self.layout.placed
        moved = _move_about(self.target[frame], first.center) @ first.camera_from_object
        layout = replace(self.layout, placed=(Placed(first.solid, moved), *others))
        layout = move_all(layout, _move_about(self.camera[frame], first.center))
        cover = self._place_cover(frame, layout.placed[0])
        return layout if cover is None else replace(layout, planes=(*layout.planes, cover))

    def _place_cover(self, frame: int, target: Placed) -> Plane | None:
        """Return the cover, which faces the camera; None while it is out of the way."""
        if self.cover is None:
            return None
        away = max(self.covered.start - frame, frame - self.covered.stop + 1, 0)
        if away > _SLIDE:
            return None
        distance = float(np.linalg.norm(target.center))
        radius = min(target.solid.radius, 0.9 * distance)
        half = _MARGIN * _DEPTH * distance * math.tan(math.asin(radius / distance))
        half += self.baseline * (1 - _DEPTH)  # so far it is beside the object from the second
        towards = target.center / distance
        right = np.cross([0.0, 1.0, 0.0], towards)
        right /= np.linalg.norm(right)
        axes = np.stack([right, np.cross(towards, right), towards], 1)
        sign = 1 if frame < self.covered.start else -1
        shift = sign * self.side * 2 * half * away / _SLIDE
        pose = rigid(axes, _DEPTH * target.center + axes[:, :2] @ shift)
        return replace(self.cover, camera_from_plane=pose, half_extent=(half, half))


def draw_scenario(
    layout: Layout,
    settings: MotionSettings,
    frames: int,
    texture: np.ndarray,
    rng: np.random.Generator,
    baseline: float = 0.0,
) -> Scenario:
    """Draw paths, and a cover.

    On a table the object slides and turns on it; in the air it moves freely.

    Args:
        layout: Of the first frame.
        settings: The motion.
        frames: Frames of the scene, T.
        texture: Of the cover, (h, w, 3) uint8.
        rng: Source of randomness.
        baseline: Distance to the right one of two cameras [m].
    """
    still = np.zeros((frames, 6))
    steps = settings.translation_mm, settings.rotation_deg
    paths = [draw_path(frames, *steps, rng) for _ in range(2)]
    camera = paths[0] if settings.moves in ("camera", "both") else still
    target = paths[1] if settings.moves in ("object", "both") else still
    if layout.tabletop:
        target = _stay_on_table(target, layout)
    start = (frames - settings.fully_occluded_frames) // 2
    angle = rng.uniform(0, 2 * math.pi)
    cover = Plane(np.eye(4), (1.0, 1.0), texture, float(rng.uniform(0.1, 0.4)))
    return Scenario(
        layout,
        camera,
        target,
        cover if settings.fully_occluded_frames else None,
        range(start, start + settings.fully_occluded_frames),
        np.array([math.cos(angle), math.sin(angle)]),
        baseline,
    )


def draw_path(
    frames: int, translation_mm: float, rotation_deg: float, rng: np.random.Generator
) -> np.ndarray:
    """Draw a smooth path that starts at 0: a sine of its own along each axis.

    The expected square of a step is `translation_mm` squared, and `rotation_deg` squared for
    the rotation vector.

    Args:
        frames: T.
        translation_mm: From one frame to the next, root mean square [mm].
        rotation_deg: Likewise [degrees].
        rng: Source of randomness.

    Returns:
        (T, 6) shift [m] and rotation vector [rad] since the first frame.
    """
    period = rng.uniform(*_PERIODS, 6)
    phase = rng.uniform(0, 2 * math.pi, 6)
    step = np.repeat([translation_mm / 1000, math.radians(rotation_deg)], 3) / math.sqrt(3)
    # a sine of amplitude a moves by 2 a sin(pi / period) |cos| a frame: root mean square sqrt(2) a
    # sin(pi / period)
    amplitude = step / (math.sqrt(2) * np.sin(math.pi / period))
    time = np.arange(frames)[:, None]
    return amplitude * (np.sin(2 * math.pi * time / period + phase) - np.sin(phase))


def is_possible(scenario: Scenario, view: View, largest_truncation: float) -> bool:
    """Return whether in all frames the target stays in view and touches nothing; a table carries
    it, and is seen from above.
    """
    moved = bool(np.abs(scenario.target).any())
    for frame in range(len(scenario.camera)):
        layout = scenario.at(frame)
        target, *others = layout.placed
        if not view.holds(target, largest_truncation):
            return False
        if layout.tabletop and not _is_carried(target, layout.planes[0]):
            return False
        if moved and not all(are_separate(target, other) for other in others):
            return False
    return True


def _is_carried(one: Placed, table: Plane) -> bool:
    """Return whether an object's center is over a table, whose top faces the camera."""
    rotation, origin = table.camera_from_plane[:3, :3], table.camera_from_plane[:3, 3]
    x, y, _ = rotation.T @ (one.center - origin)
    over = abs(x) < table.half_extent[0] and abs(y) < table.half_extent[1]
    return bool(over and -rotation[:, 2] @ origin > 0.02)


def _move_about(twist: np.ndarray, about: np.ndarray) -> np.ndarray:
    """Return the motion (4, 4) that turns about a point, and shifts."""
    turn = Rotation.from_rotvec(twist[3:]).as_matrix()
    return rigid(turn, about + twist[:3] - turn @ about)


def _stay_on_table(path: np.ndarray, layout: Layout) -> np.ndarray:
    """Return the part of a path that stays on the table: along it, and about its normal.

    What is left is as fast as the whole was expected to be.
    """
    up = layout.planes[0].camera_from_plane[:3, 2]
    along = path[:, :3] - np.outer(path[:, :3] @ up, up)
    about = np.outer(path[:, 3:] @ up, up)
    return np.concatenate([along * math.sqrt(3 / 2), about * math.sqrt(3)], axis=1)
