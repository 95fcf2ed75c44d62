"""The paper's first method: pose from pixels (section 4.2)."""

from typing import ClassVar

from posefilter.capabilities import Capabilities
from posefilter.models.image_space import ImageSpace


class PixelPF(ImageSpace):
    """A particle sees the RGB-D pixel at its position, and keeps a latent.

    Its position is no input: the paper concatenates pixel and latent only.
    """

    requires: ClassVar[Capabilities] = ("pose",)
