"""Objectives with their linear solves left to the program, for one normal and for a cone of them.

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
from impact_posture.impact.uncertain import form_and_jumps

if TYPE_CHECKING:
    from impact_posture.impact.objective import ImpactObjective

Vector = NDArray[np.float64]

# Where τ and ρ start above their solution at the first posture, by attempt: a root with an eigenvalue at zero, on the
# boundary, is a saddle point for Newton's method.
_INSIDE = ((0.03, 0.01), (0.3, 0.1), (0.003, 0.001))
CONE_ATTEMPTS = len(_INSIDE)


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


@dataclass(frozen=True, eq=False)
class Guess:
    """Where a lifted form's auxiliaries start.

    Attributes:
        values: Shape (k,).
        lower: Lower bounds, shape (k,); minus infinity where there is none.
    """

    values: Vector
    lower: Vector


@dataclass(frozen=True, eq=False)
class UnknownJump:
    """A jump ``a`` and the supports' impulses as unknowns.

    Attributes:
        a: Unknown, shape (nv,).
        variables: ``a`` and the supports' impulses.
        residual: ``M a − J_sᵀf − (the blow)`` and ``J_s a + εf``.
        mass_a: ``M a``.
        contact_velocity: ``J a``, world, shape (3,).
    """

    a: ca.SX
    variables: ca.SX
    residual: ca.SX
    mass_a: ca.SX
    contact_velocity: ca.SX


def unknown_jump(objective: ImpactObjective, tree: Tree, blow: Wrench, label: str = "") -> UnknownJump:
    """Unknowns and equations of the answer to one blow."""
    a = ca.SX.sym(f"a{label}", tree.nv)
    velocities = tree.velocities(a)
    wrenches, held, f = [blow], [], ca.SX(0, 1)
    for k, support in enumerate(objective.supports):
        foot = point_on(objective.robot, support.frame, support.offset)
        f_k = ca.SX.sym(f"f{label}_{k}", support.rows)
        full = ca.vertcat(f_k, ca.SX.zeros(6 - support.rows))
        wrenches.append(Wrench(foot, full[:3], full[3:]))
        held.append(tree.point_velocity(foot, velocities)[: support.rows] + objective.compliance * f_k)
        f = ca.vertcat(f, f_k)
    mass_a = tree.mass_times(a)
    momentum = mass_a - tree.generalized_force(wrenches)
    return UnknownJump(
        a=a,
        variables=ca.vertcat(a, f),
        residual=ca.vertcat(momentum, *held),
        mass_a=mass_a,
        contact_velocity=tree.point_velocity(blow.point, velocities)[:3],
    )


def weighed(objective: ImpactObjective, one: UnknownJump, other: UnknownJump) -> ca.SX:
    """``a₁ᵀWa₂``."""
    if objective.metric.kind == "kinetic":
        # Not sᵀJa − ε|f|², equal on the equations: stiff feet make that a small difference of large numbers.
        return ca.dot(one.a, other.mass_a)
    return ca.dot(one.a, ca.SX(objective.metric.diagonal(one.a.numel())) * other.a)


# ---- one normal ---------------------------------------------------------------------------------------------------


def lift_plain(objective: ImpactObjective, tree: Tree, n: ca.SX) -> Lifted:
    """The objective with ``a``, the supports' impulses and (for ratios) the contact's impulse as unknowns.

    ``M a − J_sᵀf − Jᵀs = 0`` and ``J_s a + εf = 0``, with ``s = n`` (impulse), ``s = λn, nᵀJa = 1`` (speed,
    energy), or ``s`` free, ``Ja = n`` (sticking).  The value is ``aᵀWa`` or ``λ/2``.
    """
    point = point_on(objective.robot, objective.contact.frame, objective.contact.offset)
    in_frame = objective.contact.normal_frame == "contact"
    zero = ca.SX.zeros(3)
    world_n = tree.rotation(point) @ n if in_frame else n
    if objective.kind == "impulse":
        unknown = ca.SX(0, 1)
        jump = unknown_jump(objective, tree, Wrench(point, n, zero, in_frame=in_frame))
        fixing = ca.SX(0, 1)
    elif objective.kind == "sticking":
        unknown = ca.SX.sym("s", 3)
        jump = unknown_jump(objective, tree, Wrench(point, unknown, zero))
        fixing = jump.contact_velocity - world_n
    else:
        unknown = ca.SX.sym("lam")
        jump = unknown_jump(objective, tree, Wrench(point, n * unknown, zero, in_frame=in_frame))
        fixing = ca.dot(world_n, jump.contact_velocity) - 1
    value = unknown / 2 if objective.kind == "energy" else weighed(objective, jump, jump)
    return Lifted(ca.vertcat(jump.variables, unknown), ca.vertcat(jump.residual, fixing), objective.scale * value)


def guess_plain(objective: ImpactObjective, q: Vector) -> Guess:
    """The auxiliaries of :func:`lift_plain` that solve its equations at ``q``."""
    quantities = objective.oracle.quantities(q)
    if objective.kind == "impulse":
        a, unknown = quantities.jump, np.zeros(0)
    elif objective.kind == "sticking":
        if quantities.sticking_jump is None or quantities.sticking_impulse is None:
            a, unknown = quantities.jump / quantities.G, quantities.normal / quantities.G
        else:
            a, unknown = quantities.sticking_jump, quantities.sticking_impulse
    else:
        a, unknown = quantities.jump / quantities.G, np.array([1 / quantities.G])
    values = np.concatenate([a, -objective.oracle.Js @ a / objective.compliance, unknown])
    return Guess(values, np.full(values.size, -np.inf))


# ---- a cone of normals --------------------------------------------------------------------------------------------


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
