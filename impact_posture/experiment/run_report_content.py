"""Texts and tables in the reports of runs and comparisons."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from impact_posture.experiment.jobs import Document, Job, controller_factory
from impact_posture.experiment.seed_statistics import Interval, headline, statistic
from impact_posture.output.plot.result_view import number
from impact_posture.output.plot.run_view import RunView, run_header
from impact_posture.output.report.report_page import Content, Table
from impact_posture.simulation.metrics import AFTER_TOUCH, UNTIL_RECOVERY
from impact_posture.system.folder_record import typed_command

# Metrics in the table of a report: key, unit and meaning.
_METRICS = (
    ("q_total_impact", "m, rad", "motion of the robot in the impact windows, ∫‖ν‖dt"),
    ("q_total_recovery", "m, rad", f"as q_total_impact, {UNTIL_RECOVERY}"),
    ("peak_jump", "m/s, rad/s", f"largest ‖ν − ν⁻‖ within {AFTER_TOUCH}, mean of the contacts"),
    ("peak_jump_max", "m/s, rad/s", "as peak_jump, but the largest of all contacts"),
    ("peak_recovery", "m/s, rad/s", f"as peak_jump, {UNTIL_RECOVERY}"),
    ("peak_force", "N", "largest normal force in the impact windows"),
    ("slip", "m", "distance that the contact slid in the impact windows"),
)
# Effects on base, joints and contact just after the robot touches the surface: key, unit and meaning.
_LOADS = (
    ("base_linear", "m/s", "largest change of the base's linear velocity, mean of the contacts"),
    ("base_angular", "rad/s", "largest change of the base's angular velocity, mean of the contacts"),
    (
        "joint_velocity",
        "",
        "largest change of velocity of the worst joint, which has the largest share of its velocity limit",
    ),
    ("joint_share", "", "joint_velocity, as a fraction of the joint's velocity limit"),
    ("impulse", "N·s", "impulse of the contact along the normal, mean of the contacts"),
)
# Metrics with another meaning in push scenarios: key → meaning.
_PUSH_MEANINGS = {
    "peak_jump": "largest ‖ν‖ from a push on until its window ends, mean of the pushes",
    "peak_jump_max": "as peak_jump, but the largest of all pushes",
    "peak_recovery": f"as peak_jump, {UNTIL_RECOVERY.replace('impact', 'push')}",
    "peak_force": "the push",
    "slip": "distance that the fastest foot slid in the impact windows",
}
# Time between two ticks that a report shows, s: ``FINE`` within impact windows, ``COARSE`` outside impact windows.
FINE, COARSE = 0.001, 0.025
_MOVES = (
    f"The slider selects the time: every {1e3 * FINE:g} ms within the impact windows, every {1e3 * COARSE:g} ms "
    "elsewhere. Within a window, the orange arrows show the change of velocity since the window began. H, V, S and "
    "the ellipsoid are values of the rigid model at the state of the robot."
)


def run_content(folder: Path, document: Document, view: RunView, job: Job) -> Content:
    """Return the texts and the table of the report about one run."""
    scenario = controller_factory(job.scenario, job.free, job.seed).setup.scenario
    options = ["simulate", job.scenario, "--controller", job.controller, "--seed", str(job.seed)]
    options += ["--mode", "held"] * (job.mode == "held") + ["--free"] * job.free
    options += ["--gain", f"{job.gain:g}"] * (job.gain != scenario.control.robust.gain)
    if scenario.push and len(document["runs"]) < len(scenario.push.signs):
        options += ["--sign", f"{document['runs'][0]['sign']:+d}"]
    metrics, status = document["metrics"], document["status"]
    verdict = [f"{status}: do not use its numbers" if metrics is None else f"{status}: {_summary(metrics)}"]
    verdict += [f"t = {event['time']:.2f} s: {event['what']}" for event in document["events"]]
    wanted = [] if metrics is None else table_metrics(view)
    rows = [(key, number(metrics[key]), unit, words) for key, unit, words in wanted]
    tables = []
    if document["prediction"] is not None:
        H = number(document["prediction"]["H"])
        rows.append(("H before", H, "jump²/(N·s)²", "jump² per impulse² at the impacts"))
        if loads := load_rows(document["prediction"]):
            e = document["prediction"].get("restitution")
            law = "" if e is None else f" (prediction with the restitution {number(e)} of the contact law)"
            title = "In the pushes" if view.pushed else f"Within {AFTER_TOUCH}{law}"
            tables.append(Table(title, ("", "measured", "rigid prediction", "unit", "meaning"), tuple(loads)))
    return Content(
        title=run_header([view])[0],
        command=typed_command(folder) or shlex.join(["impact-posture", *options]),
        facts=tuple(run_header([view])[1]),
        verdict=tuple(verdict),
        tables=(Table("Metrics", ("", "value", "unit", "meaning"), tuple(rows)), *tables),
        moves=_MOVES,
        notes=tuple(document["warnings"]),
    )


def table_metrics(view: RunView) -> list[tuple[str, str, str]]:
    """Return key, unit and meaning of each metric in the table of a report."""
    meanings = _PUSH_MEANINGS if view.pushed else {}
    return [(key, unit, meanings.get(key, meaning)) for key, unit, meaning in _METRICS]


def load_rows(prediction: Mapping[str, Any]) -> list[tuple[str, str, str, str, str]]:
    """Return key, measured and predicted value, unit and meaning of each known effect on base, joints and contact."""
    # Runs of older versions do not contain the loads.
    if prediction.get("measured_impact") is None:
        return []
    measured, predicted = (_load_cells(prediction[f"{key}_impact"]) for key in ("measured", "predicted"))
    rows = [(key, measured[key], predicted[key], unit, meaning) for key, unit, meaning in _LOADS]
    return [row for row in rows if row[1] != "–"]


def _load_cells(load: Mapping[str, Any]) -> dict[str, str]:
    joint = load["joint"]
    cells = {key: "–" if load.get(key) is None else number(load[key]) for key, *_ in _LOADS}
    if joint is not None:
        cells["joint_velocity"] = f"{joint['name']}: {number(joint['velocity'])} {joint['unit']}"
        cells["joint_share"] = "–" if joint["share"] is None else number(joint["share"])
    return cells


def _summary(metrics: Mapping[str, Any]) -> str:
    jump, force = number(metrics["peak_jump"]), number(metrics["peak_force"])
    return f"the impacts change the velocity by up to {jump} (m/s and rad/s), with forces of up to {force} N"


def comparison_content(folder: Path, document: Document, view: RunView) -> Content:
    """Return the texts and the table of the report about a comparison.  ``view`` may be any run of the comparison."""
    rows = document["rows"]
    labels = [str(row["controller"]) for row in rows]
    table = [("status", *(str(row["status"]) for row in rows), "", "")]
    for key, unit, meaning in (*table_metrics(view), *_LOADS):
        table.append((key, *(_mean(row["metrics"].get(key)) for row in rows), unit, meaning))
    joints = [(row.get("joint") or {}).get("name", "–") for row in rows]
    table.append(("joint", *joints, "", "the worst joint of any run"))
    nominal = next((row for row in rows if row["controller"] == "nominal"), None)
    compared = [row for row in rows if row["reduction"] is not None and row is not nominal]
    lines = ["No reduction is known."] if nominal is None or not compared else [
        "Within the impact windows, compared with nominal:", *(headline(row, nominal) for row in compared)
    ]  # fmt: skip
    seeds = len(document["seeds"])
    means = statistic(seeds, [Interval(**interval) for row in rows for interval in row["metrics"].values()])
    command = ["impact-posture", "compare", view.scenario, "--controllers", ",".join(labels), "--seeds", str(seeds)]
    return Content(
        title=f"{document['scenario']}: {', '.join(labels)}",
        command=typed_command(folder) or shlex.join(command),
        facts=tuple(run_header([view])[1]),
        verdict=(*lines, *(f"{row['controller']}: {reason}" for row in rows for reason in row["failed"])),
        tables=(Table(means.capitalize(), ("", *labels, "unit", "meaning"), tuple(table)),),
        moves=f"{_MOVES} The runs have the first seed.",
        notes=(),
    )


def _mean(interval: Mapping[str, Any] | None) -> str:
    """Return a mean as text, with the half width of its interval if :attr:`Interval.shown` is not ``None``."""
    if interval is None:
        return "–"
    half = Interval(**interval).shown
    return number(interval["mean"]) + ("" if half is None else f" ± {number(half)}")
