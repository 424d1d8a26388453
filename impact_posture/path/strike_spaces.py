"""The constraints of a strike, for the motions before and after the impact."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from impact_posture.dynamics.numeric import Numeric
from impact_posture.impact.worst_case.worst_normal import cone_axes
from impact_posture.path.path_space import PathSpace
from impact_posture.posture.constraints.center_of_mass_over_feet import CenterOfMassOverFeet
from impact_posture.posture.constraints.clearance import Clearance
from impact_posture.posture.constraints.pose_constraints import (
    AxisInCone,
    HeldOrientation,
    HeldPose,
    HeldPosition,
    HeldTurn,
    PositionAlong,
)
from impact_posture.posture.loads.holdable import Holdable, ReachableWrench
from impact_posture.posture.program.constrained_problem import ConstrainedProblem, equality_jacobian
from impact_posture.system.arrays import Array

# After the impact, the contact point may be this far inside the surface, m, because it may slide along the surface.
_PRESSED = 1e-4
# Heights by which a contact point that is inside the surface is lifted before it is pulled onto the constraints, m.
_HEIGHTS = (0.0, 5e-3, 2e-2)
_POSES = (HeldPose, HeldPosition, HeldOrientation, AxisInCone)
# Constraints on a robot at rest, which the limits on the load of a motion replace.
_AT_REST = (CenterOfMassOverFeet, Holdable, ReachableWrench)


class StrikeSpaces:
    """The constraints of a strike at a posture ``q``, shape (nq,), for the motions before and after the impact.

    The surface stays where it is at ``q``.  The contact point must not enter the surface.

    Attributes:
        normal: Normal of the surface at ``q``, world axes, shape (3,).
        approach: Postures on the way to the run-up.  The orientation of the contact frame is held as at the optimum.
        run_up: Postures of the run-up.  In addition, the contact point is on the normal through its place at ``q``.
        rebound: Postures after the impact, which moves all frames except the feet.  The center of mass may leave the
            feet while the robot moves, and the joint limits have no margin.

    Args:
        turns: Whether the contact frame may turn in the run-up.
        normal: Unit normal that replaces the normal of the contact, world axes, shape (3,).
    """

    def __init__(
        self, problem: ConstrainedProblem, q: Array, *, turns: bool = False, normal: Array | None = None
    ) -> None:
        oracle = problem.impact.oracle.at(q)
        self._point, self.normal = oracle.point, oracle.n if normal is None else normal
        tangents = cone_axes(self.normal)[:, 1:].T
        first = len(problem.objective.supports)
        # The constraint on the position comes first.  A constraint on the tilt may follow.
        count = 2 if problem.requirements.contact_pose.startswith("aligned:") else 1
        position, *tilt = problem.constraints[first : first + count]
        turned = [] if turns else [position.orientation, *tilt] if isinstance(position, HeldPose) else tilt
        still = {} if problem.surroundings is None else {
            c.name: c for c in problem.surroundings.fixed_at(q).constraints
        }  # fmt: skip
        rest = [
            still[c.name] if isinstance(c, Clearance) else c
            for k, c in enumerate(problem.constraints)
            if not (first <= k < first + count or c.at_impact)
        ]
        contact_at = self._point, oracle.numeric.placement(self._point).translation
        above = PositionAlong("contact above the surface", *contact_at, self.normal[None], 0.0, np.inf)
        line = PositionAlong("contact on the normal", *contact_at, tangents, 0.0, 0.0)
        dropped = (*_POSES, *_AT_REST) if first else (*_POSES, *_AT_REST, HeldTurn)
        struck = [c for k, c in enumerate(rest) if k < first or not isinstance(c, dropped)]
        pressed = PositionAlong(above.name, *contact_at, self.normal[None], -_PRESSED, np.inf)
        # The stop may use the margin of the joint limits.
        margin = np.where(problem.lower < problem.upper, problem.requirements.limit_margin, 0.0)
        wide = replace(problem, lower=problem.lower - margin, upper=problem.upper + margin)
        self.approach, self.run_up, self.rebound = (
            PathSpace(replace(limited, constraints=tuple(constraints), rows=()))
            for limited, constraints in (
                (problem, [*rest, *turned, above]),
                (problem, [*rest, *turned, above, line]),
                (wide, [*struck, pressed]),
            )
        )

    def rows(self, space: PathSpace) -> Callable[[Numeric], Array]:
        """Return a function for the matrix ``(J_equalities; nᵀJ)`` of a space, shape (m, nv)."""
        return lambda model: np.vstack(
            [equality_jacobian(space.problem, model), self.normal @ model.jacobian(self._point)[:3]]
        )

    def begin(self, start: Array) -> Array | None:
        """Return a posture of ``approach`` near a posture ``start``, shape (nq,); ``None`` if none was reached.

        The surface can be nearer than the contact point at the start, which then has to leave it.
        """
        if self.approach.valid(start):
            return start
        J = self.approach.projector.numeric.at(start).jacobian(self._point)[:3]
        steps = (height * np.linalg.pinv(J) @ self.normal for height in _HEIGHTS)
        pulled = (self.approach.pulled(start, step) for step in steps)
        moved = next((q for q in pulled if q is not None), None)
        return self.approach.apart(start) if moved is None else moved
