"""Numeric impact quantities at one posture: H, G, V, S, E, velocity jumps and effective mass ``1/G``."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from impact_posture.config.json_block import JsonBlock
from impact_posture.system.arrays import Array

# The contact is treated as immovable along the normal if G is below this fraction of the largest mobility.
_BLOCKED = 1e-12


@dataclass(frozen=True)
class ImpactQuantities:
    """The impact quantities of one contact at one posture.

    Attributes:
        H: Squared jump per squared impulse, ``nᵀΛ_c n``.
        G: Inverse effective mass along the normal, ``nᵀJM⁻¹Jᵀn = 1/m_eff``, 1/kg.
        V: Squared jump per squared approach speed, ``H/G²`` (frictionless, e = 0).
        S: Squared jump per squared approach speed if the contact sticks; ``None`` if it cannot stick at this posture.
        E: Energy dissipated per squared approach speed, ``1/(2G)`` (e = 0), which is half the effective mass, kg.
        jump: Velocity jump per unit impulse, ``a = M⁻¹Jᵀn``, shape (nv,).
        sticking_jump: Jump per unit approach speed if the contact sticks, shape (nv,); ``None`` if S is ``None``.
        sticking_impulse: Impulse per unit approach speed if the contact sticks, world axes, shape (3,); ``None`` if S
            is ``None``.
        ellipsoid: Dynamic impact ellipsoid ``Λ_c``, world axes, shape (3, 3).
        mobility: Velocity change of the contact point per impulse, ``JM⁻¹Jᵀ``, world axes, shape (3, 3), 1/kg.
        normal: World unit normal, shape (3,).
        support_impulse: Impulses ``f`` of all supports per unit impulse on the contact, shape (rows,).
    """

    H: float
    G: float
    V: float
    S: float | None
    E: float
    jump: Array
    sticking_jump: Array | None
    sticking_impulse: Array | None
    ellipsoid: Array
    mobility: Array
    normal: Array
    support_impulse: Array

    @property
    def blocked(self) -> bool:
        """Whether the contact cannot move along the normal."""
        return self.G <= _BLOCKED * float(np.linalg.eigvalsh(self.mobility)[-1])


@dataclass(frozen=True)
class Scalars(JsonBlock):
    """H, G, V, S and E as in :class:`ImpactQuantities`; a value is ``None`` if it does not exist at the posture."""

    H: float
    G: float
    V: float | None
    S: float | None
    E: float | None

    @staticmethod
    def of(quantities: ImpactQuantities) -> Scalars:
        """Return the scalars; ``V`` and ``E`` do not exist if the contact cannot move along the normal."""
        V, E = (None, None) if quantities.blocked else (quantities.V, quantities.E)
        return Scalars(quantities.H, quantities.G, V, quantities.S, E)

    @property
    def effective_mass(self) -> float | None:
        """Effective mass ``1/G``, kg; ``None`` if it is unbounded (the contact cannot move along the normal)."""
        return None if self.E is None else 1 / self.G
