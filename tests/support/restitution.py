"""Restitution of a contact law, measured with a simulated ball."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from impact_posture.errors import InputError
from impact_posture.robot.robot import Robot
from impact_posture.robot.robot_spec import RobotSpec
from impact_posture.simulation.world.actuator_command import ActuatorCommand
from impact_posture.simulation.world.contact_law import PHASES, ContactLaw
from impact_posture.simulation.world.scene import Physics, Scene, Shape, Surface
from impact_posture.simulation.world.world import World, build_world

_RADIUS = 0.02
# A contact that lasts longer than this number of time constants counts as a contact that never ends.
_PATIENCE = 200


@dataclass(frozen=True)
class Bounce:
    """Measured impact, averaged over several fractions of a time step at which the first touch occurs.

    Attributes:
        restitution: Normal speed after the impact, divided by the normal speed before.
        spread: Largest minus smallest restitution over the tested moments of touch.
        duration: Duration of the contact force, s.
        depth: Largest penetration of the ball, m.
        peak: Peak force times duration, divided by the impulse; 1 if the force is constant.
    """

    restitution: float
    spread: float
    duration: float
    depth: float
    peak: float


def ideal_restitution(damping: float) -> float:
    """Return the restitution of ``r'' = −2ζω r' − ω² r`` for any ω; the contact ends when its force vanishes.

    The value is ``exp(−2ζ arccos ζ/√(1 − ζ²))`` for ζ < 1, ``e⁻²`` for ζ = 1, ``exp(−2ζ arcosh ζ/√(ζ² − 1))`` for ζ >
    1.  A :class:`ContactLaw` approaches this value if d is near 1 and T is many time steps.

    Args:
        damping: Damping ratio ζ, at least zero.
    """
    if abs(damping - 1) < 1e-9:
        return float(np.exp(-2.0))
    turn = np.arccos(damping) if damping < 1 else np.arccosh(damping)
    return float(np.exp(-2 * damping * turn / np.sqrt(abs(1 - damping**2))))


def ball(mass: float = 1.0, radius: float = _RADIUS) -> Robot:
    """Return a robot without joints: a solid ball with the frame ``ball`` at its center."""
    model = pin.Model()
    joint = model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "root_joint")
    model.appendBodyToJoint(joint, pin.Inertia.FromSphere(mass, radius), pin.SE3.Identity())
    model.addFrame(pin.Frame("ball", joint, 0, pin.SE3.Identity(), pin.FrameType.BODY))
    q = np.asarray(pin.neutral(model))
    return Robot("ball", "", model, "free-flyer", {"neutral": q}, "neutral", RobotSpec())


def measure_restitution(
    law: ContactLaw, *, speed: float = 0.5, timestep: float = Physics().timestep, mass: float = 1.0
) -> Bounce:
    """Let a ball hit a surface along the normal, without gravity.

    Args:
        speed: Approach speed, m/s.
        timestep: Time step of the physics, s.
        mass: Mass of the ball, kg.  The result does not depend on the mass, because MuJoCo scales the law.

    Raises:
        InputError: The ball stays on the surface, or the time step is too long for the law.
    """
    bounces = [_one(law, speed, timestep, mass, phase) for phase in PHASES]
    restitutions = [b.restitution for b in bounces]
    return Bounce(
        restitution=float(np.mean(restitutions)),
        spread=float(np.ptp(restitutions)),
        duration=_mean(bounces, "duration"),
        depth=_mean(bounces, "depth"),
        peak=_mean(bounces, "peak"),
    )


def _one(law: ContactLaw, speed: float, timestep: float, mass: float, phase: float) -> Bounce:
    robot = ball(mass)
    scene = Scene(
        surfaces=(Surface("floor", (0, 0, 1), gap=phase * speed * timestep, **vars(law)),),
        shapes=(Shape("ball", size=(_RADIUS,), center=(0, 0, 0)),),
        physics=Physics(timestep, gravity=(0, 0, 0)),
    )
    world = build_world(robot, scene)
    world.reset(robot.posture(), [0, 0, -speed, 0, 0, 0])
    return _follow(world, scene.surfaces[0], speed)


def _follow(world: World, surface: Surface, speed: float) -> Bounce:
    """Step the simulation until the contact ends."""
    idle = ActuatorCommand(np.zeros(0), np.zeros(0))
    time = surface.solref[0]
    constant = time if time > 0 else 1 / np.sqrt(-time)
    forces, depth, ended = [0.0], 0.0, False
    for _ in range(int(_PATIENCE * constant / world.timestep)):
        world.step(idle)
        truth = world.truth()
        forces.append(float(truth.shapes[0].force[2]))
        depth = max(depth, -surface.gap - float(truth.q[2]))
        ended = forces[-1] == 0 and max(forces) > 0
        if ended:
            break
    if not ended:
        raise InputError(
            f"the ball does not leave the surface (solref {surface.solref})", where="contact law", hint="damp it less"
        )
    pushed = np.flatnonzero(forces)
    duration, impulse = (pushed[-1] - pushed[0] + 1) * world.timestep, sum(forces) * world.timestep
    after = float(world.truth().v[2])
    return Bounce(after / speed, 0.0, duration, depth, max(forces) * duration / impulse)


def _mean(bounces: Sequence[Bounce], name: str) -> float:
    return float(np.mean([getattr(bounce, name) for bounce in bounces]))
