"""``impact-posture report DIR``."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from impact_posture.errors import printable
from impact_posture_cli import options
from impact_posture_cli.output import Page, print_json

OutputFolder = Annotated[
    str, typer.Argument(metavar="DIR", help="A folder that optimize, simulate or compare --out wrote.")
]


def report(
    folder: OutputFolder,
    meshes: options.Meshes = False,
    force: options.ForceFiles = False,
    json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    page, place = Page(json=json, quiet=quiet), Path(folder)
    rewrite: Callable[..., Path]
    if any(os.path.isfile(place / name) for name in ("run.json", "comparison.json")):
        from impact_posture.experiment.run_reports import write_run_report as rewrite
    else:
        from impact_posture.output.result_reader import rewrite_report as rewrite
    with page.progress("writing"):
        written = rewrite(place, meshes=meshes, force=force)
    show_written(page, "report", written)


def show_written(page: Page, command: str, file: Path) -> None:
    """Print the path of a written file, as JSON or as text."""
    if page.json:
        print_json({"schema": f"impact-posture/{command}/1", "file": str(file)})
    elif not page.quiet:
        print(printable(str(file)))
