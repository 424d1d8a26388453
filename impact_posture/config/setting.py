"""Description of a setting for the command line: its meaning, its panel in ``--help``, and its spelling."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any


class Unstated(float):
    """Default number of a setting.  A number from the user is a plain ``float``, even if it equals the default."""


def stated(value: float | str | None) -> bool:
    """Return whether the user set a value: it is neither ``None`` nor of the type :class:`Unstated`."""
    return value is not None and not isinstance(value, Unstated)


CONTACT, METRIC, ROBOT = "Contact", "Measure", "Robot"
TASK, LIMITS, SEARCH, OUTPUT = "Task", "Limits of the task", "Search", "Output"


@dataclass(frozen=True)
class Setting:
    """Description of a setting, apart from its annotation and default.

    Attributes:
        help: Meaning in one line.
        panel: Panel of ``--help`` that lists the option.
        takes: Placeholder of the value in ``--help``.
        words: Description of the default value, if the default is not a constant.
        option: Spelling of the option, if it differs from the name of the field.
        parse: Function that converts the text of the option to the value.  If the option is repeatable, its argument
            is the list of all texts.
        repeatable: Whether the option may be given several times.
    """

    help: str
    panel: str = TASK
    takes: str | None = None
    words: str | None = None
    option: str | None = None
    parse: Callable[[Any], Any] | None = None
    repeatable: bool = False


def setting(default: Any, *description: Any, **more: Any) -> Any:
    """Return a dataclass field with a default and a :class:`Setting` as metadata."""
    return field(default=default, metadata={"setting": Setting(*description, **more)})
