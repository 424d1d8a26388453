"""Settings of a problem, described once for the command line, ``problem.toml`` and Python.

A setting is a field of :class:`RobotSettings`, :class:`ImpactSettings` or :class:`ProblemSettings`.  Its annotation
carries its type, allowed values, meaning and spelling as an option.  The command line makes its options from these
fields, ``problem.toml`` its keys, and Python its keyword arguments.

Nothing heavy is imported here, because ``--help`` reads this module.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar, Literal, get_args

from impact_posture import setting as demand
from impact_posture.errors import InputError
from impact_posture.parsing import parse_armature, parse_number_or_name, parse_payloads
from impact_posture.setting import CONTACT, METRIC, ROBOT, SEARCH, TASK, Setting
from impact_posture.tables import STRICT, Checked

Vector3 = tuple[float, float, float]
Root = Literal["free-flyer", "fixed"]
NormalFrame = Literal["world", "contact"]
MetricKind = Literal["euclidean", "kinetic", "weighted"]
ObjectiveKind = Literal["impulse", "speed", "sticking", "coulomb", "energy"]
ObjectiveChoice = Literal[ObjectiveKind, "auto"]
ContactPose = Literal["full", "position", "aligned", "free", "box"]
BaseMode = Literal["free", "level", "fixed", "box"]
SupportKind = Literal["point", "surface"]
Against = Literal["distance", "force"]
Search = Literal["multistart", "global"]
JointModel = Literal["reflected", "link", "locked", "elastic"]
TransmissionKind = Literal["rigid", "elastic", "locked"]

# Young's modulus (Pa) and Poisson's ratio of what a contact may touch: the middle of the ranges in J. M. Gere,
# Mechanics of Materials, 5th ed. (steel; oak in bending; rubber; concrete).
MATERIALS = {"steel": (200e9, 0.28), "wood": (11.5e9, 0.3), "rubber": (0.03e9, 0.48), "ground": (24e9, 0.15)}

# Most characters of the name of an obstacle, which errors print.
_LONGEST_NAME = 60
# Least distance (m) of links that stay apart, and edge length (m) of a surface that ends before the robot's stand.
CLEARANCE, PATCH = 0.001, 0.3
# Coulomb coefficient of an ordinary surface.
FRICTION = 0.7
# Number of distances of --tradeoff without a number.
TRADEOFF_POINTS = 16


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
            "Make a joint rigid, or all that fit a pattern such as 'gripper_*' (in quotes); repeatable.",
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
        str | None, Setting("File of data that the URDF cannot hold.", ROBOT, "ROBOT.TOML", "beside the URDF")
    ] = None
    srdf: Annotated[
        str | None,
        Setting(
            "Named postures and rotor data: a path, or example-robot-data:PATH.", ROBOT, "FILE", "robot.toml's"
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
            "Direction out of the surface, towards the robot, of any length. Required unless --contact is given.",
            CONTACT, "X Y Z", **demand.DIRECTION,
        ),
    ] = None  # fmt: skip
    offset: Annotated[
        Vector3 | None,
        Setting(
            "Contact point from the frame's origin, in the frame, m.", CONTACT, "X Y Z", "0 0 0", **demand.NUMBERS
        ),
    ] = None
    normal_frame: Annotated[NormalFrame, Setting("Axes in which the normal is given.", CONTACT)] = "world"
    contact: Annotated[
        str | tuple[str, ...] | None,
        Setting(
            "Contact, in place of --frame and --normal; repeatable for up to 6 contacts at once.",
            CONTACT, "FRAME:NX,NY,NZ[:IMPULSE]", **demand.CONTACTS, repeatable=True,
        ),
    ] = None  # fmt: skip
    bilateral: Annotated[bool, Setting("Contacts can also pull, as in a grasp.", CONTACT)] = False
    impulse: Annotated[float, Setting("Bound on the impulse, N·s.", CONTACT, **demand.ABOVE_ZERO)] = 1.0
    speed: Annotated[float, Setting("Approach speed, m/s.", CONTACT, **demand.ZERO_OR_MORE)] = 1.0
    restitution: Annotated[
        float,
        Setting(
            "Coefficient of restitution, 0 (plastic) to 1 (elastic).",
            CONTACT, **demand.SHARE,
        ),
    ] = 0.0  # fmt: skip
    contact_stiffness: Annotated[
        str | float | None,
        Setting(
            f"Stiffness of the contact, or the material that a steel tip touches: {', '.join(MATERIALS)}.",
            CONTACT, "N/M|MATERIAL", "not known", parse=parse_number_or_name,
            **demand.between(1.0, 1e12, "N/m", tuple(MATERIALS)),
        ),
    ] = None  # fmt: skip
    contact_duration: Annotated[
        float | None,
        Setting(
            "Time from touch to greatest compression, s.", CONTACT, default="not known",
            **demand.between(1e-7, 100.0, "s"),
        ),
    ] = None  # fmt: skip
    friction: Annotated[
        float, Setting("Friction coefficient at the impact and at the feet.", CONTACT, **demand.ZERO_OR_MORE)
    ] = FRICTION
    metric: Annotated[
        MetricKind,
        Setting("Norm of the velocity jump: euclidean, kinetic or weighted.", METRIC, "KIND"),
    ] = "euclidean"
    weights: Annotated[
        str | tuple[float, ...] | None,
        Setting(
            "Weights of the weighted metric: TOML of joint = weight, or 1/limit².", METRIC, "FILE|velocity-limits"
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
            "Half angle of the cone of normals that are possible; the worst normal counts.",
            METRIC, "DEG", **demand.HALF_ANGLE,
        ),
    ] = 0.0  # fmt: skip
    armature_range: Annotated[
        tuple[float, float] | None,
        Setting(
            "Lowest and highest factor on the armature that are possible; the worst case counts.",
            METRIC, "LOW HIGH", "as stated", **demand.FACTORS,
        ),
    ] = None  # fmt: skip
    payload: Annotated[
        tuple[tuple[str, float], ...],
        Setting(
            "Mass in kg that the robot may carry at the frame; repeatable; the worst case counts.",
            METRIC, "FRAME MASS", parse=parse_payloads, repeatable=True, **demand.MASSES,
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
class Obstacle(Checked):
    """A box or a ball that the robot stays clear of.

    Attributes:
        name: Name in messages.
        box: Edge lengths of a box along its own axes, m.
        sphere: Radius of a ball, m.
        position: Center in the world, m.
        quaternion: Orientation of a box in the world, x y z w.

    Raises:
        InputError: A value does not fit, there is not exactly one of ``box`` and ``sphere``, or the quaternion has no
            unit length.
    """

    name: str
    box: Annotated[Vector3 | None, Setting("Edge lengths, m.", **demand.LENGTHS)] = None
    sphere: Annotated[float | None, Setting("Radius, m.", **demand.ABOVE_ZERO)] = None
    position: Annotated[Vector3, Setting("Center in the world, m.", **demand.NUMBERS)] = (0.0, 0.0, 0.0)
    quaternion: Annotated[
        tuple[float, float, float, float], Setting("Orientation x y z w.", **demand.NUMBERS)
    ] = (0.0, 0.0, 0.0, 1.0)  # fmt: skip

    def __post_init__(self) -> None:
        """Check the values."""
        super().__post_init__()
        if not self.name.strip() or len(self.name) > _LONGEST_NAME:
            what = "has no name" if not self.name.strip() else f"has a name of {len(self.name)} characters"
            raise InputError(what, where="obstacles", hint=f"give each a name of up to {_LONGEST_NAME} characters")
        where = f"obstacle '{self.name}'"
        if (self.box is None) == (self.sphere is None):
            what = "neither edge lengths nor a radius" if self.box is None else "edge lengths and a radius"
            raise InputError(f"has {what}", where=where, hint="give one of the keys box and sphere")
        norm = math.hypot(*self.quaternion)
        if abs(norm - 1) > 1e-3:
            raise InputError(
                f"the quaternion has norm {norm:.4g}", where=where, hint="give a unit quaternion x y z w"
            )


@dataclass(frozen=True, kw_only=True)
class ProblemSettings(ImpactSettings):
    """Content of a ``problem.toml``; the robot or the default of the option provides a value for ``None``."""

    schema: Literal["impact-posture/problem/1"] = "impact-posture/problem/1"
    q: tuple[float, ...] | None = None
    target_position: Annotated[
        Vector3 | None, Setting("Contact frame's position, world, m.", TASK, "X Y Z", "where it is", **demand.NUMBERS)
    ] = None
    target_quaternion: Annotated[
        tuple[float, float, float, float] | None,
        Setting("Contact frame's orientation, scalar last.", TASK, "X Y Z W", "as it is", **demand.UNIT),
    ] = None
    contact_pose: Annotated[
        str | None,
        Setting(
            "Constraint on the contact frame: full, position, aligned (spin free), aligned:DEG (and tilted by up to "
            "DEG), free or box.",
            TASK, "KIND", "robot.toml's, else full", **demand.kind_or_tilt(get_args(ContactPose), "aligned"),
        ),
    ] = None  # fmt: skip
    box: Annotated[Vector3, Setting("Half extents of --contact-pose box, m.", TASK, "X Y Z", **demand.LENGTHS)] = (
        0.05,
        0.05,
        0.05,
    )
    keep: Annotated[
        tuple[str, ...], Setting("Hold the pose of another frame; repeatable.", TASK, "FRAME", repeatable=True)
    ] = ()
    hold: Annotated[
        tuple[str, ...] | None,
        Setting("Keep a joint at its value; repeatable.", TASK, "JOINT", "robot.toml's", repeatable=True),
    ] = None
    base: Annotated[
        str | None,
        Setting(
            "Constraint on a floating base: free, level (yaw free), level:DEG (and tilted by up to DEG), fixed or "
            "box.",
            TASK, "KIND", "robot.toml's, else free", **demand.kind_or_tilt(get_args(BaseMode), "level"),
        ),
    ] = None  # fmt: skip
    base_box: Annotated[Vector3, Setting("Half extents of --base box, m.", TASK, "X Y Z", **demand.LENGTHS)] = (
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
            **demand.ZERO_OR_MORE,
        ),
    ] = None  # fmt: skip
    keep_contacts: Annotated[bool, Setting("The impact must neither lift nor slide a foot.", TASK)] = False
    holdable: Annotated[
        bool,
        Setting(
            "Keep joint torques, rotor thrusts and forces of the feet within their limits at rest, where the robot's "
            "data say them.",
            TASK, option="--holdable/--no-holdable",
        ),
    ] = True  # fmt: skip
    approach: Annotated[
        bool,
        Setting("The joints can bring the contact to the surface at --speed within their velocity limits.", TASK),
    ] = False
    hold_force: Annotated[
        float,
        Setting(
            "Force along the normal that the robot also has to hold after the impact, N.", TASK, "N",
            **demand.between(0.0, 1e6, "N"),
        ),
    ] = 0.0  # fmt: skip
    max_force: Annotated[
        float | None,
        Setting(
            "Largest allowed peak force, N, without friction; needs --contact-stiffness or --contact-duration.", TASK,
            default="no bound", **demand.between(1e-6, 1e9, "N"),
        ),
    ] = None  # fmt: skip
    max_joint_jump: Annotated[
        float | None,
        Setting(
            "Largest allowed velocity jump of a joint without friction, rad/s or m/s.", TASK, default="no bound",
            **demand.between(1e-6, 1e9, "rad/s or m/s"),
        ),
    ] = None  # fmt: skip
    max_torque: Annotated[
        float | None,
        Setting(
            "Largest torque with which the controller may answer the jump, N·m; needs --velocity-gain.", TASK,
            default="no bound", **demand.between(1e-6, 1e9, "N·m"),
        ),
    ] = None  # fmt: skip
    velocity_gain: Annotated[
        float | None,
        Setting(
            "Gain K_d of the controller for --max-torque, N·m·s/rad.", TASK, default="not known",
            **demand.between(1e-6, 1e9, "N·m·s/rad"),
        ),
    ] = None  # fmt: skip
    collision: Annotated[
        bool,
        Setting(
            "Keep the links clear of each other, the surface, the ground and obstacles.", TASK,
            option="--collision/--no-collision",
        ),
    ] = True  # fmt: skip
    clearance: Annotated[
        float, Setting("Least distance of links that stay apart, m.", TASK, **demand.between(1e-4, 1.0, "m"))
    ] = CLEARANCE
    surface: Annotated[
        str | float | None,
        Setting(
            "Surface at the contact: an endless plane, none, or a square of this edge length, m.", TASK,
            "plane|none|M", f"the plane, or {PATCH:g} where the robot stands behind it", parse=parse_number_or_name,
            **demand.between(1e-3, 1e3, "m", ("plane", "none")),
        ),
    ] = None  # fmt: skip
    obstacles: tuple[Obstacle, ...] = ()
    limit_margin: Annotated[
        float | None,
        Setting("Distance from the joint limits, rad or m.", TASK, default="robot.toml's", **demand.ZERO_OR_MORE),
    ] = None
    regularization: Annotated[
        float, Setting("Weight of the distance from the start.", TASK, **demand.ZERO_OR_MORE)
    ] = 0.0
    tradeoff: Annotated[
        int,
        Setting(
            "Also find the best posture within each of K distances from the start, which shows what a smaller change "
            f"gains; {TRADEOFF_POINTS} distances without K, none for 0.",
            TASK, "[K]", **demand.ZERO_OR_MORE,
        ),
    ] = 0  # fmt: skip
    tradeoff_against: Annotated[
        Against,
        Setting(
            "What --tradeoff bounds: the distance from the start, or the peak force of the impact.", TASK, "WHAT"
        ),
    ] = "distance"  # fmt: skip
    path: Annotated[
        bool, Setting("Also find and time a path from the start to the optimum on which all constraints hold.", TASK)
    ] = False
    search: Annotated[
        Search,
        Setting(
            "multistart, or global: maps self-motions of 1 or 2 degrees of freedom, else hops from the best optimum.",
            SEARCH, "HOW",
        ),
    ] = "multistart"  # fmt: skip
    starts: Annotated[int, Setting("Number of starting points of the search.", SEARCH, **demand.ONE_OR_MORE)] = 16
    finish_all: Annotated[
        bool, Setting("Finish starts of large programs that can no longer be the best: lists all optima.", SEARCH)
    ] = False
    seed: Annotated[int, Setting("Seed of the random starts.", SEARCH, **demand.ZERO_OR_MORE)] = 0
