"""Count, for each joint, the operations of an ideal articulated-body factorization, two solves and the gradient.

The count follows patterns of zeros, not values.  Each joint is a rotation in a coordinate plane of its link.
Rotating a pair of numbers requires 4 multiplications and 2 additions (4m 2a).  A symmetric 2×2 matrix requires 4m 5a,
and a general 2×2 matrix 4m 10a with the double angle (3m 2a for each joint).  A constant rotation that only permutes
axes requires no operation; any other is counted as one more plane rotation.  A translation is a cross product with
the nonzero entries of its vector.  Each joint requires:

- factorization: the column ``U = I^A S``, one reciprocal, ``U/D``, and one triangle of ``I^a = I^A − U Uᵀ/D``, whose
  row of the joint axis is zero without armature.  ``I^a`` is rotated, moved by two products with ``p̂`` and added to
  the parent;
- solves: the solve for a passes biases inward along the chain of the contact, the solve for b from every joint.  Both
  pass velocities outward;
- gradient, for a and for b: the rows of ``f = I^a v⁻ + p^a`` that enter the axis row of ``v⁻ ×* f``, and this row.

For the base, add ``Rᵀn``, an LDLᵀ of a symmetric 6×6 matrix and two solves with it.  The count ignores symmetric
values, equal entries and constants that can be combined.  So a program can need fewer operations for some robots.
"""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impact_posture.robot.robot import Robot

Pattern = NDArray[np.bool_]

_TINY = 1e-9


class _Count:
    """Counter of operations.  Each method takes and returns patterns of nonzero entries, and adds its operations."""

    total = 0

    def ops(self, *counts: int) -> None:
        self.total += sum(counts)

    def plus(self, x: Pattern, y: Pattern) -> Pattern:
        """Add two arrays; for symmetric matrices, only one triangle."""
        both = x & y
        self.ops(int(np.triu(both).sum() if both.ndim == 2 else both.sum()))
        return x | y

    def times(self, x: Pattern, y: Pattern, triangle: bool = False) -> Pattern:
        """Multiply two matrices; with ``triangle``, compute only one triangle of the product."""
        terms = x.astype(int) @ y.astype(int)
        wanted = np.triu(terms) if triangle else terms
        self.ops(int(wanted.sum()), int(np.maximum(wanted - 1, 0).sum()))
        return np.asarray(terms > 0)

    def turn(self, v: Pattern, axis: int) -> Pattern:
        """Rotate a 3-vector in a coordinate plane."""
        i, j = (axis + 1) % 3, (axis + 2) % 3
        both = int(v[i]) + int(v[j])
        self.ops(2 * both, 2 * (both == 2))
        v = v.copy()
        v[i] = v[j] = v[i] or v[j]
        return v

    def turn_matrix(self, M: Pattern, axis: int, symmetric: bool) -> Pattern:
        """Rotate a 3×3 matrix in a coordinate plane, from both sides."""
        i, j, k = (axis + 1) % 3, (axis + 2) % 3, axis
        M = M.copy()
        if M[np.ix_([i, j], [i, j])].any():
            self.ops(4, 5 if symmetric else 10)
            M[np.ix_([i, j], [i, j])] = True
        M[:, k] = self.turn(M[:, k], axis)
        M[k, :] = M[:, k] if symmetric else self.turn(M[k, :], axis)
        return M


class _Joint:
    """Transformations between the link of a joint and the parent link."""

    def __init__(self, model: pin.Model, i: int) -> None:
        name = model.joints[i].shortname().replace("JointModel", "")
        placement = model.jointPlacements[i]
        self.parent, self.revolute = int(model.parents[i]), name.startswith("R")
        self.axis = "XYZ".index(name[1]) if name[1:2] in tuple("XYZ") else 2
        self.armed = float(model.armature[model.idx_vs[i]]) > 0
        self.R = np.abs(placement.rotation) > _TINY
        self.permutes = bool((self.R.sum(axis=0) == 1).all())
        p = np.abs(placement.translation) > _TINY
        if not self.revolute:
            p = p | (self.R @ (np.arange(3) == self.axis))
        self.cross = np.array([[0, p[2], p[1]], [p[2], 0, p[0]], [p[1], p[0], 0]], dtype=bool)

    @property
    def row(self) -> int:
        """Index of the entry of a spatial vector that acts along or about the joint axis."""
        return self.axis + (3 if self.revolute else 0)

    def vector(self, count: _Count, v: Pattern, inward: bool) -> Pattern:
        """Rotate a 3-vector to the parent link or from it."""
        if inward and self.revolute:
            v = count.turn(v, self.axis)
        if self.permutes:
            v = (self.R if inward else self.R.T) @ v
        else:
            count.ops(4, 2)
            v = np.full(3, bool(v.any()))
        return count.turn(v, self.axis) if self.revolute and not inward else v

    def force(self, count: _Count, f: Pattern) -> Pattern:
        """Transform a spatial force to the parent link."""
        linear, angular = self.vector(count, f[:3], True), self.vector(count, f[3:], True)
        moment = count.times(self.cross, linear[:, None])[:, 0]
        return np.concatenate([linear, count.plus(angular, moment)])

    def motion(self, count: _Count, v: Pattern) -> Pattern:
        """Transform a spatial motion from the parent link."""
        swept = count.times(self.cross, v[3:, None])[:, 0]
        linear = count.plus(v[:3], swept)
        return np.concatenate([self.vector(count, linear, False), self.vector(count, v[3:], False)])

    def inertia(self, count: _Count, I: Pattern) -> Pattern:  # noqa: E741
        """Transform a symmetric 6×6 inertia to the parent link."""
        A, B, D = I[:3, :3], I[:3, 3:], I[3:, 3:]
        if self.revolute:
            count.ops(3, 2)
            A, B, D = (count.turn_matrix(M, self.axis, s) for M, s in ((A, True), (B, False), (D, True)))
        if self.permutes:
            A, B, D = (self.R @ M @ self.R.T for M in (A, B, D))
        else:
            A, B, D = (count.turn_matrix(M, 0, s) | M.any() for M, s in ((A, True), (B, False), (D, True)))
        moved = count.times(A, self.cross)
        count.ops(int((B & moved).sum()))
        shifted = B | moved
        first = count.times(self.cross, B, triangle=True)
        second = count.times(self.cross, shifted, triangle=True)
        D = count.plus(count.plus(D, first | first.T), second | second.T)
        return np.block([[A, shifted], [shifted.T, D]])


def floor(robot: Robot, contact: int) -> int:
    """Return the number of operations of H and ∇H for a robot with the contact on the link of joint ``contact``.

    Every joint has one degree of freedom, except a free-flyer at the root.
    """
    model, count = robot.model, _Count()
    joints = {i: _Joint(model, i) for i in range(1, model.njoints) if model.nvs[i] == 1}
    based = [i for i in range(1, model.njoints) if i not in joints]
    chain = {contact}
    while model.parents[min(chain)]:
        chain.add(int(model.parents[min(chain)]))
    reduced = _factorize(count, model, joints)
    count.ops(2 * sum(j.revolute for j in joints.values()))
    for _ in based:
        count.ops(15 + 50 + 2 * 36 + 3, 15 + 35 + 2 * 30, 6)
    passed = [_inward(count, joints, chain & set(joints), {contact}), _inward(count, joints, set(joints), set())]
    for forces in passed:
        before = _outward(count, model, joints, based)
        for i, joint in joints.items():
            if not joint.parent:
                continue
            rows = [r for r in range(6) if r % 3 != joint.axis and (joint.revolute or r > 2)]
            f = count.times(reduced[i][rows], before[i][:, None])[:, 0]
            count.plus(f, forces.get(i, np.zeros(6, dtype=bool))[rows])
            count.ops(2 * int(sum(before[i][r] for r in rows)))
    # Rotate the normal outward and the couple inward along the chain, and add the row of the couple.  Then count the
    # operations of scaling, of H, and of the lever arms of the contact.
    for i in sorted(chain & set(joints)):
        for inward in (False, True):
            joints[i].vector(count, np.ones(3, dtype=bool), inward)
        count.ops(1)
    count.ops(18 + 2 * model.nv, 12 + model.nv - 1)
    return count.total


def _factorize(count: _Count, model: pin.Model, joints: dict[int, _Joint]) -> dict[int, Pattern]:
    articulated = {i: np.abs(model.inertias[i].matrix()) > _TINY for i in range(1, model.njoints)}
    reduced: dict[int, Pattern] = {}
    for i in sorted(joints, reverse=True):
        joint, body = joints[i], articulated[i]
        U = body[:, joint.row].copy()
        count.ops(int(joint.armed), 1)
        if not joint.parent:
            continue
        U[joint.row] = joint.armed
        count.ops(int(U.sum()))
        rest = body.copy()
        if not joint.armed:
            rest[joint.row, :] = rest[:, joint.row] = False
        update = np.outer(U, U)
        count.ops(int(np.triu(update).sum()))
        reduced[i] = count.plus(rest, update)
        articulated[joint.parent] = count.plus(articulated[joint.parent], joint.inertia(count, reduced[i]))
    return reduced


def _inward(count: _Count, joints: dict[int, _Joint], active: set[int], loaded: set[int]) -> dict[int, Pattern]:
    """Pass biases from the leaves inward along the ``active`` joints; an external force acts on the ``loaded``
    links."""
    bias = {i: np.zeros(6, dtype=bool) for i in joints}
    for i in loaded & set(joints):
        bias[i][:] = True
    passed = {}
    for i in sorted(active, reverse=True):
        joint = joints[i]
        count.ops(1, int(not loaded and bias[i][joint.row]))  # (τ − Sᵀbias)/D
        if not joint.parent:
            continue
        drive = np.arange(6) != joint.row if not joint.armed else np.ones(6, dtype=bool)
        count.ops(int(drive.sum()))
        passed[i] = count.plus(bias[i], drive)
        moved = joint.force(count, passed[i])
        if joint.parent in joints:
            bias[joint.parent] = count.plus(bias[joint.parent], moved)
        else:
            count.ops(6)
    return passed


def _outward(count: _Count, model: pin.Model, joints: dict[int, _Joint], based: list[int]) -> dict[int, Pattern]:
    """Pass velocities from the base outward; return ``v⁻`` of every joint that has a parent."""
    after = {i: np.ones(6, dtype=bool) for i in based}
    before = {}
    for i, joint in joints.items():
        moved = joint.motion(count, after[joint.parent]) if joint.parent else np.zeros(6, dtype=bool)
        if joint.parent:
            before[i] = moved
            count.ops(2 * int(moved.sum()))  # rate − gain v⁻
        after[i] = count.plus(moved, np.arange(6) == joint.row)
    return before
