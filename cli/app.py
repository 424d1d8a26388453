"""The Typer app: the subcommands of ``impact-posture``."""

from __future__ import annotations

from typing import Annotated

import typer

from impact_posture_cli.commands import COMMANDS

app = typer.Typer(
    name="impact-posture",
    help="Find the posture in which a redundant robot takes an impact best, see why, and hand it to the controller.",
    epilog="Each command has its own --help. ROBOT: a name from 'impact-posture robots', or a path to a .urdf.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)


def _version(value: bool) -> None:
    if value:
        from impact_posture.version import __version__

        typer.echo(f"impact-posture {__version__}")
        raise typer.Exit


@app.callback()
def root(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    """Carry the options that stand before a command."""


for name, command in COMMANDS.items():
    app.command(name)(command)
