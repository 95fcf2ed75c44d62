"""The likelihood without gradient gives the numbers of the one that is trained."""

import pytest
import torch

from posefilter.errors import UserError
from posefilter.geometry.camera import intrinsics
from posefilter.geometry.pose import make_pose
from posefilter.geometry.rotation import random_rotation
from posefilter.nets import fused
from posefilter.nets.coordinates import Coordinates
from posefilter.nets.likelihood import Pixels, PoseLikelihood, flatten_images

H, W, B, N, FEATURES = 45, 61, 2, 37, 5  # no whole cells of the coordinate network
CENTER, RADIUS = torch.tensor([0.01, -0.02, 0.03]), 0.1
K = torch.stack([intrinsics(80.0, 90.0, 31.0, 22.0), intrinsics(70.0, 75.0, 28.0, 25.0)])


def make_images(g: torch.Generator, context: bool = True) -> Pixels:
    rgb, depth = (
        torch.rand(B, 3, H, W, generator=g),
        0.6 + 0.4 * torch.rand(B, 1, H, W, generator=g),
    )
    depth[:, :, ::7, ::5] = 0
    if not context:
        return flatten_images(rgb, depth, K)
    h, w, fragments = -(-H // 8), -(-W // 8), 9
    draw = lambda *shape: torch.randn(*shape, generator=g)  # noqa: E731
    coordinates = Coordinates(
        draw(B, h, w),
        torch.log_softmax(4 * draw(B, h, w, fragments), dim=-1),
        draw(B, h, w, fragments, 3),
        draw(B, fragments, 3),
        draw(B, h, w, FEATURES),
    )
    return flatten_images(rgb, depth, K, coordinates)


def make_poses(g: torch.Generator) -> torch.Tensor:
    """Some of them beside the frame, and some too near."""
    shift = torch.randn(B, N, 3, generator=g) * torch.tensor([0.3, 0.3, 0.4])
    return make_pose(random_rotation(B, N, generator=g), shift + torch.tensor([0.0, 0.0, 0.8]))


def make_likelihood(context: int | None, octaves: int = 4) -> PoseLikelihood:
    torch.manual_seed(3)
    likelihood = PoseLikelihood(width=32, blocks=2, octaves=octaves, context=context)
    for parameter in likelihood.parameters():  # the last layer of a block is zero at first
        torch.nn.init.normal_(parameter, std=0.2)
    return likelihood.eval()


@pytest.mark.parametrize(("context", "octaves"), [(None, 4), (FEATURES, 4), (FEATURES, 0)])
@pytest.mark.parametrize(("sigma", "ray"), [(0.004, True), (0.1, True), (0.1, False)])
def test_both_ways_agree(context: int | None, octaves: int, sigma: float, ray: bool) -> None:
    g = torch.Generator().manual_seed(0)
    image, poses = make_images(g, context is not None), make_poses(g)
    likelihood = make_likelihood(context, octaves)
    likelihood.ray = ray
    with torch.enable_grad():  # the reference
        exact = likelihood(
            image, poses, torch.tensor(sigma), CENTER, RADIUS, 50, torch.Generator().manual_seed(1)
        )
    with torch.no_grad():
        fast = likelihood(
            image, poses, torch.tensor(sigma), CENTER, RADIUS, 50, torch.Generator().manual_seed(1)
        )
    assert exact.requires_grad
    assert not fast.requires_grad
    assert exact.std() > 0.1  # poses differ
    torch.testing.assert_close(fast, exact.detach(), rtol=1e-4, atol=1e-3)


def test_in_half_precision_the_error_is_that_of_the_reference() -> None:
    g = torch.Generator().manual_seed(0)
    image, poses, likelihood = make_images(g), make_poses(g), make_likelihood(FEATURES)

    def score(grad: bool, half: bool) -> torch.Tensor:
        h = torch.Generator().manual_seed(1)
        with torch.set_grad_enabled(grad), torch.autocast("cpu", torch.bfloat16, enabled=half):
            out = likelihood(image, poses, torch.tensor(0.02), CENTER, RADIUS, 50, h)
        return out.detach().float()

    exact = score(grad=True, half=False)
    reference, fast = score(grad=True, half=True), score(grad=False, half=True)
    assert 0 < (fast - exact).abs().mean() < 2 * (reference - exact).abs().mean()


def test_parts_of_points_are_scored_as_the_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    g = torch.Generator().manual_seed(0)
    image, poses, likelihood = make_images(g), make_poses(g), make_likelihood(FEATURES)
    noise = torch.randn(B, 1, 50, 2, generator=g)
    arguments = (likelihood, image, poses, torch.tensor(0.02), CENTER, RADIUS, noise)
    with torch.no_grad():
        whole = fused.score(*arguments)
        monkeypatch.setattr(fused, "PART", 97)
        parts = fused.score(*arguments)
    torch.testing.assert_close(parts, whole, rtol=1e-5, atol=1e-4)


def test_tables_made_before_are_used() -> None:
    g = torch.Generator().manual_seed(0)
    image, poses, likelihood = make_images(g), make_poses(g), make_likelihood(FEATURES)
    noise = torch.randn(B, 1, 20, 2, generator=g)
    assert image.context is not None
    tables = fused.make_tables(image.context)
    rest = (poses, torch.tensor(0.02), CENTER, RADIUS, noise)
    with torch.no_grad():
        own = fused.score(likelihood, image, *rest)
        given = fused.score(likelihood, image._replace(tables=tables), *rest)
        empty = tables._replace(smooth=torch.zeros_like(tables.smooth))
        other = fused.score(likelihood, image._replace(tables=empty), *rest)
    assert torch.equal(own, given)
    assert not torch.allclose(own, other)


def test_a_likelihood_without_context_passes_over_an_images_tables() -> None:
    """They are made where the proposals have features, for whichever likelihood."""
    g = torch.Generator().manual_seed(0)
    image, poses, likelihood = make_images(g), make_poses(g), make_likelihood(None)
    assert image.context is not None
    tabled = image._replace(tables=fused.make_tables(image.context))
    rest = (poses, torch.tensor(0.02), CENTER, RADIUS, torch.randn(B, 1, 20, 2, generator=g))
    with torch.no_grad():
        assert torch.equal(
            fused.score(likelihood, tabled, *rest), fused.score(likelihood, image, *rest)
        )


def test_a_likelihood_with_context_refuses_images_without() -> None:
    g = torch.Generator().manual_seed(0)
    image, poses, likelihood = make_images(g, False), make_poses(g), make_likelihood(FEATURES)
    with torch.no_grad(), pytest.raises(UserError, match="model/proposals=dense"):
        likelihood(image, poses, torch.tensor(0.02), CENTER, RADIUS, 8, g)


def test_what_is_kept_of_a_network_goes_when_the_network_changes() -> None:
    g = torch.Generator().manual_seed(0)
    image, poses, likelihood = make_images(g), make_poses(g), make_likelihood(FEATURES)
    noise = torch.randn(B, 1, 20, 2, generator=g)

    def score(sigma: float) -> torch.Tensor:
        return fused.score(likelihood, image, poses, torch.tensor(sigma), CENTER, RADIUS, noise)

    def anew(sigma: float) -> torch.Tensor:
        fused.CACHE.clear()
        return score(sigma)

    with torch.no_grad():
        first = score(0.02)
        assert torch.equal(score(0.02), first)
        assert not torch.allclose(score(0.1), first)  # of another noise level
        likelihood.modulate[2].bias.add_(0.3)
        changed = score(0.02)
        assert not torch.allclose(changed, first)
        assert torch.equal(changed, anew(0.02))
        state = {k: 0.5 * v for k, v in likelihood.state_dict().items()}
        likelihood.load_state_dict(state, assign=True)  # other tensors of the same versions
        halved = score(0.02)
        assert not torch.allclose(halved, changed)
        assert torch.equal(halved, anew(0.02))
        for level in range(70):
            score(0.01 + 0.001 * level)
        assert 1 <= len(fused.CACHE._entries[likelihood].values) <= 32


def test_weights_are_computed_once_for_a_noise_level(monkeypatch: pytest.MonkeyPatch) -> None:
    g = torch.Generator().manual_seed(0)
    image, poses, likelihood = make_images(g), make_poses(g), make_likelihood(FEATURES)
    made = []
    init = fused._Weights.__init__
    monkeypatch.setattr(
        fused._Weights, "__init__", lambda self, *given: (made.append(given), init(self, *given))[1]
    )
    with torch.no_grad():
        for sigma in (0.008, 0.004, 0.008, 0.004):
            likelihood(image, poses, torch.tensor(sigma), CENTER, RADIUS, 8, g)
    assert len(made) == 2


def test_every_parameter_that_weights_depend_on_is_watched() -> None:
    g = torch.Generator().manual_seed(0)
    image, poses, likelihood = make_images(g), make_poses(g), make_likelihood(FEATURES)
    noise = torch.randn(B, 1, 20, 2, generator=g)
    arguments = (likelihood, image, poses, torch.tensor(0.02), CENTER, RADIUS, noise)
    with torch.no_grad():
        for parameter in likelihood.parameters():
            fused.score(*arguments)
            parameter.mul_(1.1)
            kept = fused.score(*arguments)
            fused.CACHE.clear()
            assert torch.equal(kept, fused.score(*arguments))
