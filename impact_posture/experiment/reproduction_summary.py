"""Sentences and Markdown tables that summarize a reproduction."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from impact_posture.experiment.reproduction import FITTED, PAPER, Reproduction, missed_targets
from impact_posture.experiment.seed_statistics import ControllerRow, Interval, statistic
from impact_posture.simulation.controllers.controller_factory import MEANING
from impact_posture.simulation.metrics import UNTIL_RECOVERY
from impact_posture.system.escape import markdown

# Maximum number of decimals, so that numbers near zero stay short.
_DECIMALS = 4
# Metric in the table of a scenario → number of its significant digits.
_COLUMNS = {
    "peak_jump": 3, "peak_recovery": 3, "saturation_inside": 2, "saturation_outside": 2, "relaxed_ticks": 2,
    "peak_force": 3,
}  # fmt: skip
LEGEND = (
    f"The recovery columns show the same integral and peak {UNTIL_RECOVERY}. In a relaxed tick, limits made a task "
    "give way. The status is `completed`, or how many runs completed. The reduction is left out if a run did not "
    "complete."
)


def table_one(results: Reproduction) -> str:
    """Return a Markdown table of ``q_total_impact``, with one row per scenario.

    A row contains the values of the paper (nominal, robust) and of this package (nominal, robust, best controller).
    """
    head = "scenario|paper: nominal|robust|reduction|ours: nominal|robust|reduction|best|reduction"
    lines = []
    for scenario in results.scenarios:
        paper, best = PAPER.get(scenario), results.best(scenario)
        nominal, robust = results.row(scenario, "nominal"), results.row(scenario, "robust")
        printed = ["–"] * 3
        if paper is not None:
            printed = [f"{paper.nominal:g}", f"{paper.robust:g}", f"{100 * paper.reduction:.1f} %"]
        name = "–" if best is None else best.controller
        ours = [_total(nominal), _total(robust), reduction_text(robust), name, reduction_text(best)]
        lines.append([markdown(scenario), *printed, *ours])
    return _table(head, lines)


def fitted(results: Reproduction) -> str:
    """Return a Markdown list: what was fitted in each scenario, and our nominal value relative to the paper."""
    lines = []
    for scenario in results.scenarios:
        paper, nominal = PAPER.get(scenario), results.row(scenario, "nominal")
        if paper is not None and nominal is not None and nominal.metrics:
            share = nominal.metrics["q_total_impact"].mean / paper.nominal
            words = f"our nominal value is {share:.2g} times the paper's; {FITTED[scenario]}"
            lines.append(f"- {markdown(scenario)}: {words}.")
    return "\n".join(lines)


def scenario_table(rows: Sequence[ControllerRow]) -> str:
    """Return a Markdown table with one row per controller of a scenario."""
    head = (
        "controller|status|q_total_impact|reduction|over the recovery|peak jump|in the recovery|saturated inside, s|"
        "outside, s|relaxed ticks|peak force, N|over nominal's|normal impulse, N·s|base, m/s|base, rad/s|worst joint|"
        "H before|measured / predicted jump|targets"
    )
    lines = []
    for row in rows:
        whole = row.completed == row.runs
        status = row.status if whole else f"{row.status}, {row.completed} of {row.runs} completed"
        cells = [row.controller, markdown(status)]
        if row.metrics:
            cells += [
                _total(row),
                reduction_text(row),
                percent(row.recovery) if row.controller != "nominal" else "–",
                *(interval_text(row.metrics[name], digits) for name, digits in _COLUMNS.items()),
                "–" if row.force is None else f"{row.force.mean:.2f}",
                *(_known(row, name) for name in ("impulse", "base_linear", "base_angular")),
                markdown(joint_text(row)),
                "–" if row.H is None else f"{row.H:.3g}",
                "–" if row.ratio is None else f"{row.ratio:.2f}",
                targets_text(row),
            ]
        lines.append(cells)
    return _table(head, lines)


def _table(head: str, rows: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table.  Rows that are too short are filled with empty cells."""
    columns = head.split("|")
    lines = [f"| {' | '.join([*cells, *[''] * (len(columns) - len(cells))])} |" for cells in (columns, *rows)]
    return "\n".join([lines[0], "|---" * len(columns) + "|", *lines[1:]])


def summary(results: Reproduction) -> str:
    """Return the content of ``SUMMARY.md``."""
    parts = [
        "# The experiments of the paper, simulated again",
        f"Numbers: {statistic(results.seeds, [])}.",
        "## What to choose",
        "\n".join(f"- {line}" for line in advice(results)),
        "## Table I of Afifi et al. 2026, and ours",
        table_one(results),
        "Values that were fitted to the paper:",
        fitted(results),
        "The paper has other robots, gains, contact models and windows, and states few of these values. Compare "
        "reductions, not values. `q_total_impact` is the integral of ‖ν‖ over fixed windows, which are the same for "
        "every controller. The value is summed over contacts, or averaged over pushes with both signs.",
        "A seed above zero changes the start, the speed or force, and the friction (`[spread]` in the scenario), and "
        "the sensor noise. The intervals contain the effects of all these changes.",
        LEGEND,
    ]
    for scenario in results.scenarios:
        notes = "\n".join(remarks(results, scenario))
        parts += [f"## {markdown(scenario)}", scenario_table(results.of(scenario)), notes]
    return "\n\n".join(parts) + "\n"


def advice(results: Reproduction, others: Reproduction | None = None) -> list[str]:
    """Return one line for each scenario: the best controller in ``results``, its reduction and its disadvantages.

    If ``results`` does not contain the held variant of the best controller, ``others`` can contain it.
    """
    lines = []
    for scenario in results.scenarios:
        best, robust = results.best(scenario), results.row(scenario, "robust")
        if best is None or best.reduction is None:
            lines.append(f"**{markdown(scenario)}**: nothing was better than nominal.")
            continue
        missed = _missed(best)
        line = (
            f"**{markdown(scenario)}**: `{best.controller}` ({MEANING[best.controller.partition(':')[0]]}) moves "
            f"{reduction_text(best)} less than nominal ({percent(best.recovery)} less over the recovery)"
        )
        line += f", but with {missed}." if missed else " and meets every target."
        line += _force(best, results.row(scenario, "nominal"))
        line += _held(best, (others or results).row(scenario, f"{best.controller}:held"))
        if robust is not None and robust is not best and robust.reduction is not None:
            missed = _missed(robust)
            line += f" The paper's term: {reduction_text(robust)}" + (f", with {missed}." if missed else ".")
        lines.append(line)
    return lines


def _force(best: ControllerRow, nominal: ControllerRow | None) -> str:
    """Return a sentence about the contact force if it is more than 10 % larger than with the nominal controller."""
    if nominal is None:
        return ""
    before, after = (row.metrics["peak_force"].mean for row in (nominal, best))
    return f" The peak contact force is {after:.0f} N instead of {before:.0f} N." if after > 1.1 * before else ""


def _held(best: ControllerRow, held: ControllerRow | None) -> str:
    """Return a warning if ``held``, the effect of the posture alone, is at most half of the total reduction."""
    share = _share(held, best)
    if share is None or share > 0.5:
        return ""
    return (
        " The posture does not cause this reduction: with the posture held before the impact, the reduction is only "
        f"{reduction_text(held)}. "
        "A stiffer nominal controller is simpler."
    )


def _share(part: ControllerRow | None, whole: ControllerRow | None) -> float | None:
    """Return the reduction of ``part`` divided by the reduction of ``whole``.

    Return 0 if the reduction of ``whole`` is not positive, and ``None`` if a reduction is missing.
    """
    if part is None or whole is None or part.reduction is None or whole.reduction is None:
        return None
    return part.reduction.mean / whole.reduction.mean if whole.reduction.mean > 0 else 0.0


def remarks(results: Reproduction, scenario: str) -> list[str]:
    """Return sentences for the text below the table of a scenario."""
    lines = []
    for name in ("robust", "walker"):
        held, whole = results.row(scenario, f"{name}:held"), results.row(scenario, name)
        share = _share(held, whole)
        if share is not None:
            why = "the posture" if share > 0.5 else "the stiffness of the term, not from the posture"
            lines.append(
                f"`{name}`: if the reached posture is held before the impact, the reduction is "
                f"{reduction_text(held)} instead of {reduction_text(whole)}. Most of the reduction comes from {why}."
            )
    live, stiff = results.row(scenario, "robust"), results.row(scenario, "stiff")
    if stiff is not None and live is not None and stiff.reduction is not None and live.reduction is not None:
        more = "larger" if stiff.reduction.mean > live.reduction.mean else "smaller"
        lines.append(
            f"`stiff`, a nominal controller as stiff as the term, gives a {more} reduction, {reduction_text(stiff)}."
        )
    for row in results.of(scenario):
        if not row.rested:
            lines.append(f"`{row.controller}` does not come to rest, so the metrics contain its own motion.")
        if row.stops:
            lines.append(f"`{row.controller}` reaches the stops of {markdown(', '.join(row.stops))}.")
        if row.failed:
            lines.append(f"`{row.controller}`: {markdown('; '.join(row.failed))}.")
    return lines


def _known(row: ControllerRow, name: str) -> str:
    return interval_text(row.metrics[name]) if name in row.metrics else "–"


def joint_text(row: ControllerRow) -> str:
    """Return name, change of velocity and share of the velocity limit of the worst joint in the impacts of a row."""
    if row.joint is None:
        return "–"
    share = row.metrics.get("joint_share")
    limit = "" if share is None else f", {100 * share.mean:.3g} %"
    return f"{row.joint.name} {row.metrics['joint_velocity'].mean:.3g} {row.joint.unit}{limit}"


def interval_text(value: Interval, digits: int = 3) -> str:
    """Return ``mean ± half width``, or the mean alone if :attr:`Interval.shown` is ``None``.

    The mean has ``digits`` significant digits.
    """
    decimals = max(0, digits - 1 - int(np.floor(np.log10(abs(value.mean))))) if value.mean else 0
    return _plus_minus(value, min(decimals, _DECIMALS))


def percent(value: Interval | None, unit: str = " %") -> str:
    """Return a share as text in percent."""
    return "–" if value is None else _plus_minus(value, 1, 100) + unit


def _plus_minus(value: Interval, decimals: int, factor: int = 1) -> str:
    # Adding zero turns -0.0 into 0.0.
    text = f"{round(factor * value.mean, decimals) + 0.0:.{decimals}f}"
    return text if value.shown is None else f"{text} ± {factor * value.shown:.{decimals}f}"


def reduction_text(row: ControllerRow | None) -> str:
    """Return the reduction of a row in percent; ``–`` for nominal or if the reduction is ``None``."""
    return percent(None if row is None or row.controller == "nominal" else row.reduction)


def targets_text(row: ControllerRow) -> str:
    """Return ``met``, or the names of the missed targets; empty if the row has no targets."""
    missed = missed_targets(row)
    if missed is None:
        return ""
    return "missed: " + ", ".join(missed) if missed else "met"


def _missed(row: ControllerRow) -> str:
    return ", ".join((missed_targets(row) or {}).values())


def _total(row: ControllerRow | None) -> str:
    return "–" if row is None or not row.metrics else interval_text(row.metrics["q_total_impact"])
