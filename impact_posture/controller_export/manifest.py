"""Manifest of an exported controller: read, check and build what it names.  This module needs no CasADi."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from impact_posture.errors import SpecError
from impact_posture.libraries import build_library

SCHEMA = "impact-posture/controller/1"
# Most numbers of one kind.  A larger size is no robot, and would only ask for memory.
_MOST = 100_000

Size = Annotated[int, Field(ge=-1, le=_MOST)]
Name = Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_]*$")]


class _Strict(BaseModel):
    model_config = ConfigDict(strict=True)


class _Task(_Strict):
    name: str
    rows: Annotated[int, Field(ge=1, le=6)]


class Manifest(_Strict):
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
    found = []
    for file in [path] if not path.is_dir() else sorted(path.glob("*.json")):
        try:
            document = json.loads(file.read_text(encoding="utf-8"))
        except (OSError, ValueError, RecursionError):
            continue
        if isinstance(document, dict) and document.get("schema") == SCHEMA:
            found.append((file, document))
    if len(found) != 1:
        what = "holds no exported controller" if not found else f"holds {len(found)} exported controllers"
        raise SpecError(what, where=str(path), hint="name the folder that codegen --controller wrote")
    file, document = found[0]
    try:
        # From JSON, because strict validation takes a list for a tuple there and converts nothing else.
        checked = Manifest.model_validate_json(json.dumps(document, allow_nan=False))
    except (ValidationError, ValueError) as error:
        first = error.errors()[0] if isinstance(error, ValidationError) else {"loc": (), "msg": str(error)}
        what = f"is no whole manifest: {'.'.join(map(str, first['loc']))}: {first['msg']}"
        raise SpecError(what, where=str(file), hint="run codegen again") from None
    return document, checked, file.parent


def build_controller(folder: Path, manifest: dict[str, Any]) -> Path:
    """Build ``lib<prefix>.so`` in the folder of an exported controller.

    Raises:
        CompilerError: There is no compiler, or it failed.
        OutputError: The library cannot be written.
    """
    return build_library(folder, str(manifest["prefix"]), flags=["-isystem", "daqp", *manifest["sources"]])
