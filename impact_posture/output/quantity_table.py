"""Rows of the table of an impact at start and optimum: keys, units and meanings for terminal and report."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from impact_posture.impact.metric import Metric
    from impact_posture.impact.resolved_impact import ResolvedImpact

HEAD = ("", "before", "after", "unit", "meaning")
"""Headers of the table."""


class QuantityRow(NamedTuple):
    """A quantity at the initial and at the optimal posture, with its unit and its meaning in a few words.

    ``key`` is the symbol or name of the quantity.  A value is ``None`` where it is undefined.
    """

    key: str
    before: float | None
    after: float | None
    unit: str
    meaning: str

    def cells(self, number: Callable[[float | None], str]) -> tuple[str, ...]:
        """Return the row as texts in the order of :data:`HEAD`; ``number`` formats a value."""
        return self.key, number(self.before), number(self.after), self.unit, self.meaning


def quantities(metric: Metric) -> list[tuple[str, str, str]]:
    """Return key, unit and meaning of H, G, V, S and E in a metric."""
    kinetic = metric.kind == "kinetic"
    per_impulse, per_speed = ("1/kg", "kg") if kinetic else ("jump²/(N·s)²", "jump²/(m/s)²")
    return [
        ("H", per_impulse, "jump² per impulse²"),
        ("G", "1/kg", "inverse effective mass along n"),
        ("V", per_speed, "jump² per speed², no friction"),
        ("S", per_speed, "the same when the contact sticks"),
        ("E", "kg", "energy lost per speed², e = 0"),
    ]


def answer_key(document: dict[str, Any]) -> str:
    """Return the key of a ``result.json`` that describes the posture of ``posture.json``."""
    return "reachable" if "reachable" in document else "optimal"


def quantity_rows(impact: ResolvedImpact, initial: dict[str, Any], optimal: dict[str, Any]) -> list[QuantityRow]:
    """Return the rows of the table with the values at the start and at the optimum.

    The first rows state the effects on base, joints and contact at the given speed and friction.  The next rows are
    the fastest approach, the norm of the jump, the objective, and H, G, V, S and E.  Unknown quantities have no row.
    ``initial`` and ``optimal`` are the blocks of ``result.json``.
    """
    named = quantities(impact.metric)
    kind, per_speed = impact.objective.kind, named[2][1]
    unit = {"impulse": "jump²", "energy": "kg", "effective-mass": "kg"}.get(kind, per_speed)
    named.insert(0, ("objective", unit, f"what was minimized ({kind})"))
    rows = _felt_rows(impact, initial, optimal) if impact.speed else []
    first, last = (block.get("attainable_speed") for block in (initial, optimal))
    if (first, last) != (None, None):
        rows.append(QuantityRow("approach", first, last, "m/s", "fastest within joint velocity limits"))
    first, last = ((block["jump"]["coulomb"] or {}).get("norm") for block in (initial, optimal))
    if impact.speed and None not in (first, last):
        rows.append(QuantityRow("‖Δν‖", first, last, "jump", "base and joints in one norm"))
    return [*rows, *(QuantityRow(key, initial[key], optimal[key], unit, words) for key, unit, words in named)]


def _felt_rows(impact: ResolvedImpact, initial: dict[str, Any], optimal: dict[str, Any]) -> list[QuantityRow]:
    at = f"at {impact.speed:g} m/s, friction {impact.contact.friction:g}"
    rows, jumps = list[QuantityRow](), [block["jump"]["coulomb"] for block in (initial, optimal)]
    # The ``result.json`` of earlier versions has neither effects nor normal impulses.
    effects: list[dict[str, Any]] = [(jump or {}).get("effect") or {} for jump in jumps]
    if all(effects):
        pairs = [(f"base {key}", f"base_{key}", unit) for key, unit in (("linear", "m/s"), ("angular", "rad/s"))]
        for name, key, unit in pairs:
            rows += _row(name, [effect[key] for effect in effects], unit, f"jump of the base {at}")
        joints = [effect["joint"] or {} for effect in effects]
        names = " → ".join(dict.fromkeys(joint.get("name", "") for joint in joints))
        velocities, unit = [joint.get("velocity") for joint in joints], joints[0].get("unit", "")
        rows += _row("joint", velocities, unit, f"worst: {names}")
        shares = [joint.get("share") for joint in joints]
        percent = [None if share is None else 100 * share for share in shares]
        rows += _row("joint share", percent, "%", "of its velocity limit")
        rows += _row("impulse", [jump["normal_impulse"] for jump in jumps], "N·s", f"normal impulse {at}")
    forces = [(block["compression"] or {}).get("peak_force") for block in (initial, optimal)]
    return [*rows, *_row("force", forces, "N", f"peak normal force {at}")]


def _row(key: str, values: list[Any], unit: str, meaning: str) -> list[QuantityRow]:
    """Return a row with the two ``values``, or no row if a value is unknown."""
    return [] if None in values else [QuantityRow(key, values[0], values[1], unit, meaning)]
