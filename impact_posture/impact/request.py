"""From what a user asked for, as text and numbers, to robot, contact, supports, metric and objective.

``evaluate``, ``optimize``, ``codegen`` and ``verify`` all mean the same by the same options because all come here.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from impact_posture.errors import ContactError, FrameNotFound, InputError
from impact_posture.impact.contact import ImpactContact, NormalFrame, Support, least_compliance, point_on
from impact_posture.impact.metric import Metric, MetricKind, ObjectiveKind, build_metric
from impact_posture.impact.objective import ImpactObjective
from impact_posture.impact.parsing import parse_contact
from impact_posture.impact.supports import refuse_held, resolve_supports
from impact_posture.robot.guess import feet, tips
from impact_posture.robot.model_variant import Payload, build_model_variants
from impact_posture.robot.postures import read_posture
from impact_posture.robot.robot import Robot
from impact_posture.robot.robot_loader import LoadOptions, load_robot
from impact_posture.robot.spec import Vector3

Vector = NDArray[np.float64]

FLOATS = "because its data name neither feet nor rotors"


@dataclass(frozen=True)
class ImpactRequest:
    """An impact as a user asks for it; what is ``None`` comes from the robot.

    Attributes:
        robot: Known name, path to a ``.urdf``, or ``example-robot-data:<path>``.
        load: How to load it.
        frame: Contact frame.
        normal: Direction out of the surface, shape (3,), any length.
        offset: Contact point in the frame, meters.
        normal_frame: Axes of ``normal``.
        contacts: ``FRAME:NX,NY,NZ[:IMPULSE]`` each, instead of ``frame`` and ``normal``; several act at once.
        bilateral: Whether several contacts can pull as well as push.
        impulse: λ̄, N·s.
        posture: Name or file.
        supports: ``FRAME[:point|surface]`` each; empty for none.
        metric: How the jump is weighed.
        weights: File or ``velocity-limits``, for the weighted metric.
        objective: What is minimized.
        speed: Approach speed, m/s.
        restitution: Coefficient of restitution.
        compliance: ε of the supports, 1/kg.
        normal_cone: Half angle of the cone of normals whose worst is meant, degrees.
        armature_range: Lowest and highest factor on the armature, whose worst is meant.
        payloads: What the robot may carry, one at a time, and whose worst is meant.
    """

    robot: str
    load: LoadOptions = field(default_factory=LoadOptions)
    frame: str | None = None
    normal: Vector3 | None = None
    offset: Vector3 | None = None
    normal_frame: NormalFrame = "world"
    contacts: tuple[str, ...] = ()
    bilateral: bool = False
    impulse: float = 1.0
    posture: str | None = None
    supports: tuple[str, ...] | None = None
    metric: MetricKind = "euclidean"
    weights: str | None = None
    objective: ObjectiveKind = "impulse"
    speed: float = 1.0
    restitution: float = 0.0
    compliance: float | None = None
    normal_cone: float = 0.0
    armature_range: tuple[float, float] | None = None
    payloads: tuple[Payload, ...] = ()

    def resolve(self) -> ResolvedImpact:
        """Load the robot and check everything against it.

        Raises:
            ImpactPostureError: The first thing that is wrong, in one line.
        """
        robot = load_robot(self.robot, self.load)
        q = read_posture(robot, self.posture)
        leading, *others = self._contacts(robot)
        supports = resolve_supports(robot, self.supports)
        for contact in (leading, *others):
            refuse_held(robot, contact, supports)
        least = least_compliance(robot)
        if self.compliance is not None and not (np.isfinite(self.compliance) and self.compliance >= least):
            raise InputError(
                f"the compliance is {self.compliance:g} 1/kg",
                where="support_compliance",
                hint=f"give at least {least:.3g}, 1e-6 over the mass: below it rounding eats what stiffer feet gain",
            )
        objective = ImpactObjective(
            robot,
            leading,
            build_metric(robot, self.metric, self.weights),
            self.objective,
            supports,
            self.compliance or 0.0,
            self.normal_cone,
            tuple(others),
            self.bilateral,
            build_model_variants(robot, self.armature_range, self.payloads),
        )
        held_by = _missing_support(robot) if self.supports is None and not supports else ""
        posture = self.posture or robot.default_posture
        return ResolvedImpact(objective, q, posture, self.speed, self.restitution, held_by)

    def _contacts(self, robot: Robot) -> list[ImpactContact]:
        if not self.contacts:
            if self.normal is None:
                raise ContactError("there is none", where="--normal", hint="give the direction out of the surface")
            return [self._contact(robot, self.frame or _default_frame(robot), self.normal, None)]
        if self.frame is not None or self.normal is not None:
            raise ContactError(
                "--contact stands instead of --frame and --normal", where="--contact", hint="give one of the two"
            )
        if len(self.contacts) > 1 and self.offset is not None:
            raise ContactError(
                "one offset for several contacts", where="--offset", hint="leave it out, or add frames to the URDF"
            )
        return [self._contact(robot, *parse_contact(text)) for text in self.contacts]

    def _contact(self, robot: Robot, frame: str, normal: Vector3, impulse: float | None) -> ImpactContact:
        if frame not in robot.frame_names:
            raise FrameNotFound(frame, tips(robot, feet(robot)), where=robot.name)
        offset = self.offset
        if offset is None:
            offset = robot.spec.contact.offset if frame == robot.spec.contact.frame else (0.0, 0.0, 0.0)
        bound = self.impulse if impulse is None else impulse
        contact = ImpactContact(frame, normal, offset, self.normal_frame, bound)
        point_on(robot, contact.frame, contact.offset)
        return contact


@dataclass(frozen=True, eq=False)
class ResolvedImpact:
    """A request that fits its robot.

    Attributes:
        objective: Carries robot, contact, metric, kind, supports and compliance.
        q: The posture asked for, shape (nq,).
        posture: Its name or file.
        speed: Approach speed, m/s.
        restitution: Coefficient of restitution.
        missing_support: How to say what holds a floating robot up, where nothing does; else empty.
    """

    objective: ImpactObjective
    q: Vector
    posture: str
    speed: float
    restitution: float
    missing_support: str = ""

    @property
    def robot(self) -> Robot:
        """The robot as loaded."""
        return self.objective.robot

    @property
    def contact(self) -> ImpactContact:
        """The contact, its normal a unit vector."""
        return self.objective.contact

    @property
    def supports(self) -> tuple[Support, ...]:
        """Feet in force."""
        return self.objective.supports

    @property
    def metric(self) -> Metric:
        """How the jump is weighed."""
        return self.objective.metric

    @property
    def warnings(self) -> tuple[str, ...]:
        """What to know about the robot and about this objective."""
        found = (*self.robot.warnings, *self.objective.warnings)
        if not self.missing_support:
            return found
        return (*found, f"{self.robot.name} is taken as floating freely, {FLOATS}; {self.missing_support}")

    def to_dict(self, q: Vector | None = None) -> dict[str, object]:
        """The blocks of ``result.json`` that say what was asked: robot, contacts, supports, metric.

        Args:
            q: Where world normals are taken of those that turn with the robot; the posture asked for by default.
        """
        q = self.q if q is None else q
        return {
            "robot": robot_block(self.robot),
            "contacts": [_contact_block(single, q) for single in self.objective.singles],
            "scenarios": [scenario.to_dict() for scenario in self.objective.scenarios],
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
            },
        }


def _contact_block(single: ImpactObjective, q: Vector) -> dict[str, object]:
    """A contact, its normal in world axes at ``q``."""
    contact = single.contact
    return {
        "frame": contact.frame,
        "offset": list(contact.offset),
        "normal": [float(v) for v in single.oracle.at(q).n],
        "normal_frame": contact.normal_frame,
        "impulse_bound": contact.impulse,
    }


def robot_block(robot: Robot) -> dict[str, object]:
    """The ``robot`` block of ``result.json``."""
    return {
        "name": robot.name,
        "source": robot.source,
        "model_sha256": robot.model_sha256,
        "nq": robot.nq,
        "nv": robot.nv,
        "joint_names": list(robot.joint_names),
        "root": robot.root,
        "convention": robot.convention,
        "armature": [float(v) for v in robot.armature],
        "armature_source": robot.armature_source,
        "locked": list(robot.locked),
    }


def _missing_support(robot: Robot) -> str:
    """How to say what holds the robot up, if it floats and its data name neither feet nor rotors; else empty."""
    spec = robot.spec
    known = spec.propulsion is not None or spec.kind == "aerial" or spec.constraints.level_base
    if not robot.floating or known:
        return ""
    found = feet(robot)
    stand = " ".join(f"--support {frame}" for frame in found) + " (its feet by name or geometry)"
    return (
        f"give {stand if found else '--support FRAME for each foot'}, --no-support if it floats indeed, --base, or a "
        "robot.toml (inspect --write-robot-toml drafts one)"
    )


def _default_frame(robot: Robot) -> str:
    if robot.spec.contact.frame is not None:
        return robot.spec.contact.frame
    raise ContactError(
        f"{robot.name} has no default contact frame",
        where="--frame",
        hint=f"give one, for example {', '.join(tips(robot, feet(robot))[:3])}",
    )
