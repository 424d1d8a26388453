"""Joints that the URDF parser of Pinocchio makes: placement, orientation and motion subspace as expressions."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impact_posture.dynamics.spatial import Spin, constant, quaternion_matrix, skew
from impact_posture.errors import UnsupportedJoint

_AXES = {"X": (1.0, 0.0, 0.0), "Y": (0.0, 1.0, 0.0), "Z": (0.0, 0.0, 1.0)}
# Short names of joint models without "JointModel", with the axis of the joint.
_REVOLUTE = {"RX": "X", "RY": "Y", "RZ": "Z", "RevoluteUnaligned": None}
_CONTINUOUS = {"RUBX": "X", "RUBY": "Y", "RUBZ": "Z", "RevoluteUnboundedUnaligned": None}
_PRISMATIC = {"PX": "X", "PY": "Y", "PZ": "Z", "PrismaticUnaligned": None}


@dataclass(frozen=True)
class JointKind:
    """Kind of a ``pin.JointModel``.

    Attributes:
        family: ``revolute``, ``continuous``, ``prismatic``, ``free-flyer``, ``planar``, ``spherical`` or
            ``translation``.
        axis: Unit axis in the joint frame, shape (3,); zeros where it has none.
        subspace: Motion subspace ``S`` in the joint frame, shape (6, nv); it is constant for all families.
        nq: Length of the configuration.
    """

    family: str
    axis: NDArray[np.float64]
    subspace: NDArray[np.float64]
    nq: int

    @property
    def nv(self) -> int:
        """Degrees of freedom."""
        return int(self.subspace.shape[1])


def joint_kind(joint: pin.JointModel, name: str) -> JointKind:
    """Classify a Pinocchio joint.

    Raises:
        UnsupportedJoint: No URDF makes such a joint (composite, universal, helical, ...).
    """
    short = joint.shortname().removeprefix("JointModel")
    for family, table in (("revolute", _REVOLUTE), ("continuous", _CONTINUOUS), ("prismatic", _PRISMATIC)):
        if short in table:
            axis = _axis(joint, table[short], linear=family == "prismatic")
            subspace = np.zeros((6, 1))
            subspace[0 if family == "prismatic" else 3 :][:3, 0] = axis
            return JointKind(family, axis, subspace, int(joint.nq))
    eye, none = np.eye(6), np.zeros(3)
    others = {
        "FreeFlyer": JointKind("free-flyer", none, eye, 7),
        "Planar": JointKind("planar", np.array(_AXES["Z"]), eye[:, [0, 1, 5]], 4),
        "Spherical": JointKind("spherical", none, eye[:, 3:], 4),
        "Translation": JointKind("translation", none, eye[:, :3], 3),
    }
    if short in others:
        return others[short]
    raise UnsupportedJoint(
        f"joint '{name}' is of type {short}",
        where="symbolic dynamics",
        hint="lock it (--lock) or model it by revolute and prismatic joints",
    )


def _axis(joint: pin.JointModel, letter: str | None, *, linear: bool) -> NDArray[np.float64]:
    if letter is not None:
        return np.array(_AXES[letter])
    alone = pin.Model()
    alone.addJoint(0, joint, pin.SE3.Identity(), "joint")
    data = alone.createData()
    pin.computeJointJacobians(alone, data, pin.neutral(alone))
    column = np.asarray(pin.getJointJacobian(alone, data, 1, pin.LOCAL)).reshape(6)
    return np.asarray(column[:3] if linear else column[3:])


def joint_transform(kind: JointKind, q: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Return rotation (3, 3) and translation (3,) of the moved frame in the rest frame of the joint."""
    zero = ca.SX(3, 1)
    if kind.family == "revolute":
        return axis_rotation(kind.axis, ca.cos(q[0]), ca.sin(q[0])), zero
    if kind.family == "continuous":
        return axis_rotation(kind.axis, q[0], q[1]), zero
    if kind.family == "prismatic":
        return ca.SX.eye(3), constant(kind.axis) * q[0]
    if kind.family == "free-flyer":
        return quaternion_matrix(q[3:7]), q[:3]
    if kind.family == "planar":
        return axis_rotation(kind.axis, q[2], q[3]), ca.sparsify(ca.vertcat(q[0], q[1], 0))
    if kind.family == "spherical":
        return quaternion_matrix(q), zero
    return ca.SX.eye(3), q[:3]


def joint_spin(kind: JointKind, q: ca.SX) -> Spin | None:
    """Return the rotation of a joint about a coordinate axis; ``None`` for another joint."""
    axis = int(np.argmax(np.abs(kind.axis)))
    if kind.family not in ("revolute", "continuous") or abs(kind.axis[axis]) < 1 - 1e-15:
        return None
    cosine, sine = (ca.cos(q[0]), ca.sin(q[0])) if kind.family == "revolute" else (q[0], q[1])
    sense = float(np.sign(kind.axis[axis]))
    return Spin(axis, cosine, sense * sine, sense)


def axis_rotation(axis: NDArray[np.float64], cosine: ca.SX, sine: ca.SX) -> ca.SX:
    """Return the rotation ``aaᵀ + cos (I − aaᵀ) + sin [a]×`` (Rodrigues)."""
    outer = np.outer(axis, axis)
    return ca.sparsify(constant(outer) + cosine * constant(np.eye(3) - outer) + sine * skew(constant(axis)))


def joint_quaternion(kind: JointKind, x: ca.SX) -> ca.SX:
    """Return the unit quaternion ``x y z w`` of a joint's rotation, smooth everywhere, from its chart coordinates.

    Continuous and planar joints enter by their angle (see :class:`~impact_posture.dynamics.chart.Chart`), because a
    half angle is no smooth function of its cosine and sine.
    """
    if kind.family in ("revolute", "continuous"):
        return _half(kind.axis, x[0])
    if kind.family == "planar":
        return _half(kind.axis, x[2])
    if kind.family == "free-flyer":
        return x[3:7]
    if kind.family == "spherical":
        return x
    return ca.SX([0, 0, 0, 1])


def _half(axis: NDArray[np.float64], angle: ca.SX) -> ca.SX:
    return ca.vertcat(ca.densify(constant(axis)) * ca.sin(angle / 2), ca.cos(angle / 2))
