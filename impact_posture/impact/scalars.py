"""The numbers of an impact that have a name each, and the objective made of them, where they exist."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from impact_posture.errors import MetricError
from impact_posture.impact.objective import ImpactObjective
from impact_posture.impact.oracle import ImpactQuantities
from impact_posture.impact.single_impact import SingleImpact

Vector = NDArray[np.float64]

# Below this share of the largest mobility the contact counts as blocked along n, and JM⁻¹Jᵀ as singular.
_BLOCKED = 1e-12
_SINGULAR = 1e-9


@dataclass(frozen=True)
class Scalars:
    """The five numbers of an impact; ``None`` where one does not exist.

    Attributes:
        H: Squared jump per squared impulse.
        G: Inverse effective mass along the normal, 1/kg.
        V: Squared jump per squared approach speed, frictionless, e = 0.
        S: The same when the contact point sticks.
        E: Energy dissipated per squared approach speed, e = 0: half the effective mass, kg.
    """

    H: float
    G: float
    V: float | None
    S: float | None
    E: float | None

    @staticmethod
    def of(found: ImpactQuantities) -> Scalars:
        """Read them off; ``V`` and ``E`` do not exist where the contact cannot move along the normal."""
        if _blocked(found):
            return Scalars(found.H, found.G, None, found.S, None)
        return Scalars(found.H, found.G, found.V, found.S, found.E)

    @property
    def effective_mass(self) -> float | None:
        """``1/G``, kg; ``None`` where unbounded."""
        return None if self.E is None else 1 / self.G

    def to_dict(self) -> dict[str, float | None]:
        """JSON content."""
        return {"H": self.H, "G": self.G, "V": self.V, "S": self.S, "E": self.E}


@dataclass(frozen=True)
class VariantValue:
    """What an impact means should the robot be another than it was modeled.

    Attributes:
        name: The variant's.
        objective: The objective there; ``None`` where it does not exist.
        scalars: H, G, V, S, E of the leading contact there.
    """

    name: str
    objective: float | None
    scalars: Scalars

    def to_dict(self) -> dict[str, object]:
        """JSON content."""
        return {"name": self.name, "objective": self.objective, **self.scalars.to_dict()}


def _blocked(found: ImpactQuantities) -> bool:
    return found.G <= _BLOCKED * float(np.linalg.eigvalsh(found.mobility)[-1])


def variant_values(objective: ImpactObjective, q: Vector) -> tuple[VariantValue, ...]:
    """The objective and its parts in each variant."""
    pairs = zip(objective.model_variants, objective.by_variant, strict=True) if objective.model_variants else ()
    return tuple(
        VariantValue(variant.name, objective_value(member, q), Scalars.of(member.oracle.quantities(q)))
        for variant, member in pairs
    )


def worst_member(objective: ImpactObjective, model_variants: tuple[VariantValue, ...]) -> ImpactObjective:
    """The objective in the worst of its model_variants as evaluated, one where it does not exist before all others."""
    if not model_variants:
        return objective
    values = [np.inf if variant.objective is None else variant.objective for variant in model_variants]
    return objective.by_variant[int(np.argmax(values))]


def objective_value(objective: ImpactObjective, q: Vector) -> float | None:
    """The objective; ``None`` where it does not exist: in any of its model_variants, of any normal of its cone."""
    if objective.model_variants:
        values = [objective_value(member, q) for member in objective.by_variant]
        return None if None in values else max(v for v in values if v is not None)
    if isinstance(objective.worst_case, SingleImpact):
        scalars = Scalars.of(objective.oracle.quantities(q))
        alone: float | None = getattr(scalars, objective.impact_kind.symbol)
        return None if alone is None else objective.scale * alone
    try:
        value = objective.value(q)
    except MetricError:
        return None
    return value if np.isfinite(value) else None


def objective_gradient(objective: ImpactObjective, q: Vector, value: float | None) -> Vector | None:
    """Tangent gradient, shape (nv,), where the objective has ``value``; a subgradient where tied.

    ``None`` where it does not exist.
    """
    values = np.linalg.eigvalsh(objective.oracle.quantities(q).mobility)
    singular = objective.kind == "sticking" and values[0] <= _SINGULAR * values[-1]
    return None if singular or value is None else objective.gradient(q)
