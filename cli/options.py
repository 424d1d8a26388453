"""The options that commands share, each said once: name, check, help."""

from __future__ import annotations

from collections.abc import Collection
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from impact_posture_cli.checks import (
    Four,
    Three,
    Two,
    UsageError,
    cone,
    contact,
    contacts,
    direction,
    factors,
    finite,
    not_negative,
    payloads,
    positive,
    positives,
    unit_share,
)

# The library's own Literal types sit behind heavy imports; a test keeps the two in step.
NormalFrame = Literal["world", "contact"]
MetricKind = Literal["euclidean", "kinetic", "weighted"]
ObjectiveKind = Literal["impulse", "speed", "sticking", "energy"]
RootKind = Literal["free-flyer", "fixed"]
ContactPose = Literal["full", "position", "aligned", "free", "box"]
BaseMode = Literal["free", "level", "fixed", "box"]
CompileMode = Literal["auto", "always", "never"]


class PictureFormat(StrEnum):
    """Typer takes lists of enumerations, not of literals."""

    png = "png"
    svg = "svg"
    pdf = "pdf"


# Distances of --tradeoff without a number.
TRADEOFF_POINTS = 16


CONTACT, ROBOT, TASK, METRIC, OUTPUT = "Contact", "Robot", "Task", "Measure", "Output"


def check_contact(frame: object, normal: object, contact: object) -> None:
    """Ask for ``--normal`` or ``--contact``, and not for both.

    Raises:
        UsageError: Exit code 2.
    """
    if not contact and normal is None:
        raise UsageError("Missing option '--normal X Y Z': the direction out of the surface, towards the robot.")
    if contact and (frame is not None or normal is not None):
        raise UsageError("--contact stands instead of --frame and --normal: give one of the two.")


def check_supports(support: list[str] | None, no_support: bool) -> tuple[str, ...] | None:
    """What the two support options mean: none, those given, or (``None``) those of robot.toml.

    Raises:
        UsageError: Both were given; exit code 2.
    """
    if support and no_support:
        raise UsageError("--no-support contradicts --support: give one of the two.")
    return () if no_support else tuple(support) if support else None


def is_result(robot: str) -> bool:
    """Whether ROBOT|RESULT_DIR is a folder that optimize wrote."""
    return (Path(robot) / "result.json").is_file()


def refuse_beside_result(context: typer.Context, free: Collection[str]) -> None:
    """Refuse options that say what a result folder says already; ``free`` are those that do not.

    Raises:
        UsageError: Exit code 2.
    """
    for name in context.params:
        source = context.get_parameter_source(name)
        if name not in free and source is not None and source.name == "COMMANDLINE":
            option = f"--{name.replace('_', '-')}"
            raise UsageError(f"{option} contradicts RESULT_DIR, which says what the problem is: leave it out.")


def _option(*names: str, panel: str, help: str, **more: Any) -> Any:
    return typer.Option(*names, help=help, rich_help_panel=panel, **more)


RobotName = Annotated[
    str, typer.Argument(metavar="ROBOT", help="Known name, path to a .urdf, or example-robot-data:PATH.")
]

RobotOrResult = Annotated[
    str,
    typer.Argument(
        metavar="ROBOT|RESULT_DIR",
        help="Known name, path to a .urdf, example-robot-data:PATH, or a folder that optimize wrote.",
    ),
]

# ---- contact ----------------------------------------------------------------------------------------------------

Frame = Annotated[
    str | None,
    _option("--frame", metavar="F", panel=CONTACT, show_default="the robot's", help="Contact frame."),
]
FrameList = Annotated[
    list[str] | None,
    _option(
        "--frame", metavar="F", panel=CONTACT, show_default="the robot's",
        help="Contact frame; repeatable: several frames in one library.",
    ),
]  # fmt: skip
Offset = Annotated[
    Three | None,
    _option(
        "--offset", metavar="X Y Z", panel=CONTACT, callback=finite, show_default="0 0 0",
        help="Contact point from the frame's origin, in the frame, m.",
    ),
]  # fmt: skip
Normal = Annotated[
    Three | None,
    _option(
        "--normal", metavar="X Y Z", panel=CONTACT, callback=direction,
        help="Direction out of the surface, towards the robot; any length. Required, or --contact.",
    ),
]  # fmt: skip
NormalAxes = Annotated[
    NormalFrame, _option("--normal-frame", panel=CONTACT, help="Axes that the normal is given in.")
]
ContactText = Annotated[
    str | None,
    _option(
        "--contact", metavar="FRAME:NX,NY,NZ[:IMPULSE]", panel=CONTACT, callback=contact,
        help="Instead of --frame and --normal.",
    ),
]  # fmt: skip
ContactList = Annotated[
    list[str] | None,
    _option(
        "--contact", metavar="FRAME:NX,NY,NZ[:IMPULSE]", panel=CONTACT, callback=contacts,
        help="Instead of --frame and --normal; repeatable: up to 6 contacts at once.",
    ),
]  # fmt: skip
Bilateral = Annotated[
    bool, _option("--bilateral", panel=CONTACT, help="Several contacts can pull as well as push (grasps).")
]
Impulse = Annotated[float, _option("--impulse", panel=CONTACT, callback=positive, help="Bound on the impulse, N·s.")]
Speed = Annotated[float, _option("--speed", panel=CONTACT, callback=not_negative, help="Approach speed, m/s.")]
Restitution = Annotated[
    float, _option("--restitution", panel=CONTACT, callback=unit_share, help="0 (plastic) to 1 (elastic).")
]

# ---- measure ----------------------------------------------------------------------------------------------------

MetricName = Annotated[
    MetricKind,
    _option(
        "--metric", metavar="KIND", panel=METRIC,
        help="How the velocity jump is weighed: euclidean, kinetic or weighted.",
    ),
]  # fmt: skip
Weights = Annotated[
    str | None,
    _option(
        "--weights", metavar="FILE|velocity-limits", panel=METRIC,
        help="Diagonal of the weighted metric: TOML of joint = weight, or 1/limit².",
    ),
]  # fmt: skip
ObjectiveName = Annotated[
    ObjectiveKind,
    _option(
        "--objective", metavar="KIND", panel=METRIC,
        help="impulse (jump per impulse, H), speed (jump per approach speed without friction, V), "
        "sticking (without slip, S) or energy (E).",
    ),
]  # fmt: skip
NormalCone = Annotated[
    float, _option("--normal-cone", metavar="DEG", panel=METRIC, callback=cone, help="Uncertainty of the normal.")
]

# ---- robot ------------------------------------------------------------------------------------------------------

Posture = Annotated[
    str | None,
    _option(
        "--posture", metavar="NAME|FILE", panel=ROBOT, show_default="the robot's",
        help="Named posture, posture.json, or a JointState as .yaml.",
    ),
]  # fmt: skip
SupportList = Annotated[
    list[str] | None,
    _option(
        "--support", metavar="FRAME[:point|surface]", panel=ROBOT, show_default="the robot's",
        help="Foot that stays on the ground; repeatable.",
    ),
]  # fmt: skip
NoSupport = Annotated[bool, _option("--no-support", panel=ROBOT, help="Nothing stays on the ground.")]
Lock = Annotated[
    list[str] | None,
    _option(
        "--lock", metavar="JOINT", panel=ROBOT,
        help="Joint made rigid, or a pattern in quotes such as 'gripper_*'; repeatable.",
    ),
]  # fmt: skip
LockMassless = Annotated[
    bool, _option("--lock-massless", panel=ROBOT, help="Joints that move no mass are made rigid, all of them.")
]
Root = Annotated[
    RootKind | None, _option("--root", panel=ROBOT, show_default="robot.toml's", help="What the base hangs on.")
]
Armature = Annotated[
    list[str] | None,
    _option(
        "--armature", metavar="none|FILE|JOINT=VALUE", panel=ROBOT, show_default="robot.toml's, else the SRDF's",
        help="Rotor inertia at the joint, kg·m²; JOINT=VALUE is repeatable.",
    ),
]  # fmt: skip
Config = Annotated[
    str | None,
    _option(
        "--config", metavar="ROBOT.TOML", panel=ROBOT, show_default="beside the URDF",
        help="What URDF cannot say about the robot.",
    ),
]  # fmt: skip
Srdf = Annotated[
    str | None,
    _option(
        "--srdf", metavar="FILE", panel=ROBOT, show_default="robot.toml's",
        help="Named postures, rotor data: a path, or example-robot-data:PATH.",
    ),
]  # fmt: skip
PackageDirs = Annotated[
    list[str] | None,
    _option("--package-dir", metavar="DIR", panel=ROBOT, help="Where package:// leads; repeatable."),
]
ArmatureRange = Annotated[
    Two | None,
    _option(
        "--armature-range", metavar="LOW HIGH", panel=METRIC, callback=factors, show_default="as stated",
        help="Factors on the armature, lowest and highest, whose worst counts.",
    ),
]  # fmt: skip
PayloadList = Annotated[
    list[str] | None,
    _option(
        "--payload", metavar="FRAME MASS", panel=METRIC, callback=payloads,
        help="Mass in kg that the robot may or may not carry there; repeatable; the worst counts.",
    ),
]  # fmt: skip

# ---- task -------------------------------------------------------------------------------------------------------

TargetPosition = Annotated[
    Three | None,
    _option(
        "--target-position", metavar="X Y Z", panel=TASK, callback=finite, show_default="where it is",
        help="Contact frame's position, world, m.",
    ),
]  # fmt: skip
TargetQuaternion = Annotated[
    Four | None,
    _option(
        "--target-quaternion", metavar="X Y Z W", panel=TASK, callback=finite, show_default="as it is",
        help="Contact frame's orientation, scalar last.",
    ),
]  # fmt: skip
ContactPoseHeld = Annotated[
    ContactPose | None,
    _option(
        "--contact-pose", metavar="KIND", panel=TASK, show_default="robot.toml's, else full",
        help="What is held of the contact frame: full, position, aligned, free or box.",
    ),
]  # fmt: skip
Box = Annotated[
    Three | None,
    _option(
        "--box", metavar="X Y Z", panel=TASK, callback=positives, show_default="0.05 0.05 0.05",
        help="Half extents of --contact-pose box, m.",
    ),
]  # fmt: skip
Keep = Annotated[
    list[str] | None, _option("--keep", metavar="FRAME", panel=TASK, help="Frame whose pose is held; repeatable.")
]
Hold = Annotated[
    list[str] | None,
    _option(
        "--hold", metavar="JOINT", panel=TASK, show_default="robot.toml's",
        help="Joint kept at its value; repeatable.",
    ),
]  # fmt: skip
Base = Annotated[
    BaseMode | None,
    _option(
        "--base", metavar="KIND", panel=TASK, show_default="robot.toml's, else free",
        help="What a floating base may do: free, level, fixed or box.",
    ),
]  # fmt: skip
BaseBox = Annotated[
    Three | None,
    _option(
        "--base-box", metavar="X Y Z", panel=TASK, callback=positives, show_default="0.2 0.2 0.2",
        help="Half extents of --base box, m.",
    ),
]  # fmt: skip
ComOverFeet = Annotated[
    bool | None,
    _option(
        "--com/--no-com", panel=TASK, show_default="robot.toml's", help="Keep the center of mass above the feet."
    ),
]
KeepContacts = Annotated[
    bool, _option("--keep-contacts", panel=TASK, help="The impact must neither lift nor slide a foot.")
]
Friction = Annotated[
    float, _option("--friction", panel=TASK, callback=not_negative, help="Friction coefficient for --keep-contacts.")
]
ComMargin = Annotated[
    float | None,
    _option(
        "--com-margin", panel=TASK, callback=not_negative, show_default="robot.toml's",
        help="Its distance from the support polygon's edges, m.",
    ),
]  # fmt: skip
LimitMargin = Annotated[
    float | None,
    _option(
        "--limit-margin", panel=TASK, callback=not_negative, show_default="robot.toml's",
        help="Distance from the joint limits, rad or m.",
    ),
]  # fmt: skip
Regularization = Annotated[
    float, _option("--regularization", panel=TASK, callback=not_negative, help="Weight of staying near the start.")
]

Tradeoff = Annotated[
    int,
    _option(
        "--tradeoff", metavar="[K]", panel=TASK, min=0,
        help="What a smaller change would buy: the best objective within each of K distances from the start, "
        f"{TRADEOFF_POINTS} if K is left out; 0: none.",
    ),
]  # fmt: skip

# ---- search and output ------------------------------------------------------------------------------------------

Starts = Annotated[int, _option("--starts", panel=OUTPUT, min=1, help="Starting points of the search.")]
Seed = Annotated[int, _option("--seed", panel=OUTPUT, min=0, help="Seed of the random starts.")]
Out = Annotated[
    str | None,
    _option("--out", metavar="DIR", panel=OUTPUT, show_default="./ROBOT-FRAME", help="Result folder."),
]
Force = Annotated[bool, _option("--force", panel=OUTPUT, help="Replace an existing result folder.")]
Prefix = Annotated[
    str | None,
    _option(
        "--prefix", metavar="NAME", panel=OUTPUT, show_default="ROBOT_FRAME", help="What the C names begin with."
    ),
]
ExportOut = Annotated[
    str | None,
    _option("--out", metavar="DIR", panel=OUTPUT, show_default="./PREFIX-c", help="Folder of the C code."),
]
Float = Annotated[bool, _option("--float", panel=OUTPUT, help="Compute in float instead of double.")]
Portable = Annotated[
    bool,
    _option("--portable", panel=OUTPUT, help="Plain C99 without vectors, for compilers other than GCC and Clang."),
]
CompileLibrary = Annotated[
    bool, _option("--compile", panel=OUTPUT, help="Build the shared library and compare it with other libraries.")
]
NoCodegen = Annotated[bool, _option("--no-codegen", panel=OUTPUT, help="Leave the C export out.")]
Json = Annotated[bool, _option("--json", panel=OUTPUT, help="One JSON document on standard output.")]
Quiet = Annotated[bool, _option("--quiet", "-q", panel=OUTPUT, help="The result alone: no warnings, no progress.")]
Jobs = Annotated[int, _option("--jobs", panel=OUTPUT, min=1, help="Processes that search.")]
Compile = Annotated[CompileMode, _option("--compile", panel=OUTPUT, help="Whether the program becomes machine code.")]
Formats = Annotated[
    list[PictureFormat] | None,
    _option("--format", panel=OUTPUT, show_default="png", help="Of the pictures: png, svg or pdf; repeatable."),
]
