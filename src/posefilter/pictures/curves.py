"""Draw numbers that change over the filter's iterations."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from posefilter.pictures.canvas import new_figure

_TITLES = {
    "ess": ("effective particles", "share of all"),
    "spread_m": ("spread of the centres", "mm"),
    "spread_rad": ("spread of the rotations", "degrees"),
    "spread_px": ("spread", "px"),
    "sigma_m": ("noise level", "mm"),
    "sigma_px": ("noise level", "px"),
    "best_log_likelihood": ("best log-likelihood", "nat"),
}
_LINE = "#2b6cb0"


def draw_health(curves: Mapping[str, Sequence[float]], images: int, title: str = "Filter health") -> Figure:
    """Draw how the filter fares over its iterations, one panel a quantity.

    curves: by name, one number an iteration, means over `images` images; units as the names' endings say.
    """
    figure = new_figure(1000, 560)
    columns = 3
    rows = -(-len(curves) // columns)
    spacing = {"left": 0.07, "right": 0.98, "bottom": 0.1, "top": 0.86, "hspace": 0.55, "wspace": 0.3}
    panels = figure.subplots(rows, columns, squeeze=False, gridspec_kw=spacing)
    for axes, (name, values) in zip(panels.flat, curves.items(), strict=False):
        label, unit = _TITLES.get(name, (name.replace("_", " "), ""))
        shown = np.asarray(values, float) * {"mm": 1000, "degrees": 180 / np.pi}.get(unit, 1)
        axes.plot(np.arange(len(shown)), shown, "o-", color=_LINE, markersize=3.5, linewidth=1.6)
        axes.set(title=label, ylabel=unit, xlabel="iteration")
        if name == "ess":
            axes.set_ylim(0, 1)
        elif len(shown) and np.isfinite(shown).all() and shown.min() >= 0 and not name.startswith("best"):
            axes.set_ylim(0, max(float(shown.max()) * 1.08, 1e-9))
        axes.xaxis.get_major_locator().set_params(integer=True)
        axes.grid(alpha=0.25)
        axes.spines[["top", "right"]].set_visible(False)
    for axes in panels.flat[len(curves) :]:
        axes.set_axis_off()
    figure.suptitle(f"{title}: means over {images} image{'s' * (images != 1)}", fontsize=14, x=0.02, ha="left")
    return figure
