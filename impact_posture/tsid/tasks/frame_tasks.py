"""Tasks that regulate a frame: its position, its pose on SE(3), or its position and the direction of an axis."""

from __future__ import annotations

import math
from abc import abstractmethod
from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from impact_posture.config.checked import checked
from impact_posture.config.demand import Positive
from impact_posture.errors import InputError
from impact_posture.system.arrays import Array
from impact_posture.tsid.point_kinematics import Point, PointState
from impact_posture.tsid.state import State
from impact_posture.tsid.tasks.task import Target, TargetTask


@checked
@dataclass(frozen=True)
class Impedance:
    """Apparent inertia of a frame: a measured force ``F̂`` adds ``M_d⁻¹ F̂`` to the desired acceleration.

    Without an impedance, the controller compensates the measured force and pushes against a wall more and more.

    Attributes:
        mass: Apparent mass, kg.
        inertia: Apparent rotational inertia, kg·m²; with ``None``, measured moments do not rotate the frame.
    """

    mass: Positive
    inertia: Positive | None = None

    def inverse(self) -> Array:
        """Return the diagonal of ``M_d⁻¹``, first for the force, then for the moment, shape (6,)."""
        turn = 0.0 if self.inertia is None else 1.0 / self.inertia
        return np.array([1.0 / self.mass] * 3 + [turn] * 3)


@checked
class FrameTask(TargetTask[Target]):
    """Base class of tasks that regulate a point of a frame.

    Attributes:
        target: Desired position or pose of the point in the world; by default, its present value at ``reset``.
        point: The regulated point.
    """

    def __init__(
        self,
        point: Point,
        *,
        name: str | None = None,
        kp: ArrayLike = 100.0,
        kd: ArrayLike | None = None,
        weight: ArrayLike = 1.0,
        impedance: Impedance | None = None,
    ) -> None:
        """Set the point, the gains of :class:`~impact_posture.tsid.tasks.task.Task`, and the impedance.

        If ``impedance`` is ``None``, the task ignores a measured force.

        Raises:
            InputError: A gain or weight is negative, is not finite, or has the wrong shape.
        """
        super().__init__(name=name or f"{point.frame} {self.title}", kp=kp, kd=kd, weight=weight)
        self.point, self.points = point, (point,)
        self._soften = None if impedance is None else impedance.inverse()

    @abstractmethod
    def select(self, here: PointState, six: Array) -> Array:
        """Return the rows of ``six`` that the task regulates.

        ``six`` has the shape (6,) or (6, nv): three linear rows, then three angular rows, in world axes.
        """

    def jacobian(self, state: State) -> Array:
        here = state.at(self.point)
        return self.select(here, here.jacobian)

    def drift(self, state: State) -> Array:
        here = state.at(self.point)
        return self.select(here, here.drift)

    def feedforward(self, state: State) -> Array | None:
        """Return ``M_d⁻¹ F̂``; return ``None`` without an impedance or a measured force."""
        if self._soften is None or not state.pushed:
            return None
        return self.select(state.at(self.point), self._soften * state.force)


class FramePosition(FrameTask[Array]):
    """Regulate the world position ``p`` of a point: ``e = p_des − p``; ``J`` is its linear Jacobian (3 × nv).

    Attributes:
        target: Desired position ``p_des``, world, m, shape (3,); by default, the position at ``reset``.
    """

    title, rows = "position", 3

    def present(self, state: State) -> Array:
        return state.at(self.point).position.copy()

    def error(self, state: State) -> Array:
        return np.asarray(self.required_target() - state.at(self.point).position)

    def select(self, here: PointState, six: Array) -> Array:
        return six[:3]


class FramePose(FrameTask[pin.SE3]):
    """Regulate the pose ``T`` of a frame at one of its points: ``e = log₆(T⁻¹ T_des)`` in world axes (6 × nv).

    ``ẏ`` is the body twist of the frame at the point, expressed in world axes.  With an impedance, the closed loop is
    ``M_d(ÿ − ÿ_des) + … = F̂``.

    Attributes:
        target: Desired pose ``T_des``, world from frame, with its origin at the point; by default, the pose at
            ``reset``.
    """

    title, rows = "pose", 6

    def present(self, state: State) -> pin.SE3:
        return placement(state.at(self.point))

    def error(self, state: State) -> Array:
        """Return ``log₆(T⁻¹ T_des)`` in world axes, linear part first, in a new array of shape (6,)."""
        here, error = state.at(self.point), np.empty(6)
        local = pin.log6(placement(here).actInv(self.required_target()))
        # One matrix product rotates the linear and the angular part, which are the rows of a matrix.
        np.matmul(local.vector.reshape(2, 3), here.rotation.T, out=error.reshape(2, 3))
        return error

    def drift(self, state: State) -> Array:
        """Return the spatial acceleration at ``ν̇ = 0``, which is the classical acceleration minus ``ω × v``."""
        return state.at(self.point).spatial_drift

    def select(self, here: PointState, six: Array) -> Array:
        return six


@checked
class FrameAligned(FrameTask[pin.SE3]):
    """Regulate the position of a point and the direction of an axis; rotation about the axis is free (5 × nv).

    The first three rows are the rows of :class:`FramePosition`.  The last two rows are components of the shortest
    rotation from the axis to its desired direction.  The components are along two directions of the frame that are
    orthogonal to the axis.  The last two rows of ``J`` are the components of the frame's angular velocity along the
    same two directions.

    Attributes:
        target: Desired pose ``T_des``, world from frame, with its origin at the point; by default, the pose at
            ``reset``.
    """

    title, rows = "axis", 5

    def __init__(self, point: Point, axis: ArrayLike = (0.0, 0.0, 1.0), **gains: Any) -> None:
        """Set the axis, a vector of any length in the frame; ``gains`` are arguments of :class:`FrameTask`.

        Raises:
            InputError: The axis has no direction, or a gain is invalid.
        """
        super().__init__(point, **gains)
        self._axis = np.array(axis, dtype=float)
        length = float(np.linalg.norm(self._axis))
        if self._axis.shape != (3,) or not 0 < length < math.inf:
            raise InputError("the axis has no direction", where=self.name, hint="give three numbers, not all zero")
        self._axis /= length
        # The last two right singular vectors of the axis, taken as a 1 × 3 matrix, are orthogonal to the axis.
        self._across = np.linalg.svd(self._axis[None])[2][1:]

    def present(self, state: State) -> pin.SE3:
        return placement(state.at(self.point))

    def error(self, state: State) -> Array:
        """Return ``p_des − p`` and two components of the shortest rotation (angle in rad times axis), shape (5,)."""
        here, target = state.at(self.point), self.required_target()
        wanted = here.rotation.T @ (target.rotation @ self._axis)
        turn = self._across @ np.cross(self._axis, wanted)
        sine, cosine = math.hypot(*turn), float(self._axis @ wanted)
        if sine >= 1e-12:
            turn *= math.atan2(sine, cosine) / sine
        elif cosine < 0:
            # The axis points opposite to its target.  All orthogonal rotation axes are equally good, so the code
            # selects the first.
            turn[0] = math.pi
        return np.concatenate([target.translation - here.position, turn])

    def select(self, here: PointState, six: Array) -> Array:
        """Return the linear rows and the two angular components orthogonal to the axis.

        ``six`` can also be an acceleration, because ``d(Rᵀω)/dt = Rᵀω̇``.
        """
        return np.concatenate([six[:3], self._across @ (here.rotation.T @ six[3:])])


EndEffector = FramePose | FramePosition | FrameAligned


def pose_task(point: Point, pose: str, axis: Array | None, **options: Any) -> EndEffector:
    """Return the task that regulates a point as a pose mode requires.

    ``position`` and ``box`` regulate the position.  ``aligned`` also regulates the direction of ``axis``, a unit
    vector in the frame, shape (3,).  All other modes, and ``aligned`` without an axis, regulate the whole pose.
    """
    if pose in ("position", "box"):
        return FramePosition(point, **options)
    if pose == "aligned" and axis is not None:
        return FrameAligned(point, axis, **options)
    return FramePose(point, **options)


def placement(point: PointState) -> pin.SE3:
    """Return the pose, world from frame, with the origin at the point."""
    return pin.SE3(point.rotation, point.position)
