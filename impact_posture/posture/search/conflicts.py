"""Find the conflicting constraints of an infeasible problem, by relaxing each constraint with penalized slacks."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
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

# A constraint is treated as satisfied if its violation is below this value (m, rad).
_KEPT = 1e-6
# Penalty per meter of penetration between bodies, lower than the penalty 1 per meter of a violated pose.  If a body
# blocks a pose, the conflict that is reported is therefore the body and not the pose.
_SLACK_PRICE = 0.03
# Weight of the squared distance from the given posture.  The weight makes the solution unique.
_AWAY_PRICE = 1e-6
# Maximum number of starts.
_TRIES = 24
# Maximum number of random postures from which the starts are chosen.  The postures farthest from all bodies often
# lead to a feasible posture when arbitrary postures do not.
_DRAWN = 200
# Number of starts that confirm a conflict that is known from a nearby target.  For panda in front of a
# wall, two starts are needed to find a way around a body.
_CONFIRMING = 4
# Number of random postures that are drawn first.  These postures usually suffice, and drawing all ``_DRAWN`` postures
# takes longer than solving the program of a small robot.
_DRAW = 8
# Maximum number of times that missing rows are added to the program for one start.
_ROUNDS = 20


@dataclass(frozen=True)
class LeastViolation:
    """The posture ``q`` with the least violation, and the problem with all rows that its program needed.

    ``conflicts`` is the violation of each violated constraint; it is empty if all constraints are satisfied.
    ``sizes`` contains the violations as texts with units.
    ``at_limits`` names the joints that are at a limit.  ``violation`` is the sum of all violations, each multiplied
    by the penalty (:attr:`Constraint.price`) of its constraint.
    """

    q: Array
    problem: ConstrainedProblem
    conflicts: dict[str, float]
    sizes: dict[str, str]
    at_limits: tuple[str, ...]
    violation: float


def find_conflicts(
    problem: ConstrainedProblem,
    seed: int = 0,
    program: ElasticProgram | None = None,
    guesses: Sequence[Array] = (),
    beside: float = 0.0,
) -> LeastViolation:
    """Minimize the slack ``Σ (s⁺ + s⁻)`` with ``c(q) + s⁺ − s⁻`` within bounds, from ``guesses`` and other starts.

    ``program`` may belong to the same problem with another target or with fewer rows.  ``beside`` is the least
    violation of a search for a nearby target.  The search stops after :data:`_CONFIRMING` starts if the least
    violation so far is at least half of ``beside``.
    """
    chart = Chart.of(problem.robot.model)
    program = program or ElasticProgram(problem)
    best: LeastViolation | None = None
    for count, start in enumerate(islice(chain(guesses, _starts(problem, chart, seed)), _TRIES), 1):
        for _ in range(_ROUNDS):
            end = _relax(problem, chart, program, start)
            if end.problem is problem:
                break
            problem = end.problem
        if best is None or end.violation < best.violation:
            best = end
        if not best.conflicts or (count == _CONFIRMING and 2 * best.violation >= beside > 0):
            break
    assert best is not None  # noqa: S101 (narrows a type)
    return replace(best, problem=problem)


def _starts(problem: ConstrainedProblem, chart: Chart, seed: int) -> Iterator[Array]:
    """Yield the given posture, then projected random postures, the farthest from all bodies first."""
    yield problem.given
    rng, projector = np.random.default_rng(seed), Projector(problem)
    near = [problem.given if k % 2 else None for k in range(1, _DRAWN)]
    for draw in near[:_DRAW], near[_DRAW:]:
        postures = [projector.project(random_posture(problem, chart, rng, posture)) for posture in draw]
        yield from (p.q for p in sorted(postures, key=lambda p: (p.violation > FEASIBLE, projector.outside(p.q))))


def _relax(problem: ConstrainedProblem, chart: Chart, program: ElasticProgram, start: Array) -> LeastViolation:
    """Minimize the slack from one start; rows that the program lacked are added to the problem in the result."""
    lower_rows, upper_rows = problem.row_bounds
    norms = np.zeros(len(chart.quaternion_slices()))
    x = np.clip(chart.to_x(start), problem.lower, problem.upper)
    guess = problem.guess(Numeric(problem.robot.model).at(chart.to_q(x)))
    solver, began = program.solver(problem), time.perf_counter()
    slacks = int(solver.size1_in("x0")) - chart.nx - len(guess.values)
    solution = run_solver(
        solver,
        x0=np.concatenate([x, np.full(slacks, 0.1), guess.values]),
        p=np.concatenate([chart.to_x(problem.given), *[c.parameters for c in problem.constraints]]),
        lbx=np.concatenate([problem.lower, np.zeros(slacks), guess.lower]),
        ubx=np.concatenate([problem.upper, np.full(slacks, np.inf), guess.above]),
        lbg=np.concatenate([norms, lower_rows]),
        ubg=np.concatenate([norms, upper_rows]),
    )
    program.time_s += time.perf_counter() - began
    q = chart.to_q(np.array(solution["x"]).reshape(-1)[: chart.nx])
    return _conflicts_at(problem.grown([q]), chart, q)


class ElasticProgram:
    """The program that relaxes the constraints with slacks.

    Most expressions of the program stay the same when rows are added.  ``rows`` are the rows of its constraints, if
    another program of the problem has already built them.  ``problem`` is the problem with all rows added so far, and
    ``time_s`` is the total wall time of the solver.
    """

    def __init__(self, problem: ConstrainedProblem, rows: ProgramRows | None = None) -> None:
        self.problem, self.time_s = problem, 0.0
        self._latest: tuple[str, ca.Function] | None = None
        self._rows = rows = rows or ProgramRows(problem)
        self._away = _AWAY_PRICE * rows.away
        self._fixed = Derivatives.of(ca.vertcat(self._away, rows.norms), rows.x)

    def solver(self, problem: ConstrainedProblem) -> ca.Function:
        """Return ``nlpsol`` for the original problem, or for this problem with another target or more rows."""
        self.problem, structure = problem, problem.structure
        if self._latest is None or self._latest[0] != structure:
            self._latest = structure, self._solver(problem)
        return self._latest[1]

    def _solver(self, problem: ConstrainedProblem) -> ca.Function:
        lifted = self._rows.lift(problem)
        z, nx = lifted.variables.numel(), self._rows.chart.nx
        # If a constraint has its own slack, which has a lower penalty, its rows need no other slack.
        counts = [len(problem.carried(i)) for i in range(len(problem.constraints))]
        rigid = np.repeat(np.array([not piece.slack.nnz() for piece in lifted.pieces], dtype=bool), counts)
        price = np.repeat([c.price for c in problem.constraints], counts)[rigid]
        k, place = len(price), ca.SX.eye(len(rigid))[:, np.flatnonzero(rigid).tolist()]
        up, down = ca.SX.sym("up", k), ca.SX.sym("down", k)
        x = ca.vertcat(self._rows.x, up, down, lifted.variables)
        p = ca.vertcat(self._rows.reference, *self._rows.parameters)
        g = ca.vertcat(self._rows.norms, lifted.rows + place @ (up - down))
        f = ca.dot(price, up + down) + _SLACK_PRICE * lifted.slack + self._away
        known = self._rows.derivatives(lifted)
        slacks = ca.horzcat(place, -place)
        # The vector of unknowns contains x, then the slacks, then the auxiliary unknowns.  The rows are linear in the
        # slacks.
        hessian, others = ca.SX(nx + 2 * k + z, nx + 2 * k + z), [*range(nx), *range(nx + 2 * k, nx + 2 * k + z)]
        hessian[others, others] = known.hessian
        jacobian = ca.horzcat(known.jacobian[:, :nx], slacks, known.jacobian[:, nx:])
        joint = joined(self._fixed, Derivatives(known.multipliers, jacobian, hessian), nx)
        derivatives = joint.reordered([*range(1, joint.multipliers.numel())])
        options = {**IPOPT_OPTIONS, "ipopt.tol": 1e-8, **derivatives.options(x, p, joint.multipliers[0], g)}
        return ca.nlpsol("elastic", "ipopt", {"x": x, "p": p, "f": f, "g": g}, options)


def _conflicts_at(problem: ConstrainedProblem, chart: Chart, q: Array) -> LeastViolation:
    numeric = Numeric(problem.robot.model).at(q)
    conflicts, sizes = dict[str, float](), dict[str, str]()
    total = 0.0
    for constraint, excess in zip(problem.constraints, problem.violations(numeric), strict=True):
        for name, violation in constraint.conflicts(excess).items():
            if violation > _KEPT:
                conflicts[name] = conflicts.get(name, 0.0) + violation
                sizes[name] = constraint.size(name, conflicts[name])
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
    return LeastViolation(q, problem, conflicts, sizes, tuple(limits), total)
