"""What the surfaces do to each shape, step by step."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class ShapeTruth:
    """What happens to one shape.

    Attributes:
        frame: The frame that carries it.
        touching: Whether a surface pushed it in the last step.
        force: Of all surfaces on it in the last step, world, N, shape (3,).
        impulse: Of all surfaces on it since the reset, world, N·s, shape (3,).
        peak: Largest normal force since the last look, N; contacts of a box, and of several surfaces, summed.
        began: When a surface first pushed it since the last look, s; ``None``: it has not.
        slip: Tangential speed of its contact points, the fastest of them, m/s; 0 where it does not touch.
    """

    frame: str
    touching: bool
    force: Array
    impulse: Array
    peak: float
    began: float | None
    slip: float


class ContactLog:
    """Forces of the step just taken, and what has come of them since.

    Args:
        model: MuJoCo's.
        geoms: Names of the shapes' geoms.
        frames: The frames that carry them.
    """

    def __init__(self, model: Any, geoms: tuple[str, ...], frames: tuple[str, ...]) -> None:
        self._frames, count = frames, len(frames)
        # Planes come first in every contact: it pushes the second geom.
        self._shape_of = np.full(model.ngeom, -1)
        for k, name in enumerate(geoms):
            self._shape_of[model.geom(name).id] = k
        self._body_of, self._root_of = np.array(model.geom_bodyid), np.array(model.body_rootid)
        self._step = float(model.opt.timestep)
        self.forces: Array = np.zeros((count, 3))
        self._normal, self._impulses, self._peaks = np.zeros(count), np.zeros((count, 3)), np.zeros(count)
        self._began = np.full(count, np.nan)

    def reset(self) -> None:
        """Forget."""
        for values in (self.forces, self._normal, self._impulses, self._peaks):
            values[:] = 0.0
        self._began[:] = np.nan

    def step(self, data: Any) -> None:
        """Take in the forces of a step from ``data.time − timestep`` to ``data.time``."""
        self.forces[:] = 0.0
        self._normal[:] = 0.0
        if not data.ncon:
            return
        contact = data.contact
        first, shapes, frames, dim = (
            contact.efc_address,
            self._shape_of[contact.geom[:, 1]],
            contact.frame,
            contact.dim,
        )
        if first.min() < 0:
            # Just outside: found, but not pushing.
            pushing = first >= 0
            first, dim, frames, shapes = first[pushing], dim[pushing], frames[pushing], shapes[pushing]
        local = np.zeros((first.size, 3))
        local[:, 0] = data.efc_force[first]
        # Without friction a contact has one number, else three.
        rough = np.flatnonzero(dim == 3)
        local[rough, 1] = data.efc_force[first[rough] + 1]
        local[rough, 2] = data.efc_force[first[rough] + 2]
        # A contact's frame has its axes as rows, the normal first.
        np.add.at(self.forces, shapes, (local[:, None, :] @ frames.reshape(-1, 3, 3))[:, 0])
        np.add.at(self._normal, shapes, local[:, 0])
        self._impulses += self._step * self.forces
        np.maximum(self._peaks, self._normal, out=self._peaks)
        fresh = (self._normal > 0) & np.isnan(self._began)
        self._began[fresh] = data.time - self._step

    def look(self, data: Any) -> tuple[ShapeTruth, ...]:
        """All of it; peaks and beginnings start anew."""
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
        """Tangential speeds, shape (shapes,), of what touches now and was pushed in the last step."""
        slips = np.zeros(len(self._frames))
        if not (data.ncon and self._normal.any()):
            return slips
        contact = data.contact
        geoms = contact.geom[:, 1]
        shapes, bodies = self._shape_of[geoms], self._body_of[geoms]
        twists, arms = data.cvel[bodies], contact.pos - data.subtree_com[self._root_of[bodies]]
        # ω × r, which numpy's own cross takes long for.
        x, y, z = twists[:, 0], twists[:, 1], twists[:, 2]
        velocities = twists[:, 3:].copy()
        velocities[:, 0] += y * arms[:, 2] - z * arms[:, 1]
        velocities[:, 1] += z * arms[:, 0] - x * arms[:, 2]
        velocities[:, 2] += x * arms[:, 1] - y * arms[:, 0]
        normals = contact.frame[:, :3]
        velocities -= np.sum(normals * velocities, axis=1, keepdims=True) * normals
        np.maximum.at(slips, shapes, np.linalg.norm(velocities, axis=1))
        slips[self._normal <= 0] = 0.0
        return slips
