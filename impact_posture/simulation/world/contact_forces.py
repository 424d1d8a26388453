"""Contact forces on each shape, recorded in every step and evaluated for many steps together."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from impact_posture.system.arrays import Array

# ``_ROWS`` are the indices of the three constraint rows of a contact with friction.  The mask ``_FIRST`` selects the
# first row, the only row of a contact without friction.
_ROWS, _FIRST = np.arange(3), np.arange(3) == 0
# Indices with which a cross product is computed: (a × b)ᵢ = a[_NEXT[i]] b[_LAST[i]] − a[_LAST[i]] b[_NEXT[i]].
_NEXT, _LAST = [1, 2, 0], [2, 0, 1]
# After this number of steps, recorded contacts are evaluated even without a call of :meth:`ContactLog.look`.
_MOST = 4096


class ShapeTruth(NamedTuple):
    """Contact of a shape with all surfaces.

    Attributes:
        frame: Frame of the shape.
        touching: True if a surface pushed the shape in the last step.
        force: Force on the shape in the last step, world, N, shape (3,).
        impulse: Impulse on the shape since the reset, world, N·s, shape (3,).
        peak: Largest sum of the normal forces since the last evaluation, N.
        began: Time at which a surface first pushed since the last evaluation, s; ``None`` if no surface pushed.
        slip: Largest tangential speed of the contact points, m/s; 0 without contact.
    """

    frame: str
    touching: bool
    force: Array
    impulse: Array
    peak: float
    began: float | None
    slip: float


class _Step(NamedTuple):
    """Contacts of a step as MuJoCo stores them, with the number of the step and the time at its end."""

    number: int
    time: float
    geoms: Array
    sizes: Array
    rows: Array
    frames: Array
    forces: Array


class _Mark(NamedTuple):
    """Contacts after a step, with velocities and centers of mass of all bodies, as MuJoCo stores them."""

    geoms: Array
    points: Array
    frames: Array
    twists: Array
    centers: Array


class ContactLog:
    """Contacts of all steps since the last call of :meth:`look`, with accumulated impulses and peaks."""

    def __init__(self, model: Any, geoms: tuple[tuple[str, ...], ...]) -> None:
        self._count, self._step = len(geoms), float(model.opt.timestep)
        # In a contact with a plane, MuJoCo lists the plane first, so the contact force acts on the second geom.  A
        # ball can be the first or the second geom.
        self._shape_of = np.full(model.ngeom, -1)
        for k, names in enumerate(geoms):
            self._shape_of[[model.geom(name).id for name in names]] = k
        self._body_of, self._root_of = np.array(model.geom_bodyid), np.array(model.body_rootid)
        self.reset()

    def reset(self) -> None:
        """Clear all records."""
        count = self._count
        self._steps: list[_Step] = []
        self._marks: list[tuple[int, _Mark | None]] = []
        self._number = 0
        self._force, self._normal, self._impulse = np.zeros((count, 3)), np.zeros(count), np.zeros((count, 3))
        self._peak, self._began = np.zeros(count), np.full(count, np.inf)

    def in_c(self) -> dict[str, Any]:
        """Return the values of the contacts after a reset for the struct in ``c/world_ticks.c``."""
        one, three = np.zeros(self._count), np.zeros((self._count, 3))
        return {"shapes": self._count, "shape_of": self._shape_of, "now": three, "normal": one, "impulse": three,
                "peak": one, "began": one}  # fmt: skip

    def step(self, data: Any, number: int) -> None:
        """Record the contacts of a step that ends at ``data.time``."""
        contact = data.contact
        parts = contact.geom, contact.dim, contact.efc_address, contact.frame, data.efc_force
        self._steps.append(_Step(number, data.time, *(part.copy() for part in parts)))

    def fold(self, number: int) -> None:
        """Evaluate the recorded steps if there are :data:`_MOST` or more, and :meth:`look` has nothing to return."""
        if len(self._steps) >= _MOST and not self._marks:
            self._marks.append((number, None))
            *_, peak, began, _ = self.look()
            self._peak, self._began = peak[0], np.where(np.isnan(began[0]), np.inf, began[0])

    def mark(self, data: Any, number: int) -> None:
        """Record the state after a step, so that the next :meth:`look` evaluates it."""
        mark = None
        if data.ncon:
            parts = data.contact.geom, data.contact.pos, data.contact.frame, data.cvel, data.subtree_com
            mark = _Mark(*(part.copy() for part in parts))
        self._marks.append((number, mark))

    def force(self, shape: int) -> list[float]:
        """Return the force on a shape in the last step with contact, world, N, shape (3,)."""
        # For a single step, this loop is faster than :meth:`_evaluated`.
        step, force = self._steps[-1], np.zeros(3)
        contacts = zip(step.rows, step.sizes, self._shape_of[step.geoms], step.frames, strict=True)
        for row, size, pair, frame in contacts:
            if row >= 0 and pair.max() == shape:
                pushed = step.forces[row : row + size] @ frame.reshape(3, 3)[:size]
                force = force + pushed if pair[1] >= 0 else force - pushed
        return list(force.tolist())

    def look(self) -> tuple[Array, ...]:
        """Return the quantities of :class:`ShapeTruth` except ``frame`` at the n calls of :meth:`mark`.

        The first axis has one entry per call, and the second axis has one entry per shape.  ``began`` is NaN if no
        surface touched the shape since the previous call.
        """
        ends, count = np.array([number for number, _ in self._marks]), self._count
        numbers, n = np.array([step.number for step in self._steps]), ends.size
        # If a run ends within a tick, the steps after the last call of :meth:`mark` stay recorded.
        looked = int(np.searchsorted(numbers, ends[-1], side="right"))
        steps, numbers, self._steps = self._steps[:looked], numbers[:looked], self._steps[looked:]
        # If no step was taken since the last evaluation, the contacts are the same as at the last evaluation.
        unmoved = ends == self._number
        force, normal = self._force * unmoved[:, None, None], self._normal * unmoved[:, None]
        impulse, peak, began = np.zeros((n, count, 3)), np.zeros((n, count)), np.full((n, count), np.inf)
        peak[0], began[0] = self._peak, self._began
        if steps:
            forces, normals = self._evaluated(steps)
            into, times = np.searchsorted(ends, numbers), np.array([s.time for s in steps])
            np.add.at(impulse, into, self._step * forces)
            np.maximum.at(peak, into, normals)
            at, shape = np.nonzero(normals > 0)
            np.minimum.at(began, (into[at], shape), times[at] - self._step)
            last = np.minimum(np.searchsorted(numbers, ends), len(steps) - 1)
            now = numbers[last] == ends
            force[now], normal[now] = forces[last[now]], normals[last[now]]
        impulse = self._impulse + impulse.cumsum(axis=0)
        slip = self._slips() * (normal > 0)
        self._number, self._force, self._normal, self._impulse = int(ends[-1]), force[-1], normal[-1], impulse[-1]
        self._peak, self._began = np.zeros(count), np.full(count, np.inf)
        self._marks = []
        return normal > 0, force, impulse, peak, np.where(np.isinf(began), np.nan, began), slip

    def _evaluated(self, steps: list[_Step]) -> tuple[Array, Array]:
        """Return forces on shapes, shape (steps, shapes, 3), and sums of normal forces, shape (steps, shapes)."""
        counts, sizes = [s.sizes.size for s in steps], np.concatenate([s.sizes for s in steps])
        starts = np.cumsum([0, *(s.forces.size for s in steps[:-1])])
        first, at = np.concatenate([s.rows for s in steps]), np.repeat(np.arange(len(steps)), counts)
        geoms, frames = np.concatenate([s.geoms for s in steps]), np.concatenate([s.frames for s in steps])
        # MuJoCo also lists contacts just outside the surface.  Such contacts do not push and have no address (−1).
        # Contacts of other geoms have no shape (−1).
        pushing = (first >= 0) & (self._shape_of[geoms].max(axis=1) >= 0)
        first = (first + np.repeat(starts, counts))[pushing]
        at, geoms, sizes, frames = at[pushing], geoms[pushing], sizes[pushing], frames[pushing].reshape(-1, 3, 3)
        # A contact with friction has three force components, a contact without friction only the normal force.
        rough = (sizes == 3)[:, None]
        local = np.concatenate([s.forces for s in steps])[first[:, None] + _ROWS * rough] * (rough | _FIRST)
        one, other = self._shape_of[geoms].T
        shape, sign = np.maximum(one, other), np.where(other >= 0, 1.0, -1.0)
        forces, normals = np.zeros((len(steps), self._count, 3)), np.zeros((len(steps), self._count))
        # The rows of a contact frame are its axes.  The first axis is the normal.
        np.add.at(forces, (at, shape), sign[:, None] * (local[:, None, :] @ frames)[:, 0])
        np.add.at(normals, (at, shape), local[:, 0])
        return forces, normals

    def _slips(self) -> Array:
        """Return the largest tangential speed of the contact points of each shape, for each call of :meth:`mark`."""
        slips = np.zeros((len(self._marks), self._count))
        touching = [k for k, (_, mark) in enumerate(self._marks) if mark]
        if not touching:
            return slips
        geoms, points, frames, twists, centers = zip(*(self._marks[k][1] for k in touching), strict=True)
        at = np.repeat(np.arange(len(touching)), [len(pairs) for pairs in geoms])
        geom, normals = np.concatenate(geoms), np.concatenate(frames)[:, :3]
        bodies, other = self._body_of[geom[:, 1]], self._shape_of[geom[:, 1]]
        twist, center = np.array(twists)[at, bodies], np.array(centers)[at, self._root_of[bodies]]
        arms, spins = np.concatenate(points) - center, twist[:, :3]
        velocities = twist[:, 3:] + spins[:, _NEXT] * arms[:, _LAST] - spins[:, _LAST] * arms[:, _NEXT]
        velocities -= (normals * velocities).sum(axis=1, keepdims=True) * normals
        # Slip is evaluated only for contacts with surfaces, not for contacts with a ball.
        ground = (self._body_of[geom[:, 0]] == 0) & (other >= 0)
        speeds = np.sqrt((velocities * velocities).sum(axis=1))[ground]
        np.maximum.at(slips, (np.array(touching)[at[ground]], other[ground]), speeds)
        return slips
