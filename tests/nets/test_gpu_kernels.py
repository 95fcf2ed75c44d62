"""A GPU's kernel computes what `nets/fused.py` does; Triton interprets it, on the CPU."""

import importlib
from types import ModuleType

import pytest
import torch
from tests.nets.test_fused import (
    CENTER,
    FEATURES,
    RADIUS,
    B,
    N,
    make_images,
    make_likelihood,
    make_poses,
)

from posefilter.nets import fused
from posefilter.nets.coordinates import STRIDE

POINTS = 50


@pytest.fixture
def kernels(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.setenv("TRITON_INTERPRET", "1")  # which Triton reads when it is imported
    pytest.importorskip("triton", reason="no Triton, which torch's builds for GPUs bring")
    return importlib.import_module("posefilter.nets.kernels")


@pytest.mark.parametrize(("octaves", "sigma", "ray"), [(4, 0.004, True), (0, 0.1, False)])
@torch.no_grad()
def test_it_scores_points_as_the_operations_do(
    octaves: int, sigma: float, ray: bool, kernels: ModuleType
) -> None:
    g = torch.Generator().manual_seed(0)
    image, poses = make_images(g), make_poses(g)
    likelihood = make_likelihood(FEATURES, octaves)
    likelihood.ray = ray
    noise, level = torch.randn(B, 1, POINTS, 2, generator=g), torch.tensor(sigma)
    assert image.context is not None
    tables, about = fused.make_tables(image.context), image.context
    inputs, cells, inside = fused._inputs(octaves, image, tables, poses, CENTER, RADIUS, noise, 0.6)
    own = fused._Weights(likelihood, level, torch.float32)
    expected = own.score(inputs.flatten(1), tables.smooth, cells).view(B, N, POINTS)
    parts = (own.enter, own.context, own.blocks, own.floor, own.leave)
    scores, seen = kernels.score_points(
        image.values, image.size, image.intrinsics, tables.fragments, tables.smooth, about.centers,
        about.grid, about.columns, STRIDE, poses, CENTER, RADIUS, noise, 0.6, octaves,
        kernels.pack(*parts, torch.float32),
    )  # fmt: skip
    assert torch.equal(seen, inside)
    assert 0.1 < inside.float().mean() < 0.9
    torch.testing.assert_close(scores + own.last, expected, rtol=1e-4, atol=1e-3)


def test_a_cpu_has_none() -> None:
    assert not fused.has_kernels(torch.device("cpu"))
