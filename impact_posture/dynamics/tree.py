"""Dynamics of a robot at a symbolic configuration, by the articulated-body algorithm in O(n).

All quantities are in link coordinates.  ``M`` does not depend on the pose of the base.  The pose is needed only to
rotate world directions to link coordinates.  Notation and signs follow Featherstone, *Rigid Body Dynamics Algorithms*
(2008), but the linear part is first, as in Pinocchio.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

import casadi as ca
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impact_posture.dynamics import tree_steps as step
from impact_posture.dynamics.chart import JointSlot
from impact_posture.dynamics.kinematics import ByJoint, Kinematics, PointOnLink, Visits
from impact_posture.dynamics.repeated_limbs import RepeatedLimbs
from impact_posture.dynamics.spatial import (
    constant,
    cross,
    force_to_parent,
    inertia_to_parent,
    motion_to_child,
    motion_to_parent,
    spin_power,
    symmetric,
    transposed_times,
)

__all__ = ["ByJoint", "PointOnLink", "Response", "Tree", "Wrench"]

_ZERO = ca.SX(6, 1)
# Coupling of two joints: entry of the follower in ν, entry of its leader, and ratio of their velocities.
Coupled = tuple[int, int, float]


@dataclass(frozen=True)
class Wrench:
    """A force and a moment at a point of a link.

    Attributes:
        point: The point, with the axes of its frame.
        force: The force, shape (3,), in the axes of the frame if ``in_frame`` is true, otherwise in world axes.
        moment: The moment about the point, shape (3,), in the same axes as the force.
        in_frame: Whether the wrench is constant in the frame and turns with the link, or is constant in the world.
    """

    point: PointOnLink
    force: ca.SX
    moment: ca.SX
    in_frame: bool = False


@dataclass(frozen=True, eq=False)
class _Cluster:
    """Joints at one parent link that move with the velocities ``shares · rates``: one joint, or leader and followers.

    The sweeps handle a cluster as one joint, with stacked quantities of its links (constraint embedding, Jain 2012).
    ``entries`` are the entries of the joints in ν, and ``S`` is their stacked motion subspace per rate.
    """

    parent: int
    joints: list[int]
    entries: list[int]
    shares: ca.SX
    S: ca.SX


@dataclass(frozen=True, eq=False)
class Response:
    """The response of the robot to a generalized force and wrenches, with spatial quantities in link coordinates.

    Attributes:
        a: Generalized response ``M⁻¹(τ + Σ Jᵀ w)``, shape (nv,).
        velocities: Velocity of every link for the generalized velocity ``a``.
        before: Velocity ``v⁻`` of every link without the motion of the joint that moves the link.
        forces: Force that every joint transmits to its link.
        passed: The part of ``forces`` that does not depend on the motion of the parent link.
        wrenches: The wrenches that act on the robot.
    """

    a: ca.SX
    velocities: ByJoint
    before: ByJoint
    forces: ByJoint
    passed: ByJoint
    wrenches: tuple[Wrench, ...]


class Tree(Kinematics):
    """Dynamics of a model; most arguments are arguments of :class:`~impact_posture.dynamics.kinematics.Kinematics`.

    ``couplings`` are (entry of the follower in ν, entry of the leader, ratio) of coupled joints with one axis.  Only
    :meth:`respond` considers the couplings.  With ``visits``, :meth:`pair_gradient` keeps few values at a time.
    """

    def __init__(
        self,
        model: pin.Model,
        q: ca.SX,
        chart_x: ca.SX | None = None,
        extra_inertia: Mapping[int, NDArray[np.float64]] | None = None,
        limbs: RepeatedLimbs | None = None,
        couplings: Sequence[Coupled] = (),
        visits: Visits | None = None,
    ) -> None:
        super().__init__(model, q, chart_x, extra_inertia, limbs, visits)
        parent_of = {slot.v.start: parent for slot, _, parent in self._joints}
        beside = {f: (leader, ratio) for f, leader, ratio in couplings if parent_of[f] == parent_of[leader]}
        members: dict[int, list[tuple[JointSlot, float]]] = {}
        for slot in self.chart.slots:
            leader, ratio = beside.get(slot.v.start, (slot.v.start, 1.0))
            members.setdefault(leader, []).append((slot, ratio))
        self._clusters = [
            _Cluster(
                parent_of[leader],
                [slot.index for slot, _ in each],
                [k for slot, _ in each for k in range(slot.v.start, slot.v.stop)],
                constant(np.vstack([ratio * np.eye(slot.kind.nv) for slot, ratio in each])),
                constant(np.vstack([ratio * slot.kind.subspace for slot, ratio in each])),
            )
            for leader, each in members.items()
        ]
        apart = [c for c in couplings if c[0] not in beside]
        self._K = ca.SX(len(apart), self.nv)
        for k, (follower, leader, ratio) in enumerate(apart):
            self._K[k, follower], self._K[k, leader] = 1.0, -ratio

    def velocities(self, v: ca.SX) -> ByJoint:
        """Return the spatial velocity of every link, in link coordinates, for the generalized velocity ``v``."""
        velocities: ByJoint = {}
        for slot, i, parent in self._joints:
            moved = motion_to_child(self._R[i], self._p[i], velocities.get(parent, _ZERO))
            velocities[i] = moved + self._S[i] @ v[slot.v]
        return velocities

    def _accumulate(self, forces: ByJoint) -> ByJoint:
        total = dict(forces)
        for i in sorted(total, reverse=True):
            parent = self._parents[i]
            if parent:
                moved = force_to_parent(self._R[i], self._p[i], total[i])
                self.visit(i, moved)
                total[parent] = total[parent] + moved
        return total

    def mass_times(
        self, v: ca.SX, velocities: ByJoint | None = None, *, extra: bool = True, wrenches: Sequence[Wrench] = ()
    ) -> ca.SX:
        """Return ``M(q) v − Σ Jᵀ w`` in O(n), shape (nv,), where ``w`` are the ``wrenches``.

        ``M`` includes the armature and, if ``extra`` is true, the extra inertias.  ``velocities`` may be the result
        of :meth:`velocities` for ``v``, which saves time.
        """
        velocities = self.velocities(v) if velocities is None else velocities
        inertia = self._inertia if extra else self._own_inertia
        momenta = {i: inertia[i] @ velocity for i, velocity in velocities.items()}
        for wrench in wrenches:
            momenta[wrench.point.joint] = momenta[wrench.point.joint] - self.link_force(wrench)
        return self._project(self._accumulate(momenta)) + self.armature * v

    def _project(self, forces: ByJoint) -> ca.SX:
        return ca.densify(ca.vertcat(*[transposed_times(S, forces[i]) for i, S in self._S.items()]))

    def link_force(self, wrench: Wrench) -> ca.SX:
        """Return a wrench as a spatial force in link coordinates about the origin of its link, shape (6,)."""
        joint, position = wrench.point.joint, ca.SX(wrench.point.position)
        if wrench.in_frame:
            axes = constant(wrench.point.rotation)
            force, moment = axes @ wrench.force, axes @ wrench.moment
        else:
            force, moment = self.to_link(joint, wrench.force), self.to_link(joint, wrench.moment)
        return ca.vertcat(force, moment + cross(position, force))

    def generalized_force(self, wrenches: Sequence[Wrench], gravity: ca.SX | None = None) -> ca.SX:
        """Return the generalized force ``Σ Jᵀ [force; moment]`` of the wrenches and of gravity, shape (nv,).

        ``gravity`` is the gravitational acceleration in world axes, shape (3,); ``None`` for no gravity.
        """
        forces: ByJoint = dict.fromkeys(self._R, _ZERO)
        if gravity is not None:
            along = {0: gravity}
            for _, i, parent in self._joints:
                along[i] = transposed_times(self._R[i], along[parent])
                body = self.model.inertias[i]
                weight = body.mass * along[i]
                forces[i] = ca.vertcat(weight, cross(constant(np.array(body.lever)), weight))
        for wrench in wrenches:
            forces[wrench.point.joint] = forces[wrench.point.joint] + self.link_force(wrench)
        return self._project(self._accumulate(forces))

    def point_velocity(self, point: PointOnLink, velocities: ByJoint) -> ca.SX:
        """Return the world linear and angular velocity of a point, ``J v`` in LOCAL_WORLD_ALIGNED, shape (6,)."""
        local, R = self.own_velocity(point, velocities), self.rotation(point)
        return ca.vertcat(R @ local[:3], R @ local[3:])

    def point_velocities(self, points: Sequence[PointOnLink], velocities: ByJoint) -> ca.SX:
        """Return the world linear velocities of m points, shape (3m,)."""
        return ca.vertcat(*[self.point_velocity(point, velocities)[:3] for point in points])

    def own_velocity(self, point: PointOnLink, velocities: ByJoint) -> ca.SX:
        """Return the linear and angular velocity of a point in the axes of its frame, shape (6,)."""
        motion, axes = velocities[point.joint], constant(point.rotation).T
        return ca.vertcat(axes @ (motion[:3] + cross(motion[3:], ca.SX(point.position))), axes @ motion[3:])

    def _inertia_to_parent(self, i: int, inertia: ca.SX) -> ca.SX:
        """Return the symmetric 6×6 (articulated) inertia of link i in the coordinates of its parent."""
        spin = self._spin[i]
        if spin is None:
            return inertia_to_parent(inertia, self._R[i], self._p[i])
        return inertia_to_parent(inertia, self._rest[i], self._p[i], spin.cosine, spin.sine, axis=spin.axis)

    @cached_property
    def _factor(self) -> dict[_Cluster, tuple[ca.SX, ...]]:
        """Return cluster → ``(pivot, I^A, D⁻¹Uᵀ, I^A − U D⁻¹Uᵀ)`` with ``U = I^A S`` and ``D = SᵀU + armature``.

        ``I^A`` is the articulated inertia of the link (Featherstone 2008, chapter 7), block diagonal for several
        links.  The pivot is ``1/D`` if D is a number, ``D`` for a joint with several axes, and zero for a locked
        joint (infinite ``D``).
        """
        articulated = dict(self._inertia)
        factors: dict[_Cluster, tuple[ca.SX, ...]] = {}
        for c in reversed(self._clusters):
            inertia = ca.diagcat(*[articulated[i] for i in c.joints])
            D = step.pivot(inertia, c.S, (c.shares * c.shares).T @ self.armature[c.entries])
            # The pivot is computed outside the templates, so that a constant D gives a constant factor 1/D.
            pivot = ca.SX(0) if c.entries[0] in self.locked else 1 / D if D.is_scalar() else D
            factors[c] = pivot, inertia, *step.reduce(inertia, c.S, pivot)
            self.visit(c.joints[0], *factors[c])
            if c.parent:
                _, _, gain, reduced = factors[c]
                blocks, gains = ca.blocksplit(reduced, 6, 6), ca.vertsplit(gain.T, 6)
                for k, i in enumerate(c.joints):
                    moved = self._inertia_to_parent(i, blocks[k][k])
                    self.visit(i, moved)
                    articulated[c.parent] = articulated[c.parent] + moved
                for pair in combinations(zip(c.joints, gains, strict=True), 2):
                    x, y = (force_to_parent(self._R[i], self._p[i], part) for i, part in pair)
                    articulated[c.parent] = articulated[c.parent] - symmetric(D * x @ y.T + D * y @ x.T)
        return factors

    def respond(self, tau: ca.SX | None = None, wrenches: Sequence[Wrench] = ()) -> Response:
        """Solve ``M a = τ + Σ Jᵀ w`` by the articulated-body algorithm in O(n), without computing ``M``.

        The sweeps over the tree also give the force through joint i, ``f_i = I^A_i v_i + p^A_i``.  Couplings between
        joints at different links add a torque ``Kᵀμ`` such that ``K a = 0``.  Each row of K is 1 at a follower, and
        minus the ratio at the leader of this follower.
        """
        if not self._coupling_responses:
            return self._free_response(tau, wrenches)
        tau = ca.SX(self.nv, 1) if tau is None else tau
        # If μ = 0, row k of K a is the product of τ + Σ Jᵀ w with column k of M⁻¹Kᵀ.
        pushes = [(wrench.point.joint, self.link_force(wrench)) for wrench in wrenches]
        gaps = [
            ca.dot(tau, x.a) + sum(ca.dot(force, x.velocities[joint]) for joint, force in pushes)
            for x in self._coupling_responses
        ]
        return self._free_response(tau - self._K.T @ step.solve(self._coupling_mobility, ca.vertcat(*gaps)), wrenches)

    @cached_property
    def _coupling_responses(self) -> list[Response]:
        """Responses ``M⁻¹Kᵀ`` to unit torques between each follower and its leader."""
        return [self._free_response(row.T, ()) for row in ca.vertsplit(self._K)]

    @cached_property
    def _coupling_mobility(self) -> ca.SX:
        """``K M⁻¹Kᵀ``; for one coupling, its inverse."""
        mobility = self._K @ ca.horzcat(*[x.a for x in self._coupling_responses])
        return 1 / mobility if mobility.is_scalar() else mobility

    def _free_response(self, tau: ca.SX | None, wrenches: Sequence[Wrench]) -> Response:
        bias: ByJoint = dict.fromkeys(self._R, _ZERO)
        for wrench in wrenches:
            bias[wrench.point.joint] = bias[wrench.point.joint] - self.link_force(wrench)
        driven: dict[_Cluster, tuple[ca.SX, ca.SX]] = {}
        passed: ByJoint = {}
        for c in reversed(self._clusters):
            tau_c = c.shares.T @ tau[c.entries] if tau is not None else ca.SX(c.S.size2(), 1)
            stack = ca.vertcat(*[bias[i] for i in c.joints])
            drive, pushed = step.drive(c.S, tau_c, stack, self._factor[c][2])
            driven[c] = drive, stack
            passed |= zip(c.joints, ca.vertsplit(pushed, 6), strict=True)
            self.visit(c.joints[0], drive, pushed)
            for i in c.joints if c.parent else ():
                moved = force_to_parent(self._R[i], self._p[i], passed[i])
                self.visit(i, moved)
                bias[c.parent] = bias[c.parent] + moved
        velocities: ByJoint = {}
        before: ByJoint = {}
        forces: ByJoint = {}
        a = ca.SX.zeros(self.nv)
        for c in self._clusters:
            start = velocities.get(c.parent, _ZERO)
            before |= {i: motion_to_child(self._R[i], self._p[i], start) for i in c.joints}
            stack = ca.vertcat(*[before[i] for i in c.joints])
            rates, moved, through = step.respond(stack, c.S, *driven[c], *self._factor[c][:3])
            self.visit(c.joints[0], stack, rates, moved, through)
            a[c.entries] = c.shares @ rates
            velocities |= zip(c.joints, ca.vertsplit(moved, 6), strict=True)
            forces |= zip(c.joints, ca.vertsplit(through, 6), strict=True)
        return Response(a, velocities, before, forces, passed, tuple(wrenches))

    def pair_gradient(self, x: Response, y: Response) -> ca.SX:
        """Return the tangent gradient of ``w_xᵀJ y + w_yᵀJ x − yᵀM x`` for fixed x, y, w_x and w_y, shape (nv,).

        The gradient is ``Sᵀ(v_y⁻ ×* f_x + v_x⁻ ×* f_y)`` with ``f = I^a v⁻ + p^a``.  Wrenches that are constant in
        the world rotate relative to the links and add a term (:meth:`_turn`).  For a joint about a coordinate axis,
        the two terms with ``I^a`` equal the product ``v_y⁻ᵀ K v_x⁻``.  ``K`` is the derivative of ``I^a`` with
        respect to the joint angle.
        """
        turning: ByJoint = {}
        for pushed, moved in ((x, y), (y, x)):
            for wrench in pushed.wrenches:
                self._turn(turning, wrench, moved.velocities)
        if self.visits is not None:
            return self._lean_gradient(x, y, turning)
        rows: ByJoint = {}
        forces = [dict(x.forces), dict(y.forces)]
        for c, (*_, inertia) in self._factor.items():
            spin = self._spin[i := c.joints[0]]
            # In a cluster of several links, the force on one link also depends on the motion of the other links.
            if spin is not None and len(c.joints) == 1:
                rows[i] = spin_power(inertia, x.before[i], y.before[i], axis=spin.axis, sense=spin.sense)
                forces[0][i], forces[1][i] = x.passed[i], y.passed[i]
        return self._gather([(y.before, forces[0]), (x.before, forces[1])], turning, rows)

    def _lean_gradient(self, x: Response, y: Response, turning: ByJoint) -> ca.SX:
        """Return the result of :meth:`pair_gradient` by one sweep from the tips, which keeps few values at a time.

        The force of joint i is the momentum of its subtree minus the wrenches on its subtree.  If a link has one
        child, its velocity follows from the velocity of the child.  So only the velocities of the tips, of branching
        links and of the joints are kept until the sweep, and articulated inertias are not.  These formulas need up
        to 30 % more operations.
        """
        pair, forces = (x, y), (dict[int, ca.SX](), dict[int, ca.SX]())
        velocities = [dict(response.velocities) for response in pair]
        for response, force in zip(pair, forces, strict=True):
            for wrench in response.wrenches:
                joint = wrench.point.joint
                force[joint] = force.get(joint, _ZERO) - self.link_force(wrench)
        rows: ByJoint = {}
        for slot, i, parent in reversed(self._joints):
            R, p, turn, both = self._R[i], self._p[i], turning.get(i, ca.SX(3, 1)), list[tuple[ca.SX, ca.SX]]()
            for response, velocity, force in zip(pair, velocities, forces, strict=True):
                total = force.get(i, _ZERO) + self._inertia[i] @ velocity[i]
                both.append((velocity[i] - self._S[i] @ response.a[slot.v], total))
                self.visit(i, *both[-1])
            (v_x, f_x), (v_y, f_y) = both
            inner = (v_y, f_x, v_x, f_y) if parent else ()
            rows[i] = step.gradient(self._S[i], turn, ca.SX(slot.kind.nv, 1), *inner)
            self.visit(i, rows[i])
            if not parent:
                continue
            up = R @ turn
            self.visit(i, up)
            turning[parent] = turning.get(parent, ca.SX(3, 1)) + up
            for (before, total), velocity, force in zip(both, velocities, forces, strict=True):
                passed = force_to_parent(R, p, total)
                self.visit(i, passed)
                force[parent] = force.get(parent, _ZERO) + passed
                if len(self.model.children[parent]) == 1:
                    velocity[parent] = motion_to_parent(R, p, before)
                    self.visit(parent, velocity[parent])
        return ca.densify(ca.vertcat(*[rows[i] for i in self._R]))

    def energy_gradient(self, velocities: ByJoint) -> ca.SX:
        """Return the tangent gradient of ``vᵀM(q)v`` for fixed ``v``, without extra inertias, shape (nv,).

        Entry j is ``−2 S_jᵀ (v_j⁻ ×* F_j)``.  ``F_j`` is the momentum of the subtree of joint j.  ``v_j⁻`` is the
        velocity of the link after joint j without the motion of joint j.
        """
        forces = {i: -2 * (self._own_inertia[i] @ velocity) for i, velocity in velocities.items()}
        # For a joint with one axis, v⁻ can include the motion of the joint, because Sᵀ(S ×* F) is zero.
        before = {
            i: velocities[i] if slot.kind.nv == 1 else motion_to_child(self._R[i], self._p[i], velocities[parent])
            for slot, i, parent in self._joints
            if parent
        }
        return self._gather([(before, self._accumulate(forces))], {})

    def _turn(self, turning: ByJoint, wrench: Wrench, velocities: ByJoint) -> None:
        """Add ``f × u + m × ω`` to ``turning`` for a wrench ``(f, m)`` that is constant in the world.

        ``(u, ω)`` is the velocity of the point of the wrench.  When a joint j on the path to the link turns, the
        wrench rotates relative to the link.  The rotation contributes ``−ω_jᵀ (f × u + m × ω)`` to the gradient.
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
        """Return ``known + Σ S_jᵀ(v_j⁻ ×* F_j) − ω_jᵀ turning``, summed over the pairs ``(v⁻, F)``, shape (nv,)."""
        turning = {i: turning.get(i, ca.SX(3, 1)) for i in self._R}
        rows: ByJoint = {}
        for slot, i, parent in reversed(self._joints):
            if parent:
                moved = self._R[i] @ turning[i]
                self.visit(i, moved)
                turning[parent] = turning[parent] + moved
            inner = [x[i] for pair in pairs for x in pair] if parent else []
            row = (known or {}).get(i, ca.SX(slot.kind.nv, 1))
            rows[i] = step.gradient(self._S[i], turning[i], row, *inner)
            self.visit(i, rows[i])
        return ca.densify(ca.vertcat(*[rows[i] for i in self._R]))

    def turning_gradient(self, point: PointOnLink, direction: ca.SX, covector: ca.SX) -> ca.SX:
        """Return the tangent gradient of ``cᵀ d(q)``, shape (nv,), for a direction ``d`` that turns with the link.

        ``d`` and the fixed ``covector`` c are in world axes.
        """
        turning = {point.joint: -self.to_link(point.joint, cross(direction, covector))}
        return self._gather([], turning)

    @cached_property
    def _own_inertia(self) -> ByJoint:
        return {i: self._constant(i, "own inertia", lambda j: self.model.inertias[j].matrix()) for i in self._R}
