"""The constraint that no foot lifts off or slides during the impact."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np

from impact_posture.dynamics.numeric import Numeric
from impact_posture.dynamics.tree import Tree
from impact_posture.impact.friction.contact_stability import FrictionCones
from impact_posture.impact.impact_contact import point_on
from impact_posture.impact.quantities.lifted_form import impact_at
from impact_posture.impact.support_compliance import support_inertia
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.posture.constraints.constraint import ExpressionConstraint, digest
from impact_posture.system.arrays import Array


class KeptContacts(ExpressionConstraint):
    """The support impulses ``f = −J_s a/ε`` per unit impulse stay in the friction cones: ``A f(q) ≤ 0``.

    The support impulses of rigid feet are not always unique
    (:mod:`impact_posture.impact.friction.contact_stability`).  The impulses ``f`` of feet with compliance ε are one
    of the possible solutions.  The constraint is therefore sufficient for the feet to stay, but stricter than
    necessary if there are several solutions.  ``numeric`` is the model at the given posture.  This posture defines
    the axes of the soles, which do not change.  ``A`` is divided by the largest impulse at this posture.
    """

    at_impact = True
    unit = "of the largest impulse at the given posture"

    def __init__(self, objective: WorstCaseObjective, numeric: Numeric, friction: float, variant: str = "") -> None:
        self._where = f" ({variant})" if variant else ""
        self.name = f"feet that stay{self._where}"
        self._objective = replace(objective, normal_cone_deg=0.0)
        self._feet = [(point_on(objective.robot, s.frame, s.offset), s.rows) for s in objective.supports]
        axes = [np.asarray(numeric.placement(point).rotation) for point, _ in self._feet]
        matrix, self._names = FrictionCones(objective.supports, axes).matrix(friction)
        size = np.abs(self._objective.oracle.quantities(numeric.q).support_impulse).max(initial=1e-300)
        self._matrix = matrix / size
        self.parameters = np.array(objective.contact.normal)
        self.lower, self.upper = np.full(len(matrix), -np.inf), np.zeros(len(matrix))

    def describe(self) -> str:
        return f"{self.name}: no foot lifts off or slides during the impact"

    @property
    def structure(self) -> str:
        return f"{super().structure}:{digest(self._matrix)}:{self._objective.compliance!r}"

    def symbolic(self, tree: Tree, parameters: ca.SX) -> ca.SX:
        case = self._objective.case
        extra = support_inertia(case.robot, case.supports, case.compliance)
        heavy = Tree(case.robot.model, tree.q, extra_inertia=extra, couplings=case.robot.coupled_entries)
        velocities = heavy.respond(wrenches=[impact_at(case, parameters)]).velocities
        parts = [-heavy.point_velocity(foot, velocities)[:rows] / case.compliance for foot, rows in self._feet]
        return ca.densify(ca.SX(self._matrix) @ ca.vertcat(*parts))

    def evaluate(self, model: Numeric) -> tuple[Array, Array]:
        oracle = self._objective.oracle
        impulse = oracle.quantities(model.q).support_impulse
        return self._matrix @ impulse, self._matrix @ oracle.support_gradient(model.q)

    def row_name(self, row: int) -> str:
        return f"{self._names[row]}{self._where}"
