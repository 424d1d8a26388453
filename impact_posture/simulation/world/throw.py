"""Ball that is thrown at a robot: the ball in MuJoCo, and its impact in the rigid-body model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np

from impact_posture.config.checked import checked
from impact_posture.config.demand import Demand, Direction, NonNegative, Positive
from impact_posture.config.table_validation import StrictTable
from impact_posture.dynamics.mjcf import Mjcf
from impact_posture.impact.quantities.impact_oracle import ImpactOracle
from impact_posture.simulation.world.contact_law import ContactLaw
from impact_posture.system.arrays import Array
from impact_posture.system.escape import xml_name
from impact_posture.system.optional_package import import_mujoco

# Time from the launch until the ball touches a shape at rest, s.  In this short time, gravity deflects the ball by
# less than a millimeter.
FLIGHT = 0.01
# Name of the body and of the geom of the ball.
BALL = xml_name("thrown ball")
# Position of the ball at the start of a run, m.  Until the throw, the ball falls freely, far away from the robot.
_AWAY = (0.0, 0.0, -1e3)
# Tangential mobility at the surface of a solid sphere times the mass of the sphere: 1 + mr²/I with I = ⅖ mr².
_SPIN = 3.5


@checked
@dataclass(frozen=True, kw_only=True)
class Settling(StrictTable):
    """Conditions for the start of a push or throw: the robot must have come to rest.

    Attributes:
        signs: Signs of the direction; each sign is simulated in its own run.
        settle: Minimum time before the push or throw, s.
        quiet: The robot is at rest if ``‖ν‖`` is below this value (mixes m/s and rad/s, like the paper's metric).
        still: Time for which ``‖ν‖`` must stay below ``quiet`` before the push or throw, s.
        patience: Time after ``settle`` at which the push or throw starts even if the robot still moves, s.
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

    The ball starts :data:`FLIGHT` before it touches the shape.  The shape must be a sphere, and the ball flies
    straight towards the center of this sphere.  The frictionless impulse then passes through the center of the shape.

    Attributes:
        frame: Frame of the shape at which the ball is thrown.
        mass: Mass of the ball, kg.
        radius: Radius of the ball, m.
        speed: Speed of the ball, m/s.
        direction: Direction of flight for sign 1, in world axes, of any length.
        window: Duration of the impact window, which starts at the first touch, s.
    """

    frame: str
    mass: Positive
    radius: Positive
    speed: Positive
    direction: Direction
    window: Positive = 0.3


def thrown_impulses(oracle: ImpactOracle, q: Array, throw: Throw, speed: float) -> tuple[Array, Array, Array]:
    """Return three impulses of the ball, shape (3,) each: for no friction, for sticking, and for its friction.

    The mobility at the contact is ``B + D``.  ``B = J M⁻¹Jᵀ`` is the mobility of the robot.  The mobility ``D`` of
    the ball is ``1/m`` along the normal and ``3.5/m`` in the tangent plane.  Without rebound, the impulse is
    ``v n/(nᵀ(B + D)n)`` without friction and ``v (B + D)⁻¹n`` if the ball sticks.  If the ball slides, its friction
    force is assumed to have the tangential direction of the sticking impulse.  ``v`` is the approach ``speed``, m/s.
    ``n`` is the normal of the oracle, which is the direction of flight.
    """
    quantities = oracle.quantities(q)
    n = quantities.normal
    across = np.eye(3) - np.outer(n, n)
    mobility = quantities.mobility + (np.outer(n, n) + _SPIN * across) / throw.mass
    frictionless, sticking = n / float(n @ mobility @ n), np.linalg.solve(mobility, n)
    normal, tangent = float(n @ sticking), across @ sticking
    coulomb, drag = sticking, float(np.linalg.norm(tangent))
    if drag > throw.friction * normal:
        direction = n + throw.friction * tangent / drag
        coulomb = direction / float(n @ mobility @ direction)
    a, b, c = (np.asarray(speed * impulse, dtype=float) for impulse in (frictionless, sticking, coulomb))
    return a, b, c


def thrown_jumps(oracle: ImpactOracle, q: Array, throw: Throw, speed: float) -> tuple[float, float, float]:
    """Return the robot's velocity jumps ``‖Δν‖`` under each of :func:`thrown_impulses`."""
    impulses = thrown_impulses(oracle, q, throw, speed)
    a, b, c = (float(np.linalg.norm(oracle.solve(oracle.J.T @ impulse))) for impulse in impulses)
    return a, b, c


def add_ball(mjcf: Mjcf, throw: Throw) -> None:
    """Add a solid, freely moving ball to the model, after all other moving bodies."""
    moment = 0.4 * throw.mass * throw.radius**2
    inertia = {"mass": throw.mass, "ipos": np.zeros(3), "inertia": np.full(3, moment), "explicitinertial": True}
    body = mjcf.spec.worldbody.add_body(name=BALL, pos=_AWAY, **inertia)
    body.add_freejoint()
    sphere = import_mujoco().mjtGeom.mjGEOM_SPHERE
    body.add_geom(name=BALL, type=sphere, size=(throw.radius, 0.0, 0.0), mass=0.0, contype=0, conaffinity=0)


class Ball:
    """Ball in a compiled MuJoCo model."""

    def __init__(self, model: Any, throw: Throw) -> None:
        joint = int(model.body(BALL).jntadr[0])
        self._position, self._velocity = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
        self._target = model.geom(xml_name(f"shape {throw.frame}")).id
        direction = np.array(throw.direction) / np.linalg.norm(throw.direction)
        self._velocity_0 = throw.speed * direction
        self._reach = (throw.radius + float(model.geom_size[self._target, 0]) + FLIGHT * throw.speed) * direction

    def throw(self, data: Any, sign: int) -> None:
        """Place the ball and set its velocity, so that the ball touches a shape at rest after :data:`FLIGHT`."""
        start = data.geom_xpos[self._target] - sign * self._reach
        data.qpos[self._position : self._position + 7] = [*start, 1.0, 0.0, 0.0, 0.0]
        data.qvel[self._velocity : self._velocity + 6] = [*(sign * self._velocity_0), 0.0, 0.0, 0.0]
