"""Typer app with the subcommands of ``impact-posture``.  Only the module of the called subcommand is imported."""

from __future__ import annotations

from importlib import import_module
from typing import Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup

from impact_posture_cli.argv import split_vectors
from impact_posture_cli.commands import COMMANDS
from impact_posture_cli.output import use_options


def load(name: str) -> Any:
    """Import and return the function of a subcommand."""
    return getattr(import_module(f"impact_posture_cli.commands.{name}"), name)


def build(name: str) -> Any:
    """Build the parser of a subcommand with all its options."""
    single = typer.Typer(add_completion=False)
    single.command(name, help=COMMANDS[name])(load(name))
    return typer.main.get_command(single)


class CommandGroup(TyperGroup):
    """Group of subcommands that builds only the parser of the called subcommand, so that ``--help`` stays fast."""

    def __init__(self, **attributes: Any) -> None:
        super().__init__(**attributes)
        self.commands = {name: TyperCommand(name, help=text) for name, text in COMMANDS.items()}

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Return the name, the parser and the arguments of the called subcommand."""
        name, _, rest = super().resolve_command(ctx, args)
        command = build(str(name))
        lengths = {option: p.nargs for p in command.params if p.nargs > 1 for option in p.opts}
        use_options(option for p in command.params for option in (*p.opts, *p.secondary_opts))
        return name, command, split_vectors(rest, lengths)


app = typer.Typer(
    name="impact-posture",
    cls=CommandGroup,
    help="Find the posture in which an impact disturbs a redundant robot least, see why, and export it as C code.",
    epilog="Each command has its own --help. ROBOT: name from 'impact-posture robots', or path of a URDF or MJCF.",
    no_args_is_help=True,
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
    """Define the options of ``impact-posture`` itself, without a subcommand."""
