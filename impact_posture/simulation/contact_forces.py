"""Forces of the surfaces on each shape, written down in every step and evaluated for many steps at once."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from impact_posture.arrays import Array

# Rows of a contact with friction, and the row that a contact without it has.
_ROWS, _FIRST = np.arange(3), np.arange(3) == 0
# Places of the factors of a vector product.
_NEXT, _LAST = [1, 2, 0], [2, 0, 1]
# Steps with contact until they are evaluated, even if nobody looks.
_MOST = 4096


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


class ContactTrace(NamedTuple):
    """Contacts of all shapes at n marks, in the words of :class:`ShapeTruth`.

    Attributes:
        touching: Shape (n, shapes).
        force: Shape (n, shapes, 3).
        impulse: Shape (n, shapes, 3).
        peak: Since the mark before, shape (n, shapes).
        began: Since the mark before, NaN for none, shape (n, shapes).
        slip: Shape (n, shapes).
    """

    touching: Array
    force: Array
    impulse: Array
    peak: Array
    began: Array
    slip: Array


class _Step(NamedTuple):
    """Contacts of a step, as MuJoCo has them, with the number of the step and the time of its end."""

    number: int
    time: float
    geoms: Array
    sizes: Array
    rows: Array
    frames: Array
    forces: Array


class _Mark(NamedTuple):
    """Contacts after a step, with velocities and centers of mass of all bodies."""

    number: int
    geoms: Array
    points: Array
    normals: Array
    twists: Array
    centers: Array


class ContactLog:
    """Contacts of all steps since the last :meth:`look`, and what accumulates from them.

    Args:
        model: The MuJoCo model.
        geoms: Names of the geoms of the shapes.
    """

    def __init__(self, model: Any, geoms: tuple[str, ...]) -> None:
        self._count, self._step = len(geoms), float(model.opt.timestep)
        # MuJoCo names the plane of a contact first, so the contact pushes the second geom.  A ball may be either.
        self._shape_of = np.full(model.ngeom, -1)
        for k, name in enumerate(geoms):
            self._shape_of[model.geom(name).id] = k
        self._body_of, self._root_of = np.array(model.geom_bodyid), np.array(model.body_rootid)
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        count = self._count
        self._steps: list[_Step] = []
        self._marks: list[_Mark] = []
        self._number = 0
        self._force, self._normal, self._impulse = np.zeros((count, 3)), np.zeros(count), np.zeros((count, 3))
        self._peak, self._began = np.zeros(count), np.full(count, np.inf)

    def step(self, data: Any, number: int) -> None:
        """Write down the contacts of a step, which ends at ``data.time`` and has some."""
        contact = data.contact
        self._steps.append(
            _Step(
                number, data.time, contact.geom.copy(), contact.dim.copy(), contact.efc_address.copy(),
                contact.frame.copy(), data.efc_force.copy(),
            )
        )  # fmt: skip

    def fold(self, number: int) -> None:
        """Evaluate the steps until now if they are many and no state waits for a look."""
        if len(self._steps) >= _MOST and not self._marks:
            self._marks.append(_bare(number))
            found = self.look()
            self._peak, self._began = found.peak[0], np.where(np.isnan(found.began[0]), np.inf, found.began[0])

    def mark(self, data: Any, number: int) -> None:
        """Let the state after a step be one to look at."""
        if not data.ncon:
            self._marks.append(_bare(number))
            return
        contact = data.contact
        self._marks.append(
            _Mark(
                number, contact.geom.copy(), contact.pos.copy(), contact.frame[:, :3].copy(), data.cvel.copy(),
                data.subtree_com.copy(),
            )
        )  # fmt: skip

    def forces(self, count: int, shape: int) -> list[list[float]]:
        """Return the forces on a shape in the last ``count`` steps with contact, N, shape (count, 3)."""
        found: list[list[float]] = self._evaluated(self._steps[-count:])[0][:, shape].tolist()
        return found

    def look(self) -> ContactTrace:
        """Return the contacts at all marks, and begin again."""
        steps, ends, count = self._steps, np.array([mark.number for mark in self._marks]), self._count
        n = ends.size
        # What was there at the last look is still there where no step has been taken since.
        unmoved = ends == self._number
        force, normal = self._force * unmoved[:, None, None], self._normal * unmoved[:, None]
        impulse, peak, began = np.zeros((n, count, 3)), np.zeros((n, count)), np.full((n, count), np.inf)
        peak[0], began[0] = self._peak, self._began
        if steps:
            forces, normals = self._evaluated(steps)
            numbers, times = np.array([s.number for s in steps]), np.array([s.time for s in steps])
            into = np.searchsorted(ends, numbers)
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
        self._steps, self._marks = [], []
        return ContactTrace(normal > 0, force, impulse, peak, np.where(np.isinf(began), np.nan, began), slip)

    def _evaluated(self, steps: list[_Step]) -> tuple[Array, Array]:
        """Return forces, shape (steps, shapes, 3), and sums of normal forces, shape (steps, shapes)."""
        counts, sizes = [s.sizes.size for s in steps], np.concatenate([s.sizes for s in steps])
        starts = np.cumsum([0, *(s.forces.size for s in steps[:-1])])
        first, at = np.concatenate([s.rows for s in steps]), np.repeat(np.arange(len(steps)), counts)
        geoms, frames = np.concatenate([s.geoms for s in steps]), np.concatenate([s.frames for s in steps])
        # A contact just outside the surface does not push and has no address.
        there = first >= 0
        first = (first + np.repeat(starts, counts))[there]
        at, geoms, sizes, frames = at[there], geoms[there], sizes[there], frames[there].reshape(-1, 3, 3)
        # A contact has one number without friction, else three.
        rough = (sizes == 3)[:, None]
        local = np.concatenate([s.forces for s in steps])[first[:, None] + _ROWS * rough] * (rough | _FIRST)
        one, other = self._shape_of[geoms].T
        shape, sign = np.maximum(one, other), np.where(other >= 0, 1.0, -1.0)
        forces, normals = np.zeros((len(steps), self._count, 3)), np.zeros((len(steps), self._count))
        # The rows of a contact frame are its axes, the normal first.
        np.add.at(forces, (at, shape), sign[:, None] * (local[:, None, :] @ frames)[:, 0])
        np.add.at(normals, (at, shape), local[:, 0])
        return forces, normals

    def _slips(self) -> Array:
        """Return the largest tangential speed of the contact points of each shape at all marks, shape (n, shapes)."""
        slips = np.zeros((len(self._marks), self._count))
        there = [(k, mark) for k, mark in enumerate(self._marks) if mark.geoms.size]
        if not there:
            return slips
        geoms, normals = (np.concatenate([getattr(m, name) for _, m in there]) for name in ("geoms", "normals"))
        at = np.repeat(np.arange(len(there)), [len(m.geoms) for _, m in there])
        bodies, other = self._body_of[geoms[:, 1]], self._shape_of[geoms[:, 1]]
        twists = np.array([m.twists for _, m in there])[at, bodies]
        centers = np.array([m.centers for _, m in there])[at, self._root_of[bodies]]
        arms, spins = np.concatenate([m.points for _, m in there]) - centers, twists[:, :3]
        velocities = twists[:, 3:] + spins[:, _NEXT] * arms[:, _LAST] - spins[:, _LAST] * arms[:, _NEXT]
        velocities -= (normals * velocities).sum(axis=1, keepdims=True) * normals
        # A ball is no place to slide on.
        ground = (self._body_of[geoms[:, 0]] == 0) & (other >= 0)
        speeds = np.sqrt((velocities * velocities).sum(axis=1))[ground]
        np.maximum.at(slips, (np.array([k for k, _ in there])[at[ground]], other[ground]), speeds)
        return slips


_NOTHING = np.zeros((0, 2), dtype=int)


def _bare(number: int) -> _Mark:
    """Return a mark without contacts."""
    return _Mark(number, _NOTHING, _NOTHING, _NOTHING, _NOTHING, _NOTHING)
