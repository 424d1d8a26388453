"""Derivatives on the configuration manifold from values alone."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pinocchio as pin

from impact_posture.arrays import Array

_FIRST_STEP = 0.02
_LEVELS = 7


def difference_gradient(value: Callable[[Array], float], model: pin.Model, q: Array) -> Array:
    """Return ``d/dε value(q ⊕ ε e_i)``, shape (nv,), by Ridders' extrapolation of central differences.

    Each entry is the one of its tableau that differs least from its neighbors.  So the steps need no tuning, neither
    to stiff supports nor to a flat direction (Ridders 1982, "Accurate computation of F'(x) and F'(x)F''(x)").

    Args:
        value: The function.
        model: The model that defines ``⊕``.
        q: Configuration, shape (nq,).
    """
    directions = np.eye(model.nv)

    def central(step: float) -> Array:
        ahead, behind = ([value(pin.integrate(model, q, s * e)) for e in directions] for s in (step, -step))
        return np.asarray((np.array(ahead) - np.array(behind)) / (2 * step))

    best, least = np.full(model.nv, np.nan), np.full(model.nv, np.inf)
    before: list[Array] = []
    for level in range(_LEVELS):
        row = [central(_FIRST_STEP / 2**level)]
        for order, old in enumerate(before, start=1):
            factor = 4.0**order
            better = (factor * row[-1] - old) / (factor - 1)
            doubt = np.maximum(np.abs(better - row[-1]), np.abs(better - old))
            closer = doubt < least
            best, least = np.where(closer, better, best), np.where(closer, doubt, least)
            row.append(better)
        before = row
    return best
