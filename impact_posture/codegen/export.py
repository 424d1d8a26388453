"""``H``, ``∇H`` and the problem's own objective as C code that a controller can link."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from impact_posture.codegen.build_check import compile_and_check
from impact_posture.codegen.code import build_code
from impact_posture.codegen.emitter import DOUBLE, Real
from impact_posture.codegen.manifest import build_manifest
from impact_posture.codegen.naming import c_identifier, check_prefix
from impact_posture.codegen.source import build_texts
from impact_posture.codegen.variants import variants
from impact_posture.errors import InputError, OutputError
from impact_posture.impact.objective import ImpactObjective
from impact_posture.toolchain import find_compiler


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


def export(
    objective: ImpactObjective | Sequence[ImpactObjective],
    out: Path,
    *,
    prefix: str | None = None,
    posture: NDArray[np.float64] | None = None,
    real: Real = DOUBLE,
    portable: bool = False,
    force: bool = False,
    check: bool = True,
) -> Export:
    """Write the C export of an objective into the folder ``out`` and, where a compiler is there, prove it.

    Nothing is written before all of it is made, and each file appears whole or not at all.

    Args:
        objective: What to export; several of one robot, each at a frame of its own, make one library with
            functions ``<prefix>_<frame>_eval`` and so on.
        out: An existing folder.
        prefix: What the C names begin with, a C identifier; robot and frame by default.
        posture: A configuration to go along as a constant, shape (nq,).
        real: The C type to compute in.
        portable: Plain C99, for compilers without the vectors of GCC and Clang.
        force: Replace files that are there.
        check: Build and compare; ``compiled`` is false without.

    Raises:
        InputError: The prefix is no C identifier.
        PostureError: The posture has another length or is not finite.
        OutputError: ``out`` is no folder, holds such files already, or cannot be written.
        CompilerError: The compiler failed, or what it made computes other numbers; the files are there.
    """
    objectives = _same_robot(objective)
    robot = objectives[0].robot
    prefix = default_prefix(objectives) if prefix is None else check_prefix(prefix)
    if not out.is_dir():
        raise OutputError("no such folder", where=str(out), hint="create it first")
    if posture is not None:
        given = np.array(posture, dtype=float)
        posture = robot.check_posture(given, limits=False)
        # Normalizing what is of unit norm already turns last digits: keep those that result.json has.
        posture = given if np.allclose(given, posture, rtol=0, atol=1e-9) else posture
    exported = variants(objectives, prefix)
    code = build_code(exported, prefix, real, portable=portable)
    manifest = build_manifest(objectives, prefix, posture, real, code.stack_bytes)
    texts = build_texts(exported, prefix, manifest, code, real)
    texts[f"{prefix}.json"] = json.dumps(manifest, indent=2, allow_nan=False) + "\n"
    _write(texts, out, force)
    files = tuple(out / name for name in texts)
    if not check or find_compiler() is None:
        return Export(prefix, files, manifest, compiled=False, agreement=None)
    agreement = compile_and_check(out, prefix, objectives, real=real)
    return Export(prefix, files, manifest, compiled=True, agreement=agreement)


def default_prefix(objectives: Sequence[ImpactObjective]) -> str:
    """Robot and frame; the robot alone where there are several."""
    first = objectives[0]
    alone = len(objectives) == 1 and not first.others
    return c_identifier(first.robot.name, first.contact.frame if alone else "")


def _same_robot(objective: ImpactObjective | Sequence[ImpactObjective]) -> tuple[ImpactObjective, ...]:
    objectives = (objective,) if isinstance(objective, ImpactObjective) else tuple(objective)
    if not objectives:
        raise InputError("no objective is given", where="codegen", hint="give one for each frame")
    first = objectives[0]
    shared = _what(first)
    for other in objectives[1:]:
        if _what(other) != shared:
            raise InputError(
                f"'{other.contact.frame}' and '{first.contact.frame}' differ in more than the contact",
                where="codegen",
                hint="export them one by one",
            )
    return objectives


def _what(o: ImpactObjective) -> tuple[object, ...]:
    """Everything but the contact."""
    models = tuple(variant.robot.model_sha256 for variant in o.model_variants)
    return o.robot.model_sha256, o.metric, o.kind, o.supports, o.compliance, o.normal_cone_deg, models


def _write(texts: dict[str, str], out: Path, force: bool) -> None:
    there = [name for name in texts if (out / name).exists()]
    if there and not force:
        raise OutputError(f"holds {there[0]} already", where=str(out), hint="give --force to replace it")
    for name, text in texts.items():
        beside = out / f".{name}.part"
        try:
            beside.write_text(text, encoding="utf-8", newline="\n")
            os.replace(beside, out / name)
        except OSError as error:
            with suppress(OSError):
                beside.unlink()
            raise OutputError(
                f"cannot be written ({error.strerror})", where=str(out / name), hint="check the disk and permissions"
            ) from None
