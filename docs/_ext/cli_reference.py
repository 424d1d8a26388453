"""Directive ``cli-reference``, which describes the command line from the signatures of the commands.

The directive reads the public ``OptionInfo`` of Typer, and not the parser of Typer, which changes between versions.
"""

from __future__ import annotations

import inspect
import types
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, Union, get_args, get_origin, get_type_hints

import typer
from generated_markdown import add_directive
from typer.models import ArgumentInfo, OptionInfo

if TYPE_CHECKING:
    from sphinx.application import Sphinx

_WORDS = {int: "INTEGER", float: "NUMBER", str: "TEXT"}


@dataclass(frozen=True)
class Parameter:
    """Argument or option of a command: spelling, default and meaning, in Markdown."""

    names: tuple[str, ...]
    takes: str
    default: str
    meaning: str
    panel: str
    argument: bool

    @property
    def spelling(self) -> str:
        """All names of the parameter, and the placeholder of its value."""
        return f"{', '.join(self.names)} {self.takes}".strip()


def commands() -> dict[str, Callable[..., None]]:
    """Return the subcommands by name, in the order of ``--help``."""
    from impact_posture_cli.app import COMMANDS, load

    return {name: load(name) for name in COMMANDS}


def parameters(command: Callable[..., None]) -> list[Parameter]:
    """Return the parameters of a command in the order of its signature."""
    hints = get_type_hints(command, include_extras=True)
    options = []
    for name, parameter in inspect.signature(command).parameters.items():
        annotation = hints[name]
        infos = [m for m in getattr(annotation, "__metadata__", ()) if isinstance(m, ArgumentInfo | OptionInfo)]
        if annotation is typer.Context:
            continue
        if not infos:
            raise TypeError(f"parameter '{name}' of '{command.__name__}' is not documented as an option")
        info, value = infos[0], parameter.default
        inner = _plain(get_args(annotation)[0])
        argument = isinstance(info, ArgumentInfo)
        # If a parameter uses Annotated, Typer stores the first name in the field for the default.
        first = (info.default,) if isinstance(info.default, str) else ()
        names = (*first, *(info.param_decls or ())) or (f"--{name.replace('_', '-')}",)
        takes = info.metavar or ("" if inner is bool else _choices(inner) or _WORDS.get(inner, "TEXT"))
        names = (info.metavar or name.upper(),) if argument else tuple(n.replace("/", " / ") for n in names)
        options.append(
            Parameter(
                names=names,
                takes="" if argument else takes,
                default=_default(info, value),
                meaning=" ".join((info.help or "").split()) + _kinds(info, inner),
                panel=getattr(info, "rich_help_panel", None) or "Other",
                argument=argument,
            )
        )
    return options


def _plain(annotation: Any) -> Any:
    """Return the type without ``| None`` and without the list of a repeatable option."""
    if get_origin(annotation) in (Union, types.UnionType):
        annotation = next(a for a in get_args(annotation) if a is not type(None))
    return get_args(annotation)[0] if get_origin(annotation) is list else annotation


def _choices(inner: Any) -> str:
    if get_origin(inner) is Literal:
        return "|".join(str(a) for a in get_args(inner))
    members = getattr(inner, "__members__", None)
    return "|".join(str(m.value) for m in members.values()) if members else ""


def _kinds(info: ArgumentInfo | OptionInfo, inner: Any) -> str:
    """Return the choices if a metavar hides them and the help text does not name all of them."""
    choices = _choices(inner)
    if not (info.metavar and choices) or all(c in (info.help or "") for c in choices.split("|")):
        return ""
    return f" One of {choices.replace('|', ', ')}."


def _default(info: ArgumentInfo | OptionInfo, value: Any) -> str:
    if isinstance(info.show_default, str):
        return info.show_default
    if value is inspect.Parameter.empty:
        return "required"
    return "–" if value is None or value is False else f"`{value}`"


def _cell(text: str) -> str:
    return text.replace("|", "\\|")


def markdown() -> str:
    """Return a section for each command, with its purpose, its usage, and a table of its options."""
    from impact_posture_cli.app import COMMANDS

    parts = []
    for name, command in commands().items():
        every = parameters(command)
        arguments, options = [p for p in every if p.argument], [p for p in every if not p.argument]
        usage = " ".join([f"impact-posture {name}", *[a.names[0] for a in arguments], "[OPTIONS]"])
        parts += [f"## {name}", "", COMMANDS[name], "", "```text", usage, "```", ""]
        if arguments:
            parts += ["| argument | meaning |", "|---|---|"]
            parts += [f"| `{_cell(a.spelling)}` | {_cell(a.meaning)} |" for a in arguments] + [""]
        for panel in dict.fromkeys(o.panel for o in options):
            parts += [f"| {panel} | default | meaning |", "|---|---|---|"]
            parts += [
                f"| `{_cell(o.spelling)}` | {_cell(o.default)} | {_cell(o.meaning)} |"
                for o in options
                if o.panel == panel
            ] + [""]
    return "\n".join(parts)


def setup(app: Sphinx) -> dict[str, Any]:
    return add_directive(app, "cli-reference", lambda _: markdown())
