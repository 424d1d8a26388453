"""What the inner maximum was over: lines on several contacts and on model variants, alike for every command."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from impact_posture.impact.contact import ImpactContact
    from impact_posture_cli.output import Page


def contact_names(contacts: Sequence[ImpactContact]) -> list[str]:
    """What each of several contacts is called: its frame, and its normal where one frame is struck along two."""
    frames = [contact.frame for contact in contacts]
    return [
        f"{c.frame} ({', '.join(f'{v:.3g}' for v in c.normal)})" if frames.count(c.frame) > 1 else c.frame
        for c in contacts
    ]


def impulses_line(frames: Sequence[str], worst: Mapping[str, Any]) -> str:
    """The worst impulses of several contacts in words."""
    parts = [f"{value:g} N·s at {frame}" for frame, value in zip(frames, worst["impulses"], strict=True) if value]
    tied = len(worst["corners"]) - 1
    others = f" ({tied} other {'corner is' if tied == 1 else 'corners are'} as bad)" if tied else ""
    return ", ".join(parts) + others


def alone_line(page: Page, frames: Sequence[str]) -> None:
    """Whose the numbers of one contact are, where there are several."""
    page.line(f"  (H, G, V, S, E, ellipsoid, gradient and jumps: of an impact at {frames[0]} alone)", style="dim")


def contacts_table(page: Page, frames: Sequence[str], blocks: Sequence[Mapping[str, Any]]) -> None:
    """H, G, V, S of each of several contacts, as if it were alone."""
    from impact_posture_cli.output import number

    rows = [
        (f"  {frame}", *(number(block[key]) for key in ("H", "G", "V", "S")))
        for frame, block in zip(frames, blocks, strict=True)
    ]
    page.gap()
    page.table(("  each contact alone", "H", "G", "V", "S"), rows, right=(1, 2, 3, 4))


def variants_table(page: Page, blocks: Sequence[Mapping[str, Any]], titles: Sequence[str]) -> None:
    """The objective for each model variant, with one column for each evaluation."""
    from impact_posture_cli.output import number

    rows = []
    for k, variant in enumerate(blocks[0]["by_scenario"]):
        worst = [block["worst_scenario"] == variant["name"] for block in blocks]
        values = [number(block["by_scenario"][k]["objective"]) + (" ←" if bad else "  ")
                  for block, bad in zip(blocks, worst, strict=True)]  # fmt: skip
        rows.append((f"  {variant['name']}", *values))
    page.gap()
    page.table(("  objective by model variant (← worst)", *titles), rows, right=tuple(range(1, 1 + len(titles))))
