"""Pictures of beliefs: mass is drawn where the belief is."""

import math

import numpy as np
import pytest
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from posefilter.geometry.pose import make_pose, move_about
from posefilter.geometry.rotation import exp_so3
from posefilter.pictures.belief import draw_belief, longest_axis, sphere_map
from posefilter.pictures.canvas import rasterise
from posefilter.types import Belief, ObjectModel

K = np.array([[150.0, 0, 79.5], [0, 150.0, 59.5], [0, 0, 1]])
RGB = np.full((120, 160, 3), 128, np.uint8)


def model() -> ObjectModel:
    hull = torch.tensor([[x, y, z] for x in (-0.03, 0.03) for y in (-0.08, 0.08) for z in (0.0, 0.21)])
    return ObjectModel("box", hull, torch.tensor([0.0, 0.0, 0.105]), 0.136, 0.27, torch.eye(4)[None], hull)


def looking(longitude: float, latitude: float) -> torch.Tensor:
    """Return a pose whose z axis points there on the map."""
    z = torch.tensor(
        [math.cos(latitude) * math.sin(longitude), -math.sin(latitude), -math.cos(latitude) * math.cos(longitude)],
        dtype=torch.float64,
    )
    x = torch.linalg.cross(torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64), z)
    x = x / x.norm()
    R = torch.stack([x, torch.linalg.cross(z, x), z], -1)
    return make_pose(R, torch.tensor([0.02, -0.01, 0.7], dtype=torch.float64) - R @ model().center.double())


def two_modes(share: float = 0.3, count: int = 400) -> tuple[Belief, torch.Tensor, torch.Tensor]:
    a, b = looking(0.5, 0.4), looking(-1.4, -0.5)
    g = torch.Generator().manual_seed(0)
    tangent = torch.randn(count, 6, generator=g, dtype=torch.float64) * torch.tensor([0.004] * 3 + [0.03] * 3)
    start = torch.where((torch.arange(count) < count // 2)[:, None, None], a, b)
    poses = move_about(start, tangent, model().center.double())
    weights = torch.where(torch.arange(count) < count // 2, 1 - share, share) * 2 / count
    return Belief(poses[None], weights.log()[None], a[None], torch.zeros(1)), a, b


def map_of(figure: Figure) -> Axes:
    return next(axes for axes in figure.axes if axes.name == "mollweide")


@pytest.mark.parametrize(
    ("z_axis", "longitude", "latitude"),
    [((0, 0, -1), 0, 0), ((1, 0, 0), math.pi / 2, 0), ((-1, 0, 0), -math.pi / 2, 0), ((0, -1, 0), None, math.pi / 2)],
)
def test_map_is_the_images_own(z_axis: tuple[int, ...], longitude: float | None, latitude: float) -> None:
    z = torch.tensor(z_axis, dtype=torch.float64)
    x = torch.tensor([0.0, 0.0, 1.0] if z[2] == 0 else [0.0, -1.0, 0.0], dtype=torch.float64)
    u, v, _ = sphere_map(torch.stack([x, torch.linalg.cross(z, x), z], -1), 2)
    assert longitude is None or abs(float(u) - longitude) < 1e-9
    assert abs(float(v) - latitude) < 1e-9


def test_tilt_turns_clockwise_from_upwards() -> None:
    z = torch.tensor([0.0, 0.0, -1.0])
    for x, expected in (((0, -1, 0), 0.0), ((1, 0, 0), math.pi / 2), ((-1, 0, 0), -math.pi / 2)):
        first = torch.tensor(x, dtype=torch.float32)
        assert abs(float(sphere_map(torch.stack([first, torch.linalg.cross(z, first), z], -1), 2)[2]) - expected) < 1e-6
    R = looking(0.5, 0.4)[:3, :3]
    turned = R @ exp_so3(torch.tensor([0.0, 0.0, 0.3], dtype=torch.float64))
    before, after = sphere_map(R, 2), sphere_map(turned, 2)
    assert abs(float(after[0] - before[0])) < 1e-9
    assert abs(abs(float(after[2] - before[2])) - 0.3) < 1e-9


def test_longest_axis() -> None:
    assert longest_axis(model()) == 2
    assert longest_axis(model()._replace(hull=model().hull[:, [2, 1, 0]])) == 0


def test_map_shows_each_mode_with_its_mass() -> None:
    belief, _, _ = two_modes(share=0.3)
    figure = draw_belief(belief, model(), RGB, K)
    dots = max(map_of(figure).collections, key=lambda c: len(c.get_offsets()))
    place, area = np.asarray(dots.get_offsets()), dots.get_sizes()
    first = np.hypot(place[:, 0] - 0.5, place[:, 1] - 0.4) < 0.15
    second = np.hypot(place[:, 0] + 1.4, place[:, 1] + 0.5) < 0.15
    assert first.sum() == 200
    assert second.sum() == 200
    assert (area[second].mean() - 6) / (area[first].mean() - 6) == pytest.approx(0.3 / 0.7, rel=1e-6)


def test_pixels_of_the_map_are_coloured_where_the_belief_is_and_only_there() -> None:
    belief, _, b = two_modes()
    figure = draw_belief(belief, model(), RGB, K)
    picture = rasterise(figure)
    assert picture.shape[1] >= 1000
    axes = map_of(figure)
    longitude, latitude, tilt = (float(x) for x in sphere_map(b[:3, :3], 2))

    def at(u: float, v: float) -> np.ndarray:
        x, y = axes.transData.transform((u, v))
        middle = picture.shape[0] - 1 - round(y), round(x)
        return picture[middle[0] - 3 : middle[0] + 4, middle[1] - 3 : middle[1] + 4].reshape(-1, 3).astype(int)

    dots = max(axes.collections, key=lambda c: len(c.get_offsets()))
    wanted = np.array(dots.cmap((tilt / math.pi + 1) / 2)[:3]) * 255
    assert np.abs(np.median(at(longitude, latitude), 0) - wanted).max() < 40
    assert (at(1.7, -0.8) > 200).all()  # nobody is there


def test_marginals_are_in_the_units_they_say() -> None:
    belief, a, _ = two_modes(share=0.0)
    truth = a.clone()
    truth[0, 3] += 0.007
    figure = draw_belief(belief, model(), RGB, K, truth.numpy())
    panels = {axes.get_title(): axes for axes in figure.axes}
    shift = next(axes for title, axes in panels.items() if "camera x" in title)
    assert "[mm]" in shift.get_xlabel()
    estimate, true = (line.get_xdata()[0] for line in shift.lines)
    assert true - estimate == pytest.approx(7.0)
    mass, edges, _ = shift.patches[0].get_data()
    assert abs(np.average((edges[1:] + edges[:-1]) / 2, weights=mass)) < 0.5  # the mean's own frame
    turn = next(axes for title, axes in panels.items() if title.startswith("Turn") and title.endswith("z"))
    mass, edges, _ = turn.patches[0].get_data()
    width = np.sqrt(np.average(((edges[1:] + edges[:-1]) / 2) ** 2, weights=mass))
    assert width == pytest.approx(math.degrees(0.03), rel=0.2)
    assert "[degrees]" in turn.get_xlabel()


def test_what_lies_beyond_a_histogram_is_told() -> None:
    belief, _, _ = two_modes(share=0.01)
    figure = draw_belief(belief, model(), RGB, K)
    said = [text.get_text() for axes in figure.axes for text in axes.texts if "beyond" in text.get_text()]
    assert 1.0 <= max(float(text.split("%")[0]) for text in said) < 2.0  # the mode, and some of the tails


def test_a_batch_of_several_is_refused() -> None:
    belief, _, _ = two_modes()
    several = Belief(*(torch.cat([x, x]) for x in belief))
    with pytest.raises(ValueError, match="one image"):
        draw_belief(several, model(), RGB, K)
