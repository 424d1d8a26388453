"""Error bounds of double precision for the contact-consistent quantities.

Backward error analysis (N. J. Higham, *Accuracy and Stability of Numerical Algorithms*, 2002), with the inverse known
to sixty digits:

- The oracle uses Gaussian elimination with pivoting, which solves ``(K + ΔK)x = b`` with ``|ΔK| ≤ γ_3n |L||U|``
  (theorem 9.4).
- A Cholesky factorization of ``M̃ = M + J_sᵀJ_s/ε`` solves ``(M̃ + ΔM̃)x = b`` with ``|ΔM̃| ≤ γ_(3n+1) d dᵀ``,
  ``d_i² = M̃_ii`` (theorem 10.4).  The kernel's articulated-body algorithm also adds 1/ε
  to the feet, so it cannot guarantee a smaller error.

An error bound is the size of the matrix change ``ΔK`` or ``ΔM̃`` times the condition number of the quantity.  If a
quantity needs several solves, the sum of their bounds would be far too large.  For a quantity that needs several
solves, the bound is the change of the exact value when all input numbers are rounded once.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
import scipy.linalg

from impact_posture.impact.quantities.impact_oracle import ImpactOracle
from tests.support.exact import Exact, ExactImpact, Vector, bracket, exact, rounded

_UNIT = 2.0**-53


def gamma(count: int) -> float:
    """Return ``γ_n = nu/(1 − nu)`` (Higham), where u is the unit roundoff."""
    return count * _UNIT / (1 - count * _UNIT)


def eliminated(matrix: Exact) -> Vector:
    """Return the product ``|L||U|`` of the pivoted LU factors, in the row order of the matrix."""
    P, L, U = scipy.linalg.lu(rounded(matrix))
    return np.asarray(P @ np.abs(L) @ np.abs(U))


class RoundedOnce(ExactImpact):
    """Exact impact after random changes of the system matrix by one rounding of ``|L||U|`` (fixed contact point)."""

    def __init__(self, oracle: ImpactOracle, compliance: float, seed: int) -> None:
        super().__init__(oracle, compliance)
        size = eliminated(super().K_held)
        off = _UNIT * size * np.random.default_rng(seed).choice([-1.0, 1.0], size.shape)
        self.__dict__["K_held"] = super().K_held + exact(off)


class Bounded(ExactImpact):
    """Exact impact with error bounds for two solution methods."""

    @cached_property
    def share(self) -> float:
        """Bias ``ε/(σ+ε)`` of the effect of the feet; σ is the smallest positive eigenvalue of ``J_sM⁻¹J_sᵀ``."""
        root = np.linalg.cholesky(self.oracle.M)
        held = np.linalg.svd(np.linalg.solve(root, self.oracle.Js.T), compute_uv=False) ** 2
        return float(self.compliance / (held[held > 1e-12 * held[0]][-1] + self.compliance))

    @cached_property
    def _backward(self) -> Vector:
        """Bound ``γ_3n |L||U|`` on the rounding errors of elimination, in the row order of K."""
        return gamma(3 * len(self.K)) * eliminated(self.K)

    @cached_property
    def lost_by_elimination(self) -> Vector:
        """Largest error of each entry of ``a`` and ``f``, combined from solutions for the three columns of ``Jᵀ``."""
        x = np.abs(rounded(self.inverse[:, : self.nv] @ self.J.T))
        return (np.abs(rounded(self.inverse)) @ self._backward @ x + gamma(3) * x) @ np.abs(self.oracle.n)

    @cached_property
    def H_by_elimination(self) -> float:
        """Largest rounding error of ``aᵀa``."""
        a = np.abs(rounded(self.jump))
        return 2 * float(a @ self.lost_by_elimination[: self.nv]) + gamma(self.nv) * float(self.H)

    @cached_property
    def G_by_elimination(self) -> float:
        """Largest rounding error of ``nᵀJa``."""
        along = np.abs(self.oracle.n) @ np.abs(self.oracle.J)
        a = np.abs(rounded(self.jump))
        return float(along @ (self.lost_by_elimination[: self.nv] + gamma(self.nv + 3) * a))

    @cached_property
    def gradient_by_elimination(self) -> Vector:
        """Largest first-order error of each entry of ∇H, shape (nv,)."""
        x, (b, g) = np.concatenate([self.jump, self.impulse]), self.second
        y = np.concatenate([b, g])
        inverse, (a, f), (b, g) = np.abs(rounded(self.inverse)), self._split(x), self._split(y)
        lost_x = self.lost_by_elimination
        lost_y = inverse @ (self._backward @ np.abs(rounded(y))) + inverse[:, : self.nv] @ lost_x[: self.nv]
        (da, df), (db, dg) = self._split(lost_x), self._split(lost_y)
        dM, dJ, dJs, n = np.abs(self.dM), np.abs(self.dJ), np.abs(self.dJs), np.abs(self.oracle.n)
        rounding = gamma(3 * len(self.K))
        total = bracket(dJ, n, db + rounding * b) + bracket(dM, db + rounding * b, a) + bracket(dM, b, da)
        total += bracket(dJs, df + rounding * f, b) + bracket(dJs, f, db)
        return np.asarray(2 * (total + bracket(dJs, dg + rounding * g, a) + bracket(dJs, g, da)))

    def _split(self, values: Any) -> tuple[Vector, Vector]:
        sizes = np.abs(rounded(values))
        return sizes[: self.nv], sizes[self.nv :]

    @cached_property
    def sticking_by_elimination(self) -> tuple[float, float]:
        """Estimated largest errors of S and ∇S: 3n times the largest error after five random roundings."""
        others = [RoundedOnce(self.oracle, self.compliance, seed) for seed in range(5)]
        roundings = 3 * len(self.K_held)
        moved_S = max(abs(float(o.S - self.S)) for o in others)
        moved_gradient = max(float(rounded(abs(o.grad_S - self.grad_S)).max()) for o in others)
        return roundings * moved_S, roundings * moved_gradient

    @cached_property
    def _scale(self) -> Vector:
        """``d_i² = M̃_ii``."""
        return np.sqrt(np.diag(self.oracle.M) + np.sum(self.oracle.Js**2, axis=0) / self.compliance)

    def _size(self, v: Exact) -> Any:
        """``dᵀ|v|``, by columns."""
        return self._scale @ np.abs(rounded(v))

    @cached_property
    def jump_by_heavy_feet(self) -> Vector:
        """Largest error ``|M̃⁻¹ΔM̃ a|`` of each entry, shape (nv,)."""
        responses = np.abs(rounded(self.inverse[: self.nv, : self.nv]))
        return np.asarray(gamma(3 * self.nv + 1) * (responses @ self._scale) * self._size(self.jump))

    @cached_property
    def H_by_heavy_feet(self) -> float:
        """Largest error of H, ``2 bᵀΔM̃ a``."""
        return float(2 * gamma(3 * self.nv + 1) * self._size(self.jump) * self._size(self.second[0]))

    @cached_property
    def G_by_heavy_feet(self) -> float:
        """Largest error of G, ``aᵀΔM̃ a``."""
        return float(gamma(3 * self.nv + 1) * self._size(self.jump) ** 2)

    @cached_property
    def gradient_by_heavy_feet(self) -> Vector:
        """Largest error of ∇H, ``2 ∂_k(bᵀΔM̃ a)``, shape (nv,), if a rotation by 1 rad changes ``ΔM̃`` by 100 %."""
        a, b = self._size(self.jump), self._size(self.second[0])
        rates = self._size(self.jump_rates) * b + a * self._size(self.second_rates)
        return np.asarray(2 * gamma(3 * self.nv + 1) * (rates + a * b))
