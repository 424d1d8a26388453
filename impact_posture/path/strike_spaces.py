"""The constraints of a strike at one or several contacts, for the motions before and after the impact."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from impact_posture.dynamics.numeric import Numeric
from impact_posture.impact.worst_case.worst_normal import cone_axes
from impact_posture.path.path_space import PathSpace
from impact_posture.posture.constraints.center_of_mass_over_feet import CenterOfMassOverFeet
from impact_posture.posture.constraints.clearance import Clearance
from impact_posture.posture.constraints.constraint import Constraint
from impact_posture.posture.constraints.pose_constraints import (
    AxisInCone,
    HeldOrientation,
    HeldPose,
    HeldPosition,
    HeldTurn,
    PositionAlong,
)
from impact_posture.posture.formulation.build_problem import held_support
from impact_posture.posture.formulation.landing import falls_freely, landing_feet
from impact_posture.posture.loads.holdable import Holdable, ReachableWrench
from impact_posture.posture.program.constrained_problem import ConstrainedProblem, equality_jacobian
from impact_posture.system.arrays import Array

# Largest distance, m, of a contact point inside the surface after the impact, where the point may slide along the
# surface.
_PRESSED = 1e-4
# Heights by which a contact point that is inside the surface is lifted before it is pulled onto the constraints, m.
_HEIGHTS = (0.0, 5e-3, 2e-2)
_POSES = (HeldPose, HeldPosition, HeldOrientation, AxisInCone)
# Constraints on a robot at rest, which the limits on the load of a motion replace.
_AT_REST = (CenterOfMassOverFeet, Holdable, ReachableWrench)


def landed(problem: ConstrainedProblem, q: Array) -> ConstrainedProblem:
    """Return the problem of a robot that stands on its contacts after a fall; the contact points stay as at ``q``."""
    feet, numeric = landing_feet(problem.objective), Numeric(problem.robot.model).at(q)
    held = [held_support(problem.robot, numeric, foot) for foot in feet]
    objective = replace(problem.impact, supports=feet)
    return replace(problem, objective=objective, constraints=(*held, *problem.constraints), rows=())


class StrikeSpaces:
    """The constraints of a strike at a posture ``q``, shape (nq,), for the motions before and after the impact.

    The surfaces stay where they are at ``q``.  No contact point must enter its surface.

    Attributes:
        normals: Normals of the m surfaces at ``q``, world axes, shape (m, 3).
        approach: Postures on the way to the run-up.  The orientations of the contact frames are held as at the
            optimum.  A robot that falls has no other held frames.
        run_up: Postures of the run-up.  In addition, each contact point is on the normal through its position at
            ``q``.
        rebound: Postures after the impact, in which all frames except the feet may move.  The center of mass may
            leave the feet while the robot moves, and the joint limits have no margin.

    Args:
        turns: Whether the contact frames may turn in the run-up.
        normals: Unit normals that replace the normals of the contacts, world axes, shape (m, 3).
    """

    def __init__(
        self, problem: ConstrainedProblem, q: Array, *, turns: bool = False, normals: Array | None = None
    ) -> None:
        oracles = [single.oracle.at(q) for single in problem.impact.singles]
        self._points = [oracle.point for oracle in oracles]
        self.normals = np.array([oracle.n for oracle in oracles]) if normals is None else normals
        wanted, first = problem.requirements, len(problem.objective.supports)
        poses, turned, end = dict[str, str](), list[Constraint](), first
        for contact, pose in zip(problem.objective.contacts, (wanted.contact_pose, *wanted.other_poses), strict=True):
            poses.setdefault(contact.frame, pose)
        for pose in poses.values():
            # The first constraint of a contact is on the position; a second constraint may be on the tilt.
            position, *tilt = problem.constraints[end : end + 1 + pose.startswith("aligned:")]
            turned += [position.orientation, *tilt] if isinstance(position, HeldPose) else tilt
            end += 1 + len(tilt)
        still = {} if problem.surroundings is None else {
            c.name: c for c in problem.surroundings.fixed_at(q).constraints
        }  # fmt: skip
        rest = [
            still[c.name] if isinstance(c, Clearance) else c
            for k, c in enumerate(problem.constraints)
            if not (first <= k < end or c.at_impact)
        ]
        dropped = (*_POSES, *_AT_REST) if first else (*_POSES, *_AT_REST, HeldTurn)
        struck = [c for k, c in enumerate(rest) if k < first or not isinstance(c, dropped)]
        falls = falls_freely(problem.objective, wanted.base)
        held = [c for c in rest if not (falls and isinstance(c, _POSES))]
        held += [] if turns else turned
        above, line, pressed = list[Constraint](), list[Constraint](), list[Constraint]()
        for oracle, n in zip(oracles, self.normals, strict=True):
            at = oracle.point, oracle.numeric.placement(oracle.point).translation
            above.append(PositionAlong("contact above the surface", *at, n[None], 0.0, np.inf))
            line.append(PositionAlong("contact on the normal", *at, cone_axes(n)[:, 1:].T, 0.0, 0.0))
            pressed.append(PositionAlong(above[-1].name, *at, n[None], -_PRESSED, np.inf))
        # The stop may use the margin of the joint limits.
        margin = np.where(problem.lower < problem.upper, wanted.limit_margin, 0.0)
        wide = replace(problem, lower=problem.lower - margin, upper=problem.upper + margin)
        self.approach, self.run_up, self.rebound = (
            PathSpace(replace(limited, constraints=tuple(constraints), rows=()))
            for limited, constraints in (
                (problem, [*held, *above]),
                (problem, [*held, *above, *line]),
                (wide, [*struck, *pressed]),
            )
        )

    def along(self, model: Numeric) -> Array:
        """Return the rows ``n_iᵀJ_i``, shape (m, nv)."""
        return np.array([n @ model.jacobian(at)[:3] for n, at in zip(self.normals, self._points, strict=True)])

    def rows(self, space: PathSpace) -> Callable[[Numeric], Array]:
        """Return a function for the matrix ``(J_equalities; n_iᵀJ_i)`` of a space, shape (rows + m, nv)."""
        return lambda model: np.vstack([equality_jacobian(space.problem, model), self.along(model)])

    def begin(self, start: Array) -> Array | None:
        """Return a posture of ``approach`` near a posture ``start``, shape (nq,); ``None`` if none was reached.

        A contact point can be inside the surface at ``start``, and must then first leave the surface.
        """
        if self.approach.valid(start):
            return start
        model = self.approach.projector.numeric.at(start)
        J = np.vstack([model.jacobian(point)[:3] for point in self._points])
        steps = (height * np.linalg.pinv(J) @ self.normals.ravel() for height in _HEIGHTS)
        pulled = (self.approach.pulled(start, step) for step in steps)
        moved = next((q for q in pulled if q is not None), None)
        return self.approach.apart(start) if moved is None else moved
