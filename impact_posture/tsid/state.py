"""Everything a tick needs of the robot's dynamics, computed once a tick into buffers that were allocated once."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray

from impact_posture.errors import InputError
from impact_posture.robot.robot import Robot, unit_parts
from impact_posture.tsid.points import Point, PointKinematics, PointState
from impact_posture.tsid.ranges import JointRanges

Array = NDArray[np.float64]


class State:
    """``M``, ``h``, point Jacobians, drifts and center of mass at one ``(q, ν)`` at a time.

    Attributes:
        robot: The robot.
        points: The points whose kinematics it follows.
        q: Configuration, shape (nq,), a copy with unit quaternions and cosine-sine pairs.
        v: ν, shape (nv,), a copy.
        M: Mass matrix with armature, shape (nv, nv); a view on Pinocchio's data, like the next one.
        h: Coriolis, centrifugal and gravity terms, shape (nv,).
        room: Distance of every joint to its upper, then to its lower limit, negative beyond, shape (2, nv); infinite
            where there is none.
        rooms: The same, flat, shape (2 nv,).
        least_room: The smallest of them.
        force: Measured contact wrench on the robot ``[force (N); moment (N·m)]``, world axes, shape (6,).
        pushed: Whether there is such a wrench.
        mass: Total mass, kg.
        unit_parts: Where quaternions and cosine-sine pairs stand in ``q``.
    """

    def __init__(self, robot: Robot, points: Iterable[Point] = ()) -> None:
        """Size the buffers.

        Args:
            robot: The robot.
            points: The points whose kinematics are wanted; look them up with :meth:`at`.

        Raises:
            FrameNotFound: With the nearest names.
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
        # Pinocchio writes into the same memory on every call: views on it stay valid.
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

    def update(self, q: ArrayLike, v: ArrayLike) -> State:
        """Move to ``(q, ν)``; shapes (nq,) and (nv,), finite, quaternions near unit norm (see ``Controller``)."""
        model, data = self._model, self._data
        self.q[:] = q
        self.v[:] = v
        self._com = None
        for unit in self._units:
            square = float(unit.dot(unit))
            if abs(square - 1.0) > 1e-12:
                unit /= square**0.5
        # Indices are right by construction: no need for the slower mode that checks them.
        self.q.take(self._index, out=self._joints, mode="clip")
        np.subtract(self._upper, self._joints, out=self._above)
        np.subtract(self._joints, self._lower, out=self._below)
        self.least_room = self.rooms.item(self.rooms.argmin())
        pin.crba(model, data, self.q)
        pin.nonLinearEffects(model, data, self.q, self.v)
        pin.computeJointJacobiansTimeVariation(model, data, self.q, self.v)
        self._kinematics.update(self.v)
        return self

    def push(self, force: Array | None) -> None:
        """Set the measured force (3) or wrench (6) on the robot, world axes; ``None``: there is none."""
        if force is None and not self.pushed:
            return
        self.force[:] = 0.0
        self.pushed = force is not None
        if force is not None:
            if force.shape not in ((3,), (6,)):
                raise ValueError(f"a measured force has 3 or 6 numbers, not shape {force.shape}")
            self.force[: force.size] = force

    def at(self, point: Point) -> PointState:
        """Kinematics of one of the points given to the constructor.

        Raises:
            InputError: The point is none of them.
        """
        try:
            return self._views[point]
        except KeyError:
            known = ", ".join(p.frame for p in self.points) or "none"
            raise InputError(
                f"the state does not follow this point of '{point.frame}' (it follows: {known})",
                where="state",
                hint="name the point in the task's `points`",
            ) from None

    @property
    def base_rotation(self) -> Array:
        """World from base, shape (3, 3); a view.

        Raises:
            InputError: The base is fixed.
        """
        return self._floating_base()[0]

    def center_of_mass(self) -> tuple[Array, Array, Array]:
        """World position, shape (3,), Jacobian, shape (3, nv), and drift ``J̇ν``, shape (3,), of the center of mass.

        For a floating base they stand in ``M`` and ``h``: the base's linear rows are the linear momentum in base
        axes, ``m J_com = R M[:3]``, and ``m J̇_com ν = R h[:3] + m g``.

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
        """Another state at ``(q ⊕ step·ν, ν)``, for finite differences along the motion."""
        if self._aside is None:
            self._aside = State(self.robot, self.points)
        return self._aside.update(pin.integrate(self._model, self.q, step * self.v), self.v)

    def _floating_base(self) -> tuple[Array, Array]:
        if self._base is None:
            raise InputError("the base is fixed", where=self.robot.name, hint="use this on a floating base only")
        return self._base
