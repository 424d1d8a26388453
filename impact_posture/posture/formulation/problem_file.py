"""Read, prepare and write ``problem.toml``, whose keys are the command-line options, with ``_`` instead of ``-``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np

from impact_posture.config.problem_settings import ProblemSettings
from impact_posture.config.setting import stated
from impact_posture.config.table_validation import read_toml, validate
from impact_posture.errors import InputError, SpecError
from impact_posture.impact.elasticity.contact_compression import GIVE_ELASTICITY, ContactStiffness
from impact_posture.impact.evaluation.velocity_jump import normal_jump
from impact_posture.impact.objective import Objective
from impact_posture.impact.resolved_impact import FLOATS, ResolvedImpact, resolve
from impact_posture.posture.approach.approach_speed import ApproachSpeed
from impact_posture.posture.approach.attainable_speed import FASTEST
from impact_posture.posture.constraints.center_of_mass_over_feet import CenterOfMassOverFeet
from impact_posture.posture.constraints.requirements import Requirements
from impact_posture.posture.formulation.build_problem import build_problem
from impact_posture.posture.formulation.landing import falls_freely
from impact_posture.posture.program.constrained_problem import ConstrainedProblem
from impact_posture.robot.model_variant import ModelVariant
from impact_posture.robot.robot_loader import from_folder, names_a_path
from impact_posture.robot.urdf import EXAMPLE_PREFIX
from impact_posture.system.escape import toml

_FILES = ("srdf", "config")
# An option on the command line also replaces these keys of the file.
_REPLACED_BY = {
    "frame": ("contact",),
    "normal": ("contact",),
    "contact": ("frame", "normal"),
    "contact_duration": ("contact_stiffness",),
    "contact_stiffness": ("contact_duration",),
    "posture": ("q",),
}
# Fields of ``Requirements`` that are computed from the robot and from the setting with the same name.
_WORKED_OUT = {"contact_pose", "base", "hold", "com_margin", "limit_margin"}


@dataclass(frozen=True)
class Prepared:
    """A problem that is ready to be solved, with its settings and the impact that the settings define."""

    settings: ProblemSettings
    impact: ResolvedImpact
    problem: ConstrainedProblem

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings about the robot, the objective and the collision shapes, which are known before the search."""
        around = self.problem.surroundings
        return tuple(dict.fromkeys((*self.impact.warnings, *(around.shapes.warnings if around else ()))))


def read_settings(path: Path, over: dict[str, object] | None = None) -> ProblemSettings:
    """Read a ``problem.toml``; paths start from its folder, and options in ``over`` replace keys of the file."""
    data = from_folder(read_toml(path), path.resolve().parent, (*_FILES, "weights", "armature", "posture"))
    over = over or {}
    # An option also replaces keys that describe the same quantity in another form.
    replaced = [key for option in over for key in _REPLACED_BY.get(option, ())]
    if over.get("metric", "weighted") != "weighted" and "weights" not in over:
        replaced.append("weights")
    data = {key: value for key, value in data.items() if key not in replaced}
    return validate(ProblemSettings, data | over, str(path))


def prepare(settings: ProblemSettings, impact: ResolvedImpact | None = None) -> Prepared:
    """Resolve all defaults and build the problem without solving it; by default, ``settings`` define the impact.

    Raises:
        ImpactPostureError: A setting is wrong; the error describes the first wrong setting in one line.
    """
    impact = resolve(settings) if impact is None else impact
    if impact.robot.joint_model == "elastic":
        fault = "the joint model `elastic` only predicts the impact at one given posture"
        hint = "optimize with the joint model `link` or `reflected`, and evaluate the optimum with `elastic`"
        raise InputError(fault, where="joint_model", hint=hint)
    if settings.q is not None:
        impact = replace(impact, q=impact.robot.check_posture(np.array(settings.q), where="q"))
    if impact.missing_support:
        if settings.base is None:
            what = f"nothing says what holds {impact.robot.name} up, {FLOATS}"
            raise InputError(what, where=settings.robot, hint=impact.missing_support)
        impact = replace(impact, missing_support="")
    demands = requirements(settings, impact.objective)
    impact = replace(impact, held=impact.robot.fixed_with(demands.hold))
    problem = build_problem(impact.robot, impact.objective, impact.q, demands)
    released = [joint for joint in impact.robot.held if joint not in problem.requirements.hold]
    if released:
        note = f"robot.toml also holds {', '.join(released)}; your `hold` replaces its list, so these joints are free"
        problem = replace(problem, notes=(note, *problem.notes))
    return Prepared(settings, impact, problem)


def requirements(settings: ProblemSettings, objective: Objective) -> Requirements:
    """Return the requirements of the settings; a setting ``None`` selects the value in the robot's data.

    Raise ``InputError`` if a setting concerns feet and there are no supports.
    """
    robot, spec = objective.robot, objective.robot.spec.constraints
    poses = [settings.contact_pose or robot.contact_pose(contact.frame) for contact in objective.contacts]
    base = "level" if spec.level_base and robot.floating else "free"
    lands = settings.strike and falls_freely(objective, settings.base or base)
    stands = spec.com_over_feet and bool(objective.supports)
    com = stands or lands if settings.com is None else settings.com
    if settings.obstacles and not settings.collision:
        raise InputError(
            "have no effect without `collision`", where="obstacles", hint="add `collision`, or omit the obstacles"
        )
    if com and not objective.supports and not lands:
        fault = "there are no feet to keep the center of mass over"
        raise InputError(fault, where="com", hint="add `support`, or choose no `com`")
    if settings.keep_contacts and not objective.supports:
        raise InputError(
            "there are no feet to keep in place", where="keep_contacts", hint="add `support`, or omit `keep_contacts`"
        )
    if settings.approach and not 0 < settings.speed <= FASTEST:
        what = "needs an approach speed above zero"
        raise InputError(what, where="approach", hint=f"give `speed`, up to {FASTEST:g} m/s")
    worked_out = Requirements(
        approach_speed=settings.speed if _approaches(settings, objective) else 0.0,
        approach_asked=settings.approach is not None,
        contact_pose=poses[0] if poses else "free",
        other_poses=tuple(poses[1:]),
        base=settings.base or base,
        hold=robot.held if settings.hold is None else settings.hold,
        com_over_feet=com,
        com_asked=settings.com is not None,
        com_margin=spec.com_margin if settings.com_margin is None else settings.com_margin,
        largest_mass=_largest_mass(settings),
        largest_jump=_largest_jump(settings),
        limit_margin=spec.limit_margin if settings.limit_margin is None else settings.limit_margin,
    )
    shared = {f.name for f in fields(Requirements)} & {f.name for f in fields(ProblemSettings)} - _WORKED_OUT
    return replace(worked_out, **{key: getattr(settings, key) for key in shared})


def _approaches(settings: ProblemSettings, objective: Objective) -> bool:
    """Return the setting ``approach``; by default, true for a strike or a stated speed, unless the robot flies."""
    if settings.approach is not None:
        return settings.approach
    flies = objective.robot.floating and not objective.supports and settings.base != "fixed"
    return (stated(settings.speed) or settings.strike) and 0 < settings.speed <= FASTEST and not flies


def _largest_mass(settings: ProblemSettings) -> float:
    """Return the largest mass, kg, at which the peak force is at most ``max_force``; infinite for no bound."""
    for name, asked in (
        ("max_force", settings.max_force is not None),
        ("tradeoff_against", settings.tradeoff > 0 and settings.tradeoff_against == "force"),
    ):
        if asked and settings.contact_stiffness is None and settings.contact_duration is None:
            raise InputError("needs the elasticity of the contact", where=name, hint=GIVE_ELASTICITY)
        if asked and settings.speed == 0:
            raise InputError("needs an approach speed", where=name, hint="give `speed` above zero")
    contact = ContactStiffness.of(settings.contact_stiffness, settings.contact_duration)
    if settings.max_force is None or contact is None:
        return float("inf")
    return contact.largest_mass(settings.max_force, settings.speed)


def _largest_jump(settings: ProblemSettings) -> float:
    """Return the largest allowed velocity jump of a joint per approach speed; infinite if there is no bound."""
    if (settings.max_torque is None) != (settings.velocity_gain is None):
        fault = "limits the product of `velocity_gain` and the velocity jump of a joint, so both settings are needed"
        hint = "give both `max_torque` and `velocity_gain`, or neither"
        raise InputError(fault, where="max_torque" if settings.velocity_gain is None else "velocity_gain", hint=hint)
    jumps = [] if settings.max_joint_jump is None else [settings.max_joint_jump]
    if settings.max_torque is not None and settings.velocity_gain is not None:
        jumps.append(settings.max_torque / settings.velocity_gain)
    speed = normal_jump(settings.speed, settings.restitution)
    return min(jumps) / speed if jumps and speed > 0 else float("inf")


def resolved_settings(prepared: Prepared) -> ProblemSettings:
    """Return the settings with all defaults written out; these settings reproduce the result."""
    settings, impact, wanted = prepared.settings, prepared.impact, prepared.problem.requirements
    robot = settings.robot
    if names_a_path(robot, Path()):
        robot = str(Path(robot).expanduser().resolve())
    changes: dict[str, object] = {
        "robot": robot,
        "root": impact.robot.root,
        "package_dir": tuple(str(Path(p).expanduser().resolve()) for p in settings.package_dir),
        **_resolved_contacts(impact),
        "posture": None,
        "q": tuple(float(v) for v in impact.q),
        # The key `contact_pose` applies to all contacts.  If there are several contacts, the key keeps the value that
        # the user gave.
        "contact_pose": settings.contact_pose if wanted.other_poses else wanted.contact_pose,
        "support": tuple(f"{s.frame}:{s.kind}" for s in impact.supports),
        "support_compliance": impact.objective.compliance if impact.supports else None,
        **{key: getattr(wanted, key) for key in ("hold", "base", "com_margin", "limit_margin")},
        "com": any(isinstance(c, CenterOfMassOverFeet) for c in prepared.problem.constraints),
        "metric": impact.metric.kind,
        "weights": impact.metric.weights,
        "objective": impact.objective.kind,
        "approach": any(isinstance(c, ApproachSpeed) for c in prepared.problem.constraints),
        "normal_cone": impact.objective.normal_cone_deg,
        "bilateral": impact.objective.bilateral,
        "normal_frame": impact.contact.normal_frame,
        "joint_model": impact.robot.joint_model,
        "speed": impact.speed,
        "restitution": impact.restitution,
        **_resolved_variants(impact.objective.model_variants),
    }
    for key in _FILES:
        value = getattr(settings, key)
        in_package = value is None or value.startswith(EXAMPLE_PREFIX)
        changes[key] = value if in_package else str(Path(value).expanduser().resolve())
    if settings.armature is not None:
        changes["armature"] = _armature_by_joint(impact)
    return replace(settings, **changes)  # type: ignore[arg-type]


def _resolved_contacts(impact: ResolvedImpact) -> dict[str, object]:
    contact = impact.contact
    if not impact.objective.others:
        keys = ("frame", "normal", "offset", "friction", "impulse")
        return {key: getattr(contact, key) for key in keys} | {"contact": None, "contact_point": "frame"}
    texts = tuple(f"{c.frame}:{','.join(map(repr, c.normal))}:{c.impulse!r}" for c in impact.objective.contacts)
    return {"frame": None, "normal": None, "offset": None, "contact": texts, "friction": contact.friction}


def _resolved_variants(variants: Sequence[ModelVariant]) -> dict[str, object]:
    # The nominal robot is always one of the variants.
    factors = {variant.armature_factor for variant in variants} - {1.0}
    if len(factors) == 1:
        factors.add(1.0)
    payloads = dict.fromkeys(v.payload for v in variants if v.payload is not None)
    return {
        "armature_range": (min(factors), max(factors)) if factors else None,
        "payload": tuple((payload.frame, payload.mass) for payload in payloads),
    }


def _armature_by_joint(impact: ResolvedImpact) -> str | dict[str, float]:
    robot = impact.robot
    first = {name: robot.model.idx_vs[robot.joint_id(name)] for name in robot.joint_names}
    values = {name: float(robot.armature[k]) for name, k in first.items()}
    return values if any(values.values()) else "none"


def dump_settings(settings: ProblemSettings) -> str:
    """Write settings as TOML, without ``None``; raise ``SpecError`` if a value is not UTF-8."""
    lines = [f"schema = {toml(settings.schema)}"]
    # Write the robot first, because readers look for it first.
    for key in sorted((field.name for field in fields(ProblemSettings)), key=lambda name: name != "robot"):
        value = getattr(settings, key)
        if key != "schema" and value is not None and value != {}:
            try:
                lines.append(f"{key} = {toml(value)}")
            except UnicodeEncodeError:
                fault = f"'{value}' is not UTF-8, but TOML must be UTF-8"
                raise SpecError(fault, where=key, hint="rename the file or folder") from None
    return "\n".join(lines) + "\n"
