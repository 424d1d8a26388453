"""Description of a setting for the command line: its meaning, its panel in ``--help``, and its spelling."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

CONTACT, METRIC, ROBOT = "Contact", "Measure", "Robot"
TASK, LIMITS, SEARCH, OUTPUT = "Task", "Limits of the task", "Search", "Output"


@dataclass(frozen=True)
class Setting:
    """Description of a setting, besides its annotation and default.

    Attributes:
        help: Meaning in one line.
        panel: Part of ``--help`` with the option.
        takes: Placeholder of the value in ``--help``.
        words: Default in words, if it comes from the robot.
        option: Spelling of the option, if it differs from the field.
        parse: Function from all words of the command line to the value.
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
    """Return a dataclass field with a default and the arguments of :class:`Setting`."""
    return field(default=default, metadata={"setting": Setting(*description, **more)})
