"""Measure the rebound of a contact law: a ball hits it in the very world that robots are simulated in."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from impact_posture.errors import InputError
from impact_posture.robot.robot import Robot
from impact_posture.robot.spec import RobotSpec
from impact_posture.simulation.actuator_command import ActuatorCommand
from impact_posture.simulation.scene import ContactLaw, Physics, Scene, Shape, Surface
from impact_posture.simulation.world import World, build_world

_RADIUS = 0.02
# Time constants of the law after which a contact counts as endless.
_PATIENCE = 200
# Where in a time step the ball touches, as shares of it: restitution depends on that a little.
_PHASES = (0.1, 0.3, 0.5, 0.7, 0.9)


@dataclass(frozen=True)
class Bounce:
    """One impact, averaged over the places in a time step where it may begin.

    Attributes:
        restitution: Normal speed after over before.
        spread: Largest less smallest restitution over those places.
        duration: From the first to the last force, s.
        depth: How deep the ball went, m.
        peak: Largest force times duration over impulse: 1 for a constant force.
    """

    restitution: float
    spread: float
    duration: float
    depth: float
    peak: float


def ideal_restitution(damping: float) -> float:
    """Restitution of ``r'' = −2ζω r' − ω² r``, which lets go when it would have to pull, at any ω.

    ``exp(−2ζ arccos ζ/√(1 − ζ²))`` below ζ = 1, ``e⁻²`` there, ``exp(−2ζ arcosh ζ/√(ζ² − 1))`` above.  A
    :class:`ContactLaw` comes to it as its share d goes to 1 and its time constant is many time steps.

    Args:
        damping: ζ, at least zero.
    """
    if abs(damping - 1) < 1e-9:
        return float(np.exp(-2.0))
    turn = np.arccos(damping) if damping < 1 else np.arccosh(damping)
    return float(np.exp(-2 * damping * turn / np.sqrt(abs(1 - damping**2))))


def ball(mass: float = 1.0, radius: float = _RADIUS) -> Robot:
    """A robot without joints: a solid ball, frame ``ball`` in its center."""
    model = pin.Model()
    joint = model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "root_joint")
    model.appendBodyToJoint(joint, pin.Inertia.FromSphere(mass, radius), pin.SE3.Identity())
    model.addFrame(pin.Frame("ball", joint, 0, pin.SE3.Identity(), pin.FrameType.BODY))
    q = np.asarray(pin.neutral(model))
    return Robot("ball", "", model, "free-flyer", {"neutral": q}, "neutral", RobotSpec())


def measure_restitution(
    law: ContactLaw, *, speed: float = 0.5, timestep: float = Physics().timestep, mass: float = 1.0
) -> Bounce:
    """Let a ball hit a surface squarely, without gravity.

    Args:
        law: Of the surface.
        speed: Of approach, m/s.
        timestep: Of the physics, s.
        mass: Of the ball, kg; makes no difference, since MuJoCo scales the law by the mass that it feels.

    Raises:
        InputError: The ball does not come off, or the law does not fit the time step.
    """
    found = [_one(law, speed, timestep, mass, phase) for phase in _PHASES]
    mean = {key: float(np.mean([getattr(bounce, key) for bounce in found])) for key in Bounce.__annotations__}
    return Bounce(**{**mean, "spread": float(np.ptp([bounce.restitution for bounce in found]))})


def _one(law: ContactLaw, speed: float, timestep: float, mass: float, phase: float) -> Bounce:
    robot = ball(mass)
    scene = Scene(
        surfaces=(Surface("floor", (0, 0, 1), gap=phase * speed * timestep, law=law),),
        shapes=(Shape("ball", size=(_RADIUS,), center=(0, 0, 0)),),
        physics=Physics(timestep, gravity=(0, 0, 0)),
    )
    world = build_world(robot, scene)
    world.reset(robot.posture(), [0, 0, -speed, 0, 0, 0])
    return _follow(world, scene.surfaces[0], speed)


def _follow(world: World, surface: Surface, speed: float) -> Bounce:
    """Step until the surface has let go."""
    law = surface.law
    idle = ActuatorCommand(np.zeros(0), np.zeros(0))
    constant = law.solref[0] if law.solref[0] > 0 else 1 / np.sqrt(-law.solref[0])
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
        raise InputError(f"the ball stays on it (solref {law.solref})", where="contact law", hint="damp it less")
    pushed = np.flatnonzero(forces)
    duration, impulse = (pushed[-1] - pushed[0] + 1) * world.timestep, sum(forces) * world.timestep
    after = float(world.truth().v[2])
    return Bounce(after / speed, 0.0, duration, depth, max(forces) * duration / impulse)
