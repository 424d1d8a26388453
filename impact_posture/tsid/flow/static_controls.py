"""Controls that hold a posture at rest, as shares of the actuators' limits, and the polygon of the feet."""

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

# Weight of a moment (N·m), relative to a force (N), in the choice of contact wrenches.
_MOMENT = 100.0
# Least share of the half range of a control that counts as available.
_LEFT = 0.1
# Share of the weight that soles carry in equal parts.
_EVEN = 0.6
# An edge whose direction is within this angle of the first direction counts as the last edge, rad.
_START = 1e-8
# Share of the trace that keeps the balance of the base solvable where the feet cannot carry it.
_TINY = 1e-12


class StaticControls:
    """Controls at rest, ``u = G⁺(h − Jᵀf)``, as distances from the middle of their ranges.

    The unit is a share of half the range.  The contact wrenches ``f`` are the least in a weighted norm that carry the
    base.  Redundant rotors share evenly.

    Attributes:
        limited: Controls that have limits, shape (m,).
    """

    def __init__(self, actuators: Actuators, contacts: Sequence[SupportContact], share: float) -> None:
        """Set the share of the limits that rest may use, 0 to 1."""
        base = actuators.base
        self.limited = np.flatnonzero(np.isfinite(actuators.upper) & np.isfinite(actuators.lower))
        lower, upper = actuators.lower[self.limited], actuators.upper[self.limited]
        self._middle, self._half = (upper + lower) / 2, share * (upper - lower) / 2
        # The whole limits, and the least room if the start needs more than its share.
        self._whole, self._least = 1.0 / share, _LEFT / share
        wrench = np.array([1.0] * 3 + [_MOMENT] * 3)
        self._ease = 1.0 / np.concatenate([np.zeros(0), *(wrench[: c.size] for c in contacts)])
        self._count, self._base = self._ease.size, base
        # u = inverse · force, where the force is without the contacts' part.
        self._inverse = np.linalg.pinv(actuators.G, rcond=1e-9)[self.limited] / self._half[:, None]
        # Generalized forces of the contacts, per unit of the wrench on the base that they carry.
        self._carried = np.zeros((actuators.G.shape[0], base))
        if contacts:
            # Imported here, because SciPy takes long to import.  NumPy takes three times as long for six unknowns.
            from scipy.linalg.lapack import dposv

            self._solve = dposv
        self._central, self._pair = self._middle / self._half, np.zeros((actuators.G.shape[0], 2))

    def shares(self, state: State, J: Array) -> Array:
        """Return the shares at a state with ``ν = 0``, shape (m,); within ±1 the posture can be held.

        The first rows of ``J``, shape (≥ contact rows, nv), belong to the contacts.
        """
        if self._count:
            J = J[: self._count]
            A = J[:, : self._base].T
            eased = A * self._ease
            square = eased @ A.T
            # Feet on a line carry no moment about it.
            square.flat[:: self._base + 1] += _TINY * square.trace()
            _, wrenches, failed = self._solve(square, eased)
            if not failed:
                np.matmul(J.T, wrenches.T, out=self._carried)
        return np.asarray(self._needed(state.h) - self._central)

    def permitted(self, M: Array, known: Array, more: Array, shares: Array, most: float) -> float:
        """Return the share of ``more``, 0 to 1, that the actuators permit.

        The acceleration ``known``, shape (nv,), must not change.  Both accelerations may use at most the share
        ``most`` of the room beside the static controls ``shares``, shape (m,).  The contact forces come from the
        last :meth:`shares`.
        """
        self._pair[:, 0], self._pair[:, 1] = known, more
        taken, added = self._needed(M @ self._pair).T
        side = np.sign(added)
        left = most * np.maximum(self._whole - side * shares, self._least) - side * taken
        return max(float((left / np.maximum(np.abs(added), _TINY)).min(initial=1.0)), 0.0)

    def _needed(self, force: Array) -> Array:
        """Return the controls that produce generalized forces, shape (m,) for (nv,) or (m, k) for (nv, k)."""
        if self._count:
            force = force - self._carried @ force[: self._base]
        return np.asarray(self._inverse @ force)


def support_edges(state: State, contacts: Sequence[SupportContact]) -> tuple[Array, Array]:
    """Return ``n`` (k, 2) and ``b`` (k,) of the polygon ``n·c + b ≤ 0`` of the feet on level ground, m.

    A center of mass ``c`` in the polygon leaves each sole its equal part of 60 % of the weight, because a sole
    without load leaves the ground at the least push.  For this, each corner of a sole moves towards the mean of the
    same corners of all soles.  Point feet stay as they are, because three of four carry a robot.  Feet that span no
    area allow no motion of the center of mass.  The result is then four edges at an infinite distance.

    Raises:
        InputError: The base is fixed, so the feet do not carry the weight alone.
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
    even = _EVEN if all(contact.size == 6 for contact in contacts) else 0.0
    edges = polygon_edges(list((places + even * (places.mean(axis=0) - places)).reshape(-1, 2)))
    if edges is None:
        return np.vstack([np.eye(2), -np.eye(2)]), np.full(4, np.inf)
    normals, offsets = edges
    # In the order of the C code, from the leftmost corner around, because edges act one after the other.
    turn = np.arctan2(normals[:, 1], normals[:, 0])
    order = np.argsort(np.where(turn < _START - np.pi, np.pi, turn))
    return normals[order], -offsets[order]
