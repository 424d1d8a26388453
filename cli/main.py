"""Entry point of ``impact-posture``: prepare the process, then run the command line."""

from __future__ import annotations

import sys

from impact_posture_cli.process import finish, memory_fault, prepare, refuse


def main() -> None:
    """Run the command line and exit with the exit code of the command."""
    prepare()
    if fault := memory_fault():
        sys.exit(refuse(fault))
    # Import these modules after prepare(), so that a signal during the import ends the process without a traceback.
    import typer

    from impact_posture_cli.app import app
    from impact_posture_cli.argv import put_right
    from impact_posture_cli.error_boundary import run

    finish(run(typer.main.get_command(app), put_right(sys.argv[1:])))
