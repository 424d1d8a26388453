"""Worst case of several simultaneous contacts, each with its own bound on the impulse (a box of impulses).

The squared jump ``‖Σ λ_i a_i‖²_W`` with ``a_i = M⁻¹J_iᵀn_i`` is a convex quadratic function ``λᵀKλ`` of the impulses,
``K_ij = a_iᵀWa_j``.  The maximum over ``0 ≤ λ_i ≤ λ̄_i`` is therefore at a corner of this box.  The origin is not a
candidate, so ``2^m − 1`` corners remain for m contacts.  If contacts can pull, the bounds are ``|λ_i| ≤ λ̄_i``.
Opposite corners then have the same value, so ``2^(m−1)`` corners suffice.  The program is ``min t`` with ``t ≥ λᵀKλ``
at every corner.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import casadi as ca
import numpy as np

from impact_posture.config.problem_settings import MOST_CONTACTS
from impact_posture.dynamics.tree import Tree, Wrench
from impact_posture.errors import ContactError, MetricError
from impact_posture.impact.impact_contact import ImpactContact
from impact_posture.impact.kinds.impact_kind import ImpactKind
from impact_posture.impact.objective import Subgradients
from impact_posture.impact.quantities.impact_kernel import ImpactKernel
from impact_posture.impact.quantities.impact_oracle import ImpactOracle
from impact_posture.impact.quantities.lifted_form import (
    ABOVE,
    Guess,
    Lifted,
    impact_at,
    unknown_jump,
    weighed,
    worst_of,
    worst_of_guesses,
)
from impact_posture.impact.worst_case.model_set import finite_maximum, first_of_largest
from impact_posture.system.arrays import Array


@dataclass(frozen=True, eq=False)
class WorstImpulses:
    """The corner of the box of impulses at which the velocity jump is largest.

    Attributes:
        value: Value of the objective, ``λᵀKλ``, in this corner of the box.
        impulses: Impulse λ of each contact in this corner of the box, N·s, shape (m,).
        tied: All corners that attain ``value``, as rows, N·s, shape (k, m); the first row is ``impulses``.
        jump: Velocity jump ``Δν`` in this corner of the box, shape (nv,).
    """

    value: float
    impulses: Array
    tied: Array
    jump: Array

    def to_dict(self) -> dict[str, object]:
        """Return the ``worst_impulses`` block of an evaluation."""
        return {
            "impulses": self.impulses.tolist(),
            "tied": len(self.tied) > 1,
            "corners": self.tied.tolist(),
            "jump_norm": float(np.sqrt(max(self.value, 0.0))),
        }


def check_contacts(contacts: Sequence[ImpactContact], kind: type[ImpactKind], *, bilateral: bool, cone: bool) -> None:
    """Check that an objective of the type ``kind`` is defined for the contacts.

    Raises:
        ContactError: There are too many contacts, two contacts have the same point and normal, or ``bilateral`` has
            no meaning.
        MetricError: There are several contacts, and the objective type is neither ``impulse`` nor ``sticking``, or
            there is a cone of normals.
    """
    if len(contacts) == 1:
        if bilateral:
            what = "there is only one contact, and a pull causes the same velocity jump as a push"
            raise ContactError(what, where="bilateral", hint="omit `bilateral`")
        return
    if len(contacts) > MOST_CONTACTS:
        raise ContactError(f"{len(contacts)} contacts", where="contact", hint=f"give up to {MOST_CONTACTS}")
    places = [(contact.frame, contact.offset, contact.normal) for contact in contacts]
    for i, place in enumerate(places):
        if place in places[:i]:
            raise ContactError(f"'{place[0]}' is given twice", where="contact", hint="remove one")
    if bilateral and not kind.adds_up:
        raise ContactError(f"{kind.name} has no bounds on impulses", where="bilateral", hint="omit `bilateral`")
    if not (kind.adds_up or kind.simultaneous):
        what = f"{kind.name} assumes the approach speed of one contact, but there are several contacts"
        raise MetricError(what, where="objective", hint="choose impulse or sticking, or give one `contact`")
    if cone:
        what = "the worst case over a cone of normals is exact for one contact only"
        raise MetricError(what, where="normal_cone", hint="give one `contact`, or omit the cone")


def corners(count: int, bilateral: bool) -> Array:
    """Return the corners of the unit box as rows, shape (k, count).

    The entries are 0 or 1; the origin is omitted.  For bilateral contacts, the entries are ±1, and the first entry is
    always 1.
    """
    if bilateral:
        return np.array([[1.0, *rest] for rest in product((1.0, -1.0), repeat=count - 1)])
    # The corner with all impulses at their bounds comes first, so it is reported if several corners are worst.
    rows = sorted(product((1.0, 0.0), repeat=count), key=lambda corner: -sum(corner))
    return np.array(rows[:-1])


@dataclass(frozen=True)
class ImpulseBox:
    """Worst case over the corners of the box ``0 ≤ λ_i ≤ λ̄_i``, or ``|λ_i| ≤ λ̄_i`` for bilateral contacts.

    Attributes:
        oracles: Numeric impact quantities, one object per contact.
        bilateral: Whether the contacts can pull as well as push.
        attempts: Number of different initial guesses that :meth:`guess` offers.
    """

    oracles: tuple[ImpactOracle, ...]
    bilateral: bool = False
    attempts: int = len(ABOVE)

    @property
    def oracle(self) -> ImpactOracle:
        return self.oracles[0]

    @cached_property
    def corners(self) -> Array:
        """Impulses at the corners, one corner per row, N·s, shape (k, m)."""
        bounds = np.array([oracle.contact.impulse for oracle in self.oracles])
        return np.asarray(corners(len(bounds), self.bilateral) * bounds)

    def worst(self, q: Array) -> WorstImpulses:
        """Return the worst corner of the box for the posture ``q``, computed with Pinocchio."""
        jumps, values = self._jumps_and_values(q)
        tied = finite_maximum(values)[0]
        impulses = self.corners[tied[0]]
        return WorstImpulses(float(values[tied[0]]), impulses, self.corners[tied], jumps @ impulses)

    def value(self, q: Array) -> float:
        return float(self._jumps_and_values(q)[1].max())

    def subgradients(self, q: Array, within: float = 0.0) -> Subgradients:
        tied, gaps = finite_maximum(self._jumps_and_values(q)[1], within)
        return Subgradients(np.array([self._gradient(q, self.corners[k]) for k in tied]), gaps)

    def _jumps_and_values(self, q: Array) -> tuple[Array, Array]:
        """Return the jumps ``a_i`` as columns, shape (nv, m), and ``λᵀKλ`` at every corner, shape (k,)."""
        jumps = np.stack([oracle.quantities(q).jump for oracle in self.oracles], axis=1)
        K = jumps.T @ self.oracle.at(q).weigh(jumps)
        return jumps, np.asarray(np.einsum("ki,ij,kj->k", self.corners, K, self.corners))

    def _gradient(self, q: Array, impulses: Array) -> Array:
        """Return ``∂_q‖a‖²_W = 2 ∂_q[Σ λ_i n_iᵀJ_i b − bᵀMa]`` for ``a = Σ λ_i a_i`` and ``Mb = Wa``, shape (nv,)."""
        oracles = [oracle.at(q) for oracle in self.oracles]
        first = oracles[0]
        forces = np.stack([oracle.J.T @ oracle.n for oracle in oracles], axis=1)
        x = first.respond(forces @ impulses)
        y = first.respond(first.weigh(x.a))
        gradient = -first.inertial(y, x)
        for weight, oracle in zip(impulses, oracles, strict=True):
            normal = np.array(oracle.contact.normal)
            gradient = gradient + weight * oracle.coupling(normal, y.a, oracle.case.in_contact_frame)
        return np.asarray(2 * gradient + first.metric_gradient(x.a))

    def expressions(self, k: ImpactKernel) -> tuple[ca.SX, ca.SX]:
        impacts = self._impacts(k.n)
        jumps = [k.respond([impact]) for impact in impacts]
        K = _gram(len(jumps), lambda i, j: k.product(jumps[i], jumps[j]))
        rows = [ca.SX(corner) for corner in self.corners]
        _, impulses = first_of_largest([ca.bilin(K, row, row) for row in rows], rows)
        worst = k.respond([replace(impact, force=impact.force * impulses[i]) for i, impact in enumerate(impacts)])
        return k.product(worst, worst), k.size_gradient(worst)

    def lift(self, tree: Tree, parameters: ca.SX, scale: ca.SX) -> Lifted:
        case = self.oracle.case
        jumps = [unknown_jump(case, tree, [impact], f"{i}_") for i, impact in enumerate(self._impacts(parameters))]
        K = _gram(len(jumps), lambda i, j: weighed(case.metric, jumps[i], jumps[j]))
        return worst_of(jumps, [ca.bilin(K, row, row) for row in map(ca.SX, self.corners)], scale)

    def guess(self, q: Array, scale: float, attempt: int = 0) -> Guess:
        parts = [Guess.unbounded(o.with_support_impulses(o.quantities(q).jump)) for o in self.oracles]
        return worst_of_guesses(parts, self.value(q) / scale, attempt)

    def _impacts(self, n: ca.SX) -> list[Wrench]:
        """Return the unit impulses of all contacts; ``n`` is the normal of the first contact."""
        leading, *others = [oracle.case for oracle in self.oracles]
        return [impact_at(leading, n), *[impact_at(c, ca.SX(np.array(c.contact.normal))) for c in others]]


def _gram(count: int, entry: Callable[[int, int], ca.SX]) -> ca.SX:
    K = ca.SX.zeros(count, count)
    for i in range(count):
        for j in range(i, count):
            K[i, j] = K[j, i] = entry(i, j)
    return K
