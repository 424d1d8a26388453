"""Bodies in each other's hollows: they are cut into parts until the hulls of the parts leave them room."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import NamedTuple

import pinocchio as pin

from impact_posture.arrays import Array
from impact_posture.collision.hull_fit import fit_hull
from impact_posture.collision.pairs import Hindrance, Pair
from impact_posture.collision.parts import TOLERANCE, best_cut, depth
from impact_posture.collision.swept_hull import SweptHull, separation

# A body gets so many parts at most.
_MOST_PARTS = 8
# Bodies are cut until their hulls forbid less than this share of the postures that the shapes allow.
_GOAL = 0.25
# A cut is made if it leaves less than this share of the depth, measured at so many placements.
_LEFT = 0.98
_TRIED = 10


class Opened(NamedTuple):
    """Bodies with their hollows open.

    Attributes:
        parts: Hulls of each body: those of its parts, or its own.
        hindered: Pairs of bodies, by their indices, that are still in each other's hollows.
    """

    parts: list[list[SweptHull]]
    hindered: set[Pair]


@dataclass(frozen=True, eq=False)
class _Part:
    """Triangles of a part in the axes of the joint, shape (n, 3, 3), m, and their hull."""

    triangles: Array
    hull: SweptHull


# The placements, by their indices, at which the hulls of two parts touch.
_Touching = dict[tuple[_Part, _Part], list[int]]


def open_hollows(
    bodies: Sequence[SweptHull], hollows: Mapping[Pair, Hindrance], triangles: Callable[[int], Array]
) -> Opened:
    """Cut bodies until their hulls allow most of the postures that their shapes allow.

    A cut is made where it lets the two bodies least deep into each other.  Two bodies stay as they are if 8 parts of
    each are not enough, as for a shaft that fills its bore.

    Args:
        bodies: The swept hulls.
        hollows: The pairs of bodies in each other's hollows.
        triangles: The triangles around a body, by its index, in the axes of its joint, shape (n, 3, 3), m.
    """
    parts = {k: [_Part(triangles(k), bodies[k])] for k in sorted({k for pair in hollows for k in pair})}
    hindered = set()
    for pair, hindrance in hollows.items():
        before = {k: parts[k] for k in pair}
        while (count := _count(touching := _touching(parts, pair, hindrance))) > _GOAL * hindrance.free:
            if not _cut(parts, pair, touching, hindrance):
                break
        if hindrance.by(count):
            parts.update(before)
            hindered.add(pair)
    hulls = [
        _named(hull.name, [part.hull for part in parts[k]]) if k in parts else [hull] for k, hull in enumerate(bodies)
    ]
    return Opened(hulls, hindered)


def _cut(parts: dict[int, list[_Part]], pair: Pair, touching: _Touching, hindrance: Hindrance) -> bool:
    """Cut one part of two bodies, of those that touch most if that helps; tell whether any cut helps."""
    for (a, b), indices in sorted(touching.items(), key=lambda item: -len(item[1])):
        some = indices[:: -(-len(indices) // _TRIED) or 1]
        placements = [hindrance.placements[n] for n in some]
        inverses = [placement.inverse() for placement in placements]
        cuts = [
            (best_cut(part.triangles, other.hull, at), k, part)
            for k, part, other, at in ((pair[0], a, b, placements), (pair[1], b, a, inverses))
            if len(parts[k]) < _MOST_PARTS
        ]
        if cuts:
            cut, k, part = min(cuts, key=lambda found: found[0].depth)
            if cut.depth < _LEFT * depth([a.hull], b.hull, placements):
                sides = [_Part(side, _fitted(side, part.hull)) for side in cut.sides]
                parts[k] = [*(other for other in parts[k] if other is not part), *sides]
                return True
    return False


def _fitted(triangles: Array, whole: SweptHull) -> SweptHull:
    fit = fit_hull(triangles.reshape(-1, 3), TOLERANCE)
    return replace(whole, vertices=fit.vertices, radius=fit.radius)


def _touching(parts: Mapping[int, list[_Part]], pair: Pair, hindrance: Hindrance) -> _Touching:
    here = pin.SE3.Identity()
    return {
        (a, b): [n for n, at in enumerate(hindrance.placements) if separation(a.hull, here, b.hull, at).distance <= 0]
        for a, b in product(parts[pair[0]], parts[pair[1]])
    }


def _count(touching: _Touching) -> int:
    """Return the number of placements at which any hulls touch."""
    return len({n for indices in touching.values() for n in indices})


def _named(name: str, parts: list[SweptHull]) -> list[SweptHull]:
    """Give each of several parts of a body a name of its own: that of the body, with ``/1`` and so on."""
    return [replace(part, name=f"{name}/{n}") for n, part in enumerate(parts, 1)] if len(parts) > 1 else parts
