"""What an optimal posture may be up to that no constraint forbids: said in words, since nothing prevents it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from impact_posture.dynamics.numeric import Numeric
from impact_posture.impact.contact import point_on
from impact_posture.posture.problem_settings import Prepared
from impact_posture.posture.solve import PostureSolution
from impact_posture.robot.actuation import hover

Vector = NDArray[np.float64]

# A joint further than this behind a surface, meters, is worth a word.
_BEHIND = 0.01


def caveats(prepared: Prepared, solution: PostureSolution) -> list[str]:
    """Lines about hovering, about the surface that is touched, about the ground and about the compiler."""
    return [
        *([solution.compiler_fault] if solution.compiler_fault else []),
        *_hover_warnings(prepared, solution),
        *_surface_warnings(prepared, solution),
        *_ground_warnings(prepared, solution),
    ]


def _hover_warnings(prepared: Prepared, solution: PostureSolution) -> list[str]:
    """What keeps an aerial robot from hovering in the optimal posture."""
    robot = prepared.impact.robot
    if robot.spec.propulsion is None or not robot.floating:
        return []
    violations = hover(robot.model, robot.spec.propulsion, solution.q).violations
    return [f"the robot cannot hover in the optimal posture: {violation}" for violation in violations]


def _surface_warnings(prepared: Prepared, solution: PostureSolution) -> list[str]:
    """Links whose origin lies behind the contact's plane: nothing keeps the robot on its side of the surface.

    A push (a contact pose that is free) has no surface.
    """
    if prepared.problem.requirements.contact_pose == "free":
        return []
    behind = [_joints_behind(prepared, q) for q in (solution.initial, solution.q)]
    lines = []
    if behind[0]:
        lines.append(
            f"the initial posture has {_named(behind[0])} behind the surface: the normal points out of it, "
            "towards the robot; check its sign"
        )
    new = [name for name in behind[1] if name not in behind[0]]
    if new:
        lines.append(
            f"the optimal posture brings {_named(new)} behind the plane of the surface: it is not kept out of it; "
            "bound the base or the joints if the surface reaches that far"
        )
    return lines


def _joints_behind(prepared: Prepared, q: Vector) -> list[str]:
    """Joints whose origin lies behind the contact's plane; the link that touches reaches to the surface itself."""
    oracle = prepared.impact.objective.oracle.at(q)
    contact = oracle.numeric.placement(oracle.point).translation
    n, touching = oracle.n.copy(), oracle.point.joint
    return [
        name
        for joint, name, origin in _origins(prepared, oracle.numeric)
        if joint != touching and n @ (origin - contact) < -_BEHIND
    ]


def _ground_warnings(prepared: Prepared, solution: PostureSolution) -> list[str]:
    """Joints below the lowest foot, where level ground would be: nothing keeps a knee above it."""
    robot, supports = prepared.impact.robot, prepared.impact.supports
    if not supports:
        return []
    numeric = Numeric(robot.model).at(solution.q)
    ground = min(numeric.placement(point_on(robot, s.frame, s.offset)).translation[2] for s in supports)
    below = [name for _, name, origin in _origins(prepared, numeric) if origin[2] < ground - _BEHIND]
    if not below:
        return []
    return [
        f"the optimal posture has {_named(below)} below the lowest foot: nothing keeps them above the ground; narrow "
        "their limits (robot.toml [limits.position]) or stay nearer with `regularization`"
    ]


def _origins(prepared: Prepared, numeric: Numeric) -> list[tuple[int, str, Vector]]:
    """Index, name and world origin of every joint at the numeric model's posture."""
    model = prepared.impact.robot.model
    return [
        (i, "the base" if model.names[i] == "root_joint" else str(model.names[i]), numeric.data.oMi[i].translation)
        for i in range(1, model.njoints)
    ]


def _named(names: list[str]) -> str:
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more joints" if len(names) > 3 else "")
