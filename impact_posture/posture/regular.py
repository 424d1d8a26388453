"""Make a problem's equalities regular: determined where nothing determines them, independent where they repeat."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin
import scipy.linalg
from numpy.typing import NDArray

from impact_posture.dynamics.numeric import Numeric
from impact_posture.dynamics.tree import PointOnLink
from impact_posture.impact.contact import point_on
from impact_posture.impact.objective import ImpactObjective
from impact_posture.posture.constraint import Constraint, HeldPosition, HeldTurn
from impact_posture.robot.robot import Robot

if TYPE_CHECKING:
    from impact_posture.posture.problem import PostureProblem, Requirements

Vector = NDArray[np.float64]

# A direction of the tangent space counts as held when a unit step along it moves a constraint by more than this.
RANK_TOLERANCE = 1e-7
# Size of the trial turn (rad) and the share of it that must survive for the turn to be possible.
_TRIAL, _SURVIVES = 0.05, 0.1


def rank(jacobian: Vector) -> int:
    """Rank of a constraint Jacobian at the tolerance that all counts of redundancy use."""
    return int(np.linalg.matrix_rank(jacobian, tol=RANK_TOLERANCE)) if jacobian.size else 0


def equality_jacobian(problem: PostureProblem, numeric: Numeric) -> Vector:
    """Tangent Jacobian of all equalities, held joints included, at ``numeric.q``, shape (rows, nv)."""
    blocks = [held_rows(problem.robot, problem.requirements.hold)]
    blocks += [c.numeric(numeric)[1] for c in problem.constraints if c.equality]
    return np.vstack(blocks)


def held_rows(robot: Robot, hold: Sequence[str]) -> Vector:
    """Unit rows of the tangent entries of held joints, shape (k, nv)."""
    rows: list[int] = []
    for joint in hold:
        index = robot.joint_id(joint)
        rows += range(robot.model.idx_vs[index], robot.model.idx_vs[index] + robot.model.nvs[index])
    return np.eye(robot.nv)[rows]


def regularize(problem: PostureProblem) -> PostureProblem:
    """Choose an independent set of equality rows for the program; hold turns that exist to first order only.

    Four point feet on planar legs (solo8) are 12 equations of rank 10: two repeat others, and the base may roll to
    first order although any finite roll would spread the feet.  A program cannot live with either.  The rows that
    repeat others are left out of it (the certificate still checks them), and such a turn is held explicitly.
    """
    robot = problem.robot
    numeric = Numeric(robot.model).at(problem.given)
    jacobian = equality_jacobian(problem, numeric)
    if rank(jacobian) == len(jacobian):
        return problem
    added, notes = [], []
    if robot.floating:
        base = PointOnLink(1, np.zeros(3), np.eye(3))
        rotation = numeric.placement(base).rotation.copy()
        for component in range(3):
            turn = HeldTurn(base, rotation, component)
            if _only_to_first_order(problem, numeric, turn):
                added.append(turn)
                notes.append(f"{turn.name} held: the feet allow it to first order only")
    problem = replace(problem, constraints=(*problem.constraints, *added), notes=(*problem.notes, *notes))
    return replace(problem, rows=_independent_rows(problem, numeric.at(problem.given)))


def _only_to_first_order(problem: PostureProblem, numeric: Numeric, turn: HeldTurn) -> bool:
    """Whether the equalities' linearization allows a turn that the equalities themselves undo."""
    model, q = problem.robot.model, problem.given
    jacobian = equality_jacobian(problem, numeric.at(q))
    free = scipy.linalg.null_space(jacobian, rcond=RANK_TOLERANCE)
    along = free @ (free.T @ turn.numeric(numeric)[1][0])
    size = float(turn.numeric(numeric)[1][0] @ along)
    if size < 1e-3:
        return False
    equalities = [c for c in problem.constraints if c.equality]
    start = [c.numeric(numeric)[0] for c in equalities]
    q = pin.integrate(model, q, along * (_TRIAL / size))
    for _ in range(60):
        numeric.at(q)
        residual = np.concatenate(
            [np.zeros(len(held_rows(problem.robot, problem.requirements.hold)))]
            + [c.numeric(numeric)[0] - s for c, s in zip(equalities, start, strict=True)]
        )
        step = -np.linalg.pinv(equality_jacobian(problem, numeric), rcond=1e-9) @ residual
        q = pin.integrate(model, q, step)
        if np.abs(step).max() < 1e-12:
            break
    turned = float(turn.numeric(numeric.at(q))[0][0])
    return abs(turned) < _SURVIVES * _TRIAL


def _independent_rows(problem: PostureProblem, numeric: Numeric) -> tuple[tuple[int, ...], ...]:
    """For each constraint the rows that the program carries: all inequalities, independent equalities."""
    held = held_rows(problem.robot, problem.requirements.hold).sum(axis=0) > 0
    labels, blocks = [], []
    for index, constraint in enumerate(problem.constraints):
        if constraint.equality:
            blocks.append(constraint.numeric(numeric)[1])
            labels += [(index, row) for row in range(constraint.rows)]
    stacked = np.vstack(blocks)
    stacked[:, held] = 0.0
    _, triangle, order = scipy.linalg.qr(stacked.T, mode="economic", pivoting=True)
    count = int((np.abs(np.diag(triangle)) > RANK_TOLERANCE).sum())
    chosen = {labels[k] for k in order[:count]}
    return tuple(
        tuple(row for row in range(c.rows) if not c.equality or (index, row) in chosen)
        for index, c in enumerate(problem.constraints)
    )


def pin_undetermined(
    robot: Robot,
    objective: ImpactObjective,
    numeric: Numeric,
    requirements: Requirements,
    constraints: list[Constraint],
) -> tuple[list[Constraint], list[str]]:
    """Fix what neither constraints nor objective determine: base position, and the turn that n does not see.

    A contact pose that is free also gives up yaw: turning the whole robot to the blow is no change of posture.
    """
    if not robot.floating:
        return [], []
    base = PointOnLink(1, np.zeros(3), np.eye(3))
    placement = numeric.placement(base)
    J_base = numeric.jacobian(base)
    added: list[Constraint] = []
    notes: list[str] = []

    def undetermined(twist: Vector) -> bool:
        motion = np.linalg.pinv(J_base) @ twist
        return all(np.abs(c.numeric(numeric)[1] @ motion).max() < RANK_TOLERANCE for c in constraints)

    translations = [undetermined(np.eye(6)[k]) for k in range(3)]
    if any(translations):
        added.append(HeldPosition("base position", base, placement.translation))
        notes.append("base position fixed at its initial value: nothing else determines it")
    # A turn of the whole robot about the vertical through the contact (or through the base, where that is free).
    origin = numeric.placement(point_on(robot, objective.contact.frame, objective.contact.offset)).translation
    pivot = placement.translation if added else origin
    vertical = np.array([0.0, 0.0, 1.0])
    turn = np.concatenate([np.cross(vertical, placement.translation - pivot), vertical])
    n = np.array(objective.contact.normal)
    blind = objective.contact.normal_frame == "contact" or abs(abs(n[2]) - 1) < 1e-9
    if undetermined(turn) and (blind or requirements.contact_pose == "free"):
        added.append(HeldTurn(base, placement.rotation, 2))
        notes.append("base yaw fixed at its initial value: nothing else determines it")
    return added, notes
