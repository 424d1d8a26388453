"""Velocity jumps with Coulomb friction, at one contact or at several contacts at once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from impact_posture.errors import MetricError
from impact_posture.impact.evaluation.velocity_jump import Jump, weighed_jump
from impact_posture.impact.friction.contact_impulses import contact_impulses
from impact_posture.impact.friction.coulomb_impact import coulomb_impact
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.system.arrays import Array

# If the slip velocity is below this fraction of the approach speed, the point sticks.
_SLIP = 1e-6


@dataclass(frozen=True, eq=False)
class CoulombJump(Jump):
    """A predicted velocity jump with friction.

    Attributes:
        friction: Coulomb friction coefficient of the contact.
        sticks: Whether the contact point sticks.
        slip_direction: Unit vector along the slip velocity, world axes, shape (3,); ``None`` if the point sticks.
    """

    friction: float
    sticks: bool
    slip_direction: Array | None

    @staticmethod
    def of(jump: Jump, impulse: Array, n: Array, friction: float, slip: Array) -> CoulombJump:
        """Extend ``jump`` by impulse, normal and slip velocity (per approach speed) of one contact, shapes (3,)."""
        size = float(np.linalg.norm(slip))
        direction = None if size <= _SLIP else slip / size
        return CoulombJump(
            **vars(jump) | {"impulse": impulse, "normal_impulse": float(n @ impulse)},
            friction=friction,
            sticks=direction is None,
            slip_direction=direction,
        )


def coulomb_jump(objective: WorstCaseObjective, q: Array, rebound: float) -> CoulombJump | None:
    """Return the jump with friction at the first contact for ``rebound = (1 + e) v_n``, m/s.

    Return ``None`` if the point would stick in a posture where S does not exist.
    """
    try:
        impact = coulomb_impact(objective.oracle, q)
    except MetricError:
        return None
    impulse = impact.impulse * rebound
    jump = weighed_jump(objective, impact.jump * rebound, impulse)
    return CoulombJump.of(jump, impulse, objective.oracle.n, objective.contact.friction, impact.slip)


def coulomb_jumps(objective: WorstCaseObjective, q: Array, speed: float | Array) -> tuple[CoulombJump, ...] | None:
    """Return the jump of a plastic impact of all contacts at once, as one entry per contact.

    Every contact point approaches along its normal at ``speed``, m/s; an array of shape (m,) gives each contact its
    own speed.  The entries differ only in impulse, friction and slip; all have the same velocity jump.  Return
    ``None`` if the contacts can pull, or if the iteration does not converge.
    """
    if objective.bilateral:
        return None
    oracles = [single.oracle.at(q) for single in objective.singles]
    J, normals = np.vstack([oracle.J for oracle in oracles]), np.array([oracle.n for oracle in oracles])
    friction = np.array([oracle.contact.friction for oracle in oracles])
    responses = objective.oracle.at(q).solve(J.T)
    B, fastest = J @ responses, float(np.max(speed))
    before = -normals * np.broadcast_to(speed / fastest, len(normals))[:, None]
    p = contact_impulses(B, before, normals, friction)
    if p is None:
        return None
    after = (B @ p.ravel()).reshape(p.shape) + before
    slips = after - normals * (after * normals).sum(1, keepdims=True)
    jump = weighed_jump(objective, fastest * (responses @ p.ravel()), fastest * p[0])
    each = zip(fastest * p, normals, friction, slips, strict=True)
    return tuple(CoulombJump.of(jump, impulse, n, float(mu), slip) for impulse, n, mu, slip in each)
