"""Maps over the image: colors tell the network's numbers, where the cells are."""

import numpy as np
import pytest
import torch

from posefilter.figures.canvas import TRUTH, full_view
from posefilter.figures.layout import WIDTH, tile_width
from posefilter.figures.maps import (
    Proposals,
    average_objectness,
    draw_heat_map,
    draw_objectness,
    draw_point_map,
    draw_proposals,
)

H, W = 48, 64
RGB = np.full((H, W, 3), 100, np.uint8)
K = np.array([[60.0, 0, 31.5], [0, 60.0, 23.5], [0, 0, 1]])
MASK = np.zeros((H, W), bool)
MASK[16:32, 32:48] = True


def test_heat_is_where_its_cells_are() -> None:
    values = np.zeros((6, 8))
    values[2:4, 4:6] = 1.0  # cells of 8 pixels: the mask
    heat = draw_heat_map(RGB, values, full_view(H, W, 640)).astype(int).sum(-1)
    shown = np.kron(MASK, np.ones((10, 10))).astype(bool)
    assert heat[shown].min() > heat[~shown].max() + 200


def test_points_have_the_colors_of_their_axes_and_fade_with_doubt() -> None:
    points = np.zeros((1, 3, 3))
    points[0, 0], points[0, 1], points[0, 2] = [1, -1, -1], [-1, -1, 1], [1, 1, 1]
    picture = draw_point_map(points, np.array([[1.0, 1.0, 0.0]]), full_view(1, 3, 30))
    assert picture[5, 5].tolist() == [255, 0, 0]
    assert picture[5, 15].tolist() == [0, 0, 255]
    assert picture[5, 25].max() < 40  # surely not the object


def test_objectness_is_averaged_over_the_mask() -> None:
    objectness = np.zeros((6, 8))
    objectness[2:4, 4:6] = 0.8
    assert average_objectness(objectness, MASK) == pytest.approx(0.8)
    assert average_objectness(objectness, ~MASK) == 0
    assert np.isnan(average_objectness(objectness, np.zeros_like(MASK)))


def test_figure_of_objectness_shows_map_outline_and_both_sets_of_particles() -> None:
    objectness = np.zeros((6, 8))
    objectness[2:4, 4:6] = 1.0
    weights = np.full(20, 0.05)
    start, end = np.tile([8.0, 8.0], (20, 1)), np.tile([40.0, 24.0], (20, 1))
    figure = draw_objectness(objectness, RGB, MASK, (start, weights), (end, weights), "objectness")
    assert figure.shape[1] == WIDTH
    green = np.nonzero((figure == TRUTH).all(-1).any(1))[0]
    # of the clouds' photographs, below the map
    top = int(green[green > 480].min()) - round(16 * tile_width(2) / 64)
    scale = tile_width(2) / 64

    def dot(tile: int, u: float, v: float) -> int:
        """Return how far the picture there is from the gray ground."""
        row, column = top + round(v * scale), 6 + tile * 297 + round(u * scale)
        near = figure[row - 2 : row + 3, column - 2 : column + 3].astype(int)
        return int(
            np.abs(near - figure[top + round(44 * scale), 6 + tile * 297 + round(60 * scale)]).max()
        )

    assert dot(0, 8.0, 8.0) > 50
    assert dot(1, 8.0, 8.0) < 5
    assert dot(1, 40.0, 24.0) > 50


def test_figure_of_proposals_shows_them_where_they_are() -> None:
    chance = np.zeros((6, 8))
    chance[2:4, 4:6] = 1.0
    points = np.zeros((6, 8, 3))
    points[2:4, 4:6] = [1.0, -1.0, -1.0]
    axes = np.array([[[10.0, 40.0], [14.0, 40.0], [10.0, 44.0], [10.0, 36.0]]])
    said = Proposals(chance, points, -points, chance > 0, axes, 0.012)
    truth = np.eye(4)
    truth[:3, 3] = [0.11, 0.0, 0.8]
    hull = torch.tensor([[x, y, 0.0] for x in (-0.1, 0.1) for y in (-0.1, 0.1)])
    figure = draw_proposals(said, RGB, K, truth, hull, 0.14, "proposals")
    red, cyan = (figure == (255, 0, 0)).all(-1), (figure == (0, 255, 255)).all(-1)
    side = 16 * tile_width(2) / 64
    # the predicted and the true points, 16 x 16 pixels
    assert red[:, :300].sum() == pytest.approx(side**2, rel=0.03)
    assert cyan[:, 300:].sum() == pytest.approx(side**2, rel=0.03)
    orange = (np.abs(figure.astype(int) - (255, 190, 40)).max(-1) < 12)[:330, 303:]
    assert orange.any()
    assert abs(np.nonzero(orange)[1].mean() - 10 * tile_width(2) / 64) < 8
