"""The joints and links of a tree in the axes of their root link, where what lies beyond a joint just adds up."""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca
import numpy as np

from impact_posture.arrays import Array
from impact_posture.dynamics.kinematics import ByJoint, Kinematics

# Families of joints with one degree of freedom, whose coordinate in the chart changes at their velocity.
_ONE_AXIS = ("revolute", "continuous", "prismatic")


class RootAxes:
    """The tree at one symbolic configuration, in the axes of its root links.

    Args:
        tree: The tree.
    """

    def __init__(self, tree: Kinematics) -> None:
        self._tree = tree
        self._parents = [int(parent) for parent in tree.model.parents]
        slots = tree.chart.slots
        self._beyond = [slot for slot in slots if self._parents[slot.index]]
        # Joints of the degrees of freedom and of the columns of a motion.
        self._of_v = [slot.index for slot in slots for _ in range(slot.kind.nv)]
        self._of_u = [slot.index for slot in self._beyond]

    @property
    def exist(self) -> bool:
        """Whether all joints but those of root links have one degree of freedom."""
        return all(slot.kind.family in _ONE_AXIS for slot in self._beyond)

    def _lies_on(self, ends: Sequence[int], joints: Sequence[int], *, itself: bool = True) -> Array:
        """Return whether each of the ``joints`` (columns) is on the path from a root to each of the ends (rows)."""
        paths = {end: {int(i) for i in self._tree.model.supports[end]} - (set() if itself else {end}) for end in ends}
        return np.array([[joint in paths[end] for joint in joints] for end in ends], dtype=bool)

    @property
    def _places(self) -> dict[int, tuple[ca.SX, ca.SX]]:
        """Rotation and origin of every link."""
        return self._tree.root_places

    @property
    def _subspaces(self) -> ca.SX:
        """Motion subspaces of all joints, shape (6, nv)."""
        return self._tree.root_subspaces

    def _gathered(self, of_links: ByJoint) -> ByJoint:
        """Return sums over the subtrees of all joints."""
        found = dict(of_links)
        for i in sorted(found, reverse=True):
            if parent := self._parents[i]:
                found[parent] = found[parent] + found[i]
        return found


def kept(matrix: ca.SX, pattern: Array) -> ca.SX:
    """Return a matrix without the entries outside a pattern."""
    return matrix * ca.sparsify(ca.SX(pattern.astype(float)))
