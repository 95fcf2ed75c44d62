"""MSSD and MSPD against a naive loop, by hand, and by the laws that they must obey."""

import math

import numpy as np
import pytest
import torch
from torch import Generator, Tensor

from posefilter.geometry.camera import intrinsics
from posefilter.geometry.pose import make_pose, transform
from posefilter.geometry.rotation import exp_so3, random_rotation
from posefilter.geometry.symmetries import densify
from posefilter.meshes.symmetries import rotation_about, symmetry_group
from posefilter.metrics.bop import BopErrors, average_recall, mspd, mspd_of_vertices, mssd
from posefilter.types import ObjectModel

K = intrinsics(500.0, 510.0, 320.0, 240.0).double()
POINTS = 0.1 * torch.randn(50, 3, generator=Generator().manual_seed(3), dtype=torch.float64)
EYE = torch.eye(4, dtype=torch.float64)[None]
# half turns about three orthogonal axes through a point: a group
HALF_TURNS = torch.from_numpy(
    np.stack(
        [np.eye(4), *(rotation_about(a, np.pi, np.array([0.01, 0.02, 0.03])) for a in np.eye(3))]
    )
)


def scattered(*shape: int, seed: int = 0) -> Tensor:
    g = Generator().manual_seed(seed)
    shift = 0.05 * torch.randn(*shape, 3, generator=g) + torch.tensor([0.0, 0.0, 0.8])
    return make_pose(random_rotation(*shape, generator=g), shift).double()


def pixel(point: Tensor) -> Tensor:
    x, y, z = point.tolist()
    return torch.tensor([500 * x / z + 320, 510 * y / z + 240], dtype=torch.float64)


def test_against_naive_loops() -> None:
    poses, truth = scattered(2, 3), scattered(2, 3, seed=1)
    surface = mssd(poses, truth, HALF_TURNS, POINTS)
    pixels = mspd(poses, truth, HALF_TURNS, POINTS, K)
    assert surface.shape == pixels.shape == (2, 3)
    for i in range(2):
        for j in range(3):
            guess = transform(poses[i, j], POINTS)
            least = [math.inf, math.inf]
            for S in HALF_TURNS:
                true = transform(truth[i, j], transform(S, POINTS))
                pairs = list(zip(guess, true, strict=True))
                far = max(float((a - b).norm()) for a, b in pairs)
                apart = max(float((pixel(a) - pixel(b)).norm()) for a, b in pairs)
                least = [min(least[0], far), min(least[1], apart)]
            assert [float(surface[i, j]), float(pixels[i, j])] == pytest.approx(least, rel=1e-9)


def test_of_all_vertices_though_the_hull_hides_some() -> None:
    """A vertex inside of the hull that is nearer to the camera may move by more pixels."""
    poses, truth = scattered(8), scattered(8, seed=1)
    few = POINTS[:5]
    for pose, true in zip(poses, truth, strict=True):
        expected = mspd(pose, true, HALF_TURNS, POINTS, K)
        assert mspd_of_vertices(pose, true, HALF_TURNS, few, POINTS, K) == expected
        assert mspd_of_vertices(pose, true, HALF_TURNS, POINTS, POINTS, K) == expected
    assert any(mspd(poses, truth, HALF_TURNS, few, K) < mspd(poses, truth, HALF_TURNS, POINTS, K))


def test_what_is_known_by_hand() -> None:
    pose = make_pose(torch.eye(3), torch.tensor([0.0, 0.0, 1.0])).double()
    moved = make_pose(torch.eye(3), torch.tensor([0.03, 0.0, 1.0])).double()
    turned = make_pose(exp_so3(torch.tensor([0.0, 0.0, math.pi])), torch.tensor([0.0, 0.0, 1.0]))
    rod = torch.tensor([[-0.1, 0.0, 0.0], [0.1, 0.0, 0.0]], dtype=torch.float64)
    half = torch.from_numpy(np.stack([np.eye(4), rotation_about(np.eye(3)[2], np.pi, np.zeros(3))]))
    assert float(mssd(moved, pose, EYE, rod)) == pytest.approx(0.03)
    assert float(mspd(moved, pose, EYE, rod, K)) == pytest.approx(15)
    assert float(mssd(turned.double(), pose, EYE, rod)) == pytest.approx(0.2, rel=1e-6)
    assert float(mssd(turned.double(), pose, half, rod)) == pytest.approx(0, abs=1e-7)


def test_symmetries_change_nothing() -> None:
    """Neither of the estimate nor of the truth, and without them the error is what it was."""
    poses, truth = scattered(4), scattered(4, seed=1)
    plain = mssd(poses, truth, EYE, POINTS)
    expected = (transform(poses, POINTS) - transform(truth, POINTS)).norm(dim=-1).amax(-1)
    torch.testing.assert_close(plain, expected)
    # points that the group maps onto each other
    orbit = torch.cat([transform(S, POINTS) for S in HALF_TURNS])
    for S in HALF_TURNS:
        for measure in (mssd, lambda *a: mspd(*a, K)):
            known = measure(poses, truth, HALF_TURNS, orbit)
            torch.testing.assert_close(measure(poses @ S, truth, HALF_TURNS, orbit), known)
            torch.testing.assert_close(measure(poses, truth @ S, HALF_TURNS, orbit), known)
    assert bool((mssd(poses, truth, HALF_TURNS, orbit) <= mssd(poses, truth, EYE, orbit)).all())


def test_the_greatest_distance_is_at_the_hull() -> None:
    from posefilter.meshes.mesh import hull_vertices

    poses, truth = scattered(5), scattered(5, seed=1)
    hull = torch.from_numpy(hull_vertices(POINTS.numpy()))
    assert len(hull) < len(POINTS)
    torch.testing.assert_close(
        mssd(poses, truth, HALF_TURNS, hull), mssd(poses, truth, HALF_TURNS, POINTS)
    )


def test_continuous_symmetries_have_no_gaps() -> None:
    axis, point = np.array([0.6, 0.0, 0.8]), np.array([0.01, -0.02, 0.03])
    coarse = torch.from_numpy(symmetry_group(continuous=[(axis, point)], steps=36))
    fine = densify(coarse)
    assert len(fine) == 36 * 9
    between = torch.from_numpy(rotation_about(axis, math.radians(5), point))
    assert float((fine - between).abs().amax((1, 2)).min()) < math.radians(0.6)
    on_axis = torch.from_numpy(point + 0.1 * axis)
    torch.testing.assert_close(transform(fine, on_axis[None]), on_axis.expand(len(fine), 1, 3))
    assert densify(HALF_TURNS) is HALF_TURNS
    truth = scattered(1)
    wide = 0.1 * torch.eye(3, dtype=torch.float64)
    assert float(mssd(truth @ between, truth, coarse, wide)) > 0.005
    assert float(mssd(truth @ between, truth, fine, wide)) < 0.0015


def test_the_recall_is_the_challenges() -> None:
    errors = torch.tensor([0.0, 0.012, 0.049, 0.05, math.inf]).double()
    # below 10, 8, 1, 0 and 0 of the ten thresholds 0.005, 0.01, ... 0.05 of a diameter of 0.1
    unit = torch.full((5,), 0.1, dtype=torch.float64)
    thresholds = [0.05 * i for i in range(1, 11)]
    assert average_recall(errors, thresholds, unit) == pytest.approx(100 * (10 + 8 + 1) / 50)


@pytest.mark.parametrize("width", [320, 640])
def test_collected_errors_do_not_depend_on_the_images_size(width: int) -> None:
    object_model = ObjectModel(
        "rod", POINTS.float(), torch.zeros(3), 0.3, 0.4, EYE.float(), POINTS[:4]
    )
    scaled = K.clone()
    scaled[:2] *= width / 640
    truth = make_pose(torch.eye(3), torch.tensor([[0.0, 0.0, 1.0]] * 3)).double()
    guess = truth.clone()
    guess[1, 0, 3], guess[2] = 0.01, torch.nan
    metric = BopErrors([object_model])
    metric.update(guess, truth, scaled.expand(3, 3, 3), width)
    found = metric.compute()
    # 0, 10 mm and a miss; of a diameter of 0.4 m: 10 of 10, 10 of 10 and none
    assert found["mssd"]["ar"] == pytest.approx(200 / 3)
    assert found["mssd"]["median_mm"] == pytest.approx(10)
    assert found["mspd"]["median_px"] == pytest.approx(
        float(mspd(guess[1], truth[1], EYE, POINTS, K)), rel=1e-6
    )
    empty = BopErrors([object_model]).compute()
    assert math.isnan(empty["mssd"]["ar"])
    assert math.isnan(empty["mspd"]["median_px"])
