"""Figure ``nullspace``: the impact quantities along the null-space path that the optimizer used."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter

from impact_posture.errors import InputError
from impact_posture.plot.shapes import Vector
from impact_posture.plot.style import BLUE, GRAY, GREEN, INK, PURPLE, VERMILLION, framed, style
from impact_posture.plot.view import PathData, ResultView, number

# A spread above this is drawn on a log axis.
_SPREAD = 30.0
_LINES: dict[str, dict[str, Any]] = {
    "H": {"color": BLUE, "linestyle": "-", "linewidth": 1.9, "marker": "o"},
    "G": {"color": GREEN, "linestyle": (0, (1, 1)), "linewidth": 1.5, "marker": "^"},
    "V": {"color": VERMILLION, "linestyle": (0, (5, 2)), "linewidth": 1.5, "marker": "s"},
    "S": {"color": PURPLE, "linestyle": (0, (5, 1.5, 1, 1.5)), "linewidth": 1.5, "marker": "D"},
}


def path_figure(view: ResultView) -> Figure:
    """Draw H, G, V and S along ``view.path``, each divided by its value at the start; log axis if they spread widely.

    Raises:
        InputError: The view has no path, or its arrays do not fit together.
    """
    path = _checked(view.path)
    curves = {name: normalized(path, name) for name in _LINES}
    drawn = {name: curve for name, curve in curves.items() if curve is not None}
    values = np.concatenate([curve[np.isfinite(curve)] for curve in drawn.values()]) if drawn else np.ones(1)
    positive = values[values > 0]
    log = bool(positive.size) and float(positive.max() / positive.min()) > _SPREAD
    with style():
        figure, body = framed(view, 3.1, _notes(view, drawn))
        axes = body.subplots()
        for name, look in _LINES.items():
            if name in drawn:
                curve = np.where(drawn[name] > 0, drawn[name], np.nan) if log else drawn[name]
                every = max(len(path.s) // 10, 1)
                at_start = number(float(getattr(path, name)[_first(path, name)]))
                axes.plot(path.s, curve, label=f"{name} / {at_start}", markevery=every, markersize=3.5, **look)
        axes.axhline(1.0, color=GRAY, linewidth=0.6, zorder=0)
        _mark(axes, path)
        if log:
            axes.set_yscale("log")
            axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: number(value)))
            axes.yaxis.set_minor_formatter(NullFormatter())
        else:
            axes.set_ylim(0.0, 1.12 * max(float(values.max()), 1.0))
        axes.grid(True)
        axes.set_xlabel("path length in the null space, ∫‖dν‖  [rad, mixed with m]")
        axes.set_ylabel("value / value at start" + ("  (log)" if log else ""))
        if drawn:
            body.legend(loc="outside right center", title="value / start", title_fontsize=7.5, handlelength=3.2)
    return figure


def normalized(path: PathData, name: str) -> Vector | None:
    """A quantity over its value at the start (its first value where it has none there); ``None`` where that is 0."""
    values = np.asarray(getattr(path, name), dtype=float)
    first = _first(path, name)
    if first is None or not values[first] > 0:
        return None
    return np.asarray(values / values[first])


def _first(path: PathData, name: str) -> int | None:
    values = np.asarray(getattr(path, name), dtype=float)
    start = range(len(values))[path.start]
    if np.isfinite(values[start]):
        return start
    finite = np.flatnonzero(np.isfinite(values))
    return int(finite[np.argmin(np.abs(finite - start))]) if finite.size else None


def _checked(path: PathData | None) -> PathData:
    if path is None:
        raise InputError("there is no path to draw", where="figure nullspace", mend="give ResultView.path")
    sizes = {name: np.shape(getattr(path, name)) for name in ("s", *_LINES)}
    count = len(path.s)
    if count < 2 or set(sizes.values()) != {(count,)}:
        raise InputError(
            f"the path's arrays have shapes {', '.join(f'{k} {v}' for k, v in sizes.items())}",
            where="figure nullspace",
            mend="give at least two postures and one number of each quantity for each",
        )
    return path


def _mark(axes: Any, path: PathData) -> None:
    """Upright lines at the start and the optimum, named above the axes."""
    for word, index, align in (("start", path.start, "left"), ("optimum", path.optimum, "right")):
        axes.axvline(path.s[index], color=INK, linewidth=0.8, linestyle=":", zorder=1)
        axes.annotate(
            word, (path.s[index], 1.0), (0, 3), xycoords=("data", "axes fraction"), textcoords="offset points",
            ha="center" if 0.05 < _share(path, index) < 0.95 else align, fontsize=7.5,
        )  # fmt: skip


def _share(path: PathData, index: int) -> float:
    length = float(path.s[-1] - path.s[0])
    return float(path.s[index] - path.s[0]) / length if length > 0 else 0.0


def _notes(view: ResultView, drawn: dict[str, Vector]) -> list[str]:
    missing = [name for name in _LINES if name not in drawn]
    notes = "Each curve is divided by its value at the start; for H, V and S less is better. G is 1/effective mass."
    if "S" in missing:
        notes += " S is undefined along the path."
    others = [name for name in missing if name != "S"]
    return [notes + (f" {', '.join(others)} start at zero and cannot be divided by it." if others else "")]
