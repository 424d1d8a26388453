"""Settings of a problem, described once for the command line, ``problem.toml`` and Python.

A setting is a field of :class:`RobotSettings`, :class:`ImpactSettings` or :class:`ProblemSettings`.  The field
defines the type, allowed values, meaning and option spelling of the setting.  The options of the command line, the
keys of ``problem.toml`` and the keyword arguments of Python all follow from these fields.

This module imports no slow package, because ``--help`` loads it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Literal, get_args

from impact_posture.config.demand import (
    Contacts,
    Direction,
    Factors,
    HalfAngle,
    Lengths,
    NonNegative,
    OneOrMore,
    Payloads,
    Position,
    Positive,
    Share,
    TiltAndShift,
    UnitQuaternion,
    ZeroOrMore,
    between,
    kind_or_tilt,
)
from impact_posture.config.demand import Vector3 as Vector3
from impact_posture.config.obstacle import Obstacle
from impact_posture.config.setting import CONTACT, LIMITS, METRIC, ROBOT, SEARCH, TASK, Unstated, setting
from impact_posture.config.table_validation import StrictTable
from impact_posture.config.text_parsers import (
    parse_armature,
    parse_number_or_name,
    parse_payloads,
    parse_xacro_arguments,
)

Root = Literal["free-flyer", "fixed"]
NormalFrame = Literal["world", "contact"]
ContactPoint = Literal["frame", "front"]
MetricKind = Literal["euclidean", "kinetic", "weighted"]
ObjectiveKind = Literal["impulse", "speed", "sticking", "coulomb", "energy", "effective-mass"]
ObjectiveChoice = Literal[ObjectiveKind, "auto"]
ContactPose = Literal["full", "position", "aligned", "free", "box"]
BaseMode = Literal["free", "level", "fixed", "box"]
SupportKind = Literal["point", "surface"]
Against = Literal["distance", "force"]
Search = Literal["adaptive", "multistart", "global"]
JointModel = Literal["reflected", "link", "locked", "elastic"]
TransmissionKind = Literal["rigid", "elastic", "locked"]

# Young's modulus (Pa) and Poisson's ratio of surface materials: the middle of the ranges in J. M. Gere, Mechanics of
# Materials, 5th ed. (steel; oak in bending; concrete).  The value for rubber is for stiff rubber (0.01 to 0.1 GPa);
# Gere lists 0.0007 to 0.004 GPa.
MATERIALS = {"steel": (200e9, 0.28), "wood": (11.5e9, 0.3), "rubber": (0.03e9, 0.48), "ground": (24e9, 0.15)}

# Default least distance between links that must not touch, m.
CLEARANCE = 0.001
# Default tilt, degrees, and shift, m, of the surface of a strike at which only the struck links may touch it.
SURFACE_SPREAD = (5.0, 0.005)
# Default edge length of a square surface, m.  The square replaces the endless plane if a foot or a fixed base is
# behind this plane.
PATCH = 0.3
# Default half extents of the box in which the contact frame stays, m.
BOX = (0.05, 0.05, 0.05)
# Default half extents of the box in which the base stays, m.
BASE_BOX = (0.2, 0.2, 0.2)
# Default friction coefficient (Coulomb), also of the contacts of the online controller.
FRICTION = Unstated(0.7)
# Default number of starts of a multi-start search.
STARTS = 16
# Default for the largest number of random postures that the adaptive search screens.
SCREENED = 6144
# Default number of processes of a search, and of the runs of an experiment.
JOBS = 2
# Number of bounds if --tradeoff is given without a number.
TRADEOFF_POINTS = 16
# Largest number of simultaneous contacts.  The box of the impulses of six contacts has 63 corners.  Each additional
# contact doubles the number of inequalities in the program.
MOST_CONTACTS = 6
# Default approach speed of predicted impacts, m/s.
SPEED = Unstated(1.0)
# Default coefficient of restitution of predicted impacts.
RESTITUTION = 0.0


@dataclass(frozen=True, kw_only=True)
class LoadOptions(StrictTable):
    """Options for loading a robot.  ``None`` selects the value of ``robot.toml``.

    Attributes:
        lock: Joints that become rigid at the default posture: names, or patterns such as ``gripper_*``.
        lock_massless: Whether all joints that move no mass also become rigid.
        root: ``free-flyer`` puts the robot on a floating base, ``fixed`` welds it to the world.
        armature: ``"none"``, the path of a TOML file, or a value for each named joint, kg·m² (kg if prismatic).
            ``None`` selects the armature in robot.toml, or else in the rotor data of the SRDF, or else zero.
        config: Path of a robot.toml that is read instead of the robot.toml beside the URDF.
        srdf: SRDF file: a path, or ``example-robot-data:<path below robots/>``.
        package_dir: Folders in which ``package://`` paths are searched.  Only the meshes of collision shapes and
            pictures need these folders.
        xacro_arg: Argument of a xacro file → its value; ``None`` selects the defaults of the file.
        mounting: Displacement of each named joint from its place in the URDF, m, in the axes of the parent joint.
    """

    lock: tuple[str, ...] = setting(
        (), "Make a joint rigid, or all joints that match a pattern such as 'gripper_*'; repeatable.", ROBOT, "JOINT",
        repeatable=True,
    )  # fmt: skip
    lock_massless: bool = setting(False, "Make all joints that move no mass rigid.", ROBOT)
    root: Root | None = setting(None, "Joint between the world and the base.", ROBOT, words="from robot.toml")
    armature: str | Mapping[str, float] | None = setting(
        None, "Rotor inertia at the joint, kg·m²; JOINT=VALUE is repeatable.", ROBOT, "none|FILE|JOINT=VALUE",
        "from robot.toml, else the SRDF", parse=parse_armature, repeatable=True,
    )  # fmt: skip
    config: str | None = setting(
        None, "File of data that a URDF cannot contain.", ROBOT, "ROBOT.TOML", "beside the URDF"
    )
    srdf: str | None = setting(
        None,
        "SRDF with postures and rotor data: a path, or example-robot-data:PATH.",
        ROBOT,
        "FILE",
        "from robot.toml",
    )
    package_dir: tuple[str, ...] = setting(
        (), "Folder in which package:// paths are searched; repeatable.", ROBOT, "DIR", repeatable=True
    )
    xacro_arg: Mapping[str, str] | None = setting(
        None, "Argument of a xacro file; repeatable.", ROBOT, "NAME:=VALUE", "the file's defaults",
        parse=parse_xacro_arguments, repeatable=True,
    )  # fmt: skip
    mounting: Mapping[str, Vector3] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class RobotSettings(LoadOptions):
    """Name of a robot, and options for loading it.

    Attributes:
        robot: Known name, path to a ``.urdf``, or ``example-robot-data:<path>``.
    """

    robot: str


@dataclass(frozen=True, kw_only=True)
class ImpactSettings(RobotSettings):
    """Settings of an impact of a robot; ``None`` selects the value of the robot."""

    frame: str | None = setting(None, "Contact frame.", CONTACT, "F", "from the robot")
    normal: Direction | None = setting(
        None, "Direction out of the surface, of any length; required without --contact.", CONTACT, "X Y Z"
    )
    offset: Position | None = setting(None, "Contact point in the contact frame, m.", CONTACT, "X Y Z", "0 0 0")
    normal_frame: NormalFrame = setting("world", "Axes of the normal.", CONTACT)
    contact_point: ContactPoint = setting(
        "frame", "frame: the contact frame plus --offset; front: the foremost point towards the surface.", CONTACT
    )
    contact: Contacts | None = setting(
        None,
        f"Contact that replaces --frame and --normal; repeatable for up to {MOST_CONTACTS} simultaneous contacts.",
        CONTACT, "FRAME:NX,NY,NZ[:IMPULSE]", repeatable=True,
    )  # fmt: skip
    bilateral: bool = setting(False, "Contacts can also pull, as in a grasp.", CONTACT)
    impulse: Positive = setting(1.0, "Bound on the impulse, N·s.", CONTACT)
    speed: NonNegative = setting(SPEED, "Approach speed, m/s.", CONTACT)
    restitution: Share = setting(RESTITUTION, "Coefficient of restitution, 0 (plastic) to 1 (elastic).", CONTACT)
    contact_stiffness: Annotated[str | float, between(1.0, 1e12, "N/m", tuple(MATERIALS))] | None = setting(
        None, f"Stiffness of the contact, or the material of the surface: {', '.join(MATERIALS)}.", CONTACT,
        "N/M|MATERIAL", "not known", parse=parse_number_or_name,
    )  # fmt: skip
    contact_duration: Annotated[float, between(1e-7, 100.0, "s")] | None = setting(
        None, "Time from touch to greatest compression, s.", CONTACT, words="not known"
    )
    friction: NonNegative = setting(FRICTION, "Friction coefficient at the impact and at the feet.", CONTACT)
    metric: MetricKind = setting("euclidean", "Norm of the velocity jump.", METRIC)
    weights: str | tuple[float, ...] | None = setting(
        None,
        "Weights of the weighted metric: TOML file of joint = weight, or 1/limit².",
        METRIC,
        "FILE|velocity-limits",
    )
    objective: ObjectiveChoice | None = setting(
        None, "Minimize H (impulse), V (speed), S (sticking), C (coulomb), E (energy) or m (effective-mass).", METRIC,
        words="auto with --speed, --friction or a contact's elasticity, else impulse",
    )  # fmt: skip
    joint_model: JointModel = setting(
        "reflected", "Inertia of the rotors at the joints; elastic only with evaluate.", METRIC
    )
    normal_cone: HalfAngle = setting(0.0, "Half angle of a cone of normals; the worst normal is used.", METRIC, "DEG")
    armature_range: Factors | None = setting(
        None, "Lowest and highest factor on the armature; the worst case is used.", METRIC, "LOW HIGH", "as stated"
    )
    payload: Payloads = setting(
        (), "Possible payload: frame and mass, kg; the worst case is used; repeatable.", METRIC, "FRAME MASS",
        parse=parse_payloads, repeatable=True,
    )  # fmt: skip
    posture: str | None = setting(
        None, "Named posture, posture.json, or a JointState as .yaml.", ROBOT, "NAME|FILE", "from the robot"
    )
    support: tuple[str, ...] | None = setting(
        None, "Foot that stays on the ground; repeatable.", ROBOT, "FRAME[:point|surface]", "from the robot",
        repeatable=True,
    )  # fmt: skip
    support_compliance: float | None = None


@dataclass(frozen=True, kw_only=True)
class ProblemSettings(ImpactSettings):
    """Content of a ``problem.toml``.  ``None`` selects the value of the robot or the default of the option."""

    schema: Literal["impact-posture/problem/1"] = "impact-posture/problem/1"
    q: tuple[float, ...] | None = None
    target_position: Position | None = setting(
        None, "Position of the contact frame in the world, m.", TASK, "X Y Z", "where it is"
    )
    target_quaternion: UnitQuaternion | None = setting(
        None, "Orientation of the contact frame in the world, scalar last.", TASK, "X Y Z W", "as it is"
    )
    contact_pose: Annotated[str, kind_or_tilt(get_args(ContactPose), "aligned")] | None = setting(
        None, "Hold the contact frame: full, position, aligned, aligned:DEG, free or box.", TASK, "KIND",
        "from robot.toml, else full",
    )  # fmt: skip
    box: Lengths = setting(BOX, "Half extents of --contact-pose box, m.", TASK, "X Y Z")
    keep: tuple[str, ...] = setting((), "Hold the pose of another frame; repeatable.", TASK, "FRAME", repeatable=True)
    hold: tuple[str, ...] | None = setting(
        None, "Keep a joint at its value; replaces the joints in robot.toml; repeatable.", TASK, "JOINT",
        "from robot.toml", repeatable=True,
    )  # fmt: skip
    base: Annotated[str, kind_or_tilt(get_args(BaseMode), "level")] | None = setting(
        None, "Hold a floating base: free, level, level:DEG, fixed or box.", TASK, "KIND",
        "from robot.toml, else free",
    )  # fmt: skip
    base_box: Lengths = setting(BASE_BOX, "Half extents of --base box, m.", TASK, "X Y Z")
    com: bool | None = setting(
        None,
        "Keep the center of mass above the feet.",
        LIMITS,
        words="from robot.toml; on for a fall",
        option="--com/--no-com",
    )
    com_margin: NonNegative | None = setting(
        None, "Distance of the center of mass from the support polygon's edges, m.", LIMITS, words="from robot.toml"
    )
    keep_contacts: bool = setting(False, "The impact must neither lift nor slide a foot.", LIMITS)
    holdable: bool = setting(
        True, "Keep joint torques, thrusts and foot forces within their limits at rest.", LIMITS,
        option="--holdable/--no-holdable",
    )  # fmt: skip
    approach: bool | None = setting(
        None, "Joint velocity limits must allow --speed at the contact.", LIMITS,
        words="on with --speed, unless the robot flies", option="--approach/--no-approach",
    )  # fmt: skip
    hold_force: Annotated[float, between(0.0, 1e6, "N")] = setting(
        0.0, "Force along the normal that the robot must also sustain after the impact, N.", LIMITS, "N"
    )
    max_force: Annotated[float, between(1e-6, 1e9, "N")] | None = setting(
        None,
        "Bound on the peak force, N; needs --contact-stiffness or --contact-duration.",
        LIMITS,
        words="no bound",
    )
    max_joint_jump: Annotated[float, between(1e-6, 1e9, "rad/s or m/s")] | None = setting(
        None,
        "Bound on the velocity jump of each joint, with friction, rad/s or m/s.",
        LIMITS,
        words="no bound",
    )
    max_torque: Annotated[float, between(1e-6, 1e9, "N·m")] | None = setting(
        None, "Bound on the controller's torque after the jump, N·m; needs --velocity-gain.", LIMITS, words="no bound"
    )
    velocity_gain: Annotated[float, between(1e-6, 1e9, "N·m·s/rad")] | None = setting(
        None, "Gain K_d of the controller for --max-torque, N·m·s/rad.", LIMITS, words="not known"
    )
    collision: bool = setting(
        True, "Keep the links clear of each other, the surface, the ground and obstacles.", LIMITS,
        option="--collision/--no-collision",
    )  # fmt: skip
    clearance: Annotated[float, between(1e-4, 1.0, "m")] = setting(
        CLEARANCE, "Least distance between links that must not touch, m.", LIMITS
    )
    surface: Annotated[str | float, between(1e-3, 1e3, "m", ("plane", "none"))] | None = setting(
        None, "Surface at the contact: an endless plane, none, or a square of edge length M, m.", LIMITS,
        "plane|none|M", f"the plane, or {PATCH:g} where the robot stands behind it", parse=parse_number_or_name,
    )  # fmt: skip
    surface_spread: TiltAndShift = setting(
        SURFACE_SPREAD, "With --strike, tilt and shift of the surface at which only the struck links touch it.",
        LIMITS, "DEG M",
    )  # fmt: skip
    obstacles: tuple[Obstacle, ...] = ()
    limit_margin: NonNegative | None = setting(
        None, "Least distance from the joint limits, rad or m.", LIMITS, words="from robot.toml"
    )
    regularization: NonNegative = setting(0.0, "Weight of the distance from the start.", TASK)
    tradeoff: ZeroOrMore = setting(
        0, f"Best posture within each of K distances from the start; K is {TRADEOFF_POINTS} if left out.", TASK, "[K]"
    )
    tradeoff_against: Against = setting("distance", "Quantity that --tradeoff bounds: distance, or peak force.", TASK)
    path: bool = setting(
        False, "Find a timed path from the start to the optimum, on which all constraints hold.", TASK
    )
    strike: bool = setting(False, "End --path at --speed, after a run-up along the normal, instead of at rest.", TASK)
    search: Search = setting(
        "adaptive", "adaptive; multistart; or global, which adds a map of one or two degrees of freedom.", SEARCH
    )
    starts: OneOrMore | None = setting(
        None, "Largest number of screened random postures, or number of starts of multistart.", SEARCH,
        words=f"{SCREENED}, multistart {STARTS}",
    )  # fmt: skip
    finish_all: bool = setting(
        False, "Also finish starts that can no longer become the best; lists all optima.", SEARCH
    )
    seed: ZeroOrMore = setting(0, "Seed of the random starts.", SEARCH)
