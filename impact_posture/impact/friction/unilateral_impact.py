"""The impact of a standing robot whose feet can lift and slide.

The metric assumes that the ground can also pull the feet.  In this module, the ground only pushes, within the
friction cone.  Over the compression time T, the ground also carries the weight, and the motor torques do not change.
Let ``f`` be the force of a foot before the impact, ``P`` the whole impulse of the ground, and ``p`` the impulse of
the hit surface:

    ``M Δν = Jᵀp + J_sᵀ(P − fT)``.

:mod:`~impact_posture.impact.friction.contact_impulses` states the conditions for ``p`` and ``P``.  The forces ``f``
are computed for a robot with locked joints that stands on the same feet.

The force of a linear contact is a quarter of a sine wave, and it is largest at T.  The impact is therefore solved in
steps, in which the approach speed falls as ``v cos(πt/2T)``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from impact_posture.dynamics.numeric import reduced
from impact_posture.impact.friction.contact_impulses import contact_impulses
from impact_posture.impact.quantities.impact_oracle import ImpactOracle
from impact_posture.robot.robot_spec import Support
from impact_posture.system.arrays import Array

# A contact point moves if its speed is above this fraction of the approach speed.  A moving point lifts if its upward
# speed is above a tenth of this fraction; otherwise it slides.
_MOVES = 0.01
# Number of steps into which an impact is divided if the weight of the robot is included.
_STEPS = 8
# Resolution of the shortest contact time at which the feet stay, as a fraction of the largest time.
_SHORTEST = 1e-4
# A robot with locked joints stands if its feet balance the weight up to this fraction of the weight.
_STANDS = 1e-6


@dataclass(frozen=True, eq=False)
class UnilateralImpact:
    """The impact of a standing robot whose feet can lift and slide.

    Attributes:
        jump: Velocity jump Δν, shape (nv,).
        impulses: Impulses of the hit surfaces on the robot, world axes, N·s, shape (contacts, 3).
        lifts: Frames of the feet that leave the ground, or whose sole tips about an edge.
        slides: Frames of the feet that slide without lifting.
    """

    jump: Array
    impulses: Array
    lifts: tuple[str, ...]
    slides: tuple[str, ...]


class StandingFeet:
    """The contact points of the feet at one posture: their Jacobian, and the forces that carry the weight.

    A sole of known size touches the ground at its four corners.  Any other foot has one contact point.

    Attributes:
        frames: Frame of the foot for each contact point.
        jacobian: Linear Jacobian of the contact points, world axes, shape (3k, nv).
        forces: Forces that carry the weight, world axes, N, shape (k, 3); ``None`` if the robot would tip or slide
            even with locked joints.
    """

    def __init__(self, oracle: ImpactOracle, supports: Sequence[Support], q: Array, friction: float) -> None:
        oracle.at(q)
        self._oracle, self._q, self.friction = oracle, q, friction
        self.frames: list[str] = []
        rows = []
        for foot, support in zip(oracle.feet, supports, strict=True):
            J, R = oracle.numeric.jacobian(foot.point), oracle.numeric.placement(foot.point).rotation
            X, Y = support.size if support.has_sole else (0.0, 0.0)
            corners = [R @ (x, y, 0.0) for x in (-X, X) for y in (-Y, Y)] if support.has_sole else [np.zeros(3)]
            rows += [J[:3] - pin.skew(corner) @ J[3:] for corner in corners]
            self.frames += [support.frame] * len(corners)
        self.normals = np.tile([0.0, 0.0, 1.0], (len(self.frames), 1))
        M = oracle.numeric.mass_matrix()
        self.M, self.jacobian = reduced(oracle.robot.projector, M, np.vstack(rows))
        self.forces = self._carried()

    def respond(self, J: Array) -> Array:
        """Return ``M⁻¹Jᵀ``, shape (nv, rows of ``J``)."""
        return np.asarray(self._oracle.robot.projector @ np.linalg.solve(self.M, J.T))

    def _carried(self) -> Array | None:
        """Compute the forces that carry the weight as impulses that stop a rigid robot after a fall of 1 s."""
        model, base = self._oracle.robot.model, self.jacobian[:, :6]
        fall = np.tile(np.array(model.gravity.linear), (len(self.frames), 1))
        B = base @ np.linalg.solve(self._oracle.numeric.mass_matrix()[:6, :6], base.T)
        forces = contact_impulses(B, fall, self.normals, np.full(len(self.frames), self.friction))
        if forces is None:
            return None
        weight = pin.computeGeneralizedGravity(model, model.createData(), self._q)[:6]
        falls = np.abs(base.T @ forces.ravel() - weight).max() > _STANDS * np.abs(weight).max()
        return None if falls else forces


def unilateral_impact(
    feet: StandingFeet, hit: Sequence[ImpactOracle], speed: float, time: float = 0.0
) -> UnilateralImpact | None:
    """Compute the impact with feet that can lift and slide.

    ``hit`` are the oracles of the hit contacts at the posture of ``feet``.  ``speed`` is ``(1 + e) v_n``, m/s, and
    ``time`` the compression time T, s.  Return ``None`` if no impulses fulfill the conditions, or if ``time`` is
    above zero and the robot cannot stand in this posture.
    """
    if time > 0 and feet.forces is None:
        return None
    # The hit contacts come first, followed by the contact points of the feet.
    count, normals = len(hit), np.vstack([*(oracle.n for oracle in hit), feet.normals])
    J = np.vstack([*(oracle.J for oracle in hit), feet.jacobian])
    friction = np.array([*(oracle.contact.friction for oracle in hit), *[feet.friction] * len(feet.frames)])
    responses = feet.respond(J)
    B = J @ responses
    # The remaining approach speed after each step.
    left = speed * np.cos(np.pi / 2 * np.linspace(0, 1, _STEPS + 1)[1:]) if time > 0 else np.zeros(1)
    weight = np.zeros(normals.shape)
    if time > 0 and feet.forces is not None:
        weight[count:] = time / len(left) * feet.forces
    jump, impulses = np.zeros(feet.M.shape[0]), np.zeros((count, 3))
    fastest, up = np.zeros(len(feet.frames)), np.zeros(len(feet.frames))
    for speed_left in left:
        start = (J @ jump - B @ weight.ravel()).reshape(weight.shape)
        start[:count] -= (speed - speed_left) * normals[:count]
        P = contact_impulses(B, start, normals, friction)
        if P is None:
            return None
        jump, impulses = jump + responses @ (P - weight).ravel(), impulses + P[:count]
        velocities = (feet.jacobian @ jump).reshape(-1, 3)
        fastest = np.maximum(fastest, np.linalg.norm(velocities, axis=1))
        up = np.maximum(up, velocities[:, 2])
    moves = fastest > _MOVES * speed
    lifting = moves & (up > _MOVES / 10 * speed)
    lifts, moving = (dict.fromkeys(np.array(feet.frames)[points].tolist()) for points in (lifting, moves))
    return UnilateralImpact(jump, impulses, tuple(lifts), tuple(frame for frame in moving if frame not in lifts))


def longest_lifting_time(feet: StandingFeet, hit: Sequence[ImpactOracle], speed: float, most: float = 1.0) -> float:
    """Return the compression time, s, above which no foot lifts or slides; infinite if above ``most``.

    The impulse of the weight on a foot grows with the compression time, so bisection finds the time up to 5 %.
    """

    def moves(time: float) -> bool:
        impact = unilateral_impact(feet, hit, speed, time)
        return impact is None or bool(impact.lifts or impact.slides)

    if moves(most):
        return np.inf
    low, high = most * _SHORTEST, most
    if not moves(low):
        return 0.0 if not moves(0.0) else low
    while high > 1.05 * low:
        middle = float(np.sqrt(low * high))
        low, high = (middle, high) if moves(middle) else (low, middle)
    return high
