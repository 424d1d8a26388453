"""Bounds on the peak force of an impact and on the velocity jump of each joint.

Without friction, the velocity jump of the joints is ``Δν = a (1+e) v/G`` with ``a = M⁻¹Jᵀn`` and ``G = nᵀJa``, and
the peak force decreases as G increases (:mod:`impact_posture.impact.elasticity.contact_compression`).  A joint
controller with the velocity gain ``K_d`` responds to the jump with the torque ``K_d Δν``.  A bound on the torque
``K_d Δν`` is therefore a bound on the jump (Wang et al. 2020, arXiv:2006.01987).
"""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np

from impact_posture.dynamics.numeric import Numeric
from impact_posture.dynamics.tree import Tree
from impact_posture.impact.quantities.lifted_form import impact_at
from impact_posture.impact.support_compliance import support_inertia
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.posture.constraints.constraint import ExpressionConstraint, digest
from impact_posture.system.arrays import Array


class ImpactBounds(ExpressionConstraint):
    """Bounds ``1/G(q) ≤ 1/G_min`` and, at every joint, ``|a_i(q)|/G(q) ≤ b``, for the first contact of the objective.

    ``G_min`` and ``b`` are bounds of rows, so the same program can be used for all values of ``G_min`` and ``b``.

    Args:
        least_mobility: ``G_min``, 1/kg, the least G at which the peak force satisfies its bound; 0 for no bound.
        jump: ``b = Δν_max/((1+e) v)``, the largest allowed velocity jump of a joint per approach speed; infinite for
            no bound.
    """

    def __init__(self, objective: WorstCaseObjective, least_mobility: float, jump: float, variant: str = "") -> None:
        where = f" ({variant})" if variant else ""
        self.name = f"bounds on the impact{where}"
        self._objective = replace(objective, normal_cone_deg=0.0)
        robot = objective.robot
        moving = np.isfinite(robot.model.armature) & (np.arange(robot.nv) >= (6 if robot.floating else 0))
        self._joints = np.flatnonzero(moving) if np.isfinite(jump) else np.zeros(0, dtype=int)
        self._least, self._jump = least_mobility, jump
        self.parameters = np.array(objective.contact.normal)
        # The row of the peak force is 1/G and not G, because G_min can be much larger than every attainable G.
        mass = [1 / least_mobility] if least_mobility > 0 else []
        count = len(self._joints)
        self._names = [f"peak force{where}"] * len(mass)
        self._names += [f"jump of {robot.tangent_names[int(k)]}{where}" for k in self._joints]
        self._units = ["in kg of effective mass"] * len(mass) + ["in rad/s (m/s) per m/s of approach"] * count
        self.lower = np.array([*[-np.inf] * len(mass), *[-jump] * count])
        self.upper = np.array([*mass, *[jump] * count])

    def describe(self) -> str:
        parts = [f"effective mass at most {1 / self._least:.4g} kg (peak force)"] if self._least > 0 else []
        if len(self._joints):
            parts.append(f"joint velocities jump by at most {self._jump:.4g} per m/s of approach")
        return f"{self.name}: {', '.join(parts)}"

    @property
    def structure(self) -> str:
        return f"{super().structure}:{digest(self._least > 0, self._joints, self._objective.structure)}"

    def symbolic(self, tree: Tree, parameters: ca.SX) -> ca.SX:
        case = self._objective.case
        extra = support_inertia(case.robot, case.supports, case.compliance)
        heavy = Tree(case.robot.model, tree.q, extra_inertia=extra)
        impact = impact_at(case, parameters)
        response = heavy.respond(wrenches=[impact])
        G = ca.dot(heavy.link_force(impact), response.velocities[impact.point.joint])
        rows = [1 / G] if self._least > 0 else []
        return ca.densify(ca.vertcat(*rows, *[response.a[int(k)] / G for k in self._joints]))

    def evaluate(self, model: Numeric) -> tuple[Array, Array]:
        oracle, k = self._objective.oracle, self._joints
        quantities, slope = oracle.quantities(model.q), oracle.gradient_G(model.q)
        G, jump = quantities.G, quantities.jump[k] / quantities.G
        gradients = np.zeros((0, slope.size))
        if len(k):
            gradients = (oracle.jump_gradient(model.q)[k] - np.outer(jump, slope)) / G
        if self._least > 0:
            return np.append(1 / G, jump), np.vstack([-slope / G**2, gradients])
        return jump, gradients

    def conflicts(self, excess: Array) -> dict[str, float]:
        rows = zip(self._names, self._units, excess.tolist(), strict=True)
        return {f"{self.name}: {name}, {unit}": abs(value) for name, unit, value in rows if value}

    def row_name(self, row: int) -> str:
        return self._names[row]
