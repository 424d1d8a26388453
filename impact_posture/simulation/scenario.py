"""An experiment: a robot in its surroundings, what happens to it, and the gains that all controllers share."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from impact_posture.errors import InputError, SpecError
from impact_posture.progress import tell
from impact_posture.robot.actuation import allocation
from impact_posture.robot.postures import read_posture, set_joints
from impact_posture.robot.robot import Robot
from impact_posture.robot.robot_loader import load_robot
from impact_posture.settings import LoadOptions, Vector3
from impact_posture.simulation.actuator_command import Push
from impact_posture.simulation.scene import Scene, Shape, Surface
from impact_posture.simulation.world import World, build_world

Array = NDArray[np.float64]
EndEffectorPose = Literal["full", "position", "aligned"]


@dataclass(frozen=True)
class RepeatedContacts:
    """The end effector flies into a surface and away again, several times.

    A reference starts where the shape is at the start, moves along the surface's normal to ``beyond`` behind the
    surface, stays there, and comes back (:mod:`impact_posture.simulation.reference`).

    Attributes:
        frame: Of the shape that touches.
        surface: Name of the surface.
        count: How many contacts.
        speed: Of the reference at the surface, m/s.
        acceleration: Of the reference before the surface and on its way back, m/s².
        settle: Seconds before the first approach.
        dwell: Seconds that the reference stays behind the surface.
        beyond: How far behind, m.
        pause: Seconds between coming back and the next approach.
        window: Seconds from the first touch that count as the impact, the same for every controller.
    """

    frame: str
    surface: str
    speed: float
    acceleration: float = 1.0
    count: int = 5
    settle: float = 4.0
    dwell: float = 0.8
    beyond: float = 0.03
    pause: float = 1.0
    window: float = 0.3


@dataclass(frozen=True)
class SinglePush:
    """A robot that stands is pushed once it has come to rest.

    Attributes:
        frame: Where it is pushed.
        force: World, N, for sign +1.
        duration: Seconds; also the window that counts as the impact.
        signs: Which ways: a run for each.
        settle: Least seconds before the push.
        quiet: ``‖ν‖`` below which the push may begin (mixes m/s and rad/s, as the paper's metric does).
        still: Seconds for which it must have been below.
        patience: Seconds beyond ``settle`` after which a robot that is not quiet is pushed all the same.
        after: Seconds that the run goes on after the push.
    """

    frame: str
    force: Vector3
    duration: float = 0.4
    signs: tuple[int, ...] = (1, -1)
    settle: float = 1.0
    quiet: float = 0.005
    still: float = 0.2
    patience: float = 20.0
    after: float = 1.0

    def push(self, sign: int) -> Push:
        """The push of a run."""
        x, y, z = (sign * value for value in self.force)
        return Push(self.frame, (x, y, z), self.duration)


@dataclass(frozen=True)
class Gains:
    """Of one task.

    Attributes:
        kp: Stiffness, 1/s²; one number, or one an entry of the task.
        kd: Damping, 1/s; ``None``: critical, ``2√kp``.
        weight: In the cost, where the task has no level of its own.
    """

    kp: float | tuple[float, ...]
    kd: float | tuple[float, ...] | None = None
    weight: float = 1.0


@dataclass(frozen=True)
class EndEffectorGains(Gains):
    """Of the end effector's task.

    Attributes:
        pose: What is led: the frame's pose (``full``), its ``position``, or with ``aligned`` position and the frame's
            direction that is the surface's normal at the start, spin about it free.
    """

    pose: EndEffectorPose = "full"


@dataclass(frozen=True)
class RobustTerm:
    """The impact-robust term.

    Attributes:
        gain: K of the term that is scaled by the objective's curvature, 1/s²: comparable with the posture's ``kp``.
        ramp: Seconds from off to on.
        fade: Distances from a position limit between which the term fades out, rad (m).
    """

    gain: float
    ramp: float = 0.3
    fade: tuple[float, float] = (0.05, 0.2)


@dataclass(frozen=True)
class StanceGains:
    """How a controller treats the contacts of a robot that stands.

    Attributes:
        friction: Coulomb coefficient that it trusts in.
        least: Least normal force, N (of a sole: of the whole sole).
        force_weight: Of contact forces in the cost, 1/N².
    """

    friction: float = 0.5
    least: float = 1.0
    force_weight: float = 1e-5


@dataclass(frozen=True)
class Control:
    """What all controllers of an experiment have in common; a task without gains is not there.

    Attributes:
        posture: Of the posture task.
        robust: Of the impact-robust term.
        period: Seconds from tick to tick.
        tilt: Of the level base, first priority.
        end_effector: Of the end effector, second priority: linear entries first.
        apparent_mass: M_d of ``F̂/M_d`` in the end effector's law, kg; ``None``: the force is left out.
        center_of_mass: Of the center of mass.
        base: Of the base's orientation.
        footing: Of robots that stand.
    """

    posture: Gains
    robust: RobustTerm
    period: float = 1e-3
    tilt: Gains | None = None
    end_effector: EndEffectorGains | None = None
    apparent_mass: float | None = None
    center_of_mass: Gains | None = None
    base: Gains | None = None
    footing: StanceGains | None = None


@dataclass(frozen=True)
class Bounds:
    """What a run must keep to count (:func:`impact_posture.simulation.outcome.judge`).

    The first three are for a floating base.

    Attributes:
        tilt_deg: Largest angle between vertical and the base's axis that was vertical at the start, degrees.
        clearance: Least height of the base's origin above every surface, m.
        sink: How far the base may be below its start, or below where a reference leads it, m.
        lifted: Longest time without contact of a foot that is to stay, s.
        relaxed: Largest share of relaxed ticks.
        held: Longest time that a command is held for, s.
    """

    tilt_deg: float = 60.0
    clearance: float = 0.0
    sink: float = 1.0
    lifted: float = 0.1
    relaxed: float = 0.5
    held: float = 0.05


@dataclass(frozen=True, eq=False)
class Scenario:
    """An experiment as a file describes it; nothing is loaded yet.

    Attributes:
        name: What it is called.
        source: The file.
        description: One line.
        robot: Known name, path, or ``example-robot-data:`` URI.
        load: How it is loaded.
        posture: Name or file of the start posture; ``None``: the robot's default.
        joints: Values that replace the start posture's, by joint.
        scene: The surroundings.
        task: What happens.
        control: The gains.
        bounds: What a run must keep to count.
    """

    name: str
    source: str
    description: str
    robot: str
    load: LoadOptions
    posture: str | None
    joints: Mapping[str, float]
    scene: Scene
    task: RepeatedContacts | SinglePush
    control: Control
    bounds: Bounds = Bounds()

    @property
    def normal(self) -> Array:
        """Unit normal of the impact, shape (3,): the surface's, or along the push."""
        task = self.task
        if isinstance(task, RepeatedContacts):
            n = np.array(self.surface.normal, dtype=float)
        else:
            n = np.array(task.force, dtype=float)
        return np.asarray(n / np.linalg.norm(n))

    @property
    def surface(self) -> Surface:
        """The surface that is hit.

        Raises:
            InputError: The robot is pushed instead.
        """
        if isinstance(self.task, RepeatedContacts):
            return next(s for s in self.scene.surfaces if s.name == self.task.surface)
        raise self._without("surface that is hit")

    @property
    def shape(self) -> Shape:
        """The shape that hits it.

        Raises:
            InputError: The robot is pushed instead.
        """
        if isinstance(self.task, RepeatedContacts):
            return next(s for s in self.scene.shapes if s.frame == self.task.frame)
        raise self._without("shape that hits")

    def _without(self, what: str) -> InputError:
        return InputError(f"there is no {what}", where=self.source, hint="ask only where there are contacts")


@dataclass(frozen=True, eq=False)
class Setup:
    """An experiment ready to run.

    Attributes:
        scenario: What was asked for.
        robot: Its robot.
        q: Start posture, shape (nq,).
        world: Not reset yet.
    """

    scenario: Scenario
    robot: Robot
    q: Array
    world: World

    @property
    def gap(self) -> float:
        """Distance of the shape that hits from its surface at the start, m.

        Raises:
            InputError: The robot is pushed instead.
        """
        return self.world.built.gaps[self.scenario.surface.name, self.scenario.shape.frame]


def set_up(scenario: Scenario) -> Setup:
    """Load the robot, pose it, and build the world around it.

    Raises:
        ImpactPostureError: The first thing that does not fit, in one line.
    """
    tell(f"loading {scenario.robot}")
    robot = load_robot(scenario.robot, scenario.load)
    _check_base(robot, scenario)
    q = set_joints(robot, read_posture(robot, scenario.posture, where="posture"), scenario.joints, scenario.source)
    q = robot.check_posture(q, where=scenario.source)
    robot.frame_id(scenario.task.frame)
    return Setup(scenario, robot, q, build_world(robot, scenario.scene, q))


def _check_base(robot: Robot, scenario: Scenario) -> None:
    """Refuse a floating base that nothing holds, or that its rotors cannot push in every direction."""
    if not robot.floating or scenario.control.footing is not None:
        return
    propulsion = robot.spec.propulsion
    if propulsion is None:
        feet = "add [control.footing] to the scenario" if robot.spec.supports else (
            "add [propulsion] or [[supports]] to its robot.toml, or set root to fixed"
        )  # fmt: skip
        missing = "the scenario has no [control.footing]" if robot.spec.supports else "its data names no feet"
        raise SpecError(f"{robot.name} would fall: it has no rotors and {missing}", where=scenario.source, hint=feet)
    rank = allocation(robot.model, propulsion).rank
    if rank < 6:
        raise SpecError(
            f"the rotors of {robot.name} push and turn its base in {rank} of 6 directions",
            where=scenario.source,
            hint="the controllers need all 6: tilt the rotors, or take another robot",
        )
