"""Zero moment point of a robot that stands, as rows on its acceleration."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from impact_posture.system.arrays import Array
from impact_posture.tsid.flow.redundancy import Redundancy
from impact_posture.tsid.state import State
from impact_posture.tsid.support_contact import SupportContact

# Share of the distance from the center of mass to an edge that accelerations may use.
_SHARE = 0.8
# Least distance of the center of mass from an edge that counts, m.
_LEAST = 0.01
# Least square of the length of a row on the constraints.
_TINY = 1e-12


class ZeroMomentPoint:
    """Bounds of the acceleration that keep the zero moment point ``z`` within a polygon ``n·z + b ≤ 0`` on the floor.

    The feet carry the base's six rows of ``h + M ν̇``: a force ``f`` and a moment ``τ`` about the base's origin ``p``.
    With the height of ``p`` over the ground, the moments about horizontal axes vanish at
    ``z = (p_x − (τ_y + height f_x)/f_z, p_y + (τ_x − height f_y)/f_z)``.  Hence ``f_z (n·z + b)`` is linear in ``ν̇``.
    """

    def __init__(self, edges: Array, offsets: Array, state: State, contacts: Sequence[SupportContact]) -> None:
        """Set the polygon, ``n`` (k, 2) and ``b`` (k,), and the ground, on which the first contact is at a state."""
        bounded = np.isfinite(offsets)
        self._edges, self._offsets = edges[bounded], offsets[bounded]
        self._ground = float(state.at(contacts[0].point).position[2]) if contacts else 0.0
        self._rows, self._room = np.zeros((0, 0)), np.zeros(0)

    def limit(self, state: State, known: Array) -> None:
        """Set the rows at a state with ``ν = 0``, and the room beside a known acceleration, shape (nv,), in N·m."""
        if not self._offsets.size:
            return
        n, R, p = self._edges, state.base_rotation, state.q[:3]
        height, h = float(p[2]) - self._ground, state.h[:6]
        force = np.column_stack([-height * n, n @ p[:2] + self._offsets])
        moment = np.column_stack([n[:, 1], -n[:, 0], np.zeros(len(n))])
        wrench = np.hstack([force @ R, moment @ R])
        self._rows = wrench @ state.M[:6]
        static = np.maximum(-wrench @ h, _LEAST * float(R[2] @ h[:3]))
        self._room = _SHARE * static - self._rows @ known

    def keep(self, space: Redundancy, period: float, step: Array) -> Array:
        """Return a change of the velocity in a period, s, without the parts that move the point beyond an edge."""
        for row, room in zip(self._rows, self._room, strict=True):
            over = float(row @ step) - float(room) * period
            if over > 0:
                across = space.project(row)
                square = float(across @ across)
                if square > _TINY:
                    step = step - across * (over / square)
        return step
