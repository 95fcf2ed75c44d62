"""What is exported: two networks of a method, for one image, without randomness of their own.

`encode` turns a camera's image into what the filter reads, once an image. `measure` scores
particles, once a step. What is between them is a hundred lines of linear algebra: see
examples/onnx.
"""

import torch
from torch import Tensor, nn

from posefilter.deploy.resizing import Resize
from posefilter.filters.agreement import Agreement
from posefilter.images import make_unlabeled
from posefilter.models.image_space import ImageEncoding, ImageSpace
from posefilter.models.pose_pf import PosePF
from posefilter.nets.coordinates import Context, Coordinates
from posefilter.nets.encoders import ContextMap
from posefilter.nets.likelihood import Pixels, PoseLikelihood, flatten_images, sample_points
from posefilter.nets.pose_votes import measure_cells
from posefilter.nets.proposals import ObjectCoordinateNet
from posefilter.types import Particles, Step

ENCODING = ("values", "smooth", "share", "position", "network_intrinsics")


class EncodeForPoses(nn.Module):
    """A camera's image -> what a filter over poses reads.

    Args:
        method: The trained method, with a proposal network and a likelihood with context.
        resize: From the camera's size to the network's.
    """

    inputs = ("rgb", "depth", "intrinsics")
    outputs = (*ENCODING, "point", "weight")

    def __init__(self, method: PosePF, resize: Resize) -> None:
        super().__init__()
        self.proposals, self.resize = method.proposals, resize

    def forward(self, rgb: Tensor, depth: Tensor, intrinsics: Tensor) -> tuple[Tensor, ...]:
        """Encode.

        Args:
            rgb: (H, W, 3) uint8, RGB.
            depth: (H, W) [m], 0 where unknown.
            intrinsics: (3, 3) [px].

        Returns:
            For `ScorePoses`: `values` (h w, 4) and `smooth` (h w / 4, 1 + C), pixels of the
            network's image and features of four each; `share` (n, K) and `position` (n, K, 3), the
            probability of each of K surface fragments at each of n cells and the object point
            there, from the center, in radii; `network_intrinsics` (3, 3) [px].  For proposals: each
            cell's measured `point` (n, 3) [m], and its `weight` (n,), the probability that it shows
            the object, 0 where nothing was measured.
        """
        color, z, K = self.resize(rgb, depth, intrinsics)
        assert isinstance(self.proposals, ObjectCoordinateNet)
        # the exporter takes other strides than torch does, and would fail to flatten these
        coordinates = Coordinates(
            *(x.clone(memory_format=torch.contiguous_format) for x in self.proposals(color, z, K))
        )
        cells = measure_cells(z, K)
        image = flatten_images(color, z, K, coordinates)
        context = image.context
        assert context is not None
        weight = (torch.sigmoid(coordinates.logit) + 1e-4) * cells.valid
        fragments = self.proposals.fragments
        return (
            image.values[0],
            context.smooth[0],
            context.share[0].unflatten(0, (-1, fragments)),
            context.position[0].unflatten(0, (-1, fragments)),
            K[0],
            cells.point[0].flatten(0, 1),
            weight[0].flatten(),
        )


class ScorePoses(nn.Module):
    """Poses -> their log-likelihoods in one image.

    Args:
        method: The trained method.
        size: Height and width of the network's image [px].
    """

    inputs = ("poses", "sigma", "noise", *ENCODING)
    outputs = ("log_likelihood",)

    def __init__(self, method: PosePF, size: tuple[int, int]) -> None:
        super().__init__()
        self.likelihood, self.size = method.likelihood, size
        self.radius = float(method.object_model.radius)
        assert method.proposals is not None
        self.register_buffer("center", method.object_model.center.clone(), persistent=False)
        self.register_buffer("fragments", method.proposals.centers.clone(), persistent=False)

    def forward(
        self, poses: Tensor, sigma: Tensor, noise: Tensor,
        values: Tensor, smooth: Tensor, share: Tensor, position: Tensor, network_intrinsics: Tensor,
    ) -> Tensor:  # fmt: skip
        """Score poses.

        Args:
            poses: (N, 4, 4) camera_from_object [m].
            sigma: () noise level [m].
            noise: (P, 2) standard normal: which image points the poses are scored from.
            values: As `EncodeForPoses` returns it, and all that follow.
            smooth: The same.
            share: The same.
            position: The same.
            network_intrinsics: The same.

        Returns:
            Log-likelihoods up to a constant (N,).
        """
        height, width = self.size
        grid = (-(-height // 8), -(-width // 8))
        context = Context(
            smooth[None], share.flatten()[None], position.flatten(0, 1)[None],
            self.get_buffer("fragments")[None], grid, -(-width // 2),
        )  # fmt: skip
        image = Pixels(values[None], self.size, network_intrinsics[None], context)
        center = self.get_buffer("center")
        points = sample_points(image, poses[None], center, self.radius, noise[None, None])
        judge, hypotheses = self.likelihood, poses[None]
        assert isinstance(judge, PoseLikelihood)
        score = judge.score_sampled(points, hypotheses, sigma, center, self.radius)
        return (score + judge.judge_surface(image, hypotheses, sigma, center, self.radius))[0]


class EncodeForPixels(nn.Module):
    """A camera's image -> what a filter over pixels reads.

    Args:
        method: The trained method.
        resize: From the camera's size to the network's.
        levels: Number of its encoder's maps of features.
        objectness: Whether its particles are drawn by the encoder's objectness map.
    """

    inputs = ("rgb", "depth", "intrinsics")

    def __init__(self, method: ImageSpace, resize: Resize, levels: int, objectness: bool) -> None:
        super().__init__()
        self.method, self.resize, self.objectness = method, resize, objectness
        self.outputs = (
            *("image", "surface", "network_intrinsics"),
            *(f"features_{number}" for number in range(levels)),
            *(("objectness",) if objectness else ()),
        )

    def forward(self, rgb: Tensor, depth: Tensor, intrinsics: Tensor) -> tuple[Tensor, ...]:
        """Encode.

        Args:
            rgb: (H, W, 3) uint8, RGB.
            depth: (H, W) [m], 0 where unknown.
            intrinsics: (3, 3) [px].

        Returns:
            For `MeasurePixels`: `image` (4, h, w), `surface` (2, h, w), depth without holes and
            where it was measured; `network_intrinsics` (3, 3) [px]; maps of features.  And
            `objectness` (h', w'), the probability that each cell shows the object, where particles
            are drawn by it.
        """
        encoding = self.method.encode(make_unlabeled(*self.resize(rgb, depth, intrinsics)))
        kept = [encoding.image[0], encoding.depth[0], encoding.intrinsics[0]]
        kept += [level[0] for level in encoding.context.levels]
        if self.objectness:
            assert encoding.objectness is not None
            kept.append(encoding.objectness[0, 0])
        return tuple(kept)


class MeasurePixels(nn.Module):
    """Pixels -> their likelihoods, displacements, poses and next latents.

    Args:
        method: The trained method.
        strides: Pixels of a cell of each map of features.
    """

    def __init__(self, method: ImageSpace, strides: tuple[int, ...]) -> None:
        super().__init__()
        self.method, self.strides = method, strides
        estimate = method.filter.estimate
        self.agreement = estimate if isinstance(estimate, Agreement) else None
        levels = tuple(f"features_{number}" for number in range(len(strides)))
        self.inputs = ("state", "latent", "image", "surface", "network_intrinsics", *levels)
        more = () if self.agreement is None else ("point", "known", "share", "position")
        self.outputs = ("log_likelihood", "displacement", "next_latent", "pose", *more)

    def forward(
        self, state: Tensor, latent: Tensor, image: Tensor, surface: Tensor,
        network_intrinsics: Tensor, levels: tuple[Tensor, ...],
    ) -> tuple[Tensor, ...]:  # fmt: skip
        """Measure.

        Args:
            state: (N, 2) particles [px] of the network's image.
            latent: (N, L) what `next_latent` was for their ancestors; zeros at first.
            image: As `EncodeForPixels` returns it, and all that follow.
            surface: The same.
            network_intrinsics: The same.
            levels: The same.

        Returns:
            `log_likelihood` (N,), `displacement` (N, 2) [px], `next_latent` (N, L) and `pose`
            (N, 4, 4) camera_from_object [m].  For an estimate by agreement also the measured
            `point` (N, 3) [m], whether its depth is `known` (N,), and k object points that it may
            be: probabilities `share` (N, k), `position` (N, k, 3) from the center, in radii.
        """
        context = ContextMap(tuple(level[None] for level in levels), self.strides, None)
        encoding = ImageEncoding(
            image[None], surface[None], network_intrinsics[None], context, None
        )
        weights = state.new_zeros(1, state.shape[0])  # `len` would fix the number
        particles = Particles(state[None], latent[None], weights, weights.long())
        step = Step(0, 1, state.new_zeros(()))
        out = self.method.measure(encoding, particles, step, torch.Generator())
        found = [out.log_likelihood, out.displacement, out.latent, out.pose]
        if self.agreement is not None:
            point, known = self.method.surface_points(encoding, state[None])
            object_model = self.method.object_model
            share, position = self.agreement.list_object_points(
                out, point, object_model.center.to(state), object_model.radius
            )
            found += [point, known.float(), share, position]
        return tuple(one[0] for one in found)
