"""Constraints on poses of frames and on the base."""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca
import numpy as np
import pinocchio as pin

from impact_posture.dynamics.numeric import Numeric
from impact_posture.dynamics.spatial import quaternion_product
from impact_posture.dynamics.tree import PointOnLink, Tree
from impact_posture.posture.constraints.constraint import ExpressionConstraint
from impact_posture.system.arrays import Array


class HeldPosition(ExpressionConstraint):
    """The point stays at ``p*``: ``p(q) − p* = 0``, world axes, meters."""

    unit = "m"

    def __init__(self, name: str, point: PointOnLink, target: Array) -> None:
        self.name, self.point = name, point
        self.parameters = np.array(target, dtype=float)
        self.lower = self.upper = np.zeros(3)

    def symbolic(self, tree: Tree, parameters: ca.SX) -> ca.SX:
        return tree.position(self.point) - parameters

    def evaluate(self, model: Numeric) -> tuple[Array, Array]:
        return self.value(model), model.jacobian(self.point)[:3]

    def value(self, model: Numeric) -> Array:
        return np.asarray(model.placement(self.point).translation - self.parameters)

    def pose_error(self, value: Array) -> tuple[float, float]:
        """Return the distance from the target or from the allowed box, m, and a zero orientation error."""
        return float(np.linalg.norm(self.excess(value))), 0.0


class PositionBox(HeldPosition):
    """The point stays within a box around ``p*``: ``|p(q) − p*| ≤ half``, world axes, meters."""

    def __init__(self, name: str, point: PointOnLink, target: Array, half: Sequence[float]) -> None:
        super().__init__(name, point, target)
        self.upper = np.array(half, dtype=float)
        self.lower = -self.upper

    def describe(self) -> str:
        return f"{super().describe()} (" + " × ".join(f"±{v:g}" for v in self.upper) + " m)"

    def row_name(self, row: int) -> str:
        return f"{self.name} along {'xyz'[row]}"


class PositionAlong(ExpressionConstraint):
    """``lower ≤ D (p(q) − p*) ≤ upper`` for directions in the world, the rows of ``D``, shape (k, 3), meters."""

    unit = "m"

    def __init__(
        self, name: str, point: PointOnLink, target: Array, directions: Array, lower: float, upper: float
    ) -> None:
        self.name, self.point, self.directions = name, point, directions
        self.parameters = np.concatenate([target, directions.ravel()])
        self.lower, self.upper = np.full(len(directions), lower), np.full(len(directions), upper)

    def symbolic(self, tree: Tree, parameters: ca.SX) -> ca.SX:
        directions = ca.reshape(parameters[3:], 3, self.rows).T
        return directions @ (tree.position(self.point) - parameters[:3])

    def evaluate(self, model: Numeric) -> tuple[Array, Array]:
        off = model.placement(self.point).translation - self.parameters[:3]
        return self.directions @ off, self.directions @ model.jacobian(self.point)[:3]


class HeldOrientation(ExpressionConstraint):
    """The frame keeps its world orientation ``target``, shape (3, 3), or only the direction of one axis.

    The rows are twice the vector part of the error quaternion ``Q_right* ⊗ Q_target* ⊗ Q(q) ⊗ Q_right``.  To first
    order, the rows are the rotation vector of the error, rad.  The error is zero only at the target and largest at
    180°, where a skew-symmetric error is zero again.  If ``axis``, a vector in the frame, is given, ``Q_right`` turns
    z to ``axis``, and only the first two components are rows.  The frame may then turn about ``axis``.  If ``axis``
    is ``None``, ``Q_right`` is the identity, and all three components are rows.
    """

    unit = "rad"

    def __init__(self, name: str, point: PointOnLink, target: Array, axis: Array | None = None) -> None:
        self.name, self.point, target = name, point, np.array(target, dtype=float)
        self.axis = axis
        width = 3 if axis is None else 2
        right = np.eye(3)
        if axis is not None:
            right = pin.Quaternion.FromTwoVectors(right[2], np.array(axis, dtype=float)).matrix()
        left = target @ right

        self.parameters = np.concatenate([_coefficients(left.T), _coefficients(right)])
        self._left, self._right = pin.Quaternion(self.parameters[:4]), pin.Quaternion(self.parameters[4:8])
        self._axes = self._right.matrix()
        self.lower = self.upper = np.zeros(width)

    def describe(self) -> str:
        return super().describe() + ("" if self.axis is None else " (tilt zero, yaw free)")

    def symbolic(self, tree: Tree, parameters: ca.SX) -> ca.SX:
        error = quaternion_product(quaternion_product(parameters[:4], tree.quaternion(self.point)), parameters[4:8])
        return 2 * error[: self.rows]

    def evaluate(self, model: Numeric) -> tuple[Array, Array]:
        return self.error(model.placement(self.point).rotation, model.jacobian(self.point)[3:])

    def error(self, rotation: Array, jacobian: Array) -> tuple[Array, Array]:
        """Return the rows and their tangent Jacobian.

        ``jacobian`` is the angular Jacobian of the frame, shape (3, nv).
        """
        error = (self._left * pin.Quaternion(rotation) * self._right).coeffs()
        x, y, z, w = (error if error[3] >= 0 else -error).tolist()
        # d(2 vec(Q)) = (w I + [v]×) ω, with ω in the axes of the frame, turned by Q_right.
        turn = np.array([[w, -z, y], [z, w, -x], [-y, x, w]])[: self.rows] @ (rotation @ self._axes).T
        return 2 * np.array([x, y, z])[: self.rows], turn @ jacobian

    def pose_error(self, value: Array) -> tuple[float, float]:
        """Return a zero position error and the error angle θ, rad; the rows have the norm ``2 sin(θ/2)``."""
        return 0.0, 2 * float(np.arcsin(min(1.0, float(np.linalg.norm(value)) / 2)))


class HeldPose(ExpressionConstraint):
    """The frame keeps its position and orientation (six rows), or may spin about ``axis`` (five rows).

    ``orientation`` is the constraint on the orientation alone.
    """

    unit = "in m and rad"

    def __init__(self, name: str, point: PointOnLink, target: pin.SE3, axis: Array | None = None) -> None:
        self.name = name
        self._parts = (
            HeldPosition(name, point, target.translation),
            HeldOrientation(name, point, target.rotation, axis),
        )
        self.orientation = self._parts[1]
        self.parameters = np.concatenate([p.parameters for p in self._parts])
        self.lower = self.upper = np.zeros(sum(p.rows for p in self._parts))

    def describe(self) -> str:
        return super().describe() + ("" if self.rows == 6 else " (position and normal; spin free)")

    def symbolic(self, tree: Tree, parameters: ca.SX) -> ca.SX:
        position, orientation = self._parts
        return ca.vertcat(position.symbolic(tree, parameters[:3]), orientation.symbolic(tree, parameters[3:]))

    def evaluate(self, model: Numeric) -> tuple[Array, Array]:
        position, orientation = self._parts
        at, jacobian = model.placement(position.point), model.jacobian(position.point)
        turned, turning = orientation.error(at.rotation, jacobian[3:])
        return (
            np.concatenate([at.translation - position.parameters, turned]),
            np.concatenate([jacobian[:3], turning]),
        )

    def pose_error(self, value: Array) -> tuple[float, float]:
        position, orientation = self._parts
        return position.pose_error(value[:3])[0], orientation.pose_error(value[3:])[1]


class AxisInCone(ExpressionConstraint):
    """An axis of the frame stays within a cone, ``−dᵀR(q)c ≤ −cos α``, and the frame may turn about this axis.

    ``axis`` is the unit vector ``c`` in the frame, shape (3,).  ``direction`` is the axis ``d`` of the cone in the
    world, shape (3,).  ``degrees`` is the half angle α of the cone.  ``point`` is a point on the link of the frame.
    """

    unit = "in the cosine"

    def __init__(self, name: str, point: PointOnLink, axis: Array, direction: Array, degrees: float) -> None:
        self.name, self.point, self._degrees = name, point, degrees
        self.parameters = np.concatenate([axis, direction])
        self.lower, self.upper = np.array([-np.inf]), np.array([-np.cos(np.deg2rad(degrees))])

    def describe(self) -> str:
        return f"{self.name} at most {self._degrees:g}°, spin free"

    def symbolic(self, tree: Tree, parameters: ca.SX) -> ca.SX:
        return -ca.dot(tree.rotation(self.point) @ parameters[:3], parameters[3:])

    def evaluate(self, model: Numeric) -> tuple[Array, Array]:
        axis, direction = self.parameters[:3], self.parameters[3:]
        now = model.placement(self.point).rotation @ axis
        return -np.array([now @ direction]), (model.jacobian(self.point)[3:].T @ np.cross(direction, now))[None, :]


class HeldTurn(ExpressionConstraint):
    """The base does not turn about ``axis``, which is fixed in the base: ``2 axis·vec(Q*⁻¹ ⊗ Q(q)) = 0``.

    ``point`` is the origin of the base, ``target`` the orientation ``Q*`` of the base before a turn, shape (3, 3),
    and ``axis`` a unit vector in base axes, shape (3,).
    """

    unit = "rad"

    def __init__(self, point: PointOnLink, target: Array, axis: Array, name: str) -> None:
        self.name = name
        self._orientation = HeldOrientation(name, point, target)
        self._axis = np.array(axis, dtype=float)
        self.parameters = np.concatenate([self._orientation.parameters, self._axis])
        self.lower = self.upper = np.zeros(1)

    def symbolic(self, tree: Tree, parameters: ca.SX) -> ca.SX:
        return ca.dot(parameters[8:], self._orientation.symbolic(tree, parameters[:8]))

    def evaluate(self, model: Numeric) -> tuple[Array, Array]:
        value, jacobian = self._orientation.evaluate(model)
        return np.array([self._axis @ value]), (self._axis @ jacobian)[None, :]


def base_point() -> PointOnLink:
    """Return the point at the origin of the floating base, with the axes of the base."""
    return PointOnLink(1, np.zeros(3), np.eye(3))


def _coefficients(rotation: Array) -> Array:
    return np.array(pin.Quaternion(np.asarray(rotation)).coeffs())
