"""Placements of links, points and frames of a robot at a symbolic configuration."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray

from impact_posture.dynamics.chart import Chart
from impact_posture.dynamics.joints import joint_quaternion, joint_spin, joint_transform
from impact_posture.dynamics.repeated_limbs import RepeatedLimbs
from impact_posture.dynamics.spatial import constant, quaternion_product, transposed_times
from impact_posture.robot.model_joints import finite_armature

# Joint index → quantity of the link that the joint moves, such as its inertia, force or velocity.
ByJoint = dict[int, ca.SX]
# (joint index, values that a sweep computes at the joint, as a vector), in the order of the sweeps.
Visits = list[tuple[int, ca.SX]]


@dataclass(frozen=True)
class PointOnLink:
    """A point and the axes of a frame, both fixed to a link.

    Attributes:
        joint: Index of the joint that moves the link.
        position: Position of the point in link coordinates, m, shape (3,).
        rotation: Axes of the frame as columns, in link coordinates, shape (3, 3).
    """

    joint: int
    position: NDArray[np.float64]
    rotation: NDArray[np.float64]

    @cached_property
    def placement(self) -> pin.SE3:
        """Placement of the point and its axes in link coordinates."""
        return pin.SE3(self.rotation, self.position)


class Kinematics:
    """Kinematics of a ``pin.Model`` at the configuration ``q``, shape (nq, 1).

    A joint with infinite armature is locked and does not move in an impact.  ``locked`` contains the velocity entries
    of locked joints.  ``extra_inertia`` maps joint indices to constant 6×6 inertias in link coordinates.  These
    inertias are added to the inertias of the model; for example, a foot with compliance ε gets the point mass 1/ε.
    With ``limbs``, parameters replace the constants that differ between repeated limbs.  ``chart_x`` contains the
    chart coordinates of ``q``.  Only :attr:`quaternions` needs ``chart_x``.  The sweeps append their values to
    ``visits``.
    """

    def __init__(
        self,
        model: pin.Model,
        q: ca.SX,
        chart_x: ca.SX | None = None,
        extra_inertia: Mapping[int, NDArray[np.float64]] | None = None,
        limbs: RepeatedLimbs | None = None,
        visits: Visits | None = None,
    ) -> None:
        self.model, self.q, self.visits = model, q, visits
        self.chart = Chart(model)
        self.nv = self.chart.nv
        self._x = chart_x
        self._parents = [int(p) for p in model.parents]
        self._extra = dict(extra_inertia or {})
        self._R: ByJoint = {}
        self._placed: dict[tuple[int, int], tuple[ca.SX, ca.SX]] = {}
        self._p: ByJoint = {}
        self._rest: ByJoint = {}
        self._inertia: ByJoint = {}
        self.limbs = limbs
        self._joints = [(slot, slot.index, self._parents[slot.index]) for slot in self.chart.slots]
        self._spin = {i: joint_spin(slot.kind, q[slot.q]) for slot, i, _ in self._joints}
        self._S = {i: constant(slot.kind.subspace) for slot, i, _ in self._joints}
        for slot, i, _ in self._joints:
            R, p = joint_transform(slot.kind, q[slot.q])
            self._rest[i] = self._constant(i, "rotation", lambda j: model.jointPlacements[j].rotation)
            place_p = self._constant(i, "translation", lambda j: model.jointPlacements[j].translation)
            self._R[i], self._p[i] = self._rest[i] @ R, ca.densify(place_p) + self._rest[i] @ p
            self._inertia[i] = self._constant(
                i, "inertia", lambda j: model.inertias[j].matrix() + self._extra.get(j, 0.0)
            )
        armature, locked = finite_armature(model)
        self.armature = self.by_joint("armature", armature)
        self.locked = tuple(int(k) for k in np.flatnonzero(locked))

    def visit(self, joint: int, *values: ca.SX) -> None:
        """Append values that a sweep computes at a joint to ``visits``, if it was given."""
        if self.visits is not None:
            self.visits.append((joint, ca.veccat(*map(ca.densify, values))))

    def _constant(self, joint: int, tag: str, of: Callable[[int], ArrayLike]) -> ca.SX:
        """Return a constant of a joint, with parameters for the numbers that differ between repeated limbs."""
        return constant(of(joint)) if self.limbs is None else self.limbs.constant(joint, tag, of)

    def by_joint(self, tag: str, values: NDArray[np.float64]) -> ca.SX:
        """Return ``values``, one per degree of freedom, as an expression; ``tag`` names the kind of constant."""
        slots = self.chart.slots
        parts = [self._constant(s.index, tag, lambda j: values[slots[j - 1].v]) for s in slots]
        return ca.densify(ca.vertcat(*parts))

    @cached_property
    def rotations(self) -> ByJoint:
        """World rotation of every link."""
        rotations: ByJoint = {0: ca.SX.eye(3)}
        for i in self._R:
            rotations[i] = rotations[self._parents[i]] @ self._R[i]
        return rotations

    @cached_property
    def origins(self) -> ByJoint:
        """World position of the origin of every link."""
        origins: ByJoint = {0: ca.SX.zeros(3)}
        for i in self._R:
            parent = self._parents[i]
            origins[i] = origins[parent] + self.rotations[parent] @ self._p[i]
        return origins

    @cached_property
    def quaternions(self) -> ByJoint:
        """World orientation of every link as a quaternion x y z w."""
        if self._x is None:
            raise ValueError("quaternions need chart_x")
        quaternions: ByJoint = {0: ca.SX([0, 0, 0, 1])}
        for slot, i, parent in self._joints:
            rest = constant_quaternion(self.model.jointPlacements[i].rotation)
            turned = quaternion_product(rest, joint_quaternion(slot.kind, self._x[slot.x]))
            quaternions[i] = quaternion_product(quaternions[parent], turned)
        return quaternions

    def relative(self, base: int, joint: int) -> tuple[ca.SX, ca.SX]:
        """Return rotation (3, 3) and origin (3,) of the link ``joint`` in the coordinates of the link ``base``.

        The expressions depend only on the joints between the two links.
        """
        meeting = max({*self.model.supports[base]} & {*self.model.supports[joint]})
        (R_base, p_base), (R, p) = (self._below(meeting, i) for i in (base, joint))
        return R_base.T @ R, R_base.T @ (p - p_base)

    def _below(self, base: int, joint: int) -> tuple[ca.SX, ca.SX]:
        """Return the placement of the link ``joint`` in the coordinates of its ancestor ``base``."""
        if joint == base:
            return ca.SX.eye(3), ca.SX.zeros(3)
        if (base, joint) not in self._placed:
            R, p = self._below(base, self._parents[joint])
            self._placed[base, joint] = R @ self._R[joint], p + R @ self._p[joint]
        return self._placed[base, joint]

    def position(self, point: PointOnLink) -> ca.SX:
        """Return the world position of a point, shape (3,)."""
        return self.origins[point.joint] + self.rotations[point.joint] @ ca.SX(point.position)

    def rotation(self, point: PointOnLink) -> ca.SX:
        """Return the axes of the frame of a point as columns in world axes, shape (3, 3)."""
        return self.rotations[point.joint] @ constant(point.rotation)

    def quaternion(self, point: PointOnLink) -> ca.SX:
        """Return the world orientation of the frame of a point, x y z w; its sign is not unique."""
        return quaternion_product(self.quaternions[point.joint], constant_quaternion(point.rotation))

    def center_of_mass(self) -> ca.SX:
        """Return the world position of the center of mass, shape (3,)."""
        masses = {i: float(self.model.inertias[i].mass) for i in self._R} | {0: 0.0}
        moments = {i: masses[i] * constant(np.array(self.model.inertias[i].lever)) for i in self._R}
        moments[0] = ca.SX(3, 1)
        for _, i, parent in reversed(self._joints):
            masses[parent] += masses[i]
            moments[parent] = moments[parent] + masses[i] * self._p[i] + self._R[i] @ moments[i]
        return ca.densify(moments[0] / masses[0])

    def to_link(self, joint: int, direction: ca.SX) -> ca.SX:
        """Rotate a world direction into link coordinates."""
        for i in list(self.model.supports[joint])[1:]:
            direction = transposed_times(self._R[i], direction)
            self.visit(i, direction)
        return direction


def constant_quaternion(rotation: NDArray[np.float64]) -> ca.SX:
    """Return the quaternion x y z w of a constant rotation."""
    return constant(pin.Quaternion(np.asarray(rotation)).coeffs())
