"""Options that several commands share.  Options for the settings of a problem are in ``settings_options.py``."""

from __future__ import annotations

import os
from enum import StrEnum
from typing import Annotated, Any, Literal

import typer

from impact_posture.config.setting import CONTACT, OUTPUT, SEARCH

CompileMode = Literal["auto", "always", "never"]


class PictureFormat(StrEnum):
    """Formats of figures.  This is an enumeration, because Typer does not support lists of literals."""

    png = "png"
    svg = "svg"
    pdf = "pdf"


def option(names: str, panel: str, help: str, **more: Any) -> Any:
    """Return a Typer option with ``names`` such as ``"--force -f"``, in this ``panel`` of ``--help``."""
    return typer.Option(*names.split(), help=help, rich_help_panel=panel, **more)


def out_option(help: str, default: str = "") -> Any:
    """Return the option ``--out`` for the folder to write."""
    # Expand ~ here, because shells do not expand it in --out=~/result.
    home = {"callback": lambda folder: folder and os.path.expanduser(folder)}
    return option("--out", OUTPUT, help, metavar="DIR", show_default=default or True, **home)


def _check_prefix(prefix: str | None) -> str | None:
    from impact_posture.codegen.c_names import check_prefix
    from impact_posture.errors import InputError

    try:
        return prefix if prefix is None else check_prefix(prefix)
    except InputError as error:
        raise typer.BadParameter(f"{error.what}; {error.hint}") from None


RobotName = Annotated[
    str,
    typer.Argument(metavar="ROBOT", help="Known name, path to a URDF, xacro file or MJCF, or COLLECTION:NAME."),
]
RobotOrResult = Annotated[
    str, typer.Argument(metavar="ROBOT|RESULT_DIR", help="A robot, or a folder that optimize wrote.")
]
FrameList = Annotated[
    list[str] | None,
    option(
        "--frame", CONTACT, "Contact frame of a C library; repeatable.", metavar="F", show_default="from the robot"
    ),
]
Out = Annotated[str | None, out_option("Result folder.", "./ROBOT-FRAME")]
Force = Annotated[bool, option("--force", OUTPUT, "Replace an existing result folder.")]
ForceFiles = Annotated[bool, option("--force", OUTPUT, "Also replace files that you wrote or changed.")]
Prefix = Annotated[
    str | None,
    option(
        "--prefix", OUTPUT, "Beginning of all C names.", metavar="NAME", show_default="ROBOT_FRAME",
        callback=_check_prefix,
    ),
]  # fmt: skip
ExportOut = Annotated[str | None, out_option("Folder of the C code.", "./PREFIX-c")]
Float = Annotated[bool, option("--float", OUTPUT, "Use float instead of double in the C code.")]
Portable = Annotated[bool, option("--portable", OUTPUT, "Write C99 without vector types, for any compiler.")]
Cuda = Annotated[bool, option("--cuda", OUTPUT, "Also write the functions as CUDA code, with kernels for batches.")]
CompileLibrary = Annotated[bool, option("--compile", OUTPUT, "Build the shared library and check its numbers.")]
ControllerKind = Annotated[
    Literal["aerial", "legged", "arm"] | None,
    option("--controller", OUTPUT, "Export an online controller for this kind of robot.", show_default="none"),
]
ControllerFlow = Annotated[bool, option("--flow", OUTPUT, "With --controller: use the reference flow.")]
ControllerScenario = Annotated[
    str | None,
    option("--scenario", OUTPUT, "With --controller: use a scenario's tasks and gains.", metavar="SCENARIO"),
]
Daqp = Annotated[
    str | None, option("--daqp", OUTPUT, "With --controller: folder of the DAQP sources.", metavar="DIR")
]
NoCodegen = Annotated[bool, option("--no-codegen", OUTPUT, "Do not export C code.")]
NoReport = Annotated[bool, option("--no-report", OUTPUT, "Do not write report.html.")]
Meshes = Annotated[bool, option("--meshes", OUTPUT, "Embed the meshes of your own URDF in report.html.")]
Json = Annotated[bool, option("--json", OUTPUT, "Print one JSON document instead of tables.")]
Quiet = Annotated[bool, option("--quiet -q", OUTPUT, "Do not print warnings or progress.")]
Jobs = Annotated[int, option("--jobs", SEARCH, "Number of processes that search at the same time.", min=1)]
Compile = Annotated[CompileMode, option("--compile", SEARCH, "Whether to compile the code that the solver runs.")]
Formats = Annotated[
    list[PictureFormat] | None,
    option("--format", OUTPUT, "Format of the pictures: png, svg or pdf; repeatable.", show_default="png"),
]
