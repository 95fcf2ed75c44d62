"""Small plots: what is drawn lies where the axes say."""

import numpy as np

from posefilter.figures.canvas import PAPER, TRUTH
from posefilter.figures.panels import (
    BOTTOM,
    LEFT,
    RIGHT,
    TOP,
    Axis,
    Mark,
    draw_color_scale,
    draw_curve_panel,
    draw_heat_panel,
    draw_histogram_panel,
    map_colors,
)

X, Y = Axis("x [mm]", -10, 10, (-10, 0, 10)), Axis("y [mm]", -10, 10, (-10, 0, 10))


def test_rows_rise_and_columns_go_right() -> None:
    values = np.zeros((5, 5))
    values[3, 1] = 1.0  # above the middle, left of it
    panel = draw_heat_panel(map_colors(values, 0, 1), X, Y, 100 + LEFT + RIGHT)
    plot = panel[TOP : TOP + 100, LEFT : LEFT + 100]
    assert (plot[30, 30] == map_colors(np.array(1.0), 0, 1)).all()
    assert (plot[70, 30] == map_colors(np.array(0.0), 0, 1)).all()
    assert (plot[30, 70] == map_colors(np.array(0.0), 0, 1)).all()


def test_marks_are_where_they_point_and_on_the_rim_where_that_is_beyond() -> None:
    plain = np.full((3, 3, 3), 128, np.uint8)
    for x, y, u, v in ((5.0, -5.0, 75, 75), (100.0, 0.0, 90, 50)):
        plot = draw_heat_panel(plain, X, Y, 101 + LEFT + RIGHT, [Mark(x, y, TRUTH)])[
            TOP : TOP + 101, LEFT : LEFT + 101
        ]
        rows, columns = np.nonzero((plot == TRUTH).all(-1))
        assert abs(columns.mean() - u) < 1.5
        assert abs(rows.mean() - v) < 1.5


def test_a_label_that_is_longer_than_its_axis_is_whole() -> None:
    plain, y = np.full((3, 3, 3), 128, np.uint8), Y._replace(label="object's y [mm]")
    wide, narrow = (
        draw_heat_panel(plain, X, y, size + LEFT + RIGHT)[:, :20].min(-1) for size in (300, 104)
    )
    assert (narrow < 128).sum() == (wide < 128).sum() > 100


def test_a_curve_goes_through_its_numbers_and_is_cut_at_the_ends() -> None:
    places = np.array([-10.0, 0.0, 10.0])
    lines = [(np.array([-50.0, 5.0, -5.0]), (255, 0, 0))]
    plot = draw_curve_panel(lines, places, X, Y, 101 + LEFT + RIGHT, 101 + TOP + BOTTOM)
    drawn = (plot[TOP : TOP + 101, LEFT : LEFT + 101] == (255, 0, 0)).all(-1)
    assert abs(np.nonzero(drawn[:, 50])[0].mean() - 25) < 2
    assert abs(np.nonzero(drawn[:, 100])[0].mean() - 75) < 3
    assert np.nonzero(drawn[:, 0])[0].mean() > 96


def test_a_histogram_stands_on_its_edges_and_lines_are_upright() -> None:
    mass, edges = np.array([0.0, 5.0, 10.0]), np.array([-10.0, -4.0, 0.0, 10.0])
    up = Axis("share", 0, 10, (0, 10))
    panel = draw_histogram_panel(
        mass, edges, [(5.0, (255, 0, 0))], X, up, 101 + LEFT + RIGHT, 101 + TOP + BOTTOM
    )
    plot = panel[TOP : TOP + 101, LEFT : LEFT + 101]
    blue = (plot[..., 2].astype(int) - plot[..., 0]) > 40
    assert not blue[:, :29].any()
    assert abs(blue[:, 40].sum() - 51) <= 1
    assert blue[:, 95].sum() >= 99
    assert (plot[10:90, 75] == (255, 0, 0)).all()


def test_scales_run_from_their_low_end_to_their_high_one() -> None:
    scale = draw_color_scale("chance 0", "1", "viridis", 300, 20)
    low, high = map_colors(np.array([0.0, 1.0]), 0, 1)
    middle = scale[scale.shape[0] // 2]
    first, last = (np.nonzero((middle == end).all(-1))[0] for end in (low, high))
    assert 100 < first.min() < last.max() < 290
    assert last.max() - first.min() > 140
    assert (scale[0] == PAPER).all()
