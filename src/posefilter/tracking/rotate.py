"""Turns by texture, in a track."""

import torch
from torch import Generator

from posefilter.filters.texture import TextureRotations
from posefilter.protocols import Encoding, Method
from posefilter.types import BeliefBatch


class RotateTogether:
    """Turn the estimate as the print says, and all particles by the same turn.

    In a single image particles spread over the turns that its print leaves open. In a track the
    frames before have decided among them, and particles that each frame scattered anew would be
    missing where the object is. Of a can, of whose shape any turn is open, those near the estimate
    are compared alone: the frame before tells the rest.

    Args:
        texture: Decides the turn.
    """

    def __init__(self, texture: TextureRotations) -> None:
        self.texture = texture

    @torch.no_grad()
    def __call__(
        self, belief: BeliefBatch, encoding: Encoding, method: Method, generator: Generator
    ) -> BeliefBatch:
        """Return the belief, turned; the score stays."""
        best = self.texture.rotate_nearby(belief.best, encoding, method)
        if best is None:
            best = self.texture(belief, encoding, method, generator).best
        turn = torch.linalg.inv(belief.best) @ best  # in the object's frame
        return belief._replace(best=best, poses=belief.poses @ turn[:, None])
