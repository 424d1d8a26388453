"""Settings of a problem, described once for the command line, ``problem.toml`` and Python.

A setting is a field of :class:`RobotSettings`, :class:`ImpactSettings` or :class:`ProblemSettings`.  Its annotation
carries its type, allowed values, meaning and spelling as an option.  The command line makes its options from these
fields, ``problem.toml`` its keys, and Python its keyword arguments.

Nothing heavy is imported here, because ``--help`` reads this module.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar, Literal, get_args

from impact_posture.errors import ImpactPostureError, not_one_of
from impact_posture.parsing import parse_armature, parse_contact, parse_payloads, parse_stiffness
from impact_posture.tables import STRICT

Vector3 = tuple[float, float, float]
Root = Literal["free-flyer", "fixed"]
NormalFrame = Literal["world", "contact"]
MetricKind = Literal["euclidean", "kinetic", "weighted"]
ObjectiveKind = Literal["impulse", "speed", "sticking", "coulomb", "energy"]
ObjectiveChoice = Literal["impulse", "speed", "sticking", "coulomb", "energy", "auto"]
ContactPose = Literal["full", "position", "aligned", "free", "box"]
BaseMode = Literal["free", "level", "fixed", "box"]
SupportKind = Literal["point", "surface"]
Against = Literal["distance", "force"]
JointModel = Literal["reflected", "link", "locked", "elastic"]
TransmissionKind = Literal["rigid", "elastic", "locked"]

# Young's modulus (Pa) and Poisson's ratio of what a contact may touch: the middle of the ranges in J. M. Gere,
# Mechanics of Materials, 5th ed. (steel; oak in bending; rubber; concrete).
MATERIALS = {"steel": (200e9, 0.28), "wood": (11.5e9, 0.3), "rubber": (0.03e9, 0.48), "ground": (24e9, 0.15)}

CONTACT, METRIC, ROBOT, TASK, OUTPUT = "Contact", "Measure", "Robot", "Task", "Output"

# Coulomb coefficient of an ordinary surface.
FRICTION = 0.7
# Number of distances of --tradeoff without a number.
TRADEOFF_POINTS = 16
_LARGEST = float("inf")


@dataclass(frozen=True)
class Setting:
    """Annotation of a setting, besides its type.

    Attributes:
        help: Meaning in one line.
        panel: Part of ``--help`` with the option.
        takes: Placeholder of the value in ``--help``.
        default: Default in words, if it comes from the robot.
        demand: Demand on a value, as an error states it.
        holds: Whether a value meets the demand.
        option: Spelling of the option, if it differs from the field.
        parse: Function from all words of the command line to the value.
        repeatable: Whether the option may be given several times.
    """

    help: str
    panel: str = TASK
    takes: str | None = None
    default: str | None = None
    demand: str = ""
    holds: Callable[[Any], bool] | None = None
    option: str | None = None
    parse: Callable[[Any], Any] | None = None
    repeatable: bool = False

    def check(self, value: Any) -> Any:
        """Return the value.

        Raises:
            ValueError: The value does not meet the demand.
        """
        if value is not None and self.holds is not None and not self.holds(value):
            raise ValueError(self.demand)
        return value

    def __get_pydantic_core_schema__(self, source: Any, handler: Callable[[Any], Any]) -> Any:
        from pydantic_core import core_schema

        return core_schema.no_info_after_validator_function(self.check, handler(source))


def _finite(value: Any) -> bool:
    return all(-_LARGEST < v < _LARGEST for v in (value if isinstance(value, tuple) else (value,)))


def _direction(value: Vector3) -> bool:
    return _finite(value) and max(abs(v) for v in value) >= 1e-9


def _positive(value: Any) -> bool:
    return _finite(value) and min(value if isinstance(value, tuple) else (value,)) > 0


def _not_negative(value: float) -> bool:
    return 0 <= value < _LARGEST


def _stiffness(value: float | str) -> bool:
    return value in MATERIALS if isinstance(value, str) else 0 < value < _LARGEST


def tilt_of(pose: str) -> float | None:
    """Return DEG of the contact pose ``aligned:DEG``, or ``None`` for any other pose."""
    kind, colon, degrees = pose.partition(":")
    try:
        return float(degrees) if kind == "aligned" and colon else None
    except ValueError:
        return None


def _pose(value: str) -> bool:
    """Tell whether a text is a contact pose; a misspelt one gets a suggestion."""
    if value in get_args(ContactPose) or value.startswith("aligned:"):
        return value in get_args(ContactPose) or 0 < (tilt_of(value) or 0.0) < 90
    raise ValueError("; ".join(not_one_of(value, (*get_args(ContactPose), "aligned:DEG"))))


def _share(value: float) -> bool:
    return 0 <= value <= 1


def _half_angle(value: float) -> bool:
    return 0 <= value < 90


def _factors(value: tuple[float, float]) -> bool:
    return 0 < value[0] <= value[1] < _LARGEST


def _masses(value: tuple[tuple[str, float], ...]) -> bool:
    return all(0 < mass < _LARGEST for _, mass in value)


def _contacts(value: Any) -> bool:
    """Tell whether each text is a contact with a direction."""
    for text in (value,) if isinstance(value, str) else value:
        try:
            _, normal, impulse = parse_contact(text)
        except ImpactPostureError as error:
            raise ValueError(f"{error.what}; {error.hint}") from None
        if not _direction(normal) or not _positive(1.0 if impulse is None else impulse):
            raise ValueError(f"'{text}' needs a normal with a direction and an impulse above zero")
    return True


_NUMBER = {"holds": _finite, "demand": "give finite numbers"}
_LENGTHS = {"holds": _positive, "demand": "give three numbers above zero"}
_ZERO_OR_MORE = {"holds": _not_negative, "demand": "give a number, zero or more"}


@dataclass(frozen=True, kw_only=True)
class LoadOptions:
    """Options of loading a robot; the ``robot.toml`` provides a value for ``None``.

    Attributes:
        lock: Joints made rigid at the default posture: names, or patterns such as ``gripper_*``.
        lock_massless: Whether all joints that move no mass are also made rigid.
        root: ``free-flyer`` puts the robot on a floating base, ``fixed`` welds it to the world.
        armature: ``"none"``, path of a TOML file, or values by joint, kg·m² (kg if prismatic).  ``None`` takes
            the values of robot.toml, else the rotor data of the SRDF, else zero.
        config: Path of a robot.toml that replaces the one beside the URDF.
        srdf: SRDF: a path, or ``example-robot-data:<path below robots/>``.
        package_dir: Folders of ``package://`` paths.  Dynamics need none, but pictures may.
        mounting: Displacement of joints from their place in the URDF, by joint, meters, in the parent joint's axes.
    """

    __pydantic_config__: ClassVar[dict[str, Any]] = STRICT

    lock: Annotated[
        tuple[str, ...],
        Setting(
            "Joint made rigid, or a pattern in quotes such as 'gripper_*'; repeatable.",
            ROBOT, "JOINT", repeatable=True,
        ),
    ] = ()  # fmt: skip
    lock_massless: Annotated[bool, Setting("Make all joints that move no mass rigid.", ROBOT)] = False
    root: Annotated[Root | None, Setting("Joint between the world and the base.", ROBOT, default="robot.toml's")] = (
        None
    )
    armature: Annotated[
        str | Mapping[str, float] | None,
        Setting(
            "Rotor inertia at the joint, kg·m²; JOINT=VALUE is repeatable.",
            ROBOT, "none|FILE|JOINT=VALUE", "robot.toml's, else the SRDF's", parse=parse_armature, repeatable=True,
        ),
    ] = None  # fmt: skip
    config: Annotated[
        str | None, Setting("Data of the robot that URDF cannot hold.", ROBOT, "ROBOT.TOML", "beside the URDF")
    ] = None
    srdf: Annotated[
        str | None,
        Setting(
            "Named postures, rotor data: a path, or example-robot-data:PATH.", ROBOT, "FILE", "robot.toml's"
        ),
    ] = None  # fmt: skip
    package_dir: Annotated[
        tuple[str, ...], Setting("Folder of package:// paths; repeatable.", ROBOT, "DIR", repeatable=True)
    ] = ()
    mounting: Mapping[str, Vector3] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class RobotSettings(LoadOptions):
    """The robot, and the options of loading it.

    Attributes:
        robot: Known name, path to a ``.urdf``, or ``example-robot-data:<path>``.
    """

    robot: str


@dataclass(frozen=True, kw_only=True)
class ImpactSettings(RobotSettings):
    """An impact of a robot; the robot provides a value for ``None``."""

    frame: Annotated[str | None, Setting("Contact frame.", CONTACT, "F", "the robot's")] = None
    normal: Annotated[
        Vector3 | None,
        Setting(
            "Direction out of the surface, towards the robot; any length. Required, or --contact.",
            CONTACT, "X Y Z", holds=_direction, demand="give three finite numbers, not all zero",
        ),
    ] = None  # fmt: skip
    offset: Annotated[
        Vector3 | None,
        Setting("Contact point from the frame's origin, in the frame, m.", CONTACT, "X Y Z", "0 0 0", **_NUMBER),
    ] = None
    normal_frame: Annotated[NormalFrame, Setting("Axes of the normal.", CONTACT)] = "world"
    contact: Annotated[
        str | tuple[str, ...] | None,
        Setting(
            "Contact, in place of --frame and --normal; repeatable for up to 6 contacts at once.",
            CONTACT, "FRAME:NX,NY,NZ[:IMPULSE]", holds=_contacts, repeatable=True,
        ),
    ] = None  # fmt: skip
    bilateral: Annotated[bool, Setting("Contacts can also pull, as in a grasp.", CONTACT)] = False
    impulse: Annotated[
        float, Setting("Bound on the impulse, N·s.", CONTACT, holds=_positive, demand="give a number above zero")
    ] = 1.0
    speed: Annotated[float, Setting("Approach speed, m/s.", CONTACT, **_ZERO_OR_MORE)] = 1.0
    restitution: Annotated[
        float,
        Setting(
            "0 (plastic) to 1 (elastic).",
            CONTACT, holds=_share, demand="give a number from 0 to 1",
        ),
    ] = 0.0  # fmt: skip
    contact_stiffness: Annotated[
        str | float | None,
        Setting(
            f"Stiffness of the contact, or what a steel tip touches: {', '.join(MATERIALS)}.",
            CONTACT, "N/M|MATERIAL", "not known", holds=_stiffness, parse=parse_stiffness,
            demand=f"give N/m above zero, or one of {', '.join(MATERIALS)}",
        ),
    ] = None  # fmt: skip
    contact_duration: Annotated[
        float | None,
        Setting(
            "Time from touch to greatest compression, s.", CONTACT, default="not known", holds=_positive,
            demand="give seconds above zero",
        ),
    ] = None  # fmt: skip
    friction: Annotated[
        float, Setting("Friction of the impact, and of the feet for --keep-contacts.", CONTACT, **_ZERO_OR_MORE)
    ] = FRICTION
    metric: Annotated[
        MetricKind,
        Setting("Norm of the velocity jump: euclidean, kinetic or weighted.", METRIC, "KIND"),
    ] = "euclidean"
    weights: Annotated[
        str | tuple[float, ...] | None,
        Setting(
            "Diagonal of the weighted metric: TOML of joint = weight, or 1/limit².", METRIC, "FILE|velocity-limits"
        ),
    ] = None  # fmt: skip
    objective: Annotated[
        ObjectiveChoice,
        Setting(
            "impulse (jump per impulse, H), speed (jump per approach speed without friction, V), sticking (without "
            "slip, S), coulomb (with --friction: sticks or slips, C), energy (E), or auto (by speed and friction).",
            METRIC, "KIND",
        ),
    ] = "impulse"  # fmt: skip
    joint_model: Annotated[
        JointModel,
        Setting(
            "Inertia at the joints: reflected (links and rotors), link (without the rotors behind elastic "
            "transmissions), locked (rigid joints) or elastic (rotors on springs; evaluate only).",
            METRIC, "KIND",
        ),
    ] = "reflected"  # fmt: skip
    normal_cone: Annotated[
        float,
        Setting(
            "Uncertainty of the normal.",
            METRIC, "DEG", holds=_half_angle, demand="give degrees from 0 to below 90",
        ),
    ] = 0.0  # fmt: skip
    armature_range: Annotated[
        tuple[float, float] | None,
        Setting(
            "Lowest and highest factor on the armature; the worst case counts.",
            METRIC, "LOW HIGH", "as stated", holds=_factors,
            demand="give two factors above zero, the lower first, such as 0.5 2",
        ),
    ] = None  # fmt: skip
    payload: Annotated[
        tuple[tuple[str, float], ...],
        Setting(
            "Mass in kg that the robot may carry at the frame; repeatable; the worst case counts.",
            METRIC, "FRAME MASS", holds=_masses,
            demand="give a frame and kg above zero each", parse=parse_payloads, repeatable=True,
        ),
    ] = ()  # fmt: skip
    posture: Annotated[
        str | None,
        Setting(
            "Named posture, posture.json, or a JointState as .yaml.", ROBOT, "NAME|FILE", "the robot's"
        ),
    ] = None  # fmt: skip
    support: Annotated[
        tuple[str, ...] | None,
        Setting(
            "Foot that stays on the ground; repeatable.", ROBOT, "FRAME[:point|surface]", "the robot's",
            repeatable=True,
        ),
    ] = None  # fmt: skip
    support_compliance: float | None = None


@dataclass(frozen=True, kw_only=True)
class ProblemSettings(ImpactSettings):
    """Content of a ``problem.toml``; the robot or the default of the option provides a value for ``None``."""

    schema: Literal["impact-posture/problem/1"] = "impact-posture/problem/1"
    q: tuple[float, ...] | None = None
    target_position: Annotated[
        Vector3 | None, Setting("Contact frame's position, world, m.", TASK, "X Y Z", "where it is", **_NUMBER)
    ] = None
    target_quaternion: Annotated[
        tuple[float, float, float, float] | None,
        Setting("Contact frame's orientation, scalar last.", TASK, "X Y Z W", "as it is", **_NUMBER),
    ] = None
    contact_pose: Annotated[
        str | None,
        Setting(
            "Constraint on the contact frame: full, position, aligned (spin free), aligned:DEG (and tilted by up to "
            "DEG), free or box.",
            TASK, "KIND", "robot.toml's, else full", holds=_pose,
            demand="give aligned:DEG with degrees above 0 and below 90",
        ),
    ] = None  # fmt: skip
    box: Annotated[Vector3, Setting("Half extents of --contact-pose box, m.", TASK, "X Y Z", **_LENGTHS)] = (
        0.05,
        0.05,
        0.05,
    )
    keep: Annotated[
        tuple[str, ...], Setting("Frame whose pose is held; repeatable.", TASK, "FRAME", repeatable=True)
    ] = ()
    hold: Annotated[
        tuple[str, ...] | None,
        Setting("Joint kept at its value; repeatable.", TASK, "JOINT", "robot.toml's", repeatable=True),
    ] = None
    base: Annotated[
        BaseMode | None,
        Setting(
            "Constraint on a floating base: free, level, fixed or box.", TASK, "KIND", "robot.toml's, else free"
        ),
    ] = None  # fmt: skip
    base_box: Annotated[Vector3, Setting("Half extents of --base box, m.", TASK, "X Y Z", **_LENGTHS)] = (
        0.2,
        0.2,
        0.2,
    )
    com: Annotated[
        bool | None,
        Setting(
            "Keep the center of mass above the feet.", TASK, default="robot.toml's", option="--com/--no-com"
        ),
    ] = None  # fmt: skip
    com_margin: Annotated[
        float | None,
        Setting(
            "Distance of the center of mass from the support polygon's edges, m.", TASK, default="robot.toml's",
            **_ZERO_OR_MORE,
        ),
    ] = None  # fmt: skip
    keep_contacts: Annotated[bool, Setting("The impact must neither lift nor slide a foot.", TASK)] = False
    max_force: Annotated[
        float | None,
        Setting(
            "Largest peak force, N, without friction; needs --contact-stiffness or --contact-duration.", TASK,
            default="no bound", holds=_positive, demand="give a number above zero",
        ),
    ] = None  # fmt: skip
    max_joint_jump: Annotated[
        float | None,
        Setting(
            "Largest velocity jump of a joint without friction, rad/s or m/s.", TASK, default="no bound",
            holds=_positive, demand="give a number above zero",
        ),
    ] = None  # fmt: skip
    max_torque: Annotated[
        float | None,
        Setting(
            "Largest torque, N·m, with which the controller answers the jump; needs --velocity-gain.", TASK,
            default="no bound", holds=_positive, demand="give a number above zero",
        ),
    ] = None  # fmt: skip
    velocity_gain: Annotated[
        float | None,
        Setting(
            "Gain K_d of the controller for --max-torque, N·m·s/rad.", TASK, default="not known", holds=_positive,
            demand="give a number above zero",
        ),
    ] = None  # fmt: skip
    limit_margin: Annotated[
        float | None,
        Setting("Distance from the joint limits, rad or m.", TASK, default="robot.toml's", **_ZERO_OR_MORE),
    ] = None
    regularization: Annotated[float, Setting("Weight of the distance from the start.", TASK, **_ZERO_OR_MORE)] = 0.0
    tradeoff: Annotated[
        int,
        Setting(
            "Best objective within each of K distances from the start, which shows the gain of smaller changes; "
            f"{TRADEOFF_POINTS} distances without K, none for 0.",
            TASK, "[K]", holds=_not_negative, demand="give a whole number, zero or more",
        ),
    ] = 0  # fmt: skip
    tradeoff_against: Annotated[
        Against,
        Setting(
            "What --tradeoff bounds: the distance from the start, or the peak force of the impact.", TASK, "WHAT"
        ),
    ] = "distance"  # fmt: skip
    starts: Annotated[
        int, Setting("Number of starting points of the search.", OUTPUT, holds=_positive, demand="give 1 or more")
    ] = 16
    seed: Annotated[
        int, Setting("Seed of the random starts.", OUTPUT, holds=_not_negative, demand="give 0 or more")
    ] = 0
