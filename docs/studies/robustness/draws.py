"""Points of the envelope of a scenario (variations of one value, and random draws), and their simulation setups."""

from __future__ import annotations

import math
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import pinocchio as pin

from docs.studies.core import Vector
from docs.studies.robustness.variations import RANGES, URDF_X, URDF_Z, VARIATIONS
from impact_posture.errors import Infeasible, InputError
from impact_posture.robot.robot_loader import load_robot
from impact_posture.simulation.controller_gains import Gains, StanceGains
from impact_posture.simulation.scenario_file import RepeatedContacts, Scenario, SinglePush, read_scenario
from impact_posture.simulation.seed_variation import stand
from impact_posture.simulation.setup import Setup, set_up
from impact_posture.simulation.world.world import build_world

# Number of contacts at a point.  To save time, this number is smaller than in the scenario files.
COUNT = 2
# Time at the surface and pause between contacts, s, also shorter than in the scenario files.
DWELL, PAUSE = 0.4, 0.6
# Longest time for which a push waits for the robot to rest, s.
PATIENCE = 5.0
# Factor from a friction coefficient to a pyramid inside the cone with a margin of 10 %, as in the scenario files.
_TRUST = 0.9 / math.sqrt(2)
# Size of random changes of the base relative to random changes of the joints.
_BASE = 0.2


@dataclass(frozen=True)
class Draw:
    """One point of the envelope of a scenario.

    Attributes:
        number: Index of the point: first the variations are counted, then the random draws.
        attempt: Number of earlier random draws for this point that were not admissible.
        name: Name of the variation; empty for a random draw.
        values: Changed values, by the names of :data:`RANGES`.  All other values are the values of the shipped
            scenario.
    """

    scenario: str
    number: int
    attempt: int = 0
    seed: int = 0
    name: str = ""
    values: Mapping[str, float] = field(default_factory=dict)


def _generator(scenario: str, number: int, attempt: int, seed: int, what: int = 0) -> np.random.Generator:
    return np.random.default_rng([seed, zlib.crc32(scenario.encode()), number, attempt, what])


def draw(scenario: str, number: int, attempt: int = 0, seed: int = 0) -> Draw:
    """Return a point of the envelope.  Numbers below the number of variations are variations, others random draws."""
    named = list(VARIATIONS[scenario].items())
    if number < len(named):
        name, values = named[number]
        return Draw(scenario, number, 0, seed, name, values)
    rng = _generator(scenario, number - len(named), attempt, seed)
    return Draw(scenario, number, attempt, seed, "", {each.name: each.draw(rng) for each in RANGES[scenario]})


def prepare(chosen: Draw) -> Setup:
    """Build the setup of the simulation for a point.

    Raises:
        ImpactPostureError: The start is outside the limits, or the feet cannot keep their places.
    """
    scenario, v = read_scenario(chosen.scenario), chosen.values
    control = scenario.control
    robust = replace(control.robust, gain=v.get("gain", 1.0) * control.robust.gain)
    # The stiffness of a contact is proportional to the inverse square of its time constant.
    law = v.get("contact", 1.0) ** -0.5
    surfaces = tuple(
        replace(s, friction=v.get("friction", s.friction), solref=(law * s.solref[0], *s.solref[1:]))
        for s in scenario.surfaces
    )
    scenario = replace(
        scenario,
        armature=_armature(scenario, v["armature"]) if "armature" in v else scenario.armature,
        surfaces=surfaces,
        control=replace(control, robust=robust),
    )
    if isinstance(scenario.task, RepeatedContacts):
        return set_up(_contacts(scenario, scenario.task, v))
    pushed = _push(scenario, scenario.task, v)
    shipped = set_up(pushed)
    if "stir" not in v:
        return shipped
    q = _start(shipped, chosen)
    return Setup(pushed, shipped.robot, q, build_world(shipped.robot, pushed, q))


def _armature(scenario: Scenario, factor: float) -> dict[str, float]:
    """Return the scaled armature by joint.  Joints without armature are left out."""
    model = load_robot(scenario.robot, scenario).model
    own = {str(name): float(model.armature[k]) for name, k in zip(model.names, model.idx_vs, strict=True) if k >= 0}
    return {name: factor * value for name, value in own.items() if value > 0}


def _contacts(scenario: Scenario, task: RepeatedContacts, v: Mapping[str, float]) -> Scenario:
    tilt, roll = math.radians(v.get("tilt", 0.0)), math.radians(v.get("roll", 0.0))
    joints = dict(scenario.joints)
    if "shoulder" in v:
        # The elbow compensates the shoulder, so that the tool points at the wall, apart from the tilt.
        joints |= {"shoulder_pitch": v["shoulder"], "elbow_pitch": tilt - math.pi / 2 - v["shoulder"]}
    elif "elbow" in v:
        elbow = v.get("fold", 1.0) * v["elbow"]
        joints |= {"shoulder_pitch": tilt - elbow, "elbow_pitch": elbow}
    x, y, z = scenario.mounting.get("shoulder_roll", (0.0, 0.0, 0.0))
    x, z = v.get("x", URDF_X + x) - URDF_X, v.get("z", URDF_Z + z) - URDF_Z
    return replace(
        scenario,
        joints={**joints, "shoulder_roll": roll},
        mounting={**scenario.mounting, "shoulder_roll": (x, y, z)},
        contacts=replace(task, speed=v.get("speed", task.speed), count=COUNT, dwell=DWELL, pause=PAUSE),
    )


def _push(scenario: Scenario, task: SinglePush, v: Mapping[str, float]) -> Scenario:
    control, stiffer = scenario.control, v.get("stiffness", 1.0)
    footing = control.footing or StanceGains()
    if "friction" in v:
        footing = replace(footing, friction=_TRUST * v["friction"])
    x, y, z = (v.get("force", 1.0) * value for value in task.force)
    return replace(
        scenario,
        push=replace(task, force=(x, y, z), patience=PATIENCE),
        control=replace(
            control,
            footing=footing,
            posture=_stiffer(control.posture, stiffer),
            center_of_mass=control.center_of_mass and _stiffer(control.center_of_mass, stiffer),
            base=control.base and _stiffer(control.base, stiffer),
        ),
    )


def _stiffer(gains: Gains, factor: float) -> Gains:
    """Scale the stiffness of all tasks in a shipped push scenario, with critical damping."""
    if isinstance(gains.kp, tuple) or gains.kd is not None:
        raise InputError("a task with a damping of its own", where="robustness study", hint="scale it too")
    return replace(gains, kp=factor * gains.kp)


def _start(setup: Setup, chosen: Draw) -> Vector:
    """Change the posture of the scenario randomly, and project the result so that the feet keep their places."""
    robot = setup.robot
    rng = _generator(chosen.scenario, chosen.number, chosen.attempt, chosen.seed, what=1)
    step = chosen.values["stir"] * rng.normal(size=robot.nv)
    step[:6] *= _BASE
    q = stand(setup, np.asarray(pin.integrate(robot.model, setup.q, step)))
    if q is None:
        raise Infeasible({"feet": chosen.values["stir"]}, where=f"{chosen.scenario} {chosen.number}")
    return q
