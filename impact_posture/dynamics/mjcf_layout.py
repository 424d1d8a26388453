"""Pinocchio's ``q, v`` and MuJoCo's ``qpos, qvel`` of the same tree, and the maps between them.

What differs: the order of quaternions (x y z w here, w x y z there), continuous joints (cosine and sine here, an
angle there), the axes of linear velocities (the body's here, the world's or the rest frame's there), the pose of a
base (in its joint's rest frame here, in the world there), and, where a model is not numbered depth first, the order
of joints.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impact_posture.dynamics.chart import Chart, JointSlot

Vector = NDArray[np.float64]

# Numbers in qpos; velocities are as many as in Pinocchio.
_WIDTH = {
    "revolute": 1,
    "continuous": 1,
    "prismatic": 1,
    "planar": 3,
    "spherical": 4,
    "translation": 3,
    "free-flyer": 7,
}


@dataclass(frozen=True)
class MjcfSlot:
    """Where one joint of Pinocchio's sits in MuJoCo's vectors.

    Attributes:
        joint: Where it sits in Pinocchio's, and what it is.
        qpos: Its numbers in ``qpos``.
        qvel: Its numbers in ``qvel``.
        free: A free joint of MuJoCo's, whose pose and linear velocity are the world's.  A free-flyer that is none is
            three slides and a ball, in the joint's rest frame.
        placement: The joint's rest frame in its parent.
    """

    joint: JointSlot
    qpos: slice
    qvel: slice
    free: bool
    placement: pin.SE3


class MjcfLayout:
    """Conversions between Pinocchio's and MuJoCo's coordinates of one model.

    The velocity map ``T(q)``, ``qvel = T v``, is orthogonal: rotations of linear parts, and a permutation.

    Args:
        model: The model.
        order: Joint indices in the order of MuJoCo's bodies: depth first.
        free: Indices of the joints that are free joints in MuJoCo.
    """

    def __init__(self, model: pin.Model, order: Sequence[int], free: frozenset[int]) -> None:
        by_index = {slot.index: slot for slot in Chart(model).slots}
        self.slots: list[MjcfSlot] = []
        q = v = 0
        for i in order:
            joint = by_index[i]
            width, rates = _WIDTH[joint.kind.family], joint.kind.nv
            place = pin.SE3(model.jointPlacements[i])
            self.slots.append(MjcfSlot(joint, slice(q, q + width), slice(v, v + rates), i in free, place))
            q, v = q + width, v + rates
        self.nqpos, self.nv, self.nq = q, v, int(model.nq)

    def qpos(self, q: Vector) -> Vector:
        """MuJoCo's ``qpos``, shape (nqpos,), of a configuration, shape (nq,)."""
        found = np.zeros(self.nqpos)
        for slot in self.slots:
            piece, family = q[slot.joint.q], slot.joint.kind.family
            if family == "continuous":
                value: Vector = np.array([np.arctan2(piece[1], piece[0])])
            elif family == "planar":
                value = np.array([piece[0], piece[1], np.arctan2(piece[3], piece[2])])
            elif family == "spherical":
                value = _scalar_first(piece)
            elif family == "free-flyer":
                pose = pin.XYZQUATToSE3(piece)
                position, quaternion = piece[:3], pin.Quaternion(np.array(piece[3:]))
                if slot.free:
                    position = (slot.placement * pose).translation
                    quaternion = pin.Quaternion(slot.placement.rotation) * quaternion
                value = np.concatenate([position, _scalar_first(quaternion.coeffs())])
            else:
                value = piece
            found[slot.qpos] = value
        return found

    def q(self, qpos: Vector) -> Vector:
        """Pinocchio's configuration, shape (nq,), of a ``qpos``; quaternions normalized."""
        found = np.zeros(self.nq)
        for slot in self.slots:
            piece, family = qpos[slot.qpos], slot.joint.kind.family
            if family == "continuous":
                value: Vector = np.array([np.cos(piece[0]), np.sin(piece[0])])
            elif family == "planar":
                value = np.array([piece[0], piece[1], np.cos(piece[2]), np.sin(piece[2])])
            elif family == "spherical":
                value = _scalar_last(piece)
            elif family == "free-flyer":
                position, quaternion = piece[:3], pin.Quaternion(_scalar_last(piece[3:]))
                if slot.free:
                    back = slot.placement.inverse()
                    position = back.act(np.array(position))
                    quaternion = pin.Quaternion(back.rotation) * quaternion
                value = np.concatenate([position, quaternion.coeffs()])
            else:
                value = piece
            found[slot.joint.q] = value
        return found

    def velocity_map(self, q: Vector) -> Vector:
        """``T(q)``, orthogonal, shape (nv, nv): ``qvel = T v``.

        So ``M = Tᵀ M_mj T``, ``J = J_mj T`` and ``τ = Tᵀ τ_mj``.
        """
        found = np.zeros((self.nv, self.nv))
        for slot in self.slots:
            block = np.eye(slot.joint.kind.nv)
            turn = _turn(slot, q[slot.joint.q])
            block[: len(turn), : len(turn)] = turn
            found[slot.qvel, slot.joint.v] = block
        return found

    def qvel(self, q: Vector, v: Vector) -> Vector:
        """MuJoCo's ``qvel`` of a velocity, shape (nv,)."""
        return np.asarray(self.velocity_map(q) @ v)

    def v(self, qpos: Vector, qvel: Vector) -> Vector:
        """Pinocchio's velocity of a ``qvel``, shape (nv,)."""
        return np.asarray(self.velocity_map(self.q(qpos)).T @ qvel)

    def qacc(self, q: Vector, v: Vector, a: Vector) -> Vector:
        """MuJoCo's ``qacc = T a + Ṫ v``, shape (nv,): linear parts turn with their body."""
        turning = np.zeros(self.nv)
        for slot in self.slots:
            piece = v[slot.joint.v]
            if slot.joint.kind.family == "free-flyer":
                turning[slot.joint.v.start : slot.joint.v.start + 3] = np.cross(piece[3:], piece[:3])
            elif slot.joint.kind.family == "planar":
                turning[slot.joint.v.start : slot.joint.v.start + 2] = -piece[2] * piece[1], piece[2] * piece[0]
        return np.asarray(self.velocity_map(q) @ (a + turning))


def _turn(slot: MjcfSlot, piece: Vector) -> Vector:
    """What turns the first entries of a joint's velocity; empty where nothing does."""
    family = slot.joint.kind.family
    if family == "free-flyer":
        R = pin.Quaternion(np.array(piece[3:])).matrix()
        return np.asarray(slot.placement.rotation @ R if slot.free else R)
    if family == "planar":
        return np.array([[piece[2], -piece[3]], [piece[3], piece[2]]])
    return np.zeros((0, 0))


def _scalar_first(xyzw: Vector) -> Vector:
    return np.asarray(np.roll(xyzw, 1))


def _scalar_last(wxyz: Vector) -> Vector:
    return np.asarray(np.roll(wxyz, -1) / np.linalg.norm(wxyz))
