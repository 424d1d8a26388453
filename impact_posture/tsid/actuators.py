"""Actuation as the programs use it: ``M ν̇ + h = G u + …`` solved for ``u``."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from impact_posture.robot.actuation import actuation_matrix, thrust_limits
from impact_posture.robot.robot import Robot

Array = NDArray[np.float64]


class Actuators:
    """``G`` taken apart once: which forces it makes, which it cannot, and where it has a choice.

    ``G = blkdiag(G_b, I)`` with ``G_b`` (6 × rotors) constant, as generalized forces are dual to ν.  For a
    generalized force ``p = Mν̇ + h − …``:

    - ``blindᵀ p = 0`` is what the rotors leave unactuated (6 rows for a legged robot, none for six good rotors);
    - ``u = [G_b⁺ p_b + spare w; p_joints]``, where ``w`` is what more rotors than needed leave to choose.

    Attributes:
        rotors: Number of rotors.
        base: 6 for a floating base, else 0.
        G: Shape (nv, controls).
        inverse: ``G_b⁺``, shape (rotors, base).
        blind: Orthonormal basis of what ``G_b`` does not reach, shape (base, base − rank).
        spare: Orthonormal basis of ``G_b``'s null space, shape (rotors, rotors − rank).
        rank: Of ``G_b``.
        condition: Largest over smallest singular value of ``G_b`` (mixes N and N·m); 1 without rotors, infinite below
            full rank.
        lower: Rotor thrusts (N) and joint torques (N·m), shape (controls,).
        upper: As ``lower``; infinite where the model states no effort limit (or zero).
        names: Of the controls.
    """

    def __init__(self, robot: Robot) -> None:
        propulsion = robot.spec.propulsion
        self._propulsion = propulsion
        self.base = 6 if robot.floating else 0
        self.G = actuation_matrix(robot.model, propulsion)
        self.rotors = 0 if propulsion is None else len(propulsion.rotors)
        block = self.G[: self.base, : self.rotors]
        if self.rotors:
            left, values, right = np.linalg.svd(block)
            self.rank = int(np.count_nonzero(values > 1e-9 * values[0]))
            self.condition = float(values[0] / values[-1]) if self.rank == min(block.shape) else float("inf")
            kept = values[: self.rank]
            self.inverse = np.ascontiguousarray(right[: self.rank].T / kept @ left[:, : self.rank].T)
            self.blind = np.ascontiguousarray(left[:, self.rank :])
            self.spare = np.ascontiguousarray(right[self.rank :].T)
        else:
            self.rank, self.condition = 0, 1.0
            self.inverse, self.blind, self.spare = np.zeros((0, self.base)), np.eye(self.base), np.zeros((0, 0))
        effort = np.asarray(robot.model.effortLimit, dtype=float)[self.base :]
        effort = np.where(effort > 0, effort, np.inf)
        low, high = (0.0, 0.0) if propulsion is None else thrust_limits(propulsion)
        self.lower = np.concatenate([np.full(self.rotors, low), -effort])
        self.upper = np.concatenate([np.full(self.rotors, high), effort])
        rotor_names = () if propulsion is None else tuple(rotor.name for rotor in propulsion.rotors)
        self.names = (*rotor_names, *robot.tangent_names[self.base :])

    @property
    def controls(self) -> int:
        """Number of entries of ``u``."""
        return int(self.G.shape[1])

    def solve(self, force: Array, spare: Array) -> Array:
        """``u`` that makes the generalized force, shape (nv,), with the choice ``w``; a fresh array (controls,)."""
        u = np.empty(self.controls)
        u[self.rotors :] = force[self.base :]
        if self.rotors:
            np.matmul(self.inverse, force[: self.base], out=u[: self.rotors])
            if spare.size:
                u[: self.rotors] += self.spare @ spare
        return u

    def rotor_speeds(self, thrusts: Array) -> Array:
        """Speeds in the unit of ``speed_max``: ``√(thrust/c_f)``, zero for a negative thrust; shape (rotors,)."""
        if self._propulsion is None:
            return np.zeros(0)
        return np.asarray(np.sqrt(np.maximum(thrusts, 0.0) / self._propulsion.thrust_coefficient))
