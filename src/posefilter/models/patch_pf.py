"""The paper's second method: pose from patches (section 4.3)."""

from typing import ClassVar

from posefilter.capabilities import Capabilities
from posefilter.models.image_space import ImageSpace


class PatchPF(ImageSpace):
    """Each particle sees the flattened patch about it and its own location, and remembers in its
    latent.
    """

    requires: ClassVar[Capabilities] = ("pose",)

    position_width = 2
