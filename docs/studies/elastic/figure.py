"""Figure of the study of elastic joints: errors of the three models as functions of x."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from docs.studies.core import ROOT
from impact_posture.output.plot.style import BLUE, GRAY, GREEN, PALE, VERMILLION, WIDTH

if TYPE_CHECKING:
    from docs.studies.elastic.study import Row

PICTURE = ROOT / "docs" / "images" / "elastic.png"
# Relative errors below this value are drawn at this value.
_LEAST = 1e-4
_MODELS = {"elastic": (BLUE, "o"), "link": (VERMILLION, "^"), "reflected": (GREEN, "s")}


def figure(rows: Sequence[Row]) -> Figure:
    """Draw one panel for the peak link velocity and one for the force.  Marks are impacts, lines are medians."""
    drawing = Figure(figsize=(WIDTH, 3.4), layout="constrained")
    FigureCanvasAgg(drawing)
    x = np.array([row.x for row in rows])
    bins = np.geomspace(x.min(), x.max() * (1 + 1e-9), 9)
    place = np.digitize(x, bins)
    for axes, which, title in zip(
        drawing.subplots(1, 2, sharey=True),
        ("error", "force_error"),
        ("peak link velocity", "peak force"),
        strict=True,
    ):
        for model, (color, mark) in _MODELS.items():
            errors = np.maximum([getattr(row, which)[model] for row in rows], _LEAST)
            axes.plot(x, 100 * errors, mark, color=color, markersize=2.2, alpha=0.3, markeredgewidth=0)
            full = [k for k in range(1, len(bins)) if (place == k).any()]
            middle = [np.exp(np.log(x[place == k]).mean()) for k in full]
            medians = [100 * np.median(errors[place == k]) for k in full]
            axes.plot(middle, medians, "-" + mark, color=color, linewidth=1.6, markersize=4, label=model)
        for edge in (0.2, 0.75):
            axes.axvline(edge, color=GRAY, linewidth=0.8, linestyle=(0, (3, 2)))
        axes.set(xscale="log", yscale="log", title=title, xlabel=r"$x = T\sqrt{G/C}$")
        ticks = [0.05, 0.1, 0.2, 0.5, 1, 2]
        axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
        axes.minorticks_off()
        axes.grid(True, linewidth=0.4, color=PALE)
    drawing.axes[0].set_ylabel("error against MuJoCo, %")
    drawing.axes[0].set_yticks([0.01, 0.1, 1, 10, 100], ["0.01", "0.1", "1", "10", "100"])
    drawing.legend(*drawing.axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=3, frameon=False)
    return drawing


def draw(rows: Sequence[Row]) -> None:
    figure(rows).savefig(PICTURE, dpi=150)
