"""From what a user asked for, as text and numbers, to robot, contact, supports, metric and objective.

``evaluate``, ``optimize``, ``codegen`` and ``verify`` all mean the same by the same options because all come here.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import get_args

import numpy as np
from numpy.typing import NDArray

from impact_posture.errors import ContactError, FrameNotFound, InputError
from impact_posture.impact.contact import Contact, NormalFrame, Support, point_on
from impact_posture.impact.metric import Metric, MetricKind, ObjectiveKind, build_metric
from impact_posture.impact.objective import ImpactObjective
from impact_posture.robot.loader import LoadOptions, load_robot
from impact_posture.robot.postures import read_posture
from impact_posture.robot.robot import Robot
from impact_posture.robot.spec import SupportKind, Vector3

Vector = NDArray[np.float64]


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
        contact: ``FRAME:NX,NY,NZ[:IMPULSE]`` instead of ``frame`` and ``normal``.
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
    """

    robot: str
    load: LoadOptions = field(default_factory=LoadOptions)
    frame: str | None = None
    normal: Vector3 | None = None
    offset: Vector3 | None = None
    normal_frame: NormalFrame = "world"
    contact: str | None = None
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

    def resolve(self) -> ResolvedImpact:
        """Load the robot and check everything against it.

        Raises:
            ImpactPostureError: The first thing that is wrong, in one line.
        """
        robot = load_robot(self.robot, self.load)
        q = read_posture(robot, self.posture)
        contact = self._contact(robot)
        supports = resolve_supports(robot, self.supports)
        _refuse_held(robot, contact, supports)
        if self.compliance is not None and not (np.isfinite(self.compliance) and self.compliance > 0):
            raise InputError(
                f"the compliance is {self.compliance:g}", where="support_compliance", mend="give 1/kg above zero"
            )
        metric = build_metric(robot, self.metric, self.weights)
        compliance, cone = self.compliance or 0.0, self.normal_cone
        objective = ImpactObjective(robot, contact, metric, self.objective, supports, compliance, cone)
        return ResolvedImpact(objective, q, self.posture or robot.default_posture, self.speed, self.restitution)

    def _contact(self, robot: Robot) -> Contact:
        if self.contact is not None:
            if self.frame is not None or self.normal is not None:
                raise ContactError(
                    "--contact stands instead of --frame and --normal", where="--contact", mend="give one of the two"
                )
            frame, normal, impulse = parse_contact(self.contact)
            impulse = self.impulse if impulse is None else impulse
        else:
            frame, impulse = self.frame or _default_frame(robot), self.impulse
            if self.normal is None:
                raise ContactError("there is none", where="--normal", mend="give the direction out of the surface")
            normal = self.normal
        if self.offset is not None:
            offset = self.offset
        else:
            offset = robot.spec.contact.offset if frame == robot.spec.contact.frame else (0.0, 0.0, 0.0)
        contact = Contact.create(frame, normal, offset, self.normal_frame, impulse)
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
    """

    objective: ImpactObjective
    q: Vector
    posture: str
    speed: float
    restitution: float

    @property
    def robot(self) -> Robot:
        """The robot as loaded."""
        return self.objective.robot

    @property
    def contact(self) -> Contact:
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
        return (*self.robot.warnings, *self.objective.warnings)

    def to_dict(self) -> dict[str, object]:
        """The blocks of ``result.json`` that say what was asked: robot, contacts, supports, metric."""
        normal = self.objective.oracle.at(self.q).n
        return {
            "robot": robot_block(self.robot),
            "contacts": [
                {
                    "frame": self.contact.frame,
                    "offset": list(self.contact.offset),
                    "normal": [float(v) for v in normal],
                    "normal_frame": self.contact.normal_frame,
                    "impulse_bound": self.contact.impulse,
                }
            ],
            "supports": [{"frame": s.frame, "kind": s.kind} for s in self.supports],
            "support_compliance": self.objective.compliance if self.supports else None,
            "metric": {
                "name": self.metric.kind,
                "objective": self.objective.kind,
                "weights": None if self.metric.weights is None else list(self.metric.weights),
                "normal_cone_deg": self.objective.normal_cone_deg,
                "speed": self.speed,
                "restitution": self.restitution,
            },
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


def parse_contact(text: str) -> tuple[str, Vector3, float | None]:
    """Read ``FRAME:NX,NY,NZ[:IMPULSE]``; the frame's name may hold colons itself.

    Raises:
        ContactError: It does not have this form.
    """
    mend = "write FRAME:NX,NY,NZ or FRAME:NX,NY,NZ:IMPULSE"
    parts = text.split(":")
    impulse: float | None = None
    try:
        if len(parts) > 2 and "," not in parts[-1]:
            impulse = float(parts.pop())
        x, y, z = (float(v) for v in parts[-1].split(","))
    except ValueError:
        raise ContactError(f"'{text}' is no contact", where="--contact", mend=mend) from None
    frame = ":".join(parts[:-1])
    if not frame:
        raise ContactError(f"'{text}' names no frame", where="--contact", mend=mend)
    return frame, (x, y, z), impulse


def parse_armature(texts: Sequence[str]) -> Mapping[str, float] | str | None:
    """Read ``--armature``: ``none``, one file, or any number of ``JOINT=VALUE``.

    Raises:
        InputError: A mixture, or a value that is no number.
    """
    if not texts:
        return None
    if len(texts) == 1 and ("=" not in texts[0] or Path(texts[0]).is_file()):
        return texts[0]
    values: dict[str, float] = {}
    for text in texts:
        joint, equals, value = text.rpartition("=")
        try:
            if not equals:
                raise ValueError
            values[joint] = float(value)
        except ValueError:
            raise InputError(
                f"'{text}' is no JOINT=VALUE", where="--armature", mend="give none, one file, or JOINT=VALUE each"
            ) from None
    return values


def resolve_supports(robot: Robot, texts: Sequence[str] | None) -> tuple[Support, ...]:
    """Turn ``FRAME[:point|surface]`` into supports; without texts those of ``robot.toml``.

    A frame that ``robot.toml`` lists keeps its kind, offset and size from there.

    Raises:
        FrameNotFound: With the nearest names.
        InputError: A frame given twice.
    """
    known = {spec.frame: Support.from_spec(spec) for spec in robot.spec.supports}
    if texts is None:
        found = list(known.values())
    else:
        found = [_support(robot, text, known) for text in texts]
    for support in found:
        if sum(s.frame == support.frame for s in found) > 1:
            raise InputError(f"frame '{support.frame}' is given twice", where="--support", mend="remove one")
        point_on(robot, support.frame, support.offset)
    return tuple(found)


def _support(robot: Robot, text: str, known: Mapping[str, Support]) -> Support:
    frame, kind = text, None
    for candidate in get_args(SupportKind):
        if text.endswith(f":{candidate}"):
            frame, kind = text.removesuffix(f":{candidate}"), candidate
    if frame not in robot.frame_names:
        raise FrameNotFound(frame, robot.frame_names, where="--support", mend="(or FRAME:point, FRAME:surface)")
    base = known.get(frame, Support(frame))
    return Support(frame, kind or base.kind, base.offset, base.size)


def _refuse_held(robot: Robot, contact: Contact, supports: Sequence[Support]) -> None:
    """Refuse a blow at a point that a support holds: nothing but the compliance would answer it."""
    point = point_on(robot, contact.frame, contact.offset)
    for support in supports:
        foot = point_on(robot, support.frame, support.offset)
        if foot.joint != point.joint:
            continue
        same_point = float(np.linalg.norm(foot.position - point.position)) < 1e-6
        if support.kind == "surface" or support.frame == contact.frame or same_point:
            raise ContactError(
                f"the contact point is held by the support at '{support.frame}'",
                where=f"--frame {contact.frame}",
                mend="choose another frame, name the other --support frames, or --no-support",
            )


def _default_frame(robot: Robot) -> str:
    if robot.spec.contact.frame is not None:
        return robot.spec.contact.frame
    moving = [f.name for f in robot.model.frames if f.parentJoint > 0]
    raise ContactError(
        f"{robot.name} has no default contact frame",
        where="--frame",
        mend=f"give one, for example {', '.join(dict.fromkeys(moving[:-4:-1]))}",
    )
