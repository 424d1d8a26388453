"""The study's numbers as Markdown tables."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from impact_posture.errors import ImpactPostureError
from tests.benchmarks.impact.study import OBJECTIVES, SLID, Case, Choice, Outcome, Row, needed_friction
from tests.benchmarks.impact.surface import Surface

Vector = NDArray[np.float64]


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table."""
    lines = ["| " + " | ".join(line) + " |" for line in (head, *rows)]
    return "\n".join([lines[0], "|" + "---|" * len(head), *lines[1:], ""])


def rank_table(rows: Sequence[Row]) -> str:
    """Which objective orders the measured jumps?"""
    head = ["robot", "friction", "postures", "slid", "e", "size of the jumps", "√H", "√V", "√S", "√E"]
    head += ["jump per impulse with √H", "loss with E"]
    return table(head, [_rank_row(row) for row in rows])


def _rank_row(row: Row) -> list[str]:
    sizes = row.measured("size")
    restitution = row.measured("restitution")
    cells = [row.case.robot, friction_word(row.surface), str(len(row.outcomes)), str(row.slid)]
    cells += [_range(restitution), f"{sizes.min():.3g}–{sizes.max():.3g}"]
    cells += [f"{row.rank(objective):.3f}" for objective in OBJECTIVES]
    return [*cells, f"{row.rank('impulse', _per_impulse):.3f}", f"{row.rank('energy', _loss):.3f}"]


def _per_impulse(outcome: Outcome) -> float:
    return outcome.per_impulse


def _loss(outcome: Outcome) -> float:
    return outcome.measured.loss


def ratio_table(rows: Sequence[Row]) -> str:
    """How far is each objective's prediction from what happened?"""
    head = ["robot", "friction", "jump: λ√H", "jump: (1+e)v√V", "jump: (1+e)v√S", "loss: (1−e²)v²E"]
    body = [
        [row.case.robot, friction_word(row.surface), *(_ratio(row.ratios(o)) for o in OBJECTIVES)] for row in rows
    ]
    return table(head, body)


def cone_table(rows: Sequence[Row]) -> str:
    """Does the sticking impulse's own angle say which postures stick?"""
    head = ["robot", "friction", "should stick", "of these slid", "jump: (1+e)v√S", "largest error of Δν"]
    head += ["should slide", "of these slid", "jump: (1+e)v√S"]
    body = []
    for row in rows:
        held = row.held
        rest = replace(row, outcomes=tuple(o for o in row.outcomes if o not in held.outcomes))
        cells = [row.case.robot, friction_word(row.surface)]
        for part in (held, rest):
            cells += [str(len(part.outcomes)), str(part.slid), _ratio(part.ratios("sticking"))]
            if part is held:
                cells.append(f"{max((o.deviation('sticking') for o in held.outcomes), default=np.nan):.1%}")
        body.append(cells)
    return table(head, body)


def convex_line(rows: Sequence[Row], convex: Sequence[Row]) -> str:
    """What MuJoCo's own friction makes of the same postures."""
    largest = [max(row.measured("restitution").max() for row in some) for some in (rows, convex)]
    return (
        f"Under Coulomb's law no posture rebounds with more than e = {largest[0]:.2f} at "
        f"{friction_word(rows[0].surface)}; under MuJoCo's own convex friction sliding lifts the contact, up to "
        f"e = {largest[1]:.2f}."
    )


def variation_table(found: Sequence[tuple[str, Sequence[Row], Sequence[Row]]]) -> str:
    """Speed, restitution, stiffness: all robots in one row, without friction and sticking."""
    head = ["impact", "lasts, ms", "e", "no friction: rank of √V", "measured/predicted", "sticks: rank of √S"]
    head += ["measured/predicted", "slid", "left out"]
    body = []
    for words, smooth, sticky in found:
        both = [*smooth, *sticky]
        lasts = np.concatenate([row.measured("duration") for row in both]) * 1e3
        restitution = np.concatenate([row.measured("restitution") for row in both])
        cells = [words, f"{np.median(lasts):.2g}", _range(restitution)]
        for rows, objective in ((smooth, "speed"), (sticky, "sticking")):
            cells.append(f"≥ {min(row.rank(objective) for row in rows):.3f}")
            cells.append(_ratio(np.concatenate([row.ratios(objective) for row in rows])))
        body.append([*cells, str(sum(row.slid for row in sticky)), str(sum(sum(r.left_out.values()) for r in both))])
    return table(head, body)


def choice_table(found: Sequence[tuple[Case, Sequence[Choice]]]) -> str:
    """What each objective picks, and what happens there."""
    frictions = list(found[0][1][0].measured)
    head = ["robot", "picked by", "H", "1/G, kg", "V", "S", "μ to stick"]
    head += [f"jump, {friction_word(Surface(mu))}" for mu in frictions]
    words = [friction_word(Surface(mu)) for mu in (frictions[0], frictions[-1])]
    head += [f"{what}, {word}" for what in ("impulse in N·s", "loss in J") for word in words]
    body = []
    for case, choices in found:
        for choice in choices:
            o = choice.predicted
            cells = [case.robot, f"`{choice.objective}`" if choice.objective in OBJECTIVES else choice.objective]
            cells += [f"{o.H:.3g}", f"{1 / o.G:.3g}", f"{o.V:.3g}", "undefined" if o.S is None else f"{o.S:.3g}"]
            cells.append(f"{needed_friction(o):.2f}")
            cells += ["–" if m is None else f"{m.size:.2f}" for m in choice.measured.values()]
            for name in ("impulse", "loss"):
                ends = (choice.measured[frictions[0]], choice.measured[frictions[-1]])
                cells += ["–" if m is None else f"{getattr(m, name):.2f}" for m in ends]
            body.append(cells)
    return table(head, body)


def left_out_lines(rows: Sequence[Row]) -> list[str]:
    """One line for each robot and surface with a posture that is not counted."""
    lines = []
    for row in rows:
        for reason, count in sorted(row.left_out.items()):
            lines.append(f"- {row.case.robot}, {friction_word(row.surface)}: {count} left out, {reason}")
    return lines or ["- none left out"]


def verdicts(rows: Sequence[Row]) -> list[str]:
    """The targets, met or missed: ``√V`` ≥ 0.98 without friction, ``√S`` ≥ 0.95 with it, jumps within 20 %."""
    lines = []
    for mu in dict.fromkeys(row.surface.friction for row in rows):
        some = [row for row in rows if row.surface.friction == mu]
        objective, least = ("sticking", 0.95) if mu else ("speed", 0.98)
        words = f"`{objective}`, {friction_word(Surface(mu))}"
        lines += [
            _verdict(f"{words}: rank ≥ {least}", [(r, r.rank(objective) >= least) for r in some]),
            _verdict(f"{words}: every jump within 20 %", [(r, _within(r.ratios(objective))) for r in some]),
        ]
        if mu in (0, np.inf):
            lines.append(_verdict(f"{words}: Δν itself within 1 %", [(r, _near(r, objective)) for r in some]))
    return lines


def _near(row: Row, objective: str) -> bool:
    return max(outcome.deviation(objective) for outcome in row.outcomes) <= 0.01


def _within(ratios: Vector) -> bool:
    return bool(np.abs(ratios - 1).max() <= 0.2)


def _verdict(words: str, found: Sequence[tuple[Row, bool]]) -> str:
    missed = [row.case.robot for row, holds in found if not holds]
    return f"- {words}: " + (f"missed by {', '.join(missed)}" if missed else f"met by all {len(found)}")


def choice_failure(case: Case, error: ImpactPostureError) -> str:
    """A robot whose optima could not be found."""
    return f"- {case.robot}: no optima, {error}"


def friction_word(surface: Surface) -> str:
    """Friction in words."""
    if np.isinf(surface.friction):
        return "sticks"
    return f"μ = {surface.friction:g}" if surface.friction else "no friction"


def slid_words() -> str:
    """What "slid" counts."""
    return (
        f"*slid*: postures whose contact point leaves with a tangential speed above {SLID:.0%} of the approach speed"
    )


def _range(values: Vector) -> str:
    low, high = f"{values.min():.2f}", f"{values.max():.2f}"
    return low if low == high else f"{low}–{high}"


def _ratio(values: Vector) -> str:
    if not len(values):
        return "–"
    return f"{np.median(values):.3f} [{values.min():.3f}, {values.max():.3f}]"
