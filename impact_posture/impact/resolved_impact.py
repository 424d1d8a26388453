"""Turn settings into robot, contacts, supports, metric and objective, for all commands and for Python."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from impact_posture.config.problem_settings import ImpactSettings, ObjectiveKind, Vector3
from impact_posture.config.setting import stated as is_stated
from impact_posture.config.text_parsers import parse_contact
from impact_posture.errors import ContactError, FrameNotFound
from impact_posture.impact.contact_point import EarlyTouch, at_front, early_touches, sunken_feet
from impact_posture.impact.elasticity.contact_compression import ContactStiffness
from impact_posture.impact.evaluation.evaluation import Evaluation, evaluate
from impact_posture.impact.impact_contact import ImpactContact, point_on
from impact_posture.impact.metric import Metric, build_metric
from impact_posture.impact.support_compliance import check_compliance
from impact_posture.impact.supports import refuse_held, refuse_rigid, resolve_supports
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.robot.guessed_parts import feet, tips
from impact_posture.robot.joint_model import with_joint_model
from impact_posture.robot.model_variant import Payload, build_model_variants
from impact_posture.robot.posture_files import read_posture
from impact_posture.robot.robot import Robot
from impact_posture.robot.robot_loader import load_robot
from impact_posture.robot.robot_spec import Support
from impact_posture.system.arrays import Array

# If the user chooses no objective, each of these settings selects ``auto``.
_CHOOSING = ("speed", "friction", "contact_stiffness", "contact_duration")

FLOATS = "because its data name neither feet nor rotors"


def resolve(settings: ImpactSettings, robot: Robot | None = None) -> ResolvedImpact:
    """Load the robot, unless ``robot`` is given, and check all settings for this robot.

    If a setting is ``None``, the value in the robot's data is used.

    Raises:
        ImpactPostureError: A setting is wrong.  The error names the first wrong setting.
    """
    robot = with_joint_model(load_robot(settings.robot, settings) if robot is None else robot, settings.joint_model)
    q = read_posture(robot, settings.posture)
    hold = getattr(settings, "hold", None)
    held = robot.held if hold is None else tuple(hold)
    leading, *others = _contacts(settings, robot)
    if settings.contact_point == "front":
        if settings.offset is not None:
            hint = "omit one of them"
            raise ContactError("'front' contradicts `offset`", where="contact_point", hint=hint)
        given = getattr(settings, "q", None)
        at = q if given is None else robot.check_posture(np.array(given), where="q")
        leading, *others = (at_front(robot, contact, at, held) for contact in (leading, *others))
    supports = resolve_supports(robot, settings.support)
    for contact in (leading, *others):
        refuse_held(robot, contact, supports)
    refuse_rigid(robot, supports)
    compliance = settings.support_compliance
    if compliance is not None:
        check_compliance(robot, compliance)
    kind, choice = choose_objective(settings, several=bool(others))
    objective = WorstCaseObjective(
        robot,
        leading,
        build_metric(robot, settings.metric, settings.weights),
        kind,
        supports,
        compliance or 0.0,
        settings.normal_cone,
        tuple(others),
        settings.bilateral,
        build_model_variants(robot, settings.armature_range, [Payload(*payload) for payload in settings.payload]),
    )
    stiffness = ContactStiffness.of(settings.contact_stiffness, settings.contact_duration)
    held_by = missing_support(robot) if settings.support is None and not supports else ""
    posture = settings.posture or robot.default_posture
    speed, restitution = settings.speed, settings.restitution
    return ResolvedImpact(objective, q, posture, speed, restitution, held_by, stiffness, choice, held)


def choose_objective(settings: ImpactSettings, *, several: bool) -> tuple[ObjectiveKind, str]:
    """Return the objective type, and the reason if it is chosen automatically (otherwise empty)."""
    stated = [name for name in _CHOOSING if is_stated(getattr(settings, name))]
    together = several and getattr(settings, "strike", False) and not settings.bilateral
    stated += ["strike"] if together else []
    if settings.objective is None and not stated:
        return "impulse", ""
    if settings.objective is not None and settings.objective != "auto":
        return settings.objective, ""
    kind, reason = _automatic(settings, several=several, together=together)
    given = ", ".join(f"`{name}`" for name in stated)
    return kind, reason if settings.objective == "auto" else f"{reason} (auto, because of {given})"


def _automatic(settings: ImpactSettings, *, several: bool, together: bool) -> tuple[ObjectiveKind, str]:
    if together:
        return "sticking", "objective sticking: the contacts strike together, all with the same speed"
    if several:
        return "impulse", "objective impulse: for several contacts at once, only bounds on the impulses are known"
    if settings.speed == 0:
        return "impulse", "objective impulse: there is no approach speed"
    at = f"at {settings.speed:g} m/s with friction {settings.friction:g}"
    if settings.normal_cone:
        what = f"objective sticking: {at}, the jump with friction has no exact worst case over a cone"
        return "sticking", what
    if settings.friction == 0:
        return "speed", f"objective speed: {at} the contact slips freely"
    return "coulomb", f"objective coulomb: {at} the impact itself decides whether the contact sticks or slips"


def _contacts(settings: ImpactSettings, robot: Robot) -> list[ImpactContact]:
    texts = (settings.contact,) if isinstance(settings.contact, str) else settings.contact or ()
    if not texts:
        if settings.normal is None:
            raise ContactError("is missing", where="normal", hint="give the direction out of the surface")
        return [_contact(settings, robot, settings.frame or _default_frame(robot), settings.normal, None)]
    if settings.frame is not None or settings.normal is not None:
        what, hint = "cannot be combined with `frame` and `normal`", "give either `contact`, or `frame` and `normal`"
        raise ContactError(what, where="contact", hint=hint)
    if len(texts) > 1 and settings.offset is not None:
        hint = "omit the offset, or add frames to the URDF"
        raise ContactError("one offset for several contacts is ambiguous", where="offset", hint=hint)
    return [_contact(settings, robot, *parse_contact(text)) for text in texts]


def _contact(
    settings: ImpactSettings, robot: Robot, frame: str, normal: Vector3, impulse: float | None
) -> ImpactContact:
    if frame not in robot.frame_names:
        raise FrameNotFound(frame, tips(robot, feet(robot)), where=robot.name)
    offset = settings.offset
    if offset is None:
        offset = robot.spec.contact.offset_of(frame)
    bound = settings.impulse if impulse is None else impulse
    contact = ImpactContact(frame, normal, offset, settings.normal_frame, bound, settings.friction)
    point_on(robot, contact.frame, contact.offset)
    return contact


@dataclass(frozen=True, eq=False)
class ResolvedImpact:
    """An impact whose settings have been checked for its robot.

    Attributes:
        objective: Objective with robot, contacts, metric, supports and compliance.
        q: The posture that the settings name, shape (nq,).
        posture: Name or file of the posture ``q``.
        speed: Approach speed, m/s.
        restitution: Coefficient of restitution.
        missing_support: Hint how to give supports, if the robot floats and no supports are given; otherwise empty.
        contact_stiffness: Elasticity of the contact; ``None`` if not known.
        choice: Reason why ``auto`` chose this objective; empty if the settings name the objective.
        held: Joints that keep their values.
    """

    objective: WorstCaseObjective
    q: Array
    posture: str
    speed: float
    restitution: float
    missing_support: str = ""
    contact_stiffness: ContactStiffness | None = None
    choice: str = ""
    held: tuple[str, ...] = ()

    @property
    def robot(self) -> Robot:
        """The robot as loaded."""
        return self.objective.robot

    @property
    def contact(self) -> ImpactContact:
        """The first contact."""
        return self.objective.contact

    @property
    def supports(self) -> tuple[Support, ...]:
        """Feet that stay on the ground."""
        return self.objective.supports

    @property
    def metric(self) -> Metric:
        """Metric that measures the velocity jump."""
        return self.objective.metric

    def evaluate(self, q: Array | None = None) -> Evaluation:
        """Evaluate the impact at ``q``, by default at the posture of the settings."""
        q = self.q if q is None else q
        return evaluate(self.objective, q, self.speed, self.restitution, self.contact_stiffness)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings about the robot and about this objective."""
        early = self.touch_warnings(self.q, "`contact_point` front")
        feet = sunken_feet(self.robot, self.supports, self.q)
        warnings = (*self.robot.warnings, *self.objective.warnings, *early, *feet)
        if not self.missing_support:
            return warnings
        return (*warnings, f"{self.robot.name} is assumed to be floating freely, {FLOATS}; {self.missing_support}")

    def early_touches(self, q: Array) -> tuple[EarlyTouch, ...]:
        """Return the links that touch a surface before the contact point at ``q``, shape (nq,)."""
        return early_touches(self.robot, self.objective.contacts, q, self.held)

    def touch_warnings(self, q: Array, remedy: str) -> list[str]:
        """Return a warning for each of :meth:`early_touches`; ``remedy`` is a setting that prevents early touches."""
        # A single option `offset` cannot move several contact points.
        alone = not self.objective.others
        touches = self.early_touches(q)
        return [f"{t.fact}: give {f'`offset` {t.offset}, or ' if alone else ''}{remedy}" for t in touches]

    def to_dict(self, q: Array | None = None) -> dict[str, object]:
        """Return the blocks of ``result.json`` that describe the impact: robot, contacts, supports, metric.

        Normals are in world axes at the posture ``q``, by default :attr:`q`.
        """
        q = self.q if q is None else q
        return {
            "robot": robot_block(self.robot),
            "contacts": [o.contact.to_dict() | {"normal": o.oracle.at(q).n.tolist()} for o in self.objective.singles],
            "scenarios": [variant.to_dict() for variant in self.objective.model_variants],
            "supports": [{"frame": s.frame, "kind": s.kind} for s in self.supports],
            "support_compliance": self.objective.compliance if self.supports else None,
            "metric": {
                "name": self.metric.kind,
                "objective": self.objective.kind,
                "weights": None if self.metric.weights is None else list(self.metric.weights),
                "normal_cone_deg": self.objective.normal_cone_deg,
                "bilateral": self.objective.bilateral,
                "speed": self.speed,
                "restitution": self.restitution,
                "contact_stiffness": None if self.contact_stiffness is None else self.contact_stiffness.to_dict(),
            },
        }


def robot_block(robot: Robot) -> dict[str, object]:
    """Return the ``robot`` block of ``result.json``."""
    keys = ("name", "source", "model_sha256", "nq", "nv", "root", "convention", "joint_model", "armature_source")
    lists = {key: [*getattr(robot, key)] for key in ("joint_names", "q_names", "locked")}
    return {key: getattr(robot, key) for key in keys} | lists | {"armature": robot.armature.tolist()}


def missing_support(robot: Robot) -> str:
    """Return a hint how to give supports if a floating robot has data for neither feet nor rotors; else empty."""
    spec = robot.spec
    known = spec.propulsion is not None or spec.kind == "aerial" or spec.constraints.level_base
    if not robot.floating or known:
        return ""
    guessed = feet(robot)
    named = " ".join(f"`support` {frame}" for frame in guessed)
    stand = f"{named} (feet guessed from names or geometry)" if guessed else "`support` FRAME for each foot"
    draft = "(inspect --write-robot-toml drafts one)"
    return f"give {stand}, no `support` if the robot really floats, `base`, or a robot.toml {draft}"


def _default_frame(robot: Robot) -> str:
    if robot.spec.contact.frame is not None:
        return robot.spec.contact.frame
    hint = f"give a frame, for example {', '.join(tips(robot, feet(robot))[:3])}"
    raise ContactError(f"{robot.name} has no default contact frame", where="frame", hint=hint)
