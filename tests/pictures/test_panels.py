"""Small plots: what is drawn lies where the axes say."""

import numpy as np

from posefilter.pictures.canvas import PAPER, TRUTH
from posefilter.pictures.panels import LEFT, TOP, Axis, Mark, colours, curve_panel, flat_bar, heat_panel, upright_bar

X, Y = Axis("x [mm]", -10, 10, (-10, 0, 10)), Axis("y [mm]", -10, 10, (-10, 0, 10))


def test_rows_rise_and_columns_go_right() -> None:
    values = np.zeros((5, 5))
    values[3, 1] = 1.0  # above the middle, left of it
    panel = heat_panel(colours(values, 0, 1), X, Y, "t", 100)
    plot = panel[TOP : TOP + 100, LEFT : LEFT + 100]
    assert (plot[30, 30] == colours(np.array(1.0), 0, 1)).all()
    assert (plot[70, 30] == colours(np.array(0.0), 0, 1)).all()
    assert (plot[30, 70] == colours(np.array(0.0), 0, 1)).all()


def test_marks_are_where_they_point_and_on_the_rim_where_that_is_beyond() -> None:
    plain = np.full((3, 3, 3), 128, np.uint8)
    for x, y, u, v in ((5.0, -5.0, 75, 75), (100.0, 0.0, 90, 50)):
        plot = heat_panel(plain, X, Y, "", 101, [Mark(x, y, TRUTH)])[TOP : TOP + 101, LEFT : LEFT + 101]
        rows, columns = np.nonzero((plot == TRUTH).all(-1))
        assert abs(columns.mean() - u) < 1.5
        assert abs(rows.mean() - v) < 1.5


def test_a_curve_goes_through_its_numbers_and_is_cut_at_the_ends() -> None:
    places = np.array([-10.0, 0.0, 10.0])
    plot = curve_panel([(np.array([-50.0, 5.0, -5.0]), (255, 0, 0))], places, X, Y, "", 101, 101)
    drawn = (plot[TOP : TOP + 101, LEFT : LEFT + 101] == (255, 0, 0)).all(-1)
    assert abs(np.nonzero(drawn[:, 50])[0].mean() - 25) < 2
    assert abs(np.nonzero(drawn[:, 100])[0].mean() - 75) < 3
    assert np.nonzero(drawn[:, 0])[0].mean() > 96


def test_scales_run_from_their_low_end_to_their_high_one() -> None:
    bar = upright_bar("0", "1", "chance", 200)
    low, high = colours(np.array([0.0, 1.0]), 0, 1)
    assert (bar[TOP, 15] == high).all()
    assert (bar[TOP + 199, 15] == low).all()
    flat = flat_bar("chance", "0", "1", "viridis")
    middle = flat[flat.shape[0] // 2]
    columns = np.nonzero((middle == low).all(-1))[0]
    assert np.nonzero((middle == high).all(-1))[0].max() - columns.min() in range(150, 170)
    assert (flat[0] == PAPER).all()
