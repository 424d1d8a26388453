"""Actuation of a robot: solve ``M ν̇ + h = G u + …`` for the controls ``u``."""

from __future__ import annotations

import numpy as np

from impact_posture.errors import InputError
from impact_posture.robot.actuation import actuation_matrix, thrust_limits, torque_limits
from impact_posture.robot.robot import Robot
from impact_posture.system.arrays import Array


class Actuators:
    """Actuation matrix ``G = blkdiag(G_b, I)``, with pseudo-inverse, null space and control limits.

    ``G_b`` (6 × rotors) maps rotor thrusts to the wrench on the base, in base axes.  A generalized force
    ``p = [p_b; p_joints]`` can be produced only if ``blindᵀ p_b = 0``.  ``blind`` has 6 columns for a legged robot
    and none for six independent rotors.  The controls are then ``u = [G_b⁺ p_b + spare w; p_joints]``.  With
    redundant rotors, ``w`` selects one of the possible thrust vectors.

    Attributes:
        rotors: Number of rotors.
        base: Number of velocity entries of the base: 6 for a floating base, otherwise 0.
        G: Actuation matrix, shape (nv, controls).
        inverse: Pseudo-inverse ``G_b⁺``, shape (rotors, base).
        blind: Orthonormal basis of the base wrenches that rotors cannot produce, shape (base, base − rank).
        spare: Orthonormal basis of the null space of ``G_b``, shape (rotors, rotors − rank).
        rank: Rank of ``G_b``.
        lower: Lower limits of rotor thrusts (N), then of joint torques (N·m), shape (controls,).
        upper: Upper limits in the same order; infinite for joints whose effort limit is missing or zero.
        names: Names of the controls.

    Raises:
        InputError: A joint follows another joint (:class:`JointCoupling`), and robot.toml does not lock both joints.
    """

    def __init__(self, robot: Robot) -> None:
        held = robot.fixed_with(robot.held)
        for c in robot.couplings:
            if c.follower not in held:
                fault = f"the controller drives every joint separately, but '{c.follower}' is coupled to '{c.leader}'"
                hint = "`lock` both, or list them in robot.toml [constraints] hold"
                raise InputError(fault, where=robot.name, hint=hint)
        propulsion = robot.spec.propulsion
        self._propulsion = propulsion
        self.base = robot.first_joint
        self.G = actuation_matrix(robot.model, propulsion)
        rotor_names = () if propulsion is None else tuple(rotor.name for rotor in propulsion.rotors)
        self.rotors = len(rotor_names)
        left, values, right = np.linalg.svd(self.G[: self.base, : self.rotors])
        self.rank = int(np.count_nonzero(values > 1e-9 * values.max(initial=0.0)))
        self.inverse = np.ascontiguousarray(right[: self.rank].T / values[: self.rank] @ left[:, : self.rank].T)
        self.blind = np.ascontiguousarray(left[:, self.rank :])
        self.spare = np.ascontiguousarray(right[self.rank :].T)
        effort = torque_limits(robot.model)[self.base :]
        low, high = (0.0, 0.0) if propulsion is None else thrust_limits(propulsion)
        self.lower = np.concatenate([np.full(self.rotors, low), -effort])
        self.upper = np.concatenate([np.full(self.rotors, high), effort])
        self.names = (*rotor_names, *robot.tangent_names[self.base :])

    @property
    def controls(self) -> int:
        """Number of entries of ``u``."""
        return int(self.G.shape[1])

    def solve(self, force: Array, spare: Array) -> Array:
        """Return the controls ``u``, shape (controls,), in a new array.

        ``force`` is the generalized force ``p``, shape (nv,).  ``spare`` is ``w``, the coordinates of the thrusts in
        the null space of ``G_b``.
        """
        return np.concatenate([self.inverse @ force[: self.base] + self.spare @ spare, force[self.base :]])

    def rotor_speeds(self, thrusts: Array) -> Array:
        """Return the rotor speeds ``√(thrust/c_f)`` in the unit of ``speed_max``; a negative thrust gives zero."""
        if self._propulsion is None:
            return np.zeros(0)
        return np.asarray(np.sqrt(np.maximum(thrusts, 0.0) / self._propulsion.thrust_coefficient))
