"""Warnings about an optimal or reachable posture that the robot cannot hold or that crosses a surface."""

from __future__ import annotations

import numpy as np

from impact_posture.dynamics.numeric import Numeric
from impact_posture.errors import listed
from impact_posture.impact.impact_contact import point_on
from impact_posture.posture.formulation.problem_file import Prepared
from impact_posture.posture.loads.holding_forces import HoldingForces
from impact_posture.robot.model_joints import rigid_groups
from impact_posture.robot.support_polygon import nearest_in_hull, polygon_edges
from impact_posture.system.arrays import Array

# A center of mass outside the feet by at most this value (m) is not reported.
_OUTSIDE = 0.01
# Origins of joints or links are reported if they are farther than this value (m) behind a surface or below the
# ground.
_BEHIND = 0.01


def posture_warnings(
    prepared: Prepared, initial: Array, q: Array, holding: HoldingForces | None, name: str = "optimal"
) -> list[str]:
    """Return warnings about holding forces, surface and ground for the posture ``q`` with the name ``name``.

    ``holding`` are the forces that hold this posture; ``None`` if unknown.
    """
    verb = "hold" if prepared.impact.robot.spec.propulsion is None else "hover in"
    loads = holding.violations() if holding else []
    held = [f"the robot cannot {verb} the {name} posture: {violation}" for violation in loads]
    if not prepared.impact.early_touches(initial):
        touches = prepared.impact.touch_warnings(q, "`contact_pose` full")
        held += [f"in the {name} posture, {touch}" for touch in touches]
    held += _balance_warnings(prepared, q, name) if holding is None else []
    return [*held, *_surface_warnings(prepared, initial, q, name), *_ground_warnings(prepared, q, name)]


def _balance_warnings(prepared: Prepared, q: Array, posture: str) -> list[str]:
    """Warn about a center of mass that is not above the feet, which is possible without ``com_over_feet``."""
    robot, supports = prepared.impact.robot, prepared.impact.supports
    if not supports:
        return []
    numeric = Numeric(robot.model).at(q)
    points = [point_on(robot, support.frame, corner) for support in supports for corner in support.corners]
    corners = np.array([numeric.placement(point).translation[:2] for point in points])
    outside = float(np.linalg.norm(nearest_in_hull(corners - numeric.center_of_mass()[0][:2])))
    if outside <= _OUTSIDE:
        return []
    hint = (
        "require `com_over_feet`"
        if polygon_edges(corners)
        else "give the soles a size (robot.toml [[supports]] size)"
    )
    text = (
        f"the {posture} posture has the center of mass {outside:.2g} m outside the feet, so the robot falls: {hint}"
    )
    return [text]


def _surface_warnings(prepared: Prepared, initial: Array, q: Array, posture: str) -> list[str]:
    """Warn about joints or links behind the contact plane, if no constraint keeps them in front of this plane."""
    requirements = prepared.problem.requirements
    # With a free contact pose, an object pushes the robot, so there is no surface.
    if requirements.contact_pose == "free" or requirements.surface == "none":
        return []
    before, after = (_behind(prepared, posture) for posture in (initial, q))
    lines = []
    if before:
        lines.append(
            f"the initial posture has {listed(before, 3)} behind the surface: the normal must point out of it, "
            "towards the robot; check its sign"
        )
    new = [name for name in after if name not in before]
    if new:
        lines.append(
            f"the {posture} posture brings {listed(new, 3)} behind the plane of the surface: no constraint prevents "
            "this; bound the base or the joints if the surface reaches that far"
        )
    return lines


def _behind(prepared: Prepared, q: Array) -> list[str]:
    """Return the links or joints behind the contact plane, except those that move rigidly with the contact link."""
    oracle, around = prepared.impact.objective.oracle.at(q), prepared.problem.surroundings
    contact, n = oracle.numeric.placement(oracle.point).translation, oracle.n.copy()
    depth = around.depth(prepared.impact.contact) if around else 0.0
    group = rigid_groups(prepared.impact.robot.model, prepared.problem.requirements.hold)
    return [
        name
        for joint, name, origin in _origins(prepared, oracle.numeric)
        if group[joint] != group[oracle.point.joint] and n @ (origin - contact) < -depth - _BEHIND
    ]


def _ground_warnings(prepared: Prepared, q: Array, posture: str) -> list[str]:
    """Warn about joints or links below the lowest foot, if no constraint keeps them above flat ground."""
    robot, supports = prepared.impact.robot, prepared.impact.supports
    if not supports:
        return []
    numeric = Numeric(robot.model).at(q)
    ground = min(numeric.placement(point_on(robot, s.frame, s.offset)).translation[2] for s in supports)
    below = [name for _, name, origin in _origins(prepared, numeric) if origin[2] < ground - _BEHIND]
    text = (
        f"the {posture} posture has {listed(below, 3)} below the lowest foot: no constraint keeps them above the "
        "ground; narrow their limits (robot.toml [limits.position]) or stay nearer with `regularization`"
    )
    return [text] if below else []


def _origins(prepared: Prepared, numeric: Numeric) -> list[tuple[int, str, Array]]:
    """Return joint index, name and world origin of the links whose distances no collision constraint checks.

    Links without shapes have no collision constraints.  If no link has a shape, or if there are no collision
    constraints, all joints are returned instead.
    """
    robot, around = prepared.impact.robot, prepared.problem.surroundings
    if around is not None and around.shapes.bodies:
        frames = [robot.model.frames[robot.frame_id(link)] for link in around.shapes.without_shapes]
        joints = [int(frame.parentJoint) for frame in frames]
        placed = zip(joints, frames, strict=True)
        return [(k, f"link {f.name}", (numeric.data.oMi[k] * f.placement).translation) for k, f in placed if k > 0]
    names = ["the base" if name == "root_joint" else str(name) for name in robot.model.names]
    return [(k, names[k], numeric.data.oMi[k].translation) for k in range(1, robot.model.njoints)]
