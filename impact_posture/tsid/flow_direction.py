"""Direction of the reference flow: a saddle-free Newton step on the constraints, as a QP with limits."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from impact_posture.arrays import Array
from impact_posture.robot.robot import Robot
from impact_posture.tsid.daqp_solver import DaqpSolver
from impact_posture.tsid.qp import QP
from impact_posture.tsid.ranges import JointRanges
from impact_posture.tsid.state import State

# Singular value of the constraints, relative to the largest, below which they are springs.  The rows of points on one
# body can depend on each other almost: held exactly in one posture, free in the next, a flow would never rest.
_SOFT = 2e-2
# Stiffness of those springs relative to ``H₀``, 1/m²: an error of 6 mm costs half of ``H₀``.
_STIFFNESS = 3e4


@dataclass(frozen=True)
class Redundancy:
    """Directions that the constraints leave, ``J = U S Vᵀ``, and a pseudo-inverse of those that they hold.

    Attributes:
        basis: ``Z``, orthonormal, shape (nv, r).
        inverse: ``J⁺`` of the held directions, shape (nv, rows).
        springs: ``k JZ`` of nearly dependent constraints, shape (rows, r).
        stiffness: Their stiffness ``k s²`` along each column of ``Z``, shape (r,).
    """

    basis: Array
    inverse: Array
    springs: Array
    stiffness: Array

    @classmethod
    def of(cls, J: Array) -> Redundancy:
        """Decompose ``J``, shape (rows, nv)."""
        rows, nv = J.shape
        if not rows:
            return cls(np.eye(nv), np.zeros((nv, 0)), np.zeros((0, nv)), np.zeros(nv))
        U, s, Vt = np.linalg.svd(J)
        rank = int(np.count_nonzero(s > _SOFT * s[0]))
        Z = Vt[rank:].T
        springs, stiffness = np.zeros((rows, Z.shape[1])), np.zeros(Z.shape[1])
        springs[:, : s.size - rank] = U[:, rank : s.size] * (_STIFFNESS * s[rank:])
        stiffness[: s.size - rank] = _STIFFNESS * s[rank:] ** 2
        return cls(Z, (Vt[:rank].T / s[:rank]) @ U[:, :rank].T, springs, stiffness)


class FlowDirection:
    """Newton step ``δ = Z y`` of ``Φ = H/H₀ + ρ/2 ‖q_r ⊖ q₀‖²`` on the constraints.

    ``y`` minimizes ``½ yᵀ|B_Z| y + (Zᵀ∇Φ)ᵀ y``.  ``|B_Z|`` has the eigenvectors of the curvature and
    ``max(|λᵢ|, μ)`` for its eigenvalues (saddle-free Newton, Dauphin et al. 2014), so that the step leaves saddles.
    The curvature ``B`` is learned from secants by Powell's symmetric Broyden update, the slope ``T`` of the static
    controls by Broyden's.  Rows keep joints, center of mass and static controls within their limits.  A limit that
    does not hold at ``q_r`` is not crossed further.

    Attributes:
        B: Curvature of ``Φ`` on the constraints, shape (nv, nv).
        T: Slope of the static controls (:class:`StaticControls`), shape (controls, nv).
        gain: Decrease of ``Φ`` that the last step predicts.
    """

    def __init__(self, robot: Robot, edges: Array, controls: int, *, rho: float, mu: float, margin: float) -> None:
        """Size the buffers.

        Args:
            robot: The robot.
            edges: Normals of the support polygon, shape (k, 2).
            controls: Number of static controls with limits.
            rho: ρ, per rad².
            mu: μ, per rad².
            margin: Distance from the joint limits, rad (m); at most an eighth of the range of a joint.
        """
        nv, ranges = robot.nv, JointRanges(robot)
        self._joints = np.flatnonzero(np.isfinite(ranges.lower) & np.isfinite(ranges.upper))
        width = (ranges.upper - ranges.lower)[self._joints]
        self._margin = np.minimum(margin, width / 8)
        self._edges, self._mu = edges, mu
        # The pull towards the start acts on joints.  Others lead the base.
        self._pull = np.full(nv, rho)
        self._pull[: 6 if robot.floating else 0] = 0.0
        self.B, self.T, self.gain = np.zeros((nv, nv)), np.zeros((controls, nv)), 0.0
        # The sizes never change.  Directions that the constraints take keep columns of zeros.
        self._qp = QP.empty(nv, self._joints.size + edges.shape[0] + controls)
        self._solver = DaqpSolver(nv, self._qp.m)
        self._rows = np.zeros((self._qp.m, nv))
        self._rows[np.arange(self._joints.size), self._joints] = 1.0

    def learn(self, z: Array, curvature: Array, slope: Array) -> None:
        """Learn the curvature of ``H/H₀`` and the slope of the static controls along a unit vector, shape (nv,)."""
        missing = curvature + self._pull * z - self.B @ z
        missing -= z @ missing / 2 * z
        outer = np.outer(missing, z)
        self.B += outer
        self.B += outer.T
        self.T += np.outer(slope - self.T @ z, z)

    def limit(self, state: State, rooms: Array, shares: Array) -> None:
        """Set the rows for a state at ``ν = 0``.

        Args:
            state: The state.
            rooms: Distance of the center of mass to each edge of the polygon, less its margin, m, shape (k,).
            shares: Static controls, shape (controls,).
        """
        upper, lower = self._qp.upper[self._qp.n :], self._qp.lower[self._qp.n :]
        count, k = self._joints.size, self._edges.shape[0]
        room = np.maximum(state.room[:, self._joints] - self._margin, 0.0)
        upper[:count], lower[:count] = room[0], -room[1]
        if k:
            np.matmul(self._edges, state.center_of_mass()[1][:2], out=self._rows[count : count + k])
            upper[count : count + k] = np.maximum(rooms, 0.0)
        self._rows[count + k :] = self.T
        upper[count + k :] = np.maximum(1.0 - shares, 0.0)
        lower[count + k :] = np.minimum(-1.0 - shares, 0.0)

    def newton(self, space: Redundancy, gradient: Array, offset: Array, error: Array) -> Array:
        """Return the step δ, shape (nv,).

        Args:
            space: The redundancy.
            gradient: ``∇H/H₀``, shape (nv,).
            offset: ``q_r ⊖ q₀``, shape (nv,).
            error: Error of the constraints, shape (rows,).
        """
        Z = space.basis
        slope = Z.T @ (gradient + self._pull * offset) - space.springs.T @ error
        curvature = Z.T @ self.B @ Z
        curvature.flat[:: slope.size + 1] += space.stiffness
        values, vectors = np.linalg.eigh(curvature)
        way = Z @ (vectors / np.sqrt(np.maximum(np.abs(values), self._mu)))
        return self._solve(way, way.T @ (Z @ slope))

    def towards(self, Z: Array, way: Array) -> Array:
        """Return the step nearest to ``way``, shape (nv,), on the constraints and within the limits."""
        return self._solve(Z, -Z.T @ way)

    def _solve(self, way: Array, slope: Array) -> Array:
        """Return ``δ = way·y`` for the least ``½‖y‖² + slope·y``; zero if the solver fails."""
        qp, r = self._qp, way.shape[1]
        qp.A[:, :r] = self._rows @ way
        qp.A[:, r:] = 0.0
        qp.g[:r], qp.g[r:] = slope, 0.0
        # Without what the last step left: a row that was zero then would stay out.
        self._solver.reset()
        solved = self._solver.solve(qp)
        if solved is None:
            self.gain = 0.0
            return np.zeros(way.shape[0])
        y = solved.z[:r]
        self.gain = -float(slope @ y + y @ y / 2)
        return np.asarray(way @ y)
