"""Make a problem's equalities regular: independent where they repeat, held where they hold to second order only."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pinocchio as pin
import scipy.linalg
from numpy.typing import NDArray

from impact_posture.dynamics.numeric import Numeric
from impact_posture.posture.constraint import HeldTurn
from impact_posture.posture.equalities import RANK_TOLERANCE, base_point, equality_jacobian, held_rows, rank
from impact_posture.posture.problem import PostureProblem
from impact_posture.posture.starts import Projector, feasible_start

Vector = NDArray[np.float64]

# Size of the trial turn (rad) and the share of it that must survive for the turn to be possible.
_TRIAL, _SURVIVES = 0.05, 0.1
# Random feasible postures at which ranks are compared.
_SAMPLES = 4


def regularize(problem: PostureProblem) -> PostureProblem:
    """Choose an independent set of equality rows for the program; hold turns that exist to first order only.

    Four point feet on planar legs (solo8) are 12 equations of rank 10: two repeat others, and the base may roll to
    first order although any finite roll would spread the feet.  A program cannot live with either.  The rows that
    repeat others are left out of it (the certificate still checks them), and such a turn is held explicitly.
    """
    numeric = Numeric(problem.robot.model)
    jacobian = equality_jacobian(problem, numeric.at(problem.given))
    if rank(jacobian) == len(jacobian):
        return problem
    postures = _feasible_postures(problem)
    added, notes = [], []
    if problem.robot.floating:
        rotation = numeric.at(postures[0]).placement(base_point()).rotation.copy()
        for name, axis in zip(("roll", "pitch", "yaw"), np.eye(3), strict=True):
            turn = HeldTurn(base_point(), rotation, axis, f"base {name}")
            if _only_to_first_order(problem, numeric, turn, postures[0]):
                added.append(turn)
                notes.append(f"{turn.name} held: the feet allow it to first order only")
    problem = replace(problem, constraints=(*problem.constraints, *added), notes=(*problem.notes, *notes))
    # A posture may be singular by chance (a straight arm): only what repeats at the most regular one is left out.
    generic = max(postures, key=lambda q: rank(equality_jacobian(problem, numeric.at(q))))
    jacobian = equality_jacobian(problem, numeric.at(generic))
    if rank(jacobian) == len(jacobian):
        return problem
    return replace(problem, rows=_independent_rows(problem, numeric.at(generic)))


def _feasible_postures(problem: PostureProblem) -> list[Vector]:
    """The given posture pulled onto the constraints, and a few random feasible ones."""
    found = [Projector(problem).project(problem.given).q]
    found += [q for k in range(1, _SAMPLES + 1) if (q := feasible_start(problem, k, seed=0)) is not None]
    return found


def _only_to_first_order(problem: PostureProblem, numeric: Numeric, turn: HeldTurn, q: Vector) -> bool:
    """Whether the equalities' linearization at ``q`` allows a turn that the equalities themselves undo."""
    model = problem.robot.model
    jacobian = equality_jacobian(problem, numeric.at(q))
    free = scipy.linalg.null_space(jacobian, rcond=RANK_TOLERANCE)
    along = free @ (free.T @ turn.evaluate(numeric)[1][0])
    size = float(turn.evaluate(numeric)[1][0] @ along)
    if size < 1e-3:
        return False
    equalities = [c for c in problem.constraints if c.equality]
    start = [c.evaluate(numeric)[0] for c in equalities]
    q = pin.integrate(model, q, along * (_TRIAL / size))
    for _ in range(60):
        numeric.at(q)
        residual = np.concatenate(
            [np.zeros(len(held_rows(problem.robot, problem.requirements.hold)))]
            + [c.evaluate(numeric)[0] - s for c, s in zip(equalities, start, strict=True)]
        )
        step = -np.linalg.pinv(equality_jacobian(problem, numeric), rcond=1e-9) @ residual
        q = pin.integrate(model, q, step)
        if np.abs(step).max() < 1e-12:
            break
    turned = float(turn.evaluate(numeric.at(q))[0][0])
    return abs(turned) < _SURVIVES * _TRIAL


def _independent_rows(problem: PostureProblem, numeric: Numeric) -> tuple[tuple[int, ...], ...]:
    """For each constraint the rows that the program carries: all inequalities, independent equalities."""
    held = held_rows(problem.robot, problem.requirements.hold).sum(axis=0) > 0
    labels, blocks = [], []
    for index, constraint in enumerate(problem.constraints):
        if constraint.equality:
            blocks.append(constraint.evaluate(numeric)[1])
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
