"""A lower bound on the objective over a mapped self-motion manifold, by branch and bound on patches.

A patch is the part of the manifold within a radius r of its center.  With ``φ = ln f``, its gradient g along the
manifold and a bound M on the curvature of φ, the patch has ``φ ≥ φ(center) − ‖g‖ r − M r²/2``.  M is estimated from
the gradients at neighbors, so the result is an estimate as well.  The objective is therefore called *bounded*, and
the bound is not a proof. The logarithm makes the bound relative and useful even near the poles of V and S.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from impact_posture.posture.manifold.constraint_manifold import ConstraintManifold
from impact_posture.posture.manifold.self_motion import SelfMotion
from impact_posture.system.arrays import Array

# Safety factor on the largest curvature between neighbors.
_SAFETY = 2.0
# A posture is treated as feasible if its distance from the feasible set is at most this value.
_FEASIBLE = 1e-7
# A patch is discarded if its center is farther from the feasible set, to first order, than this multiple of its
# radius.
_BEYOND = 1.5
_MOST = 200_000
# A disc is covered by seven discs of half the radius, one of them in the middle.  A segment is covered by two
# segments of half the length.
_RING = [[np.sqrt(0.75) * np.cos(a), np.sqrt(0.75) * np.sin(a)] for a in np.pi / 3 * np.arange(6)]
_PARTS = {1: np.array([[-0.5], [0.5]]), 2: np.array([[0.0, 0.0], *_RING])}
# Ratio of the radius of a part to the radius of the patch that is split.  The ratio exceeds 1/2 so that the parts
# overlap.  On a curved manifold, parts of exactly half the radius could leave gaps.
_HALF = 0.52


@dataclass(frozen=True, eq=False)
class OptimalityBound:
    """The best posture on the mapped components, and an estimated lower bound of the objective on all components.

    Attributes:
        best: Least objective of a feasible posture.
        x: Posture with the objective ``best``, shape (nx,); ``None`` if no patch center is better than the known
            posture.
        patches: Number of evaluated patches.
        finished: Whether the bound of every patch is within the requested gap.
    """

    best: float
    lower: float
    x: Array | None
    patches: int
    finished: bool

    @property
    def gap(self) -> float:
        """Relative gap between the bound and the best objective, ``1 − lower/best``."""
        return max(0.0, 1 - self.lower / self.best)


@dataclass(frozen=True, eq=False)
class _Patches:
    """N patches: center (N, nx), radius (N,), φ (N,), gradient along the manifold (N, nv) and curvature (N,)."""

    x: Array
    radius: Array
    value: Array
    gradient: Array
    curvature: Array

    @property
    def lower(self) -> Array:
        """Lower bound of φ in each patch; −∞ if the objective is not defined at the center."""
        slope = np.linalg.norm(self.gradient, axis=1)
        bound = self.value - slope * self.radius - self.curvature * self.radius**2 / 2
        return np.where(np.isfinite(bound), bound, -np.inf)

    def where(self, mask: NDArray[np.bool_]) -> _Patches:
        return _Patches(*(values[mask] for values in vars(self).values()))


def bound_objective(motion: SelfMotion, best: float, gap: float = 0.01) -> OptimalityBound:
    """Split patches until no patch can contain a feasible posture with an objective below ``(1 − gap) best``.

    ``best`` is the objective of a known feasible posture, or infinity if no feasible posture is known.
    """
    manifold, dimension = motion.manifold, motion.dimension
    x = np.concatenate([component.x for component in motion.components])
    value, gradient = _along(manifold, x, dimension)
    radius = np.concatenate([component.radius for component in motion.components])
    active = _Patches(x, radius, value, gradient, _curvature(manifold, x, gradient))
    count, retired, best_x = len(x), np.inf, None
    while len(active.x):
        retired, active = _retire(active, retired, best * (1 - gap))
        # The feasibility test takes the most time, so patches that the bound excludes are removed first.
        distance = manifold.distance_to_feasible(active.x)
        values = np.where((distance <= _FEASIBLE) & np.isfinite(active.value), active.value, np.inf)
        if values.size and np.exp(values.min()) < best * (1 - 1e-9):
            best, best_x = float(np.exp(values.min())), active.x[int(values.argmin())]
        retired, active = _retire(active.where(distance <= _BEYOND * active.radius), retired, best * (1 - gap))
        if not len(active.x) or count + len(active.x) * len(_PARTS[dimension]) > _MOST:
            break
        active = _split(manifold, dimension, active)
        count += len(active.x)
    lower = min(retired, float(active.lower.min(initial=np.inf)))
    return OptimalityBound(best, min(float(np.exp(lower)), best), best_x, count, not len(active.x))


def _retire(active: _Patches, retired: float, threshold: float) -> tuple[float, _Patches]:
    """Retire patches whose bound exceeds ``threshold``; return their least bound, and the remaining patches."""
    below = active.lower < np.log(threshold)
    return min(retired, float(active.lower[~below].min(initial=np.inf))), active.where(below)


def _curvature(manifold: ConstraintManifold, x: Array, gradient: Array) -> Array:
    """Estimate the curvature from above, shape (N,): twice the change of the gradient per distance to neighbors."""
    from scipy.spatial import cKDTree

    points = manifold.embed(x)
    near = min(6, len(x))
    distance, place = cKDTree(points).query(points, near)
    change = np.linalg.norm(gradient[place.reshape(-1, near)] - gradient[:, None], axis=2)
    rate = np.where(distance.reshape(-1, near) > 0, change / np.maximum(distance.reshape(-1, near), 1e-12), 0.0)
    return np.asarray(_SAFETY * np.where(np.isfinite(rate), rate, 0.0).max(axis=1, initial=0.0))


def _split(manifold: ConstraintManifold, dimension: int, parents: _Patches) -> _Patches:
    """Split each patch into parts; the curvature of a part is at least half the curvature of the patch."""
    parts = _PARTS[dimension]
    basis = manifold.tangents(parents.x, dimension)
    steps = np.einsum("n,pd,ndv->npv", parents.radius, parts, basis)
    before = np.repeat(parents.x, len(parts), axis=0)
    x = manifold.project(manifold.move(before, steps.reshape(-1, steps.shape[2]))).x
    value, gradient = _along(manifold, x, dimension)
    shape = (len(parents.x), len(parts))
    change = np.linalg.norm(gradient.reshape(*shape, -1) - parents.gradient[:, None], axis=2)
    length = np.linalg.norm(steps, axis=2)
    rate = np.where(length > 0, change / np.maximum(length, 1e-300), 0.0)
    rate = _SAFETY * np.where(np.isfinite(rate), rate, 0.0).max(axis=1)
    curvature = np.maximum(rate, parents.curvature / 2)
    radius = np.repeat(_HALF * parents.radius, len(parts))
    return _Patches(x, radius, value, gradient, np.repeat(curvature, len(parts)))


def _along(manifold: ConstraintManifold, x: Array, dimension: int) -> tuple[Array, Array]:
    """Return ``φ = ln f``, shape (N,), and its gradient along the manifold, shape (N, nv)."""
    value, gradient = manifold.objective(x)
    basis = manifold.tangents(x, dimension)
    along = np.einsum("ndv,nd->nv", basis, np.einsum("ndv,nv->nd", basis, gradient))
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.log(value), np.asarray(along / value[:, None])
