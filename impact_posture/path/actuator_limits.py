"""Limits of motors, rotors and feet on the load of a motion."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pinocchio as pin

from impact_posture.impact.objective import Objective
from impact_posture.path.row_interpolation import Moment
from impact_posture.posture.constraints.requirements import Requirements
from impact_posture.posture.loads.load_cases import load_cases
from impact_posture.system.arrays import Array

# If the rotors miss a base wrench by less than this fraction of the weight, the difference is ignored.
_UNREACHABLE = 1e-7


@dataclass(frozen=True)
class Need:
    """The largest share of a limit that a motion needs; ``of`` names the limit."""

    share: float
    of: str


class ActuatorLimits:
    """Limits on the load ``M ν̇ + h`` of a motion.

    Motors, rotors and feet carry the load as in :class:`~impact_posture.posture.loads.equilibrium.Equilibrium`.
    The feet stay where they are at the posture ``q``, shape (nq,).  ``requirements`` contains the friction.
    ``names`` and ``kinds`` are the names and types (``torque`` or ``thrust``) of the actuators with limits.
    ``rotors`` states whether the robot flies with rotors.  ``missing`` is the reason why limits of the robot are
    unknown; empty if all are known.
    """

    def __init__(self, objective: Objective, q: Array, requirements: Requirements) -> None:
        robot = objective.robot
        self._model, self._velocities = robot.model.copy(), robot.tangent_names
        # During a motion, the rotors of motors turn with the joints, so the armature is included for every joint
        # model.
        self._model.armature = np.where(np.isfinite(robot.armature), robot.armature, 0.0)
        self._data = self._model.createData()
        self.rotors = bool(robot.floating and robot.spec.propulsion)
        loads = load_cases(objective, q, replace(requirements, hold_force=0.0))
        self.missing = loads.unknown
        self.names: tuple[str, ...] = ()
        self.kinds: tuple[str, ...] = ()
        if loads.cases:
            self._equilibrium = loads.cases[0].equilibrium
            self._unreachable = loads.cases[0].unreachable / self._equilibrium.weight
            self.names, self.kinds = self._equilibrium.actuators, self._equilibrium.kinds

    def load(self, q: Array, v: Array, a: Array) -> Array:
        """Return the generalized forces of a motion, ``M ν̇ + h``, shape (nv,), by RNEA with gravity and armature."""
        return np.array(pin.rnea(self._model, self._data, q, v, a))

    def largest_rate(self, q: Array, rest: Array, dynamic: Array) -> float | None:
        """Return the largest ``λ ≥ 0`` for which the limits allow the load ``rest + λ dynamic``, or infinity.

        A motion of duration ``T`` has the load of gravity plus ``1/T²`` times the dynamic load for ``T = 1 s``.  The
        largest ``λ`` is therefore ``1/T²``, where ``T`` is the duration of the fastest motion.  Return ``None`` if
        the limits do not even allow the load at rest.
        """
        if self._out_of_reach(rest):
            return None
        return 0.0 if self._out_of_reach(rest + dynamic) else self._equilibrium.largest_rate(q, rest, dynamic)

    def shares(self, q: Array, load: Array) -> Array | None:
        """Return the signed shares of the limits that a load needs, in the order of ``names``.

        A share is 0 in the middle of the range of an actuator, and ±1 at its limits.  The largest share is as small
        as possible.  Return ``None`` if rotors or friction do not allow the load.
        """
        return None if self._out_of_reach(load) else self._equilibrium.shares(q, load)

    def need(self, moment: Moment, speeds: Array, part: float = 1.0) -> Need:
        """Return the largest share of a limit at ``moment``; infinite if rotors or friction do not allow this motion.

        ``speeds`` are the velocity limits, shape (nv,).  Torques and thrusts may use only ``part`` of their ranges.
        """
        q, v, a = moment
        rates = np.abs(v) / speeds
        velocity = Need(float(rates.max()), f"the velocity of {self._velocities[int(rates.argmax())]}")
        shares = np.zeros(0) if self.missing else self.shares(q, self.load(q, v, a))
        if shares is None:
            return Need(np.inf, "the balance of the base")
        if not shares.size:
            return velocity
        k = int(np.abs(shares).argmax())
        actuator = Need(float(np.abs(shares[k])) / part, f"the {self.kinds[k]} of {self.names[k]}")
        return max(velocity, actuator, key=lambda need: need.share)

    def _out_of_reach(self, load: Array) -> bool:
        wrench = self._unreachable @ load[: self._unreachable.shape[1]] if len(self._unreachable) else np.zeros(0)
        return bool(np.abs(wrench).max(initial=0.0) > _UNREACHABLE)
