"""Tables and lines that describe an impact and its worst cases, for several commands."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from impact_posture_cli.output import Page, number, vector, worst_normal

if TYPE_CHECKING:
    from impact_posture.impact.impact_contact import ImpactContact
    from impact_posture.impact.resolved_impact import ResolvedImpact


def contact_names(contacts: Sequence[ImpactContact]) -> list[str]:
    """Return a name for each contact: its frame, with its normal if several contacts have the same frame."""
    frames = [contact.frame for contact in contacts]
    return [
        f"{c.frame} ({', '.join(f'{v:.3g}' for v in c.normal)})" if frames.count(c.frame) > 1 else c.frame
        for c in contacts
    ]


def impact_rows(impact: ResolvedImpact, normals: Sequence[Iterable[Any]], axes: str) -> list[tuple[str, str]]:
    """Return rows that describe an impact: normals, contact point, supports, metric, armature, joint model.

    ``axes`` names the frame of the ``normals``, one per contact.
    """
    objective, contact, metric = impact.objective, impact.contact, impact.metric
    rows = []
    for name, struck, normal in zip(contact_names(objective.contacts), objective.contacts, normals, strict=True):
        bounded = objective.others and objective.impact_kind.adds_up
        limit = f", up to {struck.impulse:g} N·s" if bounded else ""
        rows.append((f"normal at {name}" if objective.others else "normal", f"{vector(normal)} ({axes}){limit}"))
    if any(contact.offset):
        offset = ", ".join(f"{v:g}" for v in contact.offset)
        rows.append(("contact point", f"{offset} m from {contact.frame}, in its axes"))
    if impact.contact_stiffness is not None:
        rows.append(("contact", impact.contact_stiffness.words))
    feet = ", ".join(f"{s.frame} ({s.kind})" for s in impact.supports)
    rows.append(("supports", f"{feet}; compliance {objective.compliance:.3g} 1/kg" if feet else "none"))
    rows.append(("metric", f"{metric.kind} ({metric.source})" if metric.source else metric.kind))
    from impact_posture.robot.joint_model import describe_joints

    rows.append(("armature from", impact.robot.armature_source))
    return [*rows, ("joint model", describe_joints(impact.robot))]


def worst_tables(page: Page, frames: Sequence[str], blocks: Mapping[str, Mapping[str, Any]]) -> None:
    """Print the quantities of each contact alone, and the objective of each model variant.

    ``blocks`` maps a name to an evaluation as in ``result.json``.  The contacts are taken from the last evaluation.
    """
    last = list(blocks.values())[-1]
    if "by_contact" in last:
        keys = ("H", "G", "V", "S")
        pairs = zip(frames, last["by_contact"], strict=True)
        rows = [(f"  {frame}", *(number(block[key]) for key in keys)) for frame, block in pairs]
        page.gap()
        page.table(("  each contact alone", *keys), rows, right=(1, 2, 3, 4))
    if "by_scenario" in last:
        rows = []
        for k, variant in enumerate(last["by_scenario"]):
            marks = [" ←" if block["worst_scenario"] == variant["name"] else "  " for block in blocks.values()]
            values = [number(block["by_scenario"][k]["objective"]) for block in blocks.values()]
            rows.append((f"  {variant['name']}", *map("".join, zip(values, marks, strict=True))))
        page.gap()
        page.table(("  objective by model variant (← worst)", *blocks), rows, right=tuple(range(1, 1 + len(blocks))))


def worst_lines(page: Page, frames: Sequence[str], blocks: Mapping[str, Mapping[str, Any]]) -> None:
    """Print worst normal, worst impulses, and whether the feet stay in place, for each evaluation in ``blocks``."""
    named = {f" {name}" if len(blocks) > 1 else "": block for name, block in blocks.items()}
    for when, block in named.items():
        if "cone" in block:
            page.line(f"worst normal{when}: {worst_normal(block['cone'], block['worst_normal'])}")
        if "worst_impulses" in block:
            page.line(f"worst impulses{when}: {_impulses(frames, block['worst_impulses'])}")
    for when, block in named.items():
        for name, part in zip(frames, block.get("by_contact", [block]), strict=True):
            if "footing" in part:
                where = f" (impact at {name})" if "by_contact" in block else ""
                lifting, footing = part.get("lifting_feet"), part["footing"]
                line = lifting["line"] if lifting and not footing["stays"] else footing["verdict"]
                page.line(f"feet{when}{where}: {line}")


def _impulses(frames: Sequence[str], worst: Mapping[str, Any]) -> str:
    parts = [f"{value:g} N·s at {frame}" for frame, value in zip(frames, worst["impulses"], strict=True) if value]
    tied = len(worst["corners"]) - 1
    others = f" ({tied} other {'corner is' if tied == 1 else 'corners are'} as bad)" if tied else ""
    return ", ".join(parts) + others


def alone_line(page: Page, frames: Sequence[str], what: str) -> None:
    """If there are several contacts, print the contact to which the shown numbers belong."""
    if len(frames) > 1:
        page.line(f"  ({what}: of an impact at {frames[0]} alone)", style="dim")
