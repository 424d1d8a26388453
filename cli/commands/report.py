"""``impact-posture report DIR``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from impact_posture_cli import options
from impact_posture_cli.output import Page, print_json
from impact_posture_cli.progress import progress

OutputFolder = Annotated[
    str, typer.Argument(metavar="DIR", help="A folder that optimize, simulate or compare --out wrote.")
]


def report(
    folder: OutputFolder,
    meshes: options.Meshes = False,
    json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Run ``impact-posture report``."""
    from impact_posture.output_folder import add_to_record

    place = Path(folder)
    if any((place / name).is_file() for name in ("run.json", "comparison.json")):
        from impact_posture.experiment.run_reports import write_run_report as rewrite_report
    else:
        from impact_posture.result_folder import rewrite_report
    with progress("writing", shown=not (quiet or json)):
        written = rewrite_report(place, meshes=meshes)
    add_to_record(place, [written])
    if json:
        print_json({"schema": "impact-posture/report/1", "file": str(written)})
    else:
        Page(quiet=quiet).line(str(written))
