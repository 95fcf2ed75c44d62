"""An object that is small in the image is searched in a magnified window, and only there."""

from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Generator, Tensor

from posefilter.filters.estimate import Mean
from posefilter.filters.loop import ParticleFilter
from posefilter.filters.propagate import Gaussian
from posefilter.filters.refine import NoRefine
from posefilter.filters.resample import Systematic
from posefilter.filters.reweight import CurrentLikelihood
from posefilter.filters.schedule import Geometric
from posefilter.geometry.camera import back_project, pixel_grid, project
from posefilter.geometry.pose import make_pose
from posefilter.geometry.spaces import PoseSpace
from posefilter.models import zoom
from posefilter.models.zoom import MOST_ZOOM, choose_part, magnify, measure_zoom, search
from posefilter.types import Batch, ObjectModel, ParticleOutput, Particles, Step, Trace

H, W = 48, 64  # [px]
K = torch.tensor([[64.0, 0, 31.5], [0, 64.0, 23.5], [0, 0, 1]])
MODEL = ObjectModel(
    "ball", torch.zeros(1, 3), torch.zeros(3), 0.05, 0.1, torch.eye(4)[None], torch.zeros(1, 3)
)


def draw(*balls: tuple[float, float, float]) -> Batch:
    """Return images of one bright pixel (u, v) each, at a depth z."""
    n = len(balls)
    rgb, depth = torch.zeros(n, 3, H, W), torch.zeros(n, 1, H, W)
    for i, (u, v, z) in enumerate(balls):
        rgb[i, :, int(v), int(u)] = 1.0
        depth[i] = z
    index, eye = torch.zeros(n, dtype=torch.int64), torch.eye(4).repeat(n, 1, 1)
    nan = torch.full((n,), torch.nan)
    return Batch(rgb, depth, depth < 0, K.repeat(n, 1, 1), eye, index, index, nan)


class Seeker:
    """A method that sees where the brightest pixel is, or nothing if its particles begin `apart`.
    It keeps the images that it encoded, and the steps that it measured.
    """

    object_model = MODEL
    space = PoseSpace((0.0, 0.0, 0.0), 0.05)
    latent_width = 0

    def __init__(self, magnified_width: float | None, apart: float = 0.0) -> None:
        self.seen: list[Batch] = []
        self.steps: list[int] = []
        self.apart = apart
        self.filter = ParticleFilter(
            particles=30,
            steps=5,
            initialize=self.initialize,
            schedule=Geometric(0.04, 0.004),
            reweight=CurrentLikelihood(),
            resample=Systematic(),
            propagate=Gaussian(0.5),
            estimate=Mean(),
            refine=NoRefine(),
            initial_particles=60,
            magnified_width=magnified_width,
        )

    def encode(self, batch: Batch) -> Tensor:
        self.seen.append(batch)
        index = batch.rgb.sum(1).flatten(1).argmax(1)
        pixel = torch.stack([index % W, index // W], 1)[:, None].float()
        depth = batch.depth[:, 0].flatten(1).gather(1, index[:, None])
        return back_project(pixel, depth, batch.intrinsics)[:, 0]

    def initialize(
        self, batch: Batch, encoding: Tensor, method: Any, count: int, generator: Generator
    ) -> Tensor:
        noise = torch.randn(len(encoding), count, 3, generator=generator)
        centers = encoding[:, None] + 0.01 * noise
        centers[:, : count // 2, 0] += self.apart
        return make_pose(torch.eye(3).expand(*centers.shape[:2], 3, 3), centers)

    def measure(
        self, encoding: Tensor, particles: Particles, step: Step, generator: Generator
    ) -> ParticleOutput:
        self.steps.append(step.number)
        off = (particles.state[..., :3, 3] - encoding[:, None]).norm(dim=-1)
        zeros = particles.state.new_zeros(*off.shape, 6)
        score = -0.5 * (off / step.sigma) ** 2 * (not self.apart)
        return ParticleOutput(score, zeros, particles.state, particles.latent)


def run(seeker: Seeker, batch: Batch) -> Trace:
    return search(seeker, batch, Generator().manual_seed(3))


def test_a_window_shows_each_ray_as_the_image_does() -> None:
    batch = draw((10, 10, 1.0), (50, 30, 1.0))
    grid = pixel_grid(H, W).reshape(-1, 2)
    ray = back_project(grid, torch.ones(H * W), K).T.reshape(3, H, W)
    batch = batch._replace(rgb=ray.repeat(2, 1, 1, 1), depth=(2 + ray[:1]).repeat(2, 1, 1, 1))
    view = magnify(batch, torch.tensor([[20.0, 20.0], [60.0, 40.0]]), torch.tensor([2.0, 3.0]))
    assert view.rgb.shape == batch.rgb.shape
    inside = (slice(3, -3), slice(3, -3))  # at the edges there is nothing to interpolate with
    for i in range(2):
        seen = back_project(grid, torch.ones(H * W), view.intrinsics[i]).T.reshape(3, H, W)
        assert torch.allclose(view.rgb[i][:, *inside], seen[:, *inside], atol=1e-5)
        assert torch.allclose(view.depth[i, 0][inside], 2 + seen[0][inside], atol=1e-5)
    # the second is at the image's corner, and does not leave it
    corner = project(torch.tensor([[W - 0.5 - 31.5, H - 0.5 - 23.5, 64.0]]), view.intrinsics[1])
    assert torch.allclose(corner, torch.tensor([[W - 0.5, H - 0.5]]), atol=1e-3)


def test_a_window_as_large_as_the_image_is_the_image() -> None:
    batch = draw((10, 10, 1.0))
    same = magnify(batch, torch.tensor([[5.0, 9]]), torch.ones(1))
    for before, after in zip(batch, same, strict=True):
        assert torch.equal(before.nan_to_num(), after.nan_to_num())


def test_where_no_object_is_small_the_trace_is_the_filters() -> None:
    batch = draw((20, 20, 0.3), (40, 30, 0.25))  # 21 and 26 px
    plain, seeker = Seeker(None), Seeker(0.3)
    one, other = run(plain, batch), run(seeker, batch)
    assert torch.equal(one.belief.poses, other.belief.poses)
    assert len(one.particles) == len(other.particles) == 5
    assert len(seeker.seen) == 1  # and the image is encoded once
    assert seeker.steps == [0, 1, 2, 3, 4]


def test_a_small_object_is_searched_in_a_window_where_it_is_as_large_as_asked_for() -> None:
    seeker = Seeker(0.3)
    batch = draw((20, 20, 0.5))  # 13 px of 64
    trace = run(seeker, batch)
    view = seeker.seen[-1]
    diameter = view.intrinsics[0, 0, 0] * MODEL.diameter / 0.5
    assert diameter / W == pytest.approx(0.3, abs=0.03)  # whole pixels
    truth = back_project(torch.tensor([[20.0, 20]]), torch.tensor([0.5]), K)[0]
    assert torch.allclose(trace.belief.best[0, :3, 3], truth, atol=4e-3)
    assert seeker.steps == [0, 1, 2, 0, 1, 2, 3, 4]
    assert torch.equal(trace.encoding, Seeker(None).encode(batch))  # of the whole image


def test_images_of_a_batch_keep_their_places() -> None:
    batch = draw((20, 20, 0.5), (40, 30, 0.25), (10, 35, 0.6), (50, 10, 0.2))
    seeker = Seeker(0.3)
    trace = run(seeker, batch)
    pixels = torch.tensor([[[20.0, 20]], [[40, 30]], [[10, 35]], [[50, 10]]])
    depth = torch.tensor([[0.5], [0.25], [0.6], [0.2]])
    truth = back_project(pixels, depth, batch.intrinsics)[:, 0]
    for poses in (trace.belief.best[:, :3, 3], trace.particles[-1].state[..., :3, 3].mean(1)):
        assert torch.allclose(poses, truth, atol=6e-3)
    assert [len(one.rgb) for one in seeker.seen] == [4, 2, 2]
    assert all(len(one.state) == 4 for one in trace.particles)


def test_a_batch_of_all_kinds_keeps_its_places_about_a_center_that_is_not_the_origin(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Small and agreed, large, small by the whole filter's answer alone, large again."""
    agreed = zoom.find_place

    def find_place(particles: Particles, object_model: ObjectModel) -> tuple[Tensor, Tensor]:
        center, weight = agreed(particles, object_model)
        disagreed = torch.tensor([False, False, True, False])
        return torch.where(disagreed[:, None], 0.1, center), weight * ~disagreed

    monkeypatch.setattr(zoom, "find_place", find_place)
    batch = draw((27, 22, 0.5), (40, 30, 0.25), (34, 25, 0.6), (50, 10, 0.2))
    seeker, offset = Seeker(0.3), torch.tensor([0.0, 0.0, -0.04])
    seeker.object_model = MODEL._replace(center=offset)
    trace = run(seeker, batch)
    pixels = torch.tensor([[[27.0, 22]], [[40, 30]], [[34, 25]], [[50, 10]]])
    depth = torch.tensor([[0.5], [0.25], [0.6], [0.2]])
    truth = back_project(pixels, depth, batch.intrinsics)[:, 0]
    assert torch.allclose(trace.belief.best[:, :3, 3], truth, atol=6e-3)
    assert [len(one.rgb) for one in seeker.seen] == [4, 3, 2]
    for row, cameras in ((0, 0), (2, 1)):  # windows about the center, as large as asked for there
        camera, center = seeker.seen[-1].intrinsics[cameras], truth[row] + offset
        at = project(center[None], camera)[0]
        assert (at - torch.tensor([(W - 1) / 2, (H - 1) / 2])).abs().max() < 4
        assert float(camera[0, 0] * MODEL.diameter / center[2]) / W == pytest.approx(0.3, abs=0.03)


def test_particles_that_do_not_agree_see_the_whole_image_to_the_end() -> None:
    batch = draw((20, 20, 0.5))
    seeker, whole = Seeker(0.3, apart=0.2), Seeker(None, apart=0.2)
    run(seeker, batch)
    answer = run(whole, batch).belief.best[0, :3, 3]
    assert seeker.steps == [0, 1, 2, 3, 4] * 2
    at = project(answer[None], seeker.seen[-1].intrinsics[0])[0]
    assert torch.allclose(at, torch.tensor([(W - 1) / 2, (H - 1) / 2]), atol=2.0)


@pytest.mark.parametrize(
    ("z", "zoom"),
    [(0.3, 1.0), (0.33, 1.0), (0.4, 1.2), (0.5, 1.5), (1.0, 3.0), (9.0, MOST_ZOOM), (-1.0, 1.0)],
)
def test_how_much_an_object_is_magnified(z: float, zoom: float) -> None:
    center = torch.tensor([[0.0, 0.0, z]])
    found = measure_zoom(center, draw((0, 0, 1.0)), MODEL, 0.3)
    assert float(found) == pytest.approx(zoom)


def test_a_window_without_depth_is_not_searched() -> None:
    batch = draw((20, 20, 0.5))
    center = back_project(torch.tensor([[20.0, 20]]), torch.tensor([0.5]), K)
    assert float(measure_zoom(center, batch, MODEL, 0.3)) > 1
    batch.depth[..., :40, :44] = 0
    batch.depth[..., 20, 20] = 0.5  # a single pixel knows it
    assert float(measure_zoom(center, batch, MODEL, 0.3)) == 1


class Looker(Seeker):
    """Its network is sure of what is bright."""

    def encode(self, batch: Batch) -> Any:
        self.seen.append(batch)
        return SimpleNamespace(objectness=batch.rgb.mean(1, keepdim=True))


@pytest.mark.parametrize(("u", "v"), [(4, 4), (31, 24), (60, 10), (50, 44)])
def test_the_part_shows_what_the_network_is_surest_of_twice_as_large(u: int, v: int) -> None:
    looker, image = Looker(None), draw((u, v, 0.5))
    part = choose_part(looker, image)
    assert part is not None
    assert part.rgb.shape == image.rgb.shape
    assert float(part.intrinsics[0, 0, 0]) == 2 * 64
    brightest = int(part.rgb[0, 0].argmax())
    seen = torch.tensor([[brightest % W, brightest // W]]).float()
    point = back_project(seen, torch.tensor([0.5]), part.intrinsics[0])
    assert torch.allclose(project(point, K), torch.tensor([[u, v]]).float(), atol=0.6)


def test_there_is_no_part_without_depth_or_without_objectness() -> None:
    image = draw((20, 20, 0.5))
    assert choose_part(Seeker(None), image) is None
    assert choose_part(Looker(None), image._replace(depth=0 * image.depth)) is None
    half = image._replace(depth=image.depth.clone())
    half.depth[..., :40] = 0  # where the bright pixel is
    looker = Looker(None)
    part = choose_part(looker, half)
    assert part is not None
    assert float(part.depth.max()) > 0
    assert len(looker.seen[0].rgb) < 9
