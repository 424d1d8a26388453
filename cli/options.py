"""Options that several commands share besides the settings of a problem."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Any, Literal

import typer

from impact_posture.settings import CONTACT, OUTPUT

CompileMode = Literal["auto", "always", "never"]


class PictureFormat(StrEnum):
    """Formats of figures, an enumeration because Typer has no lists of literals."""

    png = "png"
    svg = "svg"
    pdf = "pdf"


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

FrameList = Annotated[
    list[str] | None,
    _option(
        "--frame", metavar="F", panel=CONTACT, show_default="the robot's",
        help="Contact frame; repeatable: several frames in one library.",
    ),
]  # fmt: skip
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
