"""Make a problem well-posed: fix free motions, omit redundant rows, block turns possible only to first order."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pinocchio as pin

from impact_posture.dynamics.numeric import Numeric
from impact_posture.impact.objective import Objective
from impact_posture.posture.constraints.constraint import Constraint
from impact_posture.posture.constraints.pose_constraints import HeldPosition, HeldTurn, base_point
from impact_posture.posture.constraints.requirements import Requirements
from impact_posture.posture.manifold.feasible_start import Projector, feasible_start
from impact_posture.posture.program.constrained_problem import (
    RANK_TOLERANCE,
    ConstrainedProblem,
    equality_jacobian,
    held_rows,
    rank,
)
from impact_posture.robot.robot import Robot
from impact_posture.system.arrays import Array, independent_rows, null_space

# Angle of a trial turn, rad.
_TRIAL = 0.05
# The constraints allow a trial turn if at least this fraction of the angle remains after the projection onto the
# constraints.
_SURVIVES = 0.1
# Number of random feasible postures at which ranks are compared.
_SAMPLES = 4
# Singular values up to this value count as zero at a projected posture, which violates the constraints by up to 1e-9.
# Some motions are blocked only to second order, for example a sway on legs without ankle roll.  The singular values
# of such motions are as large as the square root of the violation, 3e-5.
_BLURRED = 5e-5


def fix_undetermined_motions(
    robot: Robot,
    objective: Objective,
    numeric: Numeric,
    requirements: Requirements,
    constraints: Sequence[Constraint],
) -> tuple[list[Constraint], list[str]]:
    """Return constraints on motions of the base that nothing else determines, and notes for the user.

    Some motions of the whole robot, such as translations, do not change the objective.  If the constraints allow a
    motion that does not change the objective, this motion of the base is fixed.  If the contact pose is free and the
    robot has no feet, yaw is fixed as well, because a turn of the whole robot does not change the joint positions.
    """
    if not robot.floating:
        return [], []
    base = base_point()
    placement = numeric.placement(base)
    move = np.linalg.pinv(numeric.jacobian(base))
    blind = objective.blind_motions()
    turns = [motion[3:] for motion in blind if motion[3:].any()]
    if objective.contacts and requirements.contact_pose == "free" and not objective.supports:
        blind = np.vstack([blind, np.eye(6)[5]])
    basis, values, _ = np.linalg.svd(blind.T, full_matrices=False)
    motions = move @ basis[:, values > 6 * np.finfo(float).eps * values[0]]
    added: list[Constraint] = []
    notes: list[str] = []

    def free() -> Array:
        """Return the base twists that the constraints still allow, in world axes, shape (6, k)."""
        rows = [c.evaluate(numeric)[1] @ motions for c in (*constraints, *added)]
        if not rows:
            return np.asarray(numeric.jacobian(base) @ motions)
        allowed = null_space(np.vstack(rows), RANK_TOLERANCE)
        return np.asarray(numeric.jacobian(base) @ motions @ allowed)

    # A turn about a point other than the base origin also moves the base, so turns are fixed before positions.
    candidates = [("yaw", np.array([0.0, 0.0, 1.0]))]
    if len(turns) == 1:
        candidates.append(("turn about the normal", placement.rotation.T @ turns[0]))
    candidates += [("roll", np.eye(3)[0]), ("pitch", np.eye(3)[1])]
    for name, axis in candidates:
        held = HeldTurn(base, placement.rotation, axis, f"base {name}")
        if np.abs(held.evaluate(numeric)[1] @ move @ free()).max(initial=0.0) > 1e-3:
            added.append(held)
            notes.append(f"base {name} is fixed at its initial value, because nothing else determines it")
    if np.abs(free()[:3]).max(initial=0.0) > 1e-3:
        added.append(HeldPosition("base position", base, placement.translation))
        notes.append("base position is fixed at its initial value, because nothing else determines it")
    return added, notes


def make_well_posed(problem: ConstrainedProblem) -> ConstrainedProblem:
    """Choose independent equality rows for the program, and constrain turns that are possible only to first order.

    Four point feet on planar legs (solo8) give 12 equations of rank 10, so two equations are redundant.  To first
    order, the base can roll, although any finite roll would spread the feet.  The redundant equations and the roll
    prevent the solver from converging.  So the program omits the redundant rows, which the certificate still checks,
    and a constraint blocks the roll.
    """
    numeric = Numeric(problem.robot.model)
    jacobian = equality_jacobian(problem, numeric.at(problem.given))
    if rank(jacobian) == len(jacobian):
        return problem
    # Ranks are compared at the projected given posture and at a few random feasible postures.
    postures = [Projector(problem).project(problem.given).q]
    postures += [q for k in range(1, _SAMPLES + 1) if (q := feasible_start(problem, k, seed=0)) is not None]
    added, notes = [], []
    if problem.robot.floating:
        rotation = numeric.at(postures[0]).placement(base_point()).rotation.copy()
        for name, axis in zip(("roll", "pitch", "yaw"), np.eye(3), strict=True):
            turn = HeldTurn(base_point(), rotation, axis, f"base {name}")
            if _only_to_first_order(problem, numeric, turn, postures[0]):
                added.append(turn)
                notes.append(f"{turn.name} is held: the feet block it, although their linearization allows it")
    problem = replace(problem, constraints=(*problem.constraints, *added), notes=(*problem.notes, *notes))
    # A posture may happen to be singular, for example with a straight arm, so use the posture with the highest rank.
    generic = max(postures, key=lambda q: rank(equality_jacobian(problem, numeric.at(q)), _BLURRED))
    jacobian = equality_jacobian(problem, numeric.at(generic))
    if rank(jacobian, _BLURRED) == len(jacobian):
        return problem
    return replace(problem, rows=_independent_rows(problem, numeric.at(generic)))


def _only_to_first_order(problem: ConstrainedProblem, numeric: Numeric, turn: HeldTurn, q: Array) -> bool:
    """Return whether the linearized equalities at ``q`` allow a turn that the nonlinear equalities prevent."""
    model = problem.robot.model
    jacobian = equality_jacobian(problem, numeric.at(q))
    free = null_space(jacobian, RANK_TOLERANCE)
    along = free @ (free.T @ turn.evaluate(numeric)[1][0])
    size = float(turn.evaluate(numeric)[1][0] @ along)
    if size < 1e-3:
        return False
    equalities = [c for c in problem.constraints if c.equality]
    start = [c.evaluate(numeric)[0] for c in equalities]
    held = np.zeros(len(held_rows(problem.robot, problem.requirements.hold)))
    q = pin.integrate(model, q, along * (_TRIAL / size))
    for _ in range(60):
        numeric.at(q)
        residual = [c.evaluate(numeric)[0] - s for c, s in zip(equalities, start, strict=True)]
        step = -np.linalg.pinv(equality_jacobian(problem, numeric), rcond=1e-9) @ np.concatenate([held, *residual])
        q = pin.integrate(model, q, step)
        if np.abs(step).max() < 1e-12:
            break
    turned = float(turn.evaluate(numeric.at(q))[0][0])
    return abs(turned) < _SURVIVES * _TRIAL


def _independent_rows(problem: ConstrainedProblem, numeric: Numeric) -> tuple[tuple[int, ...], ...]:
    """Return, for each constraint, the indices of its rows in the program; dependent equality rows are left out."""
    held = held_rows(problem.robot, problem.requirements.hold).sum(axis=0) > 0
    equalities = [(index, c) for index, c in enumerate(problem.constraints) if c.equality]
    labels = [(index, row) for index, c in equalities for row in range(c.rows)]
    # The rows are multiplied by ``Constraint.price``, so that redundant rows with a low price are omitted first.
    stacked = np.vstack([c.price * c.evaluate(numeric)[1] for _, c in equalities])
    stacked[:, held] = 0.0
    chosen = {labels[k] for k in independent_rows(stacked, _BLURRED)}
    return tuple(
        tuple(row for row in range(len(c.lifted_bounds[0])) if not c.equality or (index, row) in chosen)
        for index, c in enumerate(problem.constraints)
    )
