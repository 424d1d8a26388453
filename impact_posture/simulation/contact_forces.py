"""Forces of the surfaces on each shape, step by step."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from impact_posture.arrays import Array

# Rows of a contact with friction, and the row that a contact without it has.
_ROWS, _FIRST = np.arange(3), np.arange(3) == 0
# Places of the factors of a vector product.
_NEXT, _LAST = [1, 2, 0], [2, 0, 1]


class ShapeTruth(NamedTuple):
    """Contact of a shape with all surfaces.

    Attributes:
        frame: The frame that carries the shape.
        touching: Whether a surface pushed it in the last step.
        force: Force on it in the last step, world, N, shape (3,).
        impulse: Impulse on it since the reset, world, N·s, shape (3,).
        peak: Largest sum of normal forces since the last look, N.
        began: Time since the last look when a surface first pushed it, s, or ``None``.
        slip: Largest tangential speed of its contact points, m/s, 0 without contact.
    """

    frame: str
    touching: bool
    force: Array
    impulse: Array
    peak: float
    began: float | None
    slip: float


class _Pairs(NamedTuple):
    """Contacts of geoms: which shape each belongs to, the way it pushes, and whether it is one on the ground.

    All three have shape (shapes, contacts).  ``bodies`` and ``roots`` are those of the second geoms.
    """

    of_shape: Array
    signed: Array
    on_ground: Array
    bodies: Array
    roots: Array


class ContactLog:
    """Contact forces of the last step, and what accumulates from them.

    Args:
        model: The MuJoCo model.
        geoms: Names of the geoms of the shapes.
        frames: The frames that carry the shapes.
    """

    def __init__(self, model: Any, geoms: tuple[str, ...], frames: tuple[str, ...]) -> None:
        self._frames, count = frames, len(frames)
        # MuJoCo names the plane of a contact first, so the contact pushes the second geom.  A ball may be either.
        self._shape_of = np.full(model.ngeom, -1)
        for k, name in enumerate(geoms):
            self._shape_of[model.geom(name).id] = k
        self._body_of, self._root_of = np.array(model.geom_bodyid), np.array(model.body_rootid)
        self._step = float(model.opt.timestep)
        self.forces: Array = np.zeros((count, 3))
        self._normal, self._impulses, self._peaks = np.zeros(count), np.zeros((count, 3)), np.zeros(count)
        self._began = np.full(count, np.nan)
        # The same geoms touch for many steps: what only depends on which ones do, by their pairs.
        self._pairs: dict[bytes, _Pairs] = {}
        self.pushing = False
        """Whether a surface pushed a shape in the last step."""

    def reset(self) -> None:
        """Set everything to zero."""
        for values in (self.forces, self._normal, self._impulses, self._peaks):
            values[:] = 0.0
        self._began[:] = np.nan
        self.pushing = False

    def step(self, data: Any) -> None:
        """Add the forces of a step from ``data.time − timestep`` to ``data.time``."""
        if not data.ncon:
            if self.pushing:
                self.forces[:], self._normal[:], self.pushing = 0.0, 0.0, False
            return
        contact = data.contact
        first, geoms, sizes = contact.efc_address, contact.geom, contact.dim
        frames = contact.frame.reshape(-1, 3, 3)
        if first.min() < 0:
            # A contact just outside the surface does not push and has no address.
            there = first >= 0
            first, geoms, sizes, frames = first[there], geoms[there], sizes[there], frames[there]
        # A contact has one number without friction, else three.
        rough = (sizes == 3)[:, None]
        local = data.efc_force[first[:, None] + _ROWS * rough] * (rough | _FIRST)
        pairs = self._known(geoms)
        # The rows of a contact frame are its axes, the normal first.
        self.forces[:] = pairs.signed @ (local[:, None, :] @ frames)[:, 0]
        self._normal[:] = pairs.of_shape @ local[:, 0]
        self._impulses += self._step * self.forces
        np.maximum(self._peaks, self._normal, out=self._peaks)
        pushed = self._normal > 0
        self.pushing = bool(pushed.any())
        fresh = pushed & np.isnan(self._began)
        if fresh.any():
            self._began[fresh] = data.time - self._step

    def look(self, data: Any) -> tuple[ShapeTruth, ...]:
        """Return the contact of every shape, and begin new peaks and new first touches."""
        slips, pushed = self._slips(data).tolist(), (self._normal > 0).tolist()
        peaks, began = self._peaks.tolist(), self._began.tolist()
        # One copy for all shapes, whose rows nobody writes.
        forces, impulses = self.forces.copy(), self._impulses.copy()
        found = tuple(
            ShapeTruth(
                frame=frame,
                touching=pushed[k],
                force=forces[k],
                impulse=impulses[k],
                peak=peaks[k],
                began=None if math.isnan(began[k]) else began[k],
                slip=slips[k],
            )
            for k, frame in enumerate(self._frames)
        )
        self._peaks[:], self._began[:] = 0.0, np.nan
        return found

    def _slips(self, data: Any) -> Array:
        """Return tangential speeds, shape (shapes,), of the shapes that were pushed in the last step."""
        if not (data.ncon and self.pushing):
            return np.zeros(len(self._frames))
        contact = data.contact
        pairs, normals = self._known(contact.geom), contact.frame[:, :3]
        twists, arms = data.cvel[pairs.bodies], contact.pos - data.subtree_com[pairs.roots]
        spins = twists[:, :3]
        velocities = twists[:, 3:] + spins[:, _NEXT] * arms[:, _LAST] - spins[:, _LAST] * arms[:, _NEXT]
        velocities -= (normals * velocities).sum(axis=1, keepdims=True) * normals
        slips = (pairs.on_ground * np.sqrt((velocities * velocities).sum(axis=1))).max(axis=1)
        return np.asarray(slips * (self._normal > 0))

    def _known(self, geoms: Array) -> _Pairs:
        """Return what depends on the geoms of the contacts alone, shape (contacts, 2)."""
        key = geoms.tobytes()
        if key not in self._pairs:
            one, other = self._shape_of[geoms].T
            shapes, bodies = np.maximum(one, other), self._body_of[geoms[:, 1]]
            of_shape = (shapes == np.arange(len(self._frames))[:, None]).astype(float)
            # A ball is no place to slide on.
            ground = (self._body_of[geoms[:, 0]] == 0) & (other >= 0)
            signed, on_ground = of_shape * np.where(other >= 0, 1.0, -1.0), of_shape * ground
            self._pairs[key] = _Pairs(of_shape, signed, on_ground, bodies, self._root_of[bodies])
        return self._pairs[key]
