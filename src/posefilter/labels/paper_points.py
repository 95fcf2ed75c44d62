"""The paper's labels of points along the rays of the object's pixels (section 5)."""

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from posefilter.capabilities import Capabilities
from posefilter.types import Batch, ObjectModel, Trace


@dataclass(eq=False)
class PaperPoints:
    """+100 on the surface with its own color, -100 behind the surface, 0 otherwise.

    The value 0 stands for possible occluders and foreign colors. States are samples (B, N, 4):
    pixel u, v; offset behind the observed surface [m]; 1 for the pixel's own color, 0 for a random
    color.

    Args:
        tolerance: Offset up to which a sample is on the surface [m].
        surface_label: Label on the surface.
        behind_label: Label behind the surface.
    """

    requires: ClassVar[Capabilities] = ("ray_samples",)

    tolerance: float = 0.01
    surface_label: float = 100.0
    behind_label: float = -100.0

    def __call__(self, trace: Trace, batch: Batch, object_model: ObjectModel) -> Tensor:
        """Return labels (1, B, N)."""
        offset = trace.particles[-1].state[..., 2]
        own_color = trace.particles[-1].state[..., 3] > 0.5
        label = torch.where(offset > self.tolerance, self.behind_label, 0.0)
        on_surface = (offset.abs() <= self.tolerance) & own_color
        return torch.where(on_surface, self.surface_label, label)[None]
