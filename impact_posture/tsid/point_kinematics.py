"""Kinematics of several points of the robot, computed in one batch from the joint Jacobians of Pinocchio."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from impact_posture.config.checked import checked
from impact_posture.robot.model_joints import v_slice
from impact_posture.robot.robot import Robot
from impact_posture.system.arrays import Array

# p @ _SHIFT has -[p]x at the upper right; this 6 x 6 matrix moves a body's velocity from the origin to p.
_SHIFT = np.zeros((3, 6, 6))
_SHIFT[[2, 0, 1], [0, 1, 2], [4, 5, 3]] = 1.0
_SHIFT[[1, 2, 0], [0, 1, 2], [5, 3, 4]] = -1.0
_FLAT, _EYE = _SHIFT.reshape(3, 36), np.eye(6).reshape(36)


@checked
@dataclass(frozen=True, eq=False)
class Point:
    """A point that is fixed in a frame of the robot.

    Attributes:
        offset: Position of the point in the coordinates of the frame, m.
    """

    frame: str
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True, eq=False)
class PointState:
    """Kinematics of a point.  The arrays are views that the next update of the state overwrites.

    Attributes:
        position: World position, m, shape (3,).
        rotation: Rotation of the frame, world from frame, shape (3, 3).
        jacobian: Jacobian of the linear and angular velocity of the point, world axes, shape (6, nv).
        velocity: ``Jν``, linear and angular velocity, shape (6,).
        drift: ``J̇ν``, classical linear and angular acceleration at ``ν̇ = 0``, shape (6,).
        spatial_drift: Spatial acceleration ``v̇ − ω × v`` at ``ν̇ = 0``, shape (6,): the rate of the body twist in
            world axes.
    """

    position: Array
    rotation: Array
    jacobian: Array
    velocity: Array
    drift: Array
    spatial_drift: Array


class PointKinematics:
    """Position, rotation, Jacobian, velocity and drift of points, in buffers that are allocated once."""

    def __init__(self, robot: Robot, data: pin.Data, points: Sequence[Point]) -> None:
        """Size the buffers.

        Before each update, the caller runs ``pin.computeJointJacobiansTimeVariation`` on ``data``.

        Raises:
            FrameNotFound: The robot lacks a frame; the exception contains the most similar names.
        """
        model, nv, count = robot.model, robot.nv, len(points)
        frames = [model.frames[robot.frame_id(point.frame)] for point in points]
        # Reshape the arrays, because Pinocchio returns vectors for a robot with one degree of freedom.
        self._J, self._dJ_transposed = data.J.reshape(6, nv), data.dJ.reshape(6, nv).T
        mask = np.zeros((count, nv))
        for k, frame in enumerate(frames):
            for joint in model.supports[frame.parentJoint]:
                mask[k, v_slice(model, joint)] = 1.0
        self._mask, self._rows_mask = mask, np.repeat(mask, 6, axis=0)
        self._position, rotation = np.zeros((count, 3)), np.zeros((count, 3, 3))
        # Views on the same memory, in the shapes that the matrix products require.
        self._shift, self._turn = np.zeros((count, 36)), np.zeros((count, 36))
        self._shift_rows = self._shift.reshape(6 * count, 6)
        self._shifts, self._turns = self._shift.reshape(count, 6, 6), self._turn.reshape(count, 6, 6)
        self._jacobian, self._velocity = np.zeros((6 * count, nv)), np.zeros(6 * count)
        twists = self._velocity.reshape(count, 6)
        self._linear, self._twists = twists[:, :3], twists[:, :, None]
        self._masked, world = np.zeros((count, nv)), np.zeros((count, 6))
        self._world, self._worlds = world, world[:, :, None]
        self._spatial, self._drift = np.zeros((count, 6)), np.zeros((count, 6))
        self._spatials, self._drifts = self._spatial[:, :, None], self._drift[:, :, None]
        self._moving = []
        for k, (frame, point) in enumerate(zip(frames, points, strict=True)):
            body, offset, turn = data.oMi[frame.parentJoint], *_fixed(frame, point)
            self._moving.append((body.rotation, body.translation, offset, turn, self._position[k], rotation[k]))
        self.points = {
            point: PointState(
                self._position[k],
                rotation[k],
                self._jacobian[6 * k : 6 * k + 6],
                self._velocity[6 * k : 6 * k + 6],
                self._drift[k],
                self._spatial[k],
            )
            for k, point in enumerate(points)
        }

    def update(self, v: Array | None) -> None:
        """Compute the kinematics from the data of Pinocchio and ν, shape (nv,).

        ``None`` means ν = 0 and is faster than an array of zeros.
        """
        if not self._moving:
            return
        for R, t, offset, turn, position, rotation in self._moving:
            if offset is None:
                position[:] = t
            else:
                np.dot(R, offset, out=position)
                position += t
            if turn is None:
                rotation[:] = R
            else:
                np.dot(R, turn, out=rotation)
        # J of Pinocchio gives the velocity of the body's point at the world origin, hence v_p = v + ω × p.
        np.matmul(self._position, _FLAT, out=self._shift)
        self._shift += _EYE
        np.matmul(self._shift_rows, self._J, out=self._jacobian)
        self._jacobian *= self._rows_mask
        if v is None:
            for part in (self._velocity, self._spatial, self._drift):
                part.fill(0.0)
            return
        np.matmul(self._jacobian, v, out=self._velocity)
        np.multiply(self._mask, v, out=self._masked)
        np.matmul(self._masked, self._dJ_transposed, out=self._world)
        np.matmul(self._shifts, self._worlds, out=self._spatials)
        # The matrix of the shifts, ``_FLAT``, also computes ω × v_p.
        np.matmul(self._linear, _FLAT, out=self._turn)
        np.matmul(self._turns, self._twists, out=self._drifts)
        self._drift += self._spatial


def _fixed(frame: pin.Frame, point: Point) -> tuple[Array | None, Array | None]:
    """Return offset and rotation of a point relative to its joint; ``None`` means no offset or no rotation."""
    placement = frame.placement
    offset = placement.act(np.array(point.offset, dtype=float))
    turn = np.array(placement.rotation)
    return (offset if np.any(offset) else None), (None if np.array_equal(turn, np.eye(3)) else turn)
