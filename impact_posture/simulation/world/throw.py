"""Ball that is thrown at a robot: the ball in MuJoCo, and its impact in the rigid model."""

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

# Time from the launch to the touch of a shape at rest, s.  In this short time, gravity bends the flight by less than
# a millimeter.
FLIGHT = 0.01
# Name of the body and of the geom of the ball.
BALL = xml_name("thrown ball")
# Position of the ball before the throw, m.  It falls there, far away from the robot.
_AWAY = (0.0, 0.0, -1e3)
# Tangential mobility of the surface of a solid sphere, times its mass: 1 + mr²/I with I = ⅖ mr².
_SPIN = 3.5


@checked
@dataclass(frozen=True, kw_only=True)
class Settling(StrictTable):
    """Time in which a robot comes to rest before a push or throw.

    Attributes:
        signs: Signs of the direction, one run each.
        settle: Least time before the impact, s.
        quiet: ``‖ν‖`` below which the impact may come (mixes m/s and rad/s, as the metric of the paper does).
        still: Time for which ``‖ν‖`` must have been below ``quiet``, s.
        patience: Time after ``settle`` when the impact comes although the robot still moves, s.
        after: Duration of the run after the push or throw, s.
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
    """Throw of a solid ball at a shape of a robot at rest.

    The ball starts :data:`FLIGHT` before the touch.  It flies straight at the center of the shape, which must be a
    sphere.  A frictionless impulse then passes through the center for every orientation of the shape.

    Attributes:
        frame: Frame of the shape that is hit.
        mass: Mass of the ball, kg.
        radius: Radius of the ball, m.
        speed: Speed of the ball, m/s.
        direction: Direction of flight for sign 1, world, any length.
        window: Length of the impact window from the first touch on, s.
    """

    frame: str
    mass: Positive
    radius: Positive
    speed: Positive
    direction: Direction
    window: Positive = 0.3


def thrown_jumps(oracle: ImpactOracle, q: Array, throw: Throw, speed: float) -> tuple[float, float, float]:
    """Return the velocity jumps ``‖Δν‖`` of the robot: without friction, sticking, and with the friction of the ball.

    The contact has the mobility ``B = J M⁻¹Jᵀ`` of the robot plus ``D`` of the ball, which is ``1/m`` along the
    normal and ``3.5/m`` across it.  Without rebound, the impulse is ``v n/(nᵀ(B + D)n)`` without friction and
    ``v (B + D)⁻¹n`` if the ball sticks.  A sliding ball is assumed to slide against its sticking impulse.  ``v`` is
    the approach ``speed``, m/s, and ``n`` the normal of the oracle, which is the direction of flight.
    """
    quantities = oracle.quantities(q)
    n, jump_per_impulse = quantities.normal, oracle.solve(oracle.J.T)
    across = np.eye(3) - np.outer(n, n)
    mobility = quantities.mobility + (np.outer(n, n) + _SPIN * across) / throw.mass
    frictionless, sticking = n / float(n @ mobility @ n), np.linalg.solve(mobility, n)
    normal, tangent = float(n @ sticking), across @ sticking
    coulomb, drag = sticking, float(np.linalg.norm(tangent))
    if drag > throw.friction * normal:
        direction = n + throw.friction * tangent / drag
        coulomb = direction / float(n @ mobility @ direction)
    impulses = (frictionless, sticking, coulomb)
    a, b, c = (speed * float(np.linalg.norm(jump_per_impulse @ impulse)) for impulse in impulses)
    return a, b, c


def add_ball(mjcf: Mjcf, throw: Throw) -> None:
    """Add a solid ball that falls freely, as the last body that moves."""
    moment = 0.4 * throw.mass * throw.radius**2
    inertia = {"mass": throw.mass, "ipos": np.zeros(3), "inertia": np.full(3, moment), "explicitinertial": True}
    body = mjcf.spec.worldbody.add_body(name=BALL, pos=_AWAY, **inertia)
    body.add_freejoint()
    sphere = import_mujoco().mjtGeom.mjGEOM_SPHERE
    body.add_geom(name=BALL, type=sphere, size=(throw.radius, 0.0, 0.0), mass=0.0, contype=0, conaffinity=0)


class Ball:
    """Ball of a compiled model."""

    def __init__(self, model: Any, throw: Throw) -> None:
        joint = int(model.body(BALL).jntadr[0])
        self._position, self._velocity = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
        self._target = model.geom(xml_name(f"shape {throw.frame}")).id
        direction = np.array(throw.direction) / np.linalg.norm(throw.direction)
        self._velocity_0 = throw.speed * direction
        self._reach = (throw.radius + float(model.geom_size[self._target, 0]) + FLIGHT * throw.speed) * direction

    def throw(self, data: Any, sign: int) -> None:
        """Place the ball so that it touches a shape at rest after :data:`FLIGHT`."""
        start = data.geom_xpos[self._target] - sign * self._reach
        data.qpos[self._position : self._position + 7] = [*start, 1.0, 0.0, 0.0, 0.0]
        data.qvel[self._velocity : self._velocity + 6] = [*(sign * self._velocity_0), 0.0, 0.0, 0.0]
