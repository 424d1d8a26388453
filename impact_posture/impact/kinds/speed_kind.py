"""The objective type ``speed``: squared velocity jump per squared approach speed, without friction."""

from __future__ import annotations

from impact_posture.impact.kinds.impact_kind import FrictionlessKind


class SpeedKind(FrictionlessKind):
    """``V = H/G²``: squared velocity jump per squared approach speed, without friction."""

    name, symbol = "speed", "V"
    units = "jump² per (m/s)² of approach, frictionless"
    no_cone = "speed is H/G², not a quadratic form of the normal, so its exact worst case over a cone is not known"
