"""Joint types that occur in URDFs: transform, orientation and motion subspace as CasADi expressions."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impact_posture.dynamics.spatial import Spin, constant, quaternion_matrix, skew, template
from impact_posture.errors import UnsupportedJoint
from impact_posture.robot.model_joints import JOINT_ENTRIES, joint_family

# ``_TURNING`` are families that rotate by an angle about an axis.  The configuration of the ``_QUATERNION`` families
# ends with a quaternion.
_TURNING, _QUATERNION = ("revolute", "continuous", "planar"), ("free-flyer", "spherical")


@dataclass(frozen=True)
class JointKind:
    """Type of a joint.

    Attributes:
        family: ``revolute``, ``continuous``, ``prismatic``, ``free-flyer``, ``planar``, ``spherical`` or
            ``translation``.
        axis: Unit axis in the joint frame, shape (3,); zero for a family without an axis.
        subspace: Motion subspace ``S`` in the joint frame, shape (6, nv); constant for all families.
        nq: Number of entries in ``q``.
    """

    family: str
    axis: NDArray[np.float64]
    subspace: NDArray[np.float64]
    nq: int

    @property
    def nv(self) -> int:
        """Number of degrees of freedom."""
        return int(self.subspace.shape[1])


def joint_kind(joint: pin.JointModel, name: str) -> JointKind:
    """Classify a Pinocchio joint.

    Raises:
        UnsupportedJoint: The joint type cannot occur in a URDF (composite, universal, helical, ...).
    """
    family = joint_family(joint)
    if family not in JOINT_ENTRIES:
        hint = "lock it (`lock`) or model it by revolute and prismatic joints"
        raise UnsupportedJoint(f"joint '{name}' is of type {family}", where="symbolic dynamics", hint=hint)
    # The motion subspace S does not depend on the configuration, so any configuration can be used here.
    data = joint.createData()
    joint.calc(data, np.full(joint.idx_q + joint.nq, 0.5))
    subspace = np.array(data.S, dtype=float).reshape(6, -1)
    axes = {"revolute": subspace[3:, 0], "prismatic": subspace[:3, 0], "planar": subspace[3:, -1]}
    axis = axes.get("revolute" if family == "continuous" else family, np.zeros(3))
    return JointKind(family, axis, subspace, int(joint.nq))


def joint_transform(kind: JointKind, q: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Return rotation (3, 3) and translation (3,) of the joint frame at ``q``, relative to its rest frame."""
    rotation, translation = ca.SX.eye(3), ca.SX(3, 1)
    if kind.family in _TURNING:
        rotation = axis_rotation(*_cosine_sine(kind, q), axis=tuple(kind.axis.tolist()))
    elif kind.family in _QUATERNION:
        rotation = quaternion_matrix(q[-4:])
    sliding = kind.subspace[:3, kind.subspace[:3].any(axis=0)]
    if sliding.size:
        translation = constant(sliding) @ q[: sliding.shape[1]]
    return rotation, translation


def joint_spin(kind: JointKind, q: ca.SX) -> Spin | None:
    """Return the rotation of a joint if it rotates about a coordinate axis; ``None`` for other joints."""
    axis = int(np.argmax(np.abs(kind.axis)))
    if kind.family not in ("revolute", "continuous") or abs(kind.axis[axis]) < 1 - 1e-15:
        return None
    cosine, sine = _cosine_sine(kind, q)
    sense = float(np.sign(kind.axis[axis]))
    return Spin(axis, cosine, sense * sine, sense)


def _cosine_sine(kind: JointKind, q: ca.SX) -> tuple[ca.SX, ca.SX]:
    return (ca.cos(q[0]), ca.sin(q[0])) if kind.family == "revolute" else (q[-2], q[-1])


@template
def axis_rotation(cosine: ca.SX, sine: ca.SX, *, axis: tuple[float, ...]) -> ca.SX:
    """Return the rotation about the unit ``axis`` a, ``aaᵀ + cos (I − aaᵀ) + sin [a]×`` (Rodrigues)."""
    outer = np.outer(axis, axis)
    return ca.sparsify(constant(outer) + cosine * constant(np.eye(3) - outer) + sine * skew(constant(axis)))


def joint_quaternion(kind: JointKind, x: ca.SX) -> ca.SX:
    """Return the unit quaternion ``x y z w`` of a joint rotation as a smooth function of the chart coordinates.

    The quaternion needs the half angle, which is not a smooth function of cosine and sine.  For this reason, the
    chart coordinate of a continuous or planar joint is the angle (:class:`~impact_posture.dynamics.chart.Chart`).
    """
    if kind.family in _TURNING:
        half = x[-1] / 2
        return ca.vertcat(ca.densify(constant(kind.axis)) * ca.sin(half), ca.cos(half))
    return x[-4:] if kind.family in _QUATERNION else ca.SX([0, 0, 0, 1])
