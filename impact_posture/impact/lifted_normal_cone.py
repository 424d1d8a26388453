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

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from impact_posture.dynamics.tree import Tree
from impact_posture.impact.cone import cone_axes, worst_normal
from impact_posture.impact.cone_symbolic import cone_axes_symbolic
from impact_posture.impact.impact_case import ImpactCase
from impact_posture.impact.impact_kind import QuadraticKind
from impact_posture.impact.lifted import Guess, Lifted, UnknownJump, impact_at, in_world
from impact_posture.impact.oracle import ImpactOracle

Vector = NDArray[np.float64]

# Where τ and ρ start above their solution at the first posture, by attempt: a root with an eigenvalue at zero, on the
# boundary, is a saddle point for Newton's method.
INSIDE = ((0.03, 0.01), (0.3, 0.1), (0.003, 0.001))


@dataclass(frozen=True, eq=False)
class FormAlongAxes:
    """The quadratic form of a kind along three directions, and what unit impulses along them cause.

    Attributes:
        form: ``K`` along the directions, shape (3, 3).
        jumps: Velocity jumps as columns, shape (nv, 3).
        impulses: Impulses as columns, world axes, shape (3, 3).
    """

    form: Vector
    jumps: Vector
    impulses: Vector

    @staticmethod
    def at(oracle: ImpactOracle, kind: QuadraticKind, q: Vector, directions: Vector) -> FormAlongAxes:
        """Compute it at ``q``; directions are columns in the axes of the contact's normal, shape (3, 3).

        Raises:
            MetricError: The form does not exist at ``q``.
        """
        oracle.at(q)
        turned = oracle.case.in_contact_frame
        axes = np.array(oracle.numeric.placement(oracle.point).rotation) if turned else np.eye(3)
        world: Vector = np.asarray(axes @ directions)
        responses = oracle.solve(oracle.J.T)
        mobility = oracle.J @ responses
        impulses = kind.directions(mobility, world)
        jumps = responses @ impulses
        K = kind.form(oracle, mobility, world, jumps)
        return FormAlongAxes((K + K.T) / 2, jumps, impulses)


def lift_cone(case: ImpactCase, kind: QuadraticKind, degrees: float, tree: Tree, n: ca.SX, scale: ca.SX) -> Lifted:
    """The worst case over the cone around ``n``: three jumps, ``τ``, ``ρ`` and the six entries of ``L``."""
    local = cone_axes_symbolic(n)
    world = in_world(case, tree, local)
    jumps: list[UnknownJump] = []
    variables: list[ca.SX] = []
    residual: list[ca.SX] = []
    for k in range(3):
        direction = kind.lift_direction(case, tree, impact_at(case, local[:, k]), world[:, k], str(k))
        jumps.append(direction[0])
        variables.append(direction[1])
        residual.append(direction[2])
    unit = kind.form_unit(case, scale)
    form = ca.SX.zeros(3, 3)
    for i in range(3):
        for j in range(i, 3):
            form[i, j] = form[j, i] = kind.lift_entry(case, world[:, i], jumps[i], jumps[j]) / unit
    tau, rho, root = ca.SX.sym("tau"), ca.SX.sym("rho"), ca.SX.sym("root", 6)
    c, s = _cosine_sine(degrees)
    t = form[0, 0] + s * tau
    block = (s * t + rho * c * c) * ca.SX.eye(2) - s * form[1:, 1:]
    L = _symmetric(root)
    gap = ca.blockcat([[tau - rho, -form[0, 1:]], [-form[1:, 0], block]]) - L @ L
    return Lifted(
        variables=ca.vertcat(*variables, tau, rho, root),
        residual=ca.vertcat(*residual, *[gap[i, j] for i, j in _UPPER]),
        value=kind.of_form_expression(case, unit * t),
    )


def guess_cone(
    oracle: ImpactOracle, kind: QuadraticKind, degrees: float, q: Vector, scale: float, attempt: int = 0
) -> Guess:
    """The auxiliaries of :func:`lift_cone` at ``q``, ``Z`` a little inside of the cone that it must stay in."""
    found = FormAlongAxes.at(oracle, kind, q, cone_axes(np.array(oracle.contact.normal)))
    form = found.form / kind.form_unit(oracle.case, scale)
    parts: list[Vector] = []
    for k in range(3):
        feet = -oracle.Js @ found.jumps[:, k] / oracle.compliance
        parts += kind.guess_direction(found.jumps[:, k], feet, found.impulses[:, k])
    c, s = _cosine_sine(degrees)
    worst = worst_normal(form, np.eye(3)[0], degrees)
    above, beyond = INSIDE[attempt]
    tau, rho = (worst.value - form[0, 0]) / s + above + beyond, worst.multiplier * s + beyond
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


def _cosine_sine(degrees: float) -> tuple[float, float]:
    alpha = np.deg2rad(degrees)
    return float(np.cos(alpha)), float(np.sin(alpha))


def _symmetric(entries: ca.SX) -> ca.SX:
    x = entries
    return ca.blockcat([[x[0], x[1], x[2]], [x[1], x[3], x[4]], [x[2], x[4], x[5]]])
