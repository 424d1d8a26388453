"""Conditions under which a verdict holds; the verdict states these conditions before its numbers."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain

from impact_posture.config.json_block import JsonBlock
from impact_posture.impact.elasticity.contact_compression import milliseconds
from impact_posture.impact.evaluation.evaluation import Evaluation
from impact_posture.impact.resolved_impact import ResolvedImpact

# An attainable speed that is below the approach speed by less than this fraction is treated as sufficient, because
# the verdict shows only three digits of both speeds.
_REACHED = 5e-3
# Largest travel of the contact point in the compression time, m, for which the posture is treated as constant.  Up to
# this travel, predicted jumps differ from the simulation by at most 5 %, or 1 % of the approach speed (`make
# study-verdict`).
LONG_TRAVEL = 0.015
# Hint if the joints are too slow for the approach speed and no path with an impact was computed.
_SLOW = "add `approach`, or correct the `speed`"
# A distance between postures (rad, m) up to this value is a rounding error.
_STILL = 1e-6


@dataclass(frozen=True)
class Condition(JsonBlock):
    """One condition of a verdict.

    Attributes:
        key: ``path``, ``arrival``, ``surface``, ``singular``, ``feet``, ``contact point``,
            ``contact time`` or ``start``.
        line: The condition in words, without a full stop.
        hint: What the user can do; empty if there is nothing to do.
        refutes: Whether the verdict has no meaning because this condition does not hold.
    """

    key: str
    line: str
    hint: str = ""
    refutes: bool = False


@dataclass(frozen=True)
class Circumstances:
    """Data of an optimization on which the conditions depend, besides the two predicted impacts.

    Attributes:
        attainable: Highest speed at which the joints can bring the contact to the surface in the optimal posture,
            m/s; ``None`` if unknown or unbounded.
        moved: Distance from the given to the initial posture, rad mixed with m.
        no_path: Why no path leads to the optimum, and where the path ends; empty if it ends at the optimum.
        strikes: Whether ``attainable`` is the speed at the end of a computed path that strikes the surface.
        spread: Tilt, degrees, and shift, m, up to which only the struck links touch the surface, if more was
            required; otherwise ``None``.
    """

    attainable: float | None = None
    moved: float = 0.0
    no_path: str = ""
    strikes: bool = False
    spread: tuple[float, float] | None = None


def conditions(
    impact: ResolvedImpact, before: Evaluation, after: Evaluation, known: Circumstances
) -> tuple[Condition, ...]:
    """Return the conditions of the verdict on the posture of ``after``, the gravest first."""
    parts = _singular(after), _feet(before, after), _touch(impact, after), _long(impact, before, after), _start(known)
    return (*_path(known), *_arrival(impact, known), *_surface(known), *chain.from_iterable(parts))


def _path(known: Circumstances) -> Iterator[Condition]:
    if known.no_path:
        line = f"posture.json is not the optimum but the posture where the path ends: {known.no_path}"
        yield Condition("path", line, "another `posture` to start from may have a path to the optimum")


def _arrival(impact: ResolvedImpact, known: Circumstances) -> Iterator[Condition]:
    if known.attainable is not None and known.attainable < (1 - _REACHED) * impact.speed:
        yield Condition(
            "arrival",
            f"cannot arrive at {impact.speed:g} m/s ({known.attainable:.3g} m/s at most)",
            "lower the `speed`, or free the pose (`contact_pose`)" if known.strikes else _SLOW,
            refutes=True,
        )


def near_surface(tilt: float, shift: float) -> str:
    """Return the text for a surface that other links may touch if its tilt (degrees) or shift (m) is larger."""
    limits = f"tilted by more than {tilt:g}° or shifted by more than {1e3 * shift:g} mm"
    return f"another link may touch the surface first if the surface is {limits}"


def _surface(known: Circumstances) -> Iterator[Condition]:
    if known.spread is not None:
        yield Condition("surface", near_surface(*known.spread), "free the pose (`contact_pose`)")


def _singular(after: Evaluation) -> Iterator[Condition]:
    motion = after.joint_yield
    if motion is not None and motion.singular:
        yield Condition(
            "singular",
            f"the contact direction is singular (the joints move the contact by {motion.along:.2g} m/rad along the "
            f"normal, at most {motion.largest:.2g} m/rad): the impact meets the inertia of the whole robot, "
            "and the joints cannot yield",
        )


def _feet(before: Evaluation, after: Evaluation) -> Iterator[Condition]:
    now = after.standing
    if now is not None and now.moves:
        too = ", before and after" if before.standing is not None and now.line == before.standing.line else ""
        hint = "`keep_contacts` admits only postures whose feet stay"
        yield Condition("feet", f"holds only if the feet stay; {now.line}{too}", hint)


def _touch(impact: ResolvedImpact, after: Evaluation) -> Iterator[Condition]:
    for touch in impact.early_touches(after.q):
        yield Condition("contact point", f"holds only if the contact point touches first; {touch.fact}")


def _long(impact: ResolvedImpact, before: Evaluation, after: Evaluation) -> Iterator[Condition]:
    times = [side.compression.time or 0.0 for side in (before, after) if side.compression is not None]
    time = max(times, default=0.0)
    if impact.speed * time > LONG_TRAVEL:
        travel = f"the surface by {1e3 * impact.speed * time:.0f} mm"
        moved = f"the robot moves during the {milliseconds(time)} of the contact ({travel})"
        yield Condition("contact time", f"{moved}, which the numbers neglect")


def _start(known: Circumstances) -> Iterator[Condition]:
    if known.moved > _STILL:
        yield Condition(
            "start",
            f"the given posture violates the constraints, so 'before' is {known.moved:.3g} (rad, m) away from it",
        )
