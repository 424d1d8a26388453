"""A body that is thrown at a robot, and what the rigid model says about its impact."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from impact_posture.arrays import Array
from impact_posture.errors import InputError
from impact_posture.impact.oracle import ImpactOracle
from impact_posture.robot.spec import NonNegative, Positive
from impact_posture.simulation.scene import ContactLaw, FiniteVector
from impact_posture.tables import Checked

# Tangential mobility of the surface of a solid sphere, times its mass: 1 + mr²/I with I = ⅖ mr².
_SPIN = 3.5


@dataclass(frozen=True, kw_only=True)
class Settling(Checked):
    """A robot that comes to rest before something happens to it.

    Attributes:
        signs: Signs of the directions, one run each.
        settle: Least time before the impact, s.
        quiet: ``‖ν‖`` below which the impact may come (mixes m/s and rad/s, as the metric of the paper does).
        still: Time for which ``‖ν‖`` must have been below ``quiet``, s.
        patience: Time beyond ``settle`` after which the impact comes although the robot still moves, s.
        after: Time that the run goes on after a push or the flight of a body, s.
    """

    signs: Annotated[tuple[Literal[1, -1], ...], Field(min_length=1)] = (1, -1)
    settle: NonNegative = 1.0
    quiet: Positive = 0.005
    still: NonNegative = 0.2
    patience: Positive = 20.0
    after: NonNegative = 1.0


@dataclass(frozen=True, kw_only=True)
class Throw(ContactLaw, Settling):
    """A solid ball is thrown at a shape of a robot that stands or hangs still.

    The ball starts :data:`FLIGHT` before the touch.  It flies straight at the center of the shape, which must be a
    sphere.  A frictionless impulse then passes through the center, whichever way the robot has turned the shape.

    Attributes:
        frame: Frame of the shape that is hit.
        mass: Mass of the ball, kg.
        radius: Radius of the ball, m.
        speed: Speed of the ball, m/s.
        direction: Direction of flight for sign 1, world, any length.
        window: Time from the first touch that counts as the impact, s.
    """

    frame: str
    mass: Positive
    radius: Positive
    speed: Positive
    direction: FiniteVector
    window: Positive = 0.3

    def __post_init__(self) -> None:
        """Refuse a throw without direction."""
        super().__post_init__()
        if not any(self.direction):
            raise InputError("key 'throw.direction': no direction", hint="give three numbers, not all zero")


# Time from the launch to the touch of a shape at rest, s.  It is short, so that gravity bends the flight by less than
# a millimeter.
FLIGHT = 0.01


def thrown_jumps(oracle: ImpactOracle, q: Array, throw: Throw, speed: float) -> tuple[float, float, float]:
    """Return the velocity jumps ``‖Δν‖`` of the robot without friction, if the ball sticks, and with its friction.

    The contact has the mobility ``B = J M⁻¹Jᵀ`` of the robot and ``D`` of the ball, ``1/m`` along the normal and
    ``3.5/m`` across it.  Without rebound, the impulse is ``v n/(nᵀ(B + D)n)`` without friction and ``v (B + D)⁻¹n``
    if the ball sticks.  A ball that slides is taken to slide against its sticking impulse.

    Args:
        oracle: Impact of the robot at the shape, with the direction of flight as normal.
        q: Posture, shape (nq,).
        throw: The ball.
        speed: Approach speed, m/s.
    """
    found = oracle.quantities(q)
    n, spread = found.normal, oracle.solve(oracle.J.T)
    across = np.eye(3) - np.outer(n, n)
    mobility = found.mobility + (np.outer(n, n) + _SPIN * across) / throw.mass
    plain, stuck = n / float(n @ mobility @ n), np.linalg.solve(mobility, n)
    normal, tangent = float(n @ stuck), across @ stuck
    real, drag = stuck, float(np.linalg.norm(tangent))
    if drag > throw.friction * normal:
        way = n + throw.friction * tangent / drag
        real = way / float(n @ mobility @ way)
    free, sticking, coulomb = (speed * float(np.linalg.norm(spread @ impulse)) for impulse in (plain, stuck, real))
    return free, sticking, coulomb
