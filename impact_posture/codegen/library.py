"""An export's shared library: where it is and how it is built.  Needs no CasADi."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

from impact_posture.errors import CompilerError, OutputError
from impact_posture.libraries import put_library, seal_path
from impact_posture.toolchain import find_compiler, run_compiler, words_of

# Strict C forbids fused multiply-adds by default.
FLAGS = ("-std=c99", "-O2", "-ffp-contract=fast", "-fPIC", "-shared")
GET_ONE = "install gcc or clang, or set CC"


def library_path(folder: Path, prefix: str) -> Path:
    """``lib<prefix>.so`` in the export's folder."""
    return folder / f"lib{prefix}.so"


def products(prefix: str) -> tuple[str, ...]:
    """What the Makefile of an export, and whoever loads it, make beside it."""
    library = f"lib{prefix}.so"
    return ("example", "example_cpp", f"{prefix}.o", library, f"{library}.sha256")


def build_library(folder: Path, prefix: str, target: Path | None = None, extra_flags: tuple[str, ...] = ()) -> Path:
    """Compile ``<prefix>.c`` in ``folder`` into a shared library; it appears whole or not at all, with its seal.

    Args:
        folder: The export.
        prefix: Its prefix.
        target: Where to; ``lib<prefix>.so`` beside the source by default.
        extra_flags: For the compiler, after :data:`FLAGS` and those in ``$CFLAGS``.

    Raises:
        CompilerError: No compiler, or it failed: its first error line and the command.
        OutputError: The library cannot be put there.
    """
    compiler = find_compiler()
    if compiler is None:
        raise CompilerError("no C compiler found", where="codegen", hint=GET_ONE)
    target = library_path(folder, prefix) if target is None else target
    # In the same folder, so that the rename is one step; by process, so that two builds do not meet.
    beside = target.with_name(f".{target.name}.{os.getpid()}.part")
    command = [
        *compiler,
        *FLAGS,
        *words_of("CFLAGS"),
        *extra_flags,
        f"{prefix}.c",
        "-o",
        str(beside.absolute()),
        "-lm",
    ]
    try:
        run_compiler(command, folder)
        put_library(beside, target)
    except OSError as error:
        hint = "check the disk and permissions"
        raise OutputError(f"cannot be written ({error.strerror})", where=str(target), hint=hint) from None
    finally:
        for left in (beside, seal_path(beside)):
            with suppress(OSError):
                left.unlink()
    return target
