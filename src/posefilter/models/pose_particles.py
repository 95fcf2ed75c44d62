"""What methods share whose particles are poses, and those of them that are no filter."""

from abc import abstractmethod
from typing import Any, ClassVar

from torch import Generator, Tensor

from posefilter.capabilities import Capabilities, read_declared
from posefilter.confidence.features import measure_coordinates
from posefilter.confidence.scale_ratio import ScaleRatio, measure_scale_ratio
from posefilter.errors import UserError
from posefilter.geometry.spaces import PoseSpace
from posefilter.models.base import PoseEstimator
from posefilter.nets.coordinates import Cells, Coordinates, HasCoordinates, gather_pixels
from posefilter.nets.proposals import ObjectCoordinateNet
from posefilter.types import Batch, BeliefBatch, ObjectModel, ParticleOutput, Particles, Step, Trace

_LEAST = 1e-6  # score whose logarithm is finite


class PoseParticles(PoseEstimator):
    """A method whose particles are poses.

    Args:
        **base: Arguments of `PoseEstimator`.
    """

    provides: ClassVar[Capabilities] = ("pose", "pose_space")

    def __init__(self, **base: Any) -> None:
        super().__init__(**base)
        self._space: PoseSpace | None = None

    @property
    def space(self) -> PoseSpace:
        """SE(3) about the object's center."""
        if self._space is None:
            model = self.object_model
            self._space = PoseSpace(tuple(model.center.tolist()), model.radius, points=model.points)
        return self._space

    def set_object(self, object_model: ObjectModel) -> None:
        """Set the object, also that of the proposal network, and forget the space about another's
        center.
        """
        super().set_object(object_model)
        self._space = None
        network = self._coordinate_net
        if network is not None:
            network.set_object(object_model.points, object_model.center, object_model.radius)

    @property
    def _coordinate_net(self) -> ObjectCoordinateNet | None:
        """The network of dense object coordinates, of those methods that have one."""
        network = getattr(self, "proposals", None)
        return network if "object_coordinates" in read_declared(type(network)).provides else None

    def collect_features(
        self, trace: Trace, batch: Batch, margin: Tensor | None = None
    ) -> dict[str, Tensor]:
        """Return what speaks for each estimate, with what such a network sees of it."""
        features = super().collect_features(trace, batch, margin)
        if self._coordinate_net is None:
            return features
        return features | measure_coordinates(*self._see_estimate(trace, batch))

    def measure_scale_ratio(
        self, trace: Trace, batch: Batch, visible: Tensor | None = None
    ) -> ScaleRatio | None:
        """Return how large the object appears by such a network; None without one."""
        if self._coordinate_net is None:
            return None
        best, coordinates, cells, object_model = self._see_estimate(trace, batch)
        if visible is not None:
            cells = cells._replace(valid=cells.valid & gather_pixels(visible, cells))
        return measure_scale_ratio(best, coordinates, cells, object_model)

    def _see_estimate(
        self, trace: Trace, batch: Batch
    ) -> tuple[Tensor, Coordinates, Cells, ObjectModel]:
        """Return the estimates of a finished run, and what the network sees of their images."""
        encoding: HasCoordinates = self.encode(batch) if trace.encoding is None else trace.encoding
        return trace.belief.best, encoding.coordinates, encoding.cells, self.object_model

    def measure_encoding_loss(self, encoding: Any, batch: Batch) -> Tensor:
        """Return the loss of what a network puts out, (B,), for methods whose training runs no
        filter.
        """
        none = BeliefBatch(*(batch.depth.new_zeros(0) for _ in BeliefBatch._fields))
        return self.loss(Trace((), (), (), none, encoding=encoding), batch, self.object_model)


class Hypotheses(PoseParticles):
    """A method that is no filter: a network, pose hypotheses from its output, and the best of them.

    The filter's loop is run for one step: it draws the hypotheses (`propose_poses`), scores each
    once, and takes the one of highest score. Nothing is resampled or moved. So the belief is the
    hypotheses, each weighted by its score.
    """

    provides: ClassVar[Capabilities] = ("pose", "pose_space", "propose_poses")
    # training rolls out no filter
    test_only_settings: ClassVar[tuple[str, ...]] = ("filter", "train_rollout")

    @abstractmethod
    def propose_poses(self, encoding: Any, particles: int, generator: Generator) -> Tensor:
        """Return hypotheses (B, particles, 4, 4), camera_from_object [m]."""

    @abstractmethod
    def score(self, encoding: Any, poses: Tensor) -> Tensor:
        """Return how well the network's output agrees with poses, (B, N, 4, 4) -> (B, N) in [0,
        1].
        """

    def measure(
        self, encoding: Any, particles: Particles, step: Step, generator: Generator
    ) -> ParticleOutput:
        """Return the logarithms of the scores."""
        score = self.score(encoding, particles.state).clamp_min(_LEAST).log()
        no_move = particles.state.new_zeros(*particles.state.shape[:2], self.space.dimensions)
        return ParticleOutput(score, no_move, particles.state, particles.latent)

    def training_losses(self, batch: Batch, generator: Generator) -> dict[str, Tensor]:
        """Return the loss of the network's output, one value for each image."""
        return {"loss": self.measure_encoding_loss(self.encode(batch), batch)}


def require_depth(valid: Tensor) -> None:
    """Raise UserError where an image has no known depth.  (B, ...) bool."""
    without = (~valid.flatten(1).any(1)).nonzero().flatten().tolist()
    if without:
        which = f" (image {without[0]} of {len(valid)}, from 0)" if len(valid) > 1 else ""
        raise UserError(
            f"depth: so few pixels of an image have depth that no pose can be proposed{which}"
        )
