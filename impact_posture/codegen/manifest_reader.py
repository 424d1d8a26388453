"""Read the manifest of an export, and compare it with a robot and a library.  This module does not import CasADi."""

from __future__ import annotations

import ctypes
import hashlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from impact_posture.errors import FrameNotFound, ManifestMismatch, SpecError
from impact_posture.system.text_files import read_text

if TYPE_CHECKING:
    from impact_posture.robot.robot import Robot

SCHEMA = "impact-posture/codegen/1"

_Checked = TypeVar("_Checked", bound=BaseModel)
Numbers = tuple[Annotated[float, Field(allow_inf_nan=False)], ...]


class Loose(BaseModel):
    """JSON object with required keys; other keys are ignored."""

    model_config = ConfigDict(strict=True)


class _SelfTest(Loose):
    q: Numbers
    n: Annotated[Numbers, Field(min_length=3, max_length=3)]
    H: float
    grad: Numbers


class _Variant(Loose):
    symbols: dict[str, str]
    self_test: _SelfTest


class _Frame(_Variant):
    frame: str
    free: _Variant | None = None


class _Several(Loose):
    symbols: dict[str, str]


class _Manifest(Loose):
    """The manifest keys that loading needs.  :func:`check_library` compares the whole manifest with the library."""

    prefix: Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_]*$")]
    real: Literal["double", "float"]
    nq: Annotated[int, Field(gt=0)]
    nv: Annotated[int, Field(gt=0)]
    joint_names: tuple[str, ...]
    convention: str
    model_sha256: str
    armature: Numbers
    frames: Annotated[tuple[_Frame, ...], Field(min_length=1)]
    several: _Several | None = None


def read_manifest(path: Path) -> tuple[dict[str, Any], Path]:
    """Read the manifest of an export; return the content of the manifest and the folder of the export.

    ``path`` is the folder, or the manifest file.

    Raises:
        SpecError: The folder has no manifest or several manifests, or the manifest is damaged.
    """
    manifest, checked, file = read_checked(path, SCHEMA, _Manifest, "export", "codegen")
    sizes = [("armature", len(checked.armature), checked.nv)]
    for block in checked.frames:
        for part in filter(None, (block, block.free)):
            sizes.append((f"self_test.q at {block.frame}", len(part.self_test.q), checked.nq))
            sizes.append((f"self_test.grad at {block.frame}", len(part.self_test.grad), checked.nv))
    for name, size, expected in sizes:
        if size != expected:
            raise _incomplete(file, f"{name} has {size} numbers instead of {expected}")
    return manifest, file.parent


def read_checked(
    path: Path, schema: str, model: type[_Checked], what: str, command: str
) -> tuple[dict[str, Any], _Checked, Path]:
    """Read and validate a manifest; return its content, the validated ``model``, and the path of the file.

    ``path`` is the folder or the manifest file.  Error messages call the content of the folder ``what``, and name
    the ``command`` that writes the folder.

    Raises:
        SpecError: The folder has no manifest or several manifests, or the manifest is damaged.
    """
    files = [path] if not os.path.isdir(path) else sorted(p for p in path.glob("*.json") if _is_manifest(p, schema))
    if len(files) != 1:
        count = f"contains no {what}" if not files else f"contains {len(files)} {what}s"
        hint = f"name the folder that {command} wrote" if not files else f"name one file, such as {files[0].name}"
        raise SpecError(count, where=str(path), hint=hint)
    (file,) = files
    try:
        manifest = json.loads(read_text(file))
    except (OSError, ValueError, RecursionError) as error:
        raise SpecError.unreadable(file, error, "run codegen again") from None
    if not isinstance(manifest, dict) or manifest.get("schema") != schema:
        hint = f"name the folder that {command} wrote, or run codegen again"
        raise SpecError(f"is not a manifest of an {what}", where=str(file), hint=hint)
    try:
        # In strict mode, pydantic accepts a list in place of a tuple only if it reads JSON text.
        return manifest, model.model_validate_json(json.dumps(manifest, allow_nan=False)), file
    except ValidationError as error:
        first = error.errors()[0]
        raise _incomplete(file, f"{'.'.join(map(str, first['loc']))}: {first['msg']}") from None
    except (ValueError, RecursionError) as error:
        raise _incomplete(file, str(error)) from None


def _incomplete(file: Path, why: str) -> SpecError:
    hint = "name the folder that codegen wrote, or run codegen again"
    return SpecError(f"is not a complete manifest: {why}", where=str(file), hint=hint)


def identity(manifest: Mapping[str, Any]) -> str:
    """Return the text with which a library identifies its manifest: sizes, number type and hash, as ``key=value``."""
    content = json.dumps(manifest, sort_keys=True, separators=(",", ":"), allow_nan=False)
    digest = hashlib.sha256(content.encode()).hexdigest()
    return f"nq={manifest['nq']} nv={manifest['nv']} real={manifest['real']} sha256={digest}"


def check_library(library: ctypes.CDLL, manifest: Mapping[str, Any], *, where: str) -> None:
    """Check that a library belongs to a manifest, before any function of the library is called.

    Raises:
        SpecError: The library does not contain the hash of a manifest.
        ManifestMismatch: The library was built for another manifest; the error names the first difference.
    """
    symbol = f"{manifest['prefix']}_manifest"
    try:
        address = ctypes.addressof(ctypes.c_char.in_dll(library, symbol))
    except ValueError:
        hint = "delete the library, so that it is built again, or run codegen again"
        raise SpecError(f"has no symbol {symbol}", where=where, hint=hint) from None
    inside = ctypes.string_at(address).decode("ascii", "replace")
    pairs = [dict(part.partition("=")[::2] for part in text.split()) for text in (identity(manifest), inside)]
    for key, value in pairs[0].items():
        if pairs[1].get(key) != value:
            name = "the manifest's hash" if key == "sha256" else key
            hint = "delete the library, so that it is built again, or run codegen again"
            raise ManifestMismatch(name, value, pairs[1].get(key), where=where, hint=hint)


def _is_manifest(path: Path, schema: str) -> bool:
    try:
        document = json.loads(read_text(path))
    except (OSError, ValueError, RecursionError):
        return False
    return isinstance(document, dict) and document.get("schema") == schema


def check_robot(manifest: Mapping[str, Any], robot: Robot, *, where: str = "manifest") -> None:
    """Raise ManifestMismatch if an export was generated for another robot; the error names the first difference."""
    joints = list(manifest["joint_names"])
    if joints != list(robot.joint_names):
        pairs = zip([*joints, None], [*robot.joint_names, None], strict=False)
        k, (theirs, ours) = next((k, pair) for k, pair in enumerate(pairs) if pair[0] != pair[1])
        raise ManifestMismatch(f"joint {k}", theirs, ours, where=where)
    if manifest["convention"] != robot.convention:
        raise ManifestMismatch("convention", manifest["convention"], robot.convention, where=where)
    if manifest["model_sha256"] == robot.model_sha256:
        return
    for name, theirs, ours in zip(robot.tangent_names, manifest["armature"], robot.armature, strict=False):
        if abs(theirs - ours) > 1e-12 * max(abs(theirs), abs(ours)):
            raise ManifestMismatch(f"armature of {name}", theirs, float(ours), where=where)
    raise ManifestMismatch(
        "model_sha256 (inertias, placements or axes)", manifest["model_sha256"], robot.model_sha256, where=where
    )


def frame_block(manifest: Mapping[str, Any], frame: str | None) -> Mapping[str, Any]:
    """Return the entry of a frame in a manifest; with ``None``, return the first entry.

    Raises:
        FrameNotFound: The export has no such frame; the error lists its frames.
    """
    blocks: dict[str, Mapping[str, Any]] = {str(block["frame"]): block for block in manifest["frames"]}
    if frame is None:
        return next(iter(blocks.values()))
    if frame not in blocks:
        raise FrameNotFound(frame, blocks, where=str(manifest["prefix"]))
    return blocks[frame]
