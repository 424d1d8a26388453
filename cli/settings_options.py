"""Create command-line options from the fields of settings, and settings from the given options."""

from __future__ import annotations

import inspect
import os
from collections.abc import Callable, Collection
from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, TypeVar, Union, get_args, get_origin, get_type_hints

import typer

from impact_posture.config.problem_settings import RobotSettings
from impact_posture.config.setting import CONTACT, LIMITS, METRIC, ROBOT, SEARCH, TASK, Setting
from impact_posture.config.table_validation import validate
from impact_posture.errors import ImpactPostureError
from impact_posture_cli.error_boundary import UsageError

_PANELS = (CONTACT, METRIC, ROBOT, TASK, LIMITS, SEARCH)
_Settings = TypeVar("_Settings", bound=RobotSettings)

NoSupport = Annotated[bool, typer.Option("--no-support", rich_help_panel=ROBOT, help="No foot stays on the ground.")]


@dataclass(frozen=True)
class TypedSettings:
    """Settings from the command line, without settings that have their default value.

    Attributes:
        context: Typer context of the command.
        values: Name of a setting → value.
    """

    context: typer.Context
    values: dict[str, Any]

    def fill(self, settings: type[_Settings], **more: Any) -> _Settings:
        """Return settings from :attr:`values` and ``more``; if both contain a name, ``more`` has priority."""
        return validate(settings, self.values | more, "options")

    def check_contact(self) -> None:
        """Check that either ``--normal`` or ``--contact`` is given."""
        if "contact" not in self.values and "normal" not in self.values:
            raise UsageError("Missing option '--normal X Y Z': the direction out of the surface, towards the robot.")
        if "contact" in self.values and ("frame" in self.values or "normal" in self.values):
            raise UsageError("--contact replaces --frame and --normal: give either --contact, or the other two.")

    def is_result(self, robot: str, free: Collection[str]) -> bool:
        """Return whether the argument ROBOT|RESULT_DIR is a result folder.

        Raises:
            UsageError: The argument is a result folder, and an option that is not in ``free`` is given.
        """
        if not os.path.isfile(Path(robot) / "result.json"):
            return False
        for name in self.context.params:
            if name not in {"robot", "json", "quiet", *free} and _on_command_line(self.context, name):
                what = f"{_spelled(name)} contradicts RESULT_DIR, which already contains the problem"
                raise UsageError(f"{what}: leave it out.")
        return True


def with_settings(
    settings: type[RobotSettings], *, without: Collection[str] = (), **changed: Any
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Return a decorator that adds an option for each setting to a command.

    Settings in ``without`` get no option.  ``changed`` replaces annotations of options: name of a setting →
    annotation.  The command is called with ``typed`` (:class:`TypedSettings`) and its own parameters.
    """
    options = _options(settings, without) | {name: (hint, None) for name, hint in changed.items()}
    if "support" in options:
        options["no_support"] = (NoSupport, False)

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        hints = get_type_hints(command, include_extras=True)
        keyword = inspect.Parameter.KEYWORD_ONLY
        others = [
            parameter.replace(kind=keyword, annotation=hints[name])
            for name, parameter in inspect.signature(command).parameters.items()
            if name != "typed"
        ]

        def run(context: typer.Context, **values: Any) -> None:
            typed = TypedSettings(context, _typed_values(context, options, settings))
            command(typed=typed, **{parameter.name: values[parameter.name] for parameter in others})

        parameters = [
            inspect.Parameter("context", keyword, annotation=typer.Context),
            *(parameter for parameter in others if parameter.default is parameter.empty),
            *(inspect.Parameter(n, keyword, default=default, annotation=a) for n, (a, default) in options.items()),
            *(parameter for parameter in others if parameter.default is not parameter.empty),
        ]
        # All versions of Typer read the signature; some versions also read the annotations.
        run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        run.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
        run.__name__, run.__doc__, run.__module__ = command.__name__, command.__doc__, command.__module__
        return run

    return decorate


def settings_of(settings: type[RobotSettings]) -> dict[str, Setting]:
    """Return name → :class:`Setting` for each field of a settings class that has an option."""
    return {f.name: f.metadata["setting"] for f in fields(settings) if "setting" in f.metadata}


def _options(settings: type[RobotSettings], without: Collection[str]) -> dict[str, tuple[Any, Any]]:
    """Return name → annotation and default of each option, in the order of the panels."""
    described, options = settings_of(settings), {}
    types, demands = get_type_hints(settings), get_type_hints(settings, include_extras=True)
    defaults: dict[str, Any] = {f.name: None if f.default is MISSING else f.default for f in fields(settings)}
    names = (name for name in described if name not in without)
    for name in sorted(names, key=lambda name: _PANELS.index(described[name].panel)):
        setting, default, words = described[name], defaults[name], described[name].words
        if isinstance(default, tuple):
            words = " ".join(f"{value:g}" for value in default) if words is None and default else words
            default = None
        option = typer.Option(
            setting.option or _spelled(name),
            metavar=setting.takes,
            help=setting.help,
            rich_help_panel=setting.panel,
            show_default=words if words is not None else True,
            callback=demanding(demands[name], setting),
        )
        options[name] = (Annotated[_option_type(types[name], setting, default is None), option], default)
    return options


def _option_type(kind: Any, setting: Setting, optional: bool) -> Any:
    if setting.repeatable:
        return list[str] | None
    inner = [t for t in get_args(kind) if t is not type(None)] if get_origin(kind) in (Union, UnionType) else [kind]
    return inner[0] | None if optional else inner[0]


def demanding(annotation: Any, setting: Setting | None = None) -> Callable[[Any], Any]:
    """Return a callback that checks the value of an option against the allowed values in an annotation."""

    def check(value: Any) -> Any:
        if value is not None and value != []:
            from impact_posture.config.checked import hint_for

            try:
                hint = hint_for(_value(setting, value), annotation)
            except ImpactPostureError as error:
                raise typer.BadParameter(f"{error.what}; {error.hint}") from None
            if hint:
                raise typer.BadParameter(hint)
        return value

    return check


def _value(setting: Setting | None, value: Any) -> Any:
    if setting is not None and setting.parse is not None:
        return setting.parse(value)
    return tuple(value) if isinstance(value, list) else value


def _typed_values(context: typer.Context, options: Collection[str], settings: type[RobotSettings]) -> dict[str, Any]:
    described, values = settings_of(settings), {}
    for name in options:
        if name in described and _on_command_line(context, name):
            values[name] = _value(described[name], context.params[name])
    if context.params.get("no_support"):
        if "support" in values:
            raise UsageError("--no-support contradicts --support: give one of the two.")
        values["support"] = ()
    return values


def _on_command_line(context: typer.Context, name: str) -> bool:
    source = context.get_parameter_source(name)
    return source is not None and source.name == "COMMANDLINE"


def _spelled(name: str) -> str:
    return f"--{name.strip('_').replace('_', '-')}"
