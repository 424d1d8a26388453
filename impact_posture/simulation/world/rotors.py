"""Propellers: speeds, thrusts, and the vibration that they cause."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from impact_posture.errors import InputError
from impact_posture.robot.actuation import thrust_limits
from impact_posture.robot.robot_spec import PropulsionSpec
from impact_posture.system.arrays import Array


class Rotors:
    """Speeds ω of the propellers, in the unit of ``speed_max``.

    Each command ω* is clipped to ``[speed_min, speed_max]``.  The speed follows the command with
    ``ω̇ = (ω* − ω)/τ``.  τ is ``time_constant_up`` if ω* > ω and ``time_constant_down`` otherwise.  Each step uses
    the exact solution.  The thrust is ``c_f ω²`` along the direction of the rotor.  The drag moment is ``κ`` times
    the thrust, against the spin.  Gyroscopic moments are not simulated, because the robot model has no inertias of
    propellers.

    Raises:
        SpecError: ``speed_min`` is not below ``speed_max``.
    """

    def __init__(self, propulsion: PropulsionSpec, timestep: float) -> None:
        thrust_limits(propulsion)
        self._lowest, self._highest = propulsion.speed_min, propulsion.speed_max
        self._up, self._down = -timestep / propulsion.time_constant_up, -timestep / propulsion.time_constant_down
        self._coefficient = propulsion.thrust_coefficient
        self.speeds: Array = np.full(len(propulsion.rotors), self._lowest)
        # n → ``exp(−k Δt/τ) − 1`` for the steps k = 1 … n, with τ up and with τ down, each of shape (n, 1).
        self._changes: dict[int, tuple[Array, Array]] = {}

    def reset(self, speeds: ArrayLike) -> None:
        """Set the speeds, shape (rotors,), after clipping to the limits.  The speeds must be finite."""
        speeds = np.asarray(speeds, dtype=float)
        if speeds.shape != self.speeds.shape or not np.isfinite(speeds).all():
            raise InputError(
                "the rotor speeds are invalid", where="reset", hint=f"give {self.speeds.size} finite numbers"
            )
        self.speeds = self.within(speeds)

    def within(self, command: Array) -> Array:
        """Return a command clipped to the limits."""
        return np.asarray(np.minimum(np.maximum(command, self._lowest), self._highest))

    def steps(self, command: Array, count: int) -> Array:
        """Take ``count`` steps under a command within the limits; return the speeds, shape (count, rotors)."""
        difference = command - self.speeds
        # A speed never overshoots its command, so the same time constant applies to all steps.
        speeds = self.speeds - np.where(difference > 0, *self._changes_in(count)) * difference
        self.speeds = speeds[-1]
        return np.asarray(speeds)

    def _changes_in(self, count: int) -> tuple[Array, Array]:
        if count not in self._changes:
            steps = np.arange(1.0, count + 1)[:, None]
            self._changes[count] = np.expm1(self._up * steps), np.expm1(self._down * steps)
        return self._changes[count]

    def in_c(self, count: int) -> dict[str, Any]:
        """Return the values of the rotors for the struct in ``c/world_ticks.c``; a tick has ``count`` steps."""
        up, down = self._changes_in(count)
        return {"rotors": self.speeds.size, "speeds": self.speeds, "phases": 0 * self.speeds, "up": up, "down": down,
                "lowest": self._lowest, "highest": self._highest, "thrust": self._coefficient}  # fmt: skip

    def thrusts(self, speeds: Array) -> Array:
        """Return the thrusts ``c_f ω²``, N, an array of the same shape as the speeds."""
        return np.asarray(self._coefficient * speeds**2)


class Vibration:
    """Vibration of unbalanced propellers, added to the measured twist of the base but not to its motion.

    Propeller i at ``p_i`` with unbalance U (kg·m) turns with the speed ω_i about ``d_i``.  The centrifugal force is
    ``U(2πω_i)² e_i``.  The unit vector ``e_i = cos φ_i x_i + s_i sin φ_i y_i`` turns in the plane of the propeller,
    with the spin ``s_i`` and ``φ̇_i = 2πω_i``.  The time integral of the force is the momentum
    ``f_i = 2πω_i U (sin φ_i x_i − s_i cos φ_i y_i)``.  With fixed joints, the resulting twist is
    ``Σ I⁻¹ [f_i; p_i × f_i]``, where I (6 × 6) is the inertia of the robot at the base.
    """

    def __init__(self, model: pin.Model, propulsion: PropulsionSpec, unbalance: float) -> None:
        frame = model.frames[model.getFrameId(propulsion.frame)].placement
        x: list[Array] = []
        y: list[Array] = []
        for rotor in propulsion.rotors:
            turn = pin.Quaternion.FromTwoVectors(np.array([0.0, 0, 1]), np.array(rotor.direction)).matrix()
            for axis, columns, sign in ((turn[:, 0], x, 1), (turn[:, 1], y, -rotor.spin)):
                force = sign * unbalance * axis
                columns.append(frame.act(pin.Force(force, np.cross(rotor.position, force))).vector)
        self._x, self._y = np.column_stack(x), np.column_stack(y)
        self._model, self._data = model, model.createData()
        self._inverse = np.zeros((6, 6))
        self.phases: Array = np.zeros(len(propulsion.rotors))

    def reset(self, q: Array, phases: Array) -> None:
        """Set the inertia at ``q``, shape (nq,), and the angles of the propellers, rad, shape (rotors,)."""
        M = np.triu(pin.crba(self._model, self._data, q)[:6, :6])
        self._inverse = np.linalg.inv(M + np.triu(M, 1).T)
        self.phases = np.array(phases)

    def steps(self, speeds: Array, timestep: float) -> Array:
        """Turn the propellers with ``speeds``, one row per step; return the angles, shape (count, rotors)."""
        phases = self.phases + 2 * np.pi * timestep * speeds.cumsum(axis=0)
        self.phases = phases[-1]
        return np.asarray(phases)

    def in_c(self) -> dict[str, Any]:
        """Return the values of the vibration for the struct in ``c/world_ticks.c``."""
        return {"vibrates": 1, "phases": self.phases, "along": self._x, "across": self._y, "inverse": self._inverse}

    def twist(self, speeds: Array, phases: Array) -> Array:
        """Return the error of the measured base twist in base axes, shape (6,)."""
        rates = 2 * np.pi * speeds
        return np.asarray(self._inverse @ (self._x @ (rates * np.sin(phases)) + self._y @ (rates * np.cos(phases))))
