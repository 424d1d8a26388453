"""A cone of normals as a program: the dual of the inner maximum.

A cone of normals (half angle α) adds the dual of the inner maximum.  In the cone's axes, with the quadratic form
``P(q) = [a, bᵀ; b, C]``, ``c = cos α``, ``s = sin α`` and everything divided by the form's first value::

    min t,   t = a + sτ,   Z = [τ − ρ, −bᵀ; −b, (st + ρc²) I − sC] = L²,   ρ ≥ 0

``Z`` is ``tI − P − μ(n₀n₀ᵀ − c²I)`` between two factors ``diag(s^-½, s^½, s^½)`` with ``μ = ρ/s``, which stays
bounded as α goes to zero.  The symmetric root ``L`` keeps its gradient where eigenvalues of ``Z`` vanish together, as
they do at mirror-symmetric postures: there ``det Z`` has none.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, overload

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from impact_posture.dynamics.tree import Tree, Wrench
from impact_posture.impact.cone import cone_axes, worst_normal
from impact_posture.impact.cone_symbolic import cone_axes_symbolic
from impact_posture.impact.contact import point_on
from impact_posture.impact.inner import Subgradients
from impact_posture.impact.lifted import Guess, Lifted, UnknownJump, unknown_jump, weighed
from impact_posture.impact.one_blow import OneBlow
from impact_posture.impact.uncertain import (
    form_and_jumps,
    worst_gradient,
    worst_normal_expression,
    worst_subgradients,
    worst_value,
)

if TYPE_CHECKING:
    from impact_posture.impact.kernel import ImpactKernel
    from impact_posture.impact.objective import ImpactObjective

Vector = NDArray[np.float64]

# Where τ and ρ start above their solution at the first posture, by attempt: a root with an eigenvalue at zero, on the
# boundary, is a saddle point for Newton's method.
_INSIDE = ((0.03, 0.01), (0.3, 0.1), (0.003, 0.001))


@dataclass(frozen=True)
class ConeOfNormals:
    """The worst normal within ``normal_cone_deg`` of the contact's own."""

    objective: ImpactObjective
    attempts: int = len(_INSIDE)

    def value(self, q: Vector) -> float:
        """See :class:`~impact_posture.impact.inner.InnerMaximum`."""
        return worst_value(self.objective, q)

    def gradient(self, q: Vector) -> Vector:
        """See :class:`~impact_posture.impact.inner.InnerMaximum`."""
        return worst_gradient(self.objective, q)

    def subgradients(self, q: Vector, within: float = 0.0) -> Subgradients:
        """See :class:`~impact_posture.impact.inner.InnerMaximum`; those at all tied worst normals."""
        return worst_subgradients(self.objective, q, within)

    def expressions(self, k: ImpactKernel) -> tuple[ca.SX, ca.SX]:
        """The one blow's along the worst normal, which the gradient holds fixed (Danskin)."""
        worst = self.objective.kernel_of(k.q, worst_normal_expression(self.objective, k), k.tree.twins)
        return OneBlow(self.objective).expressions(worst)

    def lift(self, tree: Tree, n: ca.SX, scale: ca.SX) -> Lifted:
        """See :class:`~impact_posture.impact.inner.InnerMaximum`."""
        return lift_cone(self.objective, tree, n, scale)

    def guess(self, q: Vector, scale: float, attempt: int = 0) -> Guess:
        """See :class:`~impact_posture.impact.inner.InnerMaximum`."""
        return guess_cone(self.objective, q, scale, attempt)


def lift_cone(objective: ImpactObjective, tree: Tree, n: ca.SX, scale: ca.SX) -> Lifted:
    """The worst case over the cone around ``n``: three jumps, ``τ``, ``ρ`` and the six entries of ``L``."""
    jumps: list[UnknownJump] = []
    variables: list[ca.SX] = []
    residual: list[ca.SX] = []
    point = point_on(objective.robot, objective.contact.frame, objective.contact.offset)
    in_frame = objective.contact.normal_frame == "contact"
    local = cone_axes_symbolic(n)
    world = tree.rotation(point) @ local if in_frame else local
    for k in range(3):
        if objective.kind == "sticking":
            impulse = ca.SX.sym(f"s{k}", 3)
            jump = unknown_jump(objective, tree, Wrench(point, impulse, ca.SX.zeros(3)), str(k))
            variables += [jump.variables, impulse]
            residual += [jump.residual, jump.contact_velocity - world[:, k]]
        else:
            blow = Wrench(point, local[:, k], ca.SX.zeros(3), in_frame=in_frame)
            jump = unknown_jump(objective, tree, blow, str(k))
            variables.append(jump.variables)
            residual.append(jump.residual)
        jumps.append(jump)
    unit = _unit(objective, scale)
    form = ca.SX.zeros(3, 3)
    for i in range(3):
        for j in range(i, 3):
            if objective.kind == "energy":
                entry = -ca.dot(world[:, i], jumps[j].contact_velocity)
            else:
                entry = weighed(objective, jumps[i], jumps[j])
            form[i, j] = form[j, i] = entry / unit
    tau, rho, root = ca.SX.sym("tau"), ca.SX.sym("rho"), ca.SX.sym("root", 6)
    c, s = _cosine_sine(objective)
    t = form[0, 0] + s * tau
    block = (s * t + rho * c * c) * ca.SX.eye(2) - s * form[1:, 1:]
    L = _symmetric(root)
    gap = ca.blockcat([[tau - rho, -form[0, 1:]], [-form[1:, 0], block]]) - L @ L
    worst = -1 / (2 * t * unit) if objective.kind == "energy" else objective.scale * unit * t
    return Lifted(
        variables=ca.vertcat(*variables, tau, rho, root),
        residual=ca.vertcat(*residual, *[gap[i, j] for i, j in _UPPER]),
        value=worst,
    )


def guess_cone(objective: ImpactObjective, q: Vector, scale: float, attempt: int = 0) -> Guess:
    """The auxiliaries of :func:`lift_cone` at ``q``, ``Z`` a little inside of the cone that it must stay in."""
    oracle = objective.oracle
    form, jumps, impulses = form_and_jumps(objective, q, cone_axes(np.array(objective.contact.normal)))
    form = form / _unit(objective, scale)
    parts = []
    for k in range(3):
        parts += [jumps[:, k], -oracle.Js @ jumps[:, k] / objective.compliance]
        parts += [impulses[:, k]] if objective.kind == "sticking" else []
    c, s = _cosine_sine(objective)
    found = worst_normal(form, np.eye(3)[0], objective.normal_cone_deg)
    above, beyond = _INSIDE[attempt]
    tau, rho = (found.value - form[0, 0]) / s + above + beyond, found.multiplier * s + beyond
    Z = -s * form
    Z[0, :] = Z[:, 0] = Z[:, 0] / s
    Z[0, 0] = tau - rho
    Z[1:, 1:] += (s * (form[0, 0] + s * tau) + rho * c * c) * np.eye(2)
    values, vectors = np.linalg.eigh(Z)
    root = (vectors * np.sqrt(np.maximum(values, 1e-6))) @ vectors.T
    values = np.concatenate([*parts, [tau, rho], [root[i, j] for i, j in _UPPER]])
    lower = np.full(values.size, -np.inf)
    lower[-1 - len(_UPPER)] = 0.0
    return Guess(values, lower)


_UPPER = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


def _cosine_sine(objective: ImpactObjective) -> tuple[float, float]:
    alpha = np.deg2rad(objective.normal_cone_deg)
    return float(np.cos(alpha)), float(np.sin(alpha))


@overload
def _unit(objective: ImpactObjective, scale: float) -> float: ...
@overload
def _unit(objective: ImpactObjective, scale: ca.SX) -> ca.SX: ...
def _unit(objective: ImpactObjective, scale: Any) -> Any:
    """What the quadratic form is measured in: its size where the objective is ``scale``."""
    return 1 / (2 * scale) if objective.kind == "energy" else scale / objective.scale


def _symmetric(entries: ca.SX) -> ca.SX:
    x = entries
    return ca.blockcat([[x[0], x[1], x[2]], [x[1], x[3], x[4]], [x[2], x[4], x[5]]])
