"""Dynamics of the kinematic tree at one symbolic configuration: sweeps and an O(n) articulated-body factorization.

Everything is in link coordinates, and the base's own pose enters only where a world direction is rotated into it:
``M`` does not depend on it.  Notation and signs follow Featherstone, *Rigid Body Dynamics Algorithms* (2008), in
Pinocchio's order (linear part first).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import casadi as ca

from impact_posture.dynamics.kinematics import ByJoint, Kinematics, PointOnLink
from impact_posture.dynamics.spatial import (
    constant,
    cross,
    force_to_parent,
    inertia_to_parent,
    ldl_solve,
    motion_cross_force,
    motion_to_child,
    symmetric,
)

__all__ = ["ByJoint", "Coupling", "PointOnLink", "Product", "Tree", "Wrench"]


@dataclass(frozen=True)
class Wrench:
    """A force and a moment, constant in the world (or in the frame), applied at a point of a link.

    Attributes:
        point: Where it acts.
        force: Shape (3,), in world axes; in the frame's axes if ``in_frame``.
        moment: About the point, same axes.
        in_frame: Whether it turns with the link.
    """

    point: PointOnLink
    force: ca.SX
    moment: ca.SX
    in_frame: bool = False


@dataclass(frozen=True)
class Coupling:
    """``scale · wᵀ J v`` of a wrench and a set of link velocities."""

    wrench: Wrench
    velocities: ByJoint
    scale: float | ca.SX = 1.0


@dataclass(frozen=True)
class Product:
    """``scale · leftᵀ M right`` of two sets of link velocities; ``extra``: with the extra inertias."""

    left: ByJoint
    right: ByJoint
    scale: float | ca.SX = 1.0
    extra: bool = True


class Tree(Kinematics):
    """A ``pin.Model`` at the configuration ``q`` (``SX``), with optional extra inertias on its links.

    Arguments as :class:`~impact_posture.dynamics.kinematics.Kinematics`.
    """

    # ---- sweeps -----------------------------------------------------------------------------------------------

    def velocities(self, v: ca.SX) -> ByJoint:
        """Spatial velocity of every link, in link coordinates, for the generalized velocity ``v``."""
        found: ByJoint = {}
        for slot in self.chart.slots:
            i, parent = slot.index, self._parents[slot.index]
            own = self._S[i] @ v[slot.v]
            moved = motion_to_child(self._R[i], self._p[i], found[parent]) if parent else ca.SX(6, 1)
            found[i] = moved + own
        return found

    def momenta(self, velocities: ByJoint) -> ByJoint:
        """Momentum of each link's whole subtree, in link coordinates, for the given link velocities."""
        return self._accumulate({i: self._inertia[i] @ velocities[i] for i in velocities})

    def _accumulate(self, forces: ByJoint) -> ByJoint:
        total = dict(forces)
        for i in sorted(total, reverse=True):
            parent = self._parents[i]
            if parent:
                total[parent] = total[parent] + force_to_parent(self._R[i], self._p[i], total[i])
        return total

    def mass_times(self, v: ca.SX) -> ca.SX:
        """``M(q) v`` in O(n), armature included."""
        return self._project(self.momenta(self.velocities(v))) + ca.SX(self._armature) * v

    def _project(self, forces: ByJoint) -> ca.SX:
        rows = [self._S[slot.index].T @ forces[slot.index] for slot in self.chart.slots]
        return ca.densify(ca.vertcat(*rows))

    def mass_matrix(self) -> ca.SX:
        """``M(q)`` by composite rigid bodies (Featherstone 2008, §6.2), shape (nv, nv), armature included."""
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
                composite[parent] = composite[parent] + inertia_to_parent(self._R[i], self._p[i], composite[i])
        return M + ca.diag(ca.SX(self._armature))

    def link_force(self, wrench: Wrench) -> ca.SX:
        """The wrench as a spatial force on its link, in link coordinates about the link's origin, shape (6,)."""
        joint, position = wrench.point.joint, ca.SX(wrench.point.position)
        if wrench.in_frame:
            axes = constant(wrench.point.rotation)
            force, moment = axes @ wrench.force, axes @ wrench.moment
        else:
            force, moment = self.to_link(joint, wrench.force), self.to_link(joint, wrench.moment)
        return ca.vertcat(force, moment + cross(position, force))

    def generalized_force(self, wrenches: Sequence[Wrench]) -> ca.SX:
        """``Σ Jᵀ [force; moment]`` of the wrenches, shape (nv,)."""
        forces: ByJoint = {i: ca.SX(6, 1) for i in self._R}
        for wrench in wrenches:
            forces[wrench.point.joint] = forces[wrench.point.joint] + self.link_force(wrench)
        return self._project(self._accumulate(forces))

    def point_velocity(self, point: PointOnLink, velocities: ByJoint) -> ca.SX:
        """World linear and angular velocity of a point, shape (6,): ``J v`` in LOCAL_WORLD_ALIGNED."""
        motion = velocities[point.joint]
        linear = motion[:3] + cross(motion[3:], ca.SX(point.position))
        R = self.rotations[point.joint]
        return ca.vertcat(R @ linear, R @ motion[3:])

    # ---- articulated body -------------------------------------------------------------------------------------

    @cached_property
    def _factor(self) -> tuple[ByJoint, ByJoint]:
        """Articulated inertia times ``S`` of every joint, and ``(SᵀI^A S + armature)``."""
        articulated = dict(self._inertia)
        U: ByJoint = {}
        D: ByJoint = {}
        for slot in reversed(self.chart.slots):
            i, parent = slot.index, self._parents[slot.index]
            U[i] = ca.densify(articulated[i] @ self._S[i])
            D[i] = symmetric(self._S[i].T @ U[i] + ca.diag(ca.SX(self._armature[slot.v])))
            if parent:
                gain = ldl_solve(D[i], U[i].T) if slot.kind.nv > 1 else U[i].T * (1 / D[i])
                reduced = symmetric(articulated[i] - U[i] @ gain)
                articulated[parent] = articulated[parent] + inertia_to_parent(self._R[i], self._p[i], reduced)
        return U, D

    def solve(self, tau: ca.SX | None = None, wrenches: Sequence[Wrench] = ()) -> tuple[ca.SX, ByJoint]:
        """``a = M⁻¹(τ + Σ Jᵀ w)`` by the articulated-body factorization, in O(n) and without forming ``M``.

        Returns:
            ``a``, shape (nv,), and the spatial velocity of every link under it.
        """
        U, D = self._factor
        bias: ByJoint = {i: ca.SX(6, 1) for i in self._R}
        for wrench in wrenches:
            bias[wrench.point.joint] = bias[wrench.point.joint] - self.link_force(wrench)
        torque: ByJoint = {}
        for slot in reversed(self.chart.slots):
            i, parent = slot.index, self._parents[slot.index]
            own = tau[slot.v] if tau is not None else ca.SX(slot.kind.nv, 1)
            torque[i] = ca.densify(ldl_solve(D[i], own - self._S[i].T @ bias[i]))
            if parent:
                bias[parent] = bias[parent] + force_to_parent(self._R[i], self._p[i], bias[i] + U[i] @ torque[i])
        motions: ByJoint = {}
        parts = []
        for slot in self.chart.slots:
            i, parent = slot.index, self._parents[slot.index]
            rate = torque[i]
            if parent:
                moved = motion_to_child(self._R[i], self._p[i], motions[parent])
                rate = rate - ldl_solve(D[i], U[i].T @ moved)
                motions[i] = moved + self._S[i] @ rate
            else:
                motions[i] = ca.densify(self._S[i] @ rate)
            parts.append(rate)
        return ca.densify(ca.vertcat(*parts)), motions

    # ---- tangent gradients by adjoints ------------------------------------------------------------------------

    def bracket_gradient(self, couplings: Sequence[Coupling] = (), products: Sequence[Product] = ()) -> ca.SX:
        """Tangent gradient of ``Σ scale wᵀJ(q)v + Σ scale bᵀM(q)a`` with ``w, v, a, b`` held fixed, shape (nv,).

        Moving joint j by ``S_j δ`` turns every velocity beyond it by ``−S_j δ ×``.  With ``F_j`` the force that the
        subtree of j puts against a velocity set ``v``, that is ``−S_jᵀ (v_j⁻ ×* F_j)``, where ``v_j⁻`` is the
        velocity before joint j's own.  A wrench constant in the world turns back relative to the link; its part is
        ``−ω_jᵀ (f × u + m × ω)`` on every joint below it.
        """
        sets: list[ByJoint] = []
        forces: list[ByJoint] = []

        def against(velocities: ByJoint) -> ByJoint:
            for known, force in zip(sets, forces, strict=True):
                if known is velocities:
                    return force
            sets.append(velocities)
            forces.append({i: ca.SX(6, 1) for i in self._R})
            return forces[-1]

        turning: ByJoint = {i: ca.SX(3, 1) for i in self._R}
        for coupling in couplings:
            point, joint = coupling.wrench.point, coupling.wrench.point.joint
            force = coupling.scale * self.link_force(coupling.wrench)
            acting = against(coupling.velocities)
            acting[joint] = acting[joint] + force
            if not coupling.wrench.in_frame:
                motion = coupling.velocities[joint]
                position = ca.SX(point.position)
                linear = motion[:3] + cross(motion[3:], position)
                moment = force[3:] - cross(position, force[:3])
                turning[joint] = turning[joint] + cross(force[:3], linear) + cross(moment, motion[3:])
        for product in products:
            inertia = self._inertia if product.extra else self._own_inertia
            for one, other in ((product.left, product.right), (product.right, product.left)):
                acting = against(one)
                for i in acting:
                    acting[i] = acting[i] + product.scale * (inertia[i] @ other[i])
        return self._gather(sets, [self._accumulate(force) for force in forces], turning)

    def _gather(self, sets: list[ByJoint], forces: list[ByJoint], turning: ByJoint) -> ca.SX:
        turning = dict(turning)
        rows: dict[int, ca.SX] = {}
        for slot in reversed(self.chart.slots):
            i, parent = slot.index, self._parents[slot.index]
            row = -(self._S[i][3:, :].T @ turning[i])
            if parent:
                turning[parent] = turning[parent] + self._R[i] @ turning[i]
                for velocities, force in zip(sets, forces, strict=True):
                    before = velocities[i]
                    if slot.kind.nv > 1:
                        before = motion_to_child(self._R[i], self._p[i], velocities[parent])
                    row = row - self._S[i].T @ motion_cross_force(before, force[i])
            rows[i] = row
        return ca.densify(ca.vertcat(*[rows[slot.index] for slot in self.chart.slots]))

    def turning_gradient(self, point: PointOnLink, direction: ca.SX, covector: ca.SX) -> ca.SX:
        """Tangent gradient of ``cᵀ d(q)`` where the world direction ``d`` turns with the point's link: (nv,)."""
        turning: ByJoint = {i: ca.SX(3, 1) for i in self._R}
        turning[point.joint] = -self.to_link(point.joint, cross(direction, covector))
        return self._gather([], [], turning)

    @cached_property
    def _own_inertia(self) -> ByJoint:
        return {i: constant(self.model.inertias[i].matrix()) for i in self._R}

    def own_mass_times(self, v: ca.SX, velocities: ByJoint) -> ca.SX:
        """``M v`` of the robot alone, without the extra inertias."""
        momenta = self._accumulate({i: self._own_inertia[i] @ velocities[i] for i in velocities})
        return self._project(momenta) + ca.SX(self._armature) * v
