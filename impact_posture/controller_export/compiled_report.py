"""Convert the report of a C controller to a :class:`~impact_posture.tsid.controller.Report`."""

from __future__ import annotations

from collections.abc import Mapping

from impact_posture.controller_export.controller_manifest import Manifest
from impact_posture.system.arrays import Array
from impact_posture.tsid.controller import Report, Status
from impact_posture.tsid.relaxation import Relaxed

# Statuses in the order of their numbers in C.
STATUSES = tuple(Status)


def read_report(manifest: Manifest, status: Status, iterations: int, values: Mapping[str, Array]) -> Report:
    """Return the report of the last tick; ``values`` are the arrays of the C structure ``ip_report`` by name."""
    residuals: dict[str, Array] = {}
    active: list[tuple[str, str]] = []
    if status in (Status.SOLVED, Status.RELAXED):
        start = 0
        for task in manifest.tasks:
            residuals[task.name] = values["rows"][start : start + task.rows].copy()
            start += task.rows
        if manifest.posture is not None:
            residuals[manifest.posture] = values["posture"].copy()
        if manifest.sizes["FORCES"]:
            residuals["contacts"] = values["contacts"].copy()
        first = manifest.sizes["SIMPLE"]
        equations = range(first, first + manifest.sizes["EQUATIONS"])
        for k, (name, multiplier) in enumerate(zip(manifest.bounds, values["multipliers"], strict=True)):
            if multiplier and k not in equations:
                active.append((name, "upper" if multiplier > 0 else "lower"))
    dynamics, level, value = (float(values[name][0]) for name in ("dynamics", "level", "value"))
    names = ("joint limits", *(name for name, _ in manifest.levels))
    relaxed = tuple(Relaxed(n, float(x)) for n, x in zip(names, values["relaxed"], strict=True) if x > 0)
    missed = zip(names[1:], values["deficient"], strict=False)
    deficient = tuple(Relaxed(n, float(x)) for n, x in missed if x > 0)
    return Report(status, relaxed, deficient, residuals, tuple(active), dynamics, level, value, iterations)
