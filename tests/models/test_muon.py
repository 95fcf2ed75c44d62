"""Muon against the definition of its step, and that it learns."""

import torch

from posefilter.models.muon import Muon, orthogonalize


def test_singular_values_come_to_about_one() -> None:
    g = torch.Generator().manual_seed(0)
    for shape in ((2, 40, 90), (2, 90, 40)):
        x = torch.randn(shape, generator=g)
        x[:, 0] *= 30  # one direction drowns the others
        y = orthogonalize(x)
        assert y.shape == x.shape
        values = torch.linalg.svdvals(y)
        assert values.min() > 0.4
        assert values.max() < 1.35
        u, _, v = torch.linalg.svd(x, full_matrices=False)
        assert ((u @ v) * y).sum() / (u @ v).norm() / y.norm() > 0.97  # and the directions stay


def test_a_step_has_the_given_size_whatever_the_gradient() -> None:
    torch.manual_seed(0)
    for scale in (1e-3, 1e3):
        weight = torch.nn.Parameter(torch.zeros(40, 6, 3, 3))
        before = weight.detach().clone()
        weight.grad = scale * torch.randn_like(weight)
        Muon([("net.conv.weight", weight)], lr=0.01, weight_decay=0.0).step()
        moved = (weight.detach() - before).square().mean().sqrt().item()
        # root mean square, as AdamW's usually is
        assert 0.8 * 0.2 * 0.01 < moved < 1.1 * 0.2 * 0.01


def test_a_zero_gradient_moves_no_matrix() -> None:
    """As of a loss whose weight is 0 in a stage of the training: the momentum that is left would be
    a step of full size.
    """
    torch.manual_seed(0)
    idle, busy = (torch.nn.Parameter(torch.randn(6, 8)) for _ in range(2))
    muon = Muon([("a.mid.weight", idle), ("b.mid.weight", busy)], lr=0.01)
    idle.grad, busy.grad = torch.randn(6, 8), torch.randn(6, 8)
    muon.step()
    before = [p.detach().clone() for p in (idle, busy)]
    idle.grad = torch.zeros(6, 8)
    muon.step()
    assert torch.equal(idle, before[0])
    assert not torch.equal(busy, before[1])


def test_vectors_and_spared_layers_take_adamws_step() -> None:
    torch.manual_seed(0)
    start = {
        "a.bias": torch.randn(7),
        "a.out.weight": torch.randn(5, 7),
        "a.mid.weight": torch.randn(5, 7),
    }
    ours = {name: torch.nn.Parameter(value.clone()) for name, value in start.items()}
    theirs = {name: torch.nn.Parameter(value.clone()) for name, value in start.items()}
    muon = Muon(ours.items(), lr=0.02, adam_lr=0.01, weight_decay=0.1, adam_layers=["out"])
    adamw = torch.optim.AdamW(theirs.values(), 0.01, weight_decay=0.1)
    for _ in range(3):
        for name in start:
            ours[name].grad = theirs[name].grad = torch.randn_like(start[name])
        muon.step()
        adamw.step()
    for name in ("a.bias", "a.out.weight"):
        torch.testing.assert_close(ours[name], theirs[name])
    assert not torch.allclose(ours["a.mid.weight"], theirs["a.mid.weight"], atol=1e-3)


def test_it_resumes_where_it_stopped() -> None:
    def run(
        steps: int, state: dict | None = None, weight: torch.Tensor | None = None
    ) -> tuple[torch.Tensor, dict]:
        p = torch.nn.Parameter(torch.ones(8, 9) if weight is None else weight.clone())
        b = torch.nn.Parameter(torch.zeros(8))
        optimizer = Muon([("w", p), ("b", b)], lr=0.1)
        if state:
            optimizer.load_state_dict(state)
        for _ in range(steps):
            p.grad, b.grad = p.detach() - 3 * torch.eye(8, 9), torch.zeros(8)
            optimizer.step()
        return p.detach(), optimizer.state_dict()

    whole, _ = run(6)
    half, state = run(3)
    again, _ = run(3, state, half)
    torch.testing.assert_close(again, whole)
    assert (run(200)[0] - 3 * torch.eye(8, 9)).norm() < 0.3 * (
        torch.ones(8, 9) - 3 * torch.eye(8, 9)
    ).norm()
