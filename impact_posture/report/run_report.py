"""The scene of simulated runs: the robot over time, with the impacts millisecond by millisecond."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from impact_posture.dynamics.numeric import Numeric
from impact_posture.errors import InputError
from impact_posture.impact.contact import point_on
from impact_posture.impact.objective import ImpactObjective
from impact_posture.plot.run_view import RunView, Span
from impact_posture.report.scene import Scene, Track, impact_curves
from impact_posture.report.shapes import draw_robot
from impact_posture.simulation.series import Series as RunSeries
from impact_posture.simulation.series import Window

# Time between frames in impact windows and elsewhere, s.
FINE, COARSE = 0.001, 0.025
# No position of a robot that is under control is larger, m or rad.
_AWAY = 1e3


def thin(series: RunSeries, windows: Iterable[Window | Span]) -> RunSeries:
    """Return the ticks of a run that a report shows; a force is the largest since the last of them.

    The ticks end where the state runs away.

    Args:
        series: All ticks.
        windows: Windows of the run, of which those of kind ``impact`` are shown finely.
    """
    gone = np.flatnonzero(~(np.abs(series.q).max(axis=1) < _AWAY))
    t = series.t[: gone[0]] if len(gone) else series.t
    if len(t) < 2:
        raise InputError("runs away at once", where="report", hint="there is nothing to show")
    step = float(t[1] - t[0])
    inside = np.zeros(len(t), dtype=bool)
    for window in windows:
        if window.kind == "impact":
            inside |= (t >= window.begin - FINE) & (t <= window.end)
    # Counted in ticks, because a sum of times is not exact.
    each = np.where(inside, max(round(FINE / step), 1), max(round(COARSE / step), 1))
    kept = np.flatnonzero((np.arange(len(t)) % each == 0) | (np.arange(len(t)) == len(t) - 1))
    size = np.linalg.norm(series.force[: len(t)], axis=1)
    begins = np.concatenate([[0], kept[:-1] + 1])
    strongest = [a + int(np.argmax(size[a : b + 1])) for a, b in zip(begins, kept, strict=True)]
    peaks = np.array([series.peak[a : b + 1].max() for a, b in zip(begins, kept, strict=True)])
    columns = {name: column[kept] for name, column in vars(series).items()}
    return RunSeries(**columns | {"force": series.force[strongest], "peak": peaks})


def run_scene(runs: Sequence[tuple[RunView, ImpactObjective]], *, meshes: bool = False) -> Scene:
    """Return the scene of runs of one scenario.

    Args:
        runs: The runs, with the ticks of :func:`thin`, and the impact that each is about.
        meshes: Pass on the meshes of the user's own URDF, too.
    """
    first, objective = runs[0]
    planes = []
    if first.surface is not None:
        planes.append(("surface", first.surface, np.array(first.contact.normal)))
    if first.supports:
        numeric = Numeric(first.robot.model).at(first.q[0])
        feet = [numeric.placement(point_on(first.robot, s.frame, s.offset)).translation for s in first.supports]
        planes.append(("ground", min(feet, key=lambda foot: float(foot[2])), np.array([0.0, 0.0, 1.0])))
    tracks = tuple(_track(view, one) for view, one in runs)
    return Scene(draw_robot(first.robot, meshes), objective, tracks, tuple(planes), (), False)


def _track(view: RunView, objective: ImpactObjective) -> Track:
    jumps = np.zeros_like(view.v)
    for window in view.impacts:
        within = (view.t >= window.begin) & (view.t <= window.end)
        if within.any():
            jumps[within] = view.v[within] - view.v[max(int(np.argmax(within)) - 1, 0)]
    found = [objective.oracle.quantities(q) for q in view.q]
    force = ("largest normal force", "N", view.peak)
    curves = (*impact_curves(found, objective.metric), force)
    return Track(view.name, view.t, "s", view.q, [found], jumps, curves, view.force)
