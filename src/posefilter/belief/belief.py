"""A belief over one object's pose in one image: weighted poses, and what they amount to."""

from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from numbers import Integral, Real
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from posefilter.belief.sets import PoseSet
from posefilter.belief.storage import read_arrays, write_arrays
from posefilter.belief.summaries import (
    AXES,
    Marginal,
    Mode,
    Projection,
    Uncertainty,
    check_probability,
    find_quantile,
    measure_uncertainty,
    project_belief,
)
from posefilter.errors import UserError, check_seed
from posefilter.filters.modes import APART, Modes, find_pose_modes
from posefilter.geometry.camera import check_camera_matrix
from posefilter.geometry.pose import is_rigid, make_pose, origin_of
from posefilter.geometry.pose_density import (
    PoseDensity,
    draw_poses,
    fit_density,
    log_density,
    log_density_held_out,
)
from posefilter.geometry.pose_statistics import covariance_about, twist_between
from posefilter.geometry.spaces import PoseSpace
from posefilter.geometry.symmetries import densify, gather_copies
from posefilter.types import ObjectModel

_MOST_SYMMETRIES = 10_000  # as many as an object may have (meshes/symmetries.py)
_ROUNDING = 1e-9  # of weights' sum, which float64 keeps
_SAME_OBJECT = 1e-5  # [m] by which single precision may change an object's sizes


@dataclass(frozen=True, eq=False, repr=False)
class Belief:
    """Weighted poses of one object in one image.

    The batch of tensors that a filter itself returns is `posefilter.types.BeliefBatch`.

    Attributes:
        samples: Poses (N, 4, 4) camera_from_object, float64 [m].
        weights: Their weights (N,), float64; they sum to 1.
        center: The object's center (3,) in its own frame [m], about which poses turn.
        radius: Half the diagonal of the object's bounding box [m]; a turn counts as the shift that
            it gives at this distance.
        diameter: The largest distance between two points of the object [m].
        object: The object's name.
        symmetries: Its symmetries (S, 4, 4) object_from_object, a group, the identity first. Poses
            that they make of one another are equivalent, and share the density equally.
        draws: So many of the first samples are draws about the estimate, which are one mode however
            far apart: a calibrated belief's.
    """

    samples: np.ndarray
    weights: np.ndarray
    center: np.ndarray
    radius: float
    diameter: float
    object: str = ""
    symmetries: np.ndarray = field(default_factory=lambda: np.eye(4)[None])
    draws: int = 0

    def __post_init__(self) -> None:
        """Bring arrays to float64 and weights to a sum of 1, and check all.

        Raises:
            UserError: The arrays do not fit each other, or hold no poses and weights; or the center
                or a size is none.
        """
        for name in ("samples", "weights", "center", "symmetries"):
            object.__setattr__(self, name, _as_numbers(name, getattr(self, name)))
        count = self.weights.size
        if self.samples.shape != (count, 4, 4) or self.weights.shape != (count,) or not count:
            raise UserError(
                f"belief: samples {self.samples.shape} and weights {self.weights.shape} should be "
                f"(N, 4, 4) and (N,)"
            )
        total = float(self.weights.sum())
        if not (np.isfinite(total) and abs(total - 1) < 1e-3 and (self.weights >= 0).all()):
            raise UserError(f"belief: the weights should be positive and sum to 1, not {total:.6g}")
        if abs(total - 1) > _ROUNDING:  # as of single precision
            object.__setattr__(self, "weights", self.weights / total)
        group = self.symmetries
        if group.shape[1:] != (4, 4) or not 1 <= len(group) <= _MOST_SYMMETRIES:
            raise UserError(
                f"belief: symmetries {group.shape} should be (S, 4, 4), {_MOST_SYMMETRIES} at most"
            )
        for name, poses in (("samples", self.samples), ("symmetries", group)):
            if not np.isfinite(poses).all() or not is_rigid(torch.from_numpy(poses)):
                raise UserError(f"belief: the {name} should be rigid transforms")
        if not np.allclose(group[0], np.eye(4), atol=_ROUNDING):
            raise UserError(
                "belief: the first of the symmetries should be the identity, which BOP's lists omit"
            )
        if self.center.shape != (3,) or not np.isfinite(self.center).all():
            raise UserError(f"belief: the center should be three numbers, not {self.center}")
        if not isinstance(self.draws, Integral) or not 0 <= self.draws <= count:
            raise UserError(f"belief: {self.draws} of its {count} samples cannot be draws")
        if self.draws and not self.weights[: self.draws].any():
            raise UserError(f"belief: its first {self.draws} samples are draws, and have no weight")
        for name in ("radius", "diameter"):
            size = _as_numbers(f"the {name}", getattr(self, name))
            if size.ndim or not 0 < size < np.inf:
                raise UserError(f"belief: the {name} should be above 0, and is {size}")
            object.__setattr__(self, name, float(size))

    def __repr__(self) -> str:
        about = f"{len(self.weights)} particles {self.uncertainty().describe()}"
        return f"{type(self).__name__}({self.object}: {about})"

    @cached_property
    def mean(self) -> np.ndarray:
        """The mean pose (4, 4): the mean of the centers, and the chordal mean of the rotations.

        Between two modes it is a pose that no particle holds; see `modes`.
        """
        return self._space.mean(*self._tensors).numpy()

    @cached_property
    def covariance(self) -> np.ndarray:
        """The covariance (6, 6) of the particles' twists about the mean pose.

        Rows and columns are [x, y, z, rx, ry, rz]: the translation of the object's center in the
        camera's axes [m], then the rotation vector about that center in the object's own axes
        [rad].  Square roots of the diagonal are standard deviations.  An estimate is not the mean:
        for its error see `error_covariance`.
        """
        samples, weights = self._tensors
        mean = torch.from_numpy(self.mean)
        return covariance_about(mean, samples, weights, torch.from_numpy(self.center)).numpy()

    def covariance_about(self, pose: np.ndarray) -> np.ndarray:
        """Return the covariance (6, 6) of a pose's error, if the belief is right, other modes
        included: the second moment of the twists from this pose to the particles.

        Unlike `covariance` it holds how far the pose is from the mean, and of each particle it
        takes the equivalent pose that is nearest.  Order, axes and units are those of `covariance`.

        Args:
            pose: (4, 4) camera_from_object [m], such as `Result.pose`; or (3, 4).

        Raises:
            UserError: It is no rigid transform.
        """
        return self._covariance_about(pose, len(self.weights))

    def error_covariance(self, pose: np.ndarray) -> np.ndarray:
        """Return the covariance (6, 6) of an estimate's error if the estimate is right.

        Of a calibrated belief it is that of the draws about the estimate: its other modes are what
        is true if the estimate is wrong.  Otherwise it is `covariance_about`.  Order, axes and
        units are those of `covariance`.

        Args:
            pose: The estimate, (4, 4) camera_from_object [m], `Result.pose`; or (3, 4).

        Raises:
            UserError: It is no rigid transform.
        """
        return self._covariance_about(pose, self.draws or len(self.weights))

    def _covariance_about(self, pose: np.ndarray, count: int) -> np.ndarray:
        """Return the covariance (6, 6) about a pose of the first so many samples."""
        samples, weights = (part[:count] for part in self.canonicalize(pose)._tensors)
        about, center = torch.from_numpy(_as_pose(pose)), torch.from_numpy(self.center)
        return covariance_about(about, samples, weights / weights.sum(), center).numpy()

    def canonicalize(self, pose: np.ndarray) -> "Belief":
        """Return the same belief by other samples: of each particle the equivalent pose that is
        nearest to a pose, a turn counting as the shift at the radius.

        Of a symmetric object, particles at equivalent poses are then together, so that mean,
        covariance and marginals say what they say of other objects.  A continuous symmetry has no
        gaps between its turns.

        Args:
            pose: (4, 4) camera_from_object [m], or (3, 4).

        Raises:
            UserError: It is no rigid transform.
        """
        about = torch.from_numpy(_as_pose(pose))
        group = densify(torch.from_numpy(self.symmetries))
        samples, center = self._tensors[0], torch.from_numpy(self.center)
        near = gather_copies(samples, about, center, self.radius, group)
        return replace(self, samples=near.numpy())

    @cached_property
    def modes(self) -> tuple[Mode, ...]:
        """The poses round which the weight gathers, the heaviest first; their masses sum to 1.

        Found by quick shift (Vedaldi & Soatto 2008): two particles belong to one mode where a chain
        of ever denser neighbors, each within a tenth of the diameter, leads from one to the other.
        The draws of a calibrated belief are one mode, with their mean as its pose.
        """
        samples, weights = self._tensors
        center, found = torch.from_numpy(self.center), self._found
        modes: list[Mode] = []
        for number, (pose, mass) in enumerate(zip(found.states, found.weights, strict=True)):
            if mass == 0:  # particles without weight; so are all that follow
                break
            own = found.member == number
            poses, share = samples[own], weights[own] / weights[own].sum()
            spread = covariance_about(self._space.mean(poses, share), poses, share, center)
            same = next((i for i in range(number) if self._is_equivalent(found, i, pose)), None)
            modes.append(Mode(pose.numpy(), float(mass), spread.numpy(), same))
        return tuple(modes)

    @property
    def weight_entropy(self) -> float:
        """The entropy of the weights [nat]: 0 where one particle has them all, log N where all are
        alike, as after resampling.  It is no uncertainty of the pose, since it does not depend on
        where the particles are: see `differential_entropy`.
        """
        weights = self._tensors[1]
        return -float(torch.special.xlogy(weights, weights).sum())

    @property
    def entropy(self) -> float:
        """The earlier name of `weight_entropy`."""
        return self.weight_entropy

    @property
    def effective_samples(self) -> float:
        """The effective sample size (Kong 1992): 1 where one particle has all the weight, N where
        all are alike.
        """
        return float(1 / np.square(self.weights).sum())

    def log_density(self, poses: np.ndarray) -> np.ndarray:
        """Return the log of the belief's density at poses.

        Per cubic meter of position, and per unit of rotation where SO(3) has the volume pi^2, as in
        Implicit-PDF (Murphy et al. 2021).  A kernel density estimate whose kernels follow the
        particles and know the symmetries: see `posefilter.geometry.pose_density`.  It integrates to
        1 and is never 0.

        Args:
            poses: (*, 4, 4) camera_from_object [m], or (*, 3, 4).

        Returns:
            (*) float64 [nat].

        Raises:
            UserError: They are no rigid transforms.
        """
        given = torch.from_numpy(_as_poses(poses))
        found = log_density(self._density, given.reshape(-1, 4, 4))
        return found.reshape(given.shape[:-2]).numpy()

    @cached_property
    def differential_entropy(self) -> float:
        """The entropy of what the particles are drawn from [nat], in the measure of `log_density`:
        minus the mean log density of the particles, each without its own kernel.  The kernel
        density itself is wider.
        """
        return -float(self._density.log_weights.exp() @ torch.from_numpy(self._held_out))

    def credible_set(self, level: float = 0.9) -> PoseSet:
        """Return the smallest set of poses that has this share of the belief.

        It holds every pose whose density is at least that of `level` of the particles: the highest
        density region (Hyndman 1996).  If the belief is right, it holds the truth so often.

        Raises:
            UserError: The level is not in [0, 1].
        """
        check_probability("level", level)
        weights = self._density.log_weights.exp().numpy()
        threshold = -find_quantile(-self._held_out, weights, level)
        return self.highest_density_region(level, threshold)

    def highest_density_region(self, coverage: float, min_log_density: float) -> PoseSet:
        """Return the set of the poses whose log density is at least a threshold.

        Args:
            coverage: What the set is made for, which it states and does not compute.
            min_log_density: The threshold [nat]; minus infinity gives the set of all poses.

        Raises:
            UserError: The coverage is not between 0 and 1, or the threshold no number.
        """
        check_probability("coverage", coverage)
        if not isinstance(min_log_density, Real | np.generic) or np.isnan(min_log_density):
            raise UserError(f"belief: the threshold {min_log_density!r} is no number")
        inside = self._held_out >= min_log_density
        samples = self.samples[self._density.chosen.numpy()[inside]]
        weights = self._density.log_weights.exp().numpy()[inside]
        return PoseSet(coverage, min_log_density, samples, weights, self.log_density)

    def contains(self, poses: np.ndarray, level: float = 0.9) -> np.ndarray:
        """Tell which poses are in the credible set of a level.  (*, 4, 4) -> (*) bool."""
        return self.credible_set(level).contains(poses)

    def marginal(self, axis: str) -> Marginal:
        """Return the distribution of one axis, with its quantiles.

        Args:
            axis: `x`, `y`, `z`: the object's center in the camera's axes [m]; `rx`, `ry`, `rz`: the
                rotation vector from the mean pose, in the object's own axes [rad].

        Raises:
            UserError: There is no such axis.
        """
        if axis not in AXES:
            raise UserError(f"belief: has no axis {axis}; there are {', '.join(AXES)}")
        samples, center = self._tensors[0], torch.from_numpy(self.center)
        place = origin_of(samples, center)
        turn = twist_between(torch.from_numpy(self.mean), samples, center)[:, 3:]
        column = torch.cat([place, turn], dim=1)[:, AXES.index(axis)]
        return Marginal(axis, column.numpy(), self.weights)

    def uncertainty(self, level: float = 0.95) -> Uncertainty:
        """Return how far particles are from the mean of the heaviest mode, those of its own and of
        equivalent modes; `describe()` of it says so in words.  Of a calibrated belief it is the
        estimate's mode, also where it is not the heaviest.

        Equivalent poses are one: of each particle the nearest to that mean counts, and a continuous
        symmetry has no gaps between its turns (a ball's are some 16 degrees wide).

        Raises:
            UserError: The level is not in [0, 1].
        """
        samples, weights = self._tensors
        center = torch.from_numpy(self.center)
        own = heaviest = torch.arange(len(weights)) < self.draws
        if not self.draws:
            heaviest = self._found.member == 0
            own = torch.isin(self._found.member, torch.tensor(self._list_alike()))
        pose = self._space.mean(samples[heaviest], weights[heaviest] / weights[heaviest].sum())
        poses, share = samples[own], weights[own] / weights[own].sum()
        mass, group = float(weights[own].sum()), densify(torch.from_numpy(self.symmetries))
        return measure_uncertainty(poses, share, pose, mass, center, group, level)

    def project(
        self, intrinsics: np.ndarray, points: np.ndarray | None = None, level: float = 0.95
    ) -> Projection:
        """Return where the belief puts points of the object in an image, and how surely.

        Points behind the camera, which no image shows, have places that mean nothing.

        Args:
            intrinsics: Camera matrix (3, 3) [px].
            points: (P, 3), or one (3,), in the object's frame [m]; None: its center.
            level: Share of the weight within the radius.

        Raises:
            UserError: The intrinsics are no camera matrix, the points have another shape or are not
                finite, or the level is not in [0, 1].
        """
        at = self.center if points is None else _as_numbers("points", points)
        if at.ndim not in (1, 2) or at.shape[-1] != 3:
            raise UserError(f"points: have shape {at.shape}; expected (P, 3)")
        if not np.isfinite(at).all():
            raise UserError("points: hold NaN or infinity")
        at = np.atleast_2d(at)
        K = torch.from_numpy(check_camera_matrix(intrinsics))
        return project_belief(*self._tensors, torch.from_numpy(at), K, level)

    def transform(self, frame_from_camera: np.ndarray) -> "Belief":
        """Return the belief in another frame, such as the world's or a robot's: its samples are
        then frame_from_object.

        Densities and turns stay what they are, since the measure does, and turns are about the
        object's own axes; shifts are along the axes of the frame.  A set's threshold is the same
        there, see `highest_density_region`.  Camera_from_frame brings it back to `project` it.

        Args:
            frame_from_camera: (4, 4) [m], or (3, 4).

        Raises:
            UserError: It is no rigid transform.
        """
        return replace(self, samples=_as_pose(frame_from_camera) @ self.samples)

    def draw(self, count: int, seed: int = 0) -> np.ndarray:
        """Draw poses from the density of `log_density`, none from its background of a hundredth.

        They are apart where samples are copies of one another, as after resampling, and wider than
        the samples by the width of the kernels.  Of a symmetric object, those near to the heaviest
        sample stand for the equivalent ones.

        Args:
            count: Number of poses; each sample has its share of them but for one.
            seed: The same seed gives the same poses.

        Returns:
            (count, 4, 4) camera_from_object [m], float64.

        Raises:
            UserError: The count is no whole number, 1 or more, or the seed none, 0 or more.
        """
        if not isinstance(count, int | np.integer) or isinstance(count, bool) or count < 1:
            raise UserError(f"belief: draws {count!r} poses; expected a whole number, 1 or more")
        generator = torch.Generator().manual_seed(check_seed(seed) % (1 << 63))
        return draw_poses(self._density, int(count), generator).numpy()

    def fuse(self, other: "Belief", count: int = 500, seed: int = 0) -> "Belief":
        """Return the belief after two views of one object that rests: the product of both.

        By Bayes' rule with a flat prior, if the views err independently.  Views of one filter from
        like directions do not: the result is surer than it should be.
        Of views that contradict each other both are kept, as modes.  The densities' kernels make
        standard deviations of Gaussians a tenth to a half too large.

        By importance sampling: poses x are drawn from both densities, and have the weights
        p(x) q(x) / (p(x) + q(x)).

        Args:
            other: Of the same object in the same frame; see `transform`.
            count: Number of poses drawn from each.
            seed: Of the draws.

        Returns:
            A belief with twice as many samples, of uneven weights; equivalent poses of a symmetric
            object are in one place.

        Raises:
            UserError: It is no belief, or another object's; or as of `draw`.
        """
        if not isinstance(other, Belief):
            raise UserError(f"belief: is fused with another Belief, not with {other!r:.50}")
        seed = check_seed(seed)
        own, theirs = (
            np.concatenate([one.center, [one.radius, one.diameter], one.symmetries.ravel()])
            for one in (self, other)
        )
        if len(own) != len(theirs) or not np.allclose(own, theirs, atol=_SAME_OBJECT):
            raise UserError(f"belief: {other.object} is another object than {self.object}")
        drawn = [self.draw(count, seed), other.draw(count, seed + 1)]
        samples = np.concatenate(drawn)
        p, q = self.log_density(samples), other.log_density(samples)
        log_weights = torch.from_numpy(p + q - np.logaddexp(p, q))
        weights = log_weights.softmax(0).numpy()
        fused = replace(self, samples=samples, weights=weights, draws=0)
        return fused.canonicalize(samples[weights.argmax()])

    def save(self, path: str | Path) -> None:
        """Write the belief as an .npz file; `Belief.load` reads it. The ending is added if missing.

        Its arrays are `poses` (N, 4, 4) and `weights` (N,) in float32, and `center`, `radius`,
        `diameter`, `object`, `symmetries` and `draws`.

        Raises:
            UserError: It cannot be written.
        """
        named = {one.name: getattr(self, one.name) for one in fields(self)}
        write_arrays(path, named.pop("samples"), named.pop("weights"), **named)

    @classmethod
    def load(cls, path: str | Path) -> "Belief":
        """Read what `save` wrote.

        Raises:
            UserError: The file is missing, or holds no belief.
        """
        try:
            return cls(**read_arrays(path))
        except UserError as error:
            said = str(error)
            raise UserError(said if said.startswith(f"{path}:") else f"{path}: {said}") from error

    @property
    def _tensors(self) -> tuple[Tensor, Tensor]:
        return torch.from_numpy(self.samples), torch.from_numpy(self.weights)

    @cached_property
    def _density(self) -> PoseDensity:
        samples, weights = self._tensors
        own, group = torch.from_numpy(self.center), torch.from_numpy(self.symmetries)
        return fit_density(samples, weights.log(), own, self.radius, self.diameter, group)

    @cached_property
    def _held_out(self) -> np.ndarray:
        return log_density_held_out(self._density).numpy()

    @cached_property
    def _found(self) -> Modes:
        samples, weights = self._tensors
        draws, others = self.draws, weights[self.draws :]
        if not draws:
            return find_pose_modes(samples, weights.log(), self._space, self.diameter)
        mass = weights[:draws].sum()
        states = self._space.mean(samples[:draws], weights[:draws] / mass)[None]
        masses, member = mass[None], torch.zeros(len(weights), dtype=torch.int64)
        if float(others.sum()) > 0:
            share = (others / others.sum()).log()
            found = find_pose_modes(samples[draws:], share, self._space, self.diameter)
            states = torch.cat([states, found.states])
            masses = torch.cat([masses, found.weights * others.sum()])
            member[draws:] = 1 + found.member
        order = masses.argsort(descending=True, stable=True)
        return Modes(states[order], masses[order], order.argsort()[member])

    def _is_equivalent(self, found: Modes, heavier: int, pose: Tensor) -> bool:
        center, group = torch.from_numpy(self.center), densify(torch.from_numpy(self.symmetries))
        copy = gather_copies(found.states[heavier][None], pose, center, self.radius, group)
        return bool(self._space.distance(copy, pose)[0] < APART * self.diameter)

    def _list_alike(self) -> list[int]:
        """Return the numbers of the heaviest mode and of those that symmetries make of it."""
        alike = [0]
        for number, mode in enumerate(self.modes):
            if mode.equivalent in alike:
                alike.append(number)
        return alike

    @property
    def _space(self) -> PoseSpace:
        return PoseSpace(tuple(self.center.tolist()), self.radius)


def belief_over(
    object_model: ObjectModel, samples: np.ndarray, weights: np.ndarray, draws: int = 0
) -> Belief:
    """Return the belief over an object's pose that samples (N, 4, 4) [m] with weights (N,) are."""
    parts = (object_model.center, object_model.symmetries)
    center, symmetries = (part.detach().cpu().double().numpy() for part in parts)
    sizes = float(object_model.radius), float(object_model.diameter)
    return Belief(samples, weights, center, *sizes, object_model.name, symmetries, draws)


def _as_numbers(name: str, value: Any) -> np.ndarray:
    """Return numbers as a float64 array of its own, which stays what it is if theirs changes."""
    try:
        return np.array(value, dtype=np.float64, order="C")
    except (TypeError, ValueError, RuntimeError) as error:  # torch's, of a tensor with a gradient
        raise UserError(f"belief: {name} should be numbers in an array ({error})") from error


def _as_pose(pose: np.ndarray) -> np.ndarray:
    """Return a pose (4, 4) or (3, 4) as float64 (4, 4)."""
    one = _as_poses(pose)
    if one.shape != (4, 4):
        raise UserError(f"pose: has shape {one.shape}; expected (4, 4) or (3, 4)")
    return one


def _as_poses(poses: np.ndarray) -> np.ndarray:
    """Return poses (*, 4, 4) or (*, 3, 4) as float64 (*, 4, 4)."""
    given = _as_numbers("poses", poses)
    if given.shape[-2:] == (3, 4):
        top = torch.from_numpy(given)
        given = make_pose(top[..., :3], top[..., 3]).numpy()
    if given.shape[-2:] != (4, 4):
        raise UserError(f"poses: have shape {given.shape}; expected (*, 4, 4) or (*, 3, 4)")
    if not np.isfinite(given).all() or not is_rigid(torch.from_numpy(given)):
        raise UserError("poses: should be rigid transforms")
    return given
