"""A belief over one object's pose in one image, as numbers: what `Estimator.predict` hands back."""

import zipfile
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from posefilter.errors import UserError
from posefilter.files import open_whole
from posefilter.filters.modes import find_pose_modes
from posefilter.geometry.pose import is_rigid
from posefilter.geometry.pose_statistics import covariance_about
from posefilter.geometry.spaces import PoseSpace
from posefilter.limits import MOST_BYTES


@dataclass(frozen=True)
class Mode:
    """One of the poses round which a belief gathers.

    Attributes:
        pose: The densest particle (4, 4), camera_from_object [m].
        mass: Its share of the belief, in (0, 1].
        covariance: Of its own particles about their mean pose (6, 6); see `Belief.covariance`.
    """

    pose: np.ndarray
    mass: float
    covariance: np.ndarray


@dataclass(frozen=True, eq=False)
class Belief:
    """Weighted poses of one object in one image.

    The batch of tensors that a filter itself returns is `posefilter.types.Belief`.

    Attributes:
        samples: Poses (N, 4, 4) camera_from_object, float64 [m].
        weights: Their weights (N,), float64; they sum to 1.
        center: The object's center (3,) in its own frame [m], about which poses turn.
        radius: Half the diagonal of the object's bounding box [m]; a turn counts as the shift that
            it gives at this distance.
        diameter: The largest distance between two points of the object [m].
        object: The object's name.
    """

    samples: np.ndarray
    weights: np.ndarray
    center: np.ndarray
    radius: float
    diameter: float
    object: str = ""

    def __post_init__(self) -> None:
        """Check shapes.

        Raises:
            UserError: The arrays do not fit each other, or hold no poses and weights.
        """
        count = len(self.weights)
        if self.samples.shape != (count, 4, 4) or self.weights.shape != (count,) or not count:
            raise UserError(
                f"belief: samples {self.samples.shape} and weights {self.weights.shape} should be "
                f"(N, 4, 4) and (N,)"
            )
        total = float(self.weights.sum())
        if not (np.isfinite(total) and abs(total - 1) < 1e-3 and (self.weights >= 0).all()):
            raise UserError(f"belief: the weights should be positive and sum to 1, not {total:.6g}")
        if not np.isfinite(self.samples).all() or not is_rigid(torch.from_numpy(self.samples)):
            raise UserError("belief: the samples should be rigid transforms")

    @cached_property
    def mean(self) -> np.ndarray:
        """The mean pose (4, 4): the mean of the centers, and the chordal mean of the rotations.

        Between two modes it is a pose that no particle holds; see `modes`.
        """
        return self._mean(*self._tensors).numpy()

    @cached_property
    def covariance(self) -> np.ndarray:
        """The covariance (6, 6) of the particles' twists about the mean pose.

        Rows and columns are [x, y, z, rx, ry, rz]: the shift of the object's center in the camera's
        axes [m], then the rotation vector about that center in the object's own axes [rad].  Square
        roots of the diagonal are standard deviations.
        """
        samples, weights = self._tensors
        mean = torch.from_numpy(self.mean)
        return covariance_about(mean, samples, weights, torch.from_numpy(self.center)).numpy()

    @cached_property
    def modes(self) -> tuple[Mode, ...]:
        """The poses round which the weight gathers, the heaviest first; their masses sum to 1.

        Found by quick shift (Vedaldi & Soatto 2008): two particles belong to one mode where a chain
        of ever denser neighbors, each within a tenth of the diameter, leads from one to the other.
        """
        samples, weights = self._tensors
        center = torch.from_numpy(self.center)
        found = find_pose_modes(samples, weights.log(), self._space, self.diameter)
        modes = []
        for number, (pose, mass) in enumerate(zip(found.states, found.weights, strict=True)):
            own = found.member == number
            poses, share = samples[own], weights[own] / weights[own].sum()
            spread = covariance_about(self._mean(poses, share), poses, share, center)
            modes.append(Mode(pose.numpy(), float(mass), spread.numpy()))
        return tuple(modes)

    @property
    def entropy(self) -> float:
        """The entropy of the weights [nat]: 0 where one particle has them all, log N where all are
        alike.
        """
        weights = self._tensors[1]
        return -float(torch.special.xlogy(weights, weights).sum())

    @property
    def effective_samples(self) -> float:
        """The effective sample size (Kong 1992): 1 where one particle has all the weight, N where
        all are alike.
        """
        return float(1 / np.square(self.weights).sum())

    def save(self, path: str | Path) -> None:
        """Write the belief as an .npz file; `Belief.load` reads it.

        Its arrays are `poses` (N, 4, 4) and `weights` (N,) in float32, and `center`, `radius`,
        `diameter` and `object`.

        Raises:
            UserError: It cannot be written.
        """
        file = Path(path)
        file = file if file.suffix == ".npz" else file.with_name(f"{file.name}.npz")
        named = {field.name: getattr(self, field.name) for field in fields(self)}
        poses, weights = named.pop("samples"), named.pop("weights")
        poses, weights = poses.astype(np.float32), weights.astype(np.float32)
        with open_whole(file, sync=False) as stream:
            np.savez_compressed(stream, poses=poses, weights=weights, **named)

    @classmethod
    def load(cls, path: str | Path) -> "Belief":
        """Read what `save` wrote.

        Raises:
            UserError: The file is missing, or holds no belief.
        """
        file = Path(path)
        if not file.is_file():
            raise UserError(f"{path}: no such file")
        try:
            with zipfile.ZipFile(file) as archive:
                if sum(part.file_size for part in archive.infolist()) > MOST_BYTES:
                    raise UserError(f"{path}: is larger than a belief can be")
            with np.load(file, allow_pickle=False) as stored:
                read: dict[str, Any] = {name: stored[name] for name in stored.files}
            weights = read["weights"].astype(np.float64)
            return cls(
                np.ascontiguousarray(read["poses"], dtype=np.float64),
                weights / weights.sum(),
                read["center"].astype(np.float64).reshape(3),
                float(read["radius"]),
                float(read["diameter"]),
                str(read["object"]),
            )
        except (KeyError, ValueError, TypeError, OSError, EOFError, zipfile.BadZipFile) as error:
            raise UserError(f"{path}: holds no belief as posefilter writes it ({error})") from error

    @property
    def _tensors(self) -> tuple[Tensor, Tensor]:
        return torch.from_numpy(self.samples), torch.from_numpy(self.weights)

    @property
    def _space(self) -> PoseSpace:
        x, y, z = self.center.tolist()
        return PoseSpace((x, y, z), self.radius)

    def _mean(self, samples: Tensor, weights: Tensor) -> Tensor:
        return self._space.mean(samples, weights)
