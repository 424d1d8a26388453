"""Solution of the QP of a tick.  If the strict levels are infeasible, the least important level is relaxed first."""

from __future__ import annotations

from dataclasses import dataclass

import daqp
import numpy as np

from impact_posture.system.arrays import Array, null_space
from impact_posture.tsid.assembly import Assembly
from impact_posture.tsid.qp.daqp_solver import SETTINGS, SOLVED, DaqpSolver
from impact_posture.tsid.qp.hierarchy import Level, lexicographic
from impact_posture.tsid.qp.quadratic_program import EQUALITY, QP, Solved

# A row counts as satisfied if its error is below this fraction of the sum of its absolute terms.
OFF = 1e-6
# A row that violates a bound by more than this keeps its value while the cost is minimized.  The violation is
# relative to the norm of the row times the norm of z.
_MISSES = 1e-9
# Largest violation of a bound by a result, relative to the norm of the row times the norm of z.
_ROUNDING = 1e-13
# ``_FAR`` is a bound that DAQP treats as infinite.  ``_SETTINGS`` are the DAQP settings of :func:`_cheapest`.
_FAR, _SETTINGS = 1e30, SETTINGS | {"primal_tol": 1e-11}
# Curvatures of the cost below this fraction of the largest curvature are raised to this fraction.
_FLATTEST = 1e-14
# Weight of the proximal-point term with which DAQP checks whether the strict priority levels are feasible.
_FLAT = 1e-6


@dataclass(frozen=True)
class Relaxed:
    """Strict level or limit that did not hold in a tick.

    Attributes:
        level: Name of the level, or ``joint limits``.
        amount: ``‖Jν̇ − a‖`` of the level, or the largest violation of an acceleration bound.
    """

    level: str
    amount: float


@dataclass(frozen=True, eq=False)
class Outcome:
    """Result of a tick's QP.

    Attributes:
        solved: Solution; ``None`` if the relaxed QPs have no solution either.
        relaxed: Strict levels and limits that do not hold, the most important first.
    """

    solved: Solved | None
    relaxed: tuple[Relaxed, ...] = ()


def solve(assembly: Assembly, solver: DaqpSolver) -> Outcome:
    """Solve the QP of the assembly, starting from the solver's active set.  If the solver fails, solve a relaxed QP.

    Dynamics, control limits and friction always hold, because every state has an acceleration that satisfies them.
    The acceleration bounds of joint limits are exceeded only as far as these hard rows require.  The strict levels
    follow, the most important first.  The error of a level is minimized by least squares, and less important levels
    must not change this error.  Last, the cost determines the accelerations that are still free.
    """
    qp = assembly.rank.qp
    if assembly.rank.changed:
        solver.reset()
    solved = solver.solve(qp)
    if solved is None and not solver.infeasible:
        # The solver failed from the active set of the last tick, so start without an active set.
        solver.reset()
        solved = solver.solve(qp)
    if solved is None and qp.finite:
        # DAQP can report nearly dependent rows as infeasible, so solve again with proximal iterations.  Use a new
        # solver, because proximal iterations would start from the last answer in the old workspace.
        solved = DaqpSolver(qp.n, qp.m, proximal=_FLAT).solve(qp)
    if solved is not None or not qp.finite:
        return Outcome(solved)
    nearest = lexicographic(_hierarchy(assembly), assembly.rank.units)
    if nearest is None:
        return Outcome(None)
    solved = _cheapest(assembly.rank.qp, assembly.rank.units, nearest)
    return Outcome(solved, _gave_way(assembly, solved.z))


def _cheapest(qp: QP, units: Array, nearest: Array) -> Solved:
    """Minimize the cost without changing the errors of the lexicographic answer ``nearest``.

    Equations keep their values, and so do rows that violate their bounds.  The cost is therefore minimized in the
    null space of all these rows: ``z = nearest + W y``.  In the basis ``W``, the cost is a sum of squares.  All other
    bounds hold.  Return ``nearest`` if the null space is empty or the solver failed.
    """
    values, rows = qp.values(nearest), np.vstack([np.eye(qp.n), qp.A]) * units
    size, lengths = max(1.0, float(np.max(np.abs(nearest / units)))), np.linalg.norm(rows, axis=1)
    lengths[lengths == 0.0] = 1.0
    rows /= lengths[:, None]
    lower, upper = ((bounds - values) / (lengths * size) for bounds in (qp.lower, qp.upper))
    held = (qp.sense == EQUALITY) | (np.maximum(lower, -upper) > _MISSES)
    free, only = null_space(rows[held], _MISSES), Solved(nearest, np.zeros(qp.n + qp.m), 0)
    if not free.shape[1]:
        return only
    lower, upper = np.minimum(lower, 0.0), np.maximum(upper, 0.0)
    curvatures, axes = np.linalg.eigh((free.T * units) @ qp.H @ (units[:, None] * free))
    largest = float(curvatures[-1])
    W = free @ (axes / np.sqrt(np.maximum(curvatures / largest, _FLATTEST)))
    # Leave out the bounds of rows that change only by rounding errors within the null space.
    sees = np.linalg.norm(rows @ free, axis=1) > _MISSES
    bound = np.flatnonzero(~held & sees & (np.isfinite(lower) | np.isfinite(upper)))
    seen, g = rows[bound] @ W, W.T @ (units * (qp.H @ nearest + qp.g)) / (size * largest)
    reach, senses = np.linalg.norm(seen, axis=1), np.zeros(bound.size, dtype=np.int32)
    ends = (np.clip(side[bound] / reach, -_FAR, _FAR) for side in (upper, lower))
    y, _, flag, info = daqp.solve(np.eye(g.size), g, seen / reach[:, None], *ends, senses, **_SETTINGS)
    if flag not in SOLVED:
        return only
    # Correct the step, so that held rows and active bounds are exact to the last digit.
    step, multipliers = W @ y, np.zeros(qp.n + qp.m)
    multipliers[bound] = largest * size / (lengths[bound] * reach) * info["lam"]
    active = multipliers != 0.0
    aim = np.where(multipliers > 0.0, upper, np.where(active, lower, 0.0)) - rows @ step
    exact = held | active
    step += np.linalg.lstsq(rows[exact], aim[exact], rcond=1e-12)[0]
    moved = rows @ step
    if not (np.abs(moved - np.clip(moved, lower, upper))[~held] <= _ROUNDING).all():
        return only
    return Solved(nearest + size * units * step, multipliers, int(info["iterations"]))


def missed(assembly: Assembly, z: Array, *, equations: bool) -> tuple[Relaxed, ...]:
    """Return the strict levels that ``z`` violates; ``equations`` selects their equations or their other rows."""
    levels = []
    for name, level in assembly.levels:
        rows = assembly.rank.rows(level, equations)
        A = assembly.rank.qp.A[rows]
        off, size = A @ z - assembly.rank.wanted[rows], 1.0 + float(np.max(np.abs(A) @ np.abs(z), initial=0.0))
        if float(np.max(np.abs(off), initial=0.0)) > OFF * size:
            levels.append(Relaxed(name, float(np.linalg.norm(off))))
    return tuple(levels)


def _gave_way(assembly: Assembly, z: Array) -> tuple[Relaxed, ...]:
    qp, limits = assembly.qp, assembly.limits
    values = qp.values(z)[limits]
    most = float(np.max(np.maximum(qp.lower[limits] - values, values - qp.upper[limits]), initial=0.0))
    opened = most > OFF * (1.0 + float(np.max(np.abs(values))))
    return (*([Relaxed("joint limits", most)] if opened else []), *missed(assembly, z, equations=True))


def _hierarchy(assembly: Assembly) -> list[Level]:
    """Return the levels to relax, in this order: hard rows, acceleration bounds, strict levels."""
    qp, limits, n = assembly.rank.qp, assembly.limits, assembly.qp.n
    always = np.ones(qp.m, dtype=bool)
    for _, rows in assembly.levels:
        always[rows] = False
    always[limits[limits >= n] - n] = False
    lower, upper = qp.lower[n:], qp.upper[n:]
    levels = [assembly.rank.rows(level, equations=True) for _, level in assembly.levels]
    return [
        Level(qp.A[always], lower[always], upper[always]),
        Level(np.vstack([np.eye(n), qp.A])[limits], qp.lower[limits], qp.upper[limits]),
        *(Level(qp.A[rows], lower[rows], upper[rows]) for rows in levels),
    ]
