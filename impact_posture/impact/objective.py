"""The one ``Objective`` protocol: what the program, the C export, the certificate and TSID see of an impact.

An objective is a metric × a kind × supports × one contact; none of the combinations is a class of its own.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Protocol

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from impact_posture.dynamics.tree import Tree
from impact_posture.dynamics.twins import Twins
from impact_posture.impact.contact import Contact, Support, default_compliance
from impact_posture.impact.kernel import ImpactKernel
from impact_posture.impact.lifted import CONE_ATTEMPTS, Guess, Lifted, guess_cone, guess_plain, lift_cone, lift_plain
from impact_posture.impact.metric import Metric, ObjectiveKind
from impact_posture.impact.oracle import ImpactOracle, no_sticking
from impact_posture.impact.uncertain import (
    Subgradients,
    check_cone,
    worst_gradient,
    worst_normal_expression,
    worst_subgradients,
    worst_value,
)
from impact_posture.robot.robot import Robot

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

    def subgradients(self, q: Vector) -> Subgradients:
        """What spans the subdifferential at ``q``, from Pinocchio's numbers; one gradient where it is smooth."""
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
    """

    robot: Robot
    contact: Contact
    metric: Metric = field(default_factory=Metric)
    kind: ObjectiveKind = "impulse"
    supports: tuple[Support, ...] = ()
    compliance: float = 0.0
    normal_cone_deg: float = 0.0

    def __post_init__(self) -> None:
        check_cone(self)
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
        worst = self._worst(k)
        gradients = {"speed": lambda: worst.grad_V, "energy": lambda: worst.grad_E, "sticking": lambda: worst.grad_S}
        gradient = self.scale * worst.grad_H if self.kind == "impulse" else gradients[self.kind]()
        return self._value(worst), gradient

    def _worst(self, k: ImpactKernel) -> ImpactKernel:
        """The kernel at the worst normal of the cone; its gradients hold that fixed (Danskin)."""
        if not self.normal_cone_deg:
            return k
        return self.kernel_of(k.q, worst_normal_expression(self, k), k.tree.twins)

    def _value(self, k: ImpactKernel) -> ca.SX:
        if self.kind == "impulse":
            return self.scale * k.H
        return {"speed": lambda: k.V, "energy": lambda: k.E, "sticking": lambda: k.S}[self.kind]()

    def value_fun(self) -> ca.Function:
        """``(q, n) → value``; ``n`` in the contact's normal frame."""
        k = self.kernel
        return ca.Function("value", [k.q, k.n], [self._value(self._worst(k))], ["q", "n"], ["value"], {"cse": True})

    def gradient_fun(self) -> ca.Function:
        """``(q, n) → value, gradient``: value and tangent gradient (nv); ``n`` in the contact's normal frame.

        With a cone, ``n`` is its axis, and both hold for the worst normal in it.
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
        return lift_cone(self, tree, n, scale) if self.normal_cone_deg else lift_plain(self, tree, n)

    @property
    def attempts(self) -> int:
        """Guesses that :meth:`guess` knows: one where its equations are linear in what it guesses."""
        return CONE_ATTEMPTS if self.normal_cone_deg else 1

    def guess(self, q: Vector, scale: float, attempt: int = 0) -> Guess:
        """The auxiliaries of :meth:`lift` that solve its equations at ``q``."""
        return guess_cone(self, q, scale, attempt) if self.normal_cone_deg else guess_plain(self, q)

    # ---- numeric ----------------------------------------------------------------------------------------------

    @cached_property
    def oracle(self) -> ImpactOracle:
        """Pinocchio's numbers for the same contact, metric and supports."""
        return ImpactOracle(self.robot, self.contact, self.metric, self.supports, self.compliance)

    def value(self, q: Vector) -> float:
        """The objective at ``q`` from Pinocchio's numbers.

        Raises:
            MetricError: ``sticking`` where S does not exist.
        """
        if self.normal_cone_deg:
            return worst_value(self, q)
        found = self.oracle.quantities(q)
        if self.kind == "impulse":
            return self.scale * found.H
        if self.kind == "speed":
            return found.V
        if self.kind == "energy":
            return found.E
        if found.S is None:
            raise no_sticking()
        return found.S

    def gradient(self, q: Vector) -> Vector:
        """The tangent gradient at ``q`` from Pinocchio's numbers, shape (nv,); a subgradient where tied."""
        if self.normal_cone_deg:
            return worst_gradient(self, q)
        oracle = self.oracle
        if self.kind == "impulse":
            return self.scale * oracle.gradient_H(q)
        if self.kind == "sticking":
            return oracle.gradient_S(q)
        found = oracle.quantities(q)
        if self.kind == "energy":
            return -oracle.gradient_G(q) / (2 * found.G**2)
        return oracle.gradient_H(q) / found.G**2 - 2 * found.H / found.G**3 * oracle.gradient_G(q)

    def subgradients(self, q: Vector) -> Subgradients:
        """The gradient, or those at all tied worst normals of a cone."""
        if self.normal_cone_deg:
            return worst_subgradients(self, q)
        return Subgradients(self.gradient(q)[None, :], np.zeros(1))
