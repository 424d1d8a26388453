"""Content of ``robot.toml``: data of a robot that URDF and SRDF cannot contain."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Literal

from impact_posture.config.checked import checked
from impact_posture.config.demand import NonNegative, Positive, Vector3
from impact_posture.config.problem_settings import ContactPose, Root, SupportKind, TransmissionKind
from impact_posture.config.table_validation import read_toml, validate
from impact_posture.errors import SpecError, shown

SCHEMA = "impact-posture/robot/1"


class _Table:
    __pydantic_config__: ClassVar[dict[str, Any]] = {"extra": "forbid"}


@dataclass(frozen=True)
class ModelSpec(_Table):
    """Files of the model: paths relative to robot.toml, or ``example-robot-data:<path>``."""

    urdf: str | None = None
    srdf: str | None = None
    # ``None`` keeps the root of an MJCF, and means ``fixed`` for a URDF.
    root: Root | None = None
    package_dirs: tuple[str, ...] = ()
    xacro_args: dict[str, str] = field(default_factory=dict)
    lock: tuple[str, ...] = ()
    lock_massless: bool = False
    # Whether impossible inertias, which some published URDFs contain, are warnings instead of errors.
    accept_inertias: bool = False


@dataclass(frozen=True)
class PostureSpec(_Table):
    """A named posture: base pose ``[x, y, z, qx, qy, qz, qw]`` and joints by name; all other joints are neutral."""

    base: tuple[float, float, float, float, float, float, float] | None = None
    joints: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class ContactSpec(_Table):
    """The default contact frame, and the default settings ``offset`` and ``contact_pose`` of contact frames."""

    frame: str | None = None
    offset: Vector3 = (0.0, 0.0, 0.0)
    pose: ContactPose = "full"
    frames: dict[str, ContactPose] = field(default_factory=dict)
    offsets: dict[str, Vector3] = field(default_factory=dict)

    def offset_of(self, frame: str) -> Vector3:
        """Return the default contact point of a contact frame, in the frame, m."""
        return self.offsets.get(frame, self.offset if frame == self.frame else (0.0, 0.0, 0.0))


@checked
@dataclass(frozen=True)
class Support(_Table):
    """A foot that stays on the ground during an impact.

    Attributes:
        kind: ``point`` keeps the velocity of the contact point at zero.  ``surface`` also keeps the angular velocity
            at zero.
        offset: Contact point relative to the origin of the frame, in the frame, meters.
        size: Half extents (x, y) of the sole around the contact point, in the frame, meters.  If ``size`` is zero,
            the size of a surface is measured on the shapes of the foot.  A surface without size and shapes bears no
            moment.
    """

    frame: str
    kind: SupportKind = "point"
    offset: Vector3 = (0.0, 0.0, 0.0)
    size: tuple[NonNegative, NonNegative] = (0.0, 0.0)

    @property
    def rows(self) -> int:
        """Number of velocity components that the foot keeps at zero."""
        return 3 if self.kind == "point" else 6

    @property
    def corners(self) -> tuple[Vector3, ...]:
        """Corners of the sole in the frame, m; they coincide if the size is zero."""
        (x, y, z), (half_x, half_y) = self.offset, self.size
        return tuple((x + i * half_x, y + j * half_y, z) for i in (-1, 1) for j in (-1, 1))

    @property
    def has_sole(self) -> bool:
        """Whether the foot is a ``surface`` with a ``size``."""
        return self.kind == "surface" and min(self.size) > 0


@dataclass(frozen=True)
class ConstraintSpec(_Table):
    """Default constraints of optimizations with the robot."""

    hold: tuple[str, ...] = ()
    level_base: bool = False
    com_over_feet: bool = False
    com_margin: NonNegative = 0.0
    limit_margin: NonNegative = 0.0


@dataclass(frozen=True)
class LimitSpec(_Table):
    """Limits of named joints, which replace the limits of the URDF: rad or m, rad/s or m/s, N·m or N."""

    position: dict[str, tuple[float, float]] = field(default_factory=dict)
    velocity: dict[str, Positive] = field(default_factory=dict)
    effort: dict[str, Positive] = field(default_factory=dict)


@dataclass(frozen=True)
class ArmatureSpec(_Table):
    """Rotor inertia reflected to the joint (gear ratio² × rotor inertia), kg·m² (kg for prismatic joints)."""

    default: NonNegative | None = None
    joints: dict[str, NonNegative] = field(default_factory=dict)
    source: str = ""


@dataclass(frozen=True)
class JointTransmissionSpec(_Table):
    """Transmission of a single joint; :class:`TransmissionSpec` provides missing values."""

    kind: TransmissionKind | None = None
    stiffness: Positive | None = None
    damping: NonNegative | None = None


@dataclass(frozen=True)
class TransmissionSpec(_Table):
    """Transmissions between rotors and links; the inertia of the rotors is in :class:`ArmatureSpec`.

    With a ``rigid`` transmission, the rotor moves with the link.  An ``elastic`` transmission has a spring of
    ``stiffness`` and a damper of ``damping``, N·m/rad and N·m·s/rad at the joint (N/m and N·s/m if prismatic).  A
    ``locked`` transmission, such as a worm gear, cannot be driven from its link.
    """

    kind: TransmissionKind | None = None
    stiffness: Positive | None = None
    damping: NonNegative = 0.0
    joints: dict[str, JointTransmissionSpec] = field(default_factory=dict)
    source: str = ""


@dataclass(frozen=True)
class RotorSpec(_Table):
    """A propeller: position, thrust direction, and direction of rotation as seen against the thrust direction."""

    name: str
    position: Vector3
    direction: Vector3
    spin: Literal[-1, 1]


@dataclass(frozen=True)
class PropulsionSpec(_Table):
    """The propellers of an aerial robot, with thrust ``c_f ω²`` and drag moment ``-spin · drag_ratio · thrust``."""

    frame: str
    thrust_coefficient: Positive
    drag_ratio: NonNegative
    speed_min: NonNegative
    speed_max: Positive
    time_constant_up: Positive
    time_constant_down: Positive
    rotors: tuple[RotorSpec, ...]
    source: str = ""

    @property
    def lag(self) -> float:
        """Mean time constant of the rotors, s."""
        return (self.time_constant_up + self.time_constant_down) / 2


@dataclass(frozen=True)
class RobotSpec(_Table):
    """Content of a ``robot.toml``."""

    schema: str = SCHEMA
    name: str | None = None
    kind: Literal["aerial", "arm", "quadruped", "humanoid", "mobile", "other"] = "other"
    description: str = ""
    model: ModelSpec = ModelSpec()
    default_posture: str | None = None
    postures: dict[str, PostureSpec] = field(default_factory=dict)
    contact: ContactSpec = ContactSpec()
    supports: tuple[Support, ...] = ()
    constraints: ConstraintSpec = ConstraintSpec()
    limits: LimitSpec = LimitSpec()
    armature: ArmatureSpec = ArmatureSpec()
    transmission: TransmissionSpec = TransmissionSpec()
    propulsion: PropulsionSpec | None = None
    sources: tuple[str, ...] = ()


def read_spec(path: Path, over: Path | None = None) -> RobotSpec:
    """Read and check a ``robot.toml``.  The file ``over`` provides missing values.

    If the file ``path`` names a URDF, the file describes another robot, and ``over`` is ignored.
    """
    data = read_toml(path)
    model = data.get("model", {})
    if over is not None and not (isinstance(model, dict) and "urdf" in model):
        data = _overlay(_absolute_paths(read_toml(over), over.parent), data)
    # Check the schema before the keys, because keys of another schema are not misspelt.
    schema = data.get("schema", SCHEMA)
    if schema != SCHEMA:
        raise SpecError(f"schema '{shown(schema)}'", where=str(path), hint=f'write schema = "{SCHEMA}"')
    return validate(RobotSpec, data, str(path))


def _overlay(below: dict[str, object], above: dict[str, object]) -> dict[str, object]:
    """Merge two tables recursively, but replace the tables ``armature`` and ``transmission`` as a whole."""
    merged = dict(below)
    for key, value in above.items():
        old = merged.get(key)
        if isinstance(old, dict) and isinstance(value, dict) and key not in ("armature", "transmission"):
            merged[key] = _overlay(old, value)
        else:
            merged[key] = value
    return merged


def _absolute_paths(data: dict[str, object], folder: Path) -> dict[str, object]:
    model = data.get("model")
    if isinstance(model, dict):
        for key in ("urdf", "srdf"):
            text = model.get(key)
            if isinstance(text, str) and ":" not in text:
                model[key] = str(folder / text)
    return data
