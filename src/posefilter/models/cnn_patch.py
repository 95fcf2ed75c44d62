"""The paper's third method: a CNN patch as the particle, for detection only (section 4.4)."""

from posefilter.models.image_space import ImageSpace


class CnnPatch(ImageSpace):
    """Each particle sees its patch through three convolutions, and tells an offset and a
    likelihood, but no pose.
    """

    position_width = 0
