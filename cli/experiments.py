"""What the commands that run experiments have in common: options, and tables."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Literal

import typer

if TYPE_CHECKING:
    from impact_posture.experiment.statistics import Row
    from impact_posture_cli.output import Page

RUN = "Run"
Mode = Literal["live", "held"]

ScenarioName = Annotated[
    str,
    typer.Argument(
        metavar="SCENARIO",
        help="aerial-vertical, aerial-lateral, solo8-push, talos-push, or a path to a scenario.toml.",
    ),
]
Seeds = Annotated[int, typer.Option("--seeds", min=1, rich_help_panel=RUN, help="Seeds a controller, from 0.")]
Processes = Annotated[
    int, typer.Option("--jobs", min=1, rich_help_panel=RUN, help="Processes that run at the same time.")
]


def rows_table(page: Page, rows: tuple[Row, ...] | list[Row]) -> None:
    """Controllers of a scenario, a row each."""
    from impact_posture.experiment.summary import interval_text, reduction_text

    lines = []
    for row in rows:
        if not row.metrics:
            lines.append((row.controller, "failed", "", "", "", ""))
            continue
        lines.append(
            (
                row.controller + ("" if row.rested else " *"),
                interval_text(row.metrics["q_total_impact"]),
                reduction_text(row),
                interval_text(row.metrics["peak_jump"]),
                interval_text(row.metrics["saturation_inside"], 2),
                "" if row.H is None else f"{row.H:.3g}",
            )
        )
    page.table(("  controller", "q_total", "reduction", "peak jump", "saturated s", "H before"), [
        (f"  {line[0]}", *line[1:]) for line in lines
    ], right=(1, 2, 3, 4, 5))  # fmt: skip
    for row in rows:
        for error in row.failed:
            page.line(f"  {row.controller}: {error}")
        if row.stops:
            page.line(f"  {row.controller} reaches the stops of {', '.join(row.stops)}")
    if not all(row.rested for row in rows):
        page.line("  * was not at rest before the push: its own motion is in what is measured", style="dim")
