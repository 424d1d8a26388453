"""What a posture has to satisfy.  A constraint says it twice: as an expression, and in Pinocchio's numbers.

To add one, derive from :class:`Constraint` and give ``symbolic`` and ``evaluate``; the program, the search for
feasible starts, the certificate and the elastic diagnosis take it from there.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence

import casadi as ca
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impact_posture.dynamics.numeric import Numeric
from impact_posture.dynamics.spatial import quaternion_product
from impact_posture.dynamics.tree import PointOnLink, Tree

Vector = NDArray[np.float64]


class Constraint(ABC):
    """``lower ≤ c(q) ≤ upper``; an equality where both are zero.

    Attributes:
        name: What it is called when it is active or in conflict.
        parameters: Numbers that may change without rebuilding the program (targets, polygons).
        lower: Lower bounds, shape (rows,).
        upper: Upper bounds, shape (rows,).
    """

    name: str
    parameters: Vector
    lower: Vector
    upper: Vector

    @property
    def rows(self) -> int:
        """Number of scalar constraints."""
        return int(self.lower.size)

    @property
    def equality(self) -> bool:
        """Whether it holds something at a value."""
        return bool((self.lower == self.upper).all())

    @property
    def structure(self) -> str:
        """What distinguishes two constraints apart from their parameters and bounds; part of the cache's key."""
        return f"{type(self).__name__}:{self.name}:{self.rows}"

    @abstractmethod
    def symbolic(self, tree: Tree, parameters: ca.SX) -> ca.SX:
        """``c(q)`` as an expression, shape (rows, 1); ``tree`` was built with ``chart_x``."""

    @abstractmethod
    def evaluate(self, model: Numeric) -> tuple[Vector, Vector]:
        """``c(q)``, shape (rows,), and its tangent Jacobian, shape (rows, nv), at ``model.q``."""

    def describe(self) -> str:
        """The constraint in words, one line."""
        return f"{self.name} {'held' if self.equality else 'kept within its bounds'}"

    def row_name(self, row: int) -> str:
        """What one row is called."""
        return self.name if self.rows == 1 else f"{self.name}[{row}]"

    def pose_error(self, model: Numeric) -> tuple[float, float]:
        """Error in meters and radians where it holds a pose, else zeros."""
        return 0.0, 0.0


class HeldPosition(Constraint):
    """The point stays where it is: ``p(q) − p*``, world axes, meters."""

    def __init__(self, name: str, point: PointOnLink, target: Vector) -> None:
        self.name, self.point = name, point
        self.parameters = np.array(target, dtype=float)
        self.lower = self.upper = np.zeros(3)

    def symbolic(self, tree: Tree, parameters: ca.SX) -> ca.SX:
        """See :class:`Constraint`."""
        return tree.position(self.point) - parameters

    def evaluate(self, model: Numeric) -> tuple[Vector, Vector]:
        """See :class:`Constraint`."""
        return model.placement(self.point).translation - self.parameters, model.jacobian(self.point)[:3]

    def pose_error(self, model: Numeric) -> tuple[float, float]:
        """See :class:`Constraint`."""
        return float(np.linalg.norm(self.evaluate(model)[0])), 0.0


class PositionBox(HeldPosition):
    """The point stays within a box around a place: ``|p(q) − p*| ≤ half``, world axes, meters."""

    def __init__(self, name: str, point: PointOnLink, target: Vector, half: Sequence[float]) -> None:
        super().__init__(name, point, target)
        self.upper = np.array(half, dtype=float)
        self.lower = -self.upper

    def describe(self) -> str:
        """See :class:`Constraint`."""
        return f"{super().describe()} (" + " × ".join(f"±{v:g}" for v in self.upper) + " m)"

    def row_name(self, row: int) -> str:
        """See :class:`Constraint`."""
        return f"{self.name} along {'xyz'[row]}"

    def pose_error(self, model: Numeric) -> tuple[float, float]:
        """Distance outside the box."""
        outside = np.maximum(np.abs(self.evaluate(model)[0]) - self.upper, 0.0)
        return float(np.linalg.norm(outside)), 0.0


class HeldOrientation(Constraint):
    """The frame keeps its orientation, or all of it but a turn about one axis.

    ``2 vec(Q_left* ⊗ Q(q) ⊗ Q_right)``: the vector part of the error's quaternion, polynomial in half angles.  It is
    zero at the target only (at 180° it is largest, where a skew-symmetric error is zero again), smooth, and to first
    order the rotation vector in radians.  With the first two components alone the frame's ``axis`` points as wanted
    and its spin is free.

    Args:
        name: Its name.
        point: Whose orientation.
        target: Wanted world rotation, shape (3, 3).
        axis: Axis in the frame whose direction is held and about which it may turn; ``None`` holds all three.
    """

    def __init__(self, name: str, point: PointOnLink, target: Vector, axis: Vector | None = None) -> None:
        self.name, self.point, self.target = name, point, np.array(target, dtype=float)
        self.axis = axis
        width = 3 if axis is None else 2
        right = np.eye(3) if axis is None else _rotation_to(axis)
        left = self.target @ right
        self.parameters = np.concatenate([_coefficients(left.T), _coefficients(right)])
        self.lower = self.upper = np.zeros(width)

    def describe(self) -> str:
        """See :class:`Constraint`."""
        return super().describe() + ("" if self.axis is None else " (tilt zero, yaw free)")

    def symbolic(self, tree: Tree, parameters: ca.SX) -> ca.SX:
        """See :class:`Constraint`."""
        error = quaternion_product(quaternion_product(parameters[:4], tree.quaternion(self.point)), parameters[4:8])
        return 2 * error[: self.rows]

    def evaluate(self, model: Numeric) -> tuple[Vector, Vector]:
        """See :class:`Constraint`."""
        right = pin.Quaternion(self.parameters[4:8])
        placement = model.placement(self.point)
        error = pin.Quaternion(self.parameters[:4]) * pin.Quaternion(placement.rotation) * right
        vector, w = np.array(error.coeffs()[:3]), float(error.w)
        sign = 1.0 if w >= 0 else -1.0
        # d(2 vec(Q)) = (w I + [v]×) ω in the axes that Q turns, here the frame's times `right`.
        body = (placement.rotation @ right.matrix()).T @ model.jacobian(self.point)[3:]
        J = (w * np.eye(3) + pin.skew(vector)) @ body
        return sign * 2 * vector[: self.rows], sign * J[: self.rows]

    def pose_error(self, model: Numeric) -> tuple[float, float]:
        """See :class:`Constraint`."""
        rotation = model.placement(self.point).rotation
        if self.axis is None:
            return 0.0, float(np.linalg.norm(pin.log3(self.target.T @ rotation)))
        now, wanted = rotation @ self.axis, self.target @ self.axis
        return 0.0, float(np.arctan2(np.linalg.norm(np.cross(now, wanted)), now @ wanted))


class HeldPose(Constraint):
    """Position and orientation together: one name, six rows (five with a free spin)."""

    def __init__(self, name: str, point: PointOnLink, target: pin.SE3, axis: Vector | None = None) -> None:
        self.name = name
        self._parts: tuple[Constraint, ...] = (
            HeldPosition(name, point, target.translation),
            HeldOrientation(name, point, target.rotation, axis),
        )
        self.parameters = np.concatenate([p.parameters for p in self._parts])
        self.lower = self.upper = np.zeros(sum(p.rows for p in self._parts))

    def describe(self) -> str:
        """See :class:`Constraint`."""
        return super().describe() + ("" if self.rows == 6 else " (position and normal; spin free)")

    def symbolic(self, tree: Tree, parameters: ca.SX) -> ca.SX:
        """See :class:`Constraint`."""
        position, orientation = self._parts
        return ca.vertcat(position.symbolic(tree, parameters[:3]), orientation.symbolic(tree, parameters[3:]))

    def evaluate(self, model: Numeric) -> tuple[Vector, Vector]:
        """See :class:`Constraint`."""
        values, jacobians = zip(*(p.evaluate(model) for p in self._parts), strict=True)
        return np.concatenate(values), np.vstack(jacobians)

    def pose_error(self, model: Numeric) -> tuple[float, float]:
        """See :class:`Constraint`."""
        position, orientation = self._parts
        return position.pose_error(model)[0], orientation.pose_error(model)[1]


class HeldTurn(Constraint):
    """The base's turn about one axis of its own: ``2 axis·vec(Q*⁻¹ ⊗ Q(q))``.

    Args:
        point: The base.
        target: Orientation that counts as no turn, shape (3, 3).
        axis: Unit axis in the base, shape (3,).
        name: Its name.
    """

    def __init__(self, point: PointOnLink, target: Vector, axis: Vector, name: str) -> None:
        self.name = name
        self._whole = HeldOrientation(name, point, target)
        self._axis = np.array(axis, dtype=float)
        self.parameters = np.concatenate([self._whole.parameters, self._axis])
        self.lower = self.upper = np.zeros(1)

    def symbolic(self, tree: Tree, parameters: ca.SX) -> ca.SX:
        """See :class:`Constraint`."""
        return ca.dot(parameters[8:], self._whole.symbolic(tree, parameters[:8]))

    def evaluate(self, model: Numeric) -> tuple[Vector, Vector]:
        """See :class:`Constraint`."""
        value, jacobian = self._whole.evaluate(model)
        return np.array([self._axis @ value]), (self._axis @ jacobian)[None, :]


class CenterOfMassOverFeet(Constraint):
    """The center of mass stays above the feet: ``margin − (A xy − b) ≥ 0`` written as ``A xy − b ≤ −margin``, meters.

    Args:
        normals: Outward unit normals of the support polygon's edges, shape (k, 2).
        offsets: ``b``, shape (k,).
        margin: Distance kept from the edges.
        loaded: The model whose center of mass it is and what tells it from the problem's own; ``None``: that one.
    """

    def __init__(
        self, normals: Vector, offsets: Vector, margin: float, loaded: tuple[pin.Model, str] | None = None
    ) -> None:
        self.name = "center of mass over the feet" + (f" with {loaded[1]}" if loaded else "")
        self.normals, self.offsets, self.margin = normals, offsets, margin
        self._model = loaded[0] if loaded else None
        self._k = len(offsets)
        self.parameters = np.concatenate([normals.T.reshape(-1), offsets])
        self.lower = np.full(self._k, -np.inf)
        self.upper = np.full(self._k, -margin)

    def describe(self) -> str:
        """See :class:`Constraint`."""
        return f"{self.name}, {self.margin:g} m inside the support polygon"

    def symbolic(self, tree: Tree, parameters: ca.SX) -> ca.SX:
        """See :class:`Constraint`."""
        k, own = self._k, tree if self._model is None else Tree(self._model, tree.q)
        center = own.center_of_mass()
        return parameters[:k] * center[0] + parameters[k : 2 * k] * center[1] - parameters[2 * k :]

    def evaluate(self, model: Numeric) -> tuple[Vector, Vector]:
        """See :class:`Constraint`."""
        k = self._k
        normals = self.parameters[: 2 * k].reshape(2, k).T
        own = model if self._model is None else Numeric(self._model).at(model.q)
        center, jacobian = own.center_of_mass()
        return normals @ center[:2] - self.parameters[2 * k :], normals @ jacobian[:2]

    def row_name(self, row: int) -> str:
        """See :class:`Constraint`."""
        return f"{self.name} (edge {row})"


def _coefficients(rotation: Vector) -> Vector:
    return np.array(pin.Quaternion(np.asarray(rotation)).coeffs())


def _rotation_to(axis: Vector) -> Vector:
    """A rotation that takes e_z to ``axis``."""
    return np.array(pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), np.array(axis, dtype=float)).matrix())
