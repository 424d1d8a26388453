"""Curves through a way and a run-up, with a blend instead of the corner between them."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate, pairwise

import numpy as np

from impact_posture.path.path_curve import PathCurve, fitted_curve
from impact_posture.path.path_search import placed
from impact_posture.path.path_space import PathSpace
from impact_posture.system.arrays import Array

# The blend replaces this share of the run-up, and at most half of the way.
_SHARE = 0.25
# A robot stops where the cosine between the directions of way and run-up is below the negative of this value.
_REVERSAL = 0.95
# Number of postures of the blend.
_POSTURES = 32
# Least number of knots of the curve on the part of the way that the blend replaces.
_KNOTS = 4
# Step of central differences along the way, relative to the length that the blend replaces.
_STEP = 0.01


def blended_curve(
    space: PathSpace, way: Sequence[Array], run_up: Sequence[Array], step: Array
) -> tuple[PathCurve, float] | None:
    """Return a smooth curve through a way and a run-up, and ``s`` where the blend ends.

    The postures of the run-up are even in time at the velocity of the impact; ``step`` is the last step between them,
    shape (nv,), along this velocity.  So a constant ``ṡ`` after the blend is a constant speed of the contact.

    A cubic Hermite curve replaces the last part of the way and the first part of the run-up.  If both parts are
    straight and have the same length, the blend is a parabola.  Return ``None`` if the run-up nearly reverses the
    way, so that the robot must stop, or if no smooth curve is on the constraints.
    """
    k = int(_SHARE * (len(run_up) - 1))
    size, tail = min(space.length(way) / 2, space.length(run_up[: k + 1])), run_up[k:]
    lengths = [*accumulate((space.distance(a, b) for a, b in pairwise(way)), initial=0.0)]
    cut = lengths[-1] - size
    before, first, after = placed(space, way, cut + _STEP * size * np.array([-1.0, 0.0, 1.0]))
    head = [*(q for q, length in zip(way, lengths, strict=True) if length < cut), first]
    along, across = space.difference(before, after), space.difference(run_up[k - 1], run_up[k + 1]) / 2
    pace = float(np.linalg.norm(across))
    out, back, gap = along / _STEP, across * (2 * size / pace), space.difference(first, tail[0])
    if out @ back < -_REVERSAL * np.linalg.norm(out) * np.linalg.norm(back):
        return None
    shares = np.linspace(0.0, 1.0, _POSTURES + 2)[1:-1]
    steps = [x * (1 - x) ** 2 * out + (3 - 2 * x) * x**2 * gap - x**2 * (1 - x) * back for x in shares]
    blend = [q for each in steps if (q := space.pulled(first, each)) is not None]
    if len(blend) < _POSTURES:
        return None
    sizes = [space.distance(a, b) for a, b in pairwise([*head, *blend, tail[0]])] + [pace] * (len(tail) - 1)
    whole = sum(sizes)
    end, least = step * (whole / pace), int(_KNOTS * whole / size)
    curve = fitted_curve(space, [*head, *blend, *tail], sizes, end, least)
    return None if curve is None else (curve, 1 - (len(tail) - 1) * pace / whole)
