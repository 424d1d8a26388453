"""The posture problem (objective, constraints, limits and given posture), and the rank of its equalities."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import accumulate, pairwise

import numpy as np

from impact_posture.dynamics.numeric import Numeric
from impact_posture.errors import InputError
from impact_posture.impact.objective import Objective
from impact_posture.impact.quantities.lifted_form import Guess
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.posture.constraints.constraint import Constraint
from impact_posture.posture.constraints.requirements import Requirements
from impact_posture.posture.constraints.surroundings import Surroundings
from impact_posture.robot.robot import Robot
from impact_posture.system.arrays import Array

# Singular values of the constraint Jacobian up to this value are treated as zero when its rank is computed.
RANK_TOLERANCE = 1e-7


@dataclass(frozen=True)
class ConstrainedProblem:
    """The problem ``min_q objective(q)`` subject to constraints, with the given posture.

    Attributes:
        given: Posture that the user specified, shape (nq,).
        constraints: All constraints except joint limits.
        lower: Lower joint limits plus margin, chart coordinates, shape (nx,); both limits of a held joint are equal.
        upper: Upper joint limits minus margin, chart coordinates, shape (nx,).
        rows: For each constraint, the indices of its rows in the program; empty if the program contains all rows.
        notes: Decisions made while the problem was built, one line each.
        surroundings: The bodies that the robot must not touch; ``None`` if there are no collision constraints.
    """

    robot: Robot
    objective: Objective
    requirements: Requirements
    given: Array
    constraints: tuple[Constraint, ...]
    lower: Array
    upper: Array
    rows: tuple[tuple[int, ...], ...] = ()
    notes: tuple[str, ...] = ()
    surroundings: Surroundings | None = None

    @property
    def impact(self) -> WorstCaseObjective:
        """The objective, if it is an impact objective; otherwise raise ``InputError``."""
        if not isinstance(self.objective, WorstCaseObjective):
            fault = f"is '{self.objective.name}', which is not an impact objective"
            raise InputError(fault, where="objective", hint="use a WorstCaseObjective, which provides H, G, V and S")
        return self.objective

    def carried(self, index: int) -> list[int]:
        """Return the indices of the rows of constraint ``index`` that the program contains."""
        return list(self.rows[index]) if self.rows else list(range(len(self.constraints[index].lifted_bounds[0])))

    @property
    def structure(self) -> str:
        """Text that identifies the rows of the program, without parameters and bounds."""
        return "\n".join(f"{c.structure}:{self.carried(k)}" for k, c in enumerate(self.constraints))

    @property
    def row_bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds of all rows of the program."""
        bounds = [np.array(c.lifted_bounds)[:, self.carried(i)] for i, c in enumerate(self.constraints)]
        lower, upper = np.concatenate([np.zeros((2, 0)), *bounds], axis=1)
        return lower, upper

    def guess(self, numeric: Numeric) -> Guess:
        """Return initial values and bounds, at ``numeric.q``, of the auxiliary unknowns of all constraints."""
        return Guess.joined([c.guess(numeric) for c in self.constraints if c.unknowns])

    def split(self, auxiliaries: Array) -> list[Array]:
        """Split the vector of all auxiliary unknowns into one vector for each constraint."""
        ends = list(accumulate((c.unknowns for c in self.constraints), initial=0))
        return [auxiliaries[start:stop] for start, stop in pairwise(ends)]

    @property
    def grows(self) -> bool:
        """Whether the program may lack rows that :meth:`grown` can add."""
        return any(c.grows for c in self.constraints)

    def grown(
        self, postures: Sequence[Array], numeric: Numeric | None = None, auxiliaries: Sequence[Array] | None = None
    ) -> ConstrainedProblem:
        """Return the problem with the rows that the program lacks at the postures, or ``self`` if none are missing.

        If the postures are final postures of runs, ``auxiliaries`` are the final auxiliary unknowns of these runs,
        shape (k,) each.  If ``numeric`` is given, the method sets it to the last posture.
        """
        constraints, numeric = list(self.constraints), numeric or Numeric(self.robot.model)
        for index, q in enumerate(postures):
            numeric.at(q)
            ends = [None] * len(constraints) if auxiliaries is None else self.split(auxiliaries[index])
            constraints = [c.grown(numeric, end) for c, end in zip(constraints, ends, strict=True)]
        if all(now is before for now, before in zip(constraints, self.constraints, strict=True)):
            return self
        rows = tuple(
            kept if now is before else tuple(range(len(now.lifted_bounds[0])))
            for kept, now, before in zip(self.rows, constraints, self.constraints, strict=False)
        )
        return replace(self, constraints=tuple(constraints), rows=rows)

    def slack(self, auxiliaries: Array) -> float:
        """Return the largest slack of a constraint, m, for the auxiliary unknowns at the end of a run."""
        ends = self.split(auxiliaries)
        return max((c.slack(end) for c, end in zip(self.constraints, ends, strict=True)), default=0.0)

    def violations(self, numeric: Numeric) -> list[Array]:
        """Return the signed violation of each constraint at ``numeric.q``, shape (rows,) each; zero if satisfied."""
        return [constraint.excess(constraint.value(numeric)) for constraint in self.constraints]

    def describe(self) -> list[str]:
        """Describe the constraints, one line each."""
        lines = [c.describe() for c in self.constraints]
        margin = self.requirements.limit_margin
        lines.append("joint limits" + (f", {margin:g} rad (m) inside" if margin else ""))
        lines += [f"joint '{joint}' held" for joint in self.requirements.hold]
        return lines


def rank(jacobian: Array, tolerance: float = RANK_TOLERANCE) -> int:
    """Return the rank of the Jacobian of constraints; singular values up to ``tolerance`` count as zero."""
    return int(np.linalg.matrix_rank(jacobian, tol=tolerance)) if jacobian.size else 0


def equality_jacobian(problem: ConstrainedProblem, numeric: Numeric) -> Array:
    """Return the tangent Jacobian of all equalities and held joints at ``numeric.q``, shape (rows, nv)."""
    blocks = [held_rows(problem.robot, problem.requirements.hold)]
    blocks += [c.evaluate(numeric)[1] for c in problem.constraints if c.equality]
    return np.vstack(blocks)


def held_rows(robot: Robot, hold: Sequence[str]) -> Array:
    """Return a unit row for each tangent entry of a held joint, shape (k, nv)."""
    return np.eye(robot.nv)[robot.entries(hold)]
