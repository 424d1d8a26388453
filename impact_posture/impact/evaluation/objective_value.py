"""Value and gradient of an objective, or ``None`` if they do not exist, and the value for each model variant."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from impact_posture.errors import MetricError
from impact_posture.impact.kinds.coulomb_kind import CoulombKind
from impact_posture.impact.kinds.impact_kind import ImpactKind
from impact_posture.impact.quantities.impact_quantities import Scalars
from impact_posture.impact.quantities.sticking_point import SINGULAR
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.system.arrays import Array


@dataclass(frozen=True)
class VariantValue:
    """Quantities of the impact for one model variant.

    Attributes:
        objective: Objective for this variant; ``None`` if it does not exist at the posture.
        scalars: H, G, V, S, E of the first contact for this variant.
    """

    name: str
    objective: float | None
    scalars: Scalars

    def to_dict(self) -> dict[str, object]:
        """Return JSON content."""
        return {"name": self.name, "objective": self.objective, **self.scalars.to_dict()}


def variant_values(objective: WorstCaseObjective, q: Array) -> tuple[VariantValue, ...]:
    """Return the objective and the scalars H, G, V, S, E for each model variant; empty if there are no variants."""
    pairs = zip(objective.model_variants, objective.by_variant, strict=True) if objective.model_variants else ()
    return tuple(
        VariantValue(variant.name, objective_value(member, q), Scalars.of(member.oracle.quantities(q)))
        for variant, member in pairs
    )


def worst_variant(variants: tuple[VariantValue, ...]) -> int:
    """Return the index of the worst model variant.  A variant whose objective is ``None`` is the worst."""
    return int(np.argmax([np.inf if variant.objective is None else variant.objective for variant in variants]))


def objective_value(objective: WorstCaseObjective, q: Array) -> float | None:
    """Return the objective; ``None`` if it does not exist for a model variant or a normal of the cone."""
    if objective.model_variants:
        values = [objective_value(member, q) for member in objective.by_variant]
        return None if None in values else max(v for v in values if v is not None)
    if isinstance(objective.worst_case, ImpactKind) and not isinstance(objective.worst_case, CoulombKind):
        scalars = Scalars.of(objective.oracle.quantities(q))
        alone: float | None = getattr(scalars, objective.impact_kind.symbol)
        return None if alone is None else objective.scale * alone
    try:
        value = objective.value(q)
    except MetricError:
        return None
    return value if np.isfinite(value) else None


def objective_gradient(objective: WorstCaseObjective, q: Array, value: float | None) -> Array | None:
    """Return the tangent gradient of the objective, shape (nv,); ``None`` if it does not exist at ``q``.

    If several normals, impulses or models attain the maximum, the result is a subgradient.  ``value`` is the
    objective at ``q`` from :func:`objective_value`.
    """
    values = np.linalg.eigvalsh(objective.oracle.quantities(q).mobility)
    singular = objective.kind == "sticking" and values[0] <= SINGULAR * values[-1]
    return None if singular or value is None else objective.gradient(q)
