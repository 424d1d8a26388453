"""Options that several commands share besides the settings of a problem."""

from __future__ import annotations

import os
from enum import StrEnum
from typing import Annotated, Any, Literal

import typer

from impact_posture.config.setting import CONTACT, OUTPUT, SEARCH

CompileMode = Literal["auto", "always", "never"]


class PictureFormat(StrEnum):
    """Formats of figures, an enumeration because Typer has no lists of literals."""

    png = "png"
    svg = "svg"
    pdf = "pdf"


def option(*names: str, panel: str, help: str, **more: Any) -> Any:
    """Return an option of a panel of the help."""
    return typer.Option(*names, help=help, rich_help_panel=panel, **more)


def out_option(help: str, default: str = "") -> Any:
    """Return the option of the folder to write."""
    # A shell leaves the ~ of --out=~/result to the program.
    home = {"callback": lambda folder: folder and os.path.expanduser(folder)}
    return option("--out", metavar="DIR", panel=OUTPUT, show_default=default or True, help=help, **home)


def _check_prefix(prefix: str | None) -> str | None:
    from impact_posture.codegen.c_names import check_prefix
    from impact_posture.errors import InputError

    try:
        return prefix if prefix is None else check_prefix(prefix)
    except InputError as error:
        raise typer.BadParameter(f"{error.what}; {error.hint}") from None


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

FrameList = Annotated[
    list[str] | None,
    option(
        "--frame", metavar="F", panel=CONTACT, show_default="the robot's",
        help="Contact frame; repeatable: several frames in one library.",
    ),
]  # fmt: skip
Out = Annotated[str | None, out_option("Result folder.", "./ROBOT-FRAME")]
Force = Annotated[bool, option("--force", panel=OUTPUT, help="Replace an existing result folder.")]
Prefix = Annotated[
    str | None,
    option(
        "--prefix", metavar="NAME", panel=OUTPUT, show_default="ROBOT_FRAME", help="Beginning of all names in C.",
        callback=_check_prefix,
    ),
]  # fmt: skip
ExportOut = Annotated[str | None, out_option("Folder of the C code.", "./PREFIX-c")]
Float = Annotated[bool, option("--float", panel=OUTPUT, help="Compute in float instead of double.")]
Portable = Annotated[
    bool,
    option("--portable", panel=OUTPUT, help="Write C99 without vectors, for compilers other than GCC and Clang."),
]
CompileLibrary = Annotated[
    bool, option("--compile", panel=OUTPUT, help="Build the shared library and check its numbers.")
]
ControllerKind = Annotated[
    Literal["aerial", "legged", "arm"] | None,
    option(
        "--controller", panel=OUTPUT, show_default="the gradient alone",
        help="Write a whole online controller for this kind of robot; with --normal, an impact-robust one.",
    ),
]  # fmt: skip
ControllerFlow = Annotated[
    bool,
    option(
        "--flow", panel=OUTPUT,
        help="With --controller and an impact: let the posture follow the reference flow (robust-flow).",
    ),
]  # fmt: skip
ControllerScenario = Annotated[
    str | None,
    option("--scenario", metavar="SCENARIO", panel=OUTPUT, help="With --controller: tasks and gains of a scenario."),
]
Daqp = Annotated[
    str | None,
    option("--daqp", metavar="DIR", panel=OUTPUT, help="With --controller: sources of DAQP, without a network."),
]
NoCodegen = Annotated[bool, option("--no-codegen", panel=OUTPUT, help="Leave the C export out.")]
NoReport = Annotated[bool, option("--no-report", panel=OUTPUT, help="Leave report.html out.")]
Meshes = Annotated[
    bool,
    option("--meshes", panel=OUTPUT, help="Put meshes of your own URDF into report.html, which passes them on."),
]
Json = Annotated[bool, option("--json", panel=OUTPUT, help="Print one JSON document instead of tables.")]
Quiet = Annotated[bool, option("--quiet", "-q", panel=OUTPUT, help="Print no warnings and no progress.")]
Jobs = Annotated[int, option("--jobs", panel=SEARCH, min=1, help="Number of processes that search.")]
Compile = Annotated[CompileMode, option("--compile", panel=SEARCH, help="Whether the solver runs compiled code.")]
Formats = Annotated[
    list[PictureFormat] | None,
    option("--format", panel=OUTPUT, show_default="png", help="Format of the pictures: png, svg or pdf; repeatable."),
]
