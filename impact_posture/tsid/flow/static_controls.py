"""Controls that hold a posture at rest, as shares of the actuators' limits; support polygon of the feet."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import numpy as np

from impact_posture.errors import InputError
from impact_posture.robot.support_polygon import polygon_edges
from impact_posture.system.arrays import Array
from impact_posture.tsid.actuators import Actuators
from impact_posture.tsid.state import State
from impact_posture.tsid.support_contact import SupportContact

# Weight of a moment (N·m), relative to a force (N), in the norm of contact wrenches.
MOMENT = 100.0
# Accelerations may use at least this fraction of the half range of a control, even if the static controls leave less.
LEFT = 0.1
# Each of n soles carries at least this fraction of the weight, divided by n.
EVEN = 0.6
# If the direction of an edge is within this angle of −π, rad, the edge is sorted as if its direction were +π.
_START = 1e-8
# This fraction of the trace is added to the diagonal of the equations of the contact wrenches.  With this term, the
# equations are solvable even if the feet cannot carry every wrench on the base.
TINY = 1e-12


class StaticControls:
    """Static controls ``u = G⁺(h − Jᵀf)``, measured from the middle of the control ranges.

    The value ±1 means that a control uses the permitted share of its limits.  Many contact wrenches ``f`` can carry
    the base; the class uses the wrenches with the least weighted norm.  Redundant rotors share the load evenly.

    Attributes:
        limited: Controls that have limits, shape (m,).
    """

    def __init__(self, actuators: Actuators, contacts: Sequence[SupportContact], share: float) -> None:
        """Set ``share``, the share of the limits that the static controls may use, 0 to 1."""
        base = actuators.base
        self.limited = np.flatnonzero(np.isfinite(actuators.upper) & np.isfinite(actuators.lower))
        lower, upper = actuators.lower[self.limited], actuators.upper[self.limited]
        self._middle, self._half = (upper + lower) / 2, share * (upper - lower) / 2
        # Half of the full control range, and the least range that accelerations may use.  The unit of ``_whole`` and
        # ``_least`` is half of the range that the static controls may use.
        self._whole, self._least = 1.0 / share, LEFT / share
        wrench = np.array([1.0] * 3 + [MOMENT] * 3)
        self._ease = 1.0 / np.concatenate([np.zeros(0), *(wrench[: c.size] for c in contacts)])
        self._count, self._base = self._ease.size, base
        # Matrix that maps a generalized force, without the part that contacts produce, to the controls.
        self._inverse = np.linalg.pinv(actuators.G, rcond=1e-9)[self.limited] / self._half[:, None]
        # Generalized forces of the contacts per unit wrench on the base, shape (nv, base).
        self._carried = np.zeros((actuators.G.shape[0], base))
        if contacts:
            # Imported here, because the import of SciPy is slow.  For six unknowns, NumPy needs three times as long
            # as this SciPy function.
            from scipy.linalg.lapack import dposv

            self._solve = dposv
        self._central, self._pair = self._middle / self._half, np.zeros((actuators.G.shape[0], 2))

    def shares(self, state: State, J: Array) -> Array:
        """Return the static controls at a state with ``ν = 0``, shape (m,).

        The actuators can hold the posture if all entries are within ±1.  The first rows of ``J``, shape
        (≥ contact rows, nv), belong to the contacts.
        """
        if self._count:
            J = J[: self._count]
            A = J[:, : self._base].T
            eased = A * self._ease
            square = eased @ A.T
            # Feet on one line cannot carry a moment about this line, so the matrix would be singular.
            square.flat[:: self._base + 1] += TINY * square.trace()
            _, wrenches, failed = self._solve(square, eased)
            if not failed:
                np.matmul(J.T, wrenches.T, out=self._carried)
        return np.asarray(self._needed(state.h) - self._central)

    def permitted(self, M: Array, known: Array, more: Array, shares: Array, most: float) -> float:
        """Return the fraction of the acceleration ``more``, 0 to 1, that the actuators permit.

        The acceleration ``known``, shape (nv,), is executed in any case.  The static controls ``shares``, shape (m,),
        do not use the whole control ranges.  ``known`` and the permitted part of ``more`` together may use the
        fraction ``most`` of the rest.  The contact forces follow from the last call of :meth:`shares`.
        """
        self._pair[:, 0], self._pair[:, 1] = known, more
        taken, added = self._needed(M @ self._pair).T
        side = np.sign(added)
        left = most * np.maximum(self._whole - side * shares, self._least) - side * taken
        return max(float((left / np.maximum(np.abs(added), TINY)).min(initial=1.0)), 0.0)

    def _needed(self, force: Array) -> Array:
        """Return the controls that produce generalized forces; shape (nv,) gives (m,), and (nv, k) gives (m, k)."""
        if self._count:
            force = force - self._carried @ force[: self._base]
        return np.asarray(self._inverse @ force)


def support_edges(state: State, contacts: Sequence[SupportContact]) -> tuple[Array, Array]:
    """Return ``n`` (k, 2) and ``b`` (k,) of the polygon ``n·c + b ≤ 0`` of the feet on level ground, m.

    If the center of mass ``c`` is in the polygon, each of n soles carries at least 60 %/n of the weight.  A sole
    without load would leave the ground at the smallest push.  Therefore, each corner of a sole is moved towards the
    mean of the same corners of all soles.  Point feet are not moved, because three of four feet can carry a robot.
    If the feet do not span an area, the result has four edges with infinite ``b``.  Four such edges prevent any
    motion of the center of mass.

    Raises:
        InputError: The robot has contacts, but its base is fixed.
    """
    if contacts and not state.robot.floating:
        what = "its base is fixed, and a flow with contacts needs a floating base"
        raise InputError(what, where=state.robot.name, hint="leave out `contacts`")
    corners = []
    for contact in contacts:
        here = state.at(contact.point)
        for sign in product((-1, 1), repeat=2):
            corner = np.array([*np.multiply(sign, contact.half), 0.0])
            corners.append((here.position + here.rotation @ corner)[:2])
    if not corners:
        return np.zeros((0, 2)), np.zeros(0)
    places = np.reshape(corners, (-1, 4, 2))
    even = EVEN if all(contact.size == 6 for contact in contacts) else 0.0
    edges = polygon_edges(list((places + even * (places.mean(axis=0) - places)).reshape(-1, 2)))
    if edges is None:
        return np.vstack([np.eye(2), -np.eye(2)]), np.full(4, np.inf)
    normals, offsets = edges
    # Sort the edges from the leftmost corner.  The C code has the same order, and the motion depends on it.
    turn = np.arctan2(normals[:, 1], normals[:, 0])
    order = np.argsort(np.where(turn < _START - np.pi, np.pi, turn))
    return normals[order], -offsets[order]
