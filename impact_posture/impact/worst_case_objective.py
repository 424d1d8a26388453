"""The objective of an impact: the worst case over normals, impulses or robot models."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import casadi as ca
import numpy as np

from impact_posture.config.checked import checked
from impact_posture.config.demand import HalfAngle, NonNegative
from impact_posture.config.problem_settings import ObjectiveKind
from impact_posture.dynamics.tree import Tree
from impact_posture.impact.impact_case import ImpactCase
from impact_posture.impact.impact_contact import ImpactContact
from impact_posture.impact.kinds.impact_kind import ImpactKind, QuadraticKind
from impact_posture.impact.kinds.kinds_by_name import KINDS
from impact_posture.impact.metric import Metric
from impact_posture.impact.objective import Subgradients, WorstCase
from impact_posture.impact.quantities.impact_kernel import ImpactKernel
from impact_posture.impact.quantities.impact_oracle import ImpactOracle
from impact_posture.impact.quantities.lifted_form import Guess, Lifted
from impact_posture.impact.support_compliance import default_compliance
from impact_posture.impact.worst_case.impulse_box import ImpulseBox, check_contacts
from impact_posture.impact.worst_case.model_set import ModelSet
from impact_posture.impact.worst_case.normal_cone import NormalCone, check_cone
from impact_posture.impact.worst_case.simultaneous_impact import SimultaneousImpact
from impact_posture.robot.model_variant import ModelVariant
from impact_posture.robot.robot import Robot
from impact_posture.robot.robot_spec import Support
from impact_posture.system.arrays import Array


@checked
@dataclass(frozen=True)
class WorstCaseObjective:
    """Worst case of the objective type :attr:`kind`: ``λ̄²H``, ``V``, ``S``, ``C``, ``E`` or ``m``.

    ``λ̄`` is the largest impulse of the contact along the normal.  The class implements the
    :class:`~impact_posture.impact.objective.Objective` protocol for every combination of an objective type
    (:mod:`impact_posture.impact.kinds.kinds_by_name`), a metric, supports, contacts, a cone of normals and model
    variants.  :mod:`impact_posture.impact.worst_case` has a class for each type of maximum.

    Attributes:
        contact: Point and normal of the first contact.
        metric: Weight matrix ``W`` in the squared norm of the velocity jump.
        kind: Objective type: ``impulse``, ``speed``, ``sticking``, ``coulomb``, ``energy`` or ``effective-mass``.
        supports: Feet that stay on the ground.
        compliance: Compliance ε of the supports, 1/kg; zero selects the default.
        normal_cone_deg: Half angle of the cone of possible normals, degrees; 0 if only the normal of the contact is
            possible.
        others: Contacts that are hit at the same time as the first contact: each with a bound on its impulse, or with
            the type ``sticking`` all at the same approach speed.
        bilateral: Whether several contacts can pull as well as push.
        model_variants: Possible robot models, the nominal model first; empty if only the nominal model is possible.
    """

    robot: Robot
    contact: ImpactContact
    metric: Metric = field(default_factory=Metric)
    kind: ObjectiveKind = "impulse"
    supports: tuple[Support, ...] = ()
    compliance: NonNegative = 0.0
    normal_cone_deg: HalfAngle = 0.0
    others: tuple[ImpactContact, ...] = ()
    bilateral: bool = False
    model_variants: tuple[ModelVariant, ...] = ()

    def __post_init__(self) -> None:
        kind = KINDS[self.kind]
        check_cone(kind, self.normal_cone_deg)
        check_contacts(self.contacts, kind, bilateral=self.bilateral, cone=self.normal_cone_deg != 0)
        if self.compliance == 0:
            object.__setattr__(self, "compliance", default_compliance(self.robot))

    @cached_property
    def impact_kind(self) -> ImpactKind:
        """The objective type, evaluated at the first contact with the nominal robot model."""
        return KINDS[self.kind](self.oracle)

    @property
    def name(self) -> str:
        """Name of the objective type."""
        return self.kind

    @property
    def units(self) -> str:
        """Units of the value as text."""
        return self.impact_kind.units

    @property
    def scale(self) -> float:
        """Factor between the value and H, V, S, C or E: λ̄² for ``impulse``, else 1."""
        return self.impact_kind.factor

    @property
    def structure(self) -> str:
        """Text that identifies the expressions, without the normal of the first contact (a parameter)."""
        contact = self.contact
        return repr(
            (
                (self.kind, self.metric, self.supports, self.compliance),
                (self.normal_cone_deg, self.others, self.bilateral),
                [variant.robot.impact_sha256 for variant in self.model_variants],
                (contact.frame, contact.offset, contact.normal_frame),
                (self.scale, contact.friction),
            )
        )

    @property
    def parameters(self) -> Array:
        """Normal of the first contact, shape (3,)."""
        return np.array(self.contact.normal)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warning if the metric makes the objective equal, or nearly equal, to ``G`` or ``1/G``."""
        if self.metric.kind != "kinetic":
            return ()
        # With support impulses f, aᵀMa = G − ε‖f‖².  Without supports, aᵀMa = G.
        rest = ", up to the compliance of the feet" if self.supports else ""
        meanings = {
            "speed": f"is 1/G{rest}: the exact opposite of 'impulse' (G) and twice 'energy'",
            "impulse": f"is G = 1/m_eff{rest}: it only maximizes the effective mass",
        }
        return (f"with the kinetic metric '{self.kind}' {meanings[self.kind]}",) if self.kind in meanings else ()

    @property
    def contacts(self) -> tuple[ImpactContact, ...]:
        """All contacts, starting with :attr:`contact`."""
        return (self.contact, *self.others)

    @cached_property
    def case(self) -> ImpactCase:
        """The impact at the first contact for the nominal robot model."""
        return ImpactCase(self.robot, self.contact, self.metric, self.supports, self.compliance)

    @cached_property
    def singles(self) -> tuple[WorstCaseObjective, ...]:
        """A separate objective for each contact, for the nominal robot model."""
        if not self.others and not self.model_variants:
            return (self,)
        return tuple(
            replace(self, contact=contact, others=(), bilateral=False, model_variants=()) for contact in self.contacts
        )

    @cached_property
    def by_variant(self) -> tuple[WorstCaseObjective, ...]:
        """A separate objective for each model variant; if there are no variants, only this objective."""
        if not self.model_variants:
            return (self,)
        return tuple(replace(self, robot=variant.robot, model_variants=()) for variant in self.model_variants)

    @cached_property
    def worst_case(self) -> WorstCase:
        """The maximum over models, impulses or normals that this objective computes."""
        if self.model_variants:
            return ModelSet(tuple(member.worst_case for member in self.by_variant))
        if self.others:
            oracles = tuple(single.oracle for single in self.singles)
            return ImpulseBox(oracles, self.bilateral) if self.impact_kind.adds_up else SimultaneousImpact(oracles)
        return self.normal_cone or self.impact_kind

    def check_expressions(self) -> None:
        """Raise ``MetricError`` if the objective has values, but no expressions for C code and batches."""
        for member in self.by_variant:
            if isinstance(member.worst_case, SimultaneousImpact):
                member.worst_case.check_independent()

    @cached_property
    def normal_cone(self) -> NormalCone | None:
        """Worst case over the cone around the normal of the first contact; ``None`` if there is no cone."""
        kind = self.impact_kind
        if not self.normal_cone_deg or not isinstance(kind, QuadraticKind):
            return None
        return NormalCone(kind, self.normal_cone_deg)

    @property
    def is_multiple_of_H(self) -> bool:
        """Whether the objective equals ``λ̄²H`` of the first contact, without a maximum."""
        return self.impact_kind.symbol == "H" and isinstance(self.worst_case, ImpactKind)

    @cached_property
    def kernel(self) -> ImpactKernel:
        """The expressions of H, G, V, S and E with symbols for q and n."""
        return ImpactKernel(self.case, ca.SX.sym("q", self.robot.nq), ca.SX.sym("n", 3))

    def value_fun(self) -> ca.Function:
        """Return the function ``(q, n) → value``, with ``n`` as in :meth:`gradient_fun`."""
        general = self.gradient_fun()
        q, n = general.sx_in()
        return ca.Function("value", [q, n], [general(q, n)[0]], ["q", "n"], ["value"], {"cse": True})

    def gradient_fun(self) -> ca.Function:
        """Return the function ``(q, n) → value, gradient`` with a tangent gradient, shape (nv,).

        ``n`` is the normal of the first contact in its ``normal_frame``; with a cone of normals, ``n`` is the axis of
        the cone.  If several normals, impulses or models attain the maximum, the gradient is a subgradient.
        """
        k = self.kernel
        value, gradient = self.worst_case.expressions(k)
        names = ["q", "n"], ["value", "gradient"]
        return ca.Function("gradient", [k.q, k.n], [value, gradient], *names, {"cse": True})

    def lift(self, tree: Tree, parameters: ca.SX, scale: ca.SX) -> Lifted:
        """Return the objective in lifted form: its linear systems are equations of the program."""
        return self.worst_case.lift(tree, parameters, scale)

    @property
    def attempts(self) -> int:
        """Number of different initial guesses; one if the equations are linear in the unknowns of :meth:`lift`."""
        return self.worst_case.attempts

    def guess(self, q: Array, scale: float, attempt: int = 0) -> Guess:
        """Return values of the unknowns that solve the equations of :meth:`lift` at ``q``."""
        return self.worst_case.guess(q, scale, attempt)

    @cached_property
    def oracle(self) -> ImpactOracle:
        """Numeric impact quantities of the first contact for the nominal robot model."""
        return ImpactOracle(self.case)

    def value(self, q: Array) -> float:
        """Return the objective at ``q``, computed with Pinocchio.

        Raises:
            MetricError: The objective type, such as ``sticking`` or ``coulomb``, has no value at ``q``.
        """
        return self.worst_case.value(q)

    def gradient(self, q: Array) -> Array:
        """Return the tangent gradient at ``q``, computed with Pinocchio, shape (nv,), or a subgradient."""
        return self.subgradients(q).first

    def subgradients(self, q: Array, within: float = 0.0) -> Subgradients:
        """Return the gradients of all normals, impulses and models that are at most ``within`` below the maximum."""
        return self.worst_case.subgradients(q, within)

    def movable(self, q: Array) -> bool:
        """Return whether at least one contact can move at ``q`` along its normal or a normal of its cone."""
        if self.normal_cone_deg:
            return True
        return not all(single.oracle.quantities(q).blocked for single in self.singles)

    def blind_motions(self) -> Array:
        """Return base twists that do not change the value, world axes, linear first, shape (k, 6).

        The value depends on the pose of the base only through the normal in base axes.  Therefore translations and
        the rotation about the normal do not change the value.  If the normal turns with the robot, no rotation
        changes the value.  For contacts with different normals, any rotation may change the value.
        """
        n = np.array(self.contact.normal)
        turns = n[None, :]
        if self.contact.normal_frame == "contact":
            turns = np.eye(3)
        elif any(np.linalg.norm(np.cross(n, other.normal)) > 1e-9 for other in self.others):
            turns = np.zeros((0, 3))
        return np.vstack([np.eye(6)[:3], np.hstack([np.zeros_like(turns), turns])])
