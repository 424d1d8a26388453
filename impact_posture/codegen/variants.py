"""What a library has functions for: each contact, the free robot beside one that stands, all contacts together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from impact_posture.codegen.naming import stems
from impact_posture.errors import InputError
from impact_posture.impact.objective import ImpactObjective


@dataclass(frozen=True)
class Variant:
    """An objective under its C name.

    Attributes:
        objective: What is computed.
        stem: What the C names begin with.
        free: Whether it is the free robot beside the one that stands.
        joint: Whether it is of several contacts at once: only the objective, no ``H`` of its own.
    """

    objective: ImpactObjective
    stem: str
    free: bool = False
    joint: bool = False


def variants(objectives: Sequence[ImpactObjective], prefix: str) -> tuple[Variant, ...]:
    """Each contact's objective, followed by ``<stem>_free`` without the supports where it has some.

    Several contacts at once have these each, and ``<prefix>_objective`` last.

    Raises:
        InputError: Several frames of which one is a problem with several contacts.
    """
    several = [objective for objective in objectives if objective.others]
    if several and len(objectives) > 1:
        raise InputError(
            "is one problem of several contacts beside others", where="codegen", hint="export them one by one"
        )
    # One frame that is struck along two normals has one H of any normal.
    singles: dict[str, ImpactObjective] = {}
    for single in (single for objective in several for single in objective.singles):
        singles.setdefault(single.contact.frame, single)
    each = [*singles.values()] if several else [*objectives]
    found: list[Variant] = []
    frames = [o.contact.frame for o in each]
    names = stems(prefix, frames) if len(frames) > 1 or not several else (f"{prefix}_contact",)
    for objective, stem in zip(each, names, strict=True):
        found.append(Variant(objective, stem))
        if objective.supports:
            found.append(Variant(replace(objective, supports=()), f"{stem}_free", free=True))
    return (*found, *[Variant(objective, prefix, joint=True) for objective in several])
