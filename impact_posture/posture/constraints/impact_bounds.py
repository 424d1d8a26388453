"""Bounds on the impact itself: its peak force, and the velocity jump of each joint.

Without friction the jump is ``Δν = a (1+e) v/G`` with ``a = M⁻¹Jᵀn`` and ``G = nᵀJa``, and the peak force falls with
G (:mod:`impact_posture.impact.elasticity.contact_compression`).  A joint controller with the velocity gain ``K_d``
answers the
jump with the torque ``K_d Δν``, so a bound on that torque is one on the jump (Wang et al. 2020, arXiv:2006.01987).
"""

from __future__ import annotations

import hashlib
from dataclasses import replace

import casadi as ca
import numpy as np

from impact_posture.dynamics.numeric import Numeric
from impact_posture.dynamics.tree import Tree
from impact_posture.impact.quantities.lifted_form import impact_at
from impact_posture.impact.support_compliance import support_inertia
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.posture.constraints.constraint import ExpressionConstraint
from impact_posture.system.arrays import Array


class ImpactBounds(ExpressionConstraint):
    """``1/G(q) ≤ 1/G_min`` and ``|a_i(q)|/G(q) ≤ b`` at every joint.

    The bounds are bounds of the rows, so one program serves all of them.

    Args:
        objective: The impact; the normal of its leading contact counts.
        least_mobility: ``G_min``, 1/kg, the least G with which the peak force stays below its bound; 0 for no bound.
        jump: ``b = Δν_max/((1+e) v)``, the largest jump of a joint per approach speed; infinite for no bound.
        variant: Name of the model variant, if there are several.
    """

    def __init__(self, objective: WorstCaseObjective, least_mobility: float, jump: float, variant: str = "") -> None:
        self._where = f" ({variant})" if variant else ""
        self.name = f"bounds on the impact{self._where}"
        self._objective = replace(objective, normal_cone_deg=0.0)
        robot = objective.robot
        moving = np.isfinite(robot.model.armature) & (np.arange(robot.nv) >= (6 if robot.floating else 0))
        self._joints = np.flatnonzero(moving) if np.isfinite(jump) else np.zeros(0, dtype=int)
        self._least, self._jump = least_mobility, jump
        self.parameters = np.array(objective.contact.normal)
        # Effective masses, because a bound on G can be large beside any G.
        force = [1 / least_mobility] if least_mobility > 0 else []
        self.lower = np.array([*[-np.inf] * len(force), *[-jump] * len(self._joints)])
        self.upper = np.array([*force, *[jump] * len(self._joints)])

    def describe(self) -> str:
        """See :class:`Constraint`."""
        parts = [f"effective mass at most {1 / self._least:.4g} kg (peak force)"] if self._least > 0 else []
        if len(self._joints):
            parts.append(f"joints jump at most {self._jump:.4g} per m/s of approach")
        return f"{self.name}: {', '.join(parts)}"

    @property
    def structure(self) -> str:
        """See :class:`Constraint`."""
        content = repr((self._least > 0, self._joints.tolist(), self._objective.structure))
        return f"{super().structure}:{hashlib.sha256(content.encode()).hexdigest()[:16]}"

    def symbolic(self, tree: Tree, parameters: ca.SX) -> ca.SX:
        """See :class:`Constraint`."""
        case = self._objective.case
        extra = support_inertia(case.robot, case.supports, case.compliance)
        heavy = Tree(case.robot.model, tree.q, extra_inertia=extra)
        impact = impact_at(case, parameters)
        found = heavy.respond(wrenches=[impact])
        G = ca.dot(heavy.link_force(impact), found.velocities[impact.point.joint])
        rows = [1 / G] if self._least > 0 else []
        return ca.densify(ca.vertcat(*rows, *[found.a[int(k)] / G for k in self._joints]))

    def evaluate(self, model: Numeric) -> tuple[Array, Array]:
        """See :class:`Constraint`."""
        oracle = self._objective.oracle
        found, slope = oracle.quantities(model.q), oracle.gradient_G(model.q)
        values, gradients = [], []
        if self._least > 0:
            values.append(1 / found.G)
            gradients.append(-slope / found.G**2)
        if len(self._joints):
            jumps = oracle.jump_gradient(model.q)
            for k in self._joints:
                values.append(found.jump[k] / found.G)
                gradients.append((jumps[k] - found.jump[k] / found.G * slope) / found.G)
        return np.array(values), np.array(gradients).reshape(len(values), -1)

    def conflicts(self, excess: Array) -> dict[str, float]:
        """See :class:`Constraint`."""
        forces = int(self._least > 0)
        names = [f"{self.name}: {self.row_name(row)}" for row in range(self.rows)]
        jump = "in rad/s (m/s) per m/s of approach"
        units = ["in kg of effective mass"] * forces + [jump] * (self.rows - forces)
        found = zip(names, units, excess, strict=True)
        return {f"{name}, {unit}": abs(float(value)) for name, unit, value in found if value}

    def row_name(self, row: int) -> str:
        """See :class:`Constraint`."""
        forces = int(self._least > 0)
        if row < forces:
            return f"peak force{self._where}"
        return f"jump of {self._objective.robot.tangent_names[int(self._joints[row - forces])]}{self._where}"
