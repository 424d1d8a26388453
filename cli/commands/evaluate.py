"""``impact-posture evaluate ROBOT --frame F --normal X Y Z``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from impact_posture.config.problem_settings import ImpactSettings
from impact_posture_cli import options
from impact_posture_cli.impact_tables import alone_line, contact_names, impact_rows, worst_lines, worst_tables
from impact_posture_cli.output import Page, number, print_json, vector
from impact_posture_cli.settings_options import TypedSettings, with_settings

if TYPE_CHECKING:
    from impact_posture.impact.elasticity.elastic_impact import ElasticResponse
    from impact_posture.impact.evaluation.coulomb_jump import CoulombJump
    from impact_posture.impact.evaluation.ellipsoids import Ellipsoid
    from impact_posture.impact.evaluation.evaluation import Evaluation
    from impact_posture.impact.resolved_impact import ResolvedImpact


@with_settings(ImpactSettings)
def evaluate(
    typed: TypedSettings, robot: options.RobotName, json: options.Json = False, quiet: options.Quiet = False
) -> None:
    typed.check_contact()
    from impact_posture.impact.evaluation.ellipsoids import classical_ellipsoids
    from impact_posture.impact.resolved_impact import resolve

    impact = resolve(typed.fill(ImpactSettings, robot=robot))
    evaluation = impact.evaluate()
    warnings = (*impact.warnings, *evaluation.warnings)
    classical = classical_ellipsoids(impact.objective, impact.q)
    if json:
        document = {"schema": "impact-posture/evaluation/1", "posture": impact.posture, **impact.to_dict()}
        document["evaluation"] = evaluation.to_dict()
        document["classical"] = {name: ellipsoid.to_dict() for name, ellipsoid in classical.items()}
        document["warnings"] = list(warnings)
        print_json(document)
        return
    page = Page(quiet=quiet)
    frames, block = contact_names(impact.objective.contacts), evaluation.to_dict()
    axes = "world, fixed in the contact frame" if impact.contact.normal_frame == "contact" else "world"
    normals = [part.normal for part in evaluation.contacts or (evaluation,)]
    page.title(f"{impact.robot.name} at {', '.join(c.frame for c in impact.objective.contacts)}")
    page.pairs([("posture", impact.posture), *impact_rows(impact, normals, axes)])
    if impact.choice:
        page.line(impact.choice)
    _scalars(page, impact, evaluation)
    alone_line(page, frames, "H, G, V, S, E, ellipsoid, gradient and jumps")
    _ellipsoids(page, impact, {"impact Λ_c": evaluation.ellipsoid, **classical})
    _gradient(page, impact, evaluation)
    _jumps(page, impact, evaluation)
    if evaluation.elastic is not None:
        _elastic(page, impact, evaluation.elastic)
    if evaluation.compression is not None and evaluation.compression.line:
        page.line(f"  {evaluation.compression.line}")
    worst_tables(page, frames, {"value": block})
    page.gap()
    page.line(evaluation.dominance.line)
    worst_lines(page, frames, {"value": block})
    page.warnings(warnings)


def _scalars(page: Page, impact: ResolvedImpact, evaluation: Evaluation) -> None:
    from impact_posture.output.quantity_table import quantities

    shown = [scalars for scalars in (evaluation.scalars, evaluation.without_supports) if scalars is not None]
    blocks = [scalars.to_dict() for scalars in shown]
    rows = [
        (f"  {key}", *(number(block[key]) for block in blocks), unit, words)
        for key, unit, words in quantities(impact.metric)
    ]
    masses = [number(scalars.effective_mass, missing="unbounded") for scalars in shown]
    rows.append(("  1/G", *masses, "kg", "effective mass along n"))
    page.gap()
    values = ("standing", "free") if len(shown) > 1 else ("value",)
    page.table(("", *values, "unit", "meaning"), rows, right=tuple(range(1, 1 + len(values))))
    letters = {"impulse": f"λ̄²H, λ̄ = {impact.contact.impulse:g} N·s", "speed": "V", "sticking": "S", "energy": "E"}
    for name, symbol in (("coulomb", "C"), ("effective-mass", "m in kg")):
        letters[name] = f"{symbol}, μ = {impact.contact.friction:g}"
    kind = impact.objective.kind
    if impact.objective.others:
        letters["impulse"] = "the largest ‖Δν‖² within the bounds on the impulses"
    worst = f", worst within {cone:g}° of n" if (cone := impact.objective.normal_cone_deg) else ""
    if count := len(evaluation.model_variants):
        worst += f", worst of {count} model variants"
    page.line(f"  objective {kind} ({letters[kind]}{worst}): {number(evaluation.objective)}")
    if impact.metric.kind != "kinetic":
        weighed = "weighted" if impact.metric.kind == "weighted" else "alike"
        page.line(f"  jump: ‖Δν‖, m/s and rad/s {weighed} in one norm", style="dim")


def _ellipsoids(page: Page, impact: ResolvedImpact, ellipsoids: dict[str, Ellipsoid]) -> None:
    units = {"velocity": "m/s of |ν| = 1", "force": "N of |τ| = 1"}
    kinetic = impact.metric.kind == "kinetic"
    rows = []
    for name, ellipsoid in ellipsoids.items():
        for k, radius in enumerate(ellipsoid.to_dict()["radii"]):
            unit = units.get(name, "kg^-1/2" if kinetic else "jump/(N·s)") if k == 0 else ""
            axis = vector(ellipsoid.axes[:, k])
            rows.append((f"  {name}" if k == 0 else "", number(radius, missing="unbounded"), unit, axis))
    page.gap()
    page.table(("  ellipsoid", "radius", "unit", "axis, world"), rows, right=(1, 3))


def _gradient(page: Page, impact: ResolvedImpact, evaluation: Evaluation) -> None:
    from impact_posture.impact.evaluation.velocity_jump import largest_entries

    page.gap()
    rows = [
        (f"  {name}", number(value), "per m" if unit == "m/s" else "per rad")
        for name, value, unit in largest_entries(impact.robot, evaluation.gradient)
    ]
    if rows:
        page.table(("  gradient of H", "largest", ""), rows, right=(1,))
    else:
        page.line("  gradient of H: zero in this posture")


def _jumps(page: Page, impact: ResolvedImpact, evaluation: Evaluation) -> None:
    from impact_posture.impact.evaluation.velocity_jump import merged_entries

    jumps = (evaluation.frictionless, evaluation.coulomb, evaluation.sticking)
    rows = [
        ("  ‖Δν‖", *(number(None if j is None else j.norm) for j in jumps), "jump"),
        ("  normal impulse", *(number(None if j is None else j.normal_impulse) for j in jumps), "N·s"),
        ("  impulse, norm", *(number(None if j is None else j.impulse_size) for j in jumps), "N·s"),
        ("  energy lost", number(evaluation.energy_loss), "", "", "J"),
    ]
    if (compression := evaluation.compression) is not None and compression.time is not None:
        rows.append(("  compressed for", "", number(1e3 * compression.time), "", "ms"))
        rows.append(("  peak force", "", number(compression.peak_force), "", "N"))
    for name, unit, values in merged_entries(impact.robot, *jumps):
        rows.append((f"  Δν {name}", *(number(value, missing="") for value in values), unit))
    page.gap()
    title = f"  at {evaluation.speed:g} m/s, e = {evaluation.restitution:g}"
    page.table((title, "no friction", f"μ = {impact.contact.friction:g}", "sticking", "unit"), rows, right=(1, 2, 3))
    if evaluation.coulomb is not None:
        page.line(f"  with friction μ = {impact.contact.friction:g} the contact point {_slip(evaluation.coulomb)}")
    names = contact_names(impact.objective.contacts)
    for name, jump in zip(names, evaluation.together or (), strict=False):
        page.line(
            f"  all at once, with friction: {name} {_slip(jump)}, normal impulse {number(jump.normal_impulse)} N·s"
        )


def _slip(jump: CoulombJump) -> str:
    direction = jump.slip_direction
    return "sticks" if direction is None else f"slides along {vector(direction)}"


def _elastic(page: Page, impact: ResolvedImpact, response: ElasticResponse) -> None:
    from impact_posture.impact.evaluation.impact_effect import tangent_units
    from impact_posture.impact.evaluation.velocity_jump import largest_entries

    rows = [
        ("  ‖Δν‖ of the links at greatest compression", number(response.jump_norm), "jump"),
        ("  largest ‖Δν‖ of the links", number(response.peak_jump_norm), "jump"),
        ("  impulse", number(response.impulse), "N·s"),
        ("  compressed for", number(1e3 * response.duration), "ms"),
        ("  peak force", number(response.force), "N"),
    ]
    rows += [
        (f"  Δν {name}", number(value), unit) for name, value, unit in largest_entries(impact.robot, response.jump)
    ]
    units = {"rad/s": "N·m", "m/s": "N"}
    named = zip(impact.robot.tangent_names, tangent_units(impact.robot), response.peak_torque, strict=True)
    largest = sorted(
        ((name, units[unit], value) for name, unit, value in named if value > 0), key=lambda row: -row[2]
    )
    rows += [(f"  largest torque of {name}", number(value), unit) for name, unit, value in largest[:5]]
    page.gap()
    page.table((f"  elastic joints on {response.stiffness:.3g} N/m, without friction", "", "unit"), rows, right=(1,))
