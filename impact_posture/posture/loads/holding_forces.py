"""The forces that hold a posture: the torque or thrust of each actuator with its limits, and the foot forces."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from impact_posture.config.json_block import JsonBlock
from impact_posture.posture.loads.equilibrium import Equilibrium
from impact_posture.system.arrays import Array

# Largest rounding error of the solver: in a share, and in an unbalanced wrench in units of the robot's weight.
_ROUNDING = 1e-6


@dataclass(frozen=True)
class ActuatorLoad(JsonBlock):
    """Torque (N·m), force of a prismatic joint (N) or thrust (N) of an actuator, with its limits.

    ``share`` is the distance of ``value`` from the middle of the range, divided by half the range; it is 1 at a
    limit.
    """

    value: float
    low: float
    high: float
    share: float
    unit: str


@dataclass(frozen=True)
class HoldingForces(JsonBlock):
    """Forces that hold a posture and minimize the largest :attr:`ActuatorLoad.share`.

    Attributes:
        load: Name of the load, such as ``at rest``.
        feasible: Whether the robot can hold the posture under this load.
        unbalanced: Sum of the absolute entries of the unbalanced wrench on the base.  Forces are in units of the
            robot's weight, moments in units of the weight times 1 m.
        actuators: Load of each actuator with known limits.
        contact_forces: Force of the ground on each foot, world axes, N.
        other_loads: Holding forces under the other loads: with the force ``hold_force`` and with payloads.
    """

    load: str
    feasible: bool
    largest_share: float
    unbalanced: float
    actuators: dict[str, ActuatorLoad]
    contact_forces: dict[str, list[float]]
    other_loads: tuple[HoldingForces, ...] = field(default=())

    @staticmethod
    def of(load: str, rest: Equilibrium, unreachable: Array, q: Array) -> HoldingForces:
        """Compute the forces that hold the posture ``q`` under one load.

        The rows of ``unreachable``, shape (k, 6), are combinations of the base wrench that the rotors cannot produce.
        """
        distribution = rest.distribute(q)
        z, shares = distribution.forces, distribution.shares
        unbalanced = distribution.unbalanced
        if len(unreachable):
            unbalanced += float(np.abs(unreachable @ rest.load.torque(q, z).value[:6] / rest.weight).sum())
        values = (rest.upper + rest.lower) / 2 + (rest.upper - rest.lower) / 2 * shares
        numbers = np.array([values, rest.lower, rest.upper, np.abs(shares)]).T.tolist()
        loads = [
            ActuatorLoad(value, low, high, share, unit)
            for (value, low, high, share), unit in zip(numbers, rest.units, strict=True)
        ]
        forces: dict[str, Array] = {}
        for source, part in zip(rest.load.sources, rest.load.split(z), strict=True):
            if part.size and not source.in_frame:
                foot = source.names[0]
                forces[foot] = forces.get(foot, np.zeros(3)) + (source.columns @ part)[:3]
        return HoldingForces(
            load=load,
            feasible=unbalanced <= _ROUNDING and distribution.largest <= 1 + _ROUNDING,
            largest_share=distribution.largest,
            unbalanced=unbalanced,
            actuators=dict(zip(rest.actuators, loads, strict=True)),
            contact_forces={foot: force.tolist() for foot, force in forces.items()},
        )

    def violations(self) -> list[str]:
        """Return a line for each reason why the robot cannot hold the posture under a load; empty if it can."""
        lines = []
        if self.unbalanced > _ROUNDING:
            lines.append(
                f"{self.load}, a wrench of {self.unbalanced:.2g} times the robot's weight on the base is not balanced"
            )
        for name, load in sorted(self.actuators.items(), key=lambda item: -item[1].share):
            if load.share > 1 + _ROUNDING and self.unbalanced <= _ROUNDING:
                limits = f"{load.low:.3g} to {load.high:.3g} {load.unit}"
                lines.append(f"{self.load}, {name} would need {load.value:.3g} {load.unit}, outside {limits}")
        return lines + [line for other in self.other_loads for line in other.violations()]
