"""Pictures of beliefs: mass is drawn where the belief is."""

import itertools
import math
import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.stats import chi2

from posefilter.belief import Belief
from posefilter.figures.belief import (
    Mark,
    describe_belief,
    describe_samples,
    draw_belief,
    draw_rotations,
    find_longest_axis,
    scale_radii,
    select_single,
    summarize_belief,
)
from posefilter.figures.canvas import halve, load_font
from posefilter.figures.layout import DETAIL, WIDTH, tile_width
from posefilter.figures.marginals import choose_few_ticks, compute_marginals
from posefilter.figures.mollweide import (
    color_by_turn,
    draw_blank_map,
    label_map,
    map_to_sphere,
    project_to_map,
)
from posefilter.figures.panels import LEFT, RIGHT
from posefilter.geometry.pose import make_pose, move_about
from posefilter.geometry.rotation import angle_between, exp_so3
from posefilter.types import BeliefBatch, ObjectModel

K = np.array([[150.0, 0, 79.5], [0, 150.0, 59.5], [0, 0, 1]])
RGB = np.full((120, 160, 3), 128, np.uint8)


def model() -> ObjectModel:
    hull = torch.tensor(
        [[x, y, z] for x in (-0.03, 0.03) for y in (-0.08, 0.08) for z in (0.0, 0.21)]
    )
    return ObjectModel(
        "box", hull, torch.tensor([0.0, 0.0, 0.105]), 0.136, 0.27, torch.eye(4)[None], hull
    )


def looking(longitude: float, latitude: float) -> torch.Tensor:
    """Return a pose whose z axis points there on the map."""
    z = torch.tensor(
        [
            math.cos(latitude) * math.sin(longitude),
            -math.sin(latitude),
            -math.cos(latitude) * math.cos(longitude),
        ],
        dtype=torch.float64,
    )
    x = torch.linalg.cross(torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64), z)
    x = x / x.norm()
    R = torch.stack([x, torch.linalg.cross(z, x), z], -1)
    return make_pose(
        R, torch.tensor([0.02, -0.01, 0.7], dtype=torch.float64) - R @ model().center.double()
    )


def two_modes(
    share: float = 0.3, count: int = 400
) -> tuple[BeliefBatch, torch.Tensor, torch.Tensor]:
    a, b = looking(0.5, 0.4), looking(-1.4, -0.5)
    g = torch.Generator().manual_seed(0)
    tangent = torch.randn(count, 6, generator=g, dtype=torch.float64) * torch.tensor(
        [0.004] * 3 + [0.03] * 3
    )
    start = torch.where((torch.arange(count) < count // 2)[:, None, None], a, b)
    poses = move_about(start, tangent, model().center.double())
    weights = torch.where(torch.arange(count) < count // 2, 1 - share, share) * 2 / count
    return BeliefBatch(poses[None], weights.log()[None], a[None], torch.zeros(1)), a, b


@pytest.mark.parametrize(
    ("z_axis", "longitude", "latitude"),
    [
        ((0, 0, -1), 0, 0),
        ((1, 0, 0), math.pi / 2, 0),
        ((-1, 0, 0), -math.pi / 2, 0),
        ((0, -1, 0), None, math.pi / 2),
    ],
)
def test_map_is_the_images_own(
    z_axis: tuple[int, ...], longitude: float | None, latitude: float
) -> None:
    z = torch.tensor(z_axis, dtype=torch.float64)
    x = torch.tensor([0.0, 0.0, 1.0] if z[2] == 0 else [0.0, -1.0, 0.0], dtype=torch.float64)
    u, v, _ = map_to_sphere(torch.stack([x, torch.linalg.cross(z, x), z], -1), 2)
    assert longitude is None or abs(float(u) - longitude) < 1e-9
    assert abs(float(v) - latitude) < 1e-9


def test_tilt_turns_clockwise_from_upwards() -> None:
    z = torch.tensor([0.0, 0.0, -1.0])
    for x, expected in (((0, -1, 0), 0.0), ((1, 0, 0), math.pi / 2), ((-1, 0, 0), -math.pi / 2)):
        first = torch.tensor(x, dtype=torch.float32)
        assert (
            abs(
                float(
                    map_to_sphere(torch.stack([first, torch.linalg.cross(z, first), z], -1), 2)[2]
                )
                - expected
            )
            < 1e-6
        )
    R = looking(0.5, 0.4)[:3, :3]
    turned = R @ exp_so3(torch.tensor([0.0, 0.0, 0.3], dtype=torch.float64))
    before, after = map_to_sphere(R, 2), map_to_sphere(turned, 2)
    assert abs(float(after[0] - before[0])) < 1e-9
    assert abs(abs(float(after[2] - before[2])) - 0.3) < 1e-9


def test_longest_axis() -> None:
    assert find_longest_axis(model()) == 2
    assert find_longest_axis(model()._replace(hull=model().hull[:, [2, 1, 0]])) == 0


def test_the_map_keeps_areas() -> None:
    """A hundredth of the sphere is a hundredth of the map, near a pole or at the equator."""
    ellipse = math.pi / 4 * 980 * 490  # on a map of 1000 pixels, rim aside
    for latitude in (0.0, 0.6, 1.2):
        # of a patch a quarter of the way round
        height = 0.02 * math.pi / (math.pi / 4) / math.cos(latitude)
        low, high = (
            math.sin(latitude) + side * height * math.cos(latitude) / 2 for side in (-1, 1)
        )
        edge = np.arcsin(np.linspace(low, high, 50))
        right, left = (
            project_to_map(np.full(50, turn), edge, 1000) for turn in (math.pi / 4, -math.pi / 4)
        )
        area = np.trapezoid(right[:, 0] - left[:, 0], -right[:, 1])
        assert area / ellipse == pytest.approx((high - low) / 2 / 4, rel=0.01)


def test_corners_of_the_map_are_where_they_should_be() -> None:
    places = project_to_map(
        np.array([0.0, math.pi, -math.pi, 2.0, 0.5]),
        np.array([0.0, 0.0, 0.0, math.pi / 2, -math.pi / 2]),
        1000,
    )
    expected = [[500, 250], [990, 250], [10, 250], [500, 5], [500, 495]]
    assert places == pytest.approx(np.array(expected), abs=0.5)


def test_dots_areas_are_the_weights() -> None:
    radii = scale_radii(np.array([0.0, 0.2, 0.4]), 3.0, 11.0)
    assert radii[0] == pytest.approx(3)
    assert radii[2] == pytest.approx(11)
    assert (radii[1] ** 2 - 9) / (radii[2] ** 2 - 9) == pytest.approx(0.5)


def draw_empty_map(marked: torch.Tensor) -> np.ndarray:
    """Return the map without particles, its words where they are when a pose is marked."""
    longitude, latitude, _ = (x.numpy() for x in map_to_sphere(marked[None, :3, :3], 2))
    return halve(
        label_map(draw_blank_map(2 * 588), project_to_map(longitude, latitude, 2 * 588))
    ).astype(int)


def test_pixels_of_the_map_are_colored_where_the_belief_is_and_only_there() -> None:
    belief, a, b = two_modes()
    poses, weights, best = select_single(belief)
    picture = draw_rotations(poses, weights, [Mark(best, (214, 33, 156), "square")], 2, 588).astype(
        int
    )
    longitude, latitude, tilt = (
        x.numpy() for x in map_to_sphere(torch.stack([a, b])[:, :3, :3], 2)
    )
    places, colors = project_to_map(longitude, latitude, 588), color_by_turn(tilt).astype(int)
    empty = draw_empty_map(best)
    drawn = np.argwhere(np.abs(picture - empty).max(-1) > 100)[:, ::-1]
    near = np.linalg.norm(drawn[:, None] - places[None], axis=-1)
    assert (near.min(1) < 40).all()  # nobody is anywhere else
    assert (near[:, 1] < 25).sum() > 200
    u, v = places[1].round().astype(int)
    middle = picture[v - 2 : v + 3, u - 2 : u + 3].reshape(-1, 3)
    assert np.abs(np.median(middle, 0) - colors[1]).max() < 40


def test_the_heavier_mode_covers_more_of_the_map() -> None:
    belief, a, b = two_modes(share=0.02)
    poses, weights, _ = select_single(belief)
    far = looking(2.6, -0.9)  # where the estimate is marked, out of the way
    picture = draw_rotations(poses, weights, [Mark(far, (214, 33, 156), "square")], 2, 588).astype(
        int
    )
    empty = draw_empty_map(far)
    drawn = np.argwhere(np.abs(picture - empty).max(-1) > 60)[:, ::-1]
    longitude, latitude, _ = (x.numpy() for x in map_to_sphere(torch.stack([a, b])[:, :3, :3], 2))
    heavy, light = (
        int((np.linalg.norm(drawn - at, axis=1) < 40).sum())
        for at in project_to_map(longitude, latitude, 588)
    )
    assert heavy > 1.5 * light > 100


def test_figure_shows_the_map_the_photograph_and_six_marginals() -> None:
    belief, a, _ = two_modes()
    picture = draw_belief(RGB, K, belief, model(), a.numpy())
    assert picture.shape[1] == WIDTH
    blue = (np.abs(picture.astype(int) - (122, 153, 196)).max(-1) < 3).any(0)
    columns = np.nonzero(np.diff(blue.astype(int)) == 1)[0]
    assert all(any(left < column < left + 190 for column in columns) for left in (60, 260, 460))


def test_marginals_are_in_the_units_they_say() -> None:
    belief, a, _ = two_modes(share=0.0)
    truth = a.clone()
    truth[0, 3] += 0.007
    poses, weights, best = select_single(belief)
    shifts, turns = compute_marginals(poses, weights, best, truth, model().center.double())
    estimate, true = shifts[0].marks
    assert true - estimate == pytest.approx(7.0)  # [mm]
    middle = lambda one: (one.edges[1:] + one.edges[:-1]) / 2  # noqa: E731
    assert abs(np.average(middle(shifts[0]), weights=shifts[0].mass)) < 0.5  # the mean's own frame
    width = np.sqrt(np.average(middle(turns[2]) ** 2, weights=turns[2].mass))
    assert width == pytest.approx(math.degrees(0.03), rel=0.2)
    assert shifts[0].edges[0] < min(shifts[0].marks) < max(shifts[0].marks) < shifts[0].edges[-1]


@pytest.mark.parametrize("scale", [0.3, 1.0, 3.0, 10.0, 100.0])
def test_labels_below_a_histogram_do_not_touch(scale: float) -> None:
    width = tile_width(3) - LEFT - RIGHT
    rng, several = np.random.default_rng(0), 0
    for low, high in [(-7.0, 4.5), *zip(-rng.random(99) - 0.01, rng.random(99), strict=True)]:
        low, high = low * scale, high * scale
        ticks = choose_few_ticks(low, high, width)
        assert ticks
        places = [(tick - low) / (high - low) * (width - 1) for tick in ticks]
        halves = [load_font(DETAIL).getlength(f"{tick:g}") / 2 for tick in ticks]
        ends = [(x - half, x + half) for x, half in zip(places, halves, strict=True)]
        for (_, end), (begin, _) in itertools.pairwise(ends):
            assert begin - end > 2
        several += len(ticks) >= 2
    assert several >= 95


def test_what_lies_beyond_a_histogram_is_reported() -> None:
    belief, _, _ = two_modes(share=0.01)
    poses, weights, best = select_single(belief)
    beyond = [
        one.beyond
        for row in compute_marginals(poses, weights, best, None, model().center.double())
        for one in row
    ]
    assert 0.01 <= max(beyond) < 0.02  # the mode, and some of the tails
    assert all(one == pytest.approx(0, abs=0.06) for one in beyond)


def test_a_second_pose_is_reported_with_its_share() -> None:
    """How sure the estimate's own mode is, without the other one; how heavy, far and turned the
    other is.
    """
    belief, a, b = two_modes(share=0.3)
    poses, weights, best = select_single(belief)
    found = summarize_belief(poses, weights, best, model())
    assert found.share == pytest.approx(0.7, abs=0.01)
    assert found.second is not None
    assert found.second.weight == pytest.approx(0.3, abs=0.01)
    quantile = math.sqrt(chi2.ppf(0.95, 3))
    assert found.uncertainty.translation == pytest.approx(0.004 * quantile, rel=0.15)
    assert found.uncertainty.rotation == pytest.approx(0.03 * quantile, rel=0.15)
    assert found.second_rotation == pytest.approx(
        float(angle_between(a[:3, :3], b[:3, :3])), abs=0.15
    )
    sure, other = describe_belief(found)
    assert re.fullmatch(
        r"within 1\d\.\d mm and [45]\.\d degrees \(95 %\) of a pose that has 70 % of the belief",
        sure,
    )
    assert re.fullmatch(r"second pose 30 %: [\d.]+ mm and \d+° off", other)


def test_a_second_pose_that_outweighs_the_estimate_is_not_taken_for_it() -> None:
    """The width is that of the heaviest mode, and the sentence says whose it is."""
    belief, _, _ = two_modes(share=0.7)
    poses, weights, best = select_single(belief)
    found = summarize_belief(poses, weights, best, model())
    assert found.share == pytest.approx(0.3, abs=0.01)
    assert re.fullmatch(
        r"the estimate has 30 % of the belief; another pose has 70 %, "
        r"within 1\d\.\d mm and [45]\.\d degrees \(95 %\)",
        describe_belief(found)[0],
    )


def test_an_equivalent_pose_is_no_second_one() -> None:
    best = looking(0.3, 0.4)
    center = model().center.double()
    turn = exp_so3(torch.tensor([0.0, 0.0, math.pi]).double())
    half = make_pose(turn, center - turn @ center)
    noise = 0.002 * torch.randn(300, 6, generator=torch.Generator().manual_seed(3)).double()
    poses = move_about(best.expand(300, 4, 4), noise, center)
    poses[:120] = poses[:120] @ half
    weights = torch.full((300,), 1 / 300).double()
    plain = summarize_belief(poses, weights, best, model())
    assert plain.second is not None
    assert plain.share == pytest.approx(0.6)
    group = torch.stack([torch.eye(4), half.float()])
    found = summarize_belief(poses, weights, best, model()._replace(symmetries=group))
    assert found.second is None
    assert found.share == pytest.approx(1)
    assert found.uncertainty.rotation < 0.01


def test_the_draws_of_a_calibrated_belief_are_one_mode_however_far_apart() -> None:
    """The picture then has the modes of `Belief.modes`, and the width of all draws."""
    best, center = looking(0.3, 0.4), model().center.double()
    noise = torch.randn(200, 6, generator=torch.Generator().manual_seed(3)).double()
    scale = torch.tensor([0.03] * 3 + [0.4] * 3).double()
    scale = torch.where(torch.arange(200)[:, None] < 150, scale, 0.05 * scale)
    start = torch.where((torch.arange(200) < 150)[:, None, None], best, looking(-1.4, -0.5))
    poses, weights = move_about(start, scale * noise, center), torch.full((200,), 1 / 200).double()
    assert summarize_belief(poses, weights, best, model()).share < 0.7
    found = summarize_belief(poses, weights, best, model(), draws=150)
    belief = Belief(poses.numpy(), weights.numpy(), center.numpy(), 0.136, 0.27, draws=150)
    assert [mode.mass for mode in belief.modes[:1]] == pytest.approx([found.share])
    assert found.second is not None
    assert found.second.weight == pytest.approx(belief.modes[1].mass)
    assert found.share == pytest.approx(0.75)
    assert found.uncertainty == belief.uncertainty()  # which the console names, too
    assert describe_belief(found)[0] == belief.uncertainty().describe()
    np.testing.assert_allclose(select_single(belief)[2], belief.modes[0].pose, atol=1e-9)


def test_weights_are_explained_where_they_tell_something() -> None:
    """Of draws, whose weights are equal, there is neither their scale nor an effective number."""
    weights = torch.tensor([0.5, 0.25, 0.125, 0.125]).double()
    what, colored, scale = describe_samples(weights, 0)
    assert what == "4 particles, 3 effective."
    assert colored
    assert len(scale) == 1
    what, colored, scale = describe_samples(torch.full((4,), 0.25).double(), 3)
    assert what == "3 draws of the error model about the estimate, 1 of other modes."
    assert not colored + "".join(map(str, scale))
    assert "other" not in describe_samples(torch.full((4,), 0.25).double(), 4)[0]


def test_the_draws_of_a_belief_are_known_to_its_picture() -> None:
    batch, _, _ = two_modes()
    poses, weights, _ = select_single(batch)
    sizes = (model().center.double().numpy(), 0.136, 0.27, "box")
    plain = Belief(poses.numpy(), weights.numpy(), *sizes)
    drawn = replace(plain, draws=len(weights))
    pictures = [draw_belief(RGB, K, one, model()) for one in (plain, drawn)]
    assert pictures[0].shape[0] > pictures[1].shape[0]


def test_a_single_pose_and_a_lost_estimate_are_reported() -> None:
    belief, _, b = two_modes(share=0.0)
    poses, weights, best = select_single(belief)
    keep = weights > 1e-12
    found = summarize_belief(poses[keep], weights[keep], best, model())
    assert found.second is None
    assert describe_belief(found)[1] == "no second pose above 1 %"
    away = b.clone()
    away[2, 3] += 1.0
    lost = summarize_belief(poses[keep], weights[keep], away, model())
    assert lost.share == 0
    assert describe_belief(lost)[0].startswith("the estimate lies apart from the particles, which")


def test_nothing_is_written_under_a_mark() -> None:
    """The word for a direction gives way to a mark that stands there, and is there without it."""
    blank = draw_blank_map(1176)
    (place,) = project_to_map(np.zeros(1), np.zeros(1), 1176)
    window = (
        slice(int(place[1]) - 20, int(place[1]) + 36),
        slice(int(place[0]) - 20, int(place[0]) + 20),
    )
    free, marked = (label_map(blank, taken) for taken in (np.zeros((0, 2)), place[None]))
    assert (free[window] != blank[window]).any()
    assert (marked[window] == blank[window]).all()
    # it is written elsewhere
    assert ((marked != blank).any(-1)).sum() > 0.8 * ((free != blank).any(-1)).sum()


def test_a_batch_of_several_is_refused() -> None:
    belief, _, _ = two_modes()
    several = BeliefBatch(*(torch.cat([x, x]) for x in belief))
    with pytest.raises(ValueError, match="one image"):
        draw_belief(RGB, K, several, model())
