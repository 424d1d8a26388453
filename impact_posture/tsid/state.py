"""Dynamics of the robot for one tick, in buffers that are allocated once."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from impact_posture.errors import InputError, PostureError
from impact_posture.robot.robot import Robot, unit_parts
from impact_posture.system.arrays import Array
from impact_posture.tsid.joint_ranges import JointRanges
from impact_posture.tsid.point_kinematics import Point, PointKinematics, PointState

# Default time between two ticks, s.
PERIOD = 1e-3


class State:
    """``M``, ``h``, point Jacobians, drifts and center of mass at the configuration ``q`` and the velocity ``ν``.

    Attributes:
        points: Points whose kinematics the state computes.
        q: Copy of the configuration, shape (nq,), with quaternions and cosine-sine pairs of unit length.
        v: Copy of the generalized velocity ν, shape (nv,).
        M: Mass matrix with armature, shape (nv, nv); a view on the data of Pinocchio.
        h: Coriolis, centrifugal and gravity terms, shape (nv,); a view on the data of Pinocchio.
        room: Distances of the joints from their upper limits (first row) and lower limits (second row), rad (m),
            shape (2, nv).  A distance is negative beyond the limit, and infinite if there is no limit.
        rooms: Flat view on ``room``, shape (2 nv,).
        least_room: Smallest entry of ``room``.
        force: Measured contact wrench on the robot ``[force (N); moment (N·m)]``, world axes, shape (6,).
        pushed: Whether a contact wrench is measured at this tick.
        mass: Total mass, kg.
        unit_parts: Slices of quaternions and cosine-sine pairs in ``q``.
    """

    def __init__(self, robot: Robot, points: Iterable[Point] = ()) -> None:
        """Size the buffers for a robot and for the points whose kinematics :meth:`at` returns.

        Raises:
            FrameNotFound: The robot lacks a frame; the exception contains the most similar names.
        """
        self.robot, self.points = robot, tuple(points)
        self._model = robot.model
        self._data = data = robot.model.createData()
        self.q, self.v = robot.posture(), np.zeros(robot.nv)
        self.unit_parts = tuple(part for _, part in unit_parts(robot.model))
        self._units = [self.q[part] for part in self.unit_parts]
        ranges = JointRanges(robot)
        self._upper, self._lower, self._index = ranges.upper, ranges.lower, ranges.index
        self.room, self._joints, self.least_room = np.zeros((2, robot.nv)), np.zeros(robot.nv), np.inf
        self._above, self._below, self.rooms = self.room[0], self.room[1], self.room.reshape(-1)
        self.force, self.pushed, self.mass = np.zeros(6), False, robot.mass
        # These views stay valid, because Pinocchio writes into the same memory at each call.
        self.M, self.h = data.M, data.nle
        self._gravity = np.array(robot.model.gravity.linear)
        base = data.oMi[1]
        self._base = (base.rotation, base.translation) if robot.floating else None
        self._kinematics = PointKinematics(robot, data, self.points)
        self._views = self._kinematics.points
        self._aside: State | None = None
        self._com: tuple[Array, Array, Array] | None = None
        self.update(self.q, self.v)

    @property
    def nv(self) -> int:
        """Dimension of ν."""
        return self.v.size

    def update(self, q: ArrayLike, v: ArrayLike | None) -> State:
        """Compute the state at ``q``, shape (nq,), and ν, shape (nv,), and return the state.

        All numbers must be finite, and the norms of quaternions must be close to 1.  ``None`` means ν = 0 and is
        faster than an array of zeros.
        """
        model, data = self._model, self._data
        self.q[:] = q
        self.v[:] = 0.0 if v is None else v
        self._com = None
        for unit in self._units:
            square = float(unit.dot(unit))
            if abs(square - 1.0) > 1e-12:
                unit /= square**0.5
        # The indices are valid by construction, and the mode "clip" is faster than the mode that checks them.
        self.q.take(self._index, out=self._joints, mode="clip")
        np.subtract(self._upper, self._joints, out=self._above)
        np.subtract(self._joints, self._lower, out=self._below)
        self.least_room = self.rooms.item(self.rooms.argmin())
        pin.crba(model, data, self.q)
        pin.nonLinearEffects(model, data, self.q, self.v)
        if v is None:
            pin.computeJointJacobians(model, data, self.q)
        else:
            pin.computeJointJacobiansTimeVariation(model, data, self.q, self.v)
        self._kinematics.update(None if v is None else self.v)
        return self

    def push(self, force: Array | None) -> None:
        """Set the measured force (3) or wrench (6) on the robot, world axes; ``None`` removes it."""
        if force is None and not self.pushed:
            return
        self.force[:] = 0.0
        self.pushed = force is not None
        if force is not None:
            if force.shape not in ((3,), (6,)):
                raise ValueError(f"a measured force has 3 or 6 numbers, not shape {force.shape}")
            self.force[: force.size] = force

    def at(self, point: Point) -> PointState:
        """Return the kinematics of a point that was given to the constructor.

        Raises:
            InputError: The point was not given to the constructor.
        """
        try:
            return self._views[point]
        except KeyError:
            known = ", ".join(p.frame for p in self.points) or "none"
            what = f"the state has no kinematics of this point of '{point.frame}' (it has: {known})"
            raise InputError(what, where="state", hint="name the point in the task's `points`") from None

    @property
    def base_rotation(self) -> Array:
        """Rotation of the base, world from base, shape (3, 3); a view.

        Raises:
            InputError: The base is fixed.
        """
        return self._floating_base()[0]

    def center_of_mass(self) -> tuple[Array, Array, Array]:
        """Return position (3,), Jacobian (3, nv) and drift ``J̇ν`` (3,) of the center of mass in the world.

        ``M[:3] ν`` is the linear momentum in base axes.  Hence ``m J_com = R M[:3]``, ``m J̇_com ν = R h[:3] + m g``.

        Raises:
            InputError: The base is fixed.
        """
        if self._com is None:
            (R, p), M = self._floating_base(), self.M
            scaled = R / self.mass
            first = np.array([M.item(1, 5), -M.item(0, 5), M.item(0, 4)])
            self._com = p + scaled @ first, scaled @ M[:3], scaled @ self.h[:3] + self._gravity
        return self._com

    def displaced(self, step: float) -> State:
        """Return a second state object at ``(q ⊕ step·ν, ν)``, for finite differences along the motion."""
        if self._aside is None:
            self._aside = State(self.robot, self.points)
        return self._aside.update(pin.integrate(self._model, self.q, step * self.v), self.v)

    def _floating_base(self) -> tuple[Array, Array]:
        if self._base is None:
            raise InputError("the base is fixed", where=self.robot.name, hint="use a robot with a floating base")
        return self._base


def checked_velocity(robot: Robot, v: ArrayLike) -> Array:
    """Return ν at a reset as an array of shape (nv,).

    Raises:
        PostureError: ν has the wrong shape or is not finite.
    """
    v = np.asarray(v, dtype=float)
    if v.shape != (robot.nv,) or not np.isfinite(v).all():
        what = f"the velocity of {robot.name} has another shape or is not finite"
        raise PostureError(what, where="reset", hint=f"give {robot.nv} finite numbers")
    return v
