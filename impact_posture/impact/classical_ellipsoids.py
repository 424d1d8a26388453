"""Ellipsoids by axes and radii, and the classical ones of velocity and force beside the impact ellipsoid."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from impact_posture.impact.objective import ImpactObjective

Vector = NDArray[np.float64]

# An eigenvalue below this share of the largest one is zero: no motion that way, and no bound on the force.
_RANK = 1e-12


@dataclass(frozen=True, eq=False)
class Ellipsoid:
    """An ellipsoid about the contact point.

    Attributes:
        axes: Right-handed unit axes, columns, world, shape (3, 3).
        radii: Semi-axes, descending, shape (3,); infinite along an axis without a bound.
    """

    axes: Vector
    radii: Vector

    @property
    def finite_radii(self) -> list[float | None]:
        """The radii, ``None`` for one without end."""
        return [float(r) if np.isfinite(r) else None for r in self.radii]

    def to_dict(self) -> dict[str, object]:
        """JSON content; an infinite radius is ``None``."""
        return {"axes": [[float(v) for v in row] for row in self.axes], "radii": self.finite_radii}


def ellipsoid_of(matrix: Vector) -> Ellipsoid:
    """The ellipsoid ``{A^{1/2} u : |u| ≤ 1}`` of a symmetric PSD ``A``, shape (3, 3): radii are ``√eigenvalues``."""
    values, vectors = np.linalg.eigh((matrix + matrix.T) / 2)
    return Ellipsoid(_oriented(vectors[:, ::-1]), np.sqrt(np.clip(values[::-1], 0.0, None)))


def velocity_ellipsoid(J: Vector) -> Ellipsoid:
    """Contact velocities of joint velocities ``|ν| ≤ 1``: the ellipsoid of ``JJᵀ`` (Yoshikawa 1985).

    Args:
        J: Linear contact Jacobian in world axes, shape (3, nv).
    """
    return ellipsoid_of(J @ J.T)


def force_ellipsoid(J: Vector) -> Ellipsoid:
    """Contact forces of joint torques ``|Jᵀf| ≤ 1``: the ellipsoid of ``(JJᵀ)⁻¹``, endless where J loses rank.

    Args:
        J: Linear contact Jacobian in world axes, shape (3, nv).
    """
    values, vectors = np.linalg.eigh(J @ J.T)
    kept = values > _RANK * max(float(values[-1]), 1e-300)
    radii = np.where(kept, 1 / np.sqrt(np.where(kept, values, 1.0)), np.inf)
    return Ellipsoid(_oriented(vectors), radii)


def classical_ellipsoids(objective: ImpactObjective, q: Vector) -> dict[str, Ellipsoid]:
    """``{"velocity", "force"}`` of the objective's contact at ``q``.

    Both know nothing of inertia or of supports, and mix m/s with rad/s as ``|ν|`` does.
    """
    J = objective.oracle.at(q).J
    return {"velocity": velocity_ellipsoid(J), "force": force_ellipsoid(J)}


def _oriented(vectors: Vector) -> Vector:
    """Fix the signs that an eigensolver leaves open: largest entry positive, third axis by the right hand."""
    axes = np.array(vectors, dtype=float)
    for k in range(2):
        axes[:, k] *= np.sign(axes[np.argmax(np.abs(axes[:, k])), k])
    axes[:, 2] = np.cross(axes[:, 0], axes[:, 1])
    return axes
