"""Charts of a report: nothing that is written runs over their edges."""

from io import BytesIO

import numpy as np
import pytest
from PIL import Image

from posefilter.report.charts import LIGHT, Line, Panel, draw_chart


@pytest.mark.parametrize("label", ["run {}", "model=patch_pf variant=working seed={}"])
@pytest.mark.parametrize("categories", [(), ("a", "b")])
def test_a_legend_of_long_names_stays_within_the_chart(
    label: str, categories: tuple[str, ...]
) -> None:
    lines = [Line(label.format(i), [0.0, 1.0], [float(i), 2.0]) for i in range(3)]
    picture = Image.open(
        BytesIO(
            draw_chart(
                Panel("ADD AUC", "time [s]", "", lines, categories=categories, joined=False), LIGHT
            )
        )
    )
    pixels = np.asarray(picture.convert("RGB")).astype(int)
    paper = np.array([int(LIGHT.paper[i : i + 2], 16) for i in (1, 3, 5)])
    written = (np.abs(pixels - paper) > 30).any(-1)
    assert written.any()
    assert not written[:, :2].any()
    assert not written[:, -2:].any()
    assert not written[-2:].any()
