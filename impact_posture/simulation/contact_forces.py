"""Forces of the surfaces on each shape, step by step."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from impact_posture.arrays import Array


@dataclass(frozen=True, eq=False)
class ShapeTruth:
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

    def reset(self) -> None:
        """Set everything to zero."""
        for values in (self.forces, self._normal, self._impulses, self._peaks):
            values[:] = 0.0
        self._began[:] = np.nan

    def step(self, data: Any) -> None:
        """Add the forces of a step from ``data.time − timestep`` to ``data.time``."""
        self.forces[:] = 0.0
        self._normal[:] = 0.0
        if not data.ncon:
            return
        contact = data.contact
        # A contact just outside the surface does not push and has no address.
        pushing = contact.efc_address >= 0
        first, (one, other) = contact.efc_address[pushing], self._shape_of[contact.geom[pushing]].T
        shapes, side = np.maximum(one, other), np.where(other >= 0, 1.0, -1.0)
        local = np.zeros((first.size, 3))
        local[:, 0] = data.efc_force[first]
        # A contact has one number without friction, else three.
        rough = np.flatnonzero(contact.dim[pushing] == 3)
        local[rough, 1] = data.efc_force[first[rough] + 1]
        local[rough, 2] = data.efc_force[first[rough] + 2]
        # The rows of a contact frame are its axes, the normal first.
        frames = contact.frame[pushing].reshape(-1, 3, 3)
        np.add.at(self.forces, shapes, side[:, None] * (local[:, None, :] @ frames)[:, 0])
        np.add.at(self._normal, shapes, local[:, 0])
        self._impulses += self._step * self.forces
        np.maximum(self._peaks, self._normal, out=self._peaks)
        fresh = (self._normal > 0) & np.isnan(self._began)
        self._began[fresh] = data.time - self._step

    def look(self, data: Any) -> tuple[ShapeTruth, ...]:
        """Return the contact of every shape, and begin new peaks and new first touches."""
        slips = self._slips(data)
        found = tuple(
            ShapeTruth(
                frame=frame,
                touching=bool(self._normal[k] > 0),
                force=self.forces[k].copy(),
                impulse=self._impulses[k].copy(),
                peak=float(self._peaks[k]),
                began=None if np.isnan(self._began[k]) else float(self._began[k]),
                slip=float(slips[k]),
            )
            for k, frame in enumerate(self._frames)
        )
        self._peaks[:], self._began[:] = 0.0, np.nan
        return found

    def _slips(self, data: Any) -> Array:
        """Return tangential speeds, shape (shapes,), of the shapes that were pushed in the last step."""
        slips = np.zeros(len(self._frames))
        if not (data.ncon and self._normal.any()):
            return slips
        # A ball is no place to slide on.
        contact, grounds = data.contact, self._body_of[data.contact.geom[:, 0]] == 0
        geoms, places, normals = contact.geom[grounds, 1], contact.pos[grounds], contact.frame[grounds, :3]
        bodies = self._body_of[geoms]
        twists, arms = data.cvel[bodies], places - data.subtree_com[self._root_of[bodies]]
        velocities = twists[:, 3:] + np.cross(twists[:, :3], arms)
        velocities -= np.sum(normals * velocities, axis=1, keepdims=True) * normals
        np.maximum.at(slips, self._shape_of[geoms], np.linalg.norm(velocities, axis=1))
        slips[self._normal <= 0] = 0.0
        return slips
