"""Solution of the QP of a tick.  It never fails, because strict levels give way, the least important first."""

from __future__ import annotations

from dataclasses import dataclass

import daqp
import numpy as np

from impact_posture.system.arrays import Array, null_space
from impact_posture.tsid.assembly import Assembly
from impact_posture.tsid.qp.daqp_solver import SOLVED, DaqpSolver
from impact_posture.tsid.qp.hierarchy import Level, lexicographic
from impact_posture.tsid.qp.quadratic_program import EQUALITY, QP, Solved

# Least miss that counts, relative to the terms of a row.
_OFF = 1e-6
# Least miss at which a row is held, relative to the length of the row times the size of the point.
_MISSES = 1e-9
# Largest violation of a bound by the result, in the same units.
_ROUNDING = 1e-13
# Bound that DAQP takes for infinite, and its settings for the scaled program of the cost.
_FAR, _SETTINGS = 1e30, {"primal_tol": 1e-11, "sing_tol": 1e-13, "iter_limit": 1000}
# Least curvature of the cost, relative to the largest.
_FLATTEST = 1e-14
# Weight of the proximal-point iterations with which DAQP decides whether strict levels can hold.
_FLAT = 1e-6


@dataclass(frozen=True)
class Relaxed:
    """Level or limit that gave way in a tick.

    Attributes:
        level: Name of the level, or ``joint limits``.
        amount: ``‖Jν̇ − a‖`` of the level, or the largest violation of an acceleration bound.
    """

    level: str
    amount: float


@dataclass(frozen=True, eq=False)
class Outcome:
    """Solution, or ``None`` if the relaxed QPs have none, and what gave way, the most important level first."""

    solved: Solved | None
    relaxed: tuple[Relaxed, ...] = ()


def solve(assembly: Assembly, solver: DaqpSolver) -> Outcome:
    """Solve the QP of the assembly from the solver's active set; if this fails, relax it.

    Dynamics, control limits and friction always hold, because every state has an acceleration that satisfies them.
    The acceleration bounds of joint limits open only as far as these rows demand.  Then each level, from the most
    important down, holds if it can hold together with the levels above it.  Otherwise it comes as close as possible
    in the least-squares sense and stays there for the levels below.  Last, the cost decides what is still free.
    """
    qp = assembly.rank.qp
    if assembly.rank.changed:
        solver.reset()
    solved = solver.solve(qp)
    if solved is None and not solver.infeasible:
        # The solver gave up from its warm start, so try a cold start.
        solver.reset()
        solved = solver.solve(qp)
    if solved is None and qp.finite:
        # Nearly dependent rows look infeasible.  Proximal steps decide.  They start from the last answer of their
        # workspace, hence a new one.
        solved = DaqpSolver(qp.n, qp.m, proximal=_FLAT).solve(qp)
    if solved is not None or not qp.finite:
        return Outcome(solved)
    nearest = lexicographic(_hierarchy(assembly), assembly.rank.units)
    if nearest is None:
        return Outcome(None)
    solved = _cheapest(assembly.rank.qp, assembly.rank.units, nearest)
    return Outcome(solved, _gave_way(assembly, solved.z))


def _cheapest(qp: QP, units: Array, nearest: Array) -> Solved:
    """Minimize the cost in the directions that a lexicographic answer leaves free.

    Equations and missed rows keep their values, so the cost moves in their null space: ``z = nearest + W y``, with a
    basis ``W`` in which the cost is a sum of squares.  The other bounds hold.  If they leave only rounding, return
    ``nearest``.
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
    # The held rows determine a row that moves along the free directions by rounding only.
    sees = np.linalg.norm(rows @ free, axis=1) > _MISSES
    bound = np.flatnonzero(~held & sees & (np.isfinite(lower) | np.isfinite(upper)))
    seen, g = rows[bound] @ W, W.T @ (units * (qp.H @ nearest + qp.g)) / (size * largest)
    reach, senses = np.linalg.norm(seen, axis=1), np.zeros(bound.size, dtype=np.int32)
    ends = (np.clip(side[bound] / reach, -_FAR, _FAR) for side in (upper, lower))
    y, _, flag, info = daqp.solve(np.eye(g.size), g, seen / reach[:, None], *ends, senses, **_SETTINGS)
    if flag not in SOLVED:
        return only
    # A correction makes held rows and active bounds exact to the last digit.
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
    """Return the levels that miss in their equations, or with ``equations=False`` in their rows that lack rank."""
    levels = []
    for name, level in assembly.levels:
        rows = assembly.rank.rows(level, equations)
        A = assembly.rank.qp.A[rows]
        off, size = A @ z - assembly.rank.wanted[rows], 1.0 + float(np.max(np.abs(A) @ np.abs(z), initial=0.0))
        if float(np.max(np.abs(off), initial=0.0)) > _OFF * size:
            levels.append(Relaxed(name, float(np.linalg.norm(off))))
    return tuple(levels)


def _gave_way(assembly: Assembly, z: Array) -> tuple[Relaxed, ...]:
    qp, limits = assembly.qp, assembly.limits
    values = qp.values(z)[limits]
    most = float(np.max(np.maximum(qp.lower[limits] - values, values - qp.upper[limits]), initial=0.0))
    opened = most > _OFF * (1.0 + float(np.max(np.abs(values))))
    return (*([Relaxed("joint limits", most)] if opened else []), *missed(assembly, z, equations=True))


def _hierarchy(assembly: Assembly) -> list[Level]:
    """Return the hard rows, the acceleration bounds, and the strict levels."""
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
