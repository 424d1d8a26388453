"""Content of ``scenario.toml``: the tables and keys of an experiment, which are checked when the file is read."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from impact_posture.config.checked import checked
from impact_posture.config.demand import Direction, Finite, NonNegative, OneOrMore, Positive, Share, Vector3
from impact_posture.config.problem_settings import FRICTION, RobotSettings
from impact_posture.config.table_validation import StrictTable, read_toml, validate
from impact_posture.errors import InputError, ScenarioNotFound, SpecError, shown
from impact_posture.robot.robot_loader import from_folder
from impact_posture.simulation.controller_gains import Control
from impact_posture.simulation.world.actuator_command import Push
from impact_posture.simulation.world.scene import Scene, Shape, Surface
from impact_posture.simulation.world.throw import Settling, Throw
from impact_posture.system.arrays import Array

SCHEMA = "impact-posture/scenario/1"
SHIPPED = Path(__file__).parent / "scenarios"


@checked
@dataclass(frozen=True)
class RepeatedContacts(StrictTable):
    """The end effector moves into a surface and back, several times.

    The reference starts at the shape.  It moves against the normal until it is ``beyond`` behind the surface, stays
    there, and returns (:mod:`impact_posture.simulation.controllers.contact_reference`).

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
        window: Length of the impact window from the first touch on, s.
    """

    frame: str
    surface: str
    speed: Positive
    acceleration: Positive = 1.0
    count: OneOrMore = 5
    settle: NonNegative = 4.0
    dwell: Positive = 0.8
    beyond: NonNegative = 0.03
    pause: NonNegative = 1.0
    window: Positive = 0.3


@checked
@dataclass(frozen=True)
class SinglePush(Settling):
    """Push of a robot that stands and has come to rest.

    Attributes:
        frame: Frame that is pushed.
        force: Force of a push with sign 1, world, N.
        duration: Duration of the push and of its impact window, s.
    """

    frame: str
    force: Direction
    duration: Positive = 0.4

    def push(self, sign: int) -> Push:
        """Return the push of a run."""
        x, y, z = (sign * value for value in self.force)
        return Push(self.frame, (x, y, z), self.duration)


@checked
@dataclass(frozen=True)
class Bounds(StrictTable):
    """Bounds that a run must keep to count (:func:`impact_posture.simulation.outcome.judge`).

    The first three are for a floating base.

    Attributes:
        tilt_deg: Largest angle between the vertical and the base axis that was vertical at the start, degrees.
        clearance: Least height of the base origin above every surface, m.
        sink: Largest distance of the base below its start, or below its reference, m.
        lifted: Longest loss of contact of a foot, s.
        relaxed: Largest share of relaxed ticks.
        held: Longest time for which a command is held, s.
    """

    tilt_deg: Positive = 60.0
    clearance: Finite = 0.0
    sink: Positive = 1.0
    lifted: NonNegative = 0.1
    relaxed: Share = 0.5
    held: NonNegative = 0.05


@checked
@dataclass(frozen=True, eq=False, kw_only=True)
class ScenarioTable(Scene, RobotSettings):
    """Content of a ``scenario.toml``.

    Attributes:
        name: Name of the experiment.
        description: One line.
        posture: Name or file of the start posture.  ``None`` takes the default posture of the robot.
        joints: Values by joint that replace values of the start posture, rad or m.
        contacts: The contacts, or ``None``.
        push: The push, or ``None``.
        throw: The ball that is thrown at the robot, or ``None``.  Exactly one of the three is set.
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
        """Name and ``solref`` of all contact laws, including the ball."""
        return super().laws if self.throw is None else (*super().laws, ("throw", self.throw.solref))

    def __post_init__(self) -> None:
        """Refuse a scenario without exactly one task, and a task with an unknown shape or surface."""
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


@checked
@dataclass(frozen=True, eq=False, kw_only=True)
class Scenario(ScenarioTable):
    """Experiment as its file describes it, before the robot is loaded.  Errors name the file, ``source``."""

    source: str = ""

    @property
    def task(self) -> RepeatedContacts | SinglePush | Throw:
        """The contacts, the push or the throw."""
        task = self.contacts or self.push or self.throw
        assert task is not None  # noqa: S101 (__post_init__ has checked it)
        return task

    @property
    def signs(self) -> tuple[int, ...]:
        """Sign of each run of a push or throw; empty for contacts."""
        return () if isinstance(self.task, RepeatedContacts) else self.task.signs

    @property
    def normal(self) -> Array:
        """Unit normal of the surface, or direction of the push or throw, shape (3,)."""
        direction = self.push.force if self.push else self.throw.direction if self.throw else self.surface.normal
        return np.asarray(np.array(direction, dtype=float) / np.linalg.norm(direction))

    @property
    def friction(self) -> float:
        """Coulomb coefficient of the impact."""
        return FRICTION if self.push else self.throw.friction if self.throw else self.surface.friction

    @property
    def surface(self) -> Surface:
        """The surface that is hit.  Raises an InputError if the robot is pushed."""
        return next(s for s in self.surfaces if s.name == self._contacts("surface that is hit").surface)

    @property
    def shape(self) -> Shape:
        """The shape that hits the surface, or that is hit.  Raises an InputError if the robot is pushed."""
        frame = self._contacts("shape that hits").frame if self.throw is None else self.throw.frame
        return next(s for s in self.shapes if s.frame == frame)

    @property
    def offset(self) -> Vector3:
        """Contact point in the frame of the task, m: of the shape, center of a shape that is hit, or frame origin."""
        if self.throw:
            return self.shape.center or (0.0, 0.0, 0.0)
        return self.shape.offset if self.contacts else (0.0, 0.0, 0.0)

    def _contacts(self, what: str) -> RepeatedContacts:
        if self.contacts is None:
            raise InputError(f"there is no {what}", where=self.source, hint="ask only where there are contacts")
        return self.contacts


def known_scenarios() -> tuple[str, ...]:
    """Return the sorted names of the scenarios that need no path."""
    return tuple(sorted(path.stem for path in SHIPPED.glob("*.toml")))


def read_scenario(scenario: str | Path) -> Scenario:
    """Read a shipped scenario by name, or another scenario from its file.  Paths in a file start from its folder.

    Raises:
        ScenarioNotFound: The scenario is unknown.  The error lists the nearest names.
        SpecError: The file cannot be read, has an unknown key, or a value does not fit.
    """
    path = scenario_path(scenario)
    data = read_toml(path)
    # Check the schema first, because another schema may have other keys.
    schema = data.get("schema", SCHEMA)
    if schema != SCHEMA:
        raise SpecError(f"schema '{shown(schema)}'", where=str(path), hint=f'write schema = "{SCHEMA}"')
    data = from_folder(data, path.resolve().parent, ("srdf", "config", "armature", "posture"))
    try:
        table = validate(ScenarioTable, data, str(path))
    except SpecError:
        raise
    except InputError as error:
        where = f"{path}, {error.where}" if error.where else str(path)
        raise SpecError(error.what, where=where, hint=error.hint) from None
    return Scenario(**vars(table), source=str(path))


def scenario_path(scenario: str | Path) -> Path:
    """Return the path of a scenario file.

    Raises:
        ScenarioNotFound: The scenario is unknown.  The error lists the nearest names.
    """
    if isinstance(scenario, str):
        if scenario in known_scenarios():
            return SHIPPED / f"{scenario}.toml"
        if "/" not in scenario and not scenario.endswith(".toml") and not os.path.isfile(scenario):
            raise ScenarioNotFound(scenario, known_scenarios(), hint="(or give a path to a .toml)")
    return Path(scenario).expanduser()
