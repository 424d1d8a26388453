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

from impact_posture.dynamics.tree import Tree, Wrench
from impact_posture.dynamics.twins import Twins
from impact_posture.impact.contact import Contact, Support, default_compliance, point_on
from impact_posture.impact.kernel import ImpactKernel
from impact_posture.impact.metric import Metric, ObjectiveKind
from impact_posture.impact.oracle import ImpactOracle, no_sticking
from impact_posture.robot.robot import Robot

Vector = NDArray[np.float64]


@dataclass(frozen=True)
class Lifted:
    """An objective with its inner linear solve left to the program.

    Attributes:
        variables: Auxiliary unknowns, shape (k, 1).
        residual: Equations that fix them, ``= 0``, shape (k, 1).
        value: The objective in terms of configuration and auxiliaries.
    """

    variables: ca.SX
    residual: ca.SX
    value: ca.SX


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

    def lift(self, tree: Tree, n: ca.SX) -> Lifted:
        """The value as a quadratic in auxiliaries that solve linear equations at ``tree.q``."""
        ...

    def guess(self, q: Vector) -> Vector:
        """The lifted form's auxiliaries at ``q``."""
        ...

    def value(self, q: Vector) -> float:
        """The value from Pinocchio's numbers."""
        ...

    def gradient(self, q: Vector) -> Vector:
        """The tangent gradient from Pinocchio's numbers, shape (nv,)."""
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
    """

    robot: Robot
    contact: Contact
    metric: Metric = field(default_factory=Metric)
    kind: ObjectiveKind = "impulse"
    supports: tuple[Support, ...] = ()
    compliance: float = 0.0

    def __post_init__(self) -> None:
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
        if self.kind == "impulse":
            return self.scale * k.H, self.scale * k.grad_H
        if self.kind == "speed":
            return k.V, k.grad_V
        if self.kind == "energy":
            return k.E, k.grad_E
        return k.S, k.grad_S

    def value_fun(self) -> ca.Function:
        """``(q, n) → value``; ``n`` in the contact's normal frame."""
        k = self.kernel
        value = {"impulse": self.scale * k.H, "speed": k.V, "energy": k.E}
        expression = value[self.kind] if self.kind in value else k.S
        return ca.Function("value", [k.q, k.n], [expression], ["q", "n"], ["value"], {"cse": True})

    def gradient_fun(self) -> ca.Function:
        """``(q, n) → value, gradient``: value and tangent gradient (nv); ``n`` in the contact's normal frame."""
        k = self.kernel
        value, gradient = self.expressions(k)
        return ca.Function(
            "gradient", [k.q, k.n], [value, gradient], ["q", "n"], ["value", "gradient"], {"cse": True}
        )

    def metric_fun(self) -> ca.Function:
        """``(q, n) → H, grad``: the impact-robustness metric and its tangent gradient, whatever the objective."""
        k = self.kernel
        return ca.Function("eval", [k.q, k.n], [k.H, k.grad_H], ["q", "n"], ["H", "grad"], {"cse": True})

    def lift(self, tree: Tree, n: ca.SX) -> Lifted:
        """The objective with ``a``, the supports' impulses and (for ratios) the contact's impulse as unknowns.

        ``M a − J_sᵀf − Jᵀs = 0`` and ``J_s a + εf = 0``, with ``s = n`` (impulse), ``s = λn, nᵀJa = 1`` (speed,
        energy), or ``s`` free, ``Ja = n`` (sticking).  The value is ``aᵀWa`` or ``λ/2``.
        """
        point = point_on(self.robot, self.contact.frame, self.contact.offset)
        in_frame = self.contact.normal_frame == "contact"
        zero = ca.SX.zeros(3)
        a = ca.SX.sym("a", tree.nv)
        velocities = tree.velocities(a)
        wrenches, held, f = [], [], ca.SX(0, 1)
        for k, support in enumerate(self.supports):
            foot = point_on(self.robot, support.frame, support.offset)
            f_k = ca.SX.sym(f"f{k}", support.rows)
            full = ca.vertcat(f_k, ca.SX.zeros(6 - support.rows))
            wrenches.append(Wrench(foot, full[:3], full[3:]))
            held.append(tree.point_velocity(foot, velocities)[: support.rows] + self.compliance * f_k)
            f = ca.vertcat(f, f_k)
        world_n = tree.rotation(point) @ n if in_frame else n
        contact_velocity = tree.point_velocity(point, velocities)[:3]
        if self.kind == "impulse":
            unknown, fixing = ca.SX(0, 1), ca.SX(0, 1)
            blow = Wrench(point, n, zero, in_frame=in_frame)
        elif self.kind == "sticking":
            unknown = ca.SX.sym("s", 3)
            fixing = contact_velocity - world_n
            blow = Wrench(point, unknown, zero)
        else:
            unknown = ca.SX.sym("lam")
            fixing = ca.dot(world_n, contact_velocity) - 1
            blow = Wrench(point, n * unknown, zero, in_frame=in_frame)
        mass_a = tree.mass_times(a)
        momentum = mass_a - tree.generalized_force([*wrenches, blow])
        if self.kind == "energy":
            value = unknown / 2
        elif self.metric.kind == "kinetic":
            # Not sᵀJa − ε|f|², equal on the equations: stiff feet make that a small difference of large numbers.
            value = ca.dot(a, mass_a)
        else:
            value = ca.dot(a, ca.SX(self.metric.diagonal(tree.nv)) * a)
        variables = ca.vertcat(a, f, unknown)
        residual = ca.vertcat(momentum, *held, fixing)
        return Lifted(variables, residual, self.scale * value)

    def guess(self, q: Vector) -> Vector:
        """The auxiliaries of :meth:`lift` that solve its equations at ``q``."""
        quantities = self.oracle.quantities(q)
        if self.kind == "impulse":
            a, unknown = quantities.jump, np.zeros(0)
        elif self.kind == "sticking":
            if quantities.sticking_jump is None or quantities.sticking_impulse is None:
                a, unknown = quantities.jump / quantities.G, quantities.normal / quantities.G
            else:
                a, unknown = quantities.sticking_jump, quantities.sticking_impulse
        else:
            a, unknown = quantities.jump / quantities.G, np.array([1 / quantities.G])
        return np.concatenate([a, -self.oracle.Js @ a / self.compliance, unknown])

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
        """The objective's tangent gradient at ``q`` from Pinocchio's numbers, shape (nv,)."""
        oracle = self.oracle
        if self.kind == "impulse":
            return self.scale * oracle.gradient_H(q)
        if self.kind == "sticking":
            return oracle.gradient_S(q)
        found = oracle.quantities(q)
        if self.kind == "energy":
            return -oracle.gradient_G(q) / (2 * found.G**2)
        return oracle.gradient_H(q) / found.G**2 - 2 * found.H / found.G**3 * oracle.gradient_G(q)
