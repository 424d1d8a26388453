"""A ball that is thrown at a robot, in MuJoCo, and what the rigid model says about its impact."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np

from impact_posture.config.checked import checked
from impact_posture.config.demand import Demand, Direction, NonNegative, Positive
from impact_posture.config.table_validation import StrictTable
from impact_posture.dynamics.mjcf import Mjcf, import_mujoco
from impact_posture.impact.quantities.impact_oracle import ImpactOracle
from impact_posture.simulation.world.contact_law import ContactLaw
from impact_posture.system.arrays import Array
from impact_posture.system.escape import xml_name

# Time from the launch to the touch of a shape at rest, s.  It is short, so that gravity bends the flight by less than
# a millimeter.
FLIGHT = 0.01
# Name of the body and of the geom of the ball.
BALL = xml_name("thrown ball")
# Where the ball begins to fall until it is thrown, far away from everything, m.
_AWAY = (0.0, 0.0, -1e3)
# Tangential mobility of the surface of a solid sphere, times its mass: 1 + mr²/I with I = ⅖ mr².
_SPIN = 3.5


@checked
@dataclass(frozen=True, kw_only=True)
class Settling(StrictTable):
    """A robot that comes to rest before something happens to it.

    Attributes:
        signs: Signs of the directions, one run each.
        settle: Least time before the impact, s.
        quiet: ``‖ν‖`` below which the impact may come (mixes m/s and rad/s, as the metric of the paper does).
        still: Time for which ``‖ν‖`` must have been below ``quiet``, s.
        patience: Time beyond ``settle`` after which the impact comes although the robot still moves, s.
        after: Time that the run goes on after a push or the flight of a body, s.
    """

    signs: Annotated[tuple[Literal[1, -1], ...], Demand(lambda signs: len(signs) > 0, "1, -1 or both")] = (1, -1)
    settle: NonNegative = 1.0
    quiet: Positive = 0.005
    still: NonNegative = 0.2
    patience: Positive = 20.0
    after: NonNegative = 1.0


@checked
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
    direction: Direction
    window: Positive = 0.3


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


def add_ball(mjcf: Mjcf, throw: Throw) -> None:
    """Add a solid ball that falls freely, after everything else that moves."""
    moment = 0.4 * throw.mass * throw.radius**2
    inertia = {"mass": throw.mass, "ipos": np.zeros(3), "inertia": np.full(3, moment), "explicitinertial": True}
    body = mjcf.spec.worldbody.add_body(name=BALL, pos=_AWAY, **inertia)
    body.add_freejoint()
    sphere = import_mujoco().mjtGeom.mjGEOM_SPHERE
    body.add_geom(name=BALL, type=sphere, size=(throw.radius, 0.0, 0.0), mass=0.0, contype=0, conaffinity=0)


class Ball:
    """The ball of a compiled model.

    Args:
        model: The MuJoCo model.
        throw: The throw.
    """

    def __init__(self, model: Any, throw: Throw) -> None:
        joint = int(model.body(BALL).jntadr[0])
        self._position, self._velocity = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
        self._target = model.geom(xml_name(f"shape {throw.frame}")).id
        way = np.array(throw.direction) / np.linalg.norm(throw.direction)
        self._velocity_0 = throw.speed * way
        self._reach = (throw.radius + float(model.geom_size[self._target, 0]) + FLIGHT * throw.speed) * way

    def throw(self, data: Any, sign: int) -> None:
        """Put the ball where it touches a shape at rest :data:`FLIGHT` later."""
        start = data.geom_xpos[self._target] - sign * self._reach
        data.qpos[self._position : self._position + 7] = [*start, 1.0, 0.0, 0.0, 0.0]
        data.qvel[self._velocity : self._velocity + 6] = [*(sign * self._velocity_0), 0.0, 0.0, 0.0]
