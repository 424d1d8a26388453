"""Forces that hold a robot at rest and keep every actuator as far as possible from its limits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import pinocchio as pin

from impact_posture.dynamics.linear_program import solve_linear
from impact_posture.posture.loads.static_load import ForceSource, StaticLoad
from impact_posture.robot.model_joints import effort_unit
from impact_posture.system.arrays import Array

# A share (:class:`Equilibrium`) is treated as equal to the largest share if the difference is below this value.
_TIED = 1e-9
# Maximum number of iterations of ``_even_share``; each iteration removes feet that would have to pull.
_TURNS = 4
# A load factor λ above this value is reported as infinite.
_MOST = 1e6


@dataclass(frozen=True, eq=False)
class Distribution:
    """Forces and torques that hold one posture.

    Attributes:
        forces: Vector ``z`` of the forces of rotors and feet, in units of the robot's weight, shape (k,).
        shares: Share of each actuator, −1 to 1 between its limits (:class:`Equilibrium`), shape (actuators,).
        unbalanced: Sum of the absolute entries of the unbalanced wrench on the base; zero if the base is balanced.
            Forces are in units of the robot's weight, moments in units of the weight times 1 m.
        jacobian: Tangent Jacobian of ``unbalanced`` and the absolute shares, shape (1 + actuators, nv).  If ``z`` has
            entries, only the rows of the largest shares are nonzero, or the row of ``unbalanced`` if the base is not
            balanced.
    """

    forces: Array
    shares: Array
    unbalanced: float
    jacobian: Array

    @property
    def largest(self) -> float:
        """Largest absolute share."""
        return float(np.abs(self.shares).max(initial=0.0))


@dataclass(frozen=True, eq=False)
class Thrusts:
    """Thrusts ``u = P τ_base`` of the rotors ``names``, determined by the wrench on the base, and their limits.

    ``matrix`` is ``P``, shape (k, 6), which maps a wrench (N, N·m) to thrusts (N).  ``lower`` and ``upper`` are the
    limits of the thrusts, N, shape (k,).
    """

    names: tuple[str, ...] = ()
    matrix: Array = field(default_factory=lambda: np.zeros((0, 6)))
    lower: Array = field(default_factory=lambda: np.zeros(0))
    upper: Array = field(default_factory=lambda: np.zeros(0))


class Equilibrium:
    """Rows ``R τ(q, z) + r`` for a robot at rest: first the balance of the base (= 0), then the actuator shares.

    The share of an actuator is 0 in the middle of its range, and ±1 at its limits.

    Args:
        model: Model of the robot, with gravity.
        sources: Sources of wrenches: rotors and feet, with forces in units of the robot's weight, and pushes on the
            robot, N.
        weight: The weight of the robot, N.
        limits: Largest joint torques, infinite if unknown, shape (nv,).
        coupling: Projector ``C`` of the couplings of joints, shape (nv, nv).  The motors exert ``Cᵀτ``.
        balance: Combinations of the base wrench that the sources can balance, shape (b, 6); no rows for a fixed base.
        thrusts: Thrusts of rotors that are not among the sources.
        names: Names of the entries of ``ν``.
    """

    def __init__(
        self,
        model: pin.Model,
        sources: Sequence[ForceSource],
        weight: float,
        limits: Array,
        coupling: Array,
        balance: Array,
        thrusts: Thrusts,
        names: Sequence[str],
    ) -> None:
        self.load, self.weight, self.balanced = StaticLoad(model, sources), weight, len(balance)
        bounded = [k for k, limit in enumerate(limits) if np.isfinite(limit)]
        # Entries of z with two limits are thrusts, because the forces of feet have no upper limit.
        self._free = np.flatnonzero(np.isfinite(self.load.upper))
        half, middle = (thrusts.upper - thrusts.lower) / 2, (thrusts.upper + thrusts.lower) / 2
        base = np.vstack([balance / weight, thrusts.matrix / half[:, None]])
        torque = np.diag(1 / limits)[bounded] @ coupling.T
        self.rows = np.vstack([np.zeros((len(base), model.nv)), torque])
        self.rows[: len(base), :6] = base[:, : model.nv]
        self.offset = np.zeros(len(self.rows))
        self.offset[self.balanced : len(base)] = -middle / half
        free = [self.load.names[k] for k in self._free]
        self.kinds = ("thrust",) * len(half) + ("torque",) * len(bounded) + ("thrust",) * len(free)
        self.actuators = (*thrusts.names, *(names[k] for k in bounded), *free)
        units = [effort_unit(model, joint) for joint in range(1, model.njoints) for _ in range(model.nvs[joint])]
        self.units = (*["N"] * len(half), *(units[k] for k in bounded), *["N"] * len(free))
        ends = [
            (np.append(thrusts.lower, -limits[bounded]), np.append(thrusts.upper, limits[bounded])),
            (weight * self.load.lower[self._free], weight * self.load.upper[self._free]),
        ]
        self.lower, self.upper = (np.concatenate(parts) for parts in zip(*ends, strict=True))
        # Cache of the last results, because a search evaluates a posture several times.
        self._even: tuple[bytes, float] | None = None
        self._latest: tuple[bytes, Distribution] | None = None
        self._forces: tuple[bytes, Array] | None = None

    def _affine(self, load: Array, by_force: Array) -> tuple[Array, Array, Array, Array]:
        """Return ``A, b, S, c`` for the balance ``A z + b`` and the shares ``S z + c``; ``load`` is for ``z = 0``."""
        slopes, values = self.rows @ by_force, self.rows @ load + self.offset
        half = (self.load.upper - self.load.lower)[self._free] / 2
        middle = (self.load.upper + self.load.lower)[self._free] / 2
        A, torques = np.split(slopes, [self.balanced])
        b, c = np.split(values, [self.balanced])
        thrusts = np.eye(self.load.count)[self._free] / half[:, None]
        return A, b, np.vstack([torques, thrusts]), np.append(c, -middle / half)

    def spares(self, q: Array, room: float) -> bool:
        """Return whether nearly even forces balance the base, and all shares are then at most ``1 − room``.

        Nearly even forces are thrusts in the middle of their ranges and equal foot forces, both corrected to balance
        the base.  If nearly even forces suffice, no linear program is needed.  Even if they do not suffice, other
        forces may hold the posture.
        """
        key = q.tobytes()
        if self._even is None or self._even[0] != key:
            self._even = key, self._even_share(q)
        return self._even[1] <= 1 - room

    def _even_share(self, q: Array) -> float:
        """Return the largest actuator share under nearly even forces; infinite if they do not balance the base."""
        still = self.load.torque(q, np.zeros(self.load.count), by_posture=False)
        if not self.load.count:
            shares = np.abs(self.rows @ still.value + self.offset)
            balanced = shares[: self.balanced].max(initial=0.0) < _TIED
            return float(shares[self.balanced :].max(initial=0.0)) if balanced else np.inf
        A, b, S, c = self._affine(still.value, still.by_force)
        lower, upper = self.load.lower, self.load.upper
        pushing = np.isfinite(lower) & np.isinf(upper)
        even = np.where(pushing, 1 / max(pushing.sum(), 1), 0.0)
        even[self._free] = (lower + upper)[self._free] / 2
        z, used = even, np.ones(len(even), dtype=bool)
        for _ in range(_TURNS if len(A) else 0):
            z = np.where(used, even, 0.0)
            z[used] -= np.linalg.pinv(A[:, used]) @ (A @ z + b)
            pulling = pushing & (z < 0)
            if not pulling.any():
                break
            # Feet that would have to pull get zero force in the next iteration, and the other feet support the load.
            used &= ~pulling
        balanced = np.abs(A @ z + b).max(initial=0.0) < _TIED and (z[pushing] >= 0).all()
        return float(np.abs(S @ z + c).max(initial=0.0)) if balanced else np.inf

    def distribute(self, q: Array) -> Distribution:
        """Return the forces that minimize the largest share, or the imbalance if no forces balance the base."""
        key = q.tobytes()
        if self._latest is None or self._latest[0] != key:
            self._latest = key, self._distribute(q)
        return self._latest[1]

    def _distribute(self, q: Array) -> Distribution:
        count = self.load.count
        still = self.load.torque(q, np.zeros(count))
        A, b, S, c = self._affine(still.value, still.by_force)
        jacobian = np.zeros((1 + c.size, self.load.model.nv))
        if not count:
            jacobian[1:] = np.sign(c)[:, None] * (self.rows @ still.by_posture)
            return Distribution(np.zeros(0), c, 0.0, jacobian)
        z, unbalanced, duals = self._least_share(A, b, S, c) or self._least_imbalance(A, b)
        shares = S @ z + c
        # The derivative of the optimal value is the derivative of the rows R τ at fixed z, weighted with the Lagrange
        # multipliers ``duals``.
        gradient = duals @ self.rows @ self.load.torque(q, z).by_posture
        worst = np.abs(shares) > np.abs(shares).max(initial=0.0) - _TIED
        jacobian[np.append(unbalanced > 0, worst & (unbalanced == 0))] = gradient
        return Distribution(z, shares, unbalanced, jacobian)

    def shares(self, q: Array, load: Array) -> Array | None:
        """Return the signed shares, shape (actuators,), for a load other than gravity alone, such as ``M ν̇ + h``.

        The forces are chosen so that the largest share is as small as possible.  The result is ``None`` if the feet
        cannot balance the load.
        """
        if not self.load.count:
            return np.asarray((self.rows @ load + self.offset)[self.balanced :])
        A, b, S, c = self._affine(load, self._by_force(q))
        optimum = self._least_share(A, b, S, c)
        return None if optimum is None else S @ optimum[0] + c

    def largest_rate(self, q: Array, rest: Array, dynamic: Array) -> float | None:
        """Return the largest ``λ ≥ 0`` at which the actuators can hold the load ``rest + λ dynamic``.

        The result is infinite if the actuators can hold the load for every λ, and ``None`` if they cannot even hold
        ``rest``.
        """
        rate = self.rows @ dynamic
        if not self.load.count and not self.balanced:
            # A linear program is not needed, because ``z`` has no entries.
            shares, moving = self.rows @ rest + self.offset, rate != 0
            most = ((1 - np.sign(rate) * shares)[moving] / np.abs(rate[moving])).min(initial=np.inf)
            return None if np.abs(shares).max(initial=0.0) > 1 else float(most)
        A, b, S, c = self._affine(rest, self._by_force(q))
        of_shares = np.append(rate[self.balanced :], np.zeros(len(self._free)))
        optimum = solve_linear(
            np.append(np.zeros(self.load.count), -1.0),
            np.vstack([np.column_stack([A, rate[: self.balanced]]), np.column_stack([S, of_shares])]),
            np.concatenate([-b, -1 - c]),
            np.concatenate([-b, 1 - c]),
            np.append(self.load.lower, 0.0),
            np.append(self.load.upper, _MOST),
            primal=True,
        )
        if optimum is None:
            return None
        return float("inf") if optimum.x[-1] > _MOST * (1 - 1e-9) else float(optimum.x[-1])

    def _by_force(self, q: Array) -> Array:
        key = q.tobytes()
        if self._forces is None or self._forces[0] != key:
            self._forces = key, self.load.torque(q, np.zeros(self.load.count), by_posture=False).by_force
        return self._forces[1]

    def _least_share(self, A: Array, b: Array, S: Array, c: Array) -> tuple[Array, float, Array] | None:
        """Solve ``min s`` with ``A z + b = 0``, ``|S z + c| ≤ s``; return z, the imbalance 0 and the multipliers."""
        count, one, infinite = self.load.count, np.ones((len(S), 1)), np.full(2 * len(S), np.inf)
        low, high = np.append(self.load.lower, 0.0), np.append(self.load.upper, np.inf)
        # Thrusts have no bounds in this program, because a thrust beyond its limits has a share above one.
        low[self._free], high[self._free] = -np.inf, np.inf
        optimum = solve_linear(
            np.append(np.zeros(count), 1.0),
            np.vstack([np.block([[S, -one], [-S, -one]]), np.column_stack([A, np.zeros(len(A))])]),
            np.concatenate([-infinite, -b]),
            np.concatenate([-c, c, -b]),
            low,
            high,
        )
        if optimum is None:
            return None
        above, below, balance = np.split(optimum.multipliers, [len(S), 2 * len(S)])
        duals = np.concatenate([balance, above - below])
        return optimum.x[:count], 0.0, duals[: len(self.rows)]

    def _least_imbalance(self, A: Array, b: Array) -> tuple[Array, float, Array]:
        """Solve ``min Σ|A z + b|`` within the limits of thrusts and feet; return z, the value and the multipliers."""
        unit, slacks = np.eye(len(A)), np.zeros(2 * len(A))
        optimum = solve_linear(
            np.concatenate([np.zeros(self.load.count), slacks + 1]),
            np.hstack([A, -unit, unit]),
            -b,
            -b,
            np.append(self.load.lower, slacks),
            np.append(self.load.upper, slacks + np.inf),
        )
        assert optimum is not None  # noqa: S101 (narrows a type: any imbalance is allowed)
        duals = np.append(optimum.multipliers, np.zeros(len(self.rows) - len(A)))
        return optimum.x[: self.load.count], optimum.value, duals
