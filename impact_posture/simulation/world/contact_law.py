"""Contact law of MuJoCo: the keys ``solref``, ``solimp`` and ``friction`` of a surface or a ball."""

from __future__ import annotations

from dataclasses import dataclass

from impact_posture.config.checked import checked
from impact_posture.config.demand import Finite, FiniteVector, NonNegative
from impact_posture.config.table_validation import StrictTable
from impact_posture.errors import InputError


@checked
@dataclass(frozen=True, kw_only=True)
class ContactLaw(StrictTable):
    """Spring and damper of a contact in MuJoCo.  Stiffness and damping are proportional to the effective mass.

    At distance r (negative during penetration), the contact law demands the acceleration ``r* = −b r' − k r``.
    With ``solref = (T, ζ)``, ``b = 2/(d₁T)`` and ``k = d/(d₁Tζ)²``.  If both numbers of ``solref`` are negative, they
    are ``(−k, −b)``.  The resulting acceleration is ``r'' = d r* + (1 − d) r''₀``, where ``r''₀`` is the acceleration
    without contact.  With ``solimp = (d₀, d₁, width)``, d rises from ``d₀`` at depth 0 to ``d₁`` at depth ``width``
    (m).  The contact law determines the restitution.  ``make calibration`` measures the restitution of many contact
    laws (page on simulation).

    Attributes:
        solref: Time constant T in s and damping ratio ζ.
        solimp: ``d₀``, ``d₁`` and the width in m.
        friction: Coulomb coefficient, 0 for no friction.
    """

    solref: tuple[Finite, Finite] = (0.002, 1.0)
    solimp: FiniteVector = (0.95, 0.99, 0.001)
    friction: NonNegative = 0.7

    def __post_init__(self) -> None:
        """Check that MuJoCo would not silently change a number."""
        a, b = self.solref
        if not ((a > 0 and b > 0) or (a < 0 and b <= 0)):
            hint = "give a time and a damping ratio above zero, or both numbers below"
            raise InputError(f"solref is {self.solref}", where="scene", hint=hint)
        low, high, width = self.solimp
        if not (0.0001 <= low <= high <= 0.9999 and width > 0):
            hint = "give 0.0001 ≤ d₀ ≤ d₁ ≤ 0.9999 and a width above zero (m)"
            raise InputError(f"solimp is {self.solimp}", where="scene", hint=hint)
