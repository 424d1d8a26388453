"""``impact-posture plot RESULT_DIR``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from impact_posture_cli import options
from impact_posture_cli.output import Page, print_json

ResultFolder = Annotated[str, typer.Argument(metavar="RESULT_DIR", help="A folder that optimize wrote.")]
Figures = Annotated[
    list[str] | None,
    typer.Option(
        "--figure", show_default="all",
        help="Figure to draw: ellipsoid, postures, jump, nullspace, classical, tradeoff or self_motion; repeatable.",
    ),
]  # fmt: skip
PictureOut = Annotated[
    str | None, typer.Option("--out", metavar="DIR", help="Folder for the pictures.", show_default="RESULT_DIR")
]


def plot(
    result_dir: ResultFolder,
    figure: Figures = None,
    format: options.Formats = None,
    out: PictureOut = None,
    force: options.ForceFiles = False,
    json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    from impact_posture.output.picture_formats import DEFAULT_FORMATS
    from impact_posture.output.plot import draw_into
    from impact_posture.output.result_reader import load_view

    folder = Path(result_dir)
    into = Path(out) if out else folder
    formats = format or DEFAULT_FORMATS
    page = Page(json=json, quiet=quiet)
    with page.progress("drawing"):
        written = draw_into(load_view(folder), into, formats, figure, force=force)
    if json:
        print_json({"schema": "impact-posture/plot/1", "files": [str(path) for path in written]})
        return
    for path in written:
        page.line(str(path))
