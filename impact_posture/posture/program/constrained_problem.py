"""The posture problem as data: objective, constraints, bounds and start, and the rank of its equalities."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import accumulate, pairwise

import numpy as np

from impact_posture.config.obstacle import Obstacle
from impact_posture.config.settings import CLEARANCE, Vector3
from impact_posture.dynamics.numeric import Numeric
from impact_posture.errors import InputError
from impact_posture.impact.objective import Objective
from impact_posture.impact.quantities.lifted_form import Guess
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.posture.constraints.constraint import Constraint
from impact_posture.posture.constraints.surroundings import Surroundings
from impact_posture.robot.robot import Robot
from impact_posture.system.arrays import Array

# A direction of the tangent space is held if a unit step along it moves a constraint by more than this.
RANK_TOLERANCE = 1e-7


@dataclass(frozen=True)
class Requirements:
    """Demands of the task on the posture.

    Attributes:
        contact_pose: Part of the pose of the leading contact frame that is held, as in the setting of that name.
        other_poses: The same for each other contact frame.
        target_position: Position of the contact frame, world, meters; ``None`` for its initial position.
        target_quaternion: Orientation of the contact frame, x y z w; ``None`` for its initial orientation.
        box: Half extents of the box of ``contact_pose = box``, meters.
        base: Freedom of the floating base: ``free``, ``level`` (tilt zero, yaw free), ``level:DEG`` (tilt from
            its default posture at most DEG degrees, yaw free), ``fixed`` or ``box``.
        base_box: Half extents of the box of ``base = box``, meters.
        keep: Frames whose pose is held.
        hold: Joints kept at their initial value.
        com_over_feet: Keep the center of mass above the support polygon.
        com_asked: Whether the user set ``com_over_feet``; else it is dropped if the feet span no area.
        com_margin: Distance from the polygon's edges, meters.
        keep_contacts: The impact must neither lift nor slide a foot.
        friction: Friction coefficient of the feet.
        holdable: Thrusts, torques and forces of the feet that hold the posture stay within their limits.
        limit_share: Share of the limits of torques and thrusts that holding may take; of a range, about its middle.
        hold_force: Force that each contact pushes back with after the impact, N, which has to be held as well.
        least_mobility: Least G of each contact, 1/kg, for the bound on the peak force; 0 for none.
        largest_jump: Largest jump of a joint per approach speed; infinite for no bound.
        approach_speed: Speed at which the joints have to bring the contact to the surface, m/s; 0 for no demand.
        collision: Keep the links clear of each other, the surface, the ground and the obstacles.
        clearance: Least distance of all of these, m.
        surface: ``plane``, ``none``, or the edge length of a square patch in m; ``None`` to decide by the robot.
        obstacles: Bodies in the world.
        limit_margin: Distance from the joint limits, rad or m.
        regularization: Weight of the squared distance from the initial posture, relative to the initial objective.
    """

    contact_pose: str = "full"
    other_poses: tuple[str, ...] = ()
    target_position: Vector3 | None = None
    target_quaternion: tuple[float, float, float, float] | None = None
    box: Vector3 = (0.05, 0.05, 0.05)
    base: str = "free"
    base_box: Vector3 = (0.2, 0.2, 0.2)
    keep: tuple[str, ...] = ()
    hold: tuple[str, ...] = ()
    com_over_feet: bool = False
    com_asked: bool = True
    com_margin: float = 0.0
    keep_contacts: bool = False
    friction: float = 0.7
    holdable: bool = False
    limit_share: float = 1.0
    hold_force: float = 0.0
    least_mobility: float = 0.0
    largest_jump: float = float("inf")
    approach_speed: float = 0.0
    collision: bool = False
    clearance: float = CLEARANCE
    surface: str | float | None = None
    obstacles: tuple[Obstacle, ...] = ()
    limit_margin: float = 0.0
    regularization: float = 0.0


@dataclass(frozen=True)
class ConstrainedProblem:
    """``min_q objective(q)`` under constraints, from a given posture.

    Attributes:
        robot: The robot.
        objective: The function that is minimized.
        requirements: Demands of the task.
        given: Posture of the user, shape (nq,).
        constraints: All constraints except bounds.
        lower: Lower bounds in chart coordinates, with margin, and with held joints pinned, shape (nx,).
        upper: Upper bounds, shape (nx,).
        rows: Rows of each constraint that the program carries; empty for all rows.
        notes: Decisions that the builder made for the user, one line each.
        surroundings: The bodies that the robot stays clear of; ``None`` without this demand.
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
        """The objective of an impact.

        Raises:
            InputError: The objective is not that of an impact.
        """
        if not isinstance(self.objective, WorstCaseObjective):
            raise InputError(
                f"is '{self.objective.name}', which is not that of an impact",
                where="objective",
                hint="use an WorstCaseObjective for what needs H, G, V and S",
            )
        return self.objective

    def carried(self, index: int) -> list[int]:
        """Return the rows of constraint ``index`` that the program carries."""
        return list(self.rows[index]) if self.rows else list(range(len(self.constraints[index].lifted_bounds[0])))

    @property
    def structure(self) -> str:
        """Text that distinguishes the rows that the program carries, apart from parameters and bounds."""
        return "\n".join(f"{c.structure}:{self.carried(k)}" for k, c in enumerate(self.constraints))

    @property
    def row_bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds of all rows that the program carries."""
        carried = [(*c.lifted_bounds, self.carried(i)) for i, c in enumerate(self.constraints)]
        empty = np.zeros(0)
        return (
            np.concatenate([empty, *[lower[rows] for lower, _, rows in carried]]),
            np.concatenate([empty, *[upper[rows] for _, upper, rows in carried]]),
        )

    def guess(self, numeric: Numeric) -> Guess:
        """Return the auxiliaries of all constraints to start from at ``numeric.q``, with their bounds."""
        return Guess.joined([c.guess(numeric) for c in self.constraints if c.unknowns])

    def split(self, auxiliaries: Array) -> list[Array]:
        """Return the auxiliaries of each constraint."""
        ends = list(accumulate((c.unknowns for c in self.constraints), initial=0))
        return [auxiliaries[start:stop] for start, stop in pairwise(ends)]

    @property
    def grows(self) -> bool:
        """Whether the program may lack parts."""
        return any(c.grows for c in self.constraints)

    def grown(
        self, postures: Sequence[Array], numeric: Numeric | None = None, auxiliaries: Sequence[Array] | None = None
    ) -> ConstrainedProblem:
        """Return the problem with the parts that its program lacks at any of the postures; itself if none.

        Args:
            postures: The postures, shape (nq,) each.
            numeric: The model, if the caller has it; it is moved.
            auxiliaries: Those of the program at the postures, if these are ends of runs, shape (k,) each.
        """
        constraints, numeric = list(self.constraints), numeric or Numeric(self.robot.model)
        for index, q in enumerate(postures):
            numeric.at(q)
            ends = [None] * len(constraints) if auxiliaries is None else self.split(auxiliaries[index])
            constraints = [c.grown(numeric, end) for c, end in zip(constraints, ends, strict=True)]
        if all(one is other for one, other in zip(constraints, self.constraints, strict=True)):
            return self
        rows = tuple(
            kept if now is before else tuple(range(len(now.lifted_bounds[0])))
            for kept, now, before in zip(self.rows, constraints, self.constraints, strict=False)
        )
        return replace(self, constraints=tuple(constraints), rows=rows)

    def slack(self, auxiliaries: Array) -> float:
        """Return by how much (m) the constraints let off a run that ended at these auxiliaries."""
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


def rank(jacobian: Array) -> int:
    """Return the rank of a constraint Jacobian at the tolerance of all counts of redundancy."""
    return int(np.linalg.matrix_rank(jacobian, tol=RANK_TOLERANCE)) if jacobian.size else 0


def equality_jacobian(problem: ConstrainedProblem, numeric: Numeric) -> Array:
    """Return the tangent Jacobian of all equalities and held joints at ``numeric.q``, shape (rows, nv)."""
    blocks = [held_rows(problem.robot, problem.requirements.hold)]
    blocks += [c.evaluate(numeric)[1] for c in problem.constraints if c.equality]
    return np.vstack(blocks)


def held_rows(robot: Robot, hold: Sequence[str]) -> Array:
    """Return the unit rows of the tangent entries of held joints, shape (k, nv)."""
    rows: list[int] = []
    for joint in hold:
        index = robot.joint_id(joint)
        rows += range(robot.model.idx_vs[index], robot.model.idx_vs[index] + robot.model.nvs[index])
    return np.eye(robot.nv)[rows]
