"""Dynamics of the kinematic tree at one symbolic configuration: sweeps and an O(n) articulated-body factorization.

Everything is in link coordinates.  ``M`` does not depend on the pose of the base, which only rotates world directions
into links.  Notation and signs follow Featherstone, *Rigid Body Dynamics Algorithms* (2008), with the linear part
first as in Pinocchio.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import casadi as ca

from impact_posture.dynamics.chart import JointSlot
from impact_posture.dynamics.kinematics import ByJoint, Kinematics, PointOnLink
from impact_posture.dynamics.spatial import (
    constant,
    cross,
    force_to_parent,
    ldl_solve,
    motion_cross_force,
    motion_to_child,
    rotate_inertia,
    shift_inertia,
    symmetric,
)

__all__ = ["ByJoint", "PointOnLink", "Response", "Tree", "Wrench"]


@dataclass(frozen=True)
class Wrench:
    """A force and a moment at a point of a link, constant in the world or in the frame.

    Attributes:
        point: The point.
        force: The force, shape (3,), in world axes; in the axes of the frame if ``in_frame``.
        moment: The moment about the point, shape (3,), in the same axes.
        in_frame: Whether the wrench turns with the link.
    """

    point: PointOnLink
    force: ca.SX
    moment: ca.SX
    in_frame: bool = False


@dataclass(frozen=True, eq=False)
class Response:
    """The response of the robot to a generalized force and wrenches.

    Attributes:
        a: ``M⁻¹(τ + Σ Jᵀ w)``, shape (nv,).
        velocities: Spatial velocity of every link under ``a``, in link coordinates.
        before: The same without the motion of the link's own joint, for joints with a parent joint.
        forces: Spatial force through every joint with a parent joint, on its link.
        passed: The part of that force that does not depend on the motion of the parent.
        wrenches: The wrenches.
    """

    a: ca.SX
    velocities: ByJoint
    before: ByJoint
    forces: ByJoint
    passed: ByJoint
    wrenches: tuple[Wrench, ...]


@dataclass(frozen=True, eq=False)
class _Factor:
    """Per joint: ``U = I^A S``, ``D = SᵀU + armature``, ``D⁻¹Uᵀ`` and ``I^a = I^A − U D⁻¹ Uᵀ``.

    A locked joint has ``D⁻¹ = 0``.
    """

    U: ByJoint
    D: ByJoint
    gain: ByJoint
    reduced: ByJoint


class Tree(Kinematics):
    """A ``pin.Model`` at the configuration ``q`` (``SX``), with optional extra inertias on its links.

    Arguments as :class:`~impact_posture.dynamics.kinematics.Kinematics`.
    """

    # ---- sweeps -----------------------------------------------------------------------------------------------

    def velocities(self, v: ca.SX) -> ByJoint:
        """Return the spatial velocity of every link, in link coordinates, for the generalized velocity ``v``."""
        found: ByJoint = {}
        for slot in self.chart.slots:
            i, parent = slot.index, self._parents[slot.index]
            own = self._S[i] @ v[slot.v]
            moved = motion_to_child(self._R[i], self._p[i], found[parent]) if parent else ca.SX(6, 1)
            found[i] = moved + own
        return found

    def _accumulate(self, forces: ByJoint) -> ByJoint:
        total = dict(forces)
        for i in sorted(total, reverse=True):
            parent = self._parents[i]
            if parent:
                total[parent] = total[parent] + force_to_parent(self._R[i], self._p[i], total[i])
        return total

    def mass_times(self, v: ca.SX, velocities: ByJoint | None = None, *, extra: bool = True) -> ca.SX:
        """Return ``M(q) v`` in O(n), armature included, shape (nv,).

        Args:
            v: Generalized velocity, shape (nv,).
            velocities: Spatial velocity of every link under ``v``, if it is known already.
            extra: Include the extra inertias.
        """
        velocities = self.velocities(v) if velocities is None else velocities
        inertia = self._inertia if extra else self._own_inertia
        momenta = self._accumulate({i: inertia[i] @ velocity for i, velocity in velocities.items()})
        return self._project(momenta) + self._armature * v

    def _project(self, forces: ByJoint) -> ca.SX:
        rows = [self._S[slot.index].T @ forces[slot.index] for slot in self.chart.slots]
        return ca.densify(ca.vertcat(*rows))

    def mass_matrix(self) -> ca.SX:
        """Return ``M(q)`` by composite rigid bodies (Featherstone 2008, §6.2), shape (nv, nv), armature included."""
        composite = dict(self._inertia)
        M = ca.SX.zeros(self.nv, self.nv)
        for slot in reversed(self.chart.slots):
            i, parent = slot.index, self._parents[slot.index]
            force = composite[i] @ self._S[i]
            M[slot.v, slot.v] = self._S[i].T @ force
            j, carried = i, force
            while self._parents[j]:
                carried = ca.horzcat(
                    *[force_to_parent(self._R[j], self._p[j], carried[:, c]) for c in range(carried.shape[1])]
                )
                j = self._parents[j]
                other = self.chart.slots[j - 1]
                M[other.v, slot.v] = self._S[j].T @ carried
                M[slot.v, other.v] = M[other.v, slot.v].T
            if parent:
                composite[parent] = composite[parent] + self._inertia_to_parent(i, composite[i])
        return M + ca.diag(self._armature)

    def link_force(self, wrench: Wrench) -> ca.SX:
        """Return a wrench as a spatial force in link coordinates about the origin of its link, shape (6,)."""
        joint, position = wrench.point.joint, ca.SX(wrench.point.position)
        if wrench.in_frame:
            axes = constant(wrench.point.rotation)
            force, moment = axes @ wrench.force, axes @ wrench.moment
        else:
            force, moment = self.to_link(joint, wrench.force), self.to_link(joint, wrench.moment)
        return ca.vertcat(force, moment + cross(position, force))

    def generalized_force(self, wrenches: Sequence[Wrench]) -> ca.SX:
        """Return ``Σ Jᵀ [force; moment]`` of the wrenches, shape (nv,)."""
        forces: ByJoint = {i: ca.SX(6, 1) for i in self._R}
        for wrench in wrenches:
            forces[wrench.point.joint] = forces[wrench.point.joint] + self.link_force(wrench)
        return self._project(self._accumulate(forces))

    def point_velocity(self, point: PointOnLink, velocities: ByJoint) -> ca.SX:
        """Return the world linear and angular velocity of a point, ``J v`` in LOCAL_WORLD_ALIGNED, shape (6,)."""
        motion = velocities[point.joint]
        linear = motion[:3] + cross(motion[3:], ca.SX(point.position))
        R = self.rotations[point.joint]
        return ca.vertcat(R @ linear, R @ motion[3:])

    # ---- articulated body -------------------------------------------------------------------------------------

    def _inertia_to_parent(self, i: int, inertia: ca.SX) -> ca.SX:
        """Return the symmetric 6×6 (articulated) inertia of link i in the coordinates of its parent."""
        spin = self._spin[i]
        turned = rotate_inertia(inertia, self._R[i] if spin is None else self._rest[i], spin)
        return shift_inertia(turned, self._p[i])

    @cached_property
    def _factor(self) -> _Factor:
        articulated = dict(self._inertia)
        U: ByJoint = {}
        D: ByJoint = {}
        gain: ByJoint = {}
        reduced: ByJoint = {}
        for slot in reversed(self.chart.slots):
            i, parent = slot.index, self._parents[slot.index]
            U[i] = ca.densify(articulated[i] @ self._S[i])
            D[i] = symmetric(self._S[i].T @ U[i] + ca.diag(ca.SX(self._armature[slot.v])))
            if slot.v.start in self.locked:
                gain[i], reduced[i] = ca.SX(slot.kind.nv, 6), articulated[i]
                if parent:
                    articulated[parent] = articulated[parent] + self._inertia_to_parent(i, reduced[i])
            elif parent:
                gain[i] = U[i].T * (1 / D[i]) if slot.kind.nv == 1 else ldl_solve(D[i], U[i].T)
                reduced[i] = symmetric(articulated[i] - U[i] @ gain[i])
                articulated[parent] = articulated[parent] + self._inertia_to_parent(i, reduced[i])
        return _Factor(U, D, gain, reduced)

    def respond(self, tau: ca.SX | None = None, wrenches: Sequence[Wrench] = ()) -> Response:
        """Solve ``M a = τ + Σ Jᵀ w`` by the articulated-body factorization, in O(n) and without forming ``M``.

        The force through joint i is ``f_i = I^a_i v_i⁻ + p^a_i``.  The factorization knows the momentum of the whole
        subtree, so no sweep has to gather it.
        """
        factor = self._factor
        bias: ByJoint = {i: ca.SX(6, 1) for i in self._R}
        for wrench in wrenches:
            bias[wrench.point.joint] = bias[wrench.point.joint] - self.link_force(wrench)
        drive: ByJoint = {}
        passed: ByJoint = {}
        for slot in reversed(self.chart.slots):
            i, parent = slot.index, self._parents[slot.index]
            own = tau[slot.v] if tau is not None else ca.SX(slot.kind.nv, 1)
            drive[i] = own - self._S[i].T @ bias[i]
            if parent:
                passed[i] = bias[i] + factor.gain[i].T @ drive[i]
                bias[parent] = bias[parent] + force_to_parent(self._R[i], self._p[i], passed[i])
        velocities: ByJoint = {}
        before: ByJoint = {}
        forces: ByJoint = {}
        parts = []
        for slot in self.chart.slots:
            i, parent = slot.index, self._parents[slot.index]
            rate = self._solve_joint(slot, factor.D[i], drive[i])
            if parent:
                before[i] = motion_to_child(self._R[i], self._p[i], velocities[parent])
                rate = rate - factor.gain[i] @ before[i]
                velocities[i] = before[i] + self._S[i] @ rate
                forces[i] = factor.reduced[i] @ before[i] + passed[i]
            else:
                velocities[i] = ca.densify(self._S[i] @ rate)
            parts.append(rate)
        return Response(ca.densify(ca.vertcat(*parts)), velocities, before, forces, passed, tuple(wrenches))

    def _solve_joint(self, slot: JointSlot, D: ca.SX, drive: ca.SX) -> ca.SX:
        """Return ``D⁻¹u`` of a joint, zero if it is locked."""
        if slot.v.start in self.locked:
            return ca.SX(slot.kind.nv, 1)
        return drive * (1 / D) if slot.kind.nv == 1 else ldl_solve(D, drive)

    def pair_gradient(self, x: Response, y: Response) -> ca.SX:
        """Return the tangent gradient of ``w_xᵀJ y + w_yᵀJ x − yᵀM x`` with all four letters held fixed, shape (nv,).

        It is ``Sᵀ(v_y⁻ ×* f_x + v_x⁻ ×* f_y)`` and the turning of wrenches that stay in the world.  The two responses
        know all of this.  With ``f = I^a v⁻ + p^a`` and a joint that turns about a coordinate axis, the part of
        ``I^a`` is the one product ``v_y⁻ᵀ K v_x⁻`` in place of two, where ``K`` is the rate of ``I^a`` as it turns.
        """
        turning: ByJoint = {}
        for one, other in ((x, y), (y, x)):
            for wrench in one.wrenches:
                self._turn(turning, wrench, other.velocities)
        rows: ByJoint = {}
        forces = [dict(x.forces), dict(y.forces)]
        for i in x.forces:
            spin = self._spin[i]
            if spin is not None:
                rate = spin.rate(self._factor.reduced[i])
                rows[i] = ca.dot(y.before[i], rate @ x.before[i])
                forces[0][i], forces[1][i] = x.passed[i], y.passed[i]
        return self._gather([(y.before, forces[0]), (x.before, forces[1])], turning, rows)

    # ---- tangent gradients by adjoints ------------------------------------------------------------------------

    def energy_gradient(self, velocities: ByJoint) -> ca.SX:
        """Return the tangent gradient of ``vᵀM(q)v`` with ``v`` held fixed, without extra inertias, shape (nv,).

        Moving joint j by ``S_j δ`` turns every velocity beyond it by ``−S_j δ ×``.  With ``F_j`` the momentum of the
        subtree of j, that changes the value by ``−2 S_jᵀ (v_j⁻ ×* F_j)``, where ``v_j⁻`` is the velocity of the link
        without the motion of joint j.
        """
        forces = {i: -2 * (self._own_inertia[i] @ velocity) for i, velocity in velocities.items()}
        return self._gather([(self._before(velocities), self._accumulate(forces))], {})

    def _before(self, velocities: ByJoint) -> ByJoint:
        """Return the velocity of every link without the motion of its own joint.

        A joint with one axis keeps that motion, because ``Sᵀ(S ×* F)`` is zero.
        """
        return {
            slot.index: velocities[slot.index]
            if slot.kind.nv == 1
            else motion_to_child(self._R[slot.index], self._p[slot.index], velocities[self._parents[slot.index]])
            for slot in self.chart.slots
            if self._parents[slot.index]
        }

    def _turn(self, turning: ByJoint, wrench: Wrench, velocities: ByJoint) -> None:
        """Add ``f × u + m × ω`` of a wrench that stays in the world while its link moves with ``(u, ω)``.

        The wrench turns back relative to the link, which adds ``−ω_jᵀ (f × u + m × ω)`` on every joint below.
        """
        joint = wrench.point.joint
        if wrench.in_frame:
            return
        force, motion, position = self.link_force(wrench), velocities[joint], ca.SX(wrench.point.position)
        linear = motion[:3] + cross(motion[3:], position)
        moment = force[3:] - cross(position, force[:3])
        turning[joint] = turning.get(joint, ca.SX(3, 1)) + cross(force[:3], linear) + cross(moment, motion[3:])

    def _gather(
        self, pairs: Sequence[tuple[ByJoint, ByJoint]], turning: ByJoint, known: ByJoint | None = None
    ) -> ca.SX:
        """Return ``Σ S_jᵀ(v_j⁻ ×* F_j) − ω_jᵀ turning`` for pairs ``(v⁻, F)``, plus the ``known`` rows of joints."""
        turning = {i: turning.get(i, ca.SX(3, 1)) for i in self._R}
        rows: ByJoint = {}
        for slot in reversed(self.chart.slots):
            i, parent = slot.index, self._parents[slot.index]
            row = -(self._S[i][3:, :].T @ turning[i])
            if parent:
                turning[parent] = turning[parent] + self._R[i] @ turning[i]
                row = row + (known or {}).get(i, ca.SX(1, 1))
                for before, force in pairs:
                    row = row + self._S[i].T @ motion_cross_force(before[i], force[i])
            rows[i] = row
        return ca.densify(ca.vertcat(*[rows[slot.index] for slot in self.chart.slots]))

    def turning_gradient(self, point: PointOnLink, direction: ca.SX, covector: ca.SX) -> ca.SX:
        """Return the tangent gradient of ``cᵀ d(q)``, shape (nv,), of a world direction that turns with the link."""
        turning = {point.joint: -self.to_link(point.joint, cross(direction, covector))}
        return self._gather([], turning)

    @cached_property
    def _own_inertia(self) -> ByJoint:
        return {i: self._constant(i, "own inertia", lambda j: self.model.inertias[j].matrix()) for i in self._R}
