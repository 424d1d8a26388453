"""Build the constraints of a posture problem from the requirements of a task."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pinocchio as pin

from impact_posture.config.demand import tilt_of
from impact_posture.config.problem_settings import Vector3
from impact_posture.dynamics.chart import Chart
from impact_posture.dynamics.numeric import Numeric
from impact_posture.errors import InputError
from impact_posture.impact.impact_contact import ImpactContact, point_on
from impact_posture.impact.objective import Objective
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.posture.approach.approach_speed import ApproachSpeed
from impact_posture.posture.approach.attainable_speed import AttainableSpeed
from impact_posture.posture.constraints.center_of_mass_over_feet import CenterOfMassOverFeet
from impact_posture.posture.constraints.constraint import Constraint
from impact_posture.posture.constraints.linear_joints import LinearJoints
from impact_posture.posture.constraints.pose_constraints import (
    AxisInCone,
    HeldOrientation,
    HeldPose,
    HeldPosition,
    PositionBox,
    base_point,
)
from impact_posture.posture.constraints.requirements import Requirements
from impact_posture.posture.constraints.surroundings import Surroundings
from impact_posture.posture.formulation.impact_constraints import impact_constraints
from impact_posture.posture.formulation.landing import landing_feet
from impact_posture.posture.formulation.well_posed import fix_undetermined_motions, make_well_posed
from impact_posture.posture.loads.load_cases import LoadCases, load_cases
from impact_posture.posture.program.constrained_problem import ConstrainedProblem
from impact_posture.robot.robot import Robot
from impact_posture.robot.robot_spec import Support
from impact_posture.robot.support_polygon import polygon_edges
from impact_posture.system.arrays import Array

# The bounds of a follower in the program are wider than its joint limits by this value, rad or m.
_WIDER = 0.01
# After a fall, the center of mass is at least this share of the distance from the middle of the feet to the nearest
# edge of the support polygon inside the polygon.  Near an edge, the feet cannot brake the fall without tipping the
# robot, and the contact point of a round foot moves with the leg.
_LANDING = 0.3


def build_problem(robot: Robot, objective: Objective, given: Array, requirements: Requirements) -> ConstrainedProblem:
    """Build the posture problem from its requirements without solving it.

    Raise ``InputError`` if the requirements contradict each other or do not suit the robot.
    """
    _check(robot, requirements)
    requirements = replace(requirements, hold=robot.fixed_with(requirements.hold))
    numeric = Numeric(robot.model).at(given)
    constraints: list[Constraint] = [held_support(robot, numeric, support) for support in objective.supports]
    held = {s.frame for s in objective.supports}
    poses = (requirements.contact_pose, *requirements.other_poses)
    # If a frame is struck along several normals, its pose is constrained only once.
    struck: dict[str, tuple[ImpactContact, str]] = {}
    # If the objective has no contacts, the contact pose is not used.
    for contact, mode in zip(objective.contacts, poses, strict=bool(objective.contacts)):
        struck.setdefault(contact.frame, (contact, mode))
    for contact, mode in struck.values():
        constraints += _contact_constraints(robot, contact, numeric, requirements, mode)
    for frame in dict.fromkeys(requirements.keep):
        if frame not in held:
            point = point_on(robot, frame)
            constraints.append(HeldPose(f"pose of {frame}", point, numeric.placement(point)))
    constraints += _base_constraints(robot, numeric, requirements)
    decided: list[str] = []
    if requirements.com_over_feet:
        try:
            constraints.append(_com_constraint(objective, numeric, requirements.com_margin))
        except InputError:
            if requirements.com_asked:
                raise
            decided.append("the center of mass is not constrained, because the feet span no area")
    if isinstance(objective, WorstCaseObjective):
        constraints += impact_constraints(objective, numeric, requirements, constraints)
    if requirements.approach_speed > 0:
        attainable = AttainableSpeed(robot, objective, requirements)
        if attainable.unknown:
            note = f"the speed of the approach is not required: {attainable.unknown}"
            decided += [note] if requirements.approach_asked else []
        else:
            try:
                constraints.append(ApproachSpeed(attainable, requirements.approach_speed))
            except InputError:
                if requirements.approach_asked:
                    raise
    lower, upper = _bounds(robot, given, requirements)
    loads = load_cases(objective, given, requirements) if requirements.holdable else LoadCases()
    fixed, notes = fix_undetermined_motions(robot, objective, numeric, requirements, constraints)
    notes = [*decided, *loads.notes, *notes]
    constraints += fixed
    around = None
    if requirements.collision:
        around = _surroundings(objective, numeric, requirements, list(struck.values()))
        constraints += [*around.nested, *around.constraints]
        if requirements.strike:
            spread = around.clearance_of_spread(*requirements.surface_spread)
            constraints += [] if spread is None else [spread]
        notes += around.notes
    constraints += [constraint for case in loads.cases for constraint in case.constraints()]
    constraints += [LinearJoints.coupled(robot, c) for c in robot.couplings if c.follower not in requirements.hold]
    problem = ConstrainedProblem(
        robot, objective, requirements, given, tuple(constraints), lower, upper, (), tuple(notes), around
    )
    return make_well_posed(problem)


def retarget(
    problem: ConstrainedProblem,
    position: Vector3 | None,
    quaternion: tuple[float, float, float, float] | None,
    numeric: Numeric | None = None,
) -> ConstrainedProblem:
    """Return the problem with another target of its only contact frame; the program stays the same.

    The target is a position in world axes, m, and a quaternion x y z w.  If ``position`` or ``quaternion`` is
    ``None``, the initial position or orientation is the target.  If ``numeric`` is given, the function sets it to the
    given posture.

    Raises:
        InputError: The contact pose is free and cannot have a target, or the quaternion does not have unit length.
    """
    requirements = replace(problem.requirements, target_position=position, target_quaternion=quaternion)
    _check_target(requirements)
    (contact,) = problem.objective.contacts
    numeric = (numeric or Numeric(problem.robot.model)).at(problem.given)
    contact_pose = _contact_constraints(problem.robot, contact, numeric, requirements, requirements.contact_pose)
    constraints, first = list(problem.constraints), len(problem.objective.supports)
    # The constraints of the feet come first, followed by the constraints of the contact.
    constraints[first : first + len(contact_pose)] = contact_pose
    return replace(problem, requirements=requirements, constraints=tuple(constraints))


def _surroundings(
    objective: Objective, numeric: Numeric, requirements: Requirements, struck: Sequence[tuple[ImpactContact, str]]
) -> Surroundings:
    """Return the bodies that the links must not touch.

    A contact with a free pose has no surface, because an object hits the robot there.
    """
    around = Surroundings(objective.robot, numeric, requirements.hold, requirements.clearance)
    touching = [contact for contact, mode in struck if mode != "free"]
    around.add_ground(objective.supports, touching)
    feet = [point_on(objective.robot, foot.frame, foot.offset) for foot in objective.supports]
    for contact in touching if requirements.surface != "none" else ():
        width = float("inf") if requirements.surface == "plane" else requirements.surface
        around.add_surface(contact, width if width is None else float(width), feet, objective.contacts)
    around.add_obstacles(requirements.obstacles)
    return around


def _check(robot: Robot, requirements: Requirements) -> None:
    if not robot.floating and requirements.base != "free":
        fault = f"base '{requirements.base}' needs a floating base, but the root of the robot is fixed"
        raise InputError(fault, where="base", hint="leave out `base` or use `root` free-flyer")
    if requirements.keep_contacts and not requirements.friction > 0:
        raise InputError(f"is {requirements.friction:g}", where="friction", hint="give a coefficient above zero")
    if requirements.hold_force and not requirements.holdable:
        raise InputError(
            "has no effect without `holdable`", where="hold_force", hint="add `holdable`, or omit `hold_force`"
        )
    for joint in requirements.hold:
        robot.joint_id(joint)
    _check_target(requirements)


def _check_target(requirements: Requirements) -> None:
    quaternion = requirements.target_quaternion
    if requirements.other_poses and (quaternion is not None or requirements.target_position is not None):
        fault = "is a single target, but there are several contacts"
        hint = "leave out the target and start from a `posture` that has the contacts in place"
        raise InputError(fault, where="target_quaternion" if quaternion is not None else "target_position", hint=hint)


def held_support(robot: Robot, numeric: Numeric, support: Support) -> Constraint:
    """Return the constraint that a foot stays where it is at ``numeric.q``."""
    point = point_on(robot, support.frame, support.offset)
    placement = numeric.placement(point)
    if support.kind == "point":
        return HeldPosition(f"foot {support.frame}", point, placement.translation)
    return HeldPose(f"foot {support.frame}", point, placement)


def contact_target(robot: Robot, contact: ImpactContact, numeric: Numeric, requirements: Requirements) -> pin.SE3:
    """Return the target pose of a contact frame; without targets, it is the pose at ``numeric.q``."""
    placement = numeric.placement(point_on(robot, contact.frame)).copy()
    if requirements.target_position is not None:
        placement.translation = np.array(requirements.target_position)
    if requirements.target_quaternion is not None:
        quaternion = pin.Quaternion(np.array(requirements.target_quaternion))
        placement.rotation = quaternion.normalized().matrix()
    return placement


def _contact_constraints(
    robot: Robot, contact: ImpactContact, numeric: Numeric, requirements: Requirements, mode: str
) -> list[Constraint]:
    point = point_on(robot, contact.frame)
    target = contact_target(robot, contact, numeric, requirements)
    name = f"pose of {contact.frame}"
    if mode == "free":
        if requirements.target_position is not None or requirements.target_quaternion is not None:
            fault = "a target is given but the contact pose is free"
            raise InputError(fault, where="contact_pose", hint="use full, position, aligned or box")
        return []
    if mode == "full":
        return [HeldPose(name, point, target)]
    n = np.array(contact.normal)
    axis = n if contact.normal_frame == "contact" else target.rotation.T @ n
    if mode == "aligned":
        return [HeldPose(name, point, target, axis)]
    if (degrees := tilt_of(mode)) is not None:
        held = HeldPosition(f"position of {contact.frame}", point, target.translation)
        return [held, AxisInCone(f"tilt of {contact.frame}", point, axis, target.rotation @ axis, degrees)]
    if mode == "box":
        return [PositionBox(f"position of {contact.frame}", point, target.translation, requirements.box)]
    return [HeldPosition(f"position of {contact.frame}", point, target.translation)]


def _base_constraints(robot: Robot, numeric: Numeric, requirements: Requirements) -> list[Constraint]:
    if not robot.floating:
        return []
    base = base_point()
    placement, vertical = numeric.placement(base), np.array([0.0, 0.0, 1.0])
    if requirements.base == "level":
        return [HeldOrientation("level base", base, np.eye(3), vertical)]
    if (degrees := tilt_of(requirements.base)) is not None:
        assert robot.upright is not None  # noqa: S101 (narrows a type)
        return [AxisInCone("tilt of the base", base, robot.upright, vertical, degrees)]
    if requirements.base == "fixed":
        return [HeldPose("base", base, placement)]
    if requirements.base == "box":
        return [PositionBox("base position", base, placement.translation, requirements.base_box)]
    return []


def _com_constraint(objective: Objective, numeric: Numeric, margin: float) -> CenterOfMassOverFeet:
    """Return the constraint for the feet, or else for the contacts on which the robot lands.

    A contact point moves if its frame turns about its held origin, so the polygon of a landing has the origins as
    corners, or the corners of soles.
    """
    landing = (foot if foot.has_sole else Support(foot.frame) for foot in landing_feet(objective))
    feet = objective.supports or tuple(landing)
    points = [point_on(objective.robot, foot.frame, corner) for foot in feet for corner in foot.corners]
    corners = [numeric.placement(point).translation[:2] for point in points]
    edges = polygon_edges(corners)
    if edges is None:
        fault = "the feet span no area above which the center of mass could stay"
        hint = "give three feet or soles with a size, set com_over_feet = false, or choose no `com`"
        raise InputError(fault, where="com_over_feet", hint=hint)
    if not objective.supports:
        normals, offsets = edges
        margin = max(margin, _LANDING * float((offsets - normals @ np.mean(corners, axis=0)).min()))
    return CenterOfMassOverFeet(*edges, margin)


def _bounds(robot: Robot, given: Array, requirements: Requirements) -> tuple[Array, Array]:
    """Return the joint limits minus the margin, in chart coordinates, shape (nx,); held joints have equal limits."""
    chart, followers = Chart(robot.model), {c.follower for c in robot.couplings}
    lower, upper = chart.bounds()
    x = chart.to_x(given)
    margin = requirements.limit_margin
    lower, upper = lower + margin, upper - margin
    for slot in chart.slots:
        if slot.name in requirements.hold:
            lower[slot.x] = upper[slot.x] = x[slot.x]
        elif slot.name in followers:
            # The limits of the leader imply the limits of the follower.  With wider bounds for the follower, only
            # one of the two limits is active.
            lower[slot.x] -= margin + _WIDER
            upper[slot.x] += margin + _WIDER
        elif (lower[slot.x] > upper[slot.x]).any():
            fault = f"a margin of {margin:g} leaves joint '{slot.name}' no room to move"
            raise InputError(fault, where="limit_margin", hint="give a smaller margin")
    return lower, upper
