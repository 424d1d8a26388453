"""Checks that need no robot: what fails here is a wrong command line, exit code 2."""

from __future__ import annotations

import math

import typer

Two = tuple[float, float]
Three = tuple[float, float, float]
Four = tuple[float, float, float, float]

# What every usage error derives from, whichever Click this Typer carries.
UsageError: type[Exception] = typer.BadParameter.__mro__[1]


def finite(value: object) -> object:
    """Refuse NaN and infinity."""
    numbers = value if isinstance(value, tuple) else (value,)
    if any(isinstance(v, float) and not math.isfinite(v) for v in numbers):
        raise typer.BadParameter("give finite numbers")
    return value


def positive(value: float | None) -> float | None:
    """Refuse what is not above zero."""
    if value is not None and not (math.isfinite(value) and value > 0):
        raise typer.BadParameter("give a number above zero")
    return value


def positives(value: Three | None) -> Three | None:
    """Refuse numbers that are not above zero."""
    if value is not None and not all(math.isfinite(v) and v > 0 for v in value):
        raise typer.BadParameter("give three numbers above zero")
    return value


def not_negative(value: float | None) -> float | None:
    """Refuse what is below zero."""
    if value is not None and not (math.isfinite(value) and value >= 0):
        raise typer.BadParameter("give a number, zero or more")
    return value


def direction(value: Three | None) -> Three | None:
    """Refuse what points nowhere."""
    if value is None:
        return None
    if not all(math.isfinite(v) for v in value) or max(abs(v) for v in value) < 1e-9:
        raise typer.BadParameter("give three finite numbers, not all zero")
    return value


def unit_share(value: float) -> float:
    """Refuse what lies outside [0, 1]."""
    if not 0 <= value <= 1:
        raise typer.BadParameter("give a number from 0 to 1")
    return value


def cone(value: float) -> float:
    """Refuse what is no cone's half angle."""
    if not 0 <= value < 90:
        raise typer.BadParameter("give degrees from 0 to below 90")
    return value


def contact(value: str | None) -> str | None:
    """Refuse on the spot what no robot could make right."""
    if value is None:
        return None
    from impact_posture.errors import ImpactPostureError
    from impact_posture.impact.contact import ImpactContact
    from impact_posture.impact.parsing import parse_contact

    try:
        frame, normal, impulse = parse_contact(value)
        ImpactContact(frame, normal, impulse=1.0 if impulse is None else impulse)
    except ImpactPostureError as error:
        raise typer.BadParameter(f"{error.what}; {error.hint}") from None
    return value


def factors(value: Two | None) -> Two | None:
    """Refuse what is no range of factors."""
    if value is not None and not 0 < value[0] <= value[1] < float("inf"):
        raise typer.BadParameter("give two factors above zero, the lower first, such as 0.5 2")
    return value


def payloads(values: list[str] | None) -> list[str] | None:
    """Refuse what is no frame and mass."""
    from impact_posture.errors import ImpactPostureError
    from impact_posture.impact.parsing import parse_payload

    for value in values or ():
        try:
            parse_payload(value)
        except ImpactPostureError as error:
            raise typer.BadParameter(f"{error.what}; {error.hint}") from None
    return values


def contacts(values: list[str] | None) -> list[str] | None:
    """The same for each of several."""
    for value in values or ():
        contact(value)
    return values
