"""Figures are read in small: the letters of titles and legends keep their size, and nothing is cut
off.
"""

import numpy as np
import pytest

from posefilter.figures.canvas import TRUTH, arrange_grid, load_font
from posefilter.figures.layout import (
    CAPTION,
    DETAIL,
    GAP,
    LEGEND,
    THUMBNAIL,
    TITLE,
    WIDTH,
    add_caption,
    center_part,
    compose_figure,
    draw_legend,
    draw_scale,
    draw_text,
    tile_width,
    wrap_text,
)

READ = 9  # [px] a small letter is so high that it is read at a glance


def x_height(size: int, bold: bool = False) -> float:
    """Return how high a small x is in TensorBoard's thumbnails [px]."""
    _, top, _, bottom = load_font(size, bold).getbbox("x", anchor="ls")
    return (bottom - top) * THUMBNAIL / WIDTH


def test_letters_are_read_in_a_thumbnail() -> None:
    assert x_height(TITLE) >= READ
    assert x_height(TITLE, bold=True) >= READ
    assert x_height(LEGEND) >= 0.7 * READ
    assert x_height(CAPTION) >= 0.6 * READ
    assert TITLE > 1.2 * LEGEND > 1.2 * CAPTION > 1.2 * DETAIL  # what is said first is the largest
    assert DETAIL * 0.54 >= 8  # at the whole size


def test_a_stroke_of_a_title_survives_every_second_pixel() -> None:
    """TensorBoard asks browsers for pixels, not for their means."""
    whole = compose_figure("lllll")
    small = whole[::2, ::2]
    columns = (small < 128).all(-1).any(0)
    # each letter is there, apart from the next
    assert (np.diff(columns.astype(int)) == 1).sum() == 5


@pytest.mark.parametrize("columns", [1, 2, 3])
def test_tiles_fill_a_sheet(columns: int) -> None:
    tile = np.zeros((10, tile_width(columns), 3), np.uint8)
    width = arrange_grid([tile] * columns, columns).shape[1]
    assert WIDTH - columns < width <= WIDTH
    assert center_part(tile).shape[1] == WIDTH


def test_what_is_too_wide_is_refused() -> None:
    with pytest.raises(ValueError, match="601 pixels"):
        compose_figure("title", np.zeros((10, 601, 3), np.uint8))


def test_long_writing_goes_on_in_the_next_line_and_loses_nothing() -> None:
    letters = load_font(TITLE)
    text = "what the proposal network says of every single image that it is shown"
    lines = wrap_text(text, letters, WIDTH - 2 * GAP)
    assert len(lines) > 1
    assert " ".join(lines) == text
    assert max(letters.getlength(line) for line in lines) <= WIDTH
    assert len(draw_text(text, TITLE)) == len(lines) * round(TITLE * 1.25)
    assert (draw_text(text, TITLE)[:, -3:] == 255).all()
    assert wrap_text("", letters, WIDTH) == [""]
    assert wrap_text(f"no {'a' * 99} no", letters, WIDTH) == ["no", "a" * 99, "no"]


def test_a_legend_shows_each_color_once_and_breaks_where_it_must() -> None:
    few = [("truth", TRUTH), ("estimate", (255, 80, 200))]
    many = [*few, ("where the particles started", (10, 20, 30)), ("y", (60, 190, 70))]
    line = round(LEGEND * 1.25)
    assert len(draw_legend(few)) == line
    assert len(draw_legend(many)) > line
    for _, color in many:
        rows, columns = np.nonzero((draw_legend(many) == color).all(-1))
        assert columns.max() - columns.min() in range(24, 29)
        assert rows.max() - rows.min() < 10


def test_a_scale_runs_between_its_words() -> None:
    ramp = np.array([[255, 0, 0], [0, 0, 255]], np.uint8)
    drawn = draw_scale("low", ramp, "high", 300, 20)
    middle = drawn[len(drawn) // 2]
    red, blue = (np.nonzero((middle == color).all(-1))[0] for color in ramp)
    assert red.max() + 1 == blue.min()
    assert abs(len(red) - len(blue)) <= 1
    assert red.min() > load_font(20).getlength("low")
    assert blue.max() < 300 - load_font(20).getlength("high")


def test_a_caption_is_above_its_tile_and_as_wide() -> None:
    tile = np.full((20, 100, 3), 7, np.uint8)
    both = add_caption(tile, "step 1")
    assert (both[-20:] == 7).all()
    assert both.shape[1] == 100
    assert (both[:-20] < 100).any()
