"""Annotated types that restrict values, such as :data:`Positive`, for files, options and Python arguments.

Pydantic checks values from files.  :func:`~impact_posture.config.checked.checked` checks arguments of Python calls
and the command line.  This module imports no slow package, because ``--help`` loads it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

from impact_posture.config.text_parsers import parse_contact
from impact_posture.errors import ImpactPostureError, not_one_of

_INFINITE = float("inf")
# Largest length, m.  If an input is a greater length, the solver does not return.
_FARTHEST = 1e100
# Largest mass, kg.  With a greater mass, the mass matrix is singular in double precision.
_HEAVIEST = 1e12
# Smallest tilt, degrees.  The cosine of a smaller tilt is not accurate enough for the tolerance of the certificate.
_LEAST_TILT = 0.1


@dataclass(frozen=True)
class Demand:
    """Demand on a value, used as metadata of ``Annotated``.

    Attributes:
        holds: Function that returns whether a value of the right type meets the demand.  The function may raise a
            ``ValueError`` with a more exact message.
        words: Description of valid values for error messages.
    """

    holds: Callable[[Any], bool]
    words: str

    def check(self, value: Any) -> Any:
        """Return the value if it meets the demand.

        Raises:
            ValueError: The value does not meet the demand.
        """
        if not self.holds(value):
            raise ValueError(f"give {self.words}")
        return value

    def __get_pydantic_core_schema__(self, source: Any, handler: Callable[[Any], Any]) -> Any:
        from pydantic_core import core_schema

        return core_schema.no_info_after_validator_function(self.check, handler(source))


def between(low: float, high: float, unit: str = "", names: Sequence[str] = ()) -> Demand:
    """Return a :class:`Demand` for numbers from ``low`` to ``high``, or one of several names."""
    named = f", or one of {', '.join(names)}" if names else ""
    return Demand(
        lambda value: value in names if isinstance(value, str) else low <= value <= high,
        f"{low:g} to {high:g} {unit}".rstrip() + named,
    )


def kind_or_tilt(kinds: Sequence[str], tilted: str) -> Demand:
    """Return a :class:`Demand` for one of ``kinds`` or, with ``tilted="level"``, a text such as ``level:10``."""

    def holds(value: str) -> bool:
        if value in kinds or value.startswith(f"{tilted}:"):
            return value in kinds or _LEAST_TILT <= (tilt_of(value) or 0.0) < 90
        raise ValueError("; ".join(not_one_of(value, (*kinds, f"{tilted}:DEG"))))

    return Demand(holds, f"{tilted}:DEG with {_LEAST_TILT:g} degrees or more, below 90")


def tilt_of(value: str) -> float | None:
    """Return DEG of a contact pose ``aligned:DEG`` or a base ``level:DEG``, or ``None`` for any other value."""
    kind, colon, degrees = value.partition(":")
    try:
        return float(degrees) if kind in ("aligned", "level") and colon else None
    except ValueError:
        return None


def _finite(values: Iterable[float]) -> bool:
    return all(-_INFINITE < value < _INFINITE for value in values)


def _has_direction(vector: Iterable[float]) -> bool:
    # Entries below 1e-9 may be rounding errors, so that a vector of such entries has no direction.
    return _finite(vector) and max(abs(value) for value in vector) >= 1e-9


def _is_unit(quaternion: Iterable[float]) -> bool:
    norm = math.hypot(*quaternion)
    if not abs(norm - 1) < 1e-3:
        raise ValueError(f"has norm {norm:.4g}; give {_UNIT_QUATERNION}")
    return True


def _are_contacts(texts: str | Iterable[str]) -> bool:
    for text in (texts,) if isinstance(texts, str) else texts:
        try:
            _, normal, impulse = parse_contact(text)
        except ImpactPostureError as error:
            raise ValueError(f"{error.what}; {error.hint}") from None
        if not _has_direction(normal) or not (impulse is None or 0 < impulse < _INFINITE):
            raise ValueError(f"'{text}' needs a normal with a direction and an impulse above zero")
    return True


_UNIT_QUATERNION = "a unit quaternion x y z w"

Vector3 = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]

Finite = Annotated[float, Demand(lambda value: _finite([value]), "a finite number")]
Positive = Annotated[float, Demand(lambda value: 0 < value < _INFINITE, "a number above zero")]
NonNegative = Annotated[float, Demand(lambda value: 0 <= value < _INFINITE, "a number, zero or more")]
Share = Annotated[float, Demand(lambda value: 0 <= value <= 1, "a number from 0 to 1")]
HalfAngle = Annotated[float, Demand(lambda value: 0 <= value < 90, "degrees from 0 to below 90")]
OneOrMore = Annotated[int, Demand(lambda value: value >= 1, "a whole number, 1 or more")]
ZeroOrMore = Annotated[int, Demand(lambda value: value >= 0, "a whole number, zero or more")]
FiniteVector = Annotated[Vector3, Demand(_finite, "three finite numbers")]
Position = Annotated[
    Vector3, Demand(lambda vector: all(abs(v) <= _FARTHEST for v in vector), f"finite numbers, up to {_FARTHEST:g}")
]
Direction = Annotated[Vector3, Demand(_has_direction, "three finite numbers, not all zero")]
Lengths = Annotated[Vector3, Demand(lambda vector: _finite(vector) and min(vector) > 0, "three numbers above zero")]
UnitQuaternion = Annotated[Quaternion, Demand(_is_unit, _UNIT_QUATERNION)]
Contacts = Annotated[str | tuple[str, ...], Demand(_are_contacts, "FRAME:NX,NY,NZ")]
Factors = Annotated[
    tuple[float, float],
    Demand(lambda pair: 0 < pair[0] <= pair[1] < _INFINITE, "two factors above zero, the lower first, such as 0.5 2"),
]
TiltAndShift = Annotated[
    tuple[float, float],
    Demand(lambda pair: 0 <= pair[0] <= 45 and 0 <= pair[1] <= 1, "degrees from 0 to 45 and m from 0 to 1"),
]
Payloads = Annotated[
    tuple[tuple[str, float], ...],
    Demand(
        lambda pairs: all(0 < mass <= _HEAVIEST for _, mass in pairs),
        f"a frame and kg above zero each, up to {_HEAVIEST:g}",
    ),
]
