"""The price of a posture, which a trade-off bounds: its distance from the initial posture, or its peak force."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from impact_posture.config.problem_settings import Against
from impact_posture.dynamics.chart import Chart
from impact_posture.impact.elasticity.contact_compression import ContactStiffness
from impact_posture.impact.friction.coulomb_impact import coulomb_impact
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.posture.constraints.constraint import Constraint
from impact_posture.posture.constraints.impact_bounds import ImpactBounds
from impact_posture.posture.constraints.posture_distance import WithinDistance, distance
from impact_posture.system.arrays import Array


@dataclass(frozen=True, eq=False)
class DistancePrice:
    """The distance from the initial posture, rad mixed with m.

    ``nearest`` is the posture with the least price, shape (nq,).  Options and files call the price ``against``.
    ``nothing`` is the message if the optimum already has the least price.
    """

    model: pin.Model
    nearest: Array
    against: Against = "distance"
    nothing: str = "the optimum is the initial posture"

    def measure(self, q: Array) -> float:
        """Return the price of ``q``."""
        return distance(Chart(self.model), q, self.nearest)

    def bound(self, level: float) -> Constraint:
        """Return the constraint that the price is at most ``level``; the program for another level is the same."""
        return WithinDistance(Chart(self.model), self.nearest, level)

    def within(self, q: Array, level: float) -> Array:
        """Return a posture near ``q`` with a price of at most ``level``; the price of ``q`` may be higher."""
        away = self.measure(q)
        return q if away <= level else np.array(pin.interpolate(self.model, self.nearest, q, level / away))


@dataclass(frozen=True, eq=False)
class ForcePrice:
    """The peak force of the impact with friction, N; it increases with the effective mass."""

    objective: WorstCaseObjective
    contact: ContactStiffness
    speed: float
    nearest: Array
    against: Against = "force"
    nothing: str = "the optimum has the least force"

    def measure(self, q: Array) -> float:
        return self.contact.peak_force(coulomb_impact(self.objective.oracle, q).mass, self.speed)

    def bound(self, level: float) -> Constraint:
        return ImpactBounds(self.objective, self.contact.largest_mass(level, self.speed), float("inf"))

    def within(self, q: Array, level: float) -> Array:
        return q


TradeOffPrice = DistancePrice | ForcePrice
