"""The paper's second method: pose from patches (section 4.3)."""

from typing import ClassVar

from posefilter.capabilities import Capabilities
from posefilter.models.image_space import ImageSpace


class PatchPF(ImageSpace):
    """A particle sees the flattened patch around it and its own position, and keeps a latent."""

    requires: ClassVar[Capabilities] = ("pose",)

    position_width = 2
