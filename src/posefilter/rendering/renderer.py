"""The base class of the renderers: surfaces are theirs, shadows and shading are shared."""

from abc import ABC, abstractmethod
from collections.abc import Sequence

import numpy as np

from posefilter.rendering.raycasting import RayCaster
from posefilter.rendering.surfaces import (
    Instance,
    Lights,
    Plane,
    Rendered,
    Surfaces,
    pixel_rays,
    shade,
)


class Renderer(ABC):
    """Render instances and planes as color, depth and labels.

    Args:
        keep: The number of newest meshes that stay built for ray casting.
    """

    def __init__(self, keep: int = 96) -> None:
        self.caster = RayCaster(keep)

    @abstractmethod
    def surfaces(
        self,
        instances: Sequence[Instance],
        K: np.ndarray,
        height: int,
        width: int,
        planes: Sequence[Plane] = (),
    ) -> Surfaces:
        """Return what each pixel sees.

        Args:
            instances: Posed meshes.
            K: (3, 3) camera matrix [px].
            height: Of the image [px].
            width: Of the image [px].
            planes: Textured rectangles; `index` and `unoccluded` do not count them.
        """

    def render(
        self,
        instances: Sequence[Instance],
        K: np.ndarray,
        height: int,
        width: int,
        lights: Lights,
        planes: Sequence[Plane] = (),
    ) -> Rendered:
        """Return the shaded image; arguments as of `surfaces`, and the lights."""
        surfaces = self.surfaces(instances, K, height, width, planes)
        rays = pixel_rays(K, height, width)
        shadow = self.caster.shadow(surfaces, rays, instances, lights) if lights.shadows else None
        rgb = shade(surfaces, rays, lights, shadow)
        return Rendered(rgb, surfaces.depth, surfaces.index, surfaces.unoccluded)
