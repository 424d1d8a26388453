"""An export's manifest read back, and held against the robot in hand.  Needs no CasADi."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from impact_posture.errors import FrameNotFound, ManifestMismatch, SpecError

if TYPE_CHECKING:
    from impact_posture.robot.robot import Robot

SCHEMA = "impact-posture/codegen/1"

_NEEDED = {"prefix", "real", "frames", "nq", "nv", "joint_names", "convention", "model_sha256", "armature"}


def read_manifest(path: Path) -> tuple[dict[str, Any], Path]:
    """Read the manifest of an export; return it and the export's folder.

    Args:
        path: The folder, or the manifest itself.

    Raises:
        SpecError: There is none, several, or it is broken.
    """
    files = [path] if not path.is_dir() else sorted(p for p in path.glob("*.json") if is_manifest(p))
    if len(files) != 1:
        what = "holds no export" if not files else f"holds {len(files)} exports"
        mend = "name the folder that codegen wrote" if not files else f"name one, such as {files[0].name}"
        raise SpecError(what, where=str(path), mend=mend)
    try:
        manifest = json.loads(files[0].read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        words = getattr(error, "strerror", None) or str(error)
        raise SpecError(f"cannot be read ({words})", where=str(files[0]), mend="run codegen again") from None
    schema = manifest.get("schema") if isinstance(manifest, dict) else None
    if schema != SCHEMA or not _NEEDED <= manifest.keys():
        raise SpecError(
            "is no manifest of an export" if schema != SCHEMA else "lacks keys of a manifest",
            where=str(files[0]),
            mend="name the folder that codegen wrote, or run codegen again",
        )
    return manifest, files[0].parent


def is_manifest(path: Path) -> bool:
    """Whether a file is the manifest of an export."""
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return False
    return isinstance(document, dict) and document.get("schema") == SCHEMA


def check_robot(manifest: Mapping[str, Any], robot: Robot, *, where: str = "manifest") -> None:
    """Refuse an export of another robot, naming the first difference.

    Raises:
        ManifestMismatch: Joint order, convention, armature, or anything else of the model.
    """
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
    """What a manifest says of one frame; of the first without a name.

    Raises:
        FrameNotFound: With the frames that it has.
    """
    blocks: dict[str, Mapping[str, Any]] = {str(block["frame"]): block for block in manifest["frames"]}
    if frame is None:
        return next(iter(blocks.values()))
    if frame not in blocks:
        raise FrameNotFound(frame, blocks, where=str(manifest["prefix"]))
    return blocks[frame]
