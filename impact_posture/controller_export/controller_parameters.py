"""Run-time parameters of an exported controller: order in the C structure, rules, and values of the formulation."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from impact_posture.controller_export.controller_structure import Structure
from impact_posture.system.arrays import Array
from impact_posture.tsid.flow.reference_flow_posture import ReferenceFlowPosture
from impact_posture.tsid.joint_ranges import JointRanges
from impact_posture.tsid.limits.acceleration_bounds import LimitLaw
from impact_posture.tsid.tasks.frame_tasks import FrameTask
from impact_posture.tsid.tasks.impact_robust import ImpactRobustPosture

Rule = Literal["finite", "nonnegative", "positive", "limit", "amount", "share"]
# Bit mask of each rule in the C code.  A value must be finite (bit 1), not negative (2), not zero (4), at most one
# (8).
RULES: dict[Rule, int] = {"finite": 1, "nonnegative": 3, "positive": 6, "limit": 0, "amount": 7, "share": 14}

# Name of an option of a reference flow (``_FLOW``) or of an attribute of a contact (``_CONTACT``), its rule, and its
# description in the header.
_FLOW: tuple[tuple[str, Rule, str], ...] = (
    ("speed", "amount", "largest speed of an entry of q_r, rad/s or m/s"),
    ("acceleration", "amount", "largest acceleration, rad/s2 or m/s2"),
    ("rho", "nonnegative", "weight of the squared distance from the start, 1/rad2"),
    ("mu", "amount", "smaller curvatures are raised to this value, 1/rad2"),
    ("epsilon", "amount", "predicted decrease of H/H0 below which the flow rests"),
    ("duration", "amount", "longest motion after each brace, without the time on a path or at rest, s"),
    ("joint_margin", "nonnegative", "distance from the joint limits, rad or m"),
    ("com_margin", "nonnegative", "distance of the center of mass from the edges of the support polygon, m"),
    ("tilt", "amount", "largest tilt of the base from the default posture, rad"),
    ("share", "share", "share of the actuators' limits that static controls may use"),
    ("haste", "share", "fraction of the remaining control range for accelerations; (1 + haste)/2 to brake"),
    ("tracking", "amount", "joint error at which the motion stops and waits, rad or m"),
)
_CONTACT: tuple[tuple[str, Rule, str], ...] = (
    ("kp", "nonnegative", "stiffness, 1/s2"),
    ("kd", "nonnegative", "damping, 1/s"),
    ("friction", "positive", "Coulomb coefficient"),
    ("least", "finite", "least normal force, N"),
    ("normal", "finite", "unit normal out of the ground, world"),
    ("half", "nonnegative", "half extents x, y of a sole, m"),
)


class Field(NamedTuple):
    """Parameter of a controller.

    Attributes:
        name: Name in the C structure.
        rule: Rule for values that the C function ``init`` accepts.  Only ``limit`` and ``positive`` permit infinity.
            A ``share`` is at most 1.
        text: Meaning and unit, for the header.
        value: Values in the exported formulation, as a flat array.
    """

    name: str
    rule: Rule
    text: str
    value: Array


def parameters(s: Structure, period: float) -> Iterator[Field]:
    """Yield the parameters of a formulation with their values, in the order of the C structure.

    ``period`` is the expected time between ticks, s.
    """
    formulation, actuators, ranges = s.formulation, s.actuators, JointRanges(s.robot)
    posture, robust, contacts = formulation.posture, s.robust, formulation.contacts
    law = formulation.law or LimitLaw()
    nv = s.robot.nv

    gains = (("kp", "stiffness, 1/s2"), ("kd", "damping, 1/s"), ("weight", "weight in the cost"))
    yield _field("period", "positive", "expected time between ticks, s", period)
    for name, text in gains:
        rows = np.hstack([np.zeros(0), *(getattr(task, name) for task in s.tasks)])
        yield _field(f"task_{name}", "nonnegative", f"{text}, of each row of the tasks", rows)
    soft = [t._soften if isinstance(t, FrameTask) and t._soften is not None else np.zeros(6) for t in s.tasks]
    yield _field("task_softness", "nonnegative", "inverse apparent inertia of each task, 1/kg and 1/(kg m2)", soft)
    for name, text in gains:
        value = np.zeros(nv) if posture is None else getattr(posture, name)
        yield _field(f"posture_{name}", "nonnegative", f"{text}, of the posture task", value)
    if posture is not None and posture.stiffness is not None and posture.damping is not None:
        yield _field("stiffness", "finite", "K_p of the posture task as a matrix, 1/s2", posture.stiffness)
        yield _field("damping", "finite", "K_d of the posture task as a matrix, 1/s", posture.damping)
    target = None if posture is None else posture._given
    text = "1: reset sets q_des to posture_target; 0: to the present posture"
    yield _field("posture_given", "nonnegative", text, target is not None)
    yield _field("posture_target", "finite", "q_des at reset", s.robot.posture() if target is None else target)
    for name, rule, text in _CONTACT:
        yield _field(f"contact_{name}", rule, f"{text}, of each contact", [getattr(c, name) for c in contacts])
    weights = [1.0 if c.weight is None else c.weight for c in contacts]
    yield _field("contact_weight", "positive", "weight in the cost of each contact that is not hard", weights)
    yield _field("force_weight", "positive", "weight of contact forces, 1/N2", formulation.force_weight)
    spare = formulation.spare_weight
    yield _field("spare_weight", "positive", "weight of thrusts that produce no wrench, 1/N2", spare)
    for name in ("lower", "upper"):
        yield _field(f"control_{name}", "limit", "limits of thrusts, N, and torques, N m", getattr(actuators, name))
    for name in ("lower", "upper"):
        yield _field(f"joint_{name}", "limit", "position limit of each entry of v, rad or m", getattr(ranges, name))
    yield _field("joint_velocity", "positive", "largest rate of each entry of v; may be infinite", ranges.velocity)
    propulsion = s.robot.spec.propulsion
    thrust = 1.0 if propulsion is None else propulsion.thrust_coefficient
    yield _field("thrust_coefficient", "positive", "thrust per squared rotor speed", thrust)
    for name in ("approach", "rate", "deceleration", "acceleration"):
        yield _field(f"law_{name}", "positive", f"{name} of the law of the joint limits", getattr(law, name))
    yield _field("law_margin", "nonnegative", "distance from the position limits at which joints stop", law.margin)
    if s.flow is not None:
        yield from _flow_fields(s.flow)
    if robust is not None:
        yield from _robust_fields(robust)


def _flow_fields(flow: ReferenceFlowPosture) -> Iterator[Field]:
    for name, rule, text in _FLOW:
        yield _field(f"flow_{name}", rule, f"{text}, of the flow", getattr(flow.options, name))
    if flow._path:
        yield _field("flow_path", "finite", "postures that the flow visits first", flow._path)


def _robust_fields(robust: ImpactRobustPosture) -> Iterator[Field]:
    scale, spring = 0 if robust._measure else robust.scale, ("keep", "release", "follow").index(robust.spring)
    ramp, live = robust.activation.ramp, robust.activation.live
    yield _field("robust_gain", "nonnegative", "K, 1/s2", robust.K)
    yield _field("robust_scale", "nonnegative", "lambda; 0: measured at reset", scale)
    yield _field("robust_reach", "positive", "largest length of the term, divided by K, rad", robust.reach)
    vanishes = "distance from a position limit at which the term vanishes, for each joint"
    yield _field("robust_near", "nonnegative", vanishes, robust._near)
    yield _field("robust_band", "positive", "width of the fade of each joint; may be infinite", robust._band)
    begins = "distance from a limit at which a fade can begin, rad"
    yield _field("robust_far", "positive", begins, robust._farthest)
    yield _field("robust_every", "positive", "number of ticks per evaluation of the gradient", robust.every)
    yield _field("robust_ramp", "positive", "time from level 0 to 1, s", ramp)
    yield _field("robust_live", "nonnegative", "1: the term stays on during the contact", live)
    yield _field("robust_follow", "positive", "time constant of q_des if robust_spring is 2, s", robust._follow)
    yield _field("robust_spring", "nonnegative", "mode: 0 keep, 1 release, 2 follow", spring)


def _field(name: str, rule: Rule, text: str, value: ArrayLike) -> Field:
    values = np.array(value, dtype=float).ravel()
    # C arrays cannot have the length zero.
    return Field(name, rule, text, values if values.size else np.ones(1))
