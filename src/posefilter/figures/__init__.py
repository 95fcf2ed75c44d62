"""Figures of what a filter sees and believes: arrays in, images out.

Nothing here knows Lightning.  The names below are imported when they are first used.
"""

import importlib
from typing import TYPE_CHECKING, Any

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


def __getattr__(name: str) -> Any:
    """Import a figure when it is first asked for (PEP 562)."""
    if name not in _HOMES:
        raise AttributeError(f"module 'posefilter.figures' has no attribute '{name}'")
    return getattr(importlib.import_module(f"posefilter.figures.{_HOMES[name]}"), name)
