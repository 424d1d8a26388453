"""What is minimized: the ``Objective`` protocol, and the worst case of an impact that implements it.

:class:`Objective` is all that the program, its starts, the solver and the certificate know.
:class:`ImpactObjective` combines a kind (:mod:`impact_posture.impact.kinds`), a metric, supports, contacts, a cone of
normals and model variants.  No combination is a class of its own: the shapes of the inner maximum are
(:mod:`impact_posture.impact.worst_case`).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Protocol

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from impact_posture.dynamics.repeated_limbs import RepeatedLimbs
from impact_posture.dynamics.tree import Tree
from impact_posture.impact.contact import ImpactContact, Support, default_compliance
from impact_posture.impact.impact_case import ImpactCase
from impact_posture.impact.impact_kind import ImpactKind, QuadraticKind
from impact_posture.impact.impulse_box import ImpulseBox, check_contacts
from impact_posture.impact.kernel import ImpactKernel
from impact_posture.impact.kinds import KINDS
from impact_posture.impact.lifted import Guess, Lifted
from impact_posture.impact.metric import Metric
from impact_posture.impact.model_set import ModelSet
from impact_posture.impact.normal_cone import NormalCone, check_cone
from impact_posture.impact.oracle import ImpactOracle
from impact_posture.impact.single_impact import SingleImpact
from impact_posture.impact.worst_case import Subgradients, WorstCase
from impact_posture.robot.model_variant import ModelVariant
from impact_posture.robot.robot import Robot
from impact_posture.settings import ObjectiveKind

Vector = NDArray[np.float64]

# A contact whose 1/m_eff along the normal is below this share of the largest mobility cannot move along it.
_BLOCKED = 1e-12


class Objective(Protocol):
    """What a posture problem minimizes."""

    @property
    def robot(self) -> Robot:
        """The robot."""
        ...

    @property
    def name(self) -> str:
        """What it is called in outputs."""
        ...

    @property
    def contacts(self) -> tuple[ImpactContact, ...]:
        """Contacts whose frames the problem holds; empty for none."""
        ...

    @property
    def supports(self) -> tuple[Support, ...]:
        """Feet that the problem holds; empty for none."""
        ...

    @property
    def structure(self) -> str:
        """What its expressions depend on besides the robot's dynamics; part of the compile cache's key."""
        ...

    @property
    def parameters(self) -> Vector:
        """Numbers of the lifted form that may change without rebuilding the program, shape (k,)."""
        ...

    def lift(self, tree: Tree, parameters: ca.SX, scale: ca.SX) -> Lifted:
        """The value in terms of auxiliaries and equations at ``tree.q``; ``scale`` is a typical value of it."""
        ...

    @property
    def attempts(self) -> int:
        """From how many guesses the lifted form may be tried."""
        ...

    def guess(self, q: Vector, scale: float, attempt: int = 0) -> Guess:
        """Where the lifted form's auxiliaries start at ``q``, and their bounds."""
        ...

    def value(self, q: Vector) -> float:
        """The value from Pinocchio's numbers, > 0.

        Raises:
            MetricError: It does not exist at ``q``.
        """
        ...

    def subgradients(self, q: Vector, within: float = 0.0) -> Subgradients:
        """What spans the subdifferential at ``q``, from Pinocchio's numbers; one gradient where it is smooth.

        Of a maximum, members at most ``within`` below it count as well.
        """
        ...

    def movable(self, q: Vector) -> bool:
        """Whether the value at ``q`` is more than rounding."""
        ...

    def blind_motions(self) -> Vector:
        """Motions of the whole robot that change nothing: twists of the base, world axes, linear first, (k, 6)."""
        ...


@dataclass(frozen=True)
class ImpactObjective:
    """Impulse ``λ̄²H``, speed ``V``, sticking ``S`` or energy ``E`` of one contact.

    Attributes:
        robot: The robot.
        contact: Where the impact acts, and along which normal.
        metric: How the jump is weighed.
        kind: Which of the four.
        supports: Feet that stay.
        compliance: ε of the supports, 1/kg.
        normal_cone_deg: Half angle of the cone of normals that the worst is taken of, degrees; 0: the one normal.
        others: More contacts at the same time, each with its own bound on its impulse.
        bilateral: Whether several contacts can pull as well as push.
        model_variants: Models that the worst is taken of, the robot's own first; empty: that one alone.
    """

    robot: Robot
    contact: ImpactContact
    metric: Metric = field(default_factory=Metric)
    kind: ObjectiveKind = "impulse"
    supports: tuple[Support, ...] = ()
    compliance: float = 0.0
    normal_cone_deg: float = 0.0
    others: tuple[ImpactContact, ...] = ()
    bilateral: bool = False
    model_variants: tuple[ModelVariant, ...] = ()

    def __post_init__(self) -> None:
        check_cone(self.impact_kind, self.normal_cone_deg)
        check_contacts(self.contacts, self.impact_kind, bilateral=self.bilateral, cone=self.normal_cone_deg != 0)
        if self.compliance <= 0:
            object.__setattr__(self, "compliance", default_compliance(self.robot))

    @property
    def impact_kind(self) -> ImpactKind:
        """The kind's own formulas."""
        return KINDS[self.kind]

    @property
    def name(self) -> str:
        """Kind of the objective."""
        return self.kind

    @property
    def units(self) -> str:
        """Units in words."""
        return self.impact_kind.units

    @property
    def scale(self) -> float:
        """The value over the scalar H, V, S or E that the kind is a multiple of: λ̄² for ``impulse``, else 1."""
        return self.impact_kind.factor(self.case)

    @property
    def structure(self) -> str:
        """See :class:`Objective`; the leading contact's normal is a parameter."""
        contact = self.contact
        return repr(
            (
                (self.kind, self.metric, self.supports, self.compliance),
                (self.normal_cone_deg, self.others, self.bilateral),
                [variant.robot.model_sha256 for variant in self.model_variants],
                (contact.frame, contact.offset, contact.normal_frame),
                self.scale,
            )
        )

    @property
    def parameters(self) -> Vector:
        """The leading contact's normal, shape (3,)."""
        return np.array(self.contact.normal)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Degenerate combinations, in words."""
        if self.metric.kind == "kinetic" and self.kind == "speed" and not self.supports:
            return ("with the kinetic metric 'speed' is 1/G, the exact opposite of 'impulse' (G) and twice 'energy'",)
        if self.metric.kind == "kinetic" and self.kind == "impulse" and not self.supports:
            return ("with the kinetic metric 'impulse' is G = 1/m_eff: it only maximizes the effective mass",)
        return ()

    @property
    def contacts(self) -> tuple[ImpactContact, ...]:
        """All contacts, the leading one first."""
        return (self.contact, *self.others)

    @cached_property
    def case(self) -> ImpactCase:
        """The impact at the leading contact, on the robot as modeled."""
        return ImpactCase(self.robot, self.contact, self.metric, self.supports, self.compliance)

    @cached_property
    def singles(self) -> tuple[ImpactObjective, ...]:
        """The objective of each contact alone, on the robot as modeled."""
        if not self.others:
            return (replace(self, model_variants=()) if self.model_variants else self,)
        return tuple(
            replace(self, contact=contact, others=(), bilateral=False, model_variants=()) for contact in self.contacts
        )

    @cached_property
    def by_variant(self) -> tuple[ImpactObjective, ...]:
        """The objective on each variant's robot; itself alone without model_variants."""
        if not self.model_variants:
            return (self,)
        return tuple(replace(self, robot=variant.robot, model_variants=()) for variant in self.model_variants)

    @cached_property
    def worst_case(self) -> WorstCase:
        """What the worst is taken over."""
        if self.model_variants:
            return ModelSet(tuple(member.worst_case for member in self.by_variant))
        if self.others:
            return ImpulseBox(tuple(single.oracle for single in self.singles), self.bilateral)
        cone = self.normal_cone
        return SingleImpact(self.oracle, self.impact_kind) if cone is None else cone

    @cached_property
    def normal_cone(self) -> NormalCone | None:
        """The cone of normals around the leading contact's own, on the robot as modeled."""
        kind = self.impact_kind
        if not self.normal_cone_deg or not isinstance(kind, QuadraticKind):
            return None
        return NormalCone(self.oracle, kind, self.normal_cone_deg)

    @property
    def is_multiple_of_H(self) -> bool:
        """Whether it is ``λ̄²H`` of the leading contact."""
        return self.impact_kind.symbol == "H" and isinstance(self.worst_case, SingleImpact)

    # ---- symbolic ---------------------------------------------------------------------------------------------

    @cached_property
    def kernel(self) -> ImpactKernel:
        """The expressions, on fresh symbols q and n."""
        return self.kernel_of(ca.SX.sym("q", self.robot.nq), ca.SX.sym("n", 3))

    def kernel_of(self, q: ca.SX, n: ca.SX, limbs: RepeatedLimbs | None = None) -> ImpactKernel:
        """Return the expressions on given symbols, of one form for ``limbs`` that repeat."""
        return ImpactKernel(self.case, q, n, limbs)

    def expressions(self, k: ImpactKernel) -> tuple[ca.SX, ca.SX]:
        """Value and tangent gradient (nv) in the symbols of a kernel of this contact, metric and supports."""
        return self.worst_case.expressions(k)

    def value_fun(self) -> ca.Function:
        """``(q, n) → value``; ``n`` in the contact's normal frame, as in :meth:`gradient_fun`."""
        general = self.gradient_fun()
        q, n = general.sx_in()
        return ca.Function("value", [q, n], [general(q, n)[0]], ["q", "n"], ["value"], {"cse": True})

    def gradient_fun(self) -> ca.Function:
        """``(q, n) → value, gradient``: value and tangent gradient (nv); ``n`` in the contact's normal frame.

        With a cone, ``n`` is its axis; with several contacts, the leading one's.  Where the maximum within is tied,
        the gradient is a subgradient.
        """
        k = self.kernel
        value, gradient = self.expressions(k)
        names = ["q", "n"], ["value", "gradient"]
        return ca.Function("gradient", [k.q, k.n], [value, gradient], *names, {"cse": True})

    def metric_fun(self) -> ca.Function:
        """``(q, n) → H, grad``: the impact-robustness metric and its tangent gradient, whatever the objective."""
        k = self.kernel
        return ca.Function("eval", [k.q, k.n], [k.H, k.grad_H], ["q", "n"], ["H", "grad"], {"cse": True})

    def lift(self, tree: Tree, parameters: ca.SX, scale: ca.SX) -> Lifted:
        """The objective with its linear solves as equations of the program."""
        return self.worst_case.lift(tree, parameters, scale)

    @property
    def attempts(self) -> int:
        """Guesses that :meth:`guess` knows: one where its equations are linear in what it guesses."""
        return self.worst_case.attempts

    def guess(self, q: Vector, scale: float, attempt: int = 0) -> Guess:
        """The auxiliaries of :meth:`lift` that solve its equations at ``q``."""
        return self.worst_case.guess(q, scale, attempt)

    # ---- numeric ----------------------------------------------------------------------------------------------

    @cached_property
    def oracle(self) -> ImpactOracle:
        """Pinocchio's numbers for the leading contact, the same metric and supports, the robot as modeled."""
        return ImpactOracle(self.case)

    def value(self, q: Vector) -> float:
        """The objective at ``q`` from Pinocchio's numbers.

        Raises:
            MetricError: ``sticking`` where S does not exist.
        """
        return self.worst_case.value(q)

    def gradient(self, q: Vector) -> Vector:
        """The tangent gradient at ``q`` from Pinocchio's numbers, shape (nv,); a subgradient where tied."""
        return self.worst_case.gradient(q)

    def subgradients(self, q: Vector, within: float = 0.0) -> Subgradients:
        """The gradient, or those of all that tie or lie at most ``within`` below."""
        return self.worst_case.subgradients(q, within)

    def movable(self, q: Vector) -> bool:
        """Whether a contact can move along its normal at ``q``, or along another normal of its cone."""
        if self.normal_cone_deg:
            return True
        found = [single.oracle.quantities(q) for single in self.singles]
        return any(one.G > _BLOCKED * float(np.linalg.eigvalsh(one.mobility)[-1]) for one in found)

    def blind_motions(self) -> Vector:
        """Translations, and turns about the normal: the objective depends on the base through ``R_bᵀn`` alone.

        Where the normal turns with the robot these are all turns; none where contacts have different normals.
        """
        n = np.array(self.contact.normal)
        turns = n[None, :]
        if self.contact.normal_frame == "contact":
            turns = np.eye(3)
        elif any(np.linalg.norm(np.cross(n, other.normal)) > 1e-9 for other in self.others):
            turns = np.zeros((0, 3))
        return np.vstack([np.eye(6)[:3], np.hstack([np.zeros_like(turns), turns])])
