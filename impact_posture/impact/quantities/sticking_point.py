"""Velocity jump and impulse of a contact point that sticks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from impact_posture.errors import MetricError
from impact_posture.system.arrays import Array

# Eigenvalues of JM⁻¹Jᵀ are treated as zero below this fraction of the largest eigenvalue.
SINGULAR = 1e-9


@dataclass(frozen=True, eq=False)
class ImpulseResponse:
    """Velocity jump and support impulses for a generalized impulse ``τ``, or for k impulses as columns.

    Attributes:
        a: Velocity jump ``(M + J_sᵀJ_s/ε)⁻¹ τ``, shape (nv,) or (nv, k).
        f: Support impulses ``−J_s a/ε``, shape (rows,) or (rows, k).
    """

    a: Array
    f: Array


@dataclass(frozen=True, eq=False)
class StickingPoint:
    """Contact points whose velocities are prescribed in the directions in which they can move.

    The system ``M a − J_sᵀf − Jᵀs = τ, J_s a + εf = 0, J a = v`` is solved as a whole.  A solution with
    ``(JM⁻¹Jᵀ)⁻¹`` would be less accurate, because the condition number of ``JM⁻¹Jᵀ`` would enter squared.
    """

    system: Array
    axes: Array
    outside: Array
    projector: Array

    @staticmethod
    def of(kkt: Array, J: Array, mobility: Array, projector: Array) -> StickingPoint:
        """Build the system from ``kkt = [M, −J_sᵀ; J_s, εI]``, the world ``J``, and ``mobility = JM⁻¹Jᵀ``, 1/kg.

        ``projector`` projects onto the velocities that can change (:attr:`Robot.projector`), shape (nv, nv).
        """
        values, vectors = np.linalg.eigh((mobility + mobility.T) / 2)
        kept = values > SINGULAR * max(float(values[-1]), 1e-300)
        axes = np.eye(len(J)) if kept.all() else vectors[:, kept]
        size, nv = len(kkt), J.shape[1]
        system = np.zeros((size + axes.shape[1],) * 2)
        system[:size, :size] = kkt
        system[size:, :nv] = axes.T @ J
        system[:nv, size:] = -system[size:, :nv].T
        return StickingPoint(system, axes, vectors[:, ~kept], projector)

    def can_move(self, n: Array) -> bool:
        """Return whether the point can move along ``n``."""
        return bool(np.linalg.norm(self.outside.T @ n) <= np.sqrt(SINGULAR))

    def respond(self, *, tau: Array | None = None, velocity: Array | None = None) -> tuple[ImpulseResponse, Array]:
        """Return the velocity jump with support impulses, and the impulse ``s`` on the point.

        The generalized impulse ``tau`` and the point velocity ``velocity`` are zero by default.
        """
        right, nv = np.zeros(len(self.system)), len(self.projector)
        size = len(right) - self.axes.shape[1]
        if tau is not None:
            right[:nv] = self.projector.T @ tau
        if velocity is not None:
            right[size:] = self.axes.T @ velocity
        solution = np.asarray(np.linalg.solve(self.system, right), dtype=np.float64)
        response = ImpulseResponse(self.projector @ solution[:nv], solution[nv:size])
        return response, np.asarray(self.axes @ solution[size:])


def no_sticking() -> MetricError:
    """Build the error for a posture at which S does not exist."""
    return MetricError(
        "S does not exist here: the normal has a component along which the contact point cannot move",
        where="objective sticking",
        hint="choose `objective` speed, or another frame, normal or posture",
    )
