"""Limits of the joint rates and torques in an impact at the next tick."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from impact_posture.robot.actuation import torque_limits
from impact_posture.robot.robot import Robot
from impact_posture.system.arrays import Array
from impact_posture.tsid.joint_ranges import JointRanges
from impact_posture.tsid.point_kinematics import Point
from impact_posture.tsid.state import PERIOD, State
from impact_posture.tsid.support_contact import SupportContact

# Singular values of a contact Jacobian below this fraction of the largest singular value are treated as zero.
_RANK = 1e-6


def supported_inverse(state: State, contacts: Sequence[SupportContact]) -> Array:
    """Return the inverse mass matrix of the robot on its contacts, shape (nv, nv).

    Without contacts, the result is ``M⁻¹``.  Contacts with the Jacobian ``J_s`` do not move during the impact, so the
    result is ``M⁻¹ − M⁻¹J_sᵀ(J_s M⁻¹J_sᵀ)⁺J_s M⁻¹``.
    """
    robot, M = state.robot, state.M
    if robot.couplings:
        C = robot.coupling_matrix
        inverse = C @ np.linalg.inv(C.T @ M @ C + np.diag(robot.followers)) @ C.T
    else:
        inverse = np.linalg.inv(M)
    if not contacts:
        return np.asarray(inverse)
    held = np.vstack([state.at(c.point).jacobian[: c.size] for c in contacts])
    back = held @ inverse
    return np.asarray(inverse - back.T @ np.linalg.pinv(back @ held.T, rcond=_RANK, hermitian=True) @ back)


class ImpactLimits:
    """Limit the effects of an impact at the next tick (Wang et al. 2020, impact-aware constraints).

    Just before the impact, the robot has the velocity ``ν⁻ = ν + ν̇ dt`` of the next tick.  With restitution ``e`` and
    ``M_c⁻¹`` from :func:`supported_inverse`, the impulse is ``λ = −(1 + e) (J M_c⁻¹Jᵀ)⁻¹ n nᵀJ ν⁻``.  The velocity
    jump is ``Δν = M_c⁻¹Jᵀ λ``.  Impulse and jump are linear in ``ν̇``.  For each joint, the limits are

    - ``|q̇⁻ + Δq̇| ≤ q̇_max`` for the rate after the impact;
    - ``|Jᵀλ|/δt ≤ τ_max`` for the mean torque during the impact, which lasts ``δt``.

    The controller can satisfy these limits only by a slower approach.  A joint is limited only if the model has a
    limit for this joint.

    Attributes:
        active: Whether an impact is expected; if false, the limits are off.
        restitution: Coefficient of restitution ``e``.
        duration: Duration ``δt`` of the impact, s.
        size: Number of rows.
        points: Points of the robot whose kinematics the limits read from the state.

    Args:
        robot: The robot.
        point: The point of the robot that hits the surface.
        normal: Unit normal out of the surface, world, shape (3,).
        contacts: Contacts that do not move during the impact.
        period: Time ``dt`` to the next tick, s.
    """

    name = "impact limits"
    restitution = 0.0
    duration = 5e-3

    def __init__(
        self,
        robot: Robot,
        point: Point,
        normal: ArrayLike,
        contacts: Sequence[SupportContact] = (),
        period: float = PERIOD,
    ) -> None:
        self._first = robot.first_joint
        self._torque = torque_limits(robot.model)[self._first :]
        self._rate = JointRanges(robot).velocity[self._first :]
        self._contacts, self._point, self.points = tuple(contacts), point, (point, *(c.point for c in contacts))
        self._normal, self._period = np.array(normal, dtype=float), period
        self.size, self.active = 2 * self._rate.size, False

    def jump(self, state: State) -> tuple[Array, Array]:
        """Return two matrices, shape (nv, nv) each: ``ν⁻`` → ``Δν``, and ``ν⁻`` → generalized impulse ``Jᵀλ``."""
        J = state.at(self._point).jacobian[:3]
        spread = supported_inverse(state, self._contacts) @ J.T
        mass = np.linalg.pinv(J @ spread, rcond=_RANK, hermitian=True)
        impulse = -(1 + self.restitution) * np.outer(mass @ self._normal, self._normal @ J)
        return spread @ impulse, state.robot.coupling_matrix.T @ J.T @ impulse

    def rows(self, state: State) -> tuple[Array, Array, Array]:
        """Return the rows on ``ν̇``, their lower bounds and their upper bounds.

        The first half of the rows limits the joint rates after the impact; the second half limits the impulsive
        torques.
        """
        nothing = np.full(self.size, np.inf)
        if not self.active:
            return np.zeros((self.size, state.nv)), -nothing, nothing
        jumps, impulses = self.jump(state)
        A = np.vstack([(np.eye(state.nv) + jumps)[self._first :], impulses[self._first :] / self.duration])
        now = A @ state.v
        most = np.concatenate([self._rate, self._torque])
        return self._period * A, -most - now, most - now
