"""Print the problem and the result of ``optimize``."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Any

from impact_posture.errors import listed
from impact_posture_cli.impact_tables import alone_line, contact_names, impact_rows, worst_lines, worst_tables
from impact_posture_cli.output import Page, number

if TYPE_CHECKING:
    from impact_posture.posture.formulation.problem_file import Prepared
    from impact_posture.posture.search.multistart import PostureSolution

# Number of actuators in the table of loads: the actuators nearest to their limits.
_TIGHTEST = 3


def announce(page: Page, prepared: Prepared) -> None:
    """Print the impact and the constraints, before the solver starts."""
    if page.quiet or page.json:
        return
    impact, problem = prepared.impact, prepared.problem
    contacts = impact.objective.contacts
    page.title(f"{impact.robot.name} at {', '.join(c.frame for c in contacts)}", f"objective {impact.objective.kind}")
    axes = "world" if impact.contact.normal_frame == "world" else "contact frame"
    degrees, variants = impact.objective.normal_cone_deg, impact.objective.model_variants
    rows = impact_rows(impact, [c.normal for c in contacts], axes)
    if degrees:
        rows.append(("worst normal", f"within {degrees:g}° of the normal"))
    if impact.objective.bilateral:
        rows.append(("pull", "as well as push"))
    if variants:
        rows.append(("model variants", "; ".join(v.name for v in variants)))
    page.pairs(rows)
    if impact.choice:
        page.line(impact.choice)
    page.gap()
    page.line("constraints")
    for line in problem.describe():
        page.line(f"  {line}")
    for note in problem.notes:
        page.line(f"  ({note})", style="dim")
    page.warnings(prepared.warnings)
    page.gap()


def _verdict_lines(verdict: dict[str, Any]) -> list[str]:
    """Return the verdict with one line for each condition and each sentence; all but the first line are indented."""
    text: str = verdict["line"].replace(". ", ".\n  ")
    for condition in verdict["conditions"]:
        text = text.replace(f"{condition['line']}; ", f"{condition['line']};\n  ")
    return text.split("\n")


def summarize(page: Page, prepared: Prepared, solution: PostureSolution, document: dict[str, Any]) -> None:
    """Print the result: verdict, table of values at the start and at the optimum, certificate, trade-off and path."""
    from impact_posture.output.quantity_table import HEAD, answer_key, quantity_rows
    from impact_posture.posture.search.impact_notes import percent

    initial, answer = document["initial"], document[answer_key(document)]
    impact, blocks = prepared.impact, dict(zip(HEAD[1:3], (initial, answer), strict=True))
    for line in _verdict_lines(document["verdict"]):
        page.line(line, style="bold")
    page.line(document["verdict"]["minimized"])
    for line in document["verdict"]["advice"]:
        page.line(f"  {line}")
    page.gap()
    cells = (row.cells(number) for row in quantity_rows(impact, initial, answer))
    rows = [(f"  {key}", *values) for key, *values in cells]
    page.table(HEAD, rows, right=(1, 2))
    frames = contact_names(impact.objective.contacts)
    alone_line(page, frames, ", ".join(row[0].strip() for row in rows if row[0].strip() != "objective"))
    worst_tables(page, frames, blocks)
    page.gap()
    worst_lines(page, frames, blocks)
    _holding(page, initial["holding"], answer["holding"])
    free = f"{solution.redundancy} degree{'' if solution.redundancy == 1 else 's'} of freedom"
    if "reachable" in document:
        share = percent(1 - answer["objective"] / initial["objective"])
        page.line(f"reduction {share} where the path ends; the next lines are about the optimum")
    page.line(f"reduction {percent(solution.reduction)}; {free} remaining under the constraints")
    if "robustness" in document:
        page.line(document["robustness"]["line"])
    for note in solution.notes[len(prepared.problem.notes) :]:
        page.line(note)
    if document["active"]:
        page.line("active: " + ", ".join(dict.fromkeys(_active(a) for a in document["active"])))
    _certificate(page, solution, document.get("collision"))
    _solves(page, solution)
    page.line(document["search"]["line"])
    if "global" in document:
        page.line(document["global"]["line"])
    if "tradeoff" in document:
        _tradeoff(page, document, [n for n in document["notes"] if n.startswith("trade-off:")])
    if "path" in document:
        _path(page, document["path"])
    # The first warnings are not printed again, because they were printed before the solver started.
    page.warnings(document["warnings"][len(prepared.warnings) :])


def _certificate(page: Page, solution: PostureSolution, collision: dict[str, Any] | None) -> None:
    certificate = solution.certificate
    page.line(
        f"certificate ({certificate.recomputed_with}): stationarity {certificate.stationarity:.1e}, "
        f"violation {certificate.primal:.1e}, "
        f"pose error {certificate.pose_error_m:.1e} m, {certificate.pose_error_rad:.1e} rad"
    )
    if collision is not None:
        at, bare = collision["optimal"], len(collision["links_without_shapes"])
        among = f" among the links that have shapes ({bare} ha{'ve' if bare > 1 else 's'} none)" if bare else ""
        page.line(f"no collision{among}; closest: {at['closest']}, {1e3 * at['distance']:.3g} mm")


def _solves(page: Page, solution: PostureSolution) -> None:
    """Print the number of certified solves, and each optimum with the number of solves that ended there."""
    # Count optima by their printed values, because the values of mirrored postures differ only by rounding errors.
    hits = Counter[str]()
    for optimum in solution.optima:
        hits[number(optimum.objective)] += optimum.hits
    optima = listed([f"{value} ({count}×)" for value, count in hits.items()])
    left = solution.dominated_starts
    page.line(
        f"{solution.certified_starts} of {solution.starts} solves by IPOPT certified "
        f"in {solution.solve_time_s:.1f} s; "
        + (f"{left} stopped early (--finish-all finishes them); " if left else "")
        + f"optima: {optima}"
    )


def _holding(page: Page, before: dict[str, Any] | None, after: dict[str, Any] | None) -> None:
    """Print, for each load, the actuators that are nearest to their limits."""
    if before is None or after is None:
        return
    rows = []
    for old, new in zip((before, *before["other_loads"]), (after, *after["other_loads"]), strict=True):
        shares = {name: (load["share"], new["actuators"][name]["share"]) for name, load in old["actuators"].items()}
        for name in sorted(shares, key=lambda name: -max(shares[name]))[:_TIGHTEST]:
            used = (f"{share:.0%}" for share in shares[name])
            load = new["actuators"][name]
            rows.append((f"  {name}", *used, f"{number(load['low'])} to {number(load['high'])}", new["load"]))
    page.line("share of the limits of the actuators that hold the posture (0% is mid-range)")
    page.table(("", "before", "after", "range, N·m or N", ""), rows, right=(1, 2))
    page.gap()


def _tradeoff(page: Page, document: dict[str, Any], notes: list[str]) -> None:
    from impact_posture.posture.search.impact_notes import percent

    points = document["tradeoff"]
    page.gap()
    digits = 3 if document["tradeoff_against"] == "distance" else 1
    bound = {"distance": "a distance from the initial posture (rad, mixed with m)", "force": "a peak force (N)"}
    page.line(f"trade-off: the best posture within {bound[document['tradeoff_against']]}")
    first, last = points[0]["objective"], points[-1]["objective"]
    rows = []
    for point in points:
        gain = percent((first - point["objective"]) / (first - last)) if last < first else ""
        marks = (["knee"] if point["knee"] else []) + ([] if point["certified"] else ["not certified"])
        keys = ("objective", "H", "G", "V", "S")
        rows.append(
            (f"  {point['within']:.{digits}f}", gain, *(number(point[key]) for key in keys), ", ".join(marks))
        )
    page.table(("  within", "gain", "objective", "H", "G", "V", "S", ""), rows, right=range(7))
    for note in notes:
        page.line(note)


def _path(page: Page, path: dict[str, Any]) -> None:
    from impact_posture.path.follow_through import FACTORS, RESTITUTIONS
    from impact_posture.path.strike import FREE_FALL

    page.gap()
    end = "the optimum" if path["found"] else f"objective {number(path['objective'])}"
    limit = path["limits"].get("active")
    bound = f", bound by {limit}" if limit else ""
    if path["points"] > 1:
        page.line(
            f"path to {end} by {path['method']}: {path['length']:.3g} rad (m) in {path['duration_s']:.3g} s"
            f" ({path['timing']}{bound}), violation {path['max_violation']:.1e}"
        )
    else:
        page.line("path: the start is the optimum" if path["found"] else "path: no path leads away from the start")
    if strike := path.get("strike"):
        falls = path["timing"] == FREE_FALL
        begins = "that begins without a rest" if strike["rest_s"] < strike["run_up_s"] else "from rest"
        page.line(
            f"  strikes at {number(strike['speed'])} m/s, with {strike['share']:.0%} of the velocity limits, after a "
            f"{'fall' if falls else 'run-up'} of {1e3 * strike['run_up_m']:.3g} mm {begins} at "
            f"{strike['run_up_s']:.3g} s"
        )
        if strike["hindrance"]:
            page.line(f"  {number(strike['stated_speed'])} m/s is not possible, because of {strike['hindrance']}")
        after = strike["follow_through"]
        stops = f"then stops within {number(after['longest_s'])} s after {after['stopped']}"
        # The feet of a robot that falls are pressed onto the ground, so only plastic impacts are considered.
        rebounds = "" if falls else f" to {RESTITUTIONS[-1]:g}"
        alone = 1 + len(FACTORS) * (1 if falls else len(RESTITUTIONS))
        normals = ", also along normals on the edge of the cone" if after["impacts"] > alone else ""
        page.line(
            f"  {stops if after['stopped'] else 'no stop along the velocity exists after any'} of {after['impacts']} "
            f"considered impacts (restitution {RESTITUTIONS[0]:g}{rebounds}, "
            f"{FACTORS[0]:.0%} to {FACTORS[-1]:.0%} of the speed{normals})"
        )
        for what, unit, room in (
            ("from a joint limit", "rad (m)", after["joints"]),
            ("between bodies, beyond the clearance,", "m", after["clearance"]),
            ("of the center of pressure from an edge of the support polygon", "m", after["center_of_pressure"]),
        ):
            if room:
                where = "" if room is after["center_of_pressure"] else f" {room['of']},"
                at = f"{number(room['distance'])} {unit}:{where} after {room['impact']}"
                page.line(f"  the least distance {what} is {at}")
        if after["hindrance"]:
            page.line(f"  {after['hindrance']}")
    # If the path does not reach the optimum, the verdict states the reason.
    if path["found"] and path["reason"]:
        page.line(f"  {path['reason']}")


def _active(entry: dict[str, Any]) -> str:
    name = entry["constraint"]
    if " / " in name:
        return f"{name} at their least distance"
    return f"{name} at its {entry['side']} {'limit' if name.startswith('joint ') else 'bound'}"
