"""``impact-posture evaluate ROBOT --frame F --normal X Y Z``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from impact_posture.settings import ImpactSettings
from impact_posture_cli import options
from impact_posture_cli.settings_options import Given, with_settings

if TYPE_CHECKING:
    from impact_posture.impact.classical_ellipsoids import Ellipsoid
    from impact_posture.impact.evaluation import Evaluation
    from impact_posture.impact.resolved_impact import ResolvedImpact
    from impact_posture_cli.output import Page


@with_settings(ImpactSettings)
def evaluate(
    given: Given,
    robot: options.RobotName,
    json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Run ``impact-posture evaluate``."""
    given.check_contact()
    from impact_posture.impact.classical_ellipsoids import classical_ellipsoids
    from impact_posture.impact.evaluation import evaluate as evaluate_impact
    from impact_posture.impact.resolved_impact import resolve
    from impact_posture_cli.output import Page, print_json
    from impact_posture_cli.tables import alone_line, contact_names, contacts_table, impulses_line, variants_table

    impact = resolve(given.fill(ImpactSettings, robot=robot))
    found = evaluate_impact(impact.objective, impact.q, impact.speed, impact.restitution)
    warnings = (*impact.warnings, *found.warnings)
    classical = classical_ellipsoids(impact.objective, impact.q)
    if json:
        document = {"schema": "impact-posture/evaluation/1", "posture": impact.posture, **impact.to_dict()}
        document["evaluation"] = found.to_dict()
        document["classical"] = {name: ellipsoid.to_dict() for name, ellipsoid in classical.items()}
        document["warnings"] = list(warnings)
        print_json(document)
        return
    page = Page(quiet=quiet)
    frames = contact_names(impact.objective.contacts)
    _asked(page, impact, found)
    _scalars(page, impact, found)
    if found.contacts:
        alone_line(page, frames)
    _ellipsoids(page, impact, {"impact Λ_c": found.ellipsoid, **classical})
    _gradient(page, impact, found)
    _jumps(page, impact, found)
    block = found.to_dict()
    if found.contacts:
        contacts_table(page, frames, block["by_contact"])  # type: ignore[arg-type]
    if found.scenarios:
        variants_table(page, [block], ["value"])
    page.gap()
    page.line(found.dominance.line)
    if found.impulses is not None:
        page.line(f"worst impulses: {impulses_line(frames, found.impulses.to_dict())}")
    for name, one in zip(frames, found.contacts or (found,), strict=True):
        if one.footing is not None:
            page.line(f"feet{f' (impact at {name})' if found.contacts else ''}: {one.footing.line}")
    page.warnings(warnings)


def _asked(page: Page, impact: ResolvedImpact, found: Evaluation) -> None:
    from impact_posture_cli.output import vector, worst_normal
    from impact_posture_cli.tables import contact_names

    contact, metric = impact.contact, impact.metric
    turned = ", given in the contact frame" if contact.normal_frame == "contact" else ""
    rows = [
        ("posture", impact.posture),
        *[
            (f"normal at {name}" if found.contacts else "normal",
             f"{vector(evaluation.normal)} (world{turned})"
             + (f", up to {one.impulse:g} N·s" if found.contacts else ""))
            for name, one, evaluation in zip(
                contact_names(impact.objective.contacts), impact.objective.contacts,
                found.contacts or (found,), strict=True,
            )
        ],
    ]  # fmt: skip
    if found.cone is not None:
        rows.append(("worst normal", worst_normal(found.cone.to_dict(), found.worst_normal)))
    if any(contact.offset):
        offset = ", ".join(f"{v:g}" for v in contact.offset)
        rows.append(("contact point", f"{offset} m from {contact.frame}, in its axes"))
    if impact.supports:
        feet = ", ".join(f"{s.frame} ({s.kind})" for s in impact.supports)
        rows.append(("supports", f"{feet}; compliance {impact.objective.compliance:.3g} 1/kg"))
    else:
        rows.append(("supports", "none"))
    rows.append(("metric", f"{metric.kind} ({metric.source})" if metric.source else metric.kind))
    rows.append(("armature from", impact.robot.armature_source))
    page.title(f"{impact.robot.name} at {', '.join(c.frame for c in impact.objective.contacts)}")
    page.pairs(rows)


def _scalars(page: Page, impact: ResolvedImpact, found: Evaluation) -> None:
    from impact_posture_cli.output import number

    kinetic = impact.metric.kind == "kinetic"
    per_impulse, per_speed = ("1/kg", "kg") if kinetic else ("jump²/(N·s)²", "jump²/(m/s)²")
    meaning = (
        ("H", per_impulse, "jump² per impulse²"),
        ("G", "1/kg", "inverse effective mass along n"),
        ("V", per_speed, "jump² per approach speed², no friction"),
        ("S", per_speed, "the same when the contact sticks"),
        ("E", "kg", "energy lost per approach speed², e = 0"),
    )
    mine, free = found.scalars.to_dict(), found.free.to_dict() if found.free is not None else None
    mass = (found.scalars.effective_mass, None if found.free is None else found.free.effective_mass)
    rows = [
        (f"  {key}", number(mine[key]), *(() if free is None else (number(free[key]),)), unit, words)
        for key, unit, words in meaning
    ]
    masses = [number(value, missing="unbounded") for value in (mass if free is not None else mass[:1])]
    rows.append(("  1/G", *masses, "kg", "effective mass along n"))
    page.gap()
    values = ("value",) if free is None else ("standing", "free")
    page.table(("", *values, "unit", "meaning"), rows, right=tuple(range(1, 1 + len(values))))
    letters = {"impulse": f"λ̄²H, λ̄ = {impact.contact.impulse:g} N·s", "speed": "V", "sticking": "S", "energy": "E"}
    kind = impact.objective.kind
    if impact.objective.others:
        letters["impulse"] = "the largest ‖Δν‖² within the bounds on the impulses"
    worst = f", worst within {cone:g}° of n" if (cone := impact.objective.normal_cone_deg) else ""
    if count := len(found.scenarios):
        worst += f", worst of {count} scenarios"
    page.line(f"  objective {kind} ({letters[kind]}{worst}): {number(found.objective)}")
    if not kinetic:
        weighed = "weighted" if impact.metric.kind == "weighted" else "alike"
        page.line(f"  jump: ‖Δν‖, m/s and rad/s {weighed} in one norm", style="dim")


def _ellipsoids(page: Page, impact: ResolvedImpact, ellipsoids: dict[str, Ellipsoid]) -> None:
    from impact_posture_cli.output import number, vector

    units = {"velocity": "m/s of |ν| = 1", "force": "N of |τ| = 1"}
    kinetic = impact.metric.kind == "kinetic"
    rows = []
    for name, ellipsoid in ellipsoids.items():
        for k, radius in enumerate(ellipsoid.finite_radii):
            unit = units.get(name, "kg^-1/2" if kinetic else "jump/(N·s)") if k == 0 else ""
            axis = vector(ellipsoid.axes[:, k])
            rows.append((f"  {name}" if k == 0 else "", number(radius, missing="endless"), unit, axis))
    page.gap()
    page.table(("  ellipsoid", "radius", "unit", "axis, world"), rows, right=(1, 3))


def _gradient(page: Page, impact: ResolvedImpact, found: Evaluation) -> None:
    from impact_posture.impact.velocity_jump import largest_entries
    from impact_posture_cli.output import number

    page.gap()
    rows = [
        (f"  {name}", number(value), "per m" if unit == "m/s" else "per rad")
        for name, value, unit in largest_entries(impact.robot, found.gradient)
    ]
    page.table(("  gradient of H", "largest", ""), rows, right=(1,))


def _jumps(page: Page, impact: ResolvedImpact, found: Evaluation) -> None:
    from impact_posture.impact.velocity_jump import merged_entries
    from impact_posture_cli.output import number

    jumps = (found.frictionless, found.sticking)
    rows = [
        ("  ‖Δν‖", *(number(None if j is None else j.norm) for j in jumps), "jump"),
        ("  impulse", *(number(None if j is None else j.impulse_size) for j in jumps), "N·s"),
        ("  energy lost", number(found.energy_loss), "", "J"),
    ]
    for name, unit, values in merged_entries(impact.robot, *jumps):
        rows.append((f"  Δν {name}", *(number(value, missing="") for value in values), unit))
    page.gap()
    title = f"  at {found.speed:g} m/s, e = {found.restitution:g}"
    page.table((title, "no friction", "sticking", "unit"), rows, right=(1, 2))
