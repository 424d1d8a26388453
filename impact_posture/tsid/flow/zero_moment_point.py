"""Zero moment point of a standing robot, limited by linear bounds on the acceleration."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from impact_posture.system.arrays import Array
from impact_posture.tsid.flow.redundancy import Redundancy
from impact_posture.tsid.state import State
from impact_posture.tsid.support_contact import SupportContact

# Share of the distance from the center of mass to an edge that accelerations may use.
ZMP_SHARE = 0.8
# A shorter distance from the center of mass to an edge is replaced by this distance, m.
ZMP_LEAST = 0.01
# A bound is ignored if the squared norm of its row, projected onto the null space of the feet, is smaller than this.
_TINY = 1e-12


class ZeroMomentPoint:
    """Bounds on the acceleration that keep the zero moment point ``z`` in a polygon ``n·z + b ≤ 0`` on the floor.

    The first six rows of ``h + M ν̇`` are the ground force ``f`` and its moment ``τ`` about the base origin ``p``.
    ``height`` is the height of ``p`` above the ground.  The moments about horizontal axes vanish at
    ``z = (p_x − (τ_y + height f_x)/f_z, p_y + (τ_x − height f_y)/f_z)``.  Hence ``f_z (n·z + b)`` is linear in
    ``ν̇``.
    """

    def __init__(self, edges: Array, offsets: Array, state: State, contacts: Sequence[SupportContact]) -> None:
        """Set the polygon and the height of the ground.

        ``edges`` contains ``n``, shape (k, 2), and ``offsets`` contains ``b``, shape (k,).  The height is the height
        of the first contact at ``state``.
        """
        bounded = np.isfinite(offsets)
        self._edges, self._offsets = edges[bounded], offsets[bounded]
        self._ground = float(state.at(contacts[0].point).position[2]) if contacts else 0.0
        self._rows, self._room = np.zeros((0, 0)), np.zeros(0)

    def limit(self, state: State, known: Array) -> None:
        """Set the rows at a state with ``ν = 0``, and their bounds, N·m.

        The acceleration ``known``, shape (nv,), is used in any case, so its effect is subtracted from the bounds.
        """
        if not self._offsets.size:
            return
        n, R, p = self._edges, state.base_rotation, state.q[:3]
        height, h = float(p[2]) - self._ground, state.h[:6]
        force = np.column_stack([-height * n, n @ p[:2] + self._offsets])
        moment = np.column_stack([n[:, 1], -n[:, 0], np.zeros(len(n))])
        wrench = np.hstack([force @ R, moment @ R])
        self._rows = wrench @ state.M[:6]
        static = np.maximum(-wrench @ h, ZMP_LEAST * float(R[2] @ h[:3]))
        self._room = ZMP_SHARE * static - self._rows @ known

    def keep(self, space: Redundancy, period: float, step: Array) -> Array:
        """Return ``step`` without the parts that move the zero moment point beyond an edge.

        ``step`` is a change of the velocity within ``period`` seconds, shape (nv,).
        """
        for row, room in zip(self._rows, self._room, strict=True):
            over = float(row @ step) - float(room) * period
            if over > 0:
                across = space.project(row)
                square = float(across @ across)
                if square > _TINY:
                    step = step - across * (over / square)
        return step
