"""``impact-posture optimize ROBOT --frame F --normal X Y Z`` or ``impact-posture optimize PROBLEM.toml``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from impact_posture.settings import ProblemSettings
from impact_posture_cli import options
from impact_posture_cli.settings_options import Given, with_settings

if TYPE_CHECKING:
    from impact_posture.posture.problem_settings import Prepared
    from impact_posture.posture.solve import PostureSolution
    from impact_posture.result_folder import Written
    from impact_posture_cli.output import Page

RobotOrProblem = Annotated[
    str,
    typer.Argument(
        metavar="ROBOT|PROBLEM.toml", help="Known name, path to a .urdf, example-robot-data:PATH, or a problem."
    ),
]


@with_settings(ProblemSettings)
def optimize(
    given: Given,
    robot: RobotOrProblem,
    jobs: options.Jobs = 2,
    compile: options.Compile = "auto",
    out: options.Out = None,
    force: options.Force = False,
    no_codegen: options.NoCodegen = False,
    format: options.Formats = None,
    json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Run ``impact-posture optimize``."""
    settings = _settings(robot, given)
    _refuse_idle(given, settings)
    from impact_posture.front_door import PostureProblem
    from impact_posture.front_door import optimize as solve
    from impact_posture.output_folder import check_output
    from impact_posture.posture.problem_settings import prepare
    from impact_posture.result_folder import FORMATS, default_out
    from impact_posture_cli.output import Page, print_json
    from impact_posture_cli.progress import progress

    page = Page(quiet=quiet or json)
    prepared = prepare(settings)
    folder = Path(out) if out else default_out(prepared)
    check_output(folder, force=force, kind="result")
    if not json:
        _announce(page, prepared)
    shown = not (quiet or json)
    with progress("solving", "starts", shown=shown, first="building the expressions") as advance:
        result = solve(
            PostureProblem.of(prepared),
            starts=settings.starts,
            seed=settings.seed,
            jobs=jobs,
            compile=compile,
            progress=advance,
        )
    if settings.tradeoff:
        with progress("solving", "points", shown=shown) as advance:
            result = result.trade_off(settings.tradeoff, compile=compile, progress=advance)
    if not json:
        # Pictures and C code take longer than the answer: nobody waits for it because of them.
        _summarize(page, prepared, result.solution, result.document)
    with progress("drawing" if no_codegen else "drawing and compiling", "files", shown=shown) as advance:
        written = result.save(
            folder,
            force=force,
            codegen=not no_codegen,
            formats=[f.value for f in format or ()] or FORMATS,
            jobs=jobs,
            progress=advance,
        )
    if written.compiler_error:
        page.warnings([f"the C code in c/ is written but could not be built: {written.compiler_error}"])
    if json:
        print_json(result.document)
    elif not quiet:
        page.gap()
        page.line(f"written to {written.out}: {_contents(written)}")


def _settings(robot: str, given: Given) -> ProblemSettings:
    from_file = robot.endswith(".toml")
    if not from_file or "contact" in given.values:
        given.check_contact()
    if not from_file:
        return given.fill(ProblemSettings, robot=robot)
    from impact_posture.posture.problem_settings import read_settings

    return read_settings(Path(robot), given.values)


def _refuse_idle(given: Given, settings: ProblemSettings) -> None:
    """Refuse options that would do nothing beside the others."""
    for name, used, hint in (
        ("box", settings.contact_pose == "box", "--contact-pose box"),
        ("base_box", settings.base == "box", "--base box"),
        ("com_margin", settings.com is not False, "--com"),
        ("friction", settings.keep_contacts, "--keep-contacts"),
    ):
        if name in given.values and not used:
            raise typer.BadParameter(f"does nothing without {hint}", param_hint=f"'--{name.replace('_', '-')}'")


def _announce(page: Page, prepared: Prepared) -> None:
    from impact_posture_cli.output import vector
    from impact_posture_cli.tables import contact_names

    if page.quiet:
        return
    impact, problem = prepared.impact, prepared.problem
    contacts = impact.objective.contacts
    page.title(f"{impact.robot.name} at {', '.join(c.frame for c in contacts)}", f"objective {impact.objective.kind}")
    axes = "world" if impact.contact.normal_frame == "world" else "contact frame"
    degrees = impact.objective.normal_cone_deg
    cone = f", the worst within {degrees:g}° of it" if degrees else ""
    feet = ", ".join(s.frame for s in impact.supports) or "none"
    page.pairs(
        [
            *[
                (f"normal at {name}", f"{vector(c.normal)} ({axes}), up to {c.impulse:g} N·s")
                if impact.objective.others
                else ("normal", f"{vector(c.normal)} ({axes}){cone}")
                for name, c in zip(contact_names(contacts), contacts, strict=True)
            ],
            *([("pull", "as well as push")] if impact.objective.bilateral else []),
            *(
                [("scenarios", "; ".join(s.name for s in scenarios))]
                if (scenarios := impact.objective.scenarios)
                else []
            ),
            ("metric", impact.metric.kind),
            ("supports", feet),
            ("armature from", impact.robot.armature_source),
        ]
    )
    page.gap()
    page.line("constraints")
    for line in problem.describe():
        page.line(f"  {line}")
    for note in problem.notes:
        page.line(f"  ({note})", style="dim")
    page.warnings(impact.warnings)
    page.gap()


def _summarize(page: Page, prepared: Prepared, solution: PostureSolution, document: dict[str, Any]) -> None:
    from impact_posture.posture.notes import percent
    from impact_posture_cli.output import number, worst_normal
    from impact_posture_cli.tables import contact_names, contacts_table, impulses_line, variants_table

    initial, optimal = document["initial"], document["optimal"]
    rows = []
    for key, unit, words in (
        ("objective", "", f"what was minimized ({prepared.impact.objective.kind})"),
        ("H", "", "squared jump per squared impulse"),
        ("G", "1/kg", "inverse effective mass along n"),
        ("V", "", "squared jump per squared speed, no friction"),
        ("S", "", "the same when the contact sticks"),
        ("E", "kg", "energy lost per squared speed"),
    ):
        rows.append((f"  {key}", number(initial[key]), number(optimal[key]), unit, words))
    page.table(("", "before", "after", "unit", "meaning"), rows, right=(1, 2))
    frames = contact_names(prepared.impact.objective.contacts)
    if len(frames) > 1:
        page.line(f"  (H, G, V, S, E: of an impact at {frames[0]} alone)", style="dim")
        contacts_table(page, frames, optimal["by_contact"])
    if "by_scenario" in optimal:
        variants_table(page, [initial, optimal], ["before", "after"])
    page.gap()
    for when, block in (("before", initial), ("after", optimal)):
        if "cone" in block:
            page.line(f"worst normal {when}: {worst_normal(block['cone'], block['worst_normal'])}")
        if "worst_impulses" in block:
            page.line(f"worst impulses {when}: {impulses_line(frames, block['worst_impulses'])}")
    for when, block in (("before", initial), ("after", optimal)):
        for name, feet in _footings(frames, block):
            page.line(f"feet {when}{name}: {feet['verdict']}")
    page.line(f"reduction {percent(solution.reduction)}; {_redundancy(solution.redundancy)} left by the constraints")
    if "robustness" in document:
        page.line(document["robustness"]["line"])
    for note in solution.notes[len(prepared.problem.notes) :]:
        page.line(note)
    if solution.moved > 1e-6:
        page.line(f"the given posture did not satisfy the constraints: moved by {solution.moved:.3g} first")
    if document["active"]:
        page.line("active: " + ", ".join(_active(a) for a in document["active"]))
    found = solution.certificate
    page.line(
        f"certificate ({found.recomputed_with}): stationarity {found.stationarity:.1e}, "
        f"violation {found.primal:.1e}, pose error {found.pose_error_m:.1e} m, {found.pose_error_rad:.1e} rad"
    )
    optima = ", ".join(f"{number(o.objective)} ({o.hits}×)" for o in solution.optima[:5])
    more = f" and {len(solution.optima) - 5} more" if len(solution.optima) > 5 else ""
    page.line(
        f"{solution.certified_starts} of {solution.starts} starts certified in {solution.solve_time_s:.1f} s; "
        f"optima: {optima}{more}"
    )
    if "tradeoff" in document:
        _tradeoff(page, document["tradeoff"], [n for n in document["notes"] if n.startswith("trade-off:")])
    # Those of the robot stood above the solving.
    page.warnings(document["warnings"][len(prepared.impact.warnings) :])


def _footings(frames: list[str], block: dict[str, Any]) -> list[tuple[str, dict[str, Any]]]:
    """Whether the feet stay, under each of several impacts by name."""
    if "by_contact" not in block:
        return [("", block["footing"])] if "footing" in block else []
    pairs = zip(frames, block["by_contact"], strict=True)
    return [(f" (impact at {frame})", one["footing"]) for frame, one in pairs if "footing" in one]


def _tradeoff(page: Page, points: list[dict[str, Any]], notes: list[str]) -> None:
    """What a smaller change would buy."""
    from impact_posture.posture.notes import percent
    from impact_posture_cli.output import number

    page.gap()
    page.line("trade-off: the best posture within a distance from the initial one (rad, mixed with m)")
    first, last = points[0]["objective"], points[-1]["objective"]
    rows = []
    for point in points:
        gain = percent((first - point["objective"]) / (first - last)) if last < first else ""
        marks = (["knee"] if point["knee"] else []) + ([] if point["certified"] else ["not certified"])
        keys = ("objective", "H", "G", "V", "S")
        rows.append((f"  {point['within']:.3f}", gain, *(number(point[key]) for key in keys), ", ".join(marks)))
    head = ("  within", "gain", "objective", "H", "G", "V", "S", "")
    page.table(head, rows, right=range(7))
    for note in notes:
        page.line(note)


def _redundancy(count: int) -> str:
    return "1 degree of freedom" if count == 1 else f"{count} degrees of freedom"


def _active(entry: dict[str, Any]) -> str:
    words = "limit" if entry["constraint"].startswith("joint ") else "bound"
    return f"{entry['constraint']} at its {entry['side']} {words}"


def _contents(written: Written) -> str:
    names = "posture.json, result.json, pictures"
    if written.export is None:
        return names
    if written.compiler_error:
        return f"{names}, C code in c/ (not compiled)"
    if written.export.agreement is None:
        return f"{names}, C code in c/ (no compiler here to try it: install gcc or clang, or set CC)"
    return f"{names}, C code in c/ (compiled, agrees to {written.export.agreement:.0e})"
