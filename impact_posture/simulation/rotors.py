"""Propellers: speeds that follow their commands with a lag, within their limits."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray

from impact_posture.errors import InputError
from impact_posture.robot.actuation import thrust_limits
from impact_posture.robot.spec import PropulsionSpec

Array = NDArray[np.float64]


class Rotors:
    """Speeds ω of the propellers, in the unit of ``speed_max``.

    ``ω̇ = (ω* − ω)/τ`` with the command ω* cut to ``[speed_min, speed_max]`` and τ the time constant up (ω* > ω) or
    down, integrated exactly over a step.  Thrust is ``c_f ω²`` along each rotor's direction, the drag moment ``κ``
    times that against its spin.  The propellers' own inertia is not in the model: no gyroscopic moment.

    Args:
        propulsion: Of the robot.
        timestep: Seconds.

    Raises:
        SpecError: Limits that are none.
    """

    def __init__(self, propulsion: PropulsionSpec, timestep: float) -> None:
        thrust_limits(propulsion)
        self._lowest, self._highest = propulsion.speed_min, propulsion.speed_max
        self._up = -np.expm1(-timestep / propulsion.time_constant_up)
        self._down = -np.expm1(-timestep / propulsion.time_constant_down)
        self._coefficient = propulsion.thrust_coefficient
        self.speeds: Array = np.full(len(propulsion.rotors), self._lowest)

    def reset(self, speeds: ArrayLike) -> None:
        """Turn at these speeds, cut to the limits.

        Raises:
            InputError: Not one finite number a rotor.
        """
        speeds = np.asarray(speeds, dtype=float)
        if speeds.shape != self.speeds.shape or not np.isfinite(speeds).all():
            raise InputError("no speeds of the rotors", where="reset", hint=f"give {self.speeds.size} finite numbers")
        self.speeds = self.within(speeds)

    def within(self, command: Array) -> Array:
        """A command cut to the limits."""
        return np.asarray(np.clip(command, self._lowest, self._highest))

    def step(self, command: Array) -> Array:
        """Go on by a time step under a command within the limits; the thrusts (N) at its end, shape (rotors,)."""
        away = command - self.speeds
        self.speeds = self.speeds + np.where(away > 0, self._up, self._down) * away
        return self.thrusts

    @property
    def thrusts(self) -> Array:
        """``c_f ω²``, N, shape (rotors,)."""
        return np.asarray(self._coefficient * self.speeds**2)


class Vibration:
    """The shaking of unbalanced propellers as the base's sensors see it; the body itself is left alone.

    Propeller i at ``p_i`` with unbalance U (kg·m) turns with ω_i about ``d_i`` and pulls with ``U(2πω_i)² e_i``.  In
    its disc ``e_i = cos φ_i x_i + s_i sin φ_i y_i`` turns with its spin ``s_i``, ``φ̇_i = 2πω_i``.  Integrated over
    time with the joints held, that is the twist ``Σ I⁻¹ [f_i; p_i × f_i]`` with the momentum
    ``f_i = 2πω_i U (sin φ_i x_i − s_i cos φ_i y_i)`` and the robot's inertia I at the base (6 × 6).

    Args:
        model: The robot.
        propulsion: Its rotors; speeds in Hz.
        unbalance: U, kg·m.
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
        """Take the inertia at a configuration, shape (nq,), and the propellers' angles, shape (rotors,), rad."""
        M = np.triu(pin.crba(self._model, self._data, q)[:6, :6])
        self._inverse = np.linalg.inv(M + np.triu(M, 1).T)
        self.phases = np.array(phases)

    def step(self, speeds: Array, timestep: float) -> None:
        """Turn on."""
        self.phases = self.phases + 2 * np.pi * timestep * speeds

    def twist(self, speeds: Array, phases: Array) -> Array:
        """What the base's measured twist has too much, base axes, shape (6,)."""
        rates = 2 * np.pi * speeds
        return np.asarray(self._inverse @ (self._x @ (rates * np.sin(phases)) + self._y @ (rates * np.cos(phases))))
