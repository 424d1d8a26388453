"""Random variations of the shipped scenarios: what varies, within which ranges, and how a draw becomes a setup."""

from __future__ import annotations

import math
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import pinocchio as pin

from impact_posture.errors import Infeasible, InputError
from impact_posture.posture.build_problem import build_problem
from impact_posture.posture.problem import Requirements
from impact_posture.posture.starts import Projector
from impact_posture.robot.robot_loader import load_robot
from impact_posture.simulation.control import Control, Gains, StanceGains
from impact_posture.simulation.scenario import RepeatedContacts, Scenario, Setup, SinglePush, set_up
from impact_posture.simulation.scenario_file import read_scenario
from impact_posture.simulation.scenario_objective import scenario_objective
from impact_posture.simulation.world import build_world
from tests.benchmarks.core import Vector

# To bound the time, the same for every draw and less than in the scenarios' files: contacts, seconds behind the
# surface and between contacts; seconds for which a push waits for a robot that does not come to rest.
COUNT, DWELL, PAUSE = 2, 0.4, 0.6
PATIENCE = 5.0
# A pyramid inside the cone, with a tenth to spare: as in the scenarios' files.
_TRUST = 0.9 / math.sqrt(2)
# M that the center of mass of a robot that stands stays inside its feet's polygon.
_COM_MARGIN = 0.02
# Of a base's own tilt and way, the share of what joints are stirred by.
_BASE = 0.2


@dataclass(frozen=True)
class Range:
    """What a draw chooses, from low to high: ``linear``, ``log``, or ``sign`` (one of the two ends)."""

    name: str
    low: float
    high: float
    words: str
    scale: str = "linear"

    def draw(self, rng: np.random.Generator) -> float:
        """Choose a value."""
        if self.scale == "sign":
            return self.low if rng.random() < 0.5 else self.high
        if self.scale == "log":
            return float(np.exp(rng.uniform(np.log(self.low), np.log(self.high))))
        return float(rng.uniform(self.low, self.high))

    def text(self) -> str:
        """The range, as the page shows it."""
        how = {"linear": "{} … {}", "log": "{} … {}, log-uniform", "sign": "{} or {}"}[self.scale]
        return how.format(f"{self.low:g}", f"{self.high:g}")


_COMMON = (
    Range("armature", 0.1, 3.0, "armature of every joint, times the scenario's", "log"),
    Range("gain", 0.25, 4.0, "K, times the scenario's", "log"),
)
_TOOL = (
    Range("tilt", -5.0, 5.0, "tool off the normal, in the arm's plane, degrees"),
    Range("roll", -3.0, 3.0, "tool off the normal, across, degrees"),
)


def _pushed(stir: float) -> tuple[Range, ...]:
    words = "start: size of random changes of the joints, rad, pulled back onto the feet's places"
    return (
        Range("stir", 0.02, stir, words),
        Range("force", 0.6, 1.4, "push, times the scenario's"),
        Range("sign", -1.0, 1.0, "way of the push", "sign"),
        Range("stiffness", 0.5, 2.0, "gains of center of mass, base and posture, times the scenario's", "log"),
        Range("friction", 0.5, 1.0, "friction of the ground"),
        *_COMMON,
    )


RANGES: dict[str, tuple[Range, ...]] = {
    "aerial-vertical": (
        Range("elbow", 0.4, 1.2, "start: elbow's bend, rad; shoulder so that the tool looks at the floor"),
        Range("fold", -1.0, 1.0, "start: which way the elbow bends", "sign"),
        *_TOOL,
        Range("speed", 0.25, 0.6, "approach, m/s"),
        Range("x", -0.04, 0.10, "shoulder's pitch axis ahead of the base's center, m"),
        Range("z", -0.10, -0.02, "shoulder's height over the base's center, m"),
        *_COMMON,
    ),
    "aerial-lateral": (
        Range("shoulder", -1.9, -0.6, "start: shoulder's pitch, rad; elbow so that the tool looks at the wall"),
        *_TOOL,
        Range("speed", 0.2, 0.45, "approach, m/s"),
        Range("x", 0.0, 0.13, "shoulder's pitch axis ahead of the base's center, m"),
        Range("z", -0.10, 0.0, "shoulder's height over the base's center, m"),
        *_COMMON,
    ),
    # A quadruped stands in more ways than a humanoid.
    "solo8-push": _pushed(0.3),
    "talos-push": _pushed(0.15),
}
# Where the URDF has the shoulder's pitch axis, m.
_URDF_X, _URDF_Z = 0.08, -0.06


@dataclass(frozen=True)
class Draw:
    """Values of one configuration by the names of the ranges, after ``attempt`` draws that were not admissible."""

    scenario: str
    number: int
    attempt: int
    seed: int
    values: Mapping[str, float]


def _generator(scenario: str, number: int, attempt: int, seed: int, what: int = 0) -> np.random.Generator:
    return np.random.default_rng([seed, zlib.crc32(scenario.encode()), number, attempt, what])


def draw(scenario: str, number: int, attempt: int = 0, seed: int = 0) -> Draw:
    """Draw a configuration: the same every time."""
    rng = _generator(scenario, number, attempt, seed)
    values = {each.name: each.draw(rng) for each in RANGES[scenario]}
    return Draw(scenario, number, attempt, seed, values)


def prepare(chosen: Draw) -> Setup:
    """Build what was drawn.

    Raises:
        ImpactPostureError: A start that is none: outside the limits, or not on the feet.
    """
    scenario = read_scenario(chosen.scenario)
    scenario = replace(scenario, armature=_armature(scenario, chosen.values["armature"]))
    if isinstance(scenario.task, RepeatedContacts):
        return set_up(_contacts(scenario, scenario.task, chosen.values))
    pushed = _push(scenario, scenario.task, chosen.values)
    shipped = set_up(pushed)
    q = _start(shipped, chosen)
    return Setup(pushed, shipped.robot, q, build_world(shipped.robot, pushed, q))


def _armature(scenario: Scenario, factor: float) -> dict[str, float]:
    """By joint; those that have none stay without."""
    model = load_robot(scenario.robot, scenario).model
    own = {str(name): float(model.armature[k]) for name, k in zip(model.names, model.idx_vs, strict=True) if k >= 0}
    return {name: factor * value for name, value in own.items() if value > 0}


def _robust(control: Control, factor: float) -> Control:
    return replace(control, robust=replace(control.robust, gain=factor * control.robust.gain))


def _contacts(scenario: Scenario, task: RepeatedContacts, v: Mapping[str, float]) -> Scenario:
    tilt, roll = math.radians(v["tilt"]), math.radians(v["roll"])
    elbow = v["fold"] * v["elbow"] if "elbow" in v else tilt - math.pi / 2 - v["shoulder"]
    shoulder = v.get("shoulder", tilt - elbow)
    return replace(
        scenario,
        joints={"shoulder_roll": roll, "shoulder_pitch": shoulder, "elbow_pitch": elbow},
        mounting={"shoulder_roll": (v["x"] - _URDF_X, 0.0, v["z"] - _URDF_Z)},
        contacts=replace(task, speed=v["speed"], count=COUNT, dwell=DWELL, pause=PAUSE),
        control=_robust(scenario.control, v["gain"]),
    )


def _push(scenario: Scenario, task: SinglePush, v: Mapping[str, float]) -> Scenario:
    control, (x, y, z), stiffer = scenario.control, task.force, v["stiffness"]
    footing = replace(control.footing or StanceGains(), friction=_TRUST * v["friction"])
    surfaces = tuple(replace(s, friction=v["friction"]) for s in scenario.surfaces)
    force = (v["force"] * x, v["force"] * y, v["force"] * z)
    return replace(
        scenario,
        surfaces=surfaces,
        push=replace(task, force=force, signs=(int(v["sign"]),), patience=PATIENCE),
        control=replace(
            _robust(control, v["gain"]),
            footing=footing,
            posture=_stiffer(control.posture, stiffer),
            center_of_mass=control.center_of_mass and _stiffer(control.center_of_mass, stiffer),
            base=control.base and _stiffer(control.base, stiffer),
        ),
    )


def _stiffer(gains: Gains, factor: float) -> Gains:
    """The shipped pushes have one stiffness a task, critically damped."""
    if isinstance(gains.kp, tuple) or gains.kd is not None:
        raise InputError("a task with a damping of its own", where="robustness study", hint="scale it too")
    return replace(gains, kp=factor * gains.kp)


def _start(setup: Setup, chosen: Draw) -> Vector:
    """The scenario's posture, stirred and put back on its feet."""
    robot = setup.robot
    rng = _generator(chosen.scenario, chosen.number, chosen.attempt, chosen.seed, what=1)
    hold = tuple(j for j in robot.spec.constraints.hold if j not in robot.locked)
    requirements = Requirements(
        contact_pose="free", hold=hold, com_over_feet=True, com_margin=_COM_MARGIN, com_asked=False
    )
    problem = build_problem(robot, scenario_objective(setup), setup.q, requirements)
    step = chosen.values["stir"] * rng.normal(size=robot.nv)
    step[:6] *= _BASE
    found = Projector(problem).project(np.asarray(pin.integrate(robot.model, setup.q, step)))
    if found.violation > 1e-8:
        raise Infeasible({"feet": found.violation}, where=f"{chosen.scenario} {chosen.number}")
    return robot.check_posture(found.q, where=chosen.scenario)
