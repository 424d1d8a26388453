"""Solution of the QP of a tick that never fails, because strict levels give way, the least important first."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from impact_posture.arrays import Array
from impact_posture.tsid.assembly import Assembly
from impact_posture.tsid.daqp_solver import DaqpSolver
from impact_posture.tsid.hierarchy import Level, lexicographic
from impact_posture.tsid.qp import EQUALITY, INEQUALITY, QP, Solved, Solver

# Miss that counts, relative to the terms of a row, because the hierarchy is solved to about six digits.
_OFF = 1e-6
# Pairs that are tried in order, relative to the terms of a row: a level that misses by more than the first number may
# stray by the second from the point it reached.  Without this room, the hard rows could not hold to the last digit.
_STRAY = ((_OFF, 1e-6), (0.0, 1e-6), (0.0, 1e-4), (0.0, 1e-2))
# Proximal weights that are tried in order, relative to the largest weight of the cost, with the number of steps each.
# The first weight that conditions the QP well enough changes its solution least.  The steps undo the change.
_PROXIMAL, _STEPS = (0.0, 1e-6, 1e-3, 1e3), 3
# Weight of the proximal-point iterations with which DAQP decides whether strict levels can hold.
_FLAT = 1e-6
# Largest violation of a bound in the end, times the scale of the numbers.
_EXACT = 1e-9
# Numbers are scaled below this, because the tolerances of the solver are absolute.
_LARGEST = 1e3


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
    """Answer to the QP of a tick.

    Attributes:
        solved: Solution; ``None`` if the relaxed QPs have none either.
        relaxed: Levels and limits that gave way, the most important first.
    """

    solved: Solved | None
    relaxed: tuple[Relaxed, ...] = ()


def solve(assembly: Assembly, solver: Solver, aside: Solver) -> Outcome:
    """Solve the QP of the assembly; if that fails, relax it lexicographically.

    Dynamics, control limits and friction always hold, because every state has an acceleration that satisfies them.
    The acceleration bounds of joint limits are opened only as far as these rows demand.  Then each level, from the
    most important down, holds if it can hold together with the levels above it.  Otherwise it comes as close as
    possible in the least-squares sense and stays there for the levels below.  Last, the cost is minimized with all
    of them held.

    Args:
        assembly: With :attr:`Assembly.qp` built.
        solver: Solver of the ticks, which keeps its active set.
        aside: Solver of the relaxed QPs, of the same size.
    """
    qp = assembly.rank.qp
    if assembly.rank.changed:
        solver.reset()
    solved = solver.solve(qp)
    if solved is None and not solver.infeasible:
        # The solver gave up from its warm start.  Try once without.
        solver.reset()
        solved = solver.solve(qp)
    if solved is None and qp.finite:
        # Rows that are nearly dependent look infeasible.  Proximal steps decide, in a new workspace, because they
        # start from its last answer.
        solved = DaqpSolver(qp.n, qp.m, proximal=_FLAT).solve(qp)
    if solved is not None or not qp.finite:
        return Outcome(solved)
    return _relax(assembly, aside)


def _relax(assembly: Assembly, solver: Solver) -> Outcome:
    nearest = lexicographic(_hierarchy(assembly))
    if nearest is None:
        return Outcome(None)
    for least, stray in _STRAY:
        solved = _minimize(_opened(assembly, nearest, least, stray), nearest, solver)
        if solved is not None:
            break
    else:
        # Only the cost has no minimum that the solver finds.  Without it there is an answer.
        solved = Solved(nearest, np.zeros(assembly.qp.n + assembly.qp.m), 0)
    return Outcome(solved, _gave_way(assembly, solved.z))


def _opened(assembly: Assembly, nearest: Array, least: float, stray: float) -> QP:
    """Return the QP in which rows that ``nearest`` misses by more than ``least`` stay there, up to ``stray``."""
    asked, limits = assembly.rank.qp, assembly.limits
    qp, values = asked.copy(), asked.values(nearest)[limits]
    room = np.where(_passed(asked, nearest, limits) > 0, stray * (1.0 + np.abs(values)), 0.0)
    qp.lower[limits] = np.minimum(qp.lower[limits], values) - room
    qp.upper[limits] = np.maximum(qp.upper[limits], values) + room
    for _, level in assembly.levels:
        rows = assembly.rank.rows(level, equations=True)
        off, size = _missed(assembly, nearest, rows)
        if float(np.max(np.abs(off), initial=0.0)) > least * size:
            at = qp.n + rows
            qp.sense[at] = INEQUALITY
            qp.lower[at] += off - stray * size
            qp.upper[at] += off + stray * size
    return qp


def missed(assembly: Assembly, z: Array, *, equations: bool) -> tuple[Relaxed, ...]:
    """Return the levels that miss, in their rows that are equations or in those that lack rank."""
    found = []
    for name, level in assembly.levels:
        off, size = _missed(assembly, z, assembly.rank.rows(level, equations))
        if float(np.max(np.abs(off), initial=0.0)) > _OFF * size:
            found.append(Relaxed(name, float(np.linalg.norm(off))))
    return tuple(found)


def _gave_way(assembly: Assembly, z: Array) -> tuple[Relaxed, ...]:
    limits = assembly.limits
    most = float(np.max(_passed(assembly.qp, z, limits), initial=0.0))
    opened = most > _OFF * (1.0 + float(np.max(np.abs(assembly.qp.values(z)[limits]))))
    return (*([Relaxed("joint limits", most)] if opened else []), *missed(assembly, z, equations=True))


def _missed(assembly: Assembly, z: Array, rows: NDArray[np.intp]) -> tuple[Array, float]:
    """Return ``Jν̇ − a`` of the given rows, and the size of its terms."""
    A = assembly.rank.qp.A[rows]
    return A @ z - assembly.rank.wanted[rows], 1.0 + float(np.max(np.abs(A) @ np.abs(z), initial=0.0))


def _hierarchy(assembly: Assembly) -> list[Level]:
    """Return the rows that always hold, the acceleration bounds, and the strict levels."""
    qp, limits, rank = assembly.rank.qp, assembly.limits, assembly.rank
    n = qp.n
    always = np.ones(qp.m, dtype=bool)
    for _, rows in assembly.levels:
        always[rows] = False
    always[limits[limits >= n] - n] = False
    lower, upper = qp.lower[n:], qp.upper[n:]
    levels = [rank.rows(level, equations=True) for _, level in assembly.levels]
    return [
        Level(qp.A[always], lower[always], upper[always]),
        Level(np.vstack([np.eye(n), qp.A])[limits], qp.lower[limits], qp.upper[limits]),
        *(Level(qp.A[rows], lower[rows], upper[rows]) for rows in levels),
    ]


def _passed(qp: QP, z: Array, limits: NDArray[np.intp]) -> Array:
    """Return the violation of the bounds of joint limits by ``z``; negative where they hold."""
    values = qp.values(z)[limits]
    return np.asarray(np.maximum(qp.lower[limits] - values, values - qp.upper[limits]))


def _minimize(qp: QP, start: Array, solver: Solver) -> Solved | None:
    """Return the minimum of the cost near ``start``, which satisfies all bounds to about six digits."""
    values = np.abs(np.concatenate([start, qp.A @ start]))
    scale = max(1.0, float(values.max()) / _LARGEST)
    lower, upper, start = qp.lower / scale, qp.upper / scale, start / scale
    weight = float(np.max(np.abs(np.diag(qp.H))))
    for share in _PROXIMAL:
        answer, center = None, start
        for _ in range(_STEPS if share else 1):
            # These QPs differ in their constraints, hence a warm start does not help.
            solver.reset()
            H, g = qp.H + share * weight * np.eye(qp.n), qp.g / scale - share * weight * center
            found = solver.solve(replace(qp, H=H, g=g, lower=lower, upper=upper))
            if found is None:
                break
            answer, center = found, found.z
        if answer is not None:
            z = _polished(qp, scale * answer.z, answer.multipliers)
            if qp.violation(z) <= _EXACT * scale:
                return Solved(z, scale * answer.multipliers, answer.iterations)
    return None


def _polished(qp: QP, z: Array, multipliers: Array) -> Array:
    """Return the point nearest to ``z`` at which equations and active bounds hold to the last digit."""
    above, below = (multipliers > 0) & (qp.sense != EQUALITY), (multipliers < 0) & (qp.sense != EQUALITY)
    held = above | below | (qp.sense == EQUALITY)
    off = np.where(below, qp.lower, qp.upper)[held] - qp.values(z)[held]
    return np.asarray(z + np.linalg.lstsq(np.vstack([np.eye(qp.n), qp.A])[held], off, rcond=1e-12)[0])
