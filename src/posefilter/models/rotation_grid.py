"""A baseline: Rao-Blackwellized particles, each with a distribution over a grid of rotations.

As PoseRBPF has it (Deng et al. 2019): a particle is where the object's center is. Its crop of the
image becomes a code; the cosine of the angle to the code of a render of the object, in each
rotation of a grid, is that rotation's log likelihood up to a factor. Their sum over the grid weighs
the particle, so that rotations need no particles of their own.

PoseRBPF's codes are of an autoencoder, and each video frame is a step of its filter. Here the
encoder learns the posterior over crops and rotations (losses/grid_posterior.py), and the filter
takes several steps on one image.
"""

import math
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import torch
from torch import Generator, Tensor

from posefilter.capabilities import Capabilities
from posefilter.errors import UserError
from posefilter.filters.initialize import draw_from_depth
from posefilter.geometry.crops import crop_views, look_at
from posefilter.geometry.pose import origin_of, pose_about, rotation_of
from posefilter.geometry.rotation import spread_rotations
from posefilter.models.pose_particles import PoseParticles
from posefilter.nets.crop_encoder import CropEncoder
from posefilter.types import Batch, ParticleOutput, Particles, Step

if TYPE_CHECKING:
    from posefilter.meshes.mesh import Mesh  # prediction has none

_CHUNK = 512  # crops that are encoded at once
_NEIGHBORS = 6  # cells that the score between cells is made of


class CropEncoding(NamedTuple):
    """Images to crop; nothing of them is encoded as a whole."""

    rgb: Tensor  # (B, 3, H, W) in [0, 1]
    depth: Tensor  # (B, 1, H, W) [m]
    intrinsics: Tensor  # (B, 3, 3) [px]


class TrainingEncoding(NamedTuple):
    """Scored pairs of crops and rotations."""

    scores: Tensor  # (B, C, M)
    centers: Tensor  # (B, C, 3) [m]
    rotations: Tensor  # (M, 3, 3)


class RotationGrid(PoseParticles):
    """Particles are translations, with a grid of rotations each.

    A particle's state is a pose, whose rotation nothing reads: the pose that it predicts has one
    drawn from its distribution. So the belief's poses are draws from the joint posterior.

    Args:
        net: Encodes crops and renders.
        cells: Rotations of the grid.
        crop_radius: Radius of the ball about a particle that its crop shows, in radii of the
            object.
        distance: Of the renders, in radii of the object.
        crops: Crops of an image in training, a third of them about the object.
        train_cells: Rotations that a batch is scored against in training.
        near_cells: Of these, the ones nearest to the truth of each image.
        **base: Arguments of `PoseEstimator`.
    """

    provides: ClassVar[Capabilities] = (
        "common_points",  # a crop is seen whole
        "grid_scores",
        "pose",
        "pose_space",
        "score_poses",
    )
    test_only_settings = ("filter", "train_rollout")  # training rolls out no filter
    codes: Tensor
    grid: Tensor

    def __init__(
        self,
        net: CropEncoder,
        cells: int = 4000,
        crop_radius: float = 1.0,
        distance: float = 7.0,
        crops: int = 24,
        train_cells: int = 128,
        near_cells: int = 6,
        **base: Any,
    ) -> None:
        super().__init__(**base)
        if cells < max(near_cells, _NEIGHBORS):
            raise UserError(
                f"model.cells={cells}: fewer than model.near_cells={near_cells}, or than the "
                f"{_NEIGHBORS} that a score between cells is made of"
            )
        self.net = net
        self.crop_radius, self.distance = crop_radius, distance
        self.crops, self.train_cells, self.near_cells = crops, train_cells, near_cells
        self.views: Tensor | None = None  # (cells, 5, side, side) float16; only training has them
        self.register_buffer("codes", torch.zeros(cells, net.width))
        self.register_buffer("grid", spread_rotations(cells), persistent=False)

    # -- the codebook -----------------------------------------------------------------------------

    def on_fit_start(self) -> None:
        """Render the object of the data module.

        Raises:
            UserError: The data are none of this project's, and have no mesh.
        """
        meshes = getattr(self.trainer.datamodule, "meshes", None)  # type: ignore[attr-defined]
        if meshes is None:
            raise UserError(
                "model=rotation_grid learns from renders of the object's mesh: train it with a "
                "PoseDataModule as `datamodule`, or call render() first"
            )
        self.render(meshes.load(self.object_model.name))

    def render(self, mesh: "Mesh") -> None:
        """Render the object in each rotation of the grid."""
        from posefilter.rendering.views import render_views  # Embree: prediction renders nothing

        radius, center = self.object_model.radius, self.object_model.center
        reach, distance = self.crop_radius * radius, self.distance * radius
        self.views = render_views(mesh, self.grid, center, reach, distance, self.net.side)

    def train(self, mode: bool = True) -> "RotationGrid":
        """Switch between training and evaluation, for which the renders are encoded anew."""
        super().train(mode)
        if not mode and self.views is not None:
            self.encode_views()
        return self

    @torch.no_grad()
    def encode_views(self) -> None:
        """Encode the renders by the network as it is."""
        assert self.views is not None
        codes = [self.net(part.to(self.codes)) for part in self.views.split(_CHUNK)]
        self.codes.copy_(torch.cat(codes))

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Save the codes of the network as it is, not of the last validation."""
        if self.training and self.views is not None:
            self.eval()
            checkpoint["state_dict"]["codes"] = self.codes.clone()
            self.train()
        super().on_save_checkpoint(checkpoint)

    # -- the filter -------------------------------------------------------------------------------

    def encode(self, batch: Batch) -> CropEncoding:
        """Return the images."""
        return CropEncoding(batch.rgb, batch.depth, batch.intrinsics)

    def encode_crops(self, encoding: CropEncoding, centers: Tensor) -> Tensor:
        """Return the codes of the crops about points.  (B, N, 3) [m] -> (B, N, width)."""
        codes = [
            self.net(self.crop(encoding, part).flatten(0, 1)).unflatten(0, part.shape[:2])
            for part in centers.split(max(1, _CHUNK // len(centers)), dim=1)
        ]
        return torch.cat(codes, dim=1)

    def crop(self, encoding: CropEncoding, centers: Tensor) -> Tensor:
        """Return the crops about points.  (B, N, 3) [m] -> (B, N, 5, side, side)."""
        return crop_views(
            *encoding, centers, self.crop_radius * self.object_model.radius, self.net.side
        )

    def measure(
        self, encoding: CropEncoding, particles: Particles, step: Step, generator: Generator
    ) -> ParticleOutput:
        """Score each translation by its mean likelihood over the grid, and draw a rotation."""
        center = self.object_model.center.to(particles.state)
        places = origin_of(particles.state, center)
        scores = self.net.scale * self.encode_crops(encoding, places) @ self.codes.T
        mean = scores.logsumexp(-1)
        share = (scores - mean[..., None]).exp().cumsum(-1)
        chance = torch.rand(*mean.shape, 1, generator=generator, device=mean.device)
        cell = torch.searchsorted(share, chance * share[..., -1:]).clamp_max(len(self.grid) - 1)
        rotation = look_at(places) @ self.grid[cell[..., 0]]
        pose = pose_about(rotation, places, center)
        no_move = mean.new_zeros(*mean.shape, self.space.dimensions)
        return ParticleOutput(mean - math.log(len(self.grid)), no_move, pose, particles.latent)

    def score_poses(
        self, encoding: CropEncoding, poses: Tensor, sigma: float, generator: Generator, pixels: int
    ) -> Tensor:
        """Score any poses, between cells by the mean of the nearest ones.

        Neither `sigma` nor `pixels` matter: there is one noise level, and a crop is seen whole.

        (B, N, 4, 4) camera_from_object [m] -> log-likelihoods (B, N).
        """
        places = origin_of(poses, self.object_model.center.to(poses))
        codes = self.encode_crops(encoding, places)
        rotation = look_at(places).mT @ rotation_of(poses)
        index, share = self.find_cells(rotation)
        near = self.codes[index]  # (B, N, k, width)
        return self.net.scale * ((near @ codes[..., None])[..., 0] * share).sum(-1)

    def find_cells(self, rotation: Tensor, count: int = _NEIGHBORS) -> tuple[Tensor, Tensor]:
        """Return the cells nearest to rotations, and how much each of them counts.

        (*, 3, 3) -> (*, count) int64, and (*, count) of sum 1.
        """
        trace = rotation.flatten(-2) @ self.grid.flatten(1).T
        nearest, index = trace.topk(count, dim=-1)
        # a Gaussian of the angle: 1 - cos(angle) is half its square; a cell's width is about
        # the angle of a ball of its share of SO(3)
        width = (6 * torch.pi / len(self.grid)) ** (1 / 3)
        return index, (nearest / (2 * (0.5 * width) ** 2)).softmax(-1)

    # -- training ---------------------------------------------------------------------------------

    def training_losses(self, batch: Batch, generator: Generator) -> dict[str, Tensor]:
        """Return the loss of crops that are drawn, against rotations that are drawn."""
        if self.views is None:
            raise UserError("model=rotation_grid: call render() with the object's mesh first")
        centers = self.draw_centers(batch, generator)
        cells = self.draw_cells(batch, generator)
        crops = self.crop(self.encode(batch), centers).flatten(0, 1)
        codes = self.net(torch.cat([crops, self.views[cells.cpu()].to(crops)]))
        crop_codes, view_codes = codes.split([len(crops), len(cells)])
        scores = self.net.scale * (crop_codes @ view_codes.T).unflatten(0, centers.shape[:2])
        encoding = TrainingEncoding(scores, centers, self.grid[cells])
        return {"loss": self.measure_encoding_loss(encoding, batch)}

    def draw_centers(self, batch: Batch, generator: Generator) -> Tensor:
        """Return points to crop about, (B, crops, 3) [m]: near the truth, from close to far, and
        where particles start and move to.
        """
        near = self.crops // 3
        truth = origin_of(batch.camera_from_object, self.object_model.center.to(batch.depth))
        count = self.crops - near
        others = draw_from_depth(batch.depth, batch.intrinsics, self.space, count, generator)
        others = origin_of(others, self.object_model.center.to(others))
        centers = torch.cat([truth[:, None].expand(-1, near, 3), others], dim=1)
        noise = torch.randn(centers.shape, generator=generator, device=truth.device)
        spreads = [torch.logspace(-1.5, 0, n, device=truth.device) for n in (near, count)]
        return centers + torch.cat(spreads)[:, None] * self.object_model.radius * noise

    def draw_cells(self, batch: Batch, generator: Generator) -> Tensor:
        """Return cells to score against: those nearest to each truth, and any.  -> (M,) int64."""
        center = origin_of(batch.camera_from_object, self.object_model.center.to(batch.depth))
        rotation = look_at(center).mT @ rotation_of(batch.camera_from_object)
        near = self.find_cells(rotation, self.near_cells)[0].flatten()
        count = max(self.train_cells - len(near), self.train_cells // 4)
        any_cells = torch.randint(len(self.grid), (count,), generator=generator, device=near.device)
        return torch.cat([near, any_cells])
