"""The one ``Objective`` protocol: what the program, the C export, the certificate and TSID see of an impact.

An objective is a metric × a kind × supports × contacts × a cone × scenarios; none of the combinations is a class of
its own: what they ask of the inner maximum is (:mod:`impact_posture.impact.inner`).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Protocol

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from impact_posture.dynamics.tree import Tree
from impact_posture.dynamics.twins import Twins
from impact_posture.impact.contact import Contact, Support, default_compliance
from impact_posture.impact.inner import InnerMaximum, Subgradients
from impact_posture.impact.kernel import ImpactKernel
from impact_posture.impact.lifted import Guess, Lifted
from impact_posture.impact.lifted_cone import ConeOfNormals
from impact_posture.impact.metric import Metric, ObjectiveKind
from impact_posture.impact.one_blow import OneBlow
from impact_posture.impact.oracle import ImpactOracle
from impact_posture.impact.scenarios import FewModels
from impact_posture.impact.several import BoxOfImpulses, check_contacts
from impact_posture.impact.uncertain import check_cone
from impact_posture.robot.robot import Robot
from impact_posture.robot.scenario import Scenario

Vector = NDArray[np.float64]


class Objective(Protocol):
    """What can be minimized: a value with units, its tangent gradient, an oracle, and a lifted form."""

    robot: Robot

    @property
    def name(self) -> str:
        """What it is called in outputs."""
        ...

    @property
    def units(self) -> str:
        """Units of the value."""
        ...

    def value_fun(self) -> ca.Function:
        """``(q, n) → value``."""
        ...

    def gradient_fun(self) -> ca.Function:
        """``(q, n) → value, tangent gradient (nv)``."""
        ...

    def lift(self, tree: Tree, n: ca.SX, scale: ca.SX) -> Lifted:
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
        """The value from Pinocchio's numbers."""
        ...

    def gradient(self, q: Vector) -> Vector:
        """The tangent gradient (where there is none: a subgradient) from Pinocchio's numbers, shape (nv,)."""
        ...

    def subgradients(self, q: Vector, within: float = 0.0) -> Subgradients:
        """What spans the subdifferential at ``q``, from Pinocchio's numbers; one gradient where it is smooth.

        Of a maximum, members at most ``within`` below it count as well.
        """
        ...


_UNITS = {
    "impulse": "(N·s)² × jump² per impulse²",
    "speed": "jump² per (m/s)² of approach, frictionless",
    "sticking": "jump² per (m/s)² of approach, no slip",
    "energy": "J per (m/s)² of approach",
}


@dataclass(frozen=True)
class ImpactObjective:
    """Impulse ``λ̄²H``, speed ``V``, sticking ``S`` or energy ``E`` of one contact.

    Attributes:
        robot: The robot.
        contact: Where and along what the blow comes.
        metric: How the jump is weighed.
        kind: Which of the four.
        supports: Feet that stay.
        compliance: ε of the supports, 1/kg.
        normal_cone_deg: Half angle of the cone of normals that the worst is taken of, degrees; 0: the one normal.
        others: More contacts at the same time, each with its own bound on its impulse.
        bilateral: Whether several contacts can pull as well as push.
        scenarios: Models that the worst is taken of, the robot's own first; empty: that one alone.
    """

    robot: Robot
    contact: Contact
    metric: Metric = field(default_factory=Metric)
    kind: ObjectiveKind = "impulse"
    supports: tuple[Support, ...] = ()
    compliance: float = 0.0
    normal_cone_deg: float = 0.0
    others: tuple[Contact, ...] = ()
    bilateral: bool = False
    scenarios: tuple[Scenario, ...] = ()

    def __post_init__(self) -> None:
        check_cone(self)
        check_contacts(self)
        if self.compliance <= 0:
            object.__setattr__(self, "compliance", default_compliance(self.robot))

    @property
    def name(self) -> str:
        """Kind of the objective."""
        return self.kind

    @property
    def units(self) -> str:
        """Units in words."""
        return _UNITS[self.kind]

    @property
    def scale(self) -> float:
        """λ̄² for ``impulse``, else 1."""
        return self.contact.impulse**2 if self.kind == "impulse" else 1.0

    @property
    def warnings(self) -> tuple[str, ...]:
        """Degenerate combinations, in words."""
        if self.metric.kind == "kinetic" and self.kind == "speed" and not self.supports:
            return ("with the kinetic metric 'speed' is 1/G, the exact opposite of 'impulse' (G) and twice 'energy'",)
        if self.metric.kind == "kinetic" and self.kind == "impulse" and not self.supports:
            return ("with the kinetic metric 'impulse' is G = 1/m_eff: it only maximizes the effective mass",)
        return ()

    @property
    def contacts(self) -> tuple[Contact, ...]:
        """All contacts, the leading one first."""
        return (self.contact, *self.others)

    @cached_property
    def singles(self) -> tuple[ImpactObjective, ...]:
        """The objective of each contact alone, on the robot as modeled."""
        if not self.others:
            return (replace(self, scenarios=()) if self.scenarios else self,)
        return tuple(
            replace(self, contact=contact, others=(), bilateral=False, scenarios=()) for contact in self.contacts
        )

    @cached_property
    def inner(self) -> InnerMaximum:
        """What the worst is taken over."""
        if self.scenarios:
            return FewModels(self)
        if self.others:
            return BoxOfImpulses(self)
        return ConeOfNormals(self) if self.normal_cone_deg else OneBlow(self)

    @property
    def is_multiple_of_H(self) -> bool:
        """Whether it is ``λ̄²H`` of the leading contact."""
        return self.kind == "impulse" and isinstance(self.inner, OneBlow)

    # ---- symbolic ---------------------------------------------------------------------------------------------

    @cached_property
    def kernel(self) -> ImpactKernel:
        """The expressions, on fresh symbols q and n."""
        return self.kernel_of(ca.SX.sym("q", self.robot.nq), ca.SX.sym("n", 3))

    def kernel_of(self, q: ca.SX, n: ca.SX, twins: Twins | None = None) -> ImpactKernel:
        """The expressions on given symbols; with ``twins``, alike for twin branches."""
        return ImpactKernel(self.robot, self.contact, self.metric, self.supports, self.compliance, q, n, twins)

    def expressions(self, k: ImpactKernel) -> tuple[ca.SX, ca.SX]:
        """Value and tangent gradient (nv) in the symbols of a kernel of this contact, metric and supports."""
        return self.inner.expressions(k)

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

    def lift(self, tree: Tree, n: ca.SX, scale: ca.SX) -> Lifted:
        """The objective with its linear solves as equations of the program."""
        return self.inner.lift(tree, n, scale)

    @property
    def attempts(self) -> int:
        """Guesses that :meth:`guess` knows: one where its equations are linear in what it guesses."""
        return self.inner.attempts

    def guess(self, q: Vector, scale: float, attempt: int = 0) -> Guess:
        """The auxiliaries of :meth:`lift` that solve its equations at ``q``."""
        return self.inner.guess(q, scale, attempt)

    # ---- numeric ----------------------------------------------------------------------------------------------

    @cached_property
    def oracle(self) -> ImpactOracle:
        """Pinocchio's numbers for the leading contact, the same metric and supports, the robot as modeled."""
        return ImpactOracle(self.robot, self.contact, self.metric, self.supports, self.compliance)

    def value(self, q: Vector) -> float:
        """The objective at ``q`` from Pinocchio's numbers.

        Raises:
            MetricError: ``sticking`` where S does not exist.
        """
        return self.inner.value(q)

    def gradient(self, q: Vector) -> Vector:
        """The tangent gradient at ``q`` from Pinocchio's numbers, shape (nv,); a subgradient where tied."""
        return self.inner.gradient(q)

    def subgradients(self, q: Vector, within: float = 0.0) -> Subgradients:
        """The gradient, or those of all that tie or lie at most ``within`` below."""
        return self.inner.subgradients(q, within)
