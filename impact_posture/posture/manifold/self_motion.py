"""The self-motion manifold of a problem with one or two free degrees of freedom, mapped by continuation.

During a self-motion, the robot moves and all equalities stay satisfied (J. W. Burdick, "On the inverse kinematics of
redundant manipulators: characterization of the self-motion manifolds", ICRA 1989).  The robot cannot move from one
component of the manifold to another within the joint limits.  With one degree of freedom, components are curves; with
two, surfaces.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from impact_posture.errors import InputError
from impact_posture.posture.manifold.constraint_manifold import ConstraintManifold
from impact_posture.system.arrays import Array

# First and longest step along a curve, rad or m.
_FIRST, LONGEST_STEP = 0.02, 0.08
# A curve is treated as singular if it needs a step shorter than this value, rad or m.
_SINGULAR = 1e-7
# Least cosine of the angle by which the tangent of a curve turns in one step.
_TURN = 0.98
# If the cosine of this angle is above this value, the next step is longer.
_STRAIGHT = 0.995
# A posture belongs to a node only if its distance from the tangent space of the node is at most this fraction of its
# distance from the node.
_FLAT = 0.2
# Each point of a curve is closer to a node than this fraction of a step.  On a straight line, half a step would
# suffice.  Where the curve bends, points between two nodes are slightly farther away.
_HALF = 0.52
# Maximum number of nodes of a curve or surface.
_NODES = 20_000
# Length of a step on a surface, rad or m.
_STEP = 0.16
# Least distance between the nodes of a surface, as a fraction of the step.
_APART = 0.7
# Number of directions in which steps from a node of a surface are tried.
_DIRECTIONS = 8
# Radius that a node of a surface covers, as a fraction of the step.  The direction to any point one step away differs
# from a tried direction by at most half the angle between tried directions.  This angle bounds the distance to a
# tried point.  The distance from a tried point to a node is at most ``_APART``.  The radius is the sum of these two
# distances.
COVERED = _APART + 2 * np.sin(np.pi / _DIRECTIONS / 2)
_BATCH = 100


@dataclass(frozen=True, eq=False)
class Component:
    """One connected piece of the self-motion manifold.

    Attributes:
        x: Nodes in chart coordinates, shape (N, nx); the nodes of a curve are in their order along the curve.
        s: Path length to each node, rad mixed with m, shape (N,); zeros for a surface.
        radius: Radius of the neighborhood that each node covers, shape (N,).
        ends: How each end of the curve was reached: ``limit``, ``singular`` or ``unfinished`` (too many nodes).  A
            closed curve has the only entry ``closed``, and a surface has no entry.
    """

    x: Array
    s: Array
    radius: Array
    ends: tuple[str, ...]

    @property
    def closed(self) -> bool:
        """Whether the component is a closed curve."""
        return self.ends == ("closed",)


@dataclass(frozen=True, eq=False)
class SelfMotion:
    """The mapped self-motion manifold of dimension one or two, with all components that a start reached.

    ``starts`` is the number of random postures that reached the manifold within the limits.  The last
    ``unsuccessful`` starts did not reach a new component.
    """

    manifold: ConstraintManifold
    dimension: int
    components: tuple[Component, ...]
    starts: int
    unsuccessful: int

    def component_of(self, x: Array) -> Array:
        """Return the index of the component that contains each posture, shape (N,); −1 if no component does."""
        return _component_of(self.manifold, self.dimension, self.components, x)


def map_self_motion(
    manifold: ConstraintManifold, dimension: int, known: Array, *, patience: int = 1000, seed: int = 0
) -> SelfMotion:
    """Map the components that random starts reach, until ``patience`` starts in a row reach no new component.

    The components that contain the postures ``known``, shape (N, nx), are mapped first.

    Raises:
        InputError: The number of free degrees of freedom is neither one nor two.
    """
    if dimension not in (1, 2):
        fault = f"{dimension} degrees of freedom are left"
        raise InputError(fault, where="search", hint="add constraints until 1 or 2 degrees of freedom are left")
    rng, components = np.random.default_rng(seed), _missing(manifold, dimension, (), known)
    starts = unsuccessful = idle = 0
    # Also stop if less than about a tenth of the random postures reach the manifold, because then almost no part of
    # the manifold is within the limits.
    while unsuccessful < patience and idle < 10 * patience:
        x = _random(manifold, rng)
        new = _missing(manifold, dimension, components, x)
        components += new
        starts += len(x)
        idle = 0 if len(x) else idle + _BATCH
        unsuccessful = 0 if new else unsuccessful + len(x)
    return SelfMotion(manifold, dimension, tuple(components), starts, unsuccessful)


def component_through(manifold: ConstraintManifold, x: Array) -> SelfMotion:
    """Map the curve through the posture ``x``, shape (nx,), on a manifold with one degree of freedom."""
    return SelfMotion(manifold, 1, (_curve(manifold, x),), 0, 0)


def _random(manifold: ConstraintManifold, rng: np.random.Generator) -> Array:
    """Return random postures on the manifold and within the joint limits; inequalities are ignored."""
    projected = manifold.project(manifold.draw(rng, _BATCH, manifold.problem.given), within=True)
    return projected.x[projected.converged]


def _missing(manifold: ConstraintManifold, dimension: int, known: Sequence[Component], x: Array) -> list[Component]:
    """Map and return the components that contain one of the postures ``x`` and are not yet known."""
    new: list[Component] = []
    left = x[_component_of(manifold, dimension, known, x) < 0]
    while len(left):
        new.append(_curve(manifold, left[0]) if dimension == 1 else _surface(manifold, left[0]))
        rest = left[1:]
        left = rest[_component_of(manifold, dimension, new[-1:], rest) < 0]
    return new


def _component_of(manifold: ConstraintManifold, dimension: int, components: Sequence[Component], x: Array) -> Array:
    """Return the index of the component that contains each posture, shape (N,); −1 if no component does."""
    from scipy.spatial import cKDTree

    owner = np.full(len(x), -1)
    points = manifold.embed(x)
    for index, component in enumerate(components):
        nodes = manifold.embed(component.x)
        near = min(8, len(nodes))
        distances, places = cKDTree(nodes).query(points, near)
        for distance, place in zip(distances.reshape(-1, near).T, places.reshape(-1, near).T, strict=True):
            chosen = np.flatnonzero((owner < 0) & (distance <= 1.1 * component.radius[place] + 1e-6))
            if not chosen.size:
                continue
            basis = manifold.tangents(component.x[place[chosen]], dimension)
            step = points[chosen] - nodes[place[chosen]]
            along = _embedded(manifold, component.x[place[chosen]], basis)
            share = np.einsum("nk,ndk->nd", step, along)
            off = np.linalg.norm(step - np.einsum("nd,ndk->nk", share, along), axis=1)
            owner[chosen[off <= _FLAT * distance[chosen] + 1e-6]] = index
    return owner


def _embedded(manifold: ConstraintManifold, x: Array, basis: Array) -> Array:
    """Return the directions of the embedded points for motions along the vectors of a basis, shape (N, d, k)."""
    size = 1e-6
    here = manifold.embed(x)
    moved = [(manifold.embed(manifold.move(x, size * v)) - here) / size for v in basis.transpose(1, 0, 2)]
    directions = np.stack(moved, axis=1)
    return np.asarray(directions / np.linalg.norm(directions, axis=2, keepdims=True))


def _curve(manifold: ConstraintManifold, x: Array) -> Component:
    tangent = manifold.tangents(x[None], 1)[0, 0]
    nodes, lengths, end = _branch(manifold, x, tangent)
    ends = [end]
    if end != "closed":
        back, steps, end = _branch(manifold, x, -tangent)
        nodes, lengths, ends = [*back[:0:-1], *nodes], [*steps[::-1], *lengths], [end, *ends]
    taken = np.array([0.0, *lengths])
    reach = _HALF * np.maximum(taken, np.append(taken[1:], 0.0))
    return Component(np.array(nodes), np.cumsum(taken), reach, tuple(ends))


def _branch(manifold: ConstraintManifold, start: Array, tangent: Array) -> tuple[list[Array], list[float], str]:
    """Follow a curve in one direction by predictor and corrector.

    Return the nodes in order from ``start``, the lengths of the steps, and how the curve ends.
    """
    nodes, x, direction, step = [start], start, tangent, _FIRST
    lengths: list[float] = []
    home, first = manifold.embed(start[None])[0], tangent
    while len(nodes) < _NODES:
        moved = manifold.project(manifold.move(x[None], step * direction[None]), steps=6)
        ahead = manifold.tangents(moved.x, 1)[0, 0]
        ahead = ahead * (1.0 if ahead @ direction >= 0 else -1.0)
        point = manifold.embed(np.array([x, moved.x[0]]))
        length, turn = float(np.linalg.norm(point[1] - point[0])), float(ahead @ direction)
        if not (moved.converged[0] and turn > _TURN and 0.7 * step < length < 1.3 * step):
            step /= 2
            if step < _SINGULAR:
                return nodes, lengths, "singular"
            continue
        beyond = np.maximum(manifold.lower - moved.x[0], moved.x[0] - manifold.upper).max(initial=-np.inf)
        if beyond > 1e-9:
            # If a step crosses a limit, halve the step until it ends close to the limit.
            if step < 10 * _SINGULAR:
                return nodes, lengths, "limit"
            step /= 2
            continue
        # The curve is closed if the start lies between the last two nodes, ahead of the first and behind the second.
        gap = home - point[0]
        if len(nodes) > 2 and np.linalg.norm(gap) <= 1.05 * length and ahead @ first > _TURN**2:
            behind = (point[1] - point[0]) @ (home - point[1]) <= 0
            if (point[1] - point[0]) @ gap > 0 and behind:
                return [*nodes, start], [*lengths, float(np.linalg.norm(gap))], "closed"
        nodes.append(moved.x[0])
        lengths.append(length)
        x, direction = moved.x[0], ahead
        step = min(step * (1.5 if turn > _STRAIGHT else 1.0), LONGEST_STEP)
    return nodes, lengths, "unfinished"


def _surface(manifold: ConstraintManifold, x: Array) -> Component:
    """Cover the surface through a posture with nodes, by an advancing front.

    From each node, points one step away are tried in all directions of its tangent plane.  A point that is far from
    all nodes becomes a node.  Nodes less than a step beyond the limits are included, so that the nodes cover the
    surface up to the limits.  The front does not continue from nodes beyond the limits.
    """
    from scipy.spatial import cKDTree

    angles = 2 * np.pi * np.arange(_DIRECTIONS) / _DIRECTIONS
    directions = _STEP * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    nodes, front = x[None], x[None]
    while len(front) and len(nodes) < _NODES:
        steps = np.einsum("kd,ndv->nkv", directions, manifold.tangents(front, 2)).reshape(-1, manifold.chart.nv)
        before = np.repeat(front, _DIRECTIONS, axis=0)
        tried = manifold.project(manifold.move(before, steps), steps=6)
        length = np.linalg.norm(manifold.embed(tried.x) - manifold.embed(before), axis=1)
        tried_x = tried.x[tried.converged & (length < 1.5 * _STEP)]
        outside = np.maximum(manifold.lower - tried_x, tried_x - manifold.upper).max(axis=1, initial=-np.inf)
        tried_x, outside = tried_x[outside < _STEP], outside[outside < _STEP]
        points = manifold.embed(tried_x)
        far = cKDTree(manifold.embed(nodes)).query(points, 1)[0] > _APART * _STEP if len(points) else np.zeros(0)
        chosen: list[int] = []
        for k in np.flatnonzero(far):
            if not chosen or np.linalg.norm(points[chosen] - points[k], axis=1).min() > _APART * _STEP:
                chosen.append(int(k))
        nodes = np.concatenate([nodes, tried_x[chosen]])
        front = tried_x[chosen][outside[chosen] <= 1e-9]
    return Component(nodes, np.zeros(len(nodes)), np.full(len(nodes), COVERED * _STEP), ())
