"""What holds a posture: the torque or thrust of every actuator with its limits, and the forces of the feet."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field

import numpy as np

from impact_posture.posture.loads.equilibrium import Equilibrium
from impact_posture.system.arrays import Array

# A share beyond 1, and an unbalanced wrench in weights, up to this are rounding of the solver.
_ROUNDING = 1e-6


@dataclass(frozen=True)
class ActuatorLoad:
    """Load of one actuator.

    Attributes:
        value: Torque (N·m), force of a prismatic joint (N) or thrust (N).
        low: Lower limit.
        high: Upper limit.
        share: Distance of the value from the middle of its range over half the range: 1 at a limit.
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
        largest_share: The largest share of an actuator.
        unbalanced: Sum of the absolute entries of the wrench on the base that nothing bears, in weights (moments
            over one meter).
        actuators: Load of each actuator with known limits.
        contact_forces: Force on each foot, world axes, N.
        other_loads: The same for a force to hold and for payloads.
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
        """Distribute the forces at ``q``.

        Args:
            load: The load in words.
            rest: The robot at rest under it.
            unreachable: Combinations of the base wrench that the rotors cannot make, shape (k, 6).
            q: The posture, shape (nq,).
        """
        found = rest.distribute(q)
        side = np.zeros(0)
        if len(unreachable):
            side = unreachable @ rest.load.torque(q, found.forces).value[:6] / rest.weight
        unbalanced = found.unbalanced + float(np.abs(side).sum())
        middle, half = (rest.upper + rest.lower) / 2, (rest.upper - rest.lower) / 2
        loads = zip(middle + half * found.shares, rest.lower, rest.upper, np.abs(found.shares), strict=True)
        forces: dict[str, Array] = {}
        for source, own in zip(rest.load.sources, rest.load.split(found.forces), strict=True):
            if own.size and not source.in_frame:
                foot = source.names[0]
                forces[foot] = forces.get(foot, np.zeros(3)) + (source.columns @ own)[:3]
        return HoldingForces(
            load=load,
            feasible=unbalanced <= _ROUNDING and found.largest <= 1 + _ROUNDING,
            largest_share=found.largest,
            unbalanced=unbalanced,
            actuators={
                name: ActuatorLoad(*map(float, load)) for name, load in zip(rest.actuators, loads, strict=True)
            },
            contact_forces={foot: force.tolist() for foot, force in forces.items()},
        )

    @property
    def tightest(self) -> list[str]:
        """Names of the actuators, the largest share first."""
        return sorted(self.actuators, key=lambda name: -self.actuators[name].share)

    def violations(self) -> list[str]:
        """Return reasons in words why the robot cannot hold the posture under any of the loads."""
        lines = []
        if self.unbalanced > _ROUNDING:
            lines.append(f"{self.load}, nothing bears {self.unbalanced:.2g} weights of the wrench on its base")
        for name in self.tightest if not lines else ():
            one = self.actuators[name]
            if one.share > 1 + _ROUNDING:
                limits = f"[{one.low:.3g}, {one.high:.3g}]"
                lines.append(f"{self.load}, {name} would need {one.value:.3g}, outside {limits}")
        return lines + [line for other in self.other_loads for line in other.violations()]

    def to_dict(self) -> dict[str, object]:
        """Return JSON content."""
        return asdict(self)
