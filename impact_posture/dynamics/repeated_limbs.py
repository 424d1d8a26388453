"""Repeated limbs: limbs of a robot with the same joints, for example the two legs of a humanoid.

The expressions of repeated limbs differ only in constants.  If parameters replace these constants, the same
instructions compute all limbs.  A processor then computes several limbs at once, one per SIMD lane.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass

import casadi as ca
import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray

from impact_posture.dynamics.joints import joint_kind
from impact_posture.dynamics.spatial import constant, rounded
from impact_posture.robot.model_joints import finite_armature

# A constant that is zero in only one of two limbs costs operations in both limbs.  Limbs are treated as repeated only
# if this increases their number of nonzero constants at most by this factor.
_FILL = 1.25
# Numbers of SIMD lanes, in order of preference.
_WIDTHS = (4, 2)


@dataclass(frozen=True)
class Place:
    """Position of a joint in repeated limbs.  Numbers start at zero.

    Attributes:
        group: Number of the group of limbs that repeat each other.
        lane: Number of the limb in the group, which is its SIMD lane.
        position: Number of the joint in the limb.
    """

    group: int
    lane: int
    position: int


class RepeatedLimbs:
    """The repeated limbs of a model, and parameters for the constants in which they differ.

    Attributes:
        groups: Groups of limbs; each limb is a tuple of joint indices, in the same order for all limbs of a group.
        places: Joint index → :class:`Place`, for joints in repeated limbs.
        parameters: (group, lane, name) → symbol and value of a parameter.  The name is the same for all lanes.
    """

    def __init__(self, model: pin.Model, coupled: Collection[str] = ()) -> None:
        # Limbs with one of the joints ``coupled`` differ from the other limbs of their group.
        groups = _groups(model)
        self.groups = tuple(g for g in groups if not any(model.names[k] in coupled for limb in g for k in limb))
        self.places = {
            joint: Place(g, lane, position)
            for g, limbs in enumerate(self.groups)
            for lane, limb in enumerate(limbs)
            for position, joint in enumerate(limb)
        }
        self.parameters: dict[tuple[int, int, str], tuple[ca.SX, float]] = {}

    def counterparts(self, joint: int) -> list[int]:
        """Return the joints at the same position in all limbs of the group; only ``joint`` if it is in no limb."""
        place = self.places.get(joint)
        return [joint] if place is None else [limb[place.position] for limb in self.groups[place.group]]

    def constant(self, joint: int, tag: str, of: Callable[[int], ArrayLike]) -> ca.SX:
        """Return ``of(joint)`` as an expression.

        An entry becomes a parameter if it differs between the limbs of the group.  ``of`` returns a vector or a
        matrix; a symmetric matrix stays symmetric.  ``tag`` names the kind of constant.
        """
        place = self.places.get(joint)
        if place is None:
            return constant(of(joint))
        dense = [(lane := rounded(of(other))).reshape(len(lane), -1) for other in self.counterparts(joint)]
        numbers = dense[place.lane]
        symmetric = numbers.shape[0] == numbers.shape[1] and all(np.array_equal(d, d.T) for d in dense)
        expression = ca.SX(*numbers.shape)
        for i, j in np.ndindex(numbers.shape):
            entries = [d[i, j] for d in dense]
            if len(set(entries)) > 1:
                row, column = (min(i, j), max(i, j)) if symmetric else (i, j)
                # The name includes the values, because the same tag may be used with different values.
                name = f"{place.position}.{tag}.{row}.{column}.{entries}"
                expression[i, j] = self._parameter(place, name, float(numbers[i, j]))
            elif entries[0] != 0.0:
                expression[i, j] = entries[0]
        return expression

    def indicator(self, joint: int, of: int) -> ca.SX:
        """Return a parameter that is one for the limb of the joint ``of``, and zero for other limbs of the group."""
        place = self.places[of]
        return self._parameter(self.places[joint], f"{place.position}.on.{place.lane}", float(joint == of))

    def _parameter(self, place: Place, name: str, value: float) -> ca.SX:
        key = (place.group, place.lane, name)
        if key not in self.parameters:
            self.parameters[key] = ca.SX.sym(f"c{len(self.parameters)}"), value
        return self.parameters[key][0]


def _groups(model: pin.Model) -> tuple[tuple[tuple[int, ...], ...], ...]:
    """Return the groups of repeated limbs.  A limb is a whole subtree."""
    groups: list[tuple[tuple[int, ...], ...]] = []
    waiting = [0]
    while waiting:
        children = [int(c) for c in model.children[waiting.pop(0)]]
        taken: set[int] = set()
        for child in children:
            if child in taken:
                continue
            limb = _limb(model, child)
            others = [c for c in children if c > child and c not in taken and _alike(model, limb, _limb(model, c))]
            alike = [child, *others]
            for width in _WIDTHS:
                while len(alike) >= width:
                    groups.append(tuple(_limb(model, c) for c in alike[:width]))
                    taken.update(alike[:width])
                    alike = alike[width:]
        waiting += [c for c in children if c not in taken]
    return tuple(groups)


def _limb(model: pin.Model, root: int) -> tuple[int, ...]:
    """Return the indices of the joints of a subtree in depth-first order."""
    return (root, *[joint for child in model.children[root] for joint in _limb(model, int(child))])


def _alike(model: pin.Model, first: tuple[int, ...], second: tuple[int, ...]) -> bool:
    """Return whether two limbs have equal joint types, and nearly the same zeros in placements and inertias."""
    if _joints(model, first) != _joints(model, second):
        return False
    pairs = [[_numbers(model, k) != 0.0 for k in pair] for pair in zip(first, second, strict=True)]
    return all(np.count_nonzero(a | b) <= _FILL * max(map(np.count_nonzero, (a, b))) for a, b in pairs)


def _joints(model: pin.Model, limb: tuple[int, ...]) -> list[tuple[object, ...]]:
    """Return for each joint of a limb: family, axis, whether it is locked, and position of the parent joint."""
    kinds, locked = [joint_kind(model.joints[k], str(model.names[k])) for k in limb], finite_armature(model)[1]
    parents = [-1, *[limb.index(int(model.parents[k])) for k in limb[1:]]]
    return [
        (kind.family, *kind.axis, locked[model.idx_vs[k]], parent)
        for k, kind, parent in zip(limb, kinds, parents, strict=True)
    ]


def _numbers(model: pin.Model, joint: int) -> NDArray[np.float64]:
    placement = model.jointPlacements[joint]
    arrays = (placement.rotation, placement.translation, model.inertias[joint].matrix())
    return np.concatenate([rounded(a).ravel() for a in arrays])
