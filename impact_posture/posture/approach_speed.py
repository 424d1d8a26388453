"""The speed at which the joints can bring the contact to the surface, and the constraint that it suffices.

An impact-robust arm is often stretched along the normal, and a stretched arm cannot move along itself: the posture
takes the impact well, but no joint motion arrives in it at speed.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from impact_posture.arrays import Array
from impact_posture.dynamics.numeric import Numeric
from impact_posture.dynamics.tree import PointOnLink, Tree
from impact_posture.impact.contact import point_on
from impact_posture.impact.lifted import Guess
from impact_posture.impact.objective import Objective
from impact_posture.posture.constraint import Constraint, LiftedRows, Linearization
from impact_posture.posture.linear_program import solve_linear
from impact_posture.posture.problem import Requirements, held_rows
from impact_posture.robot.robot import Robot

# A speed that no contact has, m/s: a base that flies reaches it.
_UNBOUNDED = 1e3
# A speed that the joints lack is not a meter: where a pose cannot be held, the pose is the reason.
_PRICE = 1e-3


@dataclass(frozen=True, eq=False)
class MovingPoint:
    """What a point must do while the contact approaches: rows of ``D v`` and ``D ω`` that are ``−σ d`` or zero.

    Attributes:
        name: Name of the frame.
        point: The point.
        axes: ``D``, shape (3, 3): the normal and two tangents, or the axes of the world.
        rows: Rows of ``(D v, D ω)`` that are held.
        comes: Whether the first row is the approach, ``nᵀv = −σ``; else it is zero as the others.
        in_frame: Whether the axes turn with the frame.
    """

    name: str
    point: PointOnLink
    axes: Array
    rows: tuple[int, ...]
    comes: bool = False
    in_frame: bool = False

    @property
    def arrives(self) -> Array:
        """``d`` of the rows, shape (k,)."""
        return np.array([float(self.comes and row == 0) for row in self.rows])

    def wrench(self, weights: Array) -> Array:
        """Return the force and moment whose power is the sum of the rows with these weights, shape (6,)."""
        whole = np.zeros(6)
        whole[list(self.rows)] = weights
        return np.concatenate([self.axes.T @ whole[:3], self.axes.T @ whole[3:]])

    def jacobian(self, model: Numeric) -> Array:
        """Return the rows over the generalized velocity, shape (k, nv)."""
        J = model.jacobian(self.point)
        D = self.axes @ model.placement(self.point).rotation.T if self.in_frame else self.axes
        return np.vstack([D @ J[:3], D @ J[3:]])[list(self.rows)]

    def symbolic(self, tree: Tree, velocities: dict[int, ca.SX], axes: ca.SX) -> ca.SX:
        """Return the rows as an expression, shape (k, 1)."""
        twist = tree.point_velocity(self.point, velocities)
        if self.in_frame:
            R = tree.rotations[self.point.joint] @ ca.SX(self.point.rotation)
            axes = axes @ R.T
        return ca.vertcat(axes @ twist[:3], axes @ twist[3:])[list(self.rows)]


@dataclass(frozen=True, eq=False)
class Attained:
    """The fastest approach at a posture.

    Attributes:
        speed: ``σ``, m/s; infinite where nothing bounds it.
        velocities: Share of its limit at which each free entry of the velocity moves, shape (k,).
        gradient: Tangent gradient of the speed, shape (nv,).
    """

    speed: float
    velocities: Array
    gradient: Array


class AttainableSpeed:
    """``σ(q) = max σ`` such that a generalized velocity ``|ν_i| ≤ ν̄_i`` brings the contact in at ``nᵀJν = −σ``.

    The contact point moves along the normal alone, frames that are kept do not move, and the contact frame turns only
    where its pose leaves it free.  Several contacts all arrive at ``σ``, and may slide.  The base of a robot that
    stands keeps still, so that its feet do; that of a robot without feet moves at any speed.  A contact whose pose is
    free is one where something hits the robot, at any speed.

    Args:
        robot: The robot, with the velocity limits of its URDF.
        objective: Its contacts and supports.
        requirements: What of the base, of the contact's pose and of other frames is held.

    Attributes:
        bounded: Whether velocity limits bound the speed, at least at some postures.
    """

    def __init__(self, robot: Robot, objective: Objective, requirements: Requirements) -> None:
        self._model = robot.model
        self.points = _moving_points(robot, objective, requirements)
        limit, free = robot.velocity_limits, np.zeros(robot.nv, dtype=bool)
        for moved in self.points:
            for joint in robot.model.supports[moved.point.joint].tolist()[1:]:
                start = robot.model.idx_vs[joint]
                free[start : start + robot.model.nvs[joint]] = True
        free &= ~held_rows(robot, requirements.hold).any(axis=0)
        flies = robot.floating and not objective.supports and requirements.base != "fixed"
        if robot.floating and not flies:
            free[:6] = False
        self.free = np.flatnonzero(free)
        bounded = np.isfinite(limit[self.free])
        self.scale = np.where(bounded, limit[self.free], 1.0)
        self.upper = np.where(bounded, 1.0, np.inf)
        self.names = [robot.tangent_names[k] for k in self.free]
        self.bounded = bool(self.points) and not flies and bool(bounded.any())

    @property
    def arrives(self) -> Array:
        """Rows that are the approach, shape (m,)."""
        return np.concatenate([point.arrives for point in self.points])

    def jacobian(self, model: Numeric) -> Array:
        """Return the rows over the free velocities in shares of their limits, shape (m, k)."""
        whole = np.vstack([point.jacobian(model) for point in self.points])
        return np.asarray(whole[:, self.free] * self.scale)

    def by_posture(self, model: Numeric, velocities: Array, weights: Sequence[Array]) -> Array:
        """Return the tangent gradient of the rows summed with ``weights``, one array for each point, shape (nv,)."""
        v = np.zeros(model.model.nv)
        v[self.free] = self.scale * velocities
        return np.sum(
            [
                model.coupling_gradient(moved.point, moved.wrench(own), v, in_frame=moved.in_frame)
                for moved, own in zip(self.points, weights, strict=True)
            ],
            axis=0,
        )

    def at(self, model: Numeric) -> Attained:
        """Return the fastest approach at ``model.q``."""
        A = np.column_stack([self.jacobian(model), self.arrives])
        rows, cost = np.zeros(len(A)), np.zeros(A.shape[1])
        cost[-1] = -1.0
        high = np.append(self.upper, _UNBOUNDED)
        found = solve_linear(cost, A, rows, rows, np.append(-self.upper, 0.0), high)
        if found is None:
            return Attained(0.0, np.zeros(len(self.free)), np.zeros(model.model.nv))
        if -found.value > 0.99 * _UNBOUNDED:
            return Attained(float("inf"), np.zeros(len(self.free)), np.zeros(model.model.nv))
        ends = np.cumsum([len(point.rows) for point in self.points])[:-1]
        gradient = -self.by_posture(model, found.x[:-1], np.split(found.multipliers, ends))
        return Attained(-found.value, found.x[:-1], gradient)

    def reached(self, q: Array) -> float | None:
        """Return the speed at ``q``, shape (nq,), in m/s; ``None`` where nothing bounds it."""
        speed = self.at(Numeric(self._model).at(q)).speed if self.bounded else float("inf")
        return speed if np.isfinite(speed) else None


class ApproachSpeed(Constraint):
    """``s − σ(q) ≤ 0``: the joints can bring the contact to the surface at the speed s.

    In the program the velocities are unknowns, in shares of their limits.

    Args:
        attainable: The attainable speed ``σ``.
        speed: ``s``, m/s.
    """

    price = _PRICE
    # As for holding: starts that are pulled onto it are less diverse.
    projected = False

    def __init__(self, attainable: AttainableSpeed, speed: float) -> None:
        self.name = f"approach at {speed:g} m/s"
        self._attainable, self._speed = attainable, speed
        self._coming = [point for point in attainable.points if point.comes]
        self.parameters = np.concatenate([[speed], *[point.axes.ravel() for point in self._coming]])
        self.lower, self.upper = np.array([-np.inf]), np.zeros(1)

    @property
    def structure(self) -> str:
        """See :class:`Constraint`."""
        own = self._attainable
        parts = [np.array(self.parameters.shape), own.free, own.scale]
        for moved in own.points:
            parts += [moved.point.position, moved.point.rotation, np.array([moved.point.joint, *moved.rows])]
            parts.append(np.array([moved.comes, moved.in_frame]))
        digest = hashlib.sha256(b"".join(np.ascontiguousarray(part).tobytes() for part in parts)).hexdigest()[:16]
        return f"{type(self).__name__}:{digest}"

    def describe(self) -> str:
        """See :class:`Constraint`."""
        return f"{self.name} within the velocity limits of the joints"

    def evaluate(self, model: Numeric) -> tuple[Array, Array]:
        """See :class:`Constraint`."""
        found = self._attainable.at(model)
        speed = min(found.speed, _UNBOUNDED)
        return np.array([self._speed - speed]), -found.gradient[None, :]

    # ---- lifted form ------------------------------------------------------------------------------------------

    @property
    def lifted_bounds(self) -> tuple[Array, Array]:
        """See :class:`Constraint`."""
        zero = np.zeros(len(self._attainable.arrives))
        return zero, zero

    def lift(self, tree: Tree, parameters: ca.SX) -> LiftedRows:
        """See :class:`Constraint`."""
        own = self._attainable
        z = ca.SX.sym("w", len(own.free))
        v = ca.SX(tree.model.nv, 1)
        v[own.free.tolist()] = own.scale * z
        velocities, rows, start = tree.velocities(v), [], 1
        for moved in own.points:
            axes = ca.SX(moved.axes)
            if moved.comes:
                axes = ca.reshape(parameters[start : start + 9], 3, 3).T
                start += 9
            rows.append(moved.symbolic(tree, velocities, axes) + moved.arrives * parameters[0])
        return LiftedRows(ca.densify(ca.vertcat(*rows)), z)

    @property
    def unknowns(self) -> int:
        """See :class:`Constraint`."""
        return len(self._attainable.free)

    def guess(self, model: Numeric) -> Guess:
        """See :class:`Constraint`; the fastest approach, slowed down to the speed."""
        own = self._attainable
        found = own.at(model)
        slower = self._speed / found.speed if self._speed < found.speed < np.inf else 1.0
        return Guess(slower * found.velocities, -own.upper, own.upper)

    def linearize(self, model: Numeric, auxiliaries: Array) -> Linearization:
        """See :class:`Constraint`; the limits of the joints are rows as well."""
        own, names, by_posture = self._attainable, [], []
        for index, moved in enumerate(own.points):
            for row in range(len(moved.rows)):
                weights = [np.zeros(len(point.rows)) for point in own.points]
                weights[index][row] = 1.0
                by_posture.append(own.by_posture(model, auxiliaries, weights))
                names.append(f"motion of {moved.name} in the {self.name}")
        A, limited = own.jacobian(model), np.flatnonzero(np.isfinite(own.upper))
        bounds, zero = own.upper[limited], np.zeros(len(A))
        return Linearization(
            [*names, *(f"velocity limit of {own.names[k]}" for k in limited)],
            np.concatenate([A @ auxiliaries + own.arrives * self._speed, auxiliaries[limited]]),
            np.concatenate([zero, -bounds]),
            np.concatenate([zero, bounds]),
            np.vstack([np.array(by_posture), np.zeros((len(limited), model.model.nv))]),
            np.vstack([A, np.eye(len(auxiliaries))[limited]]),
        )


def _moving_points(robot: Robot, objective: Objective, requirements: Requirements) -> list[MovingPoint]:
    found: list[MovingPoint] = []
    poses = (requirements.contact_pose, *requirements.other_poses)
    alone = len(objective.contacts) == 1
    for contact, pose in zip(objective.contacts, poses, strict=False):
        # What hits a robot that is free there comes at a speed of its own.
        if pose == "free":
            continue
        turning = {"full": (3, 4, 5), "aligned": (4, 5)}.get(pose.partition(":")[0], ())
        n = np.array(contact.normal)
        axes = np.vstack([n, np.linalg.svd(n[None, :])[2][1:]])
        point = point_on(robot, contact.frame, contact.offset)
        rows = (0, 1, 2, *turning) if alone else (0,)
        found.append(MovingPoint(contact.frame, point, axes, rows, True, contact.normal_frame == "contact"))
    struck = {contact.frame for contact in objective.contacts}
    for frame in dict.fromkeys(requirements.keep):
        if found and frame not in struck:
            found.append(MovingPoint(frame, point_on(robot, frame), np.eye(3), tuple(range(6))))
    return found
