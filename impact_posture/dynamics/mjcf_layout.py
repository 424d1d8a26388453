"""Conversions between ``q, v`` of Pinocchio and ``qpos, qvel`` of MuJoCo for the same kinematic tree.

Pinocchio and MuJoCo differ in these points:

- A quaternion is stored as x y z w in Pinocchio, and as w x y z in MuJoCo.
- The position of a continuous joint is a cosine and a sine in Pinocchio, and an angle in MuJoCo.
- The linear velocity of a base is in body axes in Pinocchio, and in the axes of the world or of the rest frame in
  MuJoCo.
- The pose of a base is relative to the rest frame of its joint in Pinocchio, and relative to the world in MuJoCo.
- MuJoCo numbers joints in depth-first order; Pinocchio can have another order.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impact_posture.dynamics.chart import Chart, JointSlot
from impact_posture.robot.model_joints import is_free_flyer
from impact_posture.system.arrays import Array


@dataclass(frozen=True)
class MjcfSlot:
    """Entries of one Pinocchio joint in the MuJoCo vectors.

    Attributes:
        joint: Type of the joint, and its entries in the Pinocchio vectors.
        qpos: Entries of the joint in ``qpos``.
        qvel: Entries of the joint in ``qvel``.
        placement: Placement of the rest frame of the joint in its parent.
        moved: Whether the joint is a MuJoCo free joint whose rest frame is not the world frame.  In MuJoCo, pose and
            linear velocity of a free joint are in world axes, and positions of slides in the rest frame.
    """

    joint: JointSlot
    qpos: slice
    qvel: slice
    placement: pin.SE3
    moved: bool


class MjcfLayout:
    """Conversions between Pinocchio and MuJoCo coordinates of one model.

    The matrix ``T(q)`` with ``qvel = T v`` is orthogonal, because it only rotates linear velocities and permutes
    entries.  ``order`` contains the joint indices in the (depth-first) order of the MuJoCo bodies.  ``free`` contains
    the indices of the joints that are free joints in MuJoCo.
    """

    def __init__(self, model: pin.Model, order: Sequence[int], free: frozenset[int]) -> None:
        self._chart = chart = Chart(model)
        self.nqpos, self.nv, self.nq = chart.nx, chart.nv, chart.nq
        self.slots: list[MjcfSlot] = []
        # For each entry of qpos, ``places`` has the index of the chart coordinate with the same value.  For each
        # entry of qvel, ``rates`` has the index of the same entry in v.
        places: list[int] = []
        rates: list[int] = []
        for i in order:
            joint = chart.slots[i - 1]
            x, v = list(range(joint.x.start, joint.x.stop)), range(joint.v.start, joint.v.stop)
            if joint.kind.family in ("spherical", "free-flyer"):
                x = [*x[:-4], x[-1], *x[-4:-1]]
            place = pin.SE3(model.jointPlacements[i])
            moved = i in free and not place.isIdentity(0.0)
            ends = slice(len(places), len(places) + len(x)), slice(len(rates), len(rates) + len(v))
            self.slots.append(MjcfSlot(joint, *ends, place, moved))
            places += x
            rates += v
        # For speed, a permutation converts most entries of all joints at once.  Only poses relative to another frame
        # and linear velocities are converted for each joint.
        self._places, self._permutation = np.array(places, dtype=int), np.eye(self.nv)[rates]
        self._rates = np.argsort(rates)
        self._moved = [slot for slot in self.slots if slot.moved]
        self._turning = [slot for slot in self.slots if slot.joint.kind.family in ("free-flyer", "planar")]

    @property
    def places(self) -> tuple[NDArray[np.int_], NDArray[np.int_]] | None:
        """Index in ``qpos`` of each entry of ``q``, and index in ``qvel`` of each entry of ``v``.

        ``None`` for a model with joints that are not hinges or slides.  For a floating base, the caller must also
        normalize the quaternion and rotate the linear velocity.
        """
        base = len(self._turning)
        # If no joint has a cosine and a sine in q, the chart coordinates equal q.
        plain = not self._moved and base <= 1 and self.nq == self.nqpos and self.slots[:base] == self._turning
        if not plain or any(slot.joint.kind.nv != 1 for slot in self.slots[base:]):
            return None
        return np.argsort(self._places), self._rates

    def qpos(self, q: Array) -> Array:
        """Convert a configuration, shape (nq,), to ``qpos``, shape (nqpos,)."""
        for slot in self._moved:
            q = q.copy()
            q[slot.joint.q] = pin.SE3ToXYZQUAT(slot.placement * pin.XYZQUATToSE3(q[slot.joint.q]))
        return np.asarray(self._chart.to_x(q)[self._places])

    def q(self, qpos: Array) -> Array:
        """Convert ``qpos``, shape (nqpos,), to a configuration, shape (nq,), with normalized quaternions."""
        x = np.zeros(self.nqpos)
        x[self._places] = qpos
        q = self._chart.to_q(x)
        for slot in self._moved:
            pose = slot.placement.actInv(pin.XYZQUATToSE3(q[slot.joint.q]))
            q[slot.joint.q] = pin.SE3ToXYZQUAT(pose)
        return q

    def velocity_map(self, q: Array) -> Array:
        """Return the orthogonal matrix ``T(q)`` with ``qvel = T v``, shape (nv, nv).

        Therefore ``M = Tᵀ M_mj T``, ``J = J_mj T`` and ``τ = Tᵀ τ_mj``, with the MuJoCo quantities ``…_mj``.
        """
        T = self._permutation.copy()
        for slot in self._turning:
            turn = _turn(slot, q[slot.joint.q])
            row, column, size = slot.qvel.start, slot.joint.v.start, len(turn)
            T[row : row + size, column : column + size] = turn
        return T

    def qvel(self, q: Array, v: Array) -> Array:
        """Convert a velocity ``v``, shape (nv,), at ``q`` to ``qvel``."""
        return np.asarray(self.velocity_map(q) @ v)

    def state(self, qpos: Array, qvel: Array) -> tuple[Array, Array]:
        """Convert ``qpos`` and ``qvel`` to the Pinocchio configuration, shape (nq,), and velocity, shape (nv,)."""
        # Simulations call this method in every tick.  For speed, it does not compute the matrix T of ``qvel = T v``.
        q, v = self.q(qpos), qvel[self._rates]
        for slot in self._turning:
            turn = _turn(slot, q[slot.joint.q])
            start, begin = slot.joint.v.start, slot.qvel.start
            v[start : start + len(turn)] = qvel[begin : begin + len(turn)] @ turn
        return q, v


def file_layout(joints: pin.Model) -> MjcfLayout:
    """Return the layout of a compiled MJCF for the model that :mod:`impact_posture.robot.mjcf_model` makes of it."""
    return MjcfLayout(joints, range(1, joints.njoints), frozenset({1} if is_free_flyer(joints) else ()))


def _turn(slot: MjcfSlot, piece: Array) -> Array:
    """Return the rotation of linear velocities from Pinocchio to MuJoCo axes; ``piece`` is the joint's ``q``."""
    if slot.joint.kind.family == "planar":
        return np.array([[piece[2], -piece[3]], [piece[3], piece[2]]])
    R = pin.Quaternion(np.array(piece[3:])).matrix()
    return np.asarray(slot.placement.rotation @ R if slot.moved else R)
