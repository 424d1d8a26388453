"""Bounds on the peak force of an impact and on the velocity jump of each joint.

With the impulse ``p`` per approach speed at the friction of the contact, the joints jump by ``Δν = (1+e) v M⁻¹Jᵀp``,
and the peak force increases with the effective mass ``m = nᵀp``
(:mod:`impact_posture.impact.elasticity.contact_compression`).  A joint controller with the velocity gain ``K_d``
responds to the jump with the torque ``K_d Δν``.  A bound on the torque ``K_d Δν`` is therefore a bound on the jump
(Wang et al. 2020, arXiv:2006.01987).
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace

import casadi as ca
import numpy as np

from impact_posture.dynamics.numeric import Numeric
from impact_posture.dynamics.tree import Tree
from impact_posture.errors import MetricError
from impact_posture.impact.friction.coulomb_impact import NO_FRICTION, CoulombImpact, coulomb_impact, impact_gradients
from impact_posture.impact.quantities.lifted_form import Guess
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.posture.constraints.constraint import Constraint, LiftedRows, Linearization, digest
from impact_posture.system.arrays import Array

# If the values for sticking and for sliding differ by less than this fraction, the contact point begins to slip.  The
# certificate then uses the gradients for both cases.
_KINK = 1e-6


class ImpactBounds(Constraint):
    """Bounds ``m(q) ≤ m_max`` and, at every joint, ``|Δν_i(q)| ≤ b`` per approach speed, for the first contact.

    Jump and impulse are unknowns of the program, with the equations of the objective ``coulomb``, or of ``speed`` if
    there is no friction.  ``m_max`` and ``b`` are bounds of rows, so one program can be used for all their values.

    Args:
        largest_mass: ``m_max``, kg, the largest effective mass with friction at which the peak force satisfies its
            bound; infinite for no bound.
        jump: ``b = Δν_max/((1+e) v)``, the largest allowed velocity jump of a joint per approach speed; infinite for
            no bound.
    """

    at_impact = by_row = True

    def __init__(self, objective: WorstCaseObjective, largest_mass: float, jump: float, variant: str = "") -> None:
        where = f" ({variant})" if variant else ""
        self.name = f"bounds on the impact{where}"
        self._slips = objective.contact.friction > NO_FRICTION
        self._objective = replace(objective, kind="coulomb" if self._slips else "speed", normal_cone_deg=0.0)
        robot = objective.robot
        moving = np.isfinite(robot.model.armature) & (np.arange(robot.nv) >= robot.first_joint)
        self._joints = np.flatnonzero(moving) if np.isfinite(jump) else np.zeros(0, dtype=int)
        self._largest, self._jump = largest_mass, jump
        self.parameters = np.array(objective.contact.normal)
        mass, count = [largest_mass] * bool(np.isfinite(largest_mass)), len(self._joints)
        self._names = [f"peak force{where}"] * len(mass)
        self._names += [f"jump of {robot.tangent_names[int(k)]}{where}" for k in self._joints]
        units = ["kg of effective mass"] * len(mass) + ["rad/s (m/s) per m/s of approach"] * count
        self._units = dict(zip(self._names, units, strict=True))
        self.lower = np.array([*[-np.inf] * len(mass), *[-jump] * count])
        self.upper = np.array([*mass, *[jump] * count])
        # The value of a row is cᵀΔν + s m, with a covector c and a factor s (0 or 1) for each row.
        self._covectors = np.vstack([np.zeros((len(mass), robot.nv)), np.eye(robot.nv)[self._joints]])
        self._shares = np.array([*[1.0] * len(mass), *[0.0] * count])

    def describe(self) -> str:
        limited = np.isfinite(self._largest)
        parts = [f"effective mass at most {self._largest:.4g} kg (peak force, with friction)"] if limited else []
        if len(self._joints):
            parts.append(f"joint velocities jump by at most {self._jump:.4g} per m/s of approach, with friction")
        return f"{self.name}: {', '.join(parts)}"

    @property
    def structure(self) -> str:
        return f"{super().structure}:{digest(self._shares, self._joints, self._objective.structure)}"

    @property
    def unknowns(self) -> int:
        # The impulse adds one unknown without friction, and the six unknowns of ``CoulombKind`` with friction.
        return self._motion + (6 if self._slips else 1)

    @property
    def _motion(self) -> int:
        """Number of unknowns of the jump and the support impulses, which is also the number of their equations."""
        return self._objective.robot.nv + sum(support.rows for support in self._objective.supports)

    @property
    def lifted_bounds(self) -> tuple[Array, Array]:
        equations = np.zeros(self._motion + (5 if self._slips else 1))
        corner = np.zeros(1 if self._slips else 0)
        lower = np.concatenate([equations, np.full_like(corner, -np.inf), self.lower])
        return lower, np.concatenate([equations, corner, self.upper])

    def lift(self, tree: Tree, parameters: ca.SX) -> LiftedRows:
        lifted = self._objective.impact_kind.lift(tree, parameters, ca.SX(1))
        mass = [lifted.variables[self._motion]] if np.isfinite(self._largest) else []
        bounded = [*mass, *(lifted.variables[int(k)] for k in self._joints)]
        return LiftedRows(ca.densify(ca.vertcat(lifted.residual, lifted.inequalities, *bounded)), lifted.variables)

    def guess(self, model: Numeric) -> Guess:
        return self._objective.impact_kind.guess(model.q, 1.0)

    def evaluate(self, model: Numeric) -> tuple[Array, Array]:
        impact = coulomb_impact(self._objective.oracle, model.q)
        gradients = impact_gradients(self._objective.oracle, model.q, impact, self._covectors, self._shares)
        return self._value(impact), gradients

    def value(self, model: Numeric) -> Array:
        return self._value(coulomb_impact(self._objective.oracle, model.q))

    def _value(self, impact: CoulombImpact) -> Array:
        return np.asarray(self._covectors @ impact.jump + impact.mass * self._shares)

    def linearize(self, model: Numeric, auxiliaries: Array) -> Linearization:
        """Linearize the bounded quantities as functions of the posture, with the auxiliary unknowns eliminated.

        Where the contact point begins to slip, the rows for sticking and for sliding are both included, because the
        quantities have a kink there.
        """
        oracle, (value, gradients) = self._objective.oracle, self.evaluate(model)
        sides = [(value, gradients)]
        with suppress(MetricError):
            other = coulomb_impact(oracle, model.q, other=True)
            if np.abs(self._value(other) - value).max(initial=0.0) <= _KINK * np.abs(value).max(initial=0.0):
                sides.append((value, impact_gradients(oracle, model.q, other, self._covectors, self._shares)))
        values, slopes = (np.concatenate(parts) for parts in zip(*sides, strict=True))
        lower, upper = (np.tile(side, len(sides)) for side in (self.lower, self.upper))
        # The certificate expects a column for each auxiliary unknown.
        auxiliary = np.zeros((len(values), len(auxiliaries)))
        return Linearization(self._names * len(sides), values, lower, upper, slopes, auxiliary)

    def size(self, name: str, violation: float) -> str:
        return f"{super().size(name, violation)} {self._units[name]}"

    def row_name(self, row: int) -> str:
        return self._names[row]
