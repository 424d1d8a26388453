"""Export ``H``, its gradient and the objective of a problem as C code for a controller."""

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
    """Generated C code in a folder.

    Attributes:
        out: The folder that contains the files.
        robot: The robot for which the code was generated.
        files: Paths of the generated files.
        manifest: The content of ``<prefix>.json``.
        library: Path of the shared library; ``None`` if the folder has no library.
    """

    out: Path
    robot: Robot
    files: tuple[Path, ...]
    manifest: dict[str, Any]
    library: Path | None = None

    @property
    def prefix(self) -> str:
        """Text with which all C names of the export begin."""
        return str(self.manifest["prefix"])


@dataclass(frozen=True)
class Export(WrittenCode):
    """The export of an objective in a folder.

    Attributes:
        agreement: Largest relative difference between the results of the compiled code and of CasADi or Pinocchio;
            ``None`` if the code was not compiled.
        requested: Whether the user requested a library.
    """

    agreement: float | None = None
    requested: bool = False

    @property
    def compiled(self) -> bool:
        """Whether the code was compiled and its results agreed with CasADi and Pinocchio."""
        return self.agreement is not None

    def load(self, **options: Any) -> ImpactGradient:
        """Load the library, which runs its code.  The options are arguments of :meth:`ImpactGradient.load`."""
        return ImpactGradient.load(self.out, robot=self.robot, **options)

    @property
    def functions(self) -> list[str]:
        """Names of all C functions of the export."""
        blocks = [block for frame in self.manifest["frames"] for block in (frame, frame["free"])]
        blocks.append(self.manifest["several"])
        return [name for block in blocks if block is not None for name in block["symbols"].values()]

    @property
    def verdict(self) -> str:
        """One line for users that states whether the library was built."""
        if self.library is not None:
            return f"{self.library.name}: built, agrees to {self.agreement:.0e}"
        if self.requested:
            return f"not built, because no C compiler is installed: {GET_ONE}, then make shared in {self.out}"
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
    cuda: bool = False,
    force: bool = False,
    check: bool = True,
) -> Export:
    """Write the C export of an objective into an existing folder, and check the code if there is a compiler.

    All texts are generated before the first file is written.  Each file is written completely or not at all.

    Args:
        objective: The objective, or several objectives of one robot at different frames.  Several objectives become
            one library with functions such as ``<prefix>_<frame>_eval``.
        out: The folder, which must exist.
        prefix: Text with which all C names begin, a C identifier; by default, names of robot and frame.
        posture: Configuration that the code contains as a constant, shape (nq,); ``None`` for no constant.
        compression: Duration and peak force of the impact (:class:`Compression`), for the manifest and the header.
        real: Floating-point type of the code.
        portable: Write plain C99 without vectors, for compilers other than GCC and Clang.
        cuda: Also write an example and ``<prefix>.cuh``: the same functions as device code, with kernels for batches.
        force: Replace existing files.
        check: Compile the code, and compare its results with CasADi and Pinocchio.

    Raises:
        InputError: The prefix is not a C identifier, the objectives differ in anything but the contact, the joint
            model is ``elastic``, or ``cuda`` is requested in ``float`` for a robot with supports.
        PostureError: The posture has the wrong length or is not finite.
        OutputError: ``out`` is not a folder, already contains the files, or is not writable.
        CompilerError: The compiler failed, or the results of the compiled code are wrong.  The files stay.
    """
    objectives = _same_robot(objective)
    robot = objectives[0].robot
    if robot.joint_model == "elastic":
        what = "the joint model elastic predicts an impact at one posture, but C code must work at all postures"
        raise InputError(what, where="joint_model", hint="use the joint model link or reflected")
    if cuda and real is FLOAT and objectives[0].supports:
        what = "with supports, float has relative errors of 1e-2 on a GPU, because the supports are stiff"
        raise InputError(what, where="cuda", hint="use double, or leave the supports out")
    prefix = default_prefix(objectives) if prefix is None else check_prefix(prefix)
    if not out.is_dir():
        raise OutputError("no such folder", where=str(out), hint="create it first")
    if posture is not None:
        stated = np.array(posture, dtype=float)
        posture = robot.check_posture(stated, limits=False)
        # Keep the digits of ``posture``, so that the code contains the same numbers as result.json.  Normalization
        # can change the last digits of a normalized posture.
        posture = stated if np.allclose(stated, posture, rtol=0, atol=1e-9) else posture
    exported, code = cached_code(tuple(objectives), prefix, real, portable, cuda)
    manifest = build_manifest(
        objectives, prefix, posture, compression, real, code.stack_bytes, portable=portable, cuda=cuda
    )
    texts = render_files(exported, prefix, manifest, code, real)
    texts[f"{prefix}.json"] = json.dumps(manifest, indent=2, allow_nan=False) + "\n"
    there = [name for name in texts if (out / name).exists()]
    if there and not force:
        raise OutputError(f"already contains {there[0]}", where=str(out), hint="give `force` to replace it")
    for name, text in texts.items():
        write_whole(out / name, text)
    written = Export(out, robot, tuple(out / name for name in texts), manifest)
    if not check or find_compiler() is None:
        return written
    return replace(written, agreement=compile_and_check(out, prefix, objectives))


@lru_cache(maxsize=1)
def cached_code(
    objectives: tuple[WorstCaseObjective, ...], prefix: str, real: Real, portable: bool, cuda: bool
) -> tuple[tuple[NamedObjective, ...], CSource]:
    """Return the named objectives and the C code of an export, cached because generating the code is slow."""
    exported = named_objectives(objectives, prefix)
    return exported, build_c_source(exported, prefix, real, portable=portable, cuda=cuda)


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
    cuda: bool = False,
    build: bool = False,
    force: bool = False,
) -> Export:
    """Write an export into a new folder, completely or not at all.

    The folder ``out`` is ``./<prefix>-c`` by default.  With ``single``, the code computes in ``float``.  ``build``
    creates ``lib<prefix>.so`` in the folder; without a compiler, the library is omitted without an error.
    ``force`` replaces an earlier export.  The other arguments are the same as in :func:`export`.

    Raises:
        OutputError: The folder exists and ``force`` is False, the folder is not an export, or it is not writable.
        CompilerError: The compiler failed, or the results of the compiled code are wrong.  Nothing is written.
        ImpactPostureError: The other errors of :func:`export`.
    """
    prefix = default_prefix(objectives) if prefix is None else check_prefix(prefix)
    out = Path(f"{prefix}-c") if out is None else out
    real = FLOAT if single else DOUBLE
    agreement = None
    with whole_folder(out, force=force, kind="export", products=products(prefix)) as folder:
        written = export(
            objectives, folder, prefix=prefix, posture=posture, compression=compression, real=real, portable=portable,
            cuda=cuda, check=False,
        )  # fmt: skip
        if build and find_compiler() is not None:
            try:
                agreement = compile_and_check(folder, prefix, objectives, keep=True)
            except CompilerError as error:
                hint = f"{error.hint}; if you do not request compilation, the C code is still written"
                raise CompilerError(error.what, where=error.where, hint=hint) from None
    library = None if agreement is None else library_path(out, prefix)
    files = tuple(out / path.name for path in written.files)
    return replace(written, out=out, files=files, agreement=agreement, library=library, requested=build)


def default_prefix(objectives: Sequence[WorstCaseObjective]) -> str:
    """Return the default prefix: names of robot and frame, or only the name of the robot for several frames."""
    first = objectives[0]
    alone = len(objectives) == 1 and not first.others
    return c_identifier(first.robot.name, first.contact.frame if alone else "")


def _same_robot(objective: WorstCaseObjective | Sequence[WorstCaseObjective]) -> tuple[WorstCaseObjective, ...]:
    """Return the objectives as a tuple; raise ``InputError`` if they differ in anything but the contact."""
    objectives = (objective,) if isinstance(objective, WorstCaseObjective) else tuple(objective)
    if not objectives:
        raise InputError("no objective is given", where="codegen", hint="give one objective for each frame")
    first = objectives[0]
    for other in objectives[1:]:
        if _without_contact(other) != _without_contact(first):
            what = f"objectives at '{first.contact.frame}', '{other.contact.frame}' differ in more than the contact"
            raise InputError(what, where="codegen", hint="export each objective separately")
    return objectives


def _without_contact(o: WorstCaseObjective) -> tuple[object, ...]:
    models = tuple(variant.robot.impact_sha256 for variant in o.model_variants)
    return o.robot.impact_sha256, o.metric, o.kind, o.supports, o.compliance, o.normal_cone_deg, models
