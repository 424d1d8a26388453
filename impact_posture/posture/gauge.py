"""Fix what nothing determines: motions of the whole robot that neither constraints nor objective see."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from impact_posture.dynamics.numeric import Numeric
from impact_posture.impact.objective import ImpactObjective
from impact_posture.posture.constraint import Constraint, HeldPosition, HeldTurn
from impact_posture.posture.equalities import RANK_TOLERANCE, base_point
from impact_posture.robot.robot import Robot

if TYPE_CHECKING:
    from impact_posture.posture.problem import Requirements

Vector = NDArray[np.float64]


def pin_undetermined(
    robot: Robot,
    objective: ImpactObjective,
    numeric: Numeric,
    requirements: Requirements,
    constraints: Sequence[Constraint],
) -> tuple[list[Constraint], list[str]]:
    """Constraints that fix the base where nothing else does, and what to tell the user.

    The objective depends on the base through ``R_bᵀn`` alone: moving the whole robot, or turning it about n, changes
    nothing (with a normal that turns along, neither does any other turn).  What of these motions the constraints
    allow is fixed at its initial value.  A contact pose that is free also gives up yaw: turning the whole robot to
    the blow is no change of posture.  Blows along several normals see every turn.
    """
    if not robot.floating:
        return [], []
    base = base_point()
    placement = numeric.placement(base)
    move = np.linalg.pinv(numeric.jacobian(base))
    n = np.array(objective.contact.normal)
    world_normal = objective.contact.normal_frame == "world"
    turns = [n] if world_normal else list(np.eye(3))
    if world_normal and any(np.linalg.norm(np.cross(n, other.normal)) > 1e-9 for other in objective.others):
        turns = []
    if requirements.contact_pose == "free" and not objective.supports:
        turns.append(np.array([0.0, 0.0, 1.0]))
    blind = np.vstack([np.eye(6)[:3], *[np.concatenate([np.zeros(3), turn]) for turn in turns]]).T
    motions = move @ scipy.linalg.orth(blind)
    added: list[Constraint] = []
    notes: list[str] = []

    def free() -> Vector:
        """Base twists that are still allowed, world axes, shape (6, k)."""
        rows = [c.numeric(numeric)[1] @ motions for c in (*constraints, *added)]
        if not rows:
            return np.asarray(numeric.jacobian(base) @ motions)
        allowed = scipy.linalg.null_space(np.vstack(rows), rcond=RANK_TOLERANCE)
        return np.asarray(numeric.jacobian(base) @ motions @ allowed)

    # Positions are the base's own: a turn about another point moves them too, so turns are fixed first.
    candidates = [("yaw", np.array([0.0, 0.0, 1.0]))]
    candidates += [("turn about the normal", placement.rotation.T @ n)] if world_normal and turns else []
    candidates += [("roll", np.eye(3)[0]), ("pitch", np.eye(3)[1])]
    for name, axis in candidates:
        held = HeldTurn(base, placement.rotation, axis, f"base {name}")
        if np.abs(held.numeric(numeric)[1] @ move @ free()).max(initial=0.0) > 1e-3:
            added.append(held)
            notes.append(f"base {name} fixed at its initial value: nothing else determines it")
    if np.abs(free()[:3]).max(initial=0.0) > 1e-3:
        added.append(HeldPosition("base position", base, placement.translation))
        notes.append("base position fixed at its initial value: nothing else determines it")
    return added, notes
