"""What the actuators and the ground can do along a motion: torques, rotor thrusts and friction."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pinocchio as pin

from impact_posture.arrays import Array
from impact_posture.dynamics.numeric import Numeric
from impact_posture.impact.contact import Support, point_on
from impact_posture.impact.contact_stability import FrictionCones
from impact_posture.robot.actuation import allocation_matrix, thrust_limits
from impact_posture.robot.robot import Robot


class ActuatorLimits:
    """Generalized forces ``[thrusts; torques] + J_sᵀ f`` within the limits of motors, rotors and friction cones.

    The equation of motion is ``M ν̇ + h = G u + J_sᵀ f`` with ``u = [rotor thrusts (N); joint torques (N·m)]`` and the
    forces ``f`` of the ground on the supports, in linear pyramids inside the friction cones.  Thrusts and forces are
    variables of a linear program, scaled by their ranges and by the weight.

    Args:
        robot: The robot.
        supports: Feet that stay on the ground.
        friction: Friction coefficient of the feet.

    Attributes:
        names: Names of the joint entries behind a floating base, then of the rotors.
        effort: Torque limits of the joint entries, infinite where there is none.
        missing: Why the limits of this robot are not known; empty if they are.
    """

    def __init__(self, robot: Robot, supports: Sequence[Support], friction: float) -> None:
        self._robot, self._supports, self._friction = robot, tuple(supports), friction
        self._model = robot.model.copy()
        self._numeric = Numeric(robot.model)
        # The rotors move with their joints, whatever an impact meets of them.
        self._model.armature = np.where(np.isfinite(robot.armature), robot.armature, 0.0)
        self._data = self._model.createData()
        self._base = 6 if robot.floating else 0
        effort = np.array(self._model.effortLimit)[self._base :]
        self.effort = np.where(np.isfinite(effort) & (effort > 0) & (effort < 1e10), effort, np.inf)
        propulsion = robot.spec.propulsion if robot.floating else None
        self._allocation = np.zeros((self._base, 0))
        self._low = self._high = 0.0
        if propulsion is not None:
            self._allocation = allocation_matrix(robot.model, propulsion)
            self._low, self._high = thrust_limits(propulsion)
        rotors = [] if propulsion is None else [rotor.name for rotor in propulsion.rotors]
        self.names = [*robot.tangent_names[self._base :], *rotors]
        held = bool(self._supports) or propulsion is not None
        self.missing = ""
        if robot.floating and not held:
            self.missing = "neither rotors nor feet on the ground are known"
        elif not np.isfinite(self.effort).any():
            self.missing = "no torque limits are known"

    def load(self, q: Array, v: Array, a: Array) -> Array:
        """Return the generalized forces of a motion, ``M ν̇ + h``, shape (nv,), by RNEA with gravity and armature."""
        return np.array(pin.rnea(self._model, self._data, q, v, a))

    def largest_rate(self, q: Array, rest: Array, dynamic: Array) -> float | None:
        """Return the largest ``λ ≥ 0`` for which the limits allow the load ``rest + λ dynamic``; infinite if all do.

        A motion that takes the time ``T`` has the load of gravity and ``1/T²`` times that of ``T = 1 s``.  So this is
        the least duration at a posture.  ``None`` if the limits do not even allow the load at rest.
        """
        found = self._program(q, rest, dynamic, largest=True)
        return None if found is None else float("inf") if found[0] > _MOST * (1 - 1e-9) else float(found[0])

    def shares(self, q: Array, load: Array) -> Array | None:
        """Return the shares of the limits that a load takes, the largest as small as possible, by name.

        The share of a joint is ``|τ|/τ_max``, or zero without a limit.  That of a rotor is the distance of its thrust
        from the middle of its range over half of the range.  ``None`` if rotors or friction do not allow the load.
        """
        if not self._base:
            return np.abs(load) / self.effort
        found = self._program(q, load, load, largest=False)
        return None if found is None else found[1]

    def _program(self, q: Array, rest: Array, dynamic: Array, *, largest: bool) -> tuple[float, Array] | None:
        """Maximize λ within all limits, or minimize the share of the limits σ, over ``[thrusts, f, λ or σ]``."""
        from scipy.optimize import linprog

        base, rotors, limited = self._base, self._allocation.shape[1], np.isfinite(self.effort)
        weight = float(pin.computeTotalMass(self._model)) * 9.81
        jacobian, cones = self._feet(q)
        forces, middle, half = len(jacobian), (self._high + self._low) / 2, (self._high - self._low) / 2
        last = dynamic if largest else np.zeros_like(rest)
        # Base rows: G u + J_sᵀ f − λ dynamic = rest, with u = middle + half · y and f = weight · y.
        into = np.hstack([half * self._allocation, weight * jacobian[:, :base].T, -last[:base, None]])
        onto = rest[:base] - middle * self._allocation.sum(axis=1)
        # Joint rows: ± (rest + λ dynamic − J_sᵀ f) ≤ τ_max, or ≤ σ τ_max.
        effort = self.effort[limited]
        torque = np.hstack([
            np.zeros((len(effort), rotors)), -weight * jacobian[:, base:].T[limited], last[base:][limited, None]
        ]) / effort[:, None]  # fmt: skip
        constant = rest[base:][limited] / effort
        thrust = np.hstack([np.eye(rotors), np.zeros((rotors, forces + 1))])
        rows, right = np.vstack([torque, -torque, thrust, -thrust]), np.ones(2 * (len(effort) + rotors))
        if not largest:
            rows[:, -1], right = -1.0, 0.0 * right
        right[: 2 * len(effort)] -= np.concatenate([constant, -constant])
        slip = np.hstack([np.zeros((len(cones), rotors)), cones, np.zeros((len(cones), 1))])
        cost = np.zeros(rotors + forces + 1)
        cost[-1] = -1.0 if largest else 1.0
        found = linprog(
            cost,
            A_ub=np.vstack([rows, slip]),
            b_ub=np.concatenate([right, np.zeros(len(slip))]),
            A_eq=into / weight if base else None,
            b_eq=onto / weight if base else None,
            bounds=[(None, None)] * (rotors + forces) + [(0.0, _MOST if largest else None)],
        )
        if found.status != 0:
            return None
        y = found.x
        used = np.zeros(len(limited))
        used[limited] = np.abs(torque[:, :-1] @ y[:-1] + constant)
        return float(y[-1]), np.concatenate([used, np.abs(y[:rotors])])

    def _feet(self, q: Array) -> tuple[Array, Array]:
        """Return the stacked Jacobians of the supports, shape (forces, nv), and the pyramids ``A f ≤ 0``."""
        if not self._supports:
            return np.zeros((0, self._robot.nv)), np.zeros((0, 0))
        numeric = self._numeric.at(q)
        points = [point_on(self._robot, s.frame, s.offset) for s in self._supports]
        axes = [numeric.placement(point).rotation for point in points]
        blocks = [numeric.jacobian(p)[: s.rows] for p, s in zip(points, self._supports, strict=True)]
        return np.vstack(blocks), FrictionCones(self._supports, axes).matrix(self._friction)[0]


# Rate above which a motion meets no limit of the actuators.
_MOST = 1e6
