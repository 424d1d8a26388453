"""``impact-posture report DIR``."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from impact_posture.errors import printable
from impact_posture_cli import options
from impact_posture_cli.output import print_json
from impact_posture_cli.progress_line import progress

OutputFolder = Annotated[
    str, typer.Argument(metavar="DIR", help="A folder that optimize, simulate or compare --out wrote.")
]


def report(
    folder: OutputFolder, meshes: options.Meshes = False, json: options.Json = False, quiet: options.Quiet = False
) -> None:
    from impact_posture.system.output_folder import add_to_record

    place = Path(folder)
    rewrite: Callable[..., Path]
    if any(os.path.isfile(place / name) for name in ("run.json", "comparison.json")):
        from impact_posture.experiment.run_reports import write_run_report as rewrite
    else:
        from impact_posture.output.result_reader import rewrite_report as rewrite
    with progress("writing", shown=not (quiet or json)):
        written = rewrite(place, meshes=meshes)
    add_to_record(place, [written])
    show_written("report", written, json=json, quiet=quiet)


def show_written(command: str, page: Path, *, json: bool, quiet: bool) -> None:
    """Print the path of a written page, as JSON or as text."""
    if json:
        print_json({"schema": f"impact-posture/{command}/1", "file": str(page)})
    elif not quiet:
        print(printable(str(page)))
