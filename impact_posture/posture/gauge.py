"""Fix what nothing determines: motions of the whole robot that neither constraints nor objective see."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from impact_posture.dynamics.numeric import Numeric
from impact_posture.impact.objective import Objective
from impact_posture.posture.constraint import Constraint, HeldPosition, HeldTurn
from impact_posture.posture.equalities import RANK_TOLERANCE, base_point
from impact_posture.posture.problem import Requirements
from impact_posture.robot.robot import Robot

Vector = NDArray[np.float64]


def pin_undetermined(
    robot: Robot,
    objective: Objective,
    numeric: Numeric,
    requirements: Requirements,
    constraints: Sequence[Constraint],
) -> tuple[list[Constraint], list[str]]:
    """Constraints that fix the base where nothing else does, and what to tell the user.

    Moving the whole robot, or turning it about an axis that the objective does not see, changes nothing.  What of
    these motions the constraints allow is fixed at its initial value.  A free contact pose also gives up yaw:
    turning the whole robot towards the impact is no change of posture.
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
    motions = move @ scipy.linalg.orth(blind.T)
    added: list[Constraint] = []
    notes: list[str] = []

    def free() -> Vector:
        """Base twists that are still allowed, world axes, shape (6, k)."""
        rows = [c.evaluate(numeric)[1] @ motions for c in (*constraints, *added)]
        if not rows:
            return np.asarray(numeric.jacobian(base) @ motions)
        allowed = scipy.linalg.null_space(np.vstack(rows), rcond=RANK_TOLERANCE)
        return np.asarray(numeric.jacobian(base) @ motions @ allowed)

    # Positions are the base's own: a turn about another point moves them too, so turns are fixed first.
    candidates = [("yaw", np.array([0.0, 0.0, 1.0]))]
    if len(turns) == 1:
        candidates.append(("turn about the normal", placement.rotation.T @ turns[0]))
    candidates += [("roll", np.eye(3)[0]), ("pitch", np.eye(3)[1])]
    for name, axis in candidates:
        held = HeldTurn(base, placement.rotation, axis, f"base {name}")
        if np.abs(held.evaluate(numeric)[1] @ move @ free()).max(initial=0.0) > 1e-3:
            added.append(held)
            notes.append(f"base {name} fixed at its initial value: nothing else determines it")
    if np.abs(free()[:3]).max(initial=0.0) > 1e-3:
        added.append(HeldPosition("base position", base, placement.translation))
        notes.append("base position fixed at its initial value: nothing else determines it")
    return added, notes
