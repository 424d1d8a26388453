"""Conversions between ``q, v`` of Pinocchio and ``qpos, qvel`` of MuJoCo, for the same tree.

The two differ in these points:

- A quaternion is x y z w in Pinocchio and w x y z in MuJoCo.
- A continuous joint is a cosine and a sine in Pinocchio and an angle in MuJoCo.
- A linear velocity is in body axes in Pinocchio, and in the axes of the world or of the rest frame in MuJoCo.
- The pose of a base is relative to the rest frame of its joint in Pinocchio and to the world in MuJoCo.
- MuJoCo numbers joints depth first, Pinocchio may not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impact_posture.dynamics.chart import Chart, JointSlot

Vector = NDArray[np.float64]

# How many numbers of qpos a joint has.  It has as many velocities as in Pinocchio.
_WIDTH = {
    "revolute": 1,
    "continuous": 1,
    "prismatic": 1,
    "planar": 3,
    "spherical": 4,
    "translation": 3,
    "free-flyer": 7,
}
# Families with the same single number in Pinocchio and MuJoCo.
_PLAIN = ("revolute", "prismatic")


@dataclass(frozen=True)
class MjcfSlot:
    """Place of one Pinocchio joint in the MuJoCo vectors.

    Attributes:
        joint: Type of the joint, and its place in the Pinocchio vectors.
        qpos: Its entries of ``qpos``.
        qvel: Its entries of ``qvel``.
        free: Whether it is a MuJoCo free joint, whose pose and linear velocity are in world axes.  Any other
            free-flyer is three slides and a ball in the rest frame of the joint.
        placement: Rest frame of the joint in its parent.
    """

    joint: JointSlot
    qpos: slice
    qvel: slice
    free: bool
    placement: pin.SE3

    @cached_property
    def moved(self) -> bool:
        """Whether the rest frame differs from the parent frame."""
        return not self.placement.isIdentity(0.0)


class MjcfLayout:
    """Conversions between Pinocchio and MuJoCo coordinates of one model.

    The velocity map ``T(q)``, ``qvel = T v``, is orthogonal, because it rotates linear parts and permutes entries.

    Args:
        model: The Pinocchio model.
        order: Joint indices in the order of the MuJoCo bodies, which is depth first.
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
        # A simulation converts in every tick.  Joints with one number on both sides are copied by index, all at once.
        plain = [slot for slot in self.slots if slot.joint.kind.family in _PLAIN]
        self._plain_q = np.array([slot.joint.q.start for slot in plain], dtype=int)
        self._plain_qpos = np.array([slot.qpos.start for slot in plain], dtype=int)
        self._others = [slot for slot in self.slots if slot.joint.kind.family not in _PLAIN]
        self._turning = [slot for slot in self.slots if slot.joint.kind.family in ("free-flyer", "planar")]
        # The velocity map before the linear parts are rotated.
        self._permutation = np.zeros((self.nv, self.nv))
        for slot in self.slots:
            self._permutation[slot.qvel, slot.joint.v] = np.eye(slot.joint.kind.nv)

    def qpos(self, q: Vector) -> Vector:
        """Return ``qpos``, shape (nqpos,), of a configuration, shape (nq,)."""
        found = np.zeros(self.nqpos)
        found[self._plain_qpos] = q[self._plain_q]
        for slot in self._others:
            piece, family = q[slot.joint.q], slot.joint.kind.family
            if family == "continuous":
                value: Vector = np.array([np.arctan2(piece[1], piece[0])])
            elif family == "planar":
                value = np.array([piece[0], piece[1], np.arctan2(piece[3], piece[2])])
            elif family == "spherical":
                value = _scalar_first(piece)
            elif family == "free-flyer":
                if slot.free and slot.moved:
                    piece = pin.SE3ToXYZQUAT(slot.placement * pin.XYZQUATToSE3(piece))
                value = np.concatenate([piece[:3], _scalar_first(piece[3:])])
            else:
                value = piece
            found[slot.qpos] = value
        return found

    def q(self, qpos: Vector) -> Vector:
        """Return the configuration, shape (nq,), of a ``qpos``, shape (nqpos,), with quaternions normalized."""
        found = np.zeros(self.nq)
        found[self._plain_q] = qpos[self._plain_qpos]
        for slot in self._others:
            piece, family = qpos[slot.qpos], slot.joint.kind.family
            if family == "continuous":
                value: Vector = np.array([np.cos(piece[0]), np.sin(piece[0])])
            elif family == "planar":
                value = np.array([piece[0], piece[1], np.cos(piece[2]), np.sin(piece[2])])
            elif family == "spherical":
                value = _scalar_last(piece)
            elif family == "free-flyer":
                value = np.concatenate([piece[:3], _scalar_last(piece[3:])])
                if slot.free and slot.moved:
                    pose = slot.placement.actInv(pin.XYZQUATToSE3(value))
                    value = pin.SE3ToXYZQUAT(pose)
            else:
                value = piece
            found[slot.joint.q] = value
        return found

    def velocity_map(self, q: Vector) -> Vector:
        """Return ``T(q)`` of ``qvel = T v``, orthogonal, shape (nv, nv).

        It follows that ``M = Tᵀ M_mj T``, ``J = J_mj T`` and ``τ = Tᵀ τ_mj``.
        """
        found = self._permutation.copy()
        for slot in self._turning:
            turn = _turn(slot, q[slot.joint.q])
            row, column, size = slot.qvel.start, slot.joint.v.start, len(turn)
            found[row : row + size, column : column + size] = turn
        return found

    def qvel(self, q: Vector, v: Vector) -> Vector:
        """Return ``qvel`` of a velocity, shape (nv,)."""
        return np.asarray(self.velocity_map(q) @ v)

    def state(self, qpos: Vector, qvel: Vector) -> tuple[Vector, Vector]:
        """Return the Pinocchio configuration, shape (nq,), and velocity, shape (nv,)."""
        q = self.q(qpos)
        return q, np.asarray(self.velocity_map(q).T @ qvel)


def _turn(slot: MjcfSlot, piece: Vector) -> Vector:
    """Return the rotation of the linear velocity of a free-flyer or planar joint."""
    if slot.joint.kind.family == "planar":
        return np.array([[piece[2], -piece[3]], [piece[3], piece[2]]])
    R = pin.Quaternion(np.array(piece[3:])).matrix()
    return np.asarray(slot.placement.rotation @ R if slot.free and slot.moved else R)


def _scalar_first(xyzw: Vector) -> Vector:
    return np.asarray(xyzw[[3, 0, 1, 2]])


def _scalar_last(wxyz: Vector) -> Vector:
    return np.asarray(wxyz[[1, 2, 3, 0]] / np.linalg.norm(wxyz))
