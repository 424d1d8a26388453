"""An objective's worst case over a cone of normals: value, worst normal, subgradients, expressions.

``impulse``, ``sticking`` and ``energy`` depend on the normal through one quadratic form ``nᵀK(q)n``, with ``K`` =
``Λ_c``, ``B⁻¹Λ_cB⁻¹`` and ``−B`` (``B = JM⁻¹Jᵀ``); the largest energy ``1/(2G)`` is where ``G`` is least.  ``speed``
is no such form and has no such dual.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from impact_posture.errors import InputError, MetricError
from impact_posture.impact.cone import WorstNormal, tied_normals, worst_normal
from impact_posture.impact.cone_symbolic import worst_normal_symbolic
from impact_posture.impact.inner import Subgradients
from impact_posture.impact.oracle import no_sticking

if TYPE_CHECKING:
    from impact_posture.impact.kernel import ImpactKernel
    from impact_posture.impact.objective import ImpactObjective

Vector = NDArray[np.float64]

# Normals whose value is within this share of the largest count as worst ones in a subdifferential.
_ACTIVE = 1e-7
# Below this share of the largest, an eigenvalue of JM⁻¹Jᵀ is zero.
_SINGULAR = 1e-9


def check_cone(objective: ImpactObjective) -> None:
    """Refuse what is no cone and what has no dual.

    Raises:
        InputError: No half angle of a cone.
        MetricError: ``speed``.
    """
    cone = objective.normal_cone_deg
    if not 0 <= cone < 90:
        raise InputError(f"the half angle is {cone:g}°", where="--normal-cone", mend="give 0 to below 90 degrees")
    if cone and objective.kind == "speed":
        raise MetricError(
            "speed is H/G², no quadratic form of the normal: the exact worst case over a cone is not known for it",
            where="--normal-cone",
            mend="choose --objective impulse, sticking or energy, or --normal-cone 0",
        )


def worst_case(objective: ImpactObjective, q: Vector) -> WorstNormal:
    """The worst normal of the cone at ``q``, in the axes that the contact's normal is given in.

    Its ``value`` is that of the form ``nᵀKn``; :func:`worst_value` is the objective's.

    Raises:
        MetricError: ``sticking`` where the contact point cannot move in every direction.
    """
    return worst_normal(_form(objective, q), np.array(objective.contact.normal), objective.normal_cone_deg)


def worst_in_world(objective: ImpactObjective, q: Vector) -> WorstNormal:
    """:func:`worst_case` with its normals in world axes."""
    found, oracle = worst_case(objective, q), objective.oracle
    if objective.contact.normal_frame == "world":
        return found
    return found.turned(np.array(oracle.at(q).numeric.placement(oracle.point).rotation))


def worst_value(objective: ImpactObjective, q: Vector) -> float:
    """The objective at its worst normal."""
    return float(_of_form(objective, np.array(worst_case(objective, q).value)))


def worst_gradient(objective: ImpactObjective, q: Vector) -> Vector:
    """Tangent gradient at the worst normal, held fixed (Danskin); where tied, the named one's: a subgradient."""
    found = worst_case(objective, q)
    slope = float(_slope(objective, np.array(found.value)))
    return slope * _form_gradient(objective, q, found.normal)


def worst_subgradients(objective: ImpactObjective, q: Vector, within: float = 0.0) -> Subgradients:
    """Gradients at all worst normals, the named one first; of an arc or a circle of them a dense sample.

    Those whose objective is at most ``within`` below count as well.
    """
    form, axis = _form(objective, q), np.array(objective.contact.normal)
    found = worst_normal(form, axis, objective.normal_cone_deg)
    size = max(float(np.abs(form).max() * _slope(objective, np.array(found.value))), 1e-300)
    normals = tied_normals(form, axis, objective.normal_cone_deg, found, max(_ACTIVE, within / size))
    values = np.einsum("ki,ij,kj->k", normals, form, normals)
    slopes = _slope(objective, values)
    gaps = np.maximum(_of_form(objective, np.array(found.value)) - _of_form(objective, values), 0.0)
    if len(normals) <= 2:
        gradients = np.array([_form_gradient(objective, q, n) for n in normals])
    else:
        gradients = np.einsum("ki,ijv,kj->kv", normals, _form_tensor(objective, q), normals)
    return Subgradients(slopes[:, None] * gradients, gaps)


def worst_normal_expression(objective: ImpactObjective, k: ImpactKernel) -> ca.SX:
    """The worst normal of a kernel's ``q`` and ``n`` in closed form, in the axes of ``n``, shape (3,)."""
    form = {"impulse": lambda: k.ellipsoid, "sticking": lambda: k.sticking_form, "energy": lambda: -k.mobility}
    K = form[objective.kind]()
    if objective.contact.normal_frame == "contact":
        R = k.tree.rotation(k.point)
        K = R.T @ K @ R
    return worst_normal_symbolic((K + K.T) / 2, k.n, objective.normal_cone_deg)


def form_and_jumps(objective: ImpactObjective, q: Vector, directions: Vector) -> tuple[Vector, Vector, Vector]:
    """The form in given directions, and what the three unit blows along them do.

    Args:
        objective: The objective.
        q: Configuration, shape (nq,).
        directions: Columns in the axes of the contact's normal, shape (3, 3).

    Returns:
        ``K`` in these directions, shape (3, 3); the jumps as columns, shape (nv, 3); the impulses, world, (3, 3).

    Raises:
        MetricError: ``sticking`` where the contact point cannot move in every direction.
    """
    oracle = objective.oracle.at(q)
    in_frame = objective.contact.normal_frame == "contact"
    turn = np.array(oracle.numeric.placement(oracle.point).rotation) if in_frame else np.eye(3)
    world: Vector = np.asarray(turn @ directions)
    responses = oracle.solve(oracle.J.T)
    mobility = oracle.J @ responses
    impulses = world
    if objective.kind == "sticking":
        sizes = np.linalg.eigvalsh((mobility + mobility.T) / 2)
        if sizes[0] <= _SINGULAR * sizes[-1]:
            raise no_sticking()
        impulses = np.asarray(np.linalg.solve(mobility, world))
    jumps = responses @ impulses
    K = np.asarray(-world.T @ mobility @ world if objective.kind == "energy" else jumps.T @ oracle.weigh(jumps))
    return (K + K.T) / 2, jumps, impulses


def _form(objective: ImpactObjective, q: Vector) -> Vector:
    return form_and_jumps(objective, q, np.eye(3))[0]


def _of_form(objective: ImpactObjective, form: Vector) -> Vector:
    """The objective's values where the form has these."""
    if objective.kind == "energy":
        return np.asarray(np.where(form < 0, -1 / (2 * np.where(form < 0, form, -1.0)), np.inf))
    return objective.scale * form


def _slope(objective: ImpactObjective, form: Vector) -> Vector:
    """Derivative of :func:`_of_form`."""
    return 1 / (2 * form**2) if objective.kind == "energy" else np.full_like(form, objective.scale)


def _form_gradient(objective: ImpactObjective, q: Vector, n: Vector) -> Vector:
    """Tangent gradient of ``nᵀK(q)n`` with ``n`` held fixed, of any length."""
    oracle = objective.oracle
    if objective.kind == "impulse":
        return oracle.gradient_H(q, n)
    return oracle.gradient_S(q, n) if objective.kind == "sticking" else -oracle.gradient_G(q, n)


def _form_tensor(objective: ImpactObjective, q: Vector) -> Vector:
    """``∂K``, shape (3, 3, nv), from the gradients along six directions."""
    axes = np.eye(3)
    tensor = np.zeros((3, 3, objective.robot.nv))
    for i in range(3):
        tensor[i, i] = _form_gradient(objective, q, axes[i])
    for i, j in ((0, 1), (0, 2), (1, 2)):
        both = _form_gradient(objective, q, axes[i] + axes[j])
        tensor[i, j] = tensor[j, i] = (both - tensor[i, i] - tensor[j, j]) / 2
    return tensor
