"""``impact-posture view DIR``."""

from __future__ import annotations

import os
from pathlib import Path

from impact_posture_cli import options
from impact_posture_cli.commands.report import OutputFolder, show_written
from impact_posture_cli.output import Page


def view(folder: OutputFolder, json: options.Json = False, quiet: options.Quiet = False) -> None:
    import webbrowser

    from impact_posture.errors import InputError
    from impact_posture.output.report import REPORT

    file = Path(folder) / REPORT
    if not os.path.isfile(file):
        raise InputError("is not there", where=str(file), hint=f"make it with `impact-posture report {folder}`")
    if not webbrowser.open(file.resolve().as_uri()):
        raise InputError("no browser could be started", where=str(file), hint="open this file in a browser")
    show_written(Page(json=json, quiet=quiet), "view", file)
