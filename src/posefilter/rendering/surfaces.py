"""The content of an image (instances, planes, lights), what each pixel sees of it, and shading.

Camera axes are OpenCV's, with pixel centers at integers. Rays are not normalized but [x, y, 1], so
that the distance along a ray is the z-depth.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from posefilter.meshes.mesh import Mesh

NEAR = 0.02  # [m]; nothing nearer is drawn


@dataclass(frozen=True, eq=False)
class Instance:
    """One mesh in an image."""

    mesh: Mesh
    camera_from_object: np.ndarray  # (4, 4) [m]; its linear part may scale


@dataclass(frozen=True, eq=False)
class Plane:
    """A textured rectangle in the plane z = 0 of its own frame."""

    camera_from_plane: np.ndarray  # (4, 4) [m], rigid
    half_extent: tuple[float, float]  # [m] along its x and y
    texture: np.ndarray  # (h, w, 3) uint8, repeated
    tile: float  # the side of one copy of the texture [m]


@dataclass(frozen=True)
class Lights:
    """Ambient light, and directional lights."""

    ambient: float = 0.6
    # towards the light, camera axes
    directions: tuple[tuple[float, float, float], ...] = ((0.3, -0.7, -0.6),)
    strengths: tuple[float, ...] = (0.5,)
    specular: float = 0.0
    shininess: float = 20.0
    shadows: bool = False  # of the instances, cast by the first light
    shadow_blur: float = 1.0  # [px / 3]
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)  # color where nothing is


@dataclass(frozen=True, eq=False)
class Surfaces:
    """What each pixel sees, before shading."""

    albedo: np.ndarray  # (H, W, 3) float32 in [0, 1]
    normal: np.ndarray  # (H, W, 3) float32 unit, camera axes, towards the camera
    depth: np.ndarray  # (H, W) float32 [m], 0 = nothing
    index: np.ndarray  # (H, W) int32 into the instances, -1 = none of them
    unoccluded: np.ndarray  # (I,) pixels in the frame that each instance would have were it alone


@dataclass(frozen=True, eq=False)
class Rendered:
    """A shaded image."""

    rgb: np.ndarray  # (H, W, 3) float32, 1 = white, may exceed it
    depth: np.ndarray  # (H, W) float32 [m], 0 = nothing
    index: np.ndarray  # (H, W) int32 into the instances, -1 = none of them
    unoccluded: np.ndarray  # (I,) pixels in the frame that each instance would have were it alone


def pixel_rays(K: np.ndarray, height: int, width: int) -> np.ndarray:
    """Return the ray [x, y, 1] through each pixel's center.  -> (H, W, 3) float32."""
    rays = np.ones((height, width, 3), np.float32)
    rays[..., 0] = (np.arange(width) - K[0, 2]) / K[0, 0]
    rays[..., 1] = ((np.arange(height) - K[1, 2]) / K[1, 1])[:, None]
    return rays


def project(points: np.ndarray, K: np.ndarray) -> np.ndarray:
    """Return where a camera sees points before it.  (P, 3) [m], (3, 3) [px] -> (P, 2) [px]."""
    return points[:, :2] / points[:, 2:] * [K[0, 0], K[1, 1]] + [K[0, 2], K[1, 2]]


def covered_pixels(points: np.ndarray, K: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Find the pixels that the convex hull of points may cover.

    Args:
        points: (P, 3) in the camera [m].
        K: (3, 3) camera matrix [px].
        shape: Height and width of the image [px].

    Returns:
        Flat indices of the pixels, with a margin.
    """
    height, width = shape
    if (points[:, 2] < NEAR).all():
        return np.zeros(0, np.int64)
    if (points[:, 2] < NEAR).any():
        return np.arange(height * width)
    pixels = project(points, K)
    low = np.maximum(np.floor(pixels.min(0)).astype(int) - 2, 0)
    high = np.minimum(np.ceil(pixels.max(0)).astype(int) + 3, [width, height])
    if (high <= low).any():
        return np.zeros(0, np.int64)
    if (np.abs(pixels) > 5 * max(width, height)).any():
        # beyond what can be drawn; corners moved one by one would turn the outline
        return np.arange(height * width)
    outline = cv2.convexHull(np.round((pixels - low) * 16).astype(np.int32))
    mask = np.zeros((high[1] - low[1], high[0] - low[0]), np.uint8)
    cv2.fillConvexPoly(mask, outline, 1, shift=4)
    cv2.polylines(mask, [outline], True, 1, thickness=3, shift=4)  # a margin: the fill rounds
    y, x = np.nonzero(mask)
    return (y + low[1]) * width + x + low[0]


def shade(
    surfaces: Surfaces, rays: np.ndarray, lights: Lights, shadow: np.ndarray | None = None
) -> np.ndarray:
    """Shade surfaces: ambient, Lambertian, and a Blinn-Phong highlight of the first light.

    Args:
        surfaces: What each pixel sees.
        rays: (H, W, 3); see `pixel_rays`.
        lights: The lights.
        shadow: (H, W) how much of the first light arrives, in [0, 1]; None: all of it.

    Returns:
        (H, W, 3) float32, 1 = white; may exceed it.
    """
    shade = np.full(surfaces.depth.shape, np.float32(lights.ambient))
    highlight = np.zeros_like(shade)
    for k, (direction, strength) in enumerate(
        zip(lights.directions, lights.strengths, strict=True)
    ):
        L = unit(np.asarray(direction, np.float32))
        arriving = np.float32(strength) if k or shadow is None else np.float32(strength) * shadow
        shade += arriving * np.maximum(surfaces.normal @ L, 0)
        if k == 0 and lights.specular > 0:
            half = L - rays / np.linalg.norm(rays, axis=-1, keepdims=True)
            half /= np.linalg.norm(half, axis=-1, keepdims=True) + 1e-6
            glint = np.maximum((surfaces.normal * half).sum(-1), 0) ** np.float32(lights.shininess)
            highlight = glint * np.float32(lights.specular) * (1 if shadow is None else shadow)
    rgb = surfaces.albedo * shade[..., None] + highlight[..., None]
    rgb[surfaces.depth == 0] = lights.background
    return rgb


def unit(v: np.ndarray) -> np.ndarray:
    """Return a vector divided by its length."""
    return v / np.linalg.norm(v)
