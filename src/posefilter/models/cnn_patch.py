"""The paper's third method: a CNN patch as the particle, for detection only (section 4.4)."""

from posefilter.models.image_space import ImageSpace


class CnnPatch(ImageSpace):
    """A particle's patch passes three convolutions; the output is an offset and a likelihood."""
