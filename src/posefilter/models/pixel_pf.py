"""The paper's first method: pose from pixels (section 4.2)."""

from typing import ClassVar

from posefilter.capabilities import Capabilities
from posefilter.models.image_space import ImageSpace


class PixelPF(ImageSpace):
    """Each particle sees the one RGB-D pixel it stands on, and remembers what it saw before in its
    latent.

    It is not told where it stands: the paper concatenates pixel and latent, no more.
    """

    requires: ClassVar[Capabilities] = ("pose",)

    position_width = 0
