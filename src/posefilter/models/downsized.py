"""The paper's fourth method: the third on a small image (section 4.5)."""

from posefilter.models.cnn_patch import CnnPatch


class Downsized(CnnPatch):
    """The same on an image 160 pixels wide (`data.image_width`): a patch covers more of the
    object.
    """
