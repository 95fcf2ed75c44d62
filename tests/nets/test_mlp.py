"""The particle networks: what mixes particles and what does not, and the paper's sizes."""

import pytest
import torch

from posefilter.errors import UserError
from posefilter.nets.mlp import LatentNet, PatchNet, mlp


def test_layers_are_as_the_paper_counts_them() -> None:
    net = mlp(260, 256, 512, 4, "batch")
    linear = [m for m in net.modules() if isinstance(m, torch.nn.Linear)]
    assert [(m.in_features, m.out_features) for m in linear] == [
        (260, 512),
        (512, 512),
        (512, 512),
        (512, 256),
    ]
    assert sum(isinstance(m, torch.nn.BatchNorm1d) for m in net.modules()) == 3
    with pytest.raises(UserError, match="batch or layer"):
        mlp(4, 4, 8, 2, "group")


@pytest.mark.parametrize(("normalization", "mixes"), [("batch", True), ("layer", False)])
def test_batch_statistics_mix_particles_and_layer_statistics_do_not(
    normalization: str, mixes: bool
) -> None:
    torch.manual_seed(0)
    latent = LatentNet(0, 1, latent_width=8, width=16, normalization=normalization).train()
    patch = PatchNet(0, 3, width=8, latent_width=4, normalization=normalization).train()
    g = torch.Generator().manual_seed(1)
    pixel = torch.rand(2, 5, 4, 1, 1, generator=g)
    window = torch.rand(2, 5, 4, 3, 3, generator=g)
    for net, seen in ((latent, pixel), (patch, window)):
        latent = torch.zeros(2, 5, net.latent_width)
        other = seen.clone()
        other[1, 4] += 3.0  # another particle, of another image
        before, after = (
            net(x, seen[..., 0, 0, :0].flatten(2)[..., :0], latent).displacement[0]
            for x in (seen, other)
        )
        assert (not torch.allclose(before, after, atol=1e-6)) == mixes


def test_the_displacement_reads_the_logit_or_the_likelihood() -> None:
    torch.manual_seed(0)
    size = {"latent_width": 8, "width": 16, "normalization": "layer"}
    by_logit, by_likelihood = (
        LatentNet(0, 1, displacement_input=reads, **size) for reads in ("logit", "likelihood")
    )
    by_likelihood.load_state_dict(by_logit.state_dict())
    inputs = torch.rand(1, 3, 4, 1, 1), torch.zeros(1, 3, 0), torch.zeros(1, 3, 8)
    for net, read in ((by_logit, lambda x: x), (by_likelihood, torch.sigmoid)):
        out = net(*inputs)
        told = torch.cat([out.pose, read(out.logit)[..., None], out.latent], -1)
        torch.testing.assert_close(out.displacement, net.displacement(told))
    assert not torch.equal(by_logit(*inputs).displacement, by_likelihood(*inputs).displacement)
    with pytest.raises(UserError, match="choose logit or likelihood"):
        LatentNet(0, 1, displacement_input="odds")


def test_a_last_layer_with_a_relu_has_no_negative_output() -> None:
    """Particles then move right and down alone."""
    torch.manual_seed(0)
    size = {"latent_width": 8, "width": 16, "normalization": "batch"}
    for last_layer, least in (("linear", False), ("relu", True)):
        net = LatentNet(0, 1, last_layer=last_layer, **size)
        out = net(torch.rand(8, 50, 4, 1, 1), torch.zeros(8, 50, 0), torch.zeros(8, 50, 8))
        for part in (out.latent, out.logit, out.displacement, out.pose):
            assert (bool(part.min() >= 0)) == least
            assert part.std() > 0
    with pytest.raises(UserError, match=r"last_layer=relu: needs model\.net\.normalization=batch"):
        LatentNet(0, 1, last_layer="relu", normalization="layer")
    with pytest.raises(UserError, match="choose linear or relu"):
        LatentNet(0, 1, last_layer="tanh")


@pytest.mark.parametrize("kernel", [1, 5])
def test_the_kernel_decides_what_a_convolution_sees(kernel: int) -> None:
    """Three layers reach three times half a kernel: what lies further off changes nothing."""
    net = PatchNet(0, 9, width=4, normalization="layer", kernel=kernel).eval()
    patch = torch.rand(1, 1, 4, 9, 9, requires_grad=True)
    net.convolve[0](patch[0])[..., 4, 4].sum().backward()
    seen = patch.grad[0, 0].abs().sum(0) > 0
    assert seen.sum() == kernel**2
    assert net(patch, torch.zeros(1, 1, 0), torch.zeros(1, 1, 0)).displacement.shape == (1, 1, 2)
    with pytest.raises(UserError, match=r"kernel=4: must be odd"):
        PatchNet(0, 9, kernel=4)


def test_a_latent_net_without_a_pose_learns() -> None:
    net = LatentNet(0, 1, pose_width=0, latent_width=8, width=16, normalization="layer")
    out = net(torch.rand(1, 3, 4, 1, 1), torch.zeros(1, 3, 0), torch.zeros(1, 3, 8))
    assert out.pose.shape == (1, 3, 0)
    (out.logit.sum() + out.displacement.sum()).backward()
    assert all(p.grad is not None for p in net.parameters())


def test_latent_net_remembers() -> None:
    torch.manual_seed(0)
    net = LatentNet(0, 1, latent_width=8, pose_width=9, width=16, normalization="layer")
    seen, extra = torch.rand(1, 3, 4, 1, 1), torch.zeros(1, 3, 0)
    first = net(seen, extra, torch.zeros(1, 3, 8))
    second = net(seen, extra, first.latent)
    assert first.pose.shape == (1, 3, 9)
    assert (first.displacement - second.displacement).abs().min() > 1e-6


def test_an_unknown_normalization_is_refused() -> None:
    with pytest.raises(UserError, match=r"model\.net\.normalization='bacth' is unknown"):
        PatchNet(0, 5, normalization="bacth")
