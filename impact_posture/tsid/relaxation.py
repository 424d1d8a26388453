"""Solving a tick's QP so that it never fails: strict levels give way, the least important first."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from impact_posture.tsid.assembly import Assembly
from impact_posture.tsid.hierarchy import Level, lexicographic
from impact_posture.tsid.qp import EQUALITY, INEQUALITY, QP, Solved, Solver

Array = NDArray[np.float64]

# What counts as not reached, relative to the numbers that a row adds up: the hierarchy is solved to about six digits.
_OFF = 1e-6
# Tried one after the other, both likewise: what misses by more than the first may stray from what was reached by the
# second.  Held to the last digit it would leave no room to satisfy to the last digit what always holds.
_STRAY = ((_OFF, 1e-6), (0.0, 1e-6), (0.0, 1e-4), (0.0, 1e-2))
# Proximal weights that are tried one after the other, relative to the largest in the cost: the first that makes the
# program well enough conditioned for the solver changes its solution the least.  Steps with each bring it back.
_PROXIMAL, _STEPS = (0.0, 1e-6, 1e-3, 1e3), 3
# By how much a bound may be passed in the end, times how far numbers were scaled down.
_EXACT = 1e-9
# Numbers are brought below this: the solver's tolerances are absolute.
_LARGEST = 1e3


@dataclass(frozen=True)
class Relaxed:
    """What gave way in a tick.

    Attributes:
        level: Name of the level, or ``joint limits``.
        amount: ``‖Jν̇ − a‖`` of the level; for joint limits the largest passing of an acceleration bound.
    """

    level: str
    amount: float


@dataclass(frozen=True, eq=False)
class Outcome:
    """The answer to a tick's QP.

    Attributes:
        solved: ``None`` where even the relaxed programs have none.
        relaxed: What gave way, the most important first; empty if nothing did.
    """

    solved: Solved | None
    relaxed: tuple[Relaxed, ...] = ()


def solve(assembly: Assembly, solver: Solver, aside: Solver) -> Outcome:
    """Solve the assembly's QP; where that fails, lexicographically relaxed.

    Dynamics, control limits and friction always hold: in every state some acceleration satisfies them.  The
    acceleration bounds of joint limits are opened only where they cannot hold beside those, and as little as that
    takes.  Then, from the most important level down: a level that can hold beside those above it holds; one that
    cannot is brought as close as it comes, in the least-squares sense, and stays there for those below.  Last, the
    cost is minimized with all of that held.

    Args:
        assembly: With :attr:`Assembly.qp` built.
        solver: The tick's own; keeps its active set.
        aside: For the relaxed programs, of the same size.
    """
    qp = assembly.rank.qp
    if assembly.rank.changed:
        solver.reset()
    solved = solver.solve(qp)
    if solved is None and not solver.infeasible:
        # Gave up from its warm start: once more without.
        solver.reset()
        solved = solver.solve(qp)
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
        # What leads nowhere is the cost: without it there is an answer.
        solved = Solved(nearest, np.zeros(assembly.qp.n + assembly.qp.m), 0)
    return Outcome(solved, _gave_way(assembly, solved.z))


def _opened(assembly: Assembly, nearest: Array, least: float, stray: float) -> QP:
    """The tick's program with what ``nearest`` misses by more than ``least`` held where it is, to ``stray``."""
    asked, limits = assembly.rank.qp, assembly.limits
    qp, values = asked.copy(), nearest[limits]
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
    """By how much the levels miss, in those rows that are equations or in those that lack rank."""
    found = []
    for name, level in assembly.levels:
        off, size = _missed(assembly, z, assembly.rank.rows(level, equations))
        if float(np.max(np.abs(off), initial=0.0)) > _OFF * size:
            found.append(Relaxed(name, float(np.linalg.norm(off))))
    return tuple(found)


def _gave_way(assembly: Assembly, z: Array) -> tuple[Relaxed, ...]:
    limits = assembly.limits
    most = float(np.max(_passed(assembly.qp, z, limits), initial=0.0))
    opened = most > _OFF * (1.0 + float(np.max(np.abs(z[limits]))))
    return (*([Relaxed("joint limits", most)] if opened else []), *missed(assembly, z, equations=True))


def _missed(assembly: Assembly, z: Array, rows: NDArray[np.intp]) -> tuple[Array, float]:
    """``Jν̇ − a`` of some rows, and how large the numbers are that it is the difference of."""
    A = assembly.rank.qp.A[rows]
    return A @ z - assembly.rank.wanted[rows], 1.0 + float(np.max(np.abs(A) @ np.abs(z), initial=0.0))


def _hierarchy(assembly: Assembly) -> list[Level]:
    """What always holds; the acceleration bounds; the strict levels."""
    qp, limits, rank = assembly.rank.qp, assembly.limits, assembly.rank
    n = qp.n
    always = np.ones(qp.m, dtype=bool)
    for _, rows in assembly.levels:
        always[rows] = False
    lower, upper = qp.lower[n:], qp.upper[n:]
    levels = [rank.rows(level, equations=True) for _, level in assembly.levels]
    return [
        Level(qp.A[always], lower[always], upper[always]),
        Level(np.eye(n)[limits], qp.lower[limits], qp.upper[limits]),
        *(Level(qp.A[rows], lower[rows], upper[rows]) for rows in levels),
    ]


def _passed(qp: QP, z: Array, limits: NDArray[np.intp]) -> Array:
    """By how much ``z`` passes the bounds of joint limits; negative where it keeps them."""
    return np.asarray(np.maximum(qp.lower[limits] - z[limits], z[limits] - qp.upper[limits]))


def _minimize(qp: QP, start: Array, solver: Solver) -> Solved | None:
    """The cost's minimum near ``start``, which satisfies all bounds to about six digits."""
    values = np.abs(np.concatenate([start, qp.A @ start]))
    scale = max(1.0, float(values.max()) / _LARGEST)
    lower, upper, start = qp.lower / scale, qp.upper / scale, start / scale
    weight = float(np.max(np.abs(np.diag(qp.H))))
    for share in _PROXIMAL:
        answer, center = None, start
        for _ in range(_STEPS if share else 1):
            # Neighbors here differ in what is bound at all: what the one before left helps nothing.
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
    """``z`` moved, by as little as it takes, to where equations and active bounds hold to the last digit."""
    above, below = (multipliers > 0) & (qp.sense != EQUALITY), (multipliers < 0) & (qp.sense != EQUALITY)
    held = above | below | (qp.sense == EQUALITY)
    off = np.where(below, qp.lower, qp.upper)[held] - qp.values(z)[held]
    return np.asarray(z + np.linalg.lstsq(np.vstack([np.eye(qp.n), qp.A])[held], off, rcond=1e-12)[0])
