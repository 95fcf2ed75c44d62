"""The methods, each a LightningModule: `from posefilter.models import PosePF`.

Their modules, such as `posefilter.models.pose_pf`, hold the same classes without Lightning, which
takes seconds to import and which a prediction does not need.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from posefilter.models.cnn_patch import CnnPatch
    from posefilter.models.downsized import Downsized
    from posefilter.models.patch_pf import PatchPF
    from posefilter.models.pixel_pf import PixelPF
    from posefilter.models.pose_pf import PosePF

__all__ = ["CnnPatch", "Downsized", "PatchPF", "PixelPF", "PosePF"]

_HOMES = {
    "CnnPatch": "cnn_patch",
    "Downsized": "downsized",
    "PatchPF": "patch_pf",
    "PixelPF": "pixel_pf",
    "PosePF": "pose_pf",
}


def __getattr__(name: str) -> Any:
    """Make a method's LightningModule when it is first used (PEP 562)."""
    if name not in _HOMES:
        raise AttributeError(f"module 'posefilter.models' has no attribute '{name}'")
    from posefilter.models.base import with_lightning

    return with_lightning(getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name))
