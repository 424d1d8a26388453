"""Manifest of an exported controller: read, check and build what it names.  This module needs no CasADi."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from impact_posture.codegen.manifest_reader import Loose, read_checked
from impact_posture.system.libraries import build_parts, library_path

SCHEMA = "impact-posture/controller/1"
# Most numbers of one kind.  A larger size is no robot, and would only ask for memory.
_MOST = 100_000

Size = Annotated[int, Field(ge=-1, le=_MOST)]
Name = Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_]*$")]


class _Task(Loose):
    name: str
    rows: Annotated[int, Field(ge=1, le=6)]


class Manifest(Loose):
    """The keys that a loader needs; the library vouches for all of them."""

    prefix: Name
    real: Literal["double"]
    nq: Annotated[int, Field(gt=0, le=_MOST)]
    nv: Annotated[int, Field(gt=0, le=_MOST)]
    joint_names: tuple[str, ...]
    convention: str
    model_sha256: str
    armature: tuple[float, ...]
    u_names: tuple[str, ...]
    sizes: dict[str, Size]
    parameters: dict[Name, Annotated[int, Field(gt=0, le=_MOST)]]
    tasks: tuple[_Task, ...]
    levels: tuple[tuple[str, int], ...]
    posture: str | None
    bounds: tuple[str, ...]
    sources: tuple[Annotated[str, Field(pattern=r"^(daqp/)?[A-Za-z0-9_]+\.c$")], ...]


def read_controller(path: Path) -> tuple[dict[str, Any], Manifest, Path]:
    """Read the manifest of an exported controller; return it, its checked keys, and the folder.

    Args:
        path: The folder, or the manifest itself.

    Raises:
        SpecError: There is no manifest, there are several, or it is broken.
    """
    document, checked, file = read_checked(path, SCHEMA, Manifest, "exported controller", "codegen --controller")
    return document, checked, file.parent


def build_controller(folder: Path, manifest: dict[str, Any], generated: Sequence[str] = ()) -> Path:
    """Build ``lib<prefix>.so`` in the folder of an exported controller.

    Args:
        folder: The folder.
        manifest: The content of its manifest.
        generated: Further flags of the compiler for what is generated from the model, in long sources without loops.

    Raises:
        CompilerError: There is no compiler, or it failed.
        OutputError: The library or the cache cannot be written.
    """
    prefix, shared = str(manifest["prefix"]), ["-isystem", "daqp"]
    own = {f"{prefix}_dynamics.c", f"{prefix}_metric.c"}
    parts = {name: [*shared, *generated] if name in own else shared for name in (f"{prefix}.c", *manifest["sources"])}
    return build_parts(folder, library_path(folder, prefix), parts)
