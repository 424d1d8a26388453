"""Contact law of MuJoCo: the keys ``solref``, ``solimp`` and ``friction`` of a surface or a ball."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from impact_posture.config.checked import checked
from impact_posture.config.demand import Finite, FiniteVector, NonNegative
from impact_posture.config.table_validation import StrictTable
from impact_posture.errors import InputError

# Midpoint and power of the curve along which d rises from d₀ to d₁ (MuJoCo defaults).
SOLIMP_SHAPE = (0.5, 2.0)
# Fractions of a time step at which a contact begins.  Restitution depends slightly on this fraction.
PHASES = (0.1, 0.3, 0.5, 0.7, 0.9)
# A contact that lasts longer than this number of time steps counts as a contact that never ends.
_MOST_STEPS = 100_000


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
            hint = "give a time and a damping ratio above zero, or two negative numbers"
            raise InputError(f"solref is {self.solref}", where="scene", hint=hint)
        low, high, width = self.solimp
        if not (0.0001 <= low <= high <= 0.9999 and width > 0):
            hint = "give 0.0001 ≤ d₀ ≤ d₁ ≤ 0.9999 and a width above zero (m)"
            raise InputError(f"solimp is {self.solimp}", where="scene", hint=hint)

    def restitution(self, speed: float, timestep: float) -> float:
        """Return the coefficient of restitution, the mean over the :data:`PHASES` at which the contact begins.

        A mass hits the surface along the normal with the approach ``speed``, m/s.  No other force acts on the mass.
        The time steps are the steps of MuJoCo, ``r' ← r' + h r''`` and ``r ← r + h r'``, where ``h`` is the
        ``timestep``, s.  The result is zero if ``speed`` is not positive.
        """
        if speed <= 0:
            return 0.0
        return float(np.mean([self._rebound(speed, timestep, phase) for phase in PHASES])) / speed

    def _rebound(self, speed: float, h: float, phase: float) -> float:
        """Return the speed at which the mass leaves the surface, m/s; zero if the mass stays on the surface."""
        (time, damping), (low, high, width) = self.solref, self.solimp
        b, k = (2 / time, 1 / (time * damping) ** 2) if time > 0 else (-damping, -time)
        b, k = b / high, k / high**2
        middle, power = SOLIMP_SHAPE
        r, v = (phase - 1) * speed * h, -speed
        for _ in range(_MOST_STEPS):
            x = min(-r / width, 1.0)
            rising = x <= middle
            y = middle * (x / middle) ** power if rising else 1 - (1 - middle) * ((1 - x) / (1 - middle)) ** power
            d = low + y * (high - low)
            a = d * (-b * v - d * k * r)
            if r >= 0 or a <= 0:
                return max(v, 0.0)
            v += h * a
            r += h * v
        return 0.0
