"""What a library has functions for: each objective, and the free robot beside one that stands."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from impact_posture.codegen.naming import stems
from impact_posture.impact.objective import ImpactObjective


@dataclass(frozen=True)
class Variant:
    """An objective under its C name.

    Attributes:
        objective: What is computed.
        stem: What the C names begin with.
        free: Whether it is the free robot beside the one that stands.
    """

    objective: ImpactObjective
    stem: str
    free: bool = False


def variants(objectives: Sequence[ImpactObjective], prefix: str) -> tuple[Variant, ...]:
    """Each objective, followed by ``<stem>_free`` without the supports where it has some."""
    found: list[Variant] = []
    for objective, stem in zip(objectives, stems(prefix, [o.contact.frame for o in objectives]), strict=True):
        found.append(Variant(objective, stem))
        if objective.supports:
            found.append(Variant(replace(objective, supports=()), f"{stem}_free", free=True))
    return tuple(found)
