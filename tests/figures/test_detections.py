"""Found is drawn full, unsure dashed with its probability, absent not at all."""

import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt

from posefilter.figures.canvas import draw_row, full_view, split_dashes
from posefilter.figures.detections import Drawn, draw_detections, pick_colors
from posefilter.figures.overlay import draw_overlay, outline_object

H, W = 120, 160
K = np.array([[150.0, 0, 79.5], [0, 150.0, 59.5], [0, 0, 1]])
GREY = np.full((H, W, 3), 128, np.uint8)
CUBE = 0.05 * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
POSE = np.eye(4)
POSE[:3, 3] = [0.05, 0.02, 0.6]


def drawn_share(picture: np.ndarray, color: tuple[int, int, int]) -> float:
    """Return the share of the outline that has been drawn in a color."""
    (line,) = outline_object(POSE, CUBE, full_view(H, W, 640).camera(K), 480, 640)
    points = np.concatenate(split_dashes(line, closed=True, dash=1, gap=0))
    near = distance_transform_edt(~(picture[:480] == color).all(-1)) < 1.5
    u, v = np.round(points).astype(int).T
    return float(near[v, u].mean())


def test_what_is_unsure_has_gaps_and_what_is_found_has_none() -> None:
    (color,) = pick_colors(1)
    full, dashed = (
        draw_detections(GREY, K, [Drawn("cube", POSE, CUBE, dashed=each)]) for each in (False, True)
    )
    assert drawn_share(full, color) > 0.99
    assert 0.45 < drawn_share(dashed, color) < 0.85
    one = draw_overlay(GREY, K, POSE, CUBE, color, dashed=True)
    assert 0.45 < drawn_share(one, color) < 0.85


def test_what_is_absent_is_named_and_not_drawn() -> None:
    names = ["003_cracker_box", "025_mug"]
    picture = draw_detections(GREY, K, [], names)
    assert (picture[:480] == 128).all()
    assert (picture[480:] == draw_row(640, "absent: 003_cracker_box, 025_mug")).all()


def test_a_long_caption_is_wrapped() -> None:
    names = [f"{number:03d}_some_object_of_a_long_name" for number in range(9)]
    one, many = (
        draw_detections(GREY, K, [], caption=" ".join(some)) for some in (names[:1], names)
    )
    assert len(many) - 480 >= 3 * (len(one) - 480)
    assert (many[:, -4:][480:] == draw_row(640, "")[0, 0]).all()  # nothing is cut at the edge


def test_a_tag_is_written_above_its_outline() -> None:
    plain, tagged = (
        draw_detections(GREY, K, [Drawn("cube", POSE, CUBE, tag)]) for tag in ("", "cube 0.34")
    )
    v, _ = np.nonzero((plain != tagged).any(-1))
    top = outline_object(POSE, CUBE, full_view(H, W, 640).camera(K), 480, 640)[0][:, 1].min()
    assert top - 25 < v.min() < v.max() < top + 3


@pytest.mark.parametrize("closed", [True, False])
def test_dashes_lie_on_the_line_and_are_spread_evenly(closed: bool) -> None:
    square = np.array([[0.0, 0], [60, 0], [60, 60], [0, 60]])
    dashes = split_dashes(square, closed, dash=11, gap=8)
    length = 240 if closed else 180
    assert len(dashes) == round(length / 19)
    on = np.minimum(np.abs(np.stack(dashes) % 60), 60 - np.abs(np.stack(dashes) % 60)).min(-1)
    assert on.max() < 1e-9
    starts = np.stack(dashes)[:, 0]
    gaps = np.abs(np.diff(starts, axis=0)).sum(1)  # along the sides: city blocks
    assert np.allclose(gaps, length / len(dashes))


def test_long_labels_have_lines_of_their_own_in_the_legend() -> None:
    """A label that the picture's edge would cut is put below the one before."""
    short, long = (
        draw_detections(GREY, K, [Drawn(label, POSE, CUBE), Drawn(label, POSE, CUBE)])
        for label in ("a", "003_cracker_box: found, probability 0.95")
    )
    assert len(long) > len(short)
    legend = long[480:]
    assert (legend[:, -4:] == legend[0, -1]).all()  # nothing at the right edge
