"""Figures of what a filter sees and believes: arrays in, images out.

Nothing here knows Lightning.  The names below are imported when they are first used.
"""

from typing import TYPE_CHECKING

from posefilter.lazy import import_lazily

if TYPE_CHECKING:
    from posefilter.figures.belief import draw_belief
    from posefilter.figures.canvas import save_image
    from posefilter.figures.overlay import draw_overlay, draw_poses

__all__ = ["draw_belief", "draw_overlay", "draw_poses", "save_image"]

_HOMES = {
    "draw_belief": "belief",
    "draw_overlay": "overlay",
    "draw_poses": "overlay",
    "save_image": "canvas",
}
__getattr__ = import_lazily(__name__, _HOMES)
