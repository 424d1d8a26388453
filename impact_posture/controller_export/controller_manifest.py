"""Read and check the manifest of an exported controller, and build its library.

This module does not import CasADi.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from impact_posture.codegen.manifest_reader import Loose, read_checked
from impact_posture.system.libraries import build_parts, library_path

SCHEMA = "impact-posture/controller/1"
# Largest size of an array that a manifest may state.  A larger size is a mistake, and would allocate too much memory.
_MOST = 100_000

Size = Annotated[int, Field(ge=-1, le=_MOST)]
Name = Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_]*$")]


class _Task(Loose):
    name: str
    rows: Annotated[int, Field(ge=1, le=6)]


class Manifest(Loose):
    """Keys of the manifest that the loader requires.

    The library contains a hash of its manifest, so a library with other values of these keys is detected.
    """

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
    """Read the manifest at ``path``, which is a file or a folder.

    Return the whole document, its checked keys, and the folder.

    Raises:
        SpecError: The folder does not contain exactly one manifest, or the manifest is broken.
    """
    document, checked, file = read_checked(path, SCHEMA, Manifest, "exported controller", "codegen --controller")
    return document, checked, file.parent


def build_controller(folder: Path, manifest: dict[str, Any], generated: Sequence[str] = ()) -> Path:
    """Build ``lib<prefix>.so`` in the folder of an exported controller.

    ``generated`` are additional compiler flags for the sources that are generated from the model, which are long and
    contain no loops.

    Raises:
        CompilerError: The compiler failed or is missing.
        OutputError: The library or the cache cannot be written.
    """
    prefix, flags = str(manifest["prefix"]), ["-isystem", "daqp"]
    straight = {f"{prefix}_dynamics.c", f"{prefix}_metric.c"}
    sources = (f"{prefix}.c", *manifest["sources"])
    parts = {name: [*flags, *generated] if name in straight else flags for name in sources}
    return build_parts(folder, library_path(folder, prefix), parts)
