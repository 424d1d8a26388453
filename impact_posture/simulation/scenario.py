"""An experiment: a robot in its surroundings, what happens to it, and which bounds it must keep."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, fields
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from impact_posture.config.option_names import as_keys
from impact_posture.config.settings import FRICTION, RobotSettings, Vector3
from impact_posture.config.toml_tables import Checked
from impact_posture.errors import ImpactPostureError, InputError, JointLocked, NameNotFound, SpecError
from impact_posture.robot.actuation import allocation
from impact_posture.robot.posture_files import read_posture, set_joints
from impact_posture.robot.robot import Robot
from impact_posture.robot.robot_loader import load_robot
from impact_posture.robot.robot_spec import NonNegative, Positive
from impact_posture.simulation.controller_gains import Control
from impact_posture.simulation.world.actuator_command import Push
from impact_posture.simulation.world.scene import Finite, FiniteVector, Scene, Shape, Surface
from impact_posture.simulation.world.throw import Settling, Throw
from impact_posture.simulation.world.world import World, build_world
from impact_posture.system.arrays import Array
from impact_posture.system.progress import tell

SCHEMA = "impact-posture/scenario/1"


@dataclass(frozen=True)
class RepeatedContacts(Checked):
    """The end effector flies into a surface and away again, several times.

    A reference starts where the shape is at the start.  It moves against the normal of the surface until it is
    ``beyond`` behind the surface, stays there, and comes back
    (:mod:`impact_posture.simulation.controllers.contact_reference`).

    Attributes:
        frame: Frame of the shape that touches.
        surface: Name of the surface.
        speed: Speed of the reference at the surface, m/s.
        acceleration: Acceleration of the reference before the surface and on its way back, m/s².
        count: Number of contacts.
        settle: Time before the first approach, s.
        dwell: Time that the reference stays behind the surface, s.
        beyond: Distance of the reference behind the surface, m.
        pause: Time between the way back and the next approach, s.
        window: Time from the first touch that counts as the impact, s.  It is the same for every controller.
    """

    frame: str
    surface: str
    speed: Positive
    acceleration: Positive = 1.0
    count: Annotated[int, Field(ge=1)] = 5
    settle: NonNegative = 4.0
    dwell: Positive = 0.8
    beyond: NonNegative = 0.03
    pause: NonNegative = 1.0
    window: Positive = 0.3


@dataclass(frozen=True)
class SinglePush(Settling):
    """A standing robot is pushed after it has come to rest.

    Attributes:
        frame: Frame that is pushed.
        force: Force of a push with sign 1, world, N.
        duration: Duration of the push and of its impact window, s.
    """

    frame: str
    force: FiniteVector
    duration: Positive = 0.4

    def __post_init__(self) -> None:
        """Refuse a push without force."""
        super().__post_init__()
        if not any(self.force):
            raise InputError("key 'push.force': no force", hint="give newtons, not all zero")

    def push(self, sign: int) -> Push:
        """Return the push of a run."""
        x, y, z = (sign * value for value in self.force)
        return Push(self.frame, (x, y, z), self.duration)


@dataclass(frozen=True)
class Bounds(Checked):
    """Bounds that a run must keep to count (:func:`impact_posture.simulation.outcome.judge`).

    The first three are for a floating base.

    Attributes:
        tilt_deg: Largest angle between vertical and the base axis that was vertical at the start, degrees.
        clearance: Least height of the base origin above every surface, m.
        sink: Largest distance of the base below its start, or below where a reference leads it, m.
        lifted: Longest time that a foot loses its contact, s.
        relaxed: Largest share of relaxed ticks.
        held: Longest time that a command is held, s.
    """

    tilt_deg: Positive = 60.0
    clearance: Finite = 0.0
    sink: Positive = 1.0
    lifted: NonNegative = 0.1
    relaxed: Annotated[float, Field(ge=0, le=1)] = 0.5
    held: NonNegative = 0.05


@dataclass(frozen=True, eq=False, kw_only=True)
class ScenarioTable(Scene, RobotSettings):
    """Content of a ``scenario.toml``.

    Attributes:
        name: Name of the experiment.
        description: One line.
        posture: Name or file of the start posture.  ``None`` takes the default posture of the robot.
        joints: Values that replace those of the start posture, by joint, rad or m.
        contacts: The contacts that the robot makes, or ``None``.
        push: The push, or ``None``.
        throw: The body that is thrown at the robot, or ``None``.  There is one of the three.
        control: The gains.
        bounds: Bounds that a run must keep to count.
    """

    schema: Literal["impact-posture/scenario/1"] = "impact-posture/scenario/1"
    name: str
    description: str = ""
    posture: str | None = None
    joints: Mapping[str, float] = field(default_factory=dict)
    contacts: RepeatedContacts | None = None
    push: SinglePush | None = None
    throw: Throw | None = None
    control: Control
    bounds: Bounds = Bounds()

    @property
    def laws(self) -> tuple[tuple[str, tuple[float, float]], ...]:
        """Name and ``solref`` of all contact laws, with that of a ball."""
        return super().laws if self.throw is None else (*super().laws, ("throw", self.throw.solref))

    def __post_init__(self) -> None:
        """Refuse no task, two tasks, and a task with an unknown shape or surface."""
        super().__post_init__()
        tasks = {key: getattr(self, key) for key in ("contacts", "push", "throw") if getattr(self, key) is not None}
        if len(tasks) != 1:
            both = "both " + " and ".join(f"[{key}]" for key in tasks)
            what = both if tasks else "neither [contacts], [push] nor [throw]"
            raise InputError(f"has {what}", hint="have one of them")
        (task, content), shapes = tasks.popitem(), [s.frame for s in self.shapes]
        names = [] if self.contacts is None else [("surface", self.contacts.surface, [s.name for s in self.surfaces])]
        for key, name, known in (*names, *([] if self.push else [("frame", content.frame, shapes)])):
            if name not in known:
                table = "surfaces" if key == "surface" else "shapes"
                hint = f"one of: {', '.join(known)}" if known else f"add it to [[{table}]]"
                raise InputError(f"key '{task}.{key}': there is no '{name}'", hint=hint)
        for shape in self.shapes if self.throw else ():
            if shape.frame == content.frame and (shape.kind != "sphere" or shape.center is None):
                what = f"a ball is thrown at the {shape.kind} at '{shape.frame}'"
                raise InputError(what, hint="make it a sphere and give its center, at which the ball flies")


_KEYS = {field.name for field in fields(ScenarioTable)}
# Settings of a problem whose key in a scenario has another name.
_RENAMED = {"contact_pose": "control.end_effector.pose"}


@dataclass(frozen=True, eq=False, kw_only=True)
class Scenario(ScenarioTable):
    """An experiment before anything is loaded.

    Attributes:
        source: Path of the file, for errors.
    """

    source: str = ""

    @property
    def task(self) -> RepeatedContacts | SinglePush | Throw:
        """The contacts, the push or the throw."""
        task = self.contacts or self.push or self.throw
        assert task is not None  # noqa: S101 (__post_init__ has checked it)
        return task

    @property
    def signs(self) -> tuple[int, ...]:
        """Signs of the pushes or throws, one run each; none for contacts."""
        return () if isinstance(self.task, RepeatedContacts) else self.task.signs

    @property
    def normal(self) -> Array:
        """Unit normal of the impact, shape (3,): that of the surface, or the direction of the push or throw."""
        given = self.push.force if self.push else self.throw.direction if self.throw else self.surface.normal
        return np.asarray(np.array(given, dtype=float) / np.linalg.norm(given))

    @property
    def friction(self) -> float:
        """Coulomb coefficient of the impact."""
        return FRICTION if self.push else self.throw.friction if self.throw else self.surface.friction

    @property
    def surface(self) -> Surface:
        """The surface that is hit.

        Raises:
            InputError: The robot is pushed instead.
        """
        return next(s for s in self.surfaces if s.name == self._contacts("surface that is hit").surface)

    @property
    def shape(self) -> Shape:
        """The shape that hits the surface, or that is hit.

        Raises:
            InputError: The robot is pushed instead.
        """
        frame = self._contacts("shape that hits").frame if self.throw is None else self.throw.frame
        return next(s for s in self.shapes if s.frame == frame)

    @property
    def offset(self) -> Vector3:
        """Contact point of the shape that hits, center of the one that is hit, or pushed frame, in the frame, m."""
        if self.throw:
            return self.shape.center or (0.0, 0.0, 0.0)
        return self.shape.offset if self.contacts else (0.0, 0.0, 0.0)

    def _contacts(self, what: str) -> RepeatedContacts:
        if self.contacts is None:
            raise InputError(f"there is no {what}", where=self.source, hint="ask only where there are contacts")
        return self.contacts


@dataclass(frozen=True, eq=False)
class Setup:
    """An experiment that is ready to run.

    Attributes:
        scenario: The experiment.
        robot: The loaded robot.
        q: Start posture, shape (nq,).
        world: The simulated world, before its first reset.
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
        ImpactPostureError: Something does not fit.
    """
    tell(f"loading {scenario.robot}")
    with naming_keys(scenario):
        robot = load_robot(scenario.robot, scenario)
        _check_base(robot, scenario)
        if rigid := [joint for joint in scenario.joints if joint in robot.locked]:
            raise JointLocked(rigid[0], where=scenario.source)
        start = read_posture(robot, scenario.posture, where="posture")
        q = set_joints(robot, start, scenario.joints, scenario.source)
        q = robot.check_posture(q, where=scenario.source)
        robot.frame_id(scenario.task.frame)
        return Setup(scenario, robot, q, build_world(robot, scenario, q, scenario.throw))


@contextmanager
def naming_keys(scenario: Scenario) -> Iterator[None]:
    """Let errors name the keys of a scenario and its file, where they name settings."""
    try:
        yield
    except ImpactPostureError as error:
        where = error.where
        if {where.partition(" ")[0], where.rpartition(" ")[2]} & _KEYS and scenario.source:
            where = f"{scenario.source}, {where}"
        elif where in ("", "problem") or (isinstance(error, NameNotFound) and "." not in where):
            # What a robot lacks is named in the scenario, but a key of robot.toml is not.
            where = scenario.source
        error.reword(as_keys(error.what, _RENAMED), where, as_keys(error.hint, _RENAMED))
        raise


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
