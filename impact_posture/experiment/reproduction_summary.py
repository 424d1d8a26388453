"""A reproduction in words and tables, as Markdown; every number comes out of the rows."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from impact_posture.escape import markdown
from impact_posture.experiment.paper import PAPER
from impact_posture.experiment.reproduction import Reproduction, targets_of
from impact_posture.experiment.statistics import Interval, Row
from impact_posture.simulation.controller_factory import MEANING

# Of numbers that are nearly zero.
_DECIMALS = 4
_MISSED = {
    "reduction": "less than the paper's reduction",
    "recovery": "less than the paper's reduction over the recovery",
    "peak_jump": "a higher peak jump than nominal",
    "peak_recovery": "a higher peak than nominal in the recovery",
    "saturation": "more saturation in the windows than nominal",
    "stops": "a joint on its stop",
    "rested": "not at rest before the push",
}
# What a table's columns mean, below every one of them.
LEGEND = (
    "Recovery: the same integral and peak until 1 s after each impact began. Relaxed ticks: limits made a task give "
    "way. Status: `completed`, or how many runs did; there is no reduction where a run did not."
)


def table_one(found: Reproduction) -> str:
    """The paper's Table I beside ours: ``q_total_impact`` of nominal, robust and the best controller."""
    lines = [
        "| scenario | paper: nominal | robust | reduction | ours: nominal | robust | reduction | best | reduction |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for scenario in found.scenarios:
        paper, rows = PAPER.get(scenario), {row.controller: row for row in found.of(scenario)}
        printed = ["–"] * 3
        if paper is not None:
            printed = [f"{paper.nominal:g}", f"{paper.robust:g}", f"{100 * paper.reduction:.1f} %"]
        nominal, robust, best = rows.get("nominal"), rows.get("robust"), found.best(scenario)
        ours = [
            _q(nominal), _q(robust), reduction_text(robust), "–" if best is None else best.controller,
            reduction_text(best),
        ]  # fmt: skip
        lines.append("| " + " | ".join([markdown(scenario), *printed, *ours]) + " |")
    return "\n".join(lines)


def scenario_table(rows: Sequence[Row]) -> str:
    """Every controller of a scenario."""
    lines = [
        "| controller | status | q_total_impact | reduction | over the recovery | peak jump | in the recovery | "
        "peak force, N | saturated inside, s | outside, s | relaxed ticks | H before | measured / predicted jump | "
        "targets |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        if not row.metrics:
            lines.append(f"| {row.controller} | {markdown(status_text(row))} |" + " |" * 12)
            continue
        cells = [
            row.controller,
            status_text(row),
            interval_text(row.metrics["q_total_impact"]),
            reduction_text(row),
            percent(row.recovery) if row.controller != "nominal" else "–",
            interval_text(row.metrics["peak_jump"]),
            interval_text(row.metrics["peak_recovery"]),
            interval_text(row.metrics["peak_force"], 3),
            interval_text(row.metrics["saturation_inside"], 2),
            interval_text(row.metrics["saturation_outside"], 2),
            interval_text(row.metrics["relaxed_ticks"], 2),
            "–" if row.H is None else f"{row.H:.3g}",
            "–" if row.ratio is None else f"{row.ratio:.2f}",
            targets_text(row),
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def summary(found: Reproduction) -> str:
    """The whole document."""
    many = f"{found.seeds} seeds" if found.seeds > 1 else "one seed"
    shown = ", with 95 % confidence intervals." if found.seeds > 2 else ": no intervals."
    parts = [
        "# The paper's experiments, simulated anew",
        f"Means over {many}{shown}",
        "## What to choose",
        "\n".join(f"- {line}" for line in advice(found)),
        "## Table I of Afifi et al. 2026, and ours",
        table_one(found),
        "The paper's robots, gains, contact models and windows are others than here, and it prints few of them: "
        "compare reductions, not values. `q_total_impact` is the integral of ‖ν‖ over fixed windows, the same for "
        "every controller; contacts are summed, pushes are the mean of both signs.",
        LEGEND,
    ]
    for scenario in found.scenarios:
        parts += [f"## {markdown(scenario)}", scenario_table(found.of(scenario)), "\n".join(remarks(found, scenario))]
    return "\n\n".join(parts) + "\n"


def advice(found: Reproduction, beside: Reproduction | None = None) -> list[str]:
    """One line a scenario: which controller, what it gives, what it costs.

    Args:
        found: The rows that count.
        beside: Rows of more controllers, where the held variant of the best one is looked for.
    """
    lines = []
    for scenario in found.scenarios:
        best, robust = found.best(scenario), next((r for r in found.of(scenario) if r.controller == "robust"), None)
        if best is None or best.reduction is None:
            lines.append(f"**{markdown(scenario)}**: nothing was better than nominal.")
            continue
        targets = targets_of(best)
        met = targets is not None and targets.met
        line = (
            f"**{markdown(scenario)}**: `{best.controller}` ({MEANING[best.controller.partition(':')[0]]}) moves "
            f"{reduction_text(best)} less than nominal, over the recovery {percent(best.recovery)}"
        )
        line += ", every target met." if met or targets is None else f", but with {_misses(targets.missed)}."
        line += _force(best, found.of(scenario)) + _held((beside or found).of(scenario), best)
        if robust is not None and robust is not best and robust.reduction is not None:
            line += f" The paper's term: {reduction_text(robust)}"
            missed = targets_of(robust)
            line += "." if missed is None or missed.met else f", with {_misses(missed.missed)}."
        lines.append(line)
    return lines


def _force(best: Row, rows: Sequence[Row]) -> str:
    """What the contact has to bear for it."""
    nominal = next((row for row in rows if row.controller == "nominal"), None)
    if nominal is None:
        return ""
    before, after = (row.metrics["peak_force"].mean for row in (nominal, best))
    return f" The contact bears up to {after:.0f} N instead of {before:.0f} N." if after > 1.1 * before else ""


def _held(rows: Sequence[Row], best: Row) -> str:
    """Whether a live term's gain is its posture."""
    held = next((row for row in rows if row.controller == f"{best.controller}:held"), None)
    if held is None or held.reduction is None or best.reduction is None:
        return ""
    if held.reduction.mean > best.reduction.mean / 2:
        return ""
    return (
        f" Not its posture does it: held before the impact, that gives {reduction_text(held)}; a stiffer nominal "
        "controller is the simpler way."
    )


def remarks(found: Reproduction, scenario: str) -> list[str]:
    """What a reader of a scenario's table must know."""
    rows = {row.controller: row for row in found.of(scenario)}
    lines = []
    live, stiff = rows.get("robust"), rows.get("stiff")
    for name in ("robust", "walker"):
        held, whole = rows.get(f"{name}:held"), rows.get(name)
        if held is None or whole is None or held.reduction is None or whole.reduction is None:
            continue
        share = held.reduction.mean / whole.reduction.mean if whole.reduction.mean > 0 else float("nan")
        lines.append(
            f"`{name}`: with the reached posture held before the impact {reduction_text(held)} remain of "
            f"{reduction_text(whole)}: "
            + ("most of it is posture." if share > 0.5 else "most of it is the term's stiffness, not the posture.")
        )
    if stiff is not None and live is not None and stiff.reduction is not None and live.reduction is not None:
        more = "more" if stiff.reduction.mean > live.reduction.mean else "less"
        lines.append(
            f"A nominal controller as stiff as the term, `stiff`, gives {reduction_text(stiff)}, {more} than it."
        )
    for row in rows.values():
        if not row.rested:
            lines.append(f"`{row.controller}` does not come to rest: its own motion is in what is measured.")
        if row.stops:
            lines.append(f"`{row.controller}` reaches the stops of {markdown(', '.join(row.stops))}.")
        if row.failed:
            lines.append(f"`{row.controller}`: {markdown('; '.join(row.failed))}.")
    return lines


def interval_text(value: Interval, digits: int = 3) -> str:
    """``mean ± half width``, the mean with so many digits and the half width with its decimals.

    From fewer than three samples no half width is shown: it would say more of Student's t than of them.
    """
    decimals = max(0, digits - 1 - int(np.floor(np.log10(abs(value.mean))))) if value.mean else 0
    decimals = min(decimals, _DECIMALS)
    text = f"{value.mean:.{decimals}f}"
    return text if value.half_width is None or value.samples < 3 else f"{text} ± {value.half_width:.{decimals}f}"


def reduction_text(row: Row | None) -> str:
    """A reduction in percent."""
    return percent(None if row is None or row.controller == "nominal" else row.reduction)


def percent(value: Interval | None, unit: str = " %") -> str:
    """A share in percent."""
    if value is None:
        return "–"
    half = value.half_width if value.samples > 2 else None
    # Adding zero turns -0.0 into 0.0.
    return f"{round(100 * value.mean, 1) + 0.0:.1f}" + ("" if half is None else f" ± {100 * half:.1f}") + unit


def status_text(row: Row) -> str:
    """``completed``, or the gravest status and how many runs completed."""
    return row.status if row.completed == row.runs else f"{row.status}, {row.completed} of {row.runs} completed"


def targets_text(row: Row) -> str:
    """Whether the targets are met, and which are not."""
    targets = targets_of(row)
    if targets is None:
        return ""
    return "met" if targets.met else "missed: " + ", ".join(targets.missed)


def _misses(names: Sequence[str]) -> str:
    return ", ".join(_MISSED[name] for name in names)


def _q(row: Row | None) -> str:
    return "–" if row is None or not row.metrics else interval_text(row.metrics["q_total_impact"])
