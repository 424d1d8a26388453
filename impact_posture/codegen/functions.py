"""The CasADi functions that an export is made of, all of them of an objective's configuration and normal."""

from __future__ import annotations

import casadi as ca

from impact_posture.impact.objective import ImpactObjective


def jump_fun(objective: ImpactObjective) -> ca.Function:
    """``(q, n) → a, G, H``: ``a = M⁻¹Jᵀn`` (nv), ``G = nᵀJa`` and ``H = aᵀWa``."""
    k = objective.kernel
    names = (["q", "n"], ["a", "G", "H"])
    return ca.Function("jump", [k.q, k.n], [k.jump.a, k.G, k.H], *names, {"cse": True})


def ellipsoid_fun(objective: ImpactObjective) -> ca.Function:
    """``q → Λ_c``, shape (3, 3), world axes."""
    k = objective.kernel
    return ca.Function("ellipsoid", [k.q], [k.ellipsoid], ["q"], ["L"], {"cse": True})


def objective_fun(objective: ImpactObjective) -> ca.Function:
    """``q → value, grad`` of the objective at its own normal."""
    q, _ = (general := objective.gradient_fun()).sx_in()
    fixed = general.call([q, ca.DM(objective.contact.normal)])
    return ca.Function("objective", [q], fixed, ["q"], ["value", "grad"], {"cse": True})
