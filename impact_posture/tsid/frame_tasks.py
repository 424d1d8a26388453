"""Tasks of a frame: its pose on SE(3), its position, its position with the direction of an axis."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray

from impact_posture.errors import InputError
from impact_posture.tsid.points import Point, PointState
from impact_posture.tsid.state import State
from impact_posture.tsid.task import Task

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Impedance:
    """How a measured force enters a frame's acceleration: ``M_d⁻¹ F̂``.

    A force that stands in the dynamics but not here is compensated by the controller, which then pushes against the
    wall ever harder.

    Attributes:
        mass: Apparent mass, kg.
        inertia: Apparent rotational inertia, kg·m²; ``None``: measured moments do not turn the frame.
    """

    mass: float
    inertia: float | None = None

    def __post_init__(self) -> None:
        """Refuse masses that are not positive."""
        if not self.mass > 0 or (self.inertia is not None and not self.inertia > 0):
            raise InputError(
                "apparent mass or inertia is not positive", where="impedance", hint="give positive numbers"
            )

    def inverse(self) -> Array:
        """``M_d⁻¹`` of force and moment, shape (6,)."""
        turn = 0.0 if self.inertia is None else 1.0 / self.inertia
        return np.array([1.0 / self.mass] * 3 + [turn] * 3)


class FramePosition(Task):
    """World position of a point: ``e = p_des − p``, ``J`` its linear Jacobian (3 × nv).

    Attributes:
        target: ``p_des``, world, meters, shape (3,); where the point is at ``reset`` unless set.
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
        super().__init__(name or f"{point.frame} position", 3, kp=kp, kd=kd, weight=weight)
        self.point, self.points = point, (point,)
        self.target: Array | None = None
        self._soften = None if impedance is None else impedance.inverse()[:3]

    def reset(self, state: State) -> None:
        """Take the present position as target unless one is set."""
        if self.target is None:
            self.target = state.at(self.point).position.copy()

    def error(self, state: State) -> Array:
        """``p_des − p``."""
        if self.target is None:
            raise without_target(self.name)
        return np.asarray(self.target - state.at(self.point).position)

    def jacobian(self, state: State) -> Array:
        """Linear rows, world-aligned."""
        return state.at(self.point).jacobian[:3]

    def drift(self, state: State) -> Array:
        """Acceleration of the point at ``ν̇ = 0``."""
        return state.at(self.point).drift[:3]

    def feedforward(self, state: State) -> Array | None:
        """``F̂/M_d`` where an impedance is set."""
        return None if self._soften is None or not state.pushed else self._soften * state.force[:3]


class FramePose(Task):
    """Pose of a frame at a point of it: ``e = log₆(T⁻¹ T_des)``, turned into world axes (6 × nv).

    The twist is that of the frame at the point, in world-aligned axes, and ``ẏ`` its body twist turned likewise; with
    an impedance the law is ``M_d(ÿ − ÿ_des) + … = F̂``.

    Attributes:
        target: ``T_des``, world from frame, origin at the point; where it is at ``reset`` unless set.
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
        super().__init__(name or f"{point.frame} pose", 6, kp=kp, kd=kd, weight=weight)
        self.point, self.points = point, (point,)
        self.target: pin.SE3 | None = None
        self._soften = None if impedance is None else impedance.inverse()
        self._e = np.zeros(6)

    def reset(self, state: State) -> None:
        """Take the present pose as target unless one is set."""
        if self.target is None:
            self.target = placement(state.at(self.point))

    def error(self, state: State) -> Array:
        """``log₆`` of the way to the target, linear part first, world axes."""
        here = state.at(self.point)
        if self.target is None:
            raise without_target(self.name)
        way = pin.log6(placement(here).actInv(self.target))
        # Row vectors: linear and angular part, turned together.
        np.matmul(way.vector.reshape(2, 3), here.rotation.T, out=self._e.reshape(2, 3))
        return self._e

    def jacobian(self, state: State) -> Array:
        """The point's Jacobian, world-aligned."""
        return state.at(self.point).jacobian

    def drift(self, state: State) -> Array:
        """Spatial acceleration of the body at the point at ``ν̇ = 0``: the classical one less ``ω × v``."""
        return state.at(self.point).spatial_drift

    def feedforward(self, state: State) -> Array | None:
        """``M_d⁻¹ F̂`` where an impedance is set."""
        return None if self._soften is None or not state.pushed else self._soften * state.force


class FrameAligned(Task):
    """World position of a point, and where an axis of its frame points; spin about the axis is free (5 × nv).

    Position as in :class:`FramePosition`.  Then the shortest rotation that takes the axis to where the target has it,
    in the two directions of the frame across the axis; ``J`` picks those of the frame's angular velocity.

    Attributes:
        target: ``T_des``, world from frame, origin at the point; where it is at ``reset`` unless set.
    """

    def __init__(
        self,
        point: Point,
        axis: ArrayLike = (0.0, 0.0, 1.0),
        *,
        name: str | None = None,
        kp: ArrayLike = 100.0,
        kd: ArrayLike | None = None,
        weight: ArrayLike = 1.0,
        impedance: Impedance | None = None,
    ) -> None:
        """Set gains and the axis, in the frame; its length does not matter.

        Raises:
            InputError: The axis has no direction, or gains that are none.
        """
        super().__init__(name or f"{point.frame} axis", 5, kp=kp, kd=kd, weight=weight)
        self.point, self.points = point, (point,)
        self.target: pin.SE3 | None = None
        self._axis = np.array(axis, dtype=float)
        length = float(np.linalg.norm(self._axis))
        if not (length > 0 and math.isfinite(length)):
            raise InputError("the axis has no direction", where=self.name, hint="give a vector that is not zero")
        self._axis /= length
        # Across the axis: the other right singular vectors of a row.
        self._across = np.linalg.svd(self._axis[None])[2][1:]
        self._soften = None if impedance is None else impedance.inverse()

    def reset(self, state: State) -> None:
        """Take the present pose as target unless one is set."""
        if self.target is None:
            self.target = placement(state.at(self.point))

    def error(self, state: State) -> Array:
        """``p_des − p``, then angle (rad) times axis of the shortest rotation."""
        here = state.at(self.point)
        if self.target is None:
            raise without_target(self.name)
        wanted = here.rotation.T @ (self.target.rotation @ self._axis)
        turn = self._across @ np.cross(self._axis, wanted)
        sine, cosine = math.hypot(*turn), float(self._axis @ wanted)
        if sine >= 1e-12:
            turn *= math.atan2(sine, cosine) / sine
        elif cosine < 0:
            # The other way round: there every axis is as short as any other.
            turn[0] = math.pi
        return np.concatenate([self.target.translation - here.position, turn])

    def jacobian(self, state: State) -> Array:
        """Linear rows, world-aligned, then angular velocity across the axis."""
        here = state.at(self.point)
        return self._picked(here, here.jacobian)

    def drift(self, state: State) -> Array:
        """Acceleration at ``ν̇ = 0``; ``d(Rᵀω)/dt = Rᵀω̇``."""
        here = state.at(self.point)
        return self._picked(here, here.drift)

    def feedforward(self, state: State) -> Array | None:
        """``M_d⁻¹ F̂`` where an impedance is set."""
        if self._soften is None or not state.pushed:
            return None
        return self._picked(state.at(self.point), self._soften * state.force)

    def _picked(self, here: PointState, six: Array) -> Array:
        return np.concatenate([six[:3], self._across @ (here.rotation.T @ six[3:])])


EndEffector = FramePose | FramePosition | FrameAligned


def placement(point: PointState) -> pin.SE3:
    """World placement of a point with its frame's rotation."""
    return pin.SE3(point.rotation, point.position)


def without_target(name: str) -> InputError:
    """What is wrong with a task that was asked for its error too early."""
    return InputError("has no target", where=name, hint="set `target`, or reset the controller first")
