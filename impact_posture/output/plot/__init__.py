"""Figures of results and of simulated runs.

:func:`draw_all` writes the figures of a result.  :func:`figures_of_run`, :func:`figures_of_comparison` and
:func:`bars_figure` return the figures of simulated runs.

A function raises :class:`~impact_posture.errors.InputError` if the data for the figure are missing, or if the runs
belong to different scenarios or robots.  The package does not change the global state of pyplot and shows no window.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable
from pathlib import Path

from matplotlib.figure import Figure

from impact_posture.errors import NameNotFound
from impact_posture.output.picture_formats import DEFAULT_FORMATS, FORMATS, check_formats
from impact_posture.output.plot import (
    classical_figure,
    ellipsoid_figure,
    jump_figure,
    path_figures,
    self_motion_figure,
)
from impact_posture.output.plot.bars import Bar, bars_figure
from impact_posture.output.plot.postures_figure import postures_figure
from impact_posture.output.plot.result_view import ResultView, TradeOffData
from impact_posture.output.plot.run_figures import figures_of_comparison, figures_of_run
from impact_posture.output.plot.run_view import RunView
from impact_posture.output.plot.style import save, save_all
from impact_posture.system.output_folder import added_files

__all__ = [
    "FIGURES",
    "FORMATS",
    "Bar",
    "FigureNotFound",
    "ResultView",
    "RunView",
    "TradeOffData",
    "bars_figure",
    "draw_all",
    "draw_into",
    "drawable",
    "figures_of_comparison",
    "figures_of_run",
    "save",
    "save_all",
]

# The figures that take longest come first, so that parallel processes end at about the same time.
FIGURES: dict[str, Callable[[ResultView], Figure]] = {
    "jump": jump_figure.jump_figure,
    "ellipsoid": ellipsoid_figure.ellipsoid_figure,
    "classical": classical_figure.classical_figure,
    "postures": postures_figure,
    "tradeoff": path_figures.tradeoff_figure,
    "path": path_figures.motion_figure,
    "self_motion": self_motion_figure.self_motion_figure,
    "nullspace": path_figures.path_figure,
}


def drawable(view: ResultView) -> list[str]:
    """Return the names of the figures for which the view has data."""
    lacking = {
        "nullspace": view.path is None,
        "tradeoff": view.tradeoff is None,
        "self_motion": view.self_motion is None,
        "path": view.motion is None or view.motion.use is None,
    }
    return [name for name in FIGURES if not lacking.get(name)]


class FigureNotFound(NameNotFound):
    """The name of a figure is unknown."""

    kind = "figure"


def draw_all(
    view: ResultView, out: Path, formats: Iterable[str] = DEFAULT_FORMATS, only: Collection[str] | None = None
) -> list[Path]:
    """Write the figures of ``view`` into ``out`` as ``<name>.<format>``; return the paths.

    Args:
        view: Result to draw.
        out: Folder, which is created if it is missing.  Files with the same name are replaced.
        formats: File formats: ``png``, ``svg`` or ``pdf``.
        only: Names of the figures to draw, from :data:`FIGURES`; ``None`` for all :func:`drawable` figures.

    Raises:
        FigureNotFound: A name in ``only`` is unknown.
        InputError: A format is unknown, or the view has no data for a figure in ``only``.
        OutputError: The folder or a file cannot be written.
    """
    wanted = check_formats(formats)
    names = drawable(view) if only is None else list(dict.fromkeys(only))
    for name in names:
        if name not in FIGURES:
            raise FigureNotFound(name, FIGURES, where="plot")
    return [path for name in names for path in save(FIGURES[name](view), out, name, wanted)]


def draw_into(
    view: ResultView, out: Path, formats: Iterable[str], only: Collection[str] | None = None, *, force: bool = False
) -> list[Path]:
    """Write figures as :func:`draw_all`, but replace files of the user only if ``force`` is true.

    Raises:
        OutputError: A file of the user has the name of a figure, or the folder cannot be written.
        InputError: As for :func:`draw_all`.
    """
    with added_files(out, force=force) as beside:
        written = draw_all(view, beside, formats, only)
    return [out / path.name for path in written]
