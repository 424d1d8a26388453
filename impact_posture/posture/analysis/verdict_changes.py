"""Changes at base, joints and contact from the initial to the optimal posture, and the outcome that follows."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

from impact_posture.impact.evaluation.impact_effect import ImpactLoad

Side = Literal["base", "joints", "impulse", "force"]

# If the relative change of a quantity is below this value, the quantity is "about the same".
SAME = 0.05
# Changes of a velocity (m/s or rad/s) below this fraction of the approach speed (m/s) are negligible.
FELT = 0.01


@dataclass(frozen=True)
class PredictedImpact(ImpactLoad):
    """The predicted impact in one posture, for the approach speed and the friction of the problem.

    The peak force is ``None`` if no contact stiffness is given.

    Attributes:
        sticks: Whether the first contact point sticks; ``None`` if the jump was computed without friction.
    """

    sticks: bool | None


@dataclass(frozen=True)
class Change:
    """Change of one quantity of the impact: a velocity jump, an impulse or a force.

    Attributes:
        side: The effect to which the quantity belongs: on the base, on the joints, impulse or force.
        relative: Relative change.
        line: The change in words.
        felt: Whether the change is not negligible compared with the approach speed.
    """

    side: Side
    relative: float
    line: str
    felt: bool = True

    @property
    def grows(self) -> bool:
        """Whether the quantity grows by 5 % or more."""
        return self.felt and self.relative >= SAME

    @property
    def falls(self) -> bool:
        """Whether the quantity falls by 5 % or more."""
        return self.felt and self.relative <= -SAME


def changes(
    before: ImpactLoad, after: ImpactLoad, speed: float, force: float | None = None, where: str = ""
) -> tuple[Change, ...]:
    """Return the changes from the impact ``before`` to the impact ``after``; ``speed`` is the approach speed, m/s.

    ``force`` is the relative change of the peak force of a linear contact, for use if the peak forces are unknown.
    ``where`` names the contact if there are several.
    """
    return (*_velocities(before, after, FELT * speed), *_contact(before, after, force, where))


def _velocities(before: ImpactLoad, after: ImpactLoad, least: float) -> Iterator[Change]:
    bases = (("m/s", before.base_linear, after.base_linear), ("rad/s", before.base_angular, after.base_angular))
    for unit, first, last in bases:
        if first is not None and last is not None:
            change, felt = relative_change(first, last), abs(last - first) > least
            line = f"base {first:.3g} to {last:.3g} {unit} ({_sign(change) if felt else 'negligible'})"
            yield Change("base", change, line, felt)
    one, other = before.joint, after.joint
    if one is None or other is None:
        return
    shares = None if one.share is None or other.share is None else (one.share, other.share)
    change = relative_change(*(shares or (one.velocity, other.velocity)))
    felt = max(one.velocity, other.velocity) > least
    limits = "" if shares is None else f"{100 * shares[0]:.3g} to {100 * shares[1]:.3g} % of its limit, "
    names = f"{one.velocity:.3g} to {other.velocity:.3g} {one.unit}"
    if one.name != other.name:
        names = f"{one.velocity:.3g} {one.unit} to {other.name} {other.velocity:.3g} {other.unit}"
    yield Change(
        "joints", change, f"worst joint {one.name} {names} ({limits}{_sign(change) if felt else 'negligible'})", felt
    )


def _contact(before: ImpactLoad, after: ImpactLoad, force: float | None, where: str) -> Iterator[Change]:
    impulse = relative_change(before.impulse, after.impulse)
    seconds = f"{before.impulse:.3g} to {after.impulse:.3g} N·s"
    yield Change("impulse", impulse, f"normal impulse{where} {seconds} ({_sign(impulse)})")
    if before.peak_force is not None and after.peak_force is not None:
        force = relative_change(before.peak_force, after.peak_force)
        newtons = f"{before.peak_force:.3g} to {after.peak_force:.3g} N ({_sign(force)})"
    elif force is not None:
        newtons = f"(linear contact) {_sign(force)}"
    else:
        return
    yield Change("force", force, f"peak force {newtons}")


def _sign(change: float) -> str:
    """Return a relative change as ``+51 %``, ``−23 %`` or ``× 2.3``; below 5 %, it is about the same."""
    if abs(change) < SAME:
        return "about the same"
    sign = "−" if change < 0 else "+"
    return f"× {1 + change:.3g}" if change >= 1 else f"{sign}{100 * abs(change):.0f} %"


def relative_change(before: float, after: float) -> float:
    """Return ``after/before − 1``; zero if ``before`` is zero."""
    return after / before - 1 if before > 0 else 0.0


def in_words(change: float) -> str:
    """Return a relative change in words; below 5 %, the quantity is about the same."""
    if abs(change) < SAME:
        return "is about the same"
    size = f"{100 * abs(change):.0f} %" if change < 1 else f"a factor of {1 + change:.3g}"
    return f"{'falls' if change < 0 else 'grows'} by {size}"


def outcome_of(parts: tuple[Change, ...]) -> str:
    """Return the outcome: ``better`` if a quantity falls and none grows, or a text on what falls and grows."""
    grow, fall = _sides([part for part in parts if part.grows]), _sides([part for part in parts if part.falls])
    # If a quantity of an effect falls and another quantity of the effect grows, the effect is reported as growing.
    fall = [side for side in fall if side not in grow]
    if not grow:
        return "better" if fall else "no better"
    if not fall:
        return "worse"
    return f"better for the {_listed(fall)} at the price of {_listed(grow)}"


def _sides(parts: list[Change]) -> list[Side]:
    """Return the effects that the changes belong to, without repetition; ``force`` replaces ``impulse``."""
    sides = list(dict.fromkeys(part.side for part in parts))
    return [side for side in sides if side != "impulse" or "force" not in sides]


def _listed(sides: list[Side]) -> str:
    return sides[0] if len(sides) == 1 else f"{', '.join(sides[:-1])} and {sides[-1]}"
