"""Signs of failure on clouds whose failure is known."""

import math

import pytest
import torch

from posefilter.geometry.lookup import is_off_frame
from posefilter.metrics.diagnostics import (
    FilterDiagnostics,
    auroc,
    distinct,
    first_axis_share,
    near_edge,
    offset_cosine,
    pairwise_cosine,
    r2_score,
)
from posefilter.types import Batch, BeliefBatch, ParticleOutput, Particles, Step, Trace


def test_pairwise_cosine_equals_the_double_loop() -> None:
    g = torch.Generator().manual_seed(0)
    displacement = torch.randn(2, 9, 2, generator=g)
    displacement[0, 3] = 0
    for b, keep in ((0, [0, 1, 2, 4, 5, 6, 7, 8]), (1, list(range(9)))):
        unit = torch.nn.functional.normalize(displacement[b, keep], dim=-1)
        pairs = [unit[i] @ unit[j] for i in range(len(keep)) for j in range(len(keep)) if i != j]
        assert pairwise_cosine(displacement)[b].item() == pytest.approx(
            torch.stack(pairs).mean().item(), abs=1e-5
        )
    assert pairwise_cosine(torch.ones(1, 5, 2))[0].item() == pytest.approx(1.0)
    assert math.isnan(pairwise_cosine(torch.zeros(1, 5, 2))[0].item())


def test_explained_is_one_for_the_truth_nought_for_the_mean_and_negative_for_drift() -> None:
    true = torch.randn(200, 2, generator=torch.Generator().manual_seed(0))
    assert r2_score(true, true) == 1
    assert r2_score(true.mean(0).expand(200, 2), true).item() == pytest.approx(0.0, abs=1e-5)
    assert r2_score(true + 3, true) < -1


def test_offset_cosine_ignores_particles_that_are_there() -> None:
    true = torch.tensor([[10.0, 0.0], [0.0, 10.0], [0.0, 0.0]])
    assert offset_cosine(
        torch.tensor([[1.0, 0.0], [1.0, 0.0], [-9.0, 1.0]]), true
    ).item() == pytest.approx(0.5)


def test_auroc_equals_counting_pairs() -> None:
    g = torch.Generator().manual_seed(0)
    score = torch.randint(0, 8, (60,), generator=g).float()
    positive = torch.rand(60, generator=g) < score / 10
    pairs = [float(a > b) + 0.5 * float(a == b) for a in score[positive] for b in score[~positive]]
    assert auroc(score, positive).item() == pytest.approx(sum(pairs) / len(pairs), abs=1e-6)
    assert math.isnan(auroc(score, torch.zeros(60, dtype=torch.bool)).item())


def test_shares_of_particles_on_object_at_edges_and_in_corners() -> None:
    state = torch.tensor([[[100.0, 50.0], [122.0, 50.0], [2.0, 2.0], [100.0, 99.0], [-5.0, 50.0]]])
    assert is_off_frame(state, 200, 100).float().mean().item() == pytest.approx(0.2)
    edge, corner = near_edge(state, 200, 100)
    assert edge.item() == pytest.approx(0.6)
    assert corner.item() == pytest.approx(0.2)


def test_a_line_has_all_variance_along_it_and_a_round_cloud_half() -> None:
    g = torch.Generator().manual_seed(0)
    along = torch.randn(1, 50, 1, generator=g)
    line = torch.tensor([400.0, -90.0]) + along * torch.tensor([3.0, -7.0])
    assert first_axis_share(line).item() == pytest.approx(1.0, abs=1e-5)
    cloud = torch.randn(1, 20000, 2, generator=g)
    assert first_axis_share(cloud).item() == pytest.approx(0.5, abs=0.01)
    # 9 of 10 parts of the variance along an axis, wherever that points and whatever the unit
    stretched = cloud * torch.tensor([3.0, 1.0])
    c, s = math.cos(0.7), math.sin(0.7)
    turned = stretched @ torch.tensor([[c, s], [-s, c]])
    assert first_axis_share(stretched).item() == pytest.approx(0.9, abs=0.01)
    torch.testing.assert_close(
        first_axis_share(turned * 1e4 + 1e5), first_axis_share(stretched), rtol=1e-3, atol=0
    )
    frame = torch.rand(1, 20000, 2, generator=g) * torch.tensor([320.0, 240.0])
    assert first_axis_share(frame).item() == pytest.approx(0.64, abs=0.01)


def test_particles_in_one_place_are_on_no_line_and_hide_no_other_image() -> None:
    state = torch.stack(
        [torch.full((3, 2), 7.0), torch.tensor([[0.0, 0.0], [1.0, 1.0], [2.0, 2.0]])]
    )
    assert first_axis_share(state)[0].isnan()
    diverged = torch.tensor([[[0.0, 0.0], [torch.inf, 1.0]], [[0.0, 0.0], [1.0, torch.nan]]])
    assert first_axis_share(diverged).isnan().all()
    mask = torch.ones(2, 1, 20, 20, dtype=torch.bool)
    signs = FilterDiagnostics()
    signs.update(
        make_trace(state, torch.zeros(2, 3)), Batch(mask, mask, mask, *[torch.zeros(1)] * 5)
    )
    assert signs.compute()["first_axis_share"] == [pytest.approx(1.0)]
    assert signs.compute()["on_object"] == [1.0]


def test_copies_count_once() -> None:
    state = torch.tensor(
        [
            [[3.0, 4.0], [3.0, 4.0], [3.04, 4.0], [3.2, 4.0]],
            [[1.0, 1.0], [2.0, 1.0], [1.0, 2.0], [9.0, 9.0]],
        ]
    )
    assert distinct(state).tolist() == [0.5, 1.0]


def test_to_tell_who_left_the_frame_is_no_skill() -> None:
    """A likelihood that is high wherever there is a picture tells nothing of the object."""
    mask = torch.zeros(1, 1, 50, 100, dtype=torch.bool)
    mask[..., 20:30, 40:60] = True
    state = torch.tensor(
        [[[45.0, 25.0], [55.0, 22.0], [5.0, 5.0], [90.0, 40.0], [-30.0, 9.0], [140.0, 9.0]]]
    )
    seen = torch.tensor([[-0.1, -0.1, -0.1, -0.1, -9.0, -9.0]])
    for log_likelihood, wanted in (
        (seen, 0.5),
        (torch.where(state[..., 0] > 60, -1.0, seen), 0.75),
    ):
        signs = FilterDiagnostics()
        signs.update(
            make_trace(state, log_likelihood), Batch(mask, mask, mask, *[torch.zeros(1)] * 5)
        )
        assert signs.compute()["auroc"] == pytest.approx(wanted)


def make_trace(state: torch.Tensor, log_likelihood: torch.Tensor) -> Trace:
    B, N = log_likelihood.shape
    particles = Particles(state, torch.zeros(B, N, 0), log_likelihood, torch.arange(N).expand(B, N))
    pose = torch.eye(4).expand(B, N, 4, 4)
    output = ParticleOutput(log_likelihood, torch.zeros_like(state), pose, torch.zeros(B, N, 0))
    return Trace(
        (particles,),
        (output,),
        (Step(0, 1, torch.tensor(0.0)),),
        BeliefBatch(pose, log_likelihood, pose[:, 0], pose[:, 0, 0]),
    )


def test_no_image_has_no_diagnostics() -> None:
    """As after a test on no frames (`data.split={train: 0.8, val: 0.2, test: 0}`)."""
    assert FilterDiagnostics().compute() == {}
