"""``H``, ``∇H`` and the problem's own objective as C code that a controller can link."""

from __future__ import annotations

import json
import os
import re
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from impact_posture.codegen.compiler import compile_and_check
from impact_posture.codegen.manifest import build_manifest
from impact_posture.codegen.source import build_texts
from impact_posture.errors import InputError, OutputError
from impact_posture.impact.objective import ImpactObjective
from impact_posture.toolchain import find_compiler

_IDENTIFIER = re.compile(r"[A-Za-z][A-Za-z0-9_]*")


@dataclass(frozen=True)
class Export:
    """A written export.

    Attributes:
        prefix: What its C names begin with.
        files: The files that were written.
        manifest: What ``<prefix>.json`` holds.
        compiled: Whether a compiler was there, built it and it agreed.
        agreement: Largest relative difference of the built code from CasADi's and Pinocchio's numbers; ``None``
            where it was not built.
    """

    prefix: str
    files: tuple[Path, ...]
    manifest: dict[str, Any]
    compiled: bool
    agreement: float | None


def c_identifier(robot: str, frame: str) -> str:
    """Robot and frame as one C identifier: what is no letter, digit or underscore becomes an underscore."""
    text = re.sub(r"_{2,}", "_", re.sub(r"[^A-Za-z0-9]", "_", f"{robot}_{frame}")).strip("_")
    return text if _IDENTIFIER.fullmatch(text) else f"robot_{text}".rstrip("_")


def export(
    objective: ImpactObjective,
    out: Path,
    *,
    prefix: str | None = None,
    posture: NDArray[np.float64] | None = None,
    force: bool = False,
    check: bool = True,
) -> Export:
    """Write the C export of an objective into the folder ``out`` and, where a compiler is there, prove it.

    Nothing is written before all of it is made, and each file appears whole or not at all.

    Args:
        objective: What to export.
        out: An existing folder.
        prefix: What the C names begin with, a C identifier; robot and frame by default.
        posture: A configuration to go along as a constant, shape (nq,).
        force: Replace files that are there.
        check: Build and compare; ``compiled`` is false without.

    Raises:
        InputError: The prefix is no C identifier.
        PostureError: The posture has another length or is not finite.
        OutputError: ``out`` is no folder, holds such files already, or cannot be written.
        CompilerError: The compiler failed, or what it made computes other numbers; the files are there.
    """
    prefix = _checked_prefix(objective, prefix)
    if not out.is_dir():
        raise OutputError("no such folder", where=str(out), mend="create it first")
    if posture is not None:
        given = np.array(posture, dtype=float)
        posture = objective.robot.check_posture(given, limits=False)
        # Normalizing what is of unit norm already turns last digits: keep those that result.json has.
        posture = given if np.allclose(given, posture, rtol=0, atol=1e-9) else posture
    manifest = build_manifest(objective, prefix, posture)
    texts = build_texts(objective, prefix, manifest)
    texts[f"{prefix}.json"] = json.dumps(manifest, indent=2, allow_nan=False, ensure_ascii=False) + "\n"
    _write(texts, out, force)
    files = tuple(out / name for name in texts)
    if not check or find_compiler() is None:
        return Export(prefix, files, manifest, compiled=False, agreement=None)
    return Export(prefix, files, manifest, compiled=True, agreement=compile_and_check(out, prefix, objective))


def _checked_prefix(objective: ImpactObjective, prefix: str | None) -> str:
    if prefix is None:
        return c_identifier(objective.robot.name, objective.contact.frame)
    if not _IDENTIFIER.fullmatch(prefix):
        raise InputError(
            f"the prefix '{prefix}' is no C identifier",
            where="--prefix",
            mend=f"letters, digits and underscores, a letter first, such as {c_identifier(prefix, '')}",
        )
    if prefix.lower() == "example":
        raise InputError("the prefix 'example' is taken by example.c", where="--prefix", mend="choose another")
    return prefix


def _write(texts: dict[str, str], out: Path, force: bool) -> None:
    there = [name for name in texts if (out / name).exists()]
    if there and not force:
        raise OutputError(f"holds {there[0]} already", where=str(out), mend="give --force to replace it")
    for name, text in texts.items():
        beside = out / f".{name}.part"
        try:
            beside.write_text(text, encoding="utf-8", newline="\n")
            os.replace(beside, out / name)
        except OSError as error:
            with suppress(OSError):
                beside.unlink()
            raise OutputError(
                f"cannot be written ({error.strerror})", where=str(out / name), mend="check the disk and permissions"
            ) from None
