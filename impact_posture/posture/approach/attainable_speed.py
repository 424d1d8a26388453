"""The highest speed at which the joints can bring the contact to the surface.

An impact-robust arm is often stretched along the normal, and a stretched arm cannot move in this direction.  In a
stretched posture, the impact changes the joint velocities little, but the joints cannot bring the contact to the
surface at the required speed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from operator import attrgetter

import casadi as ca
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impact_posture.dynamics.chart import BOUNDED, Chart
from impact_posture.dynamics.linear_program import solve_linear
from impact_posture.dynamics.numeric import Numeric
from impact_posture.dynamics.tree import PointOnLink, Tree
from impact_posture.impact.impact_contact import point_on
from impact_posture.impact.objective import Objective
from impact_posture.posture.constraints.requirements import Requirements
from impact_posture.posture.program.constrained_problem import RANK_TOLERANCE, held_rows
from impact_posture.robot.robot import Robot
from impact_posture.system.arrays import Array, independent_rows

# A contact speed (m/s) or velocity limit (rad/s or m/s) of at least this value is treated as unbounded.
FASTEST = 1e3
# Shortest duration of a run-up, s, which a controller can follow.
RUN_UP = 0.1
# A joint with the velocity ν at the impact needs the distance ``_ROOM · ν`` for its run-up; ``_ROOM`` is in s.  The
# velocity rises from rest, so its mean is about ν/2.  The factor 1.1 is needed because the velocity does not rise
# exactly linearly.
_ROOM = 1.1 * RUN_UP / 2
# Fraction of the velocity limits that a strike may use at the impact; some joints are faster before the impact.
USABLE = 0.97


@dataclass(frozen=True, eq=False)
class MovingPoint:
    """Required motion of a point at approach speed σ: the constrained rows of ``(D v, D ω)`` equal ``−σ d``.

    ``v`` and ``ω`` are the linear and angular velocity of the point in world axes.

    Attributes:
        axes: Matrix ``D``, shape (3, 3), whose rows are the normal and two tangents, or the axes of the world.
        rows: Indices of the constrained rows of ``(D v, D ω)``.
        comes: Whether the point moves towards the surface.  If true, the first row is ``nᵀv = −σ``; if false, ``d``
            is 0.
        in_frame: Whether the axes turn with the frame of the point; otherwise they are fixed in the world.
    """

    name: str
    point: PointOnLink
    axes: Array
    rows: tuple[int, ...]
    comes: bool = False
    in_frame: bool = False

    @property
    def arrives(self) -> Array:
        """Vector ``d`` for the constrained rows, shape (k,): 1 for the approach, 0 for other rows."""
        return np.array([float(self.comes and row == 0) for row in self.rows])

    def wrench(self, weights: Array) -> Array:
        """Return the wrench, force above moment, whose power is the weighted sum of the rows, shape (6,)."""
        wrench = np.zeros(6)
        wrench[list(self.rows)] = weights
        return np.concatenate([self.axes.T @ wrench[:3], self.axes.T @ wrench[3:]])

    def jacobian(self, model: Numeric) -> Array:
        """Return the matrix that maps ``ν`` to the constrained rows of ``(D v, D ω)``, shape (k, nv)."""
        J = model.jacobian(self.point)
        D = self.axes @ model.placement(self.point).rotation.T if self.in_frame else self.axes
        return np.vstack([D @ J[:3], D @ J[3:]])[list(self.rows)]

    def symbolic(self, tree: Tree, velocities: dict[int, ca.SX], axes: ca.SX) -> ca.SX:
        """Return the constrained rows of ``(D v, D ω)`` as an expression of the link velocities, shape (k, 1)."""
        twist = tree.point_velocity(self.point, velocities)
        if self.in_frame:
            R = tree.rotations[self.point.joint] @ ca.SX(self.point.rotation)
            axes = axes @ R.T
        return ca.vertcat(axes @ twist[:3], axes @ twist[3:])[list(self.rows)]


@dataclass(frozen=True, eq=False)
class Attained:
    """The fastest approach at a posture; ``speed`` is ``σ``, m/s, infinite if no velocity limit bounds it.

    ``velocities`` are the free velocities (:class:`AttainableSpeed`) at the speed ``min(σ, FASTEST)``, divided by
    their scales, shape (k,).  ``gradient`` is the tangent gradient of the speed, shape (nv,).
    """

    speed: float
    velocities: Array
    gradient: Array


class AttainableSpeed:
    """The largest σ(q) with ``nᵀJν = −σ`` for a generalized velocity within its limits, ``|ν_i| ≤ ν̄_i``.

    The contact point moves only along the normal, and the frames in :attr:`Requirements.keep` do not move.  The
    contact frame turns only if :attr:`Requirements.contact_pose` allows this, or if there are too few joints to
    prevent a turn.  Several contacts all approach at the speed ``σ``, and may also move tangentially, except in a
    strike.  The base and feet of a standing robot do not move.  The base of a robot without feet can move at any
    speed.  A contact whose ``contact_pose`` is ``free`` is left out, because there an object hits the robot.

    For a strike (:attr:`Requirements.strike`), the joints also need room for a run-up: ``q_i − ν_i t`` is within the
    joint limits.  The time ``t`` is slightly longer than half of the shortest run-up.  A strike may use only the
    fraction :data:`USABLE` of the velocity limits.

    Attributes:
        unknown: Reason why the speed is not computed; empty if it is computed.  A computed speed can still be
            infinite at some postures.
        free: Indices of the free velocities, the entries of ``ν`` that may be nonzero, shape (k,).
        scale: Unit of each free velocity, rad/s or m/s, shape (k,).
        moves: Matrix that maps the free velocities, divided by ``scale``, to ``ν``, including coupled joints, shape
            (nv, k).
        upper: Limit of each free velocity, divided by ``scale``, shape (k,); infinite if the URDF has no limit.
        roomy: Indices, in ``free``, of the joints that need room for a run-up, shape (r,).
        lowest, highest: Position limits of the joints ``roomy``, reduced by the margin, rad or m, shape (r,).
    """

    def __init__(self, robot: Robot, objective: Objective, requirements: Requirements) -> None:
        self._model, self._coupling = robot.model, robot.coupling_matrix
        self.points = _moving_points(robot, objective, requirements)
        flies = robot.floating and not objective.supports and requirements.base != "fixed"
        joints = np.arange(robot.nv) >= (0 if flies or not robot.floating else 6)
        bringing = joints & self._chain([moved.point for moved in self.points if moved.comes])
        standing = self._chain([point_on(robot, support.frame) for support in objective.supports])
        free = joints & self._chain([moved.point for moved in self.points]) & ~robot.followers
        free &= ~held_rows(robot, requirements.hold).any(axis=0)
        self.free = np.flatnonzero(free)
        limit = robot.velocity_limits[self.free]
        stated, most = limit < FASTEST, USABLE if requirements.strike else 1.0
        self.scale, self.upper = np.where(stated, limit, 1.0), np.where(stated, most, np.inf)
        self.moves = self._coupling[:, self.free] * self.scale
        self.names = [robot.tangent_names[k] for k in self.free]
        chart, margin = Chart.of(robot.model), requirements.limit_margin
        slots = [slot for slot in chart.slots if slot.kind.family in BOUNDED and requirements.strike]
        in_v, in_q, in_x = (
            np.array([k for slot in slots for k in range(part(slot).start, part(slot).stop)], dtype=int)
            for part in (attrgetter("v"), attrgetter("q"), attrgetter("x"))
        )
        low, high = (bounds[in_x] for bounds in chart.bounds())
        roomy = np.isin(in_v, self.free) & (np.isfinite(low) | np.isfinite(high))
        self.roomy, self._places = np.searchsorted(self.free, in_v[roomy]), in_q[roomy].tolist()
        self.lowest, self.highest = low[roomy] + margin, high[roomy] - margin
        self.unknown = ""
        if robot.floating and not flies and self.points and ((bringing & standing).any() or not bringing.any()):
            self.unknown = "the legs move the contact, and the speed of such a motion is not computed"
        elif not self.points or flies or (free.any() and not stated.any()):
            self.unknown = "nothing bounds it, because no joint with a velocity limit determines this speed"
        if len(self.independent) > len(self.free):
            self.points = [replace(moved, rows=moved.rows[:3]) if moved.comes else moved for moved in self.points]

    def _chain(self, points: Sequence[PointOnLink]) -> NDArray[np.bool_]:
        """Return a mask, shape (nv,), of the entries of the generalized velocity that move any of the points."""
        moves, model = np.zeros(self._model.nv, dtype=bool), self._model
        for point in points:
            for joint in model.supports[point.joint].tolist()[1:]:
                moves[model.idx_vs[joint] : model.idx_vs[joint] + model.nvs[joint]] = True
        return np.asarray(moves @ (self._coupling != 0))

    @property
    def independent(self) -> list[int]:
        """Indices of linearly independent rows of :meth:`jacobian`.

        For example, a planar robot cannot leave its plane, so the rows for motion out of the plane are zero.
        """
        if not self.points:
            return []
        rng, model, blocks = np.random.default_rng(0), Numeric(self._model), []
        for _ in range(2):
            q = pin.integrate(self._model, pin.neutral(self._model), rng.normal(size=self._model.nv))
            blocks.append(self.jacobian(model.at(q)) / self.scale)
        return independent_rows(np.column_stack([*blocks, self.arrives]), RANK_TOLERANCE)

    @property
    def arrives(self) -> Array:
        """Vector ``d`` of all points, shape (m,): 1 for the approach, 0 for other rows."""
        return np.concatenate([point.arrives for point in self.points])

    def jacobian(self, model: Numeric) -> Array:
        """Return the matrix that maps the scaled free velocities to the rows of all points, shape (m, k)."""
        rows = np.vstack([point.jacobian(model) for point in self.points])
        return np.asarray(rows @ self.moves)

    def by_posture(self, model: Numeric, velocities: Array, weights: Array) -> Array:
        """Return the tangent gradient, shape (nv,), of the weighted sum of all rows for constant velocities."""
        v = self.moves @ velocities
        gradient = np.zeros(len(v))
        ends = np.cumsum([len(moved.rows) for moved in self.points])[:-1]
        for moved, weight in zip(self.points, np.split(weights, ends), strict=True):
            gradient += model.coupling_gradient(moved.point, moved.wrench(weight), v, in_frame=moved.in_frame)
        return gradient

    def begins(self, q: Array | ca.SX, velocities: Array | ca.SX) -> Array | ca.SX:
        """Return the positions, rad or m, at which the joints :attr:`roomy` begin a run-up, shape (r,)."""
        return q[self._places] - self.room @ velocities

    @property
    def room(self) -> Array:
        """Map from the free velocities to the distances that a run-up needs, rad or m, shape (r, k)."""
        return np.asarray(_ROOM * np.diag(self.scale)[self.roomy])

    def at(self, model: Numeric) -> Attained:
        """Return the fastest approach at ``model.q``."""
        A = np.column_stack([self.jacobian(model), self.arrives])
        rows, cost = np.zeros(len(A)), np.zeros(A.shape[1])
        cost[-1] = -1.0
        high = np.append(self.upper, FASTEST)
        # A joint outside its limits may still move towards them, or be at rest.
        still = self.begins(model.q, np.zeros(len(self.free)))
        down, up = np.minimum(self.lowest - still, 0.0), np.maximum(self.highest - still, 0.0)
        optimum = solve_linear(
            cost,
            np.vstack([A, np.column_stack([-self.room, np.zeros(len(self.roomy))])]),
            np.append(rows, down),
            np.append(rows, up),
            np.append(-self.upper, 0.0),
            high,
        )
        if optimum is None:
            return Attained(0.0, np.zeros(len(self.free)), np.zeros(model.model.nv))
        if -optimum.value > (1 - 1e-9) * FASTEST:
            return Attained(float("inf"), optimum.x[:-1], np.zeros(model.model.nv))
        gradient = -self.by_posture(model, optimum.x[:-1], optimum.multipliers[: len(A)])
        of_room = optimum.multipliers[len(A) :]
        gradient[self.free[self.roomy]] -= np.where(np.where(of_room > 0, up, down) != 0, of_room, 0.0)
        return Attained(max(0.0, -optimum.value), optimum.x[:-1], gradient)

    def reached(self, q: Array) -> float | None:
        """Return the speed at ``q``, shape (nq,), in m/s; ``None`` if it is not computed or is unbounded."""
        speed = float("inf") if self.unknown else self.at(Numeric(self._model).at(q)).speed
        return speed if np.isfinite(speed) else None


def _moving_points(robot: Robot, objective: Objective, requirements: Requirements) -> list[MovingPoint]:
    points: list[MovingPoint] = []
    poses = (requirements.contact_pose, *requirements.other_poses)
    alone = len(objective.contacts) == 1
    for contact, pose in zip(objective.contacts, poses, strict=False):
        # At a contact with a free pose, an object hits the robot at its own speed, so the joints need no speed.
        if pose == "free":
            continue
        turning = {"full": (3, 4, 5), "aligned": (4, 5)}.get(pose, ())
        n = np.array(contact.normal)
        axes = np.vstack([n, np.linalg.svd(n[None, :])[2][1:]])
        point = point_on(robot, contact.frame, contact.offset)
        rows = (0, 1, 2, *turning) if alone or requirements.strike else (0,)
        points.append(MovingPoint(contact.frame, point, axes, rows, True, contact.normal_frame == "contact"))
    struck = {contact.frame for contact in objective.contacts}
    for frame in dict.fromkeys(requirements.keep):
        if points and frame not in struck:
            points.append(MovingPoint(frame, point_on(robot, frame), np.eye(3), tuple(range(6))))
    return points
