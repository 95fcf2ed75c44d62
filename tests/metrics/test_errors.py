"""ADD and ADD-S against naive loops, for any leading shapes."""

import pytest
import torch
from torch import Generator, Tensor

from posefilter.geometry.pose import make_pose, transform
from posefilter.geometry.rotation import exp_so3, random_rotation
from posefilter.metrics import errors
from posefilter.metrics.errors import add, add_s

POINTS = torch.randn(40, 3, generator=Generator().manual_seed(9)) * 0.1


def scattered(*shape: int, seed: int = 0) -> Tensor:
    g = Generator().manual_seed(seed)
    return make_pose(
        random_rotation(*shape, generator=g), 0.1 * torch.randn(*shape, 3, generator=g)
    )


def naive(pose: Tensor, truth: Tensor) -> tuple[float, float]:
    guess, true = transform(pose, POINTS), transform(truth, POINTS)
    pairs = [float((g - t).norm()) for g, t in zip(guess, true, strict=True)]
    nearest = [min(float((g - t).norm()) for g in guess) for t in true]
    return sum(pairs) / len(pairs), sum(nearest) / len(nearest)


@pytest.mark.parametrize("chunk", [1 << 20, 100])
def test_against_naive_loops(monkeypatch: pytest.MonkeyPatch, chunk: int) -> None:
    monkeypatch.setattr(errors, "_CHUNK", chunk)
    guess, truth = scattered(2, 4), scattered(2, 1, seed=1)
    a, s = add(guess, truth, POINTS), add_s(guess, truth, POINTS)
    assert a.shape == s.shape == (2, 4)
    for b in range(2):
        for n in range(4):
            assert (float(a[b, n]), float(s[b, n])) == pytest.approx(
                naive(guess[b, n], truth[b, 0]), abs=1e-5
            )


def test_what_is_known_by_hand() -> None:
    eye = torch.eye(4)
    shifted = eye.clone()
    shifted[:3, 3] = torch.tensor([0.03, 0.0, 0.04])
    assert float(add(shifted, eye, POINTS)) == pytest.approx(0.05)
    assert float(add(eye, eye, POINTS)) == 0.0
    square = torch.tensor([[1.0, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]])
    quarter = make_pose(exp_so3(torch.tensor([0.0, 0.0, torch.pi / 2])), torch.zeros(3))
    assert float(add(quarter, eye, square)) == pytest.approx(2**0.5, rel=1e-5)
    # a symmetry costs nothing
    assert float(add_s(quarter, eye, square)) == pytest.approx(0, abs=1e-6)


def test_the_direction_of_add_s_matters() -> None:
    lopsided = torch.tensor([[0.0, 0, 0], [0.01, 0, 0], [0, 0.01, 0], [1, 0, 0]])
    moved = make_pose(torch.eye(3), torch.tensor([1.0, 0.0, 0.0]))
    there, back = add_s(moved, torch.eye(4), lopsided), add_s(torch.eye(4), moved, lopsided)
    assert float(there) == pytest.approx(0.75, abs=0.02)
    assert float(back) == pytest.approx(0.26, abs=0.02)


def test_no_poses_give_no_errors() -> None:
    none = torch.zeros(0, 4, 4)
    assert add(none, none, POINTS).shape == add_s(none, none, POINTS).shape == (0,)


def test_add_has_a_gradient() -> None:
    guess = scattered(3).double().requires_grad_()
    assert torch.autograd.gradcheck(
        lambda T: add(T, scattered(3, seed=1).double(), POINTS.double()), guess
    )
