"""Self-test of an export: reference values in the manifest, and the tolerance for results of the C code."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from impact_posture.codegen.c_literals import DOUBLE, Real
from impact_posture.errors import MetricError
from impact_posture.impact.quantities.impact_oracle import ImpactOracle
from impact_posture.impact.support_compliance import heavy_feet_rounding
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.robot.robot import Robot
from impact_posture.system.arrays import Array

Reference = Callable[[Array, Array], dict[str, Array]]
"""Function of ``q``, shape (nq,), and ``n``, shape (3,), that returns a flat array for each name of a quantity."""


# Cached, because the manifest and the check of the same export need the same reference.
@lru_cache(maxsize=8)
def casadi_reference(objective: WorstCaseObjective) -> Reference:
    """Return a function that computes the quantities of an export with CasADi.

    The quantities are ``H``, ``grad`` (nv,), ``jump`` (nv,), ``G``, ``V = H/G²``, ``ellipsoid`` (9,), ``objective``
    and ``objective_grad`` (nv,).  ``objective`` and ``objective_grad`` are for the normal of the contact and do not
    depend on ``n``.  For several contacts, only ``objective`` and ``objective_grad`` exist.
    """
    k = objective.kernel
    value, gradient = objective.worst_case.expressions(k)
    outputs = {} if objective.others else {"H": k.H, "grad": k.grad_H}
    outputs |= {"objective": value, "objective_grad": gradient}
    outputs |= {} if objective.others else {"jump": k.jump.a, "G": k.G, "V": k.V, "ellipsoid": k.ellipsoid}
    function = ca.Function("reference", [k.q, k.n], [*outputs.values()], ["q", "n"], [*outputs])

    def evaluate(q: Array, n: Array) -> dict[str, Array]:
        along, stated = (function(q=q, n=normal) for normal in (n, objective.contact.normal))
        results = {name: stated[name] if name.startswith("objective") else along[name] for name in outputs}
        return {name: np.array(result, dtype=float).ravel() for name, result in results.items()}

    return evaluate


def oracle_reference(objective: WorstCaseObjective) -> Reference:
    """Return a function that computes the quantities of :func:`casadi_reference` with Pinocchio."""

    def evaluate(q: Array, n: Array) -> dict[str, Array]:
        values: dict[str, ArrayLike] = {"objective": objective.value(q), "objective_grad": objective.gradient(q)}
        if not objective.others:
            oracle = oracle_along(objective, n)
            at = oracle.quantities(q)
            values |= {"H": at.H, "grad": oracle.gradient_H(q), "jump": at.jump, "G": at.G, "V": at.V}
            values["ellipsoid"] = at.ellipsoid
        return {name: np.array(value, dtype=float).ravel() for name, value in values.items()}

    return evaluate


def oracle_along(objective: WorstCaseObjective, normal: Array) -> ImpactOracle:
    """Return the oracle of the first contact with another normal, shape (3,), in the axes of the old normal."""
    x, y, z = (float(v) for v in normal)
    return ImpactOracle(replace(objective.case, contact=replace(objective.contact, normal=(x, y, z))))


# Unit normal of the self-test.  With a normal parallel to an axis, many entries of the gradient would be zero.
_NORMAL = (0.48, -0.6, 0.64)
_SCALARS = frozenset({"H", "objective", "G", "V"})


def sample_postures(robot: Robot, count: int, seed: int) -> list[Array]:
    """Return ``count`` random configurations around the default posture, each of shape (nq,)."""
    rng = np.random.default_rng(seed)
    start = robot.posture()
    return [np.asarray(pin.integrate(robot.model, start, rng.uniform(-0.5, 0.5, robot.nv))) for _ in range(count)]


def self_test(objective: WorstCaseObjective, real: Real = DOUBLE) -> dict[str, Any]:
    """Return reference values for one posture and normal, computed with CasADi: ``q, n, H, grad, objective, …``.

    Posture and normal are rounded to the number type of the export.

    Raises:
        MetricError: The objective does not exist at this posture.
    """
    q, n = real.rounded(sample_postures(objective.robot, 1, 0)[0]), real.rounded(_NORMAL)
    values = casadi_reference(objective)(q, n)
    if not all(np.isfinite(value).all() for value in values.values()):
        what = f"objective '{objective.name}' is not finite at a random posture of {objective.robot.name}"
        raise MetricError(what, where="codegen", hint="choose another objective or frame")
    inputs = {"q": q} if objective.others else {"q": q, "n": n}
    return {
        name: float(value[0]) if name in _SCALARS else value.tolist() for name, value in (inputs | values).items()
    }


# C function → names of its results among the quantities of a reference.
RESULTS = {
    "eval": ("H", "grad"),
    "objective": ("objective", "objective_grad"),
    "value": ("H",),
    "jump": ("jump", "G", "V"),
    "ellipsoid": ("ellipsoid",),
}


def self_test_tolerance(objective: WorstCaseObjective, real: Real) -> float:
    """Return the largest relative difference from CasADi that rounding errors can cause.

    The C code rounds differently: it multiplies by reciprocals, and a compiler may use fused multiply-adds.  In
    float, ill-conditioned models amplify the rounding errors.
    """
    if real.name == "double":
        return 1e-9 * (heavy_feet_rounding(objective.robot, objective.compliance) if objective.supports else 1.0)
    return 0.05 if objective.supports else 2e-3
