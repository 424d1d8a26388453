"""An export as a folder of its own: written whole or not at all, and built where that is asked for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from impact_posture.codegen.build_check import compile_and_check
from impact_posture.codegen.emitter import DOUBLE, FLOAT
from impact_posture.codegen.export import Export, default_prefix, export
from impact_posture.codegen.library import GET_ONE, library_path, products
from impact_posture.codegen.naming import check_prefix
from impact_posture.errors import CompilerError
from impact_posture.impact.objective import ImpactObjective
from impact_posture.output_folder import whole_folder
from impact_posture.toolchain import find_compiler

SCHEMA = "impact-posture/codegen-run/1"


@dataclass(frozen=True)
class WrittenExport:
    """A written folder.

    Attributes:
        out: The folder.
        export: What is in it.
        library: The shared library, where one was built and agreed.
        asked: Whether one was asked for.
    """

    out: Path
    export: Export
    library: Path | None
    asked: bool

    @property
    def functions(self) -> list[str]:
        """Names of the C functions."""
        manifest = self.export.manifest
        blocks = [block for frame in manifest["frames"] for block in (frame, frame["free"])]
        return [
            name
            for block in (*blocks, manifest["several"])
            if block is not None
            for name in block["symbols"].values()
        ]

    @property
    def verdict(self) -> str:
        """What became of the build, in one line."""
        if self.library is not None:
            return f"{self.library.name}: built, agrees to {self.export.agreement:.0e}"
        if self.asked:
            return f"not built, there is no C compiler: {GET_ONE}, then make shared in {self.out}"
        return f"build and self-test: make -C {self.out} check (or codegen --compile)"

    def to_dict(self) -> dict[str, Any]:
        """The document of ``codegen --json``."""
        return {
            "schema": SCHEMA,
            "out": str(self.out),
            "prefix": self.export.prefix,
            "files": [path.name for path in self.export.files],
            "functions": self.functions,
            "library": None if self.library is None else self.library.name,
            "agreement": self.export.agreement,
            "real": self.export.manifest["real"],
            "stack_bytes": self.export.manifest["stack_bytes"],
            "verdict": self.verdict,
        }


def write_export(
    objectives: Sequence[ImpactObjective],
    out: Path | None = None,
    *,
    prefix: str | None = None,
    posture: NDArray[np.float64] | None = None,
    single: bool = False,
    portable: bool = False,
    build: bool = False,
    force: bool = False,
) -> WrittenExport:
    """Write an export into a folder of its own and, on demand, build and check its library there.

    Args:
        objectives: One for each frame.
        out: The folder; ``./<prefix>-c`` by default.
        prefix: What the C names begin with; robot and frame by default.
        posture: A configuration to go along, shape (nq,).
        single: Compute in ``float``.
        portable: Plain C99, for compilers without the vectors of GCC and Clang.
        build: Leave ``lib<prefix>.so`` in the folder.  Without a compiler there is none, and no error.
        force: Replace an earlier export.

    Raises:
        OutputError: The folder exists without ``force``, is no export, or cannot be written.
        CompilerError: The compiler failed, or what it made computes other numbers; nothing is written.
        ImpactPostureError: As :func:`~impact_posture.codegen.export.export`.
    """
    prefix = default_prefix(objectives) if prefix is None else check_prefix(prefix)
    out = Path(f"{prefix}-c") if out is None else out
    real = FLOAT if single else DOUBLE
    with whole_folder(out, force=force, kind="export", products=products(prefix)) as folder:
        made = export(objectives, folder, prefix=prefix, posture=posture, real=real, portable=portable, check=False)
        if build and find_compiler() is not None:
            try:
                agreement = compile_and_check(folder, prefix, objectives, real=real, keep=True)
            except CompilerError as error:
                hint = f"{error.hint}; without --compile the C code is written all the same"
                raise CompilerError(error.what, where=error.where, hint=hint) from None
            made = replace(made, compiled=True, agreement=agreement)
    made = replace(made, files=tuple(out / path.name for path in made.files))
    return WrittenExport(out, made, library_path(out, prefix) if made.compiled else None, build)
