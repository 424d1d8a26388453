"""``impact-posture verify ROBOT``."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from impact_posture_cli import options
from impact_posture_cli.checks import Three, direction

if TYPE_CHECKING:
    from impact_posture.impact.request import ResolvedImpact
    from impact_posture.verification.verification_report import Row, VerificationReport

NormalOfFirst = Annotated[
    Three | None,
    typer.Option(
        "--normal", metavar="X Y Z", callback=direction, rich_help_panel=options.CONTACT,
        show_default="0 0 1", help="Normal of the first sample; the others' are random.",
    ),
]  # fmt: skip
Samples = Annotated[
    int,
    typer.Option("--samples", min=1, rich_help_panel=options.OUTPUT, help="Random postures and normals."),
]
SampleSeed = Annotated[
    int, typer.Option("--seed", min=0, rich_help_panel=options.OUTPUT, help="Seed of the random samples.")
]


# What a result folder leaves to be said.
_FREE = {"robot", "samples", "seed", "json", "quiet"}


def verify(
    context: typer.Context,
    robot: options.RobotOrResult,
    frame: options.Frame = None,
    normal: NormalOfFirst = None,
    offset: options.Offset = None,
    normal_frame: options.NormalAxes = "world",
    contact: options.ContactText = None,
    metric: options.MetricName = "euclidean",
    weights: options.Weights = None,
    support: options.SupportList = None,
    no_support: options.NoSupport = False,
    lock: options.Lock = None,
    lock_massless: options.LockMassless = False,
    root: options.Root = None,
    armature: options.Armature = None,
    config: options.Config = None,
    srdf: options.Srdf = None,
    package_dir: options.PackageDirs = None,
    samples: Samples = 10,
    seed: SampleSeed = 0,
    json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Compute H, G, Λ_c and ∇H in every way there is and compare: pass or fail."""
    from_result = options.is_result(robot)
    if from_result:
        options.refuse_beside_result(context, _FREE)
    from impact_posture_cli.impact_options import impact_request

    if contact is None and normal is None:
        normal = (0.0, 0.0, 1.0)
    contacts = [contact] if contact else None
    request = impact_request(
        robot, frame=frame, normal=normal, offset=offset, normal_frame=normal_frame, contact=contacts, impulse=1.0,
        posture=None, support=support, no_support=no_support, metric=metric, weights=weights, objective="impulse",
        normal_cone=0.0, speed=1.0, restitution=0.0, root=root, package_dir=package_dir, srdf=srdf, config=config,
        armature=armature, lock=lock, lock_massless=lock_massless,
    )  # fmt: skip
    from impact_posture.verification.verification import verify as verify_objective
    from impact_posture_cli.output import Page, complain, print_json
    from impact_posture_cli.progress import progress_bar

    impact = _of_result(Path(robot)) if from_result else request.resolve()
    with progress_bar("comparing", shown=not (quiet or json)) as progress:
        report = verify_objective(impact.objective.singles[0], samples, seed, progress)
    if json:
        asked = {key: value for key, value in impact.to_dict().items() if key != "metric"}
        measure = {"name": impact.metric.kind, "weights": impact.metric.weights}
        document = {"schema": "impact-posture/verification/1", **asked, "metric": measure, **report.to_dict()}
        print_json(document | {"warnings": list(impact.warnings)})
    else:
        page = Page(quiet=quiet)
        _asked(page.title, impact, report)
        page.table(
            ("way", "", "largest error", "allowed", "", "where"),
            [_cells(row) for row in report.rows],
            right=(2, 3),
            fold=5,
        )
        page.warnings(impact.warnings)
        others = [contact.frame for contact in impact.objective.others]
        page.warnings([f"{impact.contact.frame} alone is compared, not {', '.join(others)}"] if others else [])
    if not report.passed:
        failed = [row for row in report.rows if row.verdict == "fail"]
        named = ", ".join(" ".join(filter(None, (row.source, row.quantity))) for row in failed)
        complain(f"error: {impact.robot.name}: other numbers than Pinocchio's: {named}; please report it")
        raise typer.Exit(1)


def _of_result(folder: Path) -> ResolvedImpact:
    """The impact that a result folder is about, at its optimum."""
    from impact_posture.impact.request import ResolvedImpact
    from impact_posture.job import load_view

    view = load_view(folder)
    return ResolvedImpact(view.objective, view.q_optimal, "the result's optimum", view.speed, view.restitution)


def _asked(title: Callable[[str, str], None], impact: ResolvedImpact, report: VerificationReport) -> None:
    feet = f", standing on {len(impact.supports)}" if impact.supports else ""
    count = len(report.samples)
    title(
        f"{impact.robot.name} at {impact.contact.frame}{feet}",
        f"against Pinocchio at {count} random posture{'s' if count > 1 else ''}, seed {report.seed}",
    )


def _cells(row: Row) -> tuple[str, ...]:
    if row.tolerance is None:
        return row.source, "", "", "", row.verdict, row.note
    error = row.note if row.error is None else f"{row.error:.1e}"
    where = ", ".join(filter(None, (f"sample {row.sample}", row.entry)))
    return row.source, row.quantity, error, f"{row.tolerance:.0e}", row.verdict, where
