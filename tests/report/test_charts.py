"""Charts of a report: nothing that is written runs over their edges."""

from io import BytesIO

import numpy as np
import pytest
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from PIL import Image

from posefilter.report.blocks import name_chart
from posefilter.report.charts import (
    DARK,
    LIGHT,
    Line,
    Panel,
    Theme,
    distinguish,
    draw_chart,
    draw_panel,
)


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


def test_long_names_keep_what_tells_them_apart() -> None:
    runs = [f"outputs/runs/2026-01-0{n}_10-00/checkpoints/best.ckpt" for n in (1, 2)]
    assert distinguish(runs) == ["…2026-01-01_10-00…", "…2026-01-02_10-00…"]
    settings = [f"model.net.width={n} filter.particles=100" for n in (16, 32)]
    assert distinguish(settings) == ["…width=16…", "…width=32…"]
    assert distinguish(["short", "other"]) == ["short", "other"]
    assert distinguish(["one long name of a single line"]) == ["one long name of a si…"]


@pytest.mark.parametrize("label", ["_old", "a$^$b", "$x$"])
def test_odd_names_are_written_as_they_are(label: str) -> None:
    lines = [Line(one, [0.0, 1.0], [1.0, 2.0]) for one in (label, "other")]
    odd, plain = (
        draw_chart(Panel("ADD AUC", "time [s]", "", some), LIGHT)
        for some in (lines, [Line("other", [0.0, 1.0], [1.0, 2.0])] * 2)
    )
    assert odd != plain


def test_a_charts_file_has_a_name_that_file_systems_take() -> None:
    long = [Panel(f"ADD of {'é' * 120}{n}", f"ADD of {'a' * 119} [mm]", "", []) for n in (1, 2)]
    names = [name_chart(panel) for panel in long]
    assert names[0] != names[1]
    assert max(len(name.encode()) for name in names) < 200
    assert name_chart(Panel("ADD AUC", "steps", "%", [])) == "add-auc-steps"


@pytest.mark.parametrize("theme", [LIGHT, DARK])
def test_the_small_ticks_of_a_logarithmic_axis_are_plain_numbers_in_the_pages_ink(
    theme: Theme,
) -> None:
    """An axis of less than a power of ten has no others."""
    figure = Figure()
    axes = figure.subplots()
    line = Line("an image", [2.5, 7.0], [300.0, 900.0])
    panel = Panel("ADD", "ADD [mm]", "mm", [line], joined=False, log_x=True, log_y=True)
    draw_panel(axes, panel, theme)
    figure.canvas.draw()
    for axis, expected in ((axes.xaxis, "3"), (axes.yaxis, "400")):
        labels = [label for label in axis.get_minorticklabels() if label.get_text()]
        assert expected in [label.get_text() for label in labels]
        assert all("10^" not in label.get_text() for label in labels)
        assert {to_hex(label.get_color()) for label in labels} == {theme.ink}
