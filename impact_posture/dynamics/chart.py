"""Coordinates of the configuration space, for optimization."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import casadi as ca
import numpy as np
import pinocchio as pin

from impact_posture.dynamics.joints import JointKind, joint_kind
from impact_posture.robot.model_joints import ENDLESS
from impact_posture.system.arrays import Array

# Joint families whose last chart coordinate is an angle.  ``q`` contains the cosine and sine of this angle.
_ANGLES = ("continuous", "planar")
# Joint families whose coordinates can have limits.
BOUNDED = ("revolute", "prismatic", "translation")


@dataclass(frozen=True)
class JointSlot:
    """One joint, and its entries in ``q``, ``v`` and the chart coordinates ``x``."""

    index: int
    name: str
    kind: JointKind
    q: slice
    v: slice
    x: slice


class Chart:
    """Chart ``x`` of the configuration space: like ``q``, but an angle replaces each pair of cosine and sine.

    A quaternion keeps its four numbers, and :meth:`norms` returns the equation for the unit norm.  ``q(x)`` is
    therefore smooth and has no singularities.
    """

    def __init__(self, model: pin.Model) -> None:
        self.slots: list[JointSlot] = []
        # ``copied`` and ``angles`` contain pairs of an index in q and an index in x.  The values of ``copied`` are
        # equal in q and x.  For ``angles``, the index in q is the index of the cosine, which the sine follows, and
        # the index in x is the index of the angle.
        copied: list[tuple[int, int]] = []
        angles: list[tuple[int, int]] = []
        start = 0
        for i in range(1, model.njoints):
            kind = joint_kind(model.joints[i], str(model.names[i]))
            angle = kind.family in _ANGLES
            q0, v0, end = int(model.idx_qs[i]), int(model.idx_vs[i]), start + kind.nq - angle
            columns = slice(q0, q0 + kind.nq), slice(v0, v0 + kind.nv), slice(start, end)
            self.slots.append(JointSlot(i, str(model.names[i]), kind, *columns))
            copied += [(q0 + k, start + k) for k in range(kind.nq - 2 * angle)]
            if angle:
                angles.append((q0 + kind.nq - 2, end - 1))
            start = end
        self._q, self._x = np.array(copied, dtype=int).reshape(-1, 2).T
        self._cosine, self._angle = np.array(angles, dtype=int).reshape(-1, 2).T
        self.nx = start
        self.nq, self.nv = int(model.nq), int(model.nv)
        self._model = model

    @staticmethod
    @lru_cache(maxsize=16)
    def of(model: pin.Model) -> Chart:
        """Return the chart of a model.  The charts of recent models are cached."""
        return Chart(model)

    @cached_property
    def bounded(self) -> tuple[list[int], list[int]]:
        """Indices, in ``v`` and in ``x``, of the coordinates that can have limits and for which ``v = dx/dt``."""
        slots = [slot for slot in self.slots if slot.kind.family in BOUNDED]
        in_v = [k for slot in slots for k in range(slot.v.start, slot.v.stop)]
        return in_v, [k for slot in slots for k in range(slot.x.start, slot.x.stop)]

    def configuration(self, x: ca.SX) -> ca.SX:
        """Return the configuration ``q(x)`` for chart coordinates ``x``, shape (nq, 1)."""
        parts = [ca.SX(0)] * self.nq
        for k, place in zip(self._q, self._x, strict=True):
            parts[k] = x[int(place)]
        for k, place in zip(self._cosine, self._angle, strict=True):
            parts[k], parts[k + 1] = ca.cos(x[int(place)]), ca.sin(x[int(place)])
        return ca.vertcat(*parts)

    def quaternion_slices(self) -> list[slice]:
        """Return the slices of ``x`` that are quaternions (x y z w)."""
        return [slice(s.x.stop - 4, s.x.stop) for s in self.slots if s.kind.family in ("free-flyer", "spherical")]

    def norms(self, x: ca.SX) -> ca.SX:
        """Return ``|quaternion|² − 1``, which must be zero, for each quaternion in ``x``."""
        return ca.vertcat(ca.SX(0, 1), *[ca.sumsqr(x[s]) - 1 for s in self.quaternion_slices()])

    def to_x(self, q: Array) -> Array:
        """Return the chart coordinates of a configuration, shape (nx,)."""
        x = np.zeros(self.nx)
        x[self._x] = q[self._q]
        if self._angle.size:
            x[self._angle] = np.arctan2(q[self._cosine + 1], q[self._cosine])
        return x

    def to_q(self, x: Array) -> Array:
        """Return the configuration for chart coordinates, shape (nq,), with normalized quaternions."""
        q = np.zeros(self.nq)
        q[self._q] = x[self._x]
        if self._angle.size:
            q[self._cosine], q[self._cosine + 1] = np.cos(x[self._angle]), np.sin(x[self._angle])
        return np.asarray(pin.normalize(self._model, q))

    def bounds(self) -> tuple[Array, Array]:
        """Return lower and upper limits of the chart coordinates, shape (nx,); infinite without a limit."""
        lower, upper = np.full(self.nx, -np.inf), np.full(self.nx, np.inf)
        for slot in self.slots:
            if slot.kind.family in BOUNDED:
                low = np.array(self._model.lowerPositionLimit[slot.q])
                high = np.array(self._model.upperPositionLimit[slot.q])
                lower[slot.x] = np.where(low < -ENDLESS, -np.inf, low)
                upper[slot.x] = np.where(high > ENDLESS, np.inf, high)
        return lower, upper
