"""Branches of a robot that have the same joints: the two legs of a humanoid, the four of a quadruped.

Their expressions differ in constants only.  With those constants as parameters, equal for every lane in name and
different in value, the dynamics of all twins are the same instructions, which a processor can do at once.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import casadi as ca
import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray

from impact_posture.dynamics.joints import joint_kind
from impact_posture.dynamics.spatial import constant

# A lane whose constants have zeros that another lacks computes with them: so much is worth it.
_FILL = 1.25
_WIDTHS = (4, 2)


@dataclass(frozen=True)
class Place:
    """Where a joint stands among its twins.

    Attributes:
        group: Number of the group of branches.
        lane: Which branch of it.
        position: Which joint of the branch, the same for its twins.
    """

    group: int
    lane: int
    position: int


class RepeatedLimbs:
    """The twin branches of a model, and the parameters that stand for what they differ in.

    Attributes:
        groups: For each group, its branches; for each branch its joints, twins at equal positions.
        places: Joint index → where it stands; joints without a twin are missing.
        parameters: Symbols that have been handed out, in order.
        values: Their values.
        keys: For each, its group, lane and a name that it shares with its twins.
    """

    def __init__(self, model: pin.Model) -> None:
        self.groups = _groups(model)
        self.places = {
            joint: Place(g, lane, position)
            for g, branches in enumerate(self.groups)
            for lane, branch in enumerate(branches)
            for position, joint in enumerate(branch)
        }
        self.parameters: list[ca.SX] = []
        self.values: list[float] = []
        self.keys: list[tuple[int, int, str]] = []
        self._known: dict[tuple[int, int, str], ca.SX] = {}

    def of(self, joint: int) -> list[int]:
        """The joint's twins in the order of their lanes, itself among them; the joint alone where it has none."""
        place = self.places.get(joint)
        return [joint] if place is None else [branch[place.position] for branch in self.groups[place.group]]

    def constant(self, joint: int, tag: str, of: Callable[[int], ArrayLike]) -> ca.SX:
        """``of(joint)`` as an expression: parameters where its twins differ, numbers elsewhere.

        Args:
            joint: The joint.
            tag: What it is, one name for each kind of constant.
            of: The numbers of a joint: a vector, or a matrix (symmetric ones stay symmetric).
        """
        lanes = [constant(of(twin)) for twin in self.of(joint)]
        place = self.places.get(joint)
        if place is None:
            return lanes[0]
        dense = [np.array(ca.DM(ca.densify(lane))) for lane in lanes]
        own = dense[place.lane]
        symmetric = own.shape[0] == own.shape[1] and all(np.array_equal(d, d.T) for d in dense)
        found = ca.SX(*own.shape)
        for i in range(own.shape[0]):
            for j in range(own.shape[1]):
                entries = [d[i, j] for d in dense]
                if len(set(entries)) > 1:
                    row, column = (min(i, j), max(i, j)) if symmetric else (i, j)
                    # With all values: another kernel's constants of the same kind may be others.
                    name = f"{place.position}.{tag}.{row}.{column}.{entries}"
                    found[i, j] = self._parameter(place, name, float(own[i, j]))
                elif entries[0] != 0.0:
                    found[i, j] = entries[0]
        return found

    def indicator(self, joint: int, of: int) -> ca.SX:
        """One for the joint ``of`` and zero for its twins: what makes their expressions alike."""
        place = self.places[of]
        return self._parameter(self.places[joint], f"{place.position}.on.{place.lane}", float(joint == of))

    def _parameter(self, place: Place, name: str, value: float) -> ca.SX:
        key = (place.group, place.lane, name)
        if key not in self._known:
            self._known[key] = ca.SX.sym(f"c{len(self.values)}")
            self.parameters.append(self._known[key])
            self.values.append(value)
            self.keys.append(key)
        return self._known[key]


def _groups(model: pin.Model) -> tuple[tuple[tuple[int, ...], ...], ...]:
    """Outermost twins first: what hangs from a twin branch is part of it."""
    found: list[tuple[tuple[int, ...], ...]] = []
    waiting = [0]
    while waiting:
        joint = waiting.pop(0)
        taken: set[int] = set()
        children = [int(c) for c in model.children[joint]]
        for child in children:
            if child in taken:
                continue
            alike = [child]
            branch = _branch(model, child)
            for other in children:
                if other > child and other not in taken and _alike(model, branch, _branch(model, other)):
                    alike.append(other)
            for width in _WIDTHS:
                while len(alike) >= width:
                    found.append(tuple(_branch(model, c) for c in alike[:width]))
                    taken.update(alike[:width])
                    alike = alike[width:]
        waiting += [c for c in children if c not in taken]
    return tuple(found)


def _branch(model: pin.Model, root: int) -> tuple[int, ...]:
    """The joints of a subtree, depth first."""
    return (root, *[joint for child in model.children[root] for joint in _branch(model, int(child))])


def _alike(model: pin.Model, one: tuple[int, ...], other: tuple[int, ...]) -> bool:
    if len(one) != len(other):
        return False
    for i, j in zip(one, other, strict=True):
        kinds = [joint_kind(model.joints[k], str(model.names[k])) for k in (i, j)]
        if kinds[0].family != kinds[1].family or not np.array_equal(kinds[0].axis, kinds[1].axis):
            return False
        parents = [b.index(int(model.parents[k])) if k != b[0] else -1 for k, b in ((i, one), (j, other))]
        if parents[0] != parents[1]:
            return False
        numbers = [_numbers(model, k) != 0.0 for k in (i, j)]
        if np.count_nonzero(numbers[0] | numbers[1]) > _FILL * max(np.count_nonzero(n) for n in numbers):
            return False
    return True


def _numbers(model: pin.Model, joint: int) -> NDArray[np.float64]:
    placement = model.jointPlacements[joint]
    arrays = (placement.rotation, placement.translation, model.inertias[joint].matrix())
    return np.concatenate([np.array(ca.DM(ca.densify(constant(a)))).ravel() for a in arrays])
