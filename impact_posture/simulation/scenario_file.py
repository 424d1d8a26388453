"""``scenario.toml``: an experiment as a file, checked where it is read."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field

from impact_posture.errors import ImpactPostureError, ScenarioNotFound, SpecError
from impact_posture.robot.robot_loader import from_folder
from impact_posture.robot.spec import NonNegative, Positive
from impact_posture.settings import LoadOptions, Root, Vector3
from impact_posture.simulation.scenario import (
    Bounds,
    Control,
    EndEffectorGains,
    EndEffectorPose,
    Gains,
    RepeatedContacts,
    RobustTerm,
    Scenario,
    SinglePush,
    StanceGains,
)
from impact_posture.simulation.scene import ContactLaw, Physics, Scene, Sensors, Shape, ShapeKind, Surface
from impact_posture.tables import read_toml, validate

SCHEMA = "impact-posture/scenario/1"
SHIPPED = Path(__file__).parent / "scenarios"

_Built = TypeVar("_Built")
Count = Annotated[int, Field(ge=1)]
Several = Positive | Annotated[tuple[Positive, ...], Field(min_length=1)]


class _Strict(BaseModel):
    # Strict: a number in quotes or a true for 1 is a slip, not a value.
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    def given(self) -> dict[str, object]:
        """What the file says, by key; what it does not is left to the dataclass's default."""
        return {name: getattr(self, name) for name in self.model_fields_set}


class PhysicsFile(_Strict):
    """``[physics]``: see :class:`~impact_posture.simulation.scene.Physics`."""

    timestep: Positive = Physics().timestep
    gravity: Vector3 | None = None
    stop_solref: tuple[float, float] = Physics().stop_solref
    stop_solimp: Vector3 = Physics().stop_solimp


class SurfaceFile(_Strict):
    """``[[surfaces]]``: see :class:`~impact_posture.simulation.scene.Surface`."""

    name: str
    normal: Vector3
    point: Vector3 | None = None
    gap: float = 0.0
    solref: tuple[float, float] = ContactLaw().solref
    solimp: Vector3 = ContactLaw().solimp
    friction: NonNegative = ContactLaw().friction


class ShapeFile(_Strict):
    """``[[shapes]]``: see :class:`~impact_posture.simulation.scene.Shape`."""

    frame: str
    kind: ShapeKind = "sphere"
    size: tuple[Positive, ...]
    offset: Vector3 = (0.0, 0.0, 0.0)
    center: Vector3 | None = None


class SensorsFile(_Strict):
    """``[sensors]``: see :class:`~impact_posture.simulation.scene.Sensors`."""

    base_position: NonNegative = 0.0
    base_angle: NonNegative = 0.0
    base_velocity: NonNegative = 0.0
    base_rate: NonNegative = 0.0
    joint_angle: NonNegative = 0.0
    joint_resolution: NonNegative = 0.0
    joint_rate: NonNegative = 0.0
    unbalance: NonNegative = 0.0
    force_frame: str | None = None
    force: NonNegative = 0.0
    force_cutoff: Positive = Sensors().force_cutoff
    delay: NonNegative = 0.0


class ContactsFile(_Strict):
    """``[contacts]``: see :class:`~impact_posture.simulation.scenario.RepeatedContacts`."""

    frame: str
    surface: str
    speed: Positive
    acceleration: Positive = 1.0
    count: Count = 5
    settle: NonNegative = 4.0
    dwell: Positive = 0.8
    beyond: NonNegative = 0.03
    pause: NonNegative = 1.0
    window: Positive = 0.3


class PushFile(_Strict):
    """``[push]``: see :class:`~impact_posture.simulation.scenario.SinglePush`."""

    frame: str
    force: Vector3
    duration: Positive = 0.4
    signs: Annotated[tuple[Literal[1, -1], ...], Field(min_length=1)] = (1, -1)
    settle: NonNegative = 1.0
    quiet: Positive = 0.005
    still: NonNegative = 0.2
    patience: Positive = 20.0
    after: NonNegative = 1.0


class GainsFile(_Strict):
    """Gains of a task: see :class:`~impact_posture.simulation.scenario.Gains`."""

    kp: Several
    kd: Several | None = None
    weight: Positive = 1.0


class EndEffectorFile(GainsFile):
    """``[control.end_effector]``: see :class:`~impact_posture.simulation.scenario.EndEffectorGains`."""

    pose: EndEffectorPose = "full"


class RobustFile(_Strict):
    """``[control.robust]``: see :class:`~impact_posture.simulation.scenario.RobustTerm`."""

    gain: Positive
    ramp: Positive = 0.3
    fade: tuple[NonNegative, Positive] = (0.05, 0.2)


class StanceGainsFile(_Strict):
    """``[control.footing]``: see :class:`~impact_posture.simulation.scenario.StanceGains`."""

    friction: Positive = 0.5
    least: Positive = 1.0
    force_weight: Positive = 1e-5


class ControlFile(_Strict):
    """``[control]``: see :class:`~impact_posture.simulation.scenario.Control`."""

    period: Positive = 1e-3
    posture: GainsFile
    robust: RobustFile
    tilt: GainsFile | None = None
    end_effector: EndEffectorFile | None = None
    apparent_mass: Positive | None = None
    center_of_mass: GainsFile | None = None
    base: GainsFile | None = None
    footing: StanceGainsFile | None = None


class BoundsFile(_Strict):
    """``[bounds]``: see :class:`~impact_posture.simulation.scenario.Bounds`."""

    tilt_deg: Positive = Bounds().tilt_deg
    clearance: float = Bounds().clearance
    sink: Positive = Bounds().sink
    lifted: NonNegative = Bounds().lifted
    relaxed: Annotated[float, Field(ge=0, le=1)] = Bounds().relaxed
    held: NonNegative = Bounds().held


class ScenarioFile(_Strict):
    """The content of a ``scenario.toml``."""

    schema_: Literal["impact-posture/scenario/1"] = Field(default="impact-posture/scenario/1", alias="schema")
    name: str
    description: str = ""
    robot: str
    root: Root | None = None
    package_dir: tuple[str, ...] = ()
    srdf: str | None = None
    config: str | None = None
    armature: str | dict[str, float] | None = None
    lock: tuple[str, ...] = ()
    mounting: dict[str, Vector3] = {}
    posture: str | None = None
    joints: dict[str, float] = {}
    physics: PhysicsFile = PhysicsFile()
    surfaces: tuple[SurfaceFile, ...] = ()
    shapes: tuple[ShapeFile, ...] = ()
    sensors: SensorsFile = SensorsFile()
    contacts: ContactsFile | None = None
    push: PushFile | None = None
    control: ControlFile
    bounds: BoundsFile = BoundsFile()


def known_scenarios() -> tuple[str, ...]:
    """Names of the scenarios that can be given without a path, sorted."""
    return tuple(sorted(path.stem for path in SHIPPED.glob("*.toml")))


def read_scenario(scenario: str | Path) -> Scenario:
    """Read a scenario: a shipped one by name, any other by its file, from whose folder its paths start.

    Raises:
        ScenarioNotFound: With the nearest names.
        SpecError: The file cannot be read, an unknown key, or a value that is none.
    """
    path = scenario_path(scenario)
    data = read_toml(path)
    # Before the keys: those of another schema are not misspelt.
    schema = data.get("schema", SCHEMA)
    if schema != SCHEMA:
        raise SpecError(f"schema '{schema}'", where=str(path), hint=f'write schema = "{SCHEMA}"')
    data = from_folder(data, path.resolve().parent, ("srdf", "config", "armature", "posture"))
    return _build(validate(ScenarioFile, data, str(path)), str(path))


def scenario_path(scenario: str | Path) -> Path:
    """Where a scenario's file is.

    Raises:
        ScenarioNotFound: With the nearest names.
    """
    if isinstance(scenario, str):
        shipped = SHIPPED / f"{scenario}.toml"
        if scenario in known_scenarios():
            return shipped
        if "/" not in scenario and not scenario.endswith(".toml") and not Path(scenario).is_file():
            raise ScenarioNotFound(scenario, known_scenarios(), hint="(or give a path to a .toml)")
    return Path(scenario).expanduser()


def _build(file: ScenarioFile, source: str) -> Scenario:
    control = file.control
    tasks = ("posture", "tilt", "center_of_mass", "base")
    gains = {key: Gains(**part.given()) for key in tasks if (part := getattr(control, key)) is not None}
    return Scenario(
        name=file.name,
        source=source,
        description=file.description,
        robot=file.robot,
        load=LoadOptions(
            root=file.root,
            package_dir=file.package_dir,
            srdf=file.srdf,
            config=file.config,
            armature=file.armature,
            lock=file.lock,
            mounting=file.mounting,
        ),
        posture=file.posture,
        joints=dict(file.joints),
        scene=_located(lambda: _scene(file), source),
        task=_task(file, source),
        control=Control(
            robust=RobustTerm(**control.robust.given()),  # type: ignore[arg-type]
            period=control.period,
            apparent_mass=control.apparent_mass,
            end_effector=None if control.end_effector is None else EndEffectorGains(**control.end_effector.given()),  # type: ignore[arg-type]
            footing=None if control.footing is None else StanceGains(**control.footing.given()),  # type: ignore[arg-type]
            **gains,
        ),
        bounds=Bounds(**file.bounds.given()),  # type: ignore[arg-type]
    )


def _scene(file: ScenarioFile) -> Scene:
    return Scene(
        surfaces=tuple(
            Surface(s.name, s.normal, s.point, s.gap, ContactLaw(s.solref, s.solimp, s.friction))
            for s in file.surfaces
        ),
        shapes=tuple(Shape(s.frame, s.kind, s.size, s.offset, s.center) for s in file.shapes),
        physics=Physics(**file.physics.given()),  # type: ignore[arg-type]
        sensors=Sensors(**file.sensors.given()),  # type: ignore[arg-type]
    )


def _located(build: Callable[[], _Built], source: str) -> _Built:
    """Say which file it was that made no scene."""
    try:
        return build()
    except ImpactPostureError as error:
        raise SpecError(error.what, where=f"{source}, {error.where}", hint=error.hint) from None


def _task(file: ScenarioFile, source: str) -> RepeatedContacts | SinglePush:
    if (file.contacts is None) == (file.push is None):
        what = "neither [contacts] nor [push]" if file.push is None else "both [contacts] and [push]"
        raise SpecError(f"has {what}", where=source, hint="have one of them")
    if file.push is not None:
        if not any(file.push.force):
            raise SpecError("key 'push.force': no force", where=source, hint="give newtons, not all zero")
        return SinglePush(**file.push.given())  # type: ignore[arg-type]
    contacts = file.contacts
    if contacts is None:
        raise SpecError("has no task", where=source, hint="have [contacts] or [push]")
    for key, name, known in (
        ("surface", contacts.surface, [s.name for s in file.surfaces]),
        ("frame", contacts.frame, [s.frame for s in file.shapes]),
    ):
        if name not in known:
            raise SpecError(
                f"key 'contacts.{key}': there is no '{name}'",
                where=source,
                hint=f"one of: {', '.join(known)}" if known else f"add it to [[{key.replace('frame', 'shape')}s]]",
            )
    return RepeatedContacts(**contacts.given())  # type: ignore[arg-type]
