"""A toy object whose likelihood is made by hand: a function of the distance to the true pose."""

from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from torch import Generator, Tensor

from posefilter.capabilities import Capabilities
from posefilter.estimator import Estimator
from posefilter.filters.estimate import Argmax
from posefilter.filters.initialize import FromProposals
from posefilter.filters.loop import ParticleFilter
from posefilter.filters.propagate import Gaussian
from posefilter.filters.refine import NoRefine
from posefilter.filters.resample import Systematic
from posefilter.filters.reweight import CurrentLikelihood
from posefilter.filters.schedule import Geometric
from posefilter.geometry.camera import pixel_grid, project
from posefilter.geometry.pose import origin_of, pose_about
from posefilter.geometry.rotation import random_rotation
from posefilter.geometry.spaces import PoseSpace
from posefilter.models.base import PoseEstimator
from posefilter.types import Batch, ObjectModel

CENTER = (0.02, 0.0, -0.01)
SPACE = PoseSpace(CENTER, 0.08)
K = np.array([[200.0, 0, 79.5], [0, 200, 59.5], [0, 0, 1]])
RGB = np.zeros((120, 160, 3), np.uint8)
RGB[:, :80, 0] = 90  # that it is not blank
# nearer than the object: nothing is seen through
DEPTH = np.tile(np.linspace(0.69, 0.71, 160, dtype=np.float32), (120, 1))


class ToyEncoding(NamedTuple):
    """The true pose, and a map of the cells about where it puts the object."""

    truth: Tensor | None
    objectness: Tensor


class Toy(PoseEstimator):
    """A method that sees the true pose, `truth`, or nothing where that is None."""

    provides: ClassVar[Capabilities] = (
        "pose",
        "pose_space",
        "score_poses",
        "propose_poses",
        "objectness",
    )

    def __init__(self) -> None:
        filter = ParticleFilter(
            200, 8, FromProposals(), Geometric(0.04, 0.004), CurrentLikelihood(), Systematic(),
            Gaussian(), Argmax(), NoRefine(),
        )  # fmt: skip
        super().__init__(filter, loss=unused, optimizer=unused)  # type: ignore[arg-type]
        self.truth: Tensor | None = None
        self.ghost: Tensor | None = None  # what the network takes for the object where it is not
        self.encoded: list[tuple[int, ...]] = []  # sizes of the images that were encoded
        self.scored: list[int] = []  # image points that poses were scored from, call by call
        line = torch.linspace(-0.05, 0.05, 3)
        points = torch.cartesian_prod(line, line, line) + torch.tensor(CENTER)
        self.set_object(
            ObjectModel("toy", points, torch.tensor(CENTER), 0.08, 0.17, torch.eye(4)[None], points)
        )

    @property
    def space(self) -> PoseSpace:
        return SPACE

    def encode(self, batch: Batch) -> Any:
        self.encoded.append(tuple(batch.rgb.shape[-2:]))
        height, width = batch.rgb.shape[-2:]
        cells = pixel_grid(height, width, 4).reshape(-1, 2)
        shown = self.ghost if self.truth is None else self.truth
        if shown is None:
            return ToyEncoding(None, torch.zeros(1, 1, height // 4, width // 4))
        middle = origin_of(shown.float(), torch.tensor(CENTER))
        reach = SPACE.radius * batch.intrinsics[0, 0, 0] / middle[2]
        near = (cells - project(middle[None], batch.intrinsics[0])).norm(dim=1) < reach
        return ToyEncoding(self.truth, near.float().view(1, 1, height // 4, width // 4))

    def measure(self, encoding: Any, particles: Any, step: Any, generator: Generator) -> Any:
        from posefilter.tracking.scoring import FrameScorer

        return FrameScorer(self, encoding, 64).measure(encoding, particles, step, generator)

    def score_poses(
        self, encoding: Any, poses: Tensor, sigma: float, generator: Generator, pixels: int
    ) -> Tensor:
        self.scored.append(poses.shape[1] * pixels)
        noise = 0.2 * torch.randn(poses.shape[:2], generator=generator)
        if encoding.truth is None:
            return noise - 10
        distance = SPACE.distance(poses, encoding.truth.to(poses)[None, None])
        return noise - 10 * torch.log1p((distance / (sigma + 0.002)).square() / 5)

    def propose_poses(self, encoding: Any, particles: int, generator: Generator) -> Tensor:
        """Half of them near the object, if there is one; the others anywhere."""
        place = torch.rand(particles, 3, generator=generator) - 0.5 + torch.tensor([0, 0, 1.0])
        R = random_rotation(particles, generator=generator)
        poses = pose_about(R, place, torch.tensor(CENTER))
        if encoding.truth is not None:
            near = torch.randn(particles // 2, 6, generator=generator) * SPACE.noise_scale(
                torch.tensor(0.03)
            )
            poses[: particles // 2] = SPACE.move(
                encoding.truth.float().expand(len(near), 4, 4), near
            )
        return poses[None]


class SeeingToy(Toy):
    """A toy that reads the true pose off the image: its green is the number of a pose.

    It can be sent to another process, since nothing has to be told to it.

    Args:
        poses: (n, 4, 4); None stands for no object.
    """

    def __init__(self, poses: list[Tensor | None]) -> None:
        super().__init__()
        self.poses = poses

    def encode(self, batch: Batch) -> Any:
        self.truth = self.poses[round(255 * float(batch.rgb[:, 1].mean()))]
        return super().encode(batch)


def unused(*_: object) -> None:
    """Stand for the loss and the optimizer, which tracking does not need."""


def make_toy() -> tuple[Toy, Estimator]:
    """Return the method, whose truth a test sets, and the estimator of it."""
    toy = Toy()
    return toy, Estimator([toy], "cpu")


def walk_pose(frames: int, shift: float = 0.004, turn: float = 0.02) -> Tensor:
    """Return the poses (frames, 4, 4) of an object that moves steadily [m, rad a frame]."""
    start = pose_about(
        random_rotation(generator=torch.Generator().manual_seed(3)),
        torch.tensor([-0.05, 0.02, 0.9]),
        torch.tensor(CENTER),
    )
    twist = torch.tensor([shift, 0.0, 0.0, 0.0, turn, 0.0])
    return torch.stack([SPACE.move(start, n * twist) for n in range(frames)])
