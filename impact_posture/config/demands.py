"""The description of a setting: its meaning, its spelling as an option, and the demand on its value."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import Field, dataclass, field
from typing import Annotated, Any, TypeVar

from impact_posture.config.option_values import parse_contact
from impact_posture.errors import ImpactPostureError, not_one_of

CONTACT, METRIC, ROBOT, TASK, SEARCH, OUTPUT = "Contact", "Measure", "Robot", "Task", "Search", "Output"
_LARGEST = float("inf")
# Largest length (m), beyond which the solver does not come back, and largest mass (kg), beyond which a mass matrix
# is singular in double precision.
_FARTHEST, _HEAVIEST = 1e100, 1e12
# Degrees below which the cosine of a tilt says nothing at the precision that certifies.
_LEAST_TILT = 0.1
# Largest distance of the norm of a given quaternion from 1.
_UNIT = 1e-3

_Class = TypeVar("_Class", bound=type)


@dataclass(frozen=True)
class Setting:
    """Description of a setting, besides its type and default.

    Attributes:
        help: Meaning in one line.
        panel: Part of ``--help`` with the option.
        takes: Placeholder of the value in ``--help``.
        words: Default in words, if it comes from the robot.
        demand: Demand on a value, as an error states it.
        holds: Whether a value meets the demand.
        option: Spelling of the option, if it differs from the field.
        parse: Function from all words of the command line to the value.
        repeatable: Whether the option may be given several times.
    """

    help: str
    panel: str = TASK
    takes: str | None = None
    words: str | None = None
    demand: str = ""
    holds: Callable[[Any], bool] | None = None
    option: str | None = None
    parse: Callable[[Any], Any] | None = None
    repeatable: bool = False

    def check(self, value: Any) -> Any:
        """Return the value.

        Raises:
            ValueError: The value does not meet the demand.
        """
        if value is not None and self.holds is not None and not self.holds(value):
            raise ValueError(self.demand)
        return value

    def __get_pydantic_core_schema__(self, source: Any, handler: Callable[[Any], Any]) -> Any:
        from pydantic_core import core_schema

        return core_schema.no_info_after_validator_function(self.check, handler(source))


def setting(default: Any, *description: Any, **more: Any) -> Any:
    """Return a field with a default and the arguments of :class:`Setting`, for a class :func:`with_demands`."""
    return field(default=default, metadata={"setting": Setting(*description, **more)})


def with_demands(cls: _Class) -> _Class:
    """Put each :func:`setting` of a class into its annotation, where pydantic and the command line find it."""
    for name, value in vars(cls).items():
        if isinstance(value, Field) and "setting" in value.metadata:
            cls.__annotations__[name] = Annotated[cls.__annotations__[name], value.metadata["setting"]]
    return cls


def _finite(value: Any) -> bool:
    return all(-_LARGEST < v < _LARGEST for v in (value if isinstance(value, tuple) else (value,)))


def _direction(value: tuple[float, ...]) -> bool:
    return _finite(value) and max(abs(v) for v in value) >= 1e-9


def _unit(value: tuple[float, ...]) -> bool:
    """Tell whether a quaternion has unit length."""
    norm = math.hypot(*value)
    if not abs(norm - 1) < _UNIT:
        raise ValueError(f"has norm {norm:.4g}; {UNIT['demand']}")
    return True


def _positive(value: Any) -> bool:
    return _finite(value) and min(value if isinstance(value, tuple) else (value,)) > 0


def _contacts(value: Any) -> bool:
    """Tell whether each text is a contact with a direction."""
    for text in (value,) if isinstance(value, str) else value:
        try:
            _, normal, impulse = parse_contact(text)
        except ImpactPostureError as error:
            raise ValueError(f"{error.what}; {error.hint}") from None
        if not _direction(normal) or not _positive(1.0 if impulse is None else impulse):
            raise ValueError(f"'{text}' needs a normal with a direction and an impulse above zero")
    return True


# Demands on values, as keyword arguments of a setting.
NUMBERS = {
    "holds": lambda value: all(abs(v) <= _FARTHEST for v in value),
    "demand": f"give finite numbers, up to {_FARTHEST:g}",
}
LENGTHS = {"holds": _positive, "demand": "give three numbers above zero"}
ABOVE_ZERO = {"holds": _positive, "demand": "give a number above zero"}
ONE_OR_MORE = {"holds": _positive, "demand": "give 1 or more"}
ZERO_OR_MORE = {"holds": lambda value: 0 <= value < _LARGEST, "demand": "give a number, zero or more"}
SHARE = {"holds": lambda value: 0 <= value <= 1, "demand": "give a number from 0 to 1"}
HALF_ANGLE = {"holds": lambda value: 0 <= value < 90, "demand": "give degrees from 0 to below 90"}
UNIT = {"holds": _unit, "demand": "give a unit quaternion x y z w"}
DIRECTION = {"holds": _direction, "demand": "give three finite numbers, not all zero"}
CONTACTS = {"holds": _contacts}
FACTORS = {
    "holds": lambda value: 0 < value[0] <= value[1] < _LARGEST,
    "demand": "give two factors above zero, the lower first, such as 0.5 2",
}
MASSES = {
    "holds": lambda value: all(0 < mass <= _HEAVIEST for _, mass in value),
    "demand": f"give a frame and kg above zero each, up to {_HEAVIEST:g}",
}


def between(low: float, high: float, unit: str, names: Sequence[str] = ()) -> dict[str, Any]:
    """Return the demand for a number within bounds, or for one of several names."""
    named = f", or one of {', '.join(names)}" if names else ""
    return {
        "holds": lambda value: value in names if isinstance(value, str) else low <= value <= high,
        "demand": f"give {low:g} to {high:g} {unit}{named}",
    }


def tilt_of(value: str) -> float | None:
    """Return DEG of a contact pose ``aligned:DEG`` or a base ``level:DEG``, or ``None`` for any other value."""
    kind, colon, degrees = value.partition(":")
    try:
        return float(degrees) if kind in ("aligned", "level") and colon else None
    except ValueError:
        return None


def kind_or_tilt(kinds: Sequence[str], tilted: str) -> dict[str, Any]:
    """Return the demand for one of these kinds, or ``tilted:DEG``; a misspelt one gets a suggestion."""

    def holds(value: str) -> bool:
        if value in kinds or value.startswith(f"{tilted}:"):
            return value in kinds or _LEAST_TILT <= (tilt_of(value) or 0.0) < 90
        raise ValueError("; ".join(not_one_of(value, (*kinds, f"{tilted}:DEG"))))

    return {"holds": holds, "demand": f"give {tilted}:DEG with {_LEAST_TILT:g} degrees or more, below 90"}
