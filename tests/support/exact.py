"""Contact-consistent quantities, computed with sixty digits.

The linear system with the matrix ``[M, −J_sᵀ; J_s, εI]`` is solved in decimal arithmetic.  ``M``, ``J`` and ``J_s``
are doubles from Pinocchio, exactly as in the oracle.
"""

from __future__ import annotations

import decimal
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from decimal import Decimal
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from impact_posture.impact.quantities.impact_oracle import ImpactOracle

Vector = NDArray[np.float64]
Exact = NDArray[Any]

DIGITS = 60


@contextmanager
def digits(count: int = DIGITS) -> Iterator[None]:
    """Use decimal arithmetic with this number of digits inside the ``with`` block."""
    with decimal.localcontext() as context:
        context.prec = count
        yield


def exact(values: object) -> Exact:
    """Convert doubles to decimal numbers without rounding."""
    doubles = np.asarray(values, dtype=float)
    decimals = np.empty(doubles.shape, dtype=object)
    for index in np.ndindex(doubles.shape):
        decimals[index] = Decimal(float(doubles[index]))
    return decimals


def rounded(values: Exact) -> Vector:
    return np.asarray(values, dtype=float)


def distance(value: object, expected: Exact) -> Vector:
    """Return ``|value − expected|``, rounded after the subtraction."""
    return rounded(abs(exact(value).reshape(np.shape(expected)) - expected))


def solve(matrix: Exact, right: Exact) -> Exact:
    """Solve by Gaussian elimination with partial pivoting, for each column of ``right``."""
    A, B = matrix.copy(), right.copy()
    size = len(A)
    for k in range(size):
        pivot = k + int(np.argmax(abs(A[k:, k])))
        if pivot != k:
            A[[k, pivot]], B[[k, pivot]] = A[[pivot, k]], B[[pivot, k]]
        for i in range(k + 1, size):
            if A[i, k]:
                factor = A[i, k] / A[k, k]
                A[i, k + 1 :] -= factor * A[k, k + 1 :]
                B[i] -= factor * B[k]
    for k in reversed(range(size)):
        B[k] = (B[k] - A[k, k + 1 :] @ B[k + 1 :]) / A[k, k]
    return B


@dataclass(frozen=True, eq=False)
class ExactImpact:
    """Exact quantities and gradients at one posture, for W = I and a normal in the world frame.

    Attributes:
        oracle: :class:`ImpactOracle` at the posture.  The oracle gives ``M, J, J_s, n`` and their derivatives as
            doubles.
        compliance: Compliance ε of the supports, 1/kg; may differ from the oracle's compliance.
    """

    oracle: ImpactOracle
    compliance: float

    @cached_property
    def K(self) -> Exact:
        M, Js = self.oracle.M, self.oracle.Js
        rows, size = Js.shape
        K = exact(np.zeros((size + rows, size + rows)))
        K[:size, :size], K[:size, size:], K[size:, :size] = exact(M), -exact(Js.T), exact(Js)
        K[range(size, size + rows), range(size, size + rows)] = Decimal(self.compliance)
        return K

    @cached_property
    def inverse(self) -> Exact:
        """Inverse of the system matrix ``K``; the first nv rows and columns are ``M̃⁻¹``."""
        return solve(self.K, exact(np.eye(len(self.K))))

    @property
    def nv(self) -> int:
        return len(self.oracle.M)

    def answer(self, tau: Exact) -> tuple[Exact, Exact]:
        """Return the solutions ``a`` and ``f`` for the right-hand side ``τ``."""
        solution = self.inverse[:, : self.nv] @ tau
        return solution[: self.nv], solution[self.nv :]

    @cached_property
    def n(self) -> Exact:
        return exact(self.oracle.n)

    @cached_property
    def J(self) -> Exact:
        return exact(self.oracle.J)

    @cached_property
    def jump(self) -> Exact:
        return self.answer(self.J.T @ self.n)[0]

    @cached_property
    def impulse(self) -> Exact:
        return self.answer(self.J.T @ self.n)[1]

    @cached_property
    def second(self) -> tuple[Exact, Exact]:
        """Solutions ``b`` and ``g`` for the right-hand side ``τ = a``."""
        return self.answer(self.jump)

    @property
    def H(self) -> Decimal:
        return Decimal(self.jump @ self.jump)

    @property
    def G(self) -> Decimal:
        return Decimal(self.n @ self.J @ self.jump)

    @property
    def V(self) -> Decimal:
        return self.H / self.G**2

    @cached_property
    def K_held(self) -> Exact:
        """Matrix K in which the contact point is also fixed: three more rows ``J a = v`` and columns ``−Jᵀs``."""
        size = len(self.K)
        K = exact(np.zeros((size + 3, size + 3)))
        K[:size, :size], K[: self.nv, size:], K[size:, : self.nv] = self.K, -self.J.T, self.J
        return K

    def _held(self, right: Exact) -> tuple[Exact, Exact, Exact]:
        solution = solve(self.K_held, right[:, None])[:, 0]
        return solution[-3:], solution[: self.nv], solution[self.nv : -3]

    @cached_property
    def sticking(self) -> tuple[Exact, Exact, Exact]:
        """Sticking impulse ``s``, the velocity jump that it causes, and the impulses of the feet."""
        return self._held(np.concatenate([exact(np.zeros(len(self.K))), self.n]))

    @property
    def S(self) -> Decimal:
        jump = self.sticking[1]
        return Decimal(jump @ jump)

    @cached_property
    def dM(self) -> Vector:
        """Derivative ``∂M_ij/∂q_k``, shape (nv, nv, nv)."""
        eye, numeric = np.eye(self.nv), self.oracle.numeric
        return np.array([[numeric.inertial_gradient(i, j) for j in eye] for i in eye])

    @cached_property
    def dJ(self) -> Vector:
        return self._rate(self.oracle.point, 3)

    @cached_property
    def dJs(self) -> Vector:
        return np.concatenate([self._rate(foot.point, foot.rows) for foot in self.oracle.feet])

    def _rate(self, point: Any, rows: int) -> Vector:
        numeric = self.oracle.numeric
        return np.array(
            [[numeric.coupling_gradient(point, np.eye(6)[i], v) for v in np.eye(self.nv)] for i in range(rows)]
        )

    @cached_property
    def grad_H(self) -> Exact:
        """Gradient ``2 ∂_q[nᵀJb + fᵀJ_s b + gᵀJ_s a − bᵀMa]``, shape (nv,)."""
        (b, g), a, f = self.second, self.jump, self.impulse
        feet = bracket(self.dJs, f, b) + bracket(self.dJs, g, a)
        return 2 * (bracket(self.dJ, self.n, b) + feet - bracket(self.dM, b, a))

    @cached_property
    def grad_G(self) -> Exact:
        """Gradient ``∂_q[2nᵀJa + 2fᵀJ_s a − aᵀMa]``, shape (nv,)."""
        a, f = self.jump, self.impulse
        return 2 * (bracket(self.dJ, self.n, a) + bracket(self.dJs, f, a)) - bracket(self.dM, a, a)

    @cached_property
    def grad_S(self) -> Exact:
        """Gradient ``2 ∂_q[sᵀJb + rᵀJa + fᵀJ_s b + gᵀJ_s a − bᵀMa]``, shape (nv,)."""
        s, a, f = self.sticking
        r, b, g = self._held(np.concatenate([a, exact(np.zeros(len(self.K_held) - self.nv))]))
        feet = bracket(self.dJs, f, b) + bracket(self.dJs, g, a)
        return 2 * (bracket(self.dJ, s, b) + bracket(self.dJ, r, a) + feet - bracket(self.dM, b, a))

    def _moved(self, a: Exact, f: Exact, force: Exact) -> Exact:
        """Return ``∂_k a`` for ``M a − J_sᵀf = τ, J_s a + εf = 0``; ``force`` is ``∂_k τ``, shape (nv, nv)."""
        first = force - np.tensordot(a, exact(self.dM), (0, 0)) + np.tensordot(f, exact(self.dJs), (0, 0))
        slip = -np.tensordot(exact(self.dJs), a, (1, 0))
        return self.inverse[: self.nv] @ np.concatenate([first, slip])

    @cached_property
    def jump_rates(self) -> Exact:
        """Derivatives of the jump ``a``; column k is ``∂_k a``."""
        return self._moved(self.jump, self.impulse, np.tensordot(self.n, exact(self.dJ), (0, 0)))

    @cached_property
    def second_rates(self) -> Exact:
        """Derivatives of ``b``; column k is ``∂_k b``."""
        return self._moved(*self.second, self.jump_rates)


def bracket(rates: Any, left: Any, right: Any) -> Any:
    """Return ``Σ_ij l_i r_j ∂_k T_ij``, shape (nv,)."""
    if left.dtype == object and rates.dtype != object:
        rates = exact(rates)
    return np.tensordot(right, np.tensordot(left, rates, (0, 0)), (0, 0))
