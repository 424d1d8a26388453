"""``impact-posture verify ROBOT``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from impact_posture.config.demand import Direction, Vector3
from impact_posture.config.problem_settings import ImpactSettings
from impact_posture.config.setting import CONTACT, OUTPUT
from impact_posture_cli import options
from impact_posture_cli.output import Page, complain, print_json
from impact_posture_cli.settings_options import TypedSettings, demanding, with_settings

if TYPE_CHECKING:
    from impact_posture.impact.resolved_impact import ResolvedImpact
    from impact_posture.verification.verification import VerificationRow

NormalOfFirst = Annotated[
    Vector3 | None,
    options.option(
        "--normal", CONTACT, "Normal of the first sample; the other normals are random.", metavar="X Y Z",
        callback=demanding(Direction), show_default="0 0 1",
    ),
]  # fmt: skip
Samples = Annotated[int, options.option("--samples", OUTPUT, "Number of random postures and normals.", min=1)]
SampleSeed = Annotated[int, options.option("--seed", OUTPUT, "Seed of the random samples.", min=0)]


_WITHOUT = {
    "bilateral", "impulse", "speed", "restitution", "objective", "normal_cone", "armature_range", "payload", "posture"
}  # fmt: skip


@with_settings(ImpactSettings, without=_WITHOUT, normal=NormalOfFirst)
def verify(
    typed: TypedSettings,
    robot: options.RobotOrResult,
    samples: Samples = 10,
    seed: SampleSeed = 0,
    json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    from_result = typed.is_result(robot, {"samples", "seed"})
    if "contact" in typed.values:
        typed.check_contact()
    from impact_posture.impact.resolved_impact import resolve
    from impact_posture.verification.verification import verify as verify_objective

    normal = {} if "contact" in typed.values else {"normal": typed.values.get("normal", (0.0, 0.0, 1.0))}
    impact = _of_result(Path(robot)) if from_result else resolve(typed.fill(ImpactSettings, robot=robot, **normal))
    page = Page(json=json, quiet=quiet)
    with page.progress("comparing") as advance:
        report = verify_objective(impact.objective.singles[0], samples, seed, advance)
    if json:
        asked = {key: value for key, value in impact.to_dict().items() if key != "metric"}
        measure = {"name": impact.metric.kind, "weights": impact.metric.weights}
        document = {"schema": "impact-posture/verification/1", **asked, "metric": measure, **report.to_dict()}
        print_json(document | {"warnings": list(impact.warnings)})
    else:
        feet = f", standing on {len(impact.supports)}" if impact.supports else ""
        postures = "posture" if len(report.samples) == 1 else "postures"
        page.title(
            f"{impact.robot.name} at {impact.contact.frame}{feet}",
            f"against Pinocchio at {len(report.samples)} random {postures}, seed {report.seed}",
        )
        head = ("way", "", "largest error", "allowed", "", "where")
        page.table(head, [_cells(row) for row in report.rows], right=(2, 3), fold=5)
        others = ", ".join(contact.frame for contact in impact.objective.others)
        page.warnings([*impact.warnings, others and f"{impact.contact.frame} alone is compared, not {others}"])
    if not report.passed:
        failed = [row for row in report.rows if row.verdict == "fail"]
        named = ", ".join(" ".join(filter(None, (row.source, row.quantity))) for row in failed)
        complain(f"error: {impact.robot.name}: numbers differ from Pinocchio: {named}; please report it")
        raise typer.Exit(1)


def _of_result(folder: Path) -> ResolvedImpact:
    from impact_posture.impact.resolved_impact import ResolvedImpact
    from impact_posture.output.result_reader import load_view

    view = load_view(folder)
    return ResolvedImpact(view.objective, view.q_optimal, "the posture of the result", view.speed, view.restitution)


def _cells(row: VerificationRow) -> tuple[str, ...]:
    if row.tolerance is None:
        return row.source, "", "", "", row.verdict, row.note
    error = row.note if row.error is None else f"{row.error:.1e}"
    where = ", ".join(filter(None, (f"sample {row.sample}", row.entry)))
    return row.source, row.quantity, error, f"{row.tolerance:.0e}", row.verdict, where
