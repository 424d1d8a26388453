"""Find the constraints that conflict in an infeasible problem, by relaxing each constraint at a price."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import chain, islice

import casadi as ca
import numpy as np

from impact_posture.dynamics.chart import Chart
from impact_posture.dynamics.numeric import Numeric
from impact_posture.posture.manifold.feasible_start import FEASIBLE, Projector, random_posture
from impact_posture.posture.program.constrained_problem import ConstrainedProblem
from impact_posture.posture.program.ipopt import IPOPT_OPTIONS, run_solver
from impact_posture.posture.program.program_rows import Derivatives, ProgramRows, joined
from impact_posture.system.arrays import Array

# A constraint with a violation below this (m, rad) is satisfied.
_KEPT = 1e-6
# Price of a meter of slack beside that of a violated row: where bodies are in the way of a pose, they are the reason.
_SLACK_PRICE = 0.03
# Price of the squared distance from the given posture, which makes the answer unique.
_AWAY_PRICE = 1e-6
# Most postures to begin from, and most that are drawn: the clearest of many lead to a posture where any 24 may not.
_TRIES, _DRAWN = 24, 200
# Postures that confirm what conflicts nearby.  In panda before a wall two find the way past a body, if there is one.
_CONFIRMING = 4
# Postures that are drawn first: mostly few are needed, and to draw all takes longer than to relax a small robot.
_DRAW = 8
# Most times that the program grows for one start.
_ROUNDS = 20


@dataclass(frozen=True)
class LeastViolation:
    """The least violation that could be found.

    Attributes:
        q: Configuration with the least violation, shape (nq,).
        problem: The problem with all parts that its program needed.
        conflicts: Violated constraints and their violation; empty if all are satisfied.
        at_limits: Joints on a limit at ``q``.
        violation: Sum of the violations at the price of each constraint.
    """

    q: Array
    problem: ConstrainedProblem
    conflicts: dict[str, float]
    at_limits: tuple[str, ...]
    violation: float


def find_conflicts(
    problem: ConstrainedProblem,
    seed: int = 0,
    program: ElasticProgram | None = None,
    guesses: Sequence[Array] = (),
    beside: float = 0.0,
) -> LeastViolation:
    """Minimize the slack ``Σ (s⁺ + s⁻)`` with ``c(q) + s⁺ − s⁻`` within bounds, from several postures.

    Args:
        problem: The posture problem.
        seed: Seed of the postures.
        program: The program of the same problem with another target, or of one that grew into it.
        guesses: Postures to begin from before all others.
        beside: Least violation known of a target nearby, which few postures confirm.  All are tried where these leave
            less than half of it.
    """
    chart = Chart.of(problem.robot.model)
    program = program or ElasticProgram(problem)
    best: LeastViolation | None = None
    for count, start in enumerate(islice(chain(guesses, _starts(problem, chart, seed)), _TRIES), 1):
        for _ in range(_ROUNDS):
            found = _relax(problem, chart, program, start)
            if found.problem is problem:
                break
            problem = found.problem
        if best is None or found.violation < best.violation:
            best = found
        if not best.conflicts or (count == _CONFIRMING and 2 * best.violation >= beside > 0):
            break
    assert best is not None  # noqa: S101 (narrows a type)
    return best


def _starts(problem: ConstrainedProblem, chart: Chart, seed: int) -> Iterator[Array]:
    """Yield the given posture, then random ones on the projected constraints, of each draw the clearest first."""
    yield problem.given
    rng, projector = np.random.default_rng(seed), Projector(problem)
    near = [problem.given if k % 2 else None for k in range(1, _DRAWN)]
    for some in near[:_DRAW], near[_DRAW:]:
        found = [projector.project(random_posture(problem, chart, rng, posture)) for posture in some]
        order = [(each.violation > FEASIBLE, projector.outside(each.q)) for each in found]
        yield from (found[k].q for k in sorted(range(len(found)), key=order.__getitem__))


def _relax(problem: ConstrainedProblem, chart: Chart, program: ElasticProgram, start: Array) -> LeastViolation:
    """Minimize the slack from one posture; the answer's problem has grown if the program lacked parts."""
    lower_rows, upper_rows = problem.row_bounds
    norms = np.zeros(len(chart.quaternion_slices()))
    x = np.clip(chart.to_x(start), problem.lower, problem.upper)
    guess = problem.guess(Numeric(problem.robot.model).at(chart.to_q(x)))
    solver, began = program.solver(problem), time.perf_counter()
    slacks = int(solver.size1_in("x0")) - chart.nx - len(guess.values)
    answer = run_solver(
        solver,
        x0=np.concatenate([x, np.full(slacks, 0.1), guess.values]),
        p=np.concatenate([chart.to_x(problem.given), *[c.parameters for c in problem.constraints]]),
        lbx=np.concatenate([problem.lower, np.zeros(slacks), guess.lower]),
        ubx=np.concatenate([problem.upper, np.full(slacks, np.inf), guess.above]),
        lbg=np.concatenate([norms, lower_rows]),
        ubg=np.concatenate([norms, upper_rows]),
    )
    program.time_s += time.perf_counter() - began
    q = chart.to_q(np.array(answer["x"]).reshape(-1)[: chart.nx])
    return _judge(problem.grown([q]), chart, q)


class ElasticProgram:
    """The elastic program, most of whose expressions stay while the problem grows.

    Args:
        problem: The problem before it grows.
        rows: The rows of its constraints, if another program of the problem has them.

    Attributes:
        problem: The problem as far as it has grown.
        time_s: Wall time within the solver so far, s.
    """

    def __init__(self, problem: ConstrainedProblem, rows: ProgramRows | None = None) -> None:
        self.problem, self.time_s = problem, 0.0
        self._latest: tuple[str, ca.Function] | None = None
        self._rows = rows = rows or ProgramRows(problem)
        self._away = _AWAY_PRICE * rows.away
        self._own = Derivatives.of(ca.vertcat(self._away, rows.norms), rows.x)

    def solver(self, problem: ConstrainedProblem) -> ca.Function:
        """Return ``nlpsol`` for the first problem, also with another target, or one that grew out of it."""
        self.problem, structure = problem, problem.structure
        if self._latest is None or self._latest[0] != structure:
            self._latest = structure, self._solver(problem)
        return self._latest[1]

    def _solver(self, problem: ConstrainedProblem) -> ca.Function:
        lifted = self._rows.lift(problem)
        z, nx = lifted.variables.numel(), self._rows.chart.nx
        # Rows with a slack of their own, which is cheaper, need no other.
        counts = [len(problem.carried(i)) for i in range(len(problem.constraints))]
        rigid = np.repeat(np.array([not piece.slack.nnz() for piece in lifted.pieces], dtype=bool), counts)
        price = np.repeat([c.price for c in problem.constraints], counts)[rigid]
        k, place = len(price), ca.SX.eye(len(rigid))[:, np.flatnonzero(rigid).tolist()]
        up, down = ca.SX.sym("up", k), ca.SX.sym("down", k)
        x, p = (
            ca.vertcat(self._rows.x, up, down, lifted.variables),
            ca.vertcat(self._rows.reference, *self._rows.parameters),
        )
        g = ca.vertcat(self._rows.norms, lifted.rows + place @ (up - down))
        f = ca.dot(price, up + down) + _SLACK_PRICE * lifted.slack + self._away
        known = self._rows.derivatives(lifted)
        slacks = ca.horzcat(place, -place)
        relaxed = Derivatives(
            known.multipliers,
            ca.horzcat(known.jacobian[:, :nx], slacks, known.jacobian[:, nx:]),
            _widened(known.hessian, nx, 2 * k, z),
        )
        found = joined(self._own, relaxed, nx)
        order = [*range(1, found.multipliers.numel())]
        placed = Derivatives(found.multipliers[order], found.jacobian[order, :], found.hessian)
        options = {**IPOPT_OPTIONS, "ipopt.tol": 1e-8, **placed.options(x, p, found.multipliers[0], g)}
        return ca.nlpsol("elastic", "ipopt", {"x": x, "p": p, "f": f, "g": g}, options)


def _widened(hessian: ca.SX, before: int, width: int, after: int) -> ca.SX:
    """Return a Hessian with unknowns that it does not depend on, between the first ones and the last."""
    place = [*range(before), *range(before + width, before + width + after)]
    wide = ca.SX(before + width + after, before + width + after)
    wide[place, place] = hessian
    return wide


def _judge(problem: ConstrainedProblem, chart: Chart, q: Array) -> LeastViolation:
    numeric = Numeric(problem.robot.model).at(q)
    conflicts: dict[str, float] = {}
    total = 0.0
    for constraint, excess in zip(problem.constraints, problem.violations(numeric), strict=True):
        for name, violation in constraint.conflicts(excess).items():
            if violation > _KEPT:
                conflicts[name] = conflicts.get(name, 0.0) + violation
                total += constraint.price * violation
    x = chart.to_x(q)
    limits = []
    for slot in chart.slots:
        if slot.kind.family not in ("revolute", "prismatic") or problem.lower[slot.x] == problem.upper[slot.x]:
            continue
        if x[slot.x] - problem.lower[slot.x] < 1e-4:
            limits.append(f"'{slot.name}' at its lower limit")
        elif problem.upper[slot.x] - x[slot.x] < 1e-4:
            limits.append(f"'{slot.name}' at its upper limit")
    return LeastViolation(q, problem, conflicts, tuple(limits), total)
