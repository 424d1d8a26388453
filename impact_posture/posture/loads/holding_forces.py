"""The forces that hold a posture: the torque or thrust of every actuator with its limits, and forces of the feet."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field

import numpy as np

from impact_posture.posture.loads.equilibrium import Equilibrium
from impact_posture.system.arrays import Array

# A share up to this above 1, and an unbalanced wrench up to this in weights, are rounding of the solver.
_ROUNDING = 1e-6


@dataclass(frozen=True)
class ActuatorLoad:
    """Torque (N·m), force of a prismatic joint (N) or thrust (N) of an actuator between its limits.

    ``share`` is the distance from the middle of the range divided by half the range, 1 at a limit.
    """

    value: float
    low: float
    high: float
    share: float


@dataclass(frozen=True)
class HoldingForces:
    """Forces that hold a posture with the least largest share of a limit.

    Attributes:
        load: The load in words, such as ``at rest``.
        feasible: Whether the robot can hold it.
        unbalanced: Sum of the absolute entries of the unbalanced wrench on the base, in weights (moments over 1 m).
        actuators: Load of each actuator with known limits.
        contact_forces: Force on each foot, world axes, N.
        other_loads: Holding forces under a force to hold and with payloads.
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
        """Distribute the forces at ``q``; rotors cannot make the base wrenches in ``unreachable``, shape (k, 6)."""
        distribution = rest.distribute(q)
        z, shares = distribution.forces, distribution.shares
        unbalanced = distribution.unbalanced
        if len(unreachable):
            unbalanced += float(np.abs(unreachable @ rest.load.torque(q, z).value[:6] / rest.weight).sum())
        values = (rest.upper + rest.lower) / 2 + (rest.upper - rest.lower) / 2 * shares
        loads = np.array([values, rest.lower, rest.upper, np.abs(shares)]).T.tolist()
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
            actuators={name: ActuatorLoad(*numbers) for name, numbers in zip(rest.actuators, loads, strict=True)},
            contact_forces={foot: force.tolist() for foot, force in forces.items()},
        )

    def violations(self) -> list[str]:
        """Return why the robot cannot hold the posture under each load, one line each; empty if it can."""
        lines = []
        if self.unbalanced > _ROUNDING:
            lines.append(f"{self.load}, nothing bears {self.unbalanced:.2g} weights of the wrench on its base")
        for name, load in sorted(self.actuators.items(), key=lambda item: -item[1].share):
            if load.share > 1 + _ROUNDING and self.unbalanced <= _ROUNDING:
                limits = f"[{load.low:.3g}, {load.high:.3g}]"
                lines.append(f"{self.load}, {name} would need {load.value:.3g}, outside {limits}")
        return lines + [line for other in self.other_loads for line in other.violations()]

    def to_dict(self) -> dict[str, object]:
        """Return JSON content."""
        return asdict(self)
