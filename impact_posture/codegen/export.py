"""Export ``H``, ``∇H`` and the objective of a problem as C code for a controller."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from impact_posture.codegen.c_literals import DOUBLE, FLOAT, Real
from impact_posture.codegen.c_names import c_identifier, check_prefix, products
from impact_posture.codegen.c_source import CSource, build_c_source
from impact_posture.codegen.compile_and_check import compile_and_check
from impact_posture.codegen.export_files import render_files
from impact_posture.codegen.export_library import NamedObjective, named_objectives
from impact_posture.codegen.impact_gradient import ImpactGradient
from impact_posture.codegen.manifest_builder import build_manifest
from impact_posture.config.checked import checked
from impact_posture.errors import CompilerError, InputError, OutputError
from impact_posture.impact.elasticity.contact_compression import Compression
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.robot.robot import Robot
from impact_posture.system.arrays import Array
from impact_posture.system.libraries import library_path
from impact_posture.system.output_folder import whole_folder, write_whole
from impact_posture.system.toolchain import GET_ONE, find_compiler

SCHEMA = "impact-posture/codegen-run/1"


@dataclass(frozen=True)
class WrittenCode:
    """Generated C in a folder.

    Attributes:
        out: The folder of the files.
        manifest: The content of ``<prefix>.json``.
        library: The shared library, where one stays in the folder.
    """

    out: Path
    robot: Robot
    files: tuple[Path, ...]
    manifest: dict[str, Any]
    library: Path | None = None

    @property
    def prefix(self) -> str:
        """Beginning of the C names."""
        return str(self.manifest["prefix"])


@dataclass(frozen=True)
class Export(WrittenCode):
    """A written export of an objective.

    Attributes:
        agreement: Largest relative difference of the built code from CasADi and Pinocchio; ``None`` without a build.
        requested: Whether a library was requested.
    """

    agreement: float | None = None
    requested: bool = False

    @property
    def compiled(self) -> bool:
        """Whether a compiler built the code and the numbers agreed."""
        return self.agreement is not None

    def load(self, **options: Any) -> ImpactGradient:
        """Load the library, which runs its code, with the options of :meth:`ImpactGradient.load`."""
        return ImpactGradient.load(self.out, robot=self.robot, **options)

    @property
    def functions(self) -> list[str]:
        """Names of the C functions."""
        blocks = [block for frame in self.manifest["frames"] for block in (frame, frame["free"])]
        blocks.append(self.manifest["several"])
        return [name for block in blocks if block is not None for name in block["symbols"].values()]

    @property
    def verdict(self) -> str:
        """The outcome of the build as one line."""
        if self.library is not None:
            return f"{self.library.name}: built, agrees to {self.agreement:.0e}"
        if self.requested:
            return f"not built, there is no C compiler: {GET_ONE}, then make shared in {self.out}"
        return f"build and self-test: make -C {self.out} check (or codegen --compile)"

    def to_dict(self) -> dict[str, Any]:
        """Return the document of ``codegen --json``."""
        return {
            "schema": SCHEMA,
            "out": str(self.out),
            "prefix": self.prefix,
            "files": [path.name for path in self.files],
            "functions": self.functions,
            "library": None if self.library is None else self.library.name,
            "agreement": self.agreement,
            "real": self.manifest["real"],
            "stack_bytes": self.manifest["stack_bytes"],
            "verdict": self.verdict,
        }


def export(
    objective: WorstCaseObjective | Sequence[WorstCaseObjective],
    out: Path,
    *,
    prefix: str | None = None,
    posture: Array | None = None,
    compression: Compression | None = None,
    real: Real = DOUBLE,
    portable: bool = False,
    force: bool = False,
    check: bool = True,
) -> Export:
    """Write the C export of an objective into an existing folder, and check it if there is a compiler.

    All texts are complete before the first file is written, and each file is written whole or not at all.

    Args:
        objective: The objective.  Several objectives of one robot at different frames make one library with functions
            ``<prefix>_<frame>_eval`` and so on.
        out: The folder.
        prefix: Beginning of the C names, a C identifier; robot and frame by default.
        posture: A configuration for a constant in the code, shape (nq,).
        compression: Compression time, peak force and x of the impact, for the manifest and the header.
        real: The number type.
        portable: Write plain C99, for compilers without the vectors of GCC and Clang.
        force: Replace existing files.
        check: Build and compare.

    Raises:
        InputError: The prefix is not a C identifier, or the objectives differ in more than the contact.
        PostureError: The posture has the wrong length or is not finite.
        OutputError: ``out`` is not a folder, already contains the files, or is not writable.
        CompilerError: The compiler failed, or the numbers of its code are wrong.  The files remain.
    """
    objectives = _same_robot(objective)
    robot = objectives[0].robot
    if robot.joint_model == "elastic":
        what = "elastic predicts the impact at one posture, and C code is for all postures"
        raise InputError(what, where="joint_model", hint="export link or reflected")
    prefix = default_prefix(objectives) if prefix is None else check_prefix(prefix)
    if not out.is_dir():
        raise OutputError("no such folder", where=str(out), hint="create it first")
    if posture is not None:
        stated = np.array(posture, dtype=float)
        posture = robot.check_posture(stated, limits=False)
        # Normalization changes the last digits of a normalized configuration.  Keep the digits of result.json.
        posture = stated if np.allclose(stated, posture, rtol=0, atol=1e-9) else posture
    exported, code = cached_code(tuple(objectives), prefix, real, portable)
    manifest = build_manifest(objectives, prefix, posture, compression, real, code.stack_bytes, portable=portable)
    texts = render_files(exported, prefix, manifest, code, real)
    texts[f"{prefix}.json"] = json.dumps(manifest, indent=2, allow_nan=False) + "\n"
    there = [name for name in texts if (out / name).exists()]
    if there and not force:
        raise OutputError(f"holds {there[0]} already", where=str(out), hint="give `force` to replace it")
    for name, text in texts.items():
        write_whole(out / name, text)
    written = Export(out, robot, tuple(out / name for name in texts), manifest)
    if not check or find_compiler() is None:
        return written
    return replace(written, agreement=compile_and_check(out, prefix, objectives))


@lru_cache(maxsize=1)
def cached_code(
    objectives: tuple[WorstCaseObjective, ...], prefix: str, real: Real, portable: bool
) -> tuple[tuple[NamedObjective, ...], CSource]:
    """Return the functions of an export, which take most of the time of :func:`export` and depend on no posture."""
    exported = named_objectives(objectives, prefix)
    return exported, build_c_source(exported, prefix, real, portable=portable)


@checked
def write_export(
    objectives: Sequence[WorstCaseObjective],
    out: Path | None = None,
    *,
    prefix: str | None = None,
    posture: Array | None = None,
    compression: Compression | None = None,
    single: bool = False,
    portable: bool = False,
    build: bool = False,
    force: bool = False,
) -> Export:
    """Write an export into a new folder, whole or not at all, and build its library there on request.

    The folder ``out`` is ``./<prefix>-c`` by default.  With ``single`` the code computes in ``float``.  ``build``
    builds ``lib<prefix>.so`` in the folder.  Without a compiler there is neither a library nor an error.  ``force``
    replaces an earlier export.  The other arguments are as in :func:`export`.

    Raises:
        OutputError: The folder exists without ``force``, is not an export, or is not writable.
        CompilerError: The compiler failed, or the numbers of its code are wrong.  Nothing is written.
        ImpactPostureError: As in :func:`export`.
    """
    prefix = default_prefix(objectives) if prefix is None else check_prefix(prefix)
    out = Path(f"{prefix}-c") if out is None else out
    real = FLOAT if single else DOUBLE
    agreement = None
    with whole_folder(out, force=force, kind="export", products=products(prefix)) as folder:
        written = export(
            objectives, folder, prefix=prefix, posture=posture, compression=compression, real=real, portable=portable,
            check=False,
        )  # fmt: skip
        if build and find_compiler() is not None:
            try:
                agreement = compile_and_check(folder, prefix, objectives, keep=True)
            except CompilerError as error:
                hint = f"{error.hint}; without compiling, the C code is written all the same"
                raise CompilerError(error.what, where=error.where, hint=hint) from None
    library = None if agreement is None else library_path(out, prefix)
    files = tuple(out / path.name for path in written.files)
    return replace(written, out=out, files=files, agreement=agreement, library=library, requested=build)


def default_prefix(objectives: Sequence[WorstCaseObjective]) -> str:
    """Return robot and frame as a prefix; the robot alone where there are several frames."""
    first = objectives[0]
    alone = len(objectives) == 1 and not first.others
    return c_identifier(first.robot.name, first.contact.frame if alone else "")


def _same_robot(objective: WorstCaseObjective | Sequence[WorstCaseObjective]) -> tuple[WorstCaseObjective, ...]:
    """Return the objectives as a tuple, and refuse objectives that differ in more than the contact."""
    objectives = (objective,) if isinstance(objective, WorstCaseObjective) else tuple(objective)
    if not objectives:
        raise InputError("no objective is given", where="codegen", hint="give one for each frame")
    first = objectives[0]
    for other in objectives[1:]:
        if _without_contact(other) != _without_contact(first):
            what = f"'{other.contact.frame}' and '{first.contact.frame}' differ in more than the contact"
            raise InputError(what, where="codegen", hint="export them one by one")
    return objectives


def _without_contact(o: WorstCaseObjective) -> tuple[object, ...]:
    models = tuple(variant.robot.impact_sha256 for variant in o.model_variants)
    return o.robot.impact_sha256, o.metric, o.kind, o.supports, o.compliance, o.normal_cone_deg, models
