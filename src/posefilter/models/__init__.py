"""The methods, each a LightningModule: `from posefilter.models import PosePF`.

Their modules, such as `posefilter.models.pose_pf`, hold the same classes without Lightning, which
takes seconds to import and which a prediction does not need.
"""

from typing import TYPE_CHECKING, Any

from posefilter.lazy import import_lazily

if TYPE_CHECKING:
    from posefilter.models.cnn_patch import CnnPatch as CnnPatch
    from posefilter.models.dense_coordinates import DenseCoordinates as DenseCoordinates
    from posefilter.models.downsized import Downsized as Downsized
    from posefilter.models.keypoints import Keypoints as Keypoints
    from posefilter.models.parts_pf import PartsPF as PartsPF
    from posefilter.models.patch_pf import PatchPF as PatchPF
    from posefilter.models.pixel_pf import PixelPF as PixelPF
    from posefilter.models.pose_pf import PosePF as PosePF
    from posefilter.models.rotation_grid import RotationGrid as RotationGrid

_HOMES = {
    "CnnPatch": "cnn_patch",
    "DenseCoordinates": "dense_coordinates",
    "Downsized": "downsized",
    "Keypoints": "keypoints",
    "PartsPF": "parts_pf",
    "PatchPF": "patch_pf",
    "PixelPF": "pixel_pf",
    "PosePF": "pose_pf",
    "RotationGrid": "rotation_grid",
}
__all__ = [*_HOMES]


def _make_lightning_module(kind: Any) -> Any:
    from posefilter.models.base import with_lightning

    return with_lightning(kind)


__getattr__ = import_lazily(__name__, _HOMES, _make_lightning_module)
