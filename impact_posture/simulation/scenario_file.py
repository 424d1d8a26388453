"""Content of ``scenario.toml``: the tables and keys of an experiment, checked when the file is read."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import numpy as np

from impact_posture.config.checked import checked
from impact_posture.config.demand import Direction, Finite, NonNegative, OneOrMore, Positive, Share, Vector3, between
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
    """Repeated contacts: the end effector moves into a surface and back, several times.

    The reference of the end effector moves from the start position to a point at the distance ``beyond`` behind the
    surface, stays there, and returns (:mod:`impact_posture.simulation.controllers.contact_reference`).

    Attributes:
        frame: Frame of the shape that touches the surface.
        others: Frames of further shapes that touch the surface at the same time.  If not empty, the robot falls
            freely from its start posture, and lands on ``frame`` and ``others``.
        surface: Name of the surface.
        speed: Speed of the reference at the surface, m/s.
        acceleration: Acceleration of the reference during the approach to the surface and during the return, m/s².
        count: Number of contacts.
        settle: Time before the first approach, s.
        dwell: Time for which the reference stays behind the surface, s.
        beyond: Distance between the surface and the deepest point of the reference behind it, m.
        pause: Time between the end of the return and the next approach, s.
        window: Duration of the impact window, which starts at the first touch, s.
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
    others: tuple[str, ...] = ()

    @property
    def frames(self) -> tuple[str, ...]:
        """Frames of all shapes that touch the surface at the same time."""
        return (self.frame, *self.others)


@checked
@dataclass(frozen=True)
class SinglePush(Settling):
    """Push of a robot at rest.

    Attributes:
        frame: Frame that is pushed.
        force: Force of a push with sign 1, world, N.
        duration: Duration of the push and of the impact window, s.
    """

    frame: str
    force: Direction
    duration: Positive = 0.4

    def push(self, sign: int) -> Push:
        """Return the push with sign 1 or −1."""
        x, y, z = (sign * value for value in self.force)
        return Push(self.frame, (x, y, z), self.duration)


@checked
@dataclass(frozen=True)
class Bounds(StrictTable):
    """Bounds that a run must not violate (:func:`impact_posture.simulation.outcome.judge`).

    The bounds ``tilt_deg``, ``clearance`` and ``sink`` are for a floating base.

    Attributes:
        tilt_deg: Maximum angle between the vertical and the base axis that was vertical at the start, degrees.
        clearance: Minimum height of the base origin above every surface, m.
        sink: Maximum distance by which the base sinks below its start, or below its reference, m.
        lifted: Maximum time for which a supporting foot loses contact, s.
        relaxed: Maximum share of ticks in which the controller relaxes a strict level.
        held: Maximum time for which the controller repeats the last command, s.
    """

    tilt_deg: Positive = 60.0
    clearance: Finite = 0.0
    sink: Positive = 1.0
    lifted: NonNegative = 0.1
    relaxed: Share = 0.5
    held: NonNegative = 0.05


@checked
@dataclass(frozen=True)
class Spread(StrictTable):
    """Largest random changes that a seed makes in the scenario (:mod:`impact_posture.simulation.seed_variation`).

    Attributes:
        joints: Change of each joint at the start, rad or m.
        speed: Relative change of the speed of the impact, or of the force of the push.
        friction: Relative change of the friction of surfaces and of a thrown ball.
        normal: Tilt of the surface of contacts about the expected contact point, degrees.
        gap: Shift of the surface of contacts along its normal, m.

    The controllers do not know ``normal`` and ``gap``.
    """

    joints: NonNegative = 0.0
    speed: Share = 0.0
    friction: Share = 0.0
    normal: Annotated[float, between(0, 45, "degrees")] = 0.0
    gap: NonNegative = 0.0


@checked
@dataclass(frozen=True, eq=False, kw_only=True)
class ScenarioTable(Scene, RobotSettings):
    """Content of a ``scenario.toml``.

    Attributes:
        name: Name of the experiment.
        description: Description of the experiment in one line.
        posture: Name or file of the start posture; ``None`` for the default posture of the robot.
        joints: Joint name → value that replaces the value in the start posture, rad or m.
        contacts: Contacts with a surface.  Exactly one of ``contacts``, ``push`` and ``throw`` is set.
        push: Push of the robot, or ``None``.
        throw: Throw of a ball at the robot, or ``None``.
        control: Gains of the controllers.
        bounds: Bounds that a run must not violate.
        spread: Largest random changes that a seed makes in the scenario.
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
    spread: Spread = Spread()

    @property
    def falls(self) -> bool:
        """Whether the robot falls freely and lands on several contacts."""
        return self.contacts is not None and bool(self.contacts.others)

    @property
    def laws(self) -> tuple[tuple[str, tuple[float, float]], ...]:
        """Pairs (name, ``solref``) of the contact laws of the joint stops, all surfaces, and the ball."""
        return super().laws if self.throw is None else (*super().laws, ("throw", self.throw.solref))

    def faced(self, shape: Shape) -> Surface | None:
        """Return the surface that the point ``offset`` of a shape faces; for contacts, the surface that is hit."""
        hit = self.contacts.surface if self.contacts is not None and shape.frame in self.contacts.frames else ""
        return next((s for s in self.surfaces if s.name == hit), super().faced(shape))

    def __post_init__(self) -> None:
        """Check that there is exactly one task, and that its shape and its surface exist."""
        super().__post_init__()
        tasks = {key: getattr(self, key) for key in ("contacts", "push", "throw") if getattr(self, key) is not None}
        if len(tasks) != 1:
            both = "both " + " and ".join(f"[{key}]" for key in tasks)
            what = both if tasks else "neither [contacts], [push] nor [throw]"
            raise InputError(f"has {what}", hint="give exactly one of them")
        if self.contacts is None and (self.spread.normal or self.spread.gap):
            raise InputError(
                "has a spread of the surface, but no [contacts]", hint="remove spread.normal and spread.gap"
            )
        (task, content), shapes = tasks.popitem(), [s.frame for s in self.shapes]
        names = [] if self.contacts is None else [("surface", self.contacts.surface, [s.name for s in self.surfaces])]
        frames = {} if self.push else {"frame": [content.frame], "others": getattr(content, "others", ())}
        names += [(key, name, shapes) for key, each in frames.items() for name in each]
        if self.falls and (content.count, content.settle) != (1, 0):
            raise InputError(
                f"key '{task}.others': a robot falls once, at the start", hint="set count = 1, settle = 0"
            )
        for key, name, known in names:
            if name not in known:
                table = "surfaces" if key == "surface" else "shapes"
                hint = f"one of: {', '.join(known)}" if known else f"add it to [[{table}]]"
                raise InputError(f"key '{task}.{key}': there is no '{name}'", hint=hint)
        for shape in self.shapes if self.throw else ():
            if shape.frame == content.frame and (shape.kind != "sphere" or shape.center is None):
                what = f"a ball is thrown at the {shape.kind} at '{shape.frame}'"
                raise InputError(what, hint="use a sphere and give its center, which is the target of the ball")


@checked
@dataclass(frozen=True, eq=False, kw_only=True)
class Scenario(ScenarioTable):
    """Experiment that the file ``source`` describes, before the robot is loaded."""

    source: str = ""

    @property
    def task(self) -> RepeatedContacts | SinglePush | Throw:
        """The task of the scenario: contacts, push or throw."""
        task = self.contacts or self.push or self.throw
        assert task is not None  # noqa: S101 (__post_init__ has checked it)
        return task

    @property
    def signs(self) -> tuple[int, ...]:
        """Signs of the push or throw, one for each run; empty for contacts."""
        return () if isinstance(self.task, RepeatedContacts) else self.task.signs

    @property
    def normal(self) -> Array:
        """Unit normal of the surface, or unit direction of the push or throw, shape (3,)."""
        direction = self.push.force if self.push else self.throw.direction if self.throw else self.surface.normal
        return np.asarray(np.array(direction, dtype=float) / np.linalg.norm(direction))

    @property
    def friction(self) -> float:
        """Coulomb coefficient of the impact."""
        return FRICTION if self.push else self.throw.friction if self.throw else self.surface.friction

    @property
    def surface(self) -> Surface:
        """Surface that the robot hits; InputError if the scenario has no contacts."""
        return next(s for s in self.surfaces if s.name == self._contacts("surface that is hit").surface)

    @property
    def shape(self) -> Shape:
        """Shape that hits the surface, or at which the ball is thrown; InputError for a push."""
        frame = self._contacts("shape that hits").frame if self.throw is None else self.throw.frame
        return next(s for s in self.shapes if s.frame == frame)

    @property
    def offset(self) -> Vector3:
        """Contact point in the frame of the task, m.

        For contacts, the ``offset`` of the shape; for a throw, the center of the shape; for a push, the frame origin.
        """
        if self.throw:
            return self.shape.center or (0.0, 0.0, 0.0)
        return self.shape.offset if self.contacts else (0.0, 0.0, 0.0)

    def _contacts(self, what: str) -> RepeatedContacts:
        if self.contacts is None:
            raise InputError(f"there is no {what}", where=self.source, hint="use a scenario with contacts")
        return self.contacts


def known_scenarios() -> tuple[str, ...]:
    """Return the sorted names of the shipped scenarios."""
    return tuple(sorted(path.stem for path in SHIPPED.glob("*.toml")))


def read_scenario(scenario: str | Path) -> Scenario:
    """Read a shipped scenario by name, or another scenario from its file.

    Paths in the file are relative to the folder of the file.

    Raises:
        ScenarioNotFound: The scenario is unknown.  The error lists similar names.
        SpecError: The file cannot be read, or has an unknown key or an invalid value.
    """
    path = scenario_path(scenario)
    data = read_toml(path)
    # Check the schema first, because files with other schemas can have other keys.
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
        ScenarioNotFound: The scenario is unknown.  The error lists similar names.
    """
    if isinstance(scenario, str):
        if scenario in known_scenarios():
            return SHIPPED / f"{scenario}.toml"
        if "/" not in scenario and not scenario.endswith(".toml") and not os.path.isfile(scenario):
            raise ScenarioNotFound(scenario, known_scenarios(), hint="(or give a path to a .toml)")
    return Path(scenario).expanduser()
