"""Rows of the table of an impact before and after: keys, units and meanings for terminal and report."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from impact_posture.impact.metric import Metric
    from impact_posture.impact.resolved_impact import ResolvedImpact


class QuantityRow(NamedTuple):
    """A quantity at the initial and at the optimal posture, with its unit and its meaning in a few words.

    ``key`` is its symbol or name.  A value is ``None`` where it is undefined.
    """

    key: str
    before: float | None
    after: float | None
    unit: str
    meaning: str


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


def quantity_rows(impact: ResolvedImpact, initial: dict[str, Any], optimal: dict[str, Any]) -> list[QuantityRow]:
    """Return the rows of the objective, H to E, normal impulse and peak force with friction, and approach speed.

    Unknown quantities have no row.  ``initial`` and ``optimal`` are the blocks of ``result.json``.
    """
    named = quantities(impact.metric)
    kind, per_speed = impact.objective.kind, named[2][1]
    unit = {"impulse": "jump²", "energy": "kg"}.get(kind, per_speed)
    named.insert(0, ("objective", unit, f"what was minimized ({kind})"))
    rows = [QuantityRow(key, initial[key], optimal[key], unit, words) for key, unit, words in named]
    jumps = [block["jump"]["coulomb"] for block in (initial, optimal)]
    forces = [(block["compression"] or {}).get("peak_force") for block in (initial, optimal)]
    at, friction = f"at {impact.speed:g} m/s", f", friction {impact.contact.friction:g}"
    if None not in jumps and impact.speed:
        # Results of earlier versions do not have this number.
        first, last = (jump.get("normal_impulse") for jump in jumps)
        rows.append(QuantityRow("impulse", first, last, "N·s", f"normal impulse {at}{friction}"))
    if None not in forces:
        rows.append(QuantityRow("force", forces[0], forces[1], "N", f"peak normal force {at}{friction}"))
    first, last = (block.get("attainable_speed") for block in (initial, optimal))
    if (first, last) != (None, None):
        rows.append(QuantityRow("approach", first, last, "m/s", "fastest within joint velocity limits"))
    return rows
