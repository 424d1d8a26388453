"""First and second derivatives of the equations of a velocity jump, in closed form.

The left sides of the equations of a velocity jump ``a`` with foot impulses ``f`` are ``M a − J_sᵀf`` and ``J_s a +
εf``.  Their sum with multipliers ``b`` and ``l`` is ``φ = bᵀM a − bᵀJ_sᵀf + lᵀJ_s a + ε lᵀf``.  All vectors in this
module are in the axes of a root link, which is a link whose parent is the world.  Therefore the inertia of a subtree
is the sum of the inertias of its links.  A motion of joint j turns all links after joint j by ``S_j ×``.  In link
axes, the velocities of these links for ``a`` change by ``U_j(a) = −S_j × V_p(a)``, where p is the parent of j.  The
derivatives are::

    ∂φ/∂q_j       = U_j(b)ᵀF_j(a) + U_j(a)ᵀF_j(b)
    ∂²φ/∂q_j∂q_k  = U_j(b)ᵀA_k(a) + U_j(a)ᵀA_k(b),   A_k = S_k ×* F_k + I_k U_k,   for k in the subtree of j

``I_k`` is the inertia of the subtree of k.  ``F_k(a)`` is the momentum of this subtree for the velocity ``a``, minus
the impulses ``f`` on its feet.  ``F_k(b)`` is the momentum of the subtree for the velocity ``b``, plus ``l``.
Automatic differentiation needs about twice as many operations for standing robots.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from impact_posture.dynamics.kinematics import ByJoint, Kinematics, PointOnLink
from impact_posture.dynamics.spatial import (
    constant,
    cross,
    motion_cross,
    motion_cross_force,
    skew,
    symmetric,
    template,
)
from impact_posture.system.arrays import Array

# Joint families with one degree of freedom, whose velocity is the time derivative of the chart coordinate.
_ONE_AXIS = ("revolute", "continuous", "prismatic")


@dataclass(frozen=True, eq=False)
class Foot:
    """A point of a link that does not move during an impact.

    Attributes:
        point: The point.  Velocity and impulse of the foot are in the axes of its frame.
        rows: Number of velocity entries that stay zero: 3 (linear), or 6 (linear and angular).
    """

    point: PointOnLink
    rows: int


@dataclass(frozen=True, eq=False)
class _Motion:
    """Columns ``U_j`` (in ``turned``) and ``A_j`` (in ``changed``) of all joints except root joints."""

    turned: ca.SX
    changed: ca.SX


class JumpDerivatives:
    """Derivatives of the jump equations at the configuration of a tree.  The tree must have no extra inertias."""

    def __init__(self, tree: Kinematics, feet: Sequence[Foot]) -> None:
        self._tree, self._feet = tree, tuple(feet)
        self._parents = [int(parent) for parent in tree.model.parents]
        slots = tree.chart.slots
        self._beyond = [slot for slot in slots if self._parents[slot.index]]
        # Joint index of each degree of freedom, and of each column of a ``_Motion``.
        self._of_v = [slot.index for slot in slots for _ in range(slot.kind.nv)]
        self._of_u = [slot.index for slot in self._beyond]

    @property
    def exist(self) -> bool:
        """Whether the closed form applies: all joints except the roots have one degree of freedom."""
        return all(slot.kind.family in _ONE_AXIS for slot in self._beyond)

    def of(self, a: ca.SX, f: ca.SX, b: ca.SX, multipliers: ca.SX, compliance: float) -> tuple[ca.SX, ca.SX]:
        """Return the Jacobian of the equations and the Hessian of ``φ``.

        The variables are the chart coordinates, ``a`` and ``f``, in this order.  ``f`` stacks the impulses of all
        feet in the axes of their frames.  ``multipliers`` is ``l``, and ``compliance`` is ε, 1/kg.
        """
        under_a, under_b = self._motion(a, -f), self._motion(b, multipliers)
        nx, others = self._tree.chart.nx, a.numel() + f.numel()
        in_x = [slot.x.start for slot in self._beyond]
        J, held = self._at_feet(self._subspaces, self._of_v), compliance * ca.SX.eye(f.numel())
        by_x, mixed = ca.SX(others, nx), ca.SX(others, nx)
        by_x[:, in_x] = ca.vertcat(self._of_momentum(under_a), self._at_feet(under_a.turned, self._of_u))
        mixed[:, in_x] = ca.vertcat(self._of_momentum(under_b), -self._at_feet(under_b.turned, self._of_u))
        products = under_a.changed.T @ under_b.turned + under_b.changed.T @ under_a.turned
        curvature = ca.SX(nx, nx)
        curvature[in_x, in_x] = ca.tril2symm(_kept(products, self._lies_on(self._of_u, self._of_u)))
        return (
            ca.horzcat(by_x, ca.blockcat([[self._mass, -J.T], [J, held]])),
            ca.blockcat([[curvature, mixed.T], [mixed, ca.SX(others, others)]]),
        )

    def _lies_on(self, ends: Sequence[int], joints: Sequence[int], *, itself: bool = True) -> Array:
        """Return whether each joint (column) is on the path from the root to each end joint (row).

        If ``itself`` is false, an end joint is not on its own path.
        """
        paths = {end: {int(i) for i in self._tree.model.supports[end]} - (set() if itself else {end}) for end in ends}
        lies = [joint in paths[end] for end in ends for joint in joints]
        return np.array(lies, dtype=bool).reshape(len(ends), len(joints))

    @cached_property
    def _mass(self) -> ca.SX:
        products = self._momenta.T @ self._subspaces
        below = _kept(products, self._lies_on(self._of_v, self._of_v) & np.tri(len(self._of_v), dtype=bool))
        return ca.tril2symm(below) + ca.diag(self._tree.armature)

    def _of_momentum(self, motion: _Motion) -> ca.SX:
        """Return ``∂(M x + J_sᵀ f)/∂q``, shape (nv, joints); ``motion`` is the :meth:`_motion` of x and f."""
        below = _kept(self._momenta.T @ motion.turned, self._lies_on(self._of_v, self._of_u))
        above = _kept(motion.changed.T @ self._subspaces, self._lies_on(self._of_u, self._of_v, itself=False))
        return below + above.T

    def _at_feet(self, motions: ca.SX, joints: Sequence[int]) -> ca.SX:
        """Return foot velocities; column k is for a motion ``motions[:, k]`` of all links after ``joints[k]``."""
        rows = [ca.SX(0, len(joints))]
        for foot, X in zip(self._feet, self._foot_motions, strict=True):
            rows.append(_kept(X @ motions, np.tile(self._lies_on([foot.point.joint], joints), (foot.rows, 1))))
        return ca.vertcat(*rows)

    @cached_property
    def _places(self) -> dict[int, tuple[ca.SX, ca.SX]]:
        root = {i: int(list(self._tree.model.supports[i])[1]) for i in set(self._of_v)}
        return {i: self._tree.relative(root[i], i) for i in root}

    @cached_property
    def _subspaces(self) -> ca.SX:
        """Motion subspaces of all joints in the axes of their root links, shape (6, nv)."""
        columns = []
        for slot in self._tree.chart.slots:
            place, S = self._places[slot.index], constant(slot.kind.subspace)
            columns += [_motion_of_link(*place, S[:, k]) for k in range(slot.kind.nv)]
        return ca.horzcat(*columns)

    @cached_property
    def _inertias(self) -> ByJoint:
        """Mass, first moment and rotational inertia of every link about the origin of its root link, shape (4, 4)."""
        inertias: ByJoint = {}
        for i, (R, p) in self._places.items():
            body = self._tree.model.inertias[i]
            numbers = (np.array(body.mass), body.lever, body.inertia)
            inertias[i] = _inertia_of_link(R, p, *[ca.SX(np.array(part)) for part in numbers])
        return inertias

    @cached_property
    def _subtrees(self) -> ByJoint:
        """Sum of the inertias of all links in the subtree of every joint, shape (4, 4)."""
        return self._gathered(self._inertias)

    def _gathered(self, of_links: ByJoint) -> ByJoint:
        sums = dict(of_links)
        for i in sorted(sums, reverse=True):
            if parent := self._parents[i]:
                sums[parent] = sums[parent] + sums[i]
        return sums

    @cached_property
    def _momenta(self) -> ca.SX:
        """Momenta ``I_k S_k`` of the subtrees, shape (6, nv)."""
        return ca.horzcat(*[_momentum(self._subtrees[i], self._subspaces[:, k]) for k, i in enumerate(self._of_v)])

    @cached_property
    def _foot_motions(self) -> list[ca.SX]:
        """Matrices, shape (rows, 6), that map the velocity of a link to the velocity of the foot on this link."""
        motions = []
        for foot in self._feet:
            R, p = self._places[foot.point.joint]
            axes, position = R @ constant(foot.point.rotation), p + R @ constant(foot.point.position)
            X = ca.blockcat([[axes.T, -axes.T @ skew(position)], [ca.SX(3, 3), axes.T]])
            motions.append(X[: foot.rows, :])
        return motions

    def _motion(self, x: ca.SX, impulses: ca.SX) -> _Motion:
        """Return ``U`` and ``A`` for the generalized velocity ``x``, with ``impulses`` added to the momenta."""
        velocities: ByJoint = {}
        forces: ByJoint = {}
        turned: ByJoint = {}
        for slot in self._tree.chart.slots:
            i, S = slot.index, self._subspaces[:, slot.v]
            velocity = S @ x[slot.v]
            if parent := self._parents[i]:
                turned[i] = -motion_cross(S, velocities[parent])
                velocity = velocity + velocities[parent]
            velocities[i], forces[i] = velocity, _momentum(self._inertias[i], velocity)
        start = 0
        for foot, X in zip(self._feet, self._foot_motions, strict=True):
            forces[foot.point.joint] += X.T @ impulses[start : start + foot.rows]
            start += foot.rows
        forces = self._gathered(forces)
        changed = [
            motion_cross_force(self._subspaces[:, slot.v], forces[i]) + _momentum(self._subtrees[i], turned[i])
            for slot in self._beyond
            for i in [slot.index]
        ]
        return _Motion(ca.horzcat(ca.SX(6, 0), *turned.values()), ca.horzcat(ca.SX(6, 0), *changed))


def _kept(matrix: ca.SX, pattern: Array) -> ca.SX:
    return matrix * ca.sparsify(ca.SX(pattern.astype(float)))


@template
def _motion_of_link(R: ca.SX, p: ca.SX, motion: ca.SX) -> ca.SX:
    """Express the motion of a link in the axes of its root link."""
    angular = R @ motion[3:]
    return ca.vertcat(R @ motion[:3] + cross(p, angular), angular)


@template
def _inertia_of_link(R: ca.SX, p: ca.SX, mass: ca.SX, lever: ca.SX, inertia: ca.SX) -> ca.SX:
    """Return ``[I h; hᵀ m]`` with ``h = m c``.

    ``I`` is about the origin of the root link, and ``inertia`` is about the center of mass ``c``.
    """
    c = p + R @ lever
    h = mass * c
    about_root = symmetric(R @ symmetric(inertia) @ R.T + ca.dot(h, c) * ca.SX.eye(3) - h @ c.T)
    return ca.blockcat([[about_root, h], [h.T, mass]])


@template
def _momentum(inertia: ca.SX, motion: ca.SX) -> ca.SX:
    """Return the momentum about the origin of the root link, ``[m v − h × w; h × v + I w]``."""
    h, v, w = inertia[:3, 3], motion[:3], motion[3:]
    return ca.vertcat(inertia[3, 3] * v - cross(h, w), cross(h, v) + inertia[:3, :3] @ w)
