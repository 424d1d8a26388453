"""The numbers of one impact at one posture: H, G, V, S, E, the jumps and the effective mass ``1/G``."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from impact_posture.system.arrays import Array

# A contact whose 1/m_eff along the normal is below this share of the largest mobility cannot move along it.
_BLOCKED = 1e-12


@dataclass(frozen=True)
class ImpactQuantities:
    """The impact quantities of one contact at one posture.

    Attributes:
        H: ``nᵀΛ_c n``, squared jump per squared impulse.
        G: ``nᵀJM⁻¹Jᵀn = 1/m_eff``, 1/kg.
        V: ``H/G²``, squared jump per squared approach speed (frictionless, e = 0).
        S: Squared jump per squared approach speed if the contact sticks; ``None`` where it does not exist.
        E: ``1/(2G)``, energy dissipated per squared approach speed (e = 0), half the effective mass, kg.
        jump: ``a = M⁻¹Jᵀn``, shape (nv,).
        sticking_jump: Jump per unit approach speed of a contact that sticks, shape (nv,), or ``None``.
        sticking_impulse: Impulse per unit approach speed of a contact that sticks, world, shape (3,), or ``None``.
        ellipsoid: ``Λ_c``, shape (3, 3).
        mobility: ``JM⁻¹Jᵀ``, shape (3, 3), 1/kg.
        normal: World unit normal, shape (3,).
        support_impulse: ``f`` per unit impulse, stacked rows of the supports.
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
class Scalars:
    """H, G, V, S and E as in :class:`ImpactQuantities`; ``None`` for a value that does not exist."""

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
        """``1/G``, kg; ``None`` where unbounded."""
        return None if self.E is None else 1 / self.G

    def to_dict(self) -> dict[str, float | None]:
        """Return JSON content."""
        return {"H": self.H, "G": self.G, "V": self.V, "S": self.S, "E": self.E}
