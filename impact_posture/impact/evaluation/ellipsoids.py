"""Ellipsoids given by axes and radii, and the classical velocity and force ellipsoids."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from impact_posture.config.json_block import JsonBlock
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.system.arrays import Array

# An eigenvalue of JJᵀ below this fraction of the largest eigenvalue is zero: the contact cannot move along the axis.
_RANK = 1e-12


@dataclass(frozen=True, eq=False)
class Ellipsoid(JsonBlock):
    """An ellipsoid about the contact point.

    Attributes:
        axes: Right-handed unit axes as columns, in world axes, shape (3, 3).
        radii: Lengths of the semi-axes in descending order, shape (3,); infinite along an axis without a bound.
    """

    axes: Array
    radii: Array


def ellipsoid_of(matrix: Array) -> Ellipsoid:
    """Return the ellipsoid ``{A^{1/2} u : |u| ≤ 1}`` of a positive semidefinite ``A``, shape (3, 3)."""
    values, vectors = np.linalg.eigh((matrix + matrix.T) / 2)
    return Ellipsoid(_oriented(vectors[:, ::-1]), np.sqrt(np.clip(values[::-1], 0.0, None)))


def force_ellipsoid(J: Array) -> Ellipsoid:
    """Return the ellipsoid of ``(JJᵀ)⁻¹``, which contains the contact forces with joint torques ``|Jᵀf| ≤ 1``.

    ``J`` is the linear Jacobian in world axes, shape (3, nv).  The radius is infinite along a direction in which the
    contact cannot move.
    """
    values, vectors = np.linalg.eigh(J @ J.T)
    kept = values > _RANK * max(float(values[-1]), 1e-300)
    radii = np.where(kept, 1 / np.sqrt(np.where(kept, values, 1.0)), np.inf)
    return Ellipsoid(_oriented(vectors), radii)


def classical_ellipsoids(objective: WorstCaseObjective, q: Array) -> dict[str, Ellipsoid]:
    """Return the ellipsoids ``velocity`` and ``force`` of the contact at ``q``.

    The velocity ellipsoid of ``JJᵀ`` contains the contact velocities for ``|ν| ≤ 1`` (Yoshikawa 1985).  Both
    ellipsoids ignore inertia and supports, and mix m/s with rad/s, because ``|ν|`` mixes these units.
    """
    J = objective.oracle.at(q).J
    return {"velocity": ellipsoid_of(J @ J.T), "force": force_ellipsoid(J)}


def _oriented(vectors: Array) -> Array:
    """Turn eigenvectors into right-handed axes; the largest entry of each of the first two axes is positive."""
    axes = np.array(vectors, dtype=float)
    for k in range(2):
        axes[:, k] *= np.sign(axes[np.argmax(np.abs(axes[:, k])), k])
    axes[:, 2] = np.cross(axes[:, 0], axes[:, 1])
    return axes
