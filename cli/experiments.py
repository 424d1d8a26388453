"""Options and tables of the commands that run experiments."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Literal

import typer

from impact_posture_cli.options import CompileMode, option
from impact_posture_cli.output import Page

if TYPE_CHECKING:
    from impact_posture.experiment.seed_statistics import ControllerRow

RUN = "Run"
Mode = Literal["live", "held"]

ScenarioName = Annotated[
    str,
    typer.Argument(
        metavar="SCENARIO",
        help="aerial-vertical, aerial-lateral, solo8-push, talos-push, talos-throw, solo8-throw, talos-strike, "
        "g1-strike, solo12-landing, solo12-drop, panda-tap, panda-wall, ur5-strike, hextilt-poke, or a path to a "
        "scenario.toml.",
    ),
]
Seeds = Annotated[int, option("--seeds", RUN, "Number of seeds per controller, counted from 0.", min=1)]
Compile = Annotated[
    CompileMode, option("--compile", RUN, "Compile controllers to machine code; auto: if there are 2 or more seeds.")
]
Processes = Annotated[int, option("--jobs", RUN, "Number of processes that run at the same time.", min=1)]


def rows_table(page: Page, rows: tuple[ControllerRow, ...] | list[ControllerRow]) -> None:
    """Write a table with one row per controller of a scenario."""
    from impact_posture.config.json_block import jsonable
    from impact_posture.experiment.reproduction_summary import interval_text, percent
    from impact_posture.experiment.seed_statistics import headline
    from impact_posture.simulation.series import RECOVERY

    lines = []
    for row in rows:
        numbers = [""] * 4
        if row.metrics:
            less = [percent(None if row.controller == "nominal" else of, "") for of in (row.reduction, row.recovery)]
            peak = f"{row.metrics['peak_jump'].mean:.3g}"
            numbers = [interval_text(row.metrics["q_total_impact"]), *less, peak]
        whole = row.completed == row.runs
        status = row.status if whole else f"{row.status} {row.runs - row.completed}/{row.runs}"
        lines.append((f"  {row.controller}{'' if row.rested else ' *'}", *numbers, status))
    head = ("  controller", "q_total", "less %", f"in {RECOVERY:g} s %", "peak jump", "status")
    page.table(head, lines, right=(1, 2, 3, 4))
    page.line("  q_total: motion in the impact windows (rad, m); peak jump in rad/s and m/s", style="dim")
    page.line(
        f"  less %: reduction of q_total; in {RECOVERY:g} s %: from each impact until {RECOVERY:g} s later",
        style="dim",
    )
    _loads_table(page, rows)
    nominal, *others = jsonable(rows)
    if nominal["controller"] == "nominal":
        for row in others:
            if row["reduction"] is not None:
                page.pairs([("", headline(row, nominal))])
    if any(row.failed for row in rows):
        page.line("  no reduction if a run of either controller did not complete; means are over completed runs",
                  style="dim")  # fmt: skip
    for row in rows:
        for line in row.failed:
            page.line(f"  {row.controller}: {line}")
        if row.stops:
            page.line(f"  {row.controller} reaches the stops of {', '.join(row.stops)}")
    if not all(row.rested for row in rows):
        page.line("  * was not at rest before the push: the numbers include its own motion", style="dim")


def _loads_table(page: Page, rows: tuple[ControllerRow, ...] | list[ControllerRow]) -> None:
    from impact_posture.experiment.reproduction_summary import joint_text
    from impact_posture.simulation.metrics import AFTER_TOUCH

    lines = []
    for row in rows:
        if not row.metrics:
            continue
        keys = ("base_linear", "base_angular", "peak_force", "impulse")
        numbers = [f"{row.metrics[key].mean:.3g}" if key in row.metrics else "–" for key in keys]
        lines.append((f"  {row.controller}", *numbers, joint_text(row)))
    if lines:
        page.gap()
        head = ("  controller", "base m/s", "rad/s", "force N", "N·s", "worst joint, % of its limit")
        page.table(head, lines, right=(1, 2, 3, 4))
        when = "in the pushes" if rows[0].approach is None else f"within {AFTER_TOUCH}"
        page.line(f"  largest changes of velocity, and normal impulse, {when}", style="dim")
