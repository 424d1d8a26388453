"""Build, load and cache shared libraries.

Loading a library runs its code, and loading a truncated library can end the process.  Therefore this module writes
a SHA-256 file beside each library that it builds.  :func:`load_library` refuses a library whose SHA-256 differs from
this file.  Only the user can write to the cache.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import re
import stat
import struct
import subprocess
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from functools import cache
from pathlib import Path

from impact_posture.errors import CompilerError, OutputError, SpecError
from impact_posture.system.folder_record import sha256_of
from impact_posture.system.scratch_folder import scratch_folder
from impact_posture.system.text_files import open_regular, read_bytes
from impact_posture.system.toolchain import require_compiler, run_compiler, run_compilers, words_of
from impact_posture.version import __version__

# In the strict mode -std=c99, GCC fuses multiplications and additions only with -ffp-contract=fast.
_FLAGS = ("-std=c99", "-O2", "-ffp-contract=fast", "-fPIC")


def library_path(folder: Path, prefix: str) -> Path:
    """Return the path of ``lib<prefix>.so`` in a folder."""
    return folder / f"lib{prefix}.so"


def build_library(folder: Path, prefix: str, library: Path | None = None, flags: Sequence[str] = ()) -> Path:
    """Compile ``<prefix>.c`` in ``folder`` into a shared library, and return the path of the library.

    By default, the library is ``lib<prefix>.so`` beside the source.  The compiler gets the flags of strict C, then
    ``$CFLAGS``, then ``flags``.

    Raises:
        CompilerError: No compiler exists, or the compiler failed; the error contains the first error line and the
            command.
        OutputError: The library cannot be written.
    """
    compiler = require_compiler("codegen")
    library = (library_path(folder, prefix) if library is None else library).absolute()
    _check_sources(folder)
    with building(library) as scratch:
        output = str(scratch / library.name)
        run_compiler(
            [*compiler, *_FLAGS, "-shared", *words_of("CFLAGS"), *flags, f"{prefix}.c", "-o", output, "-lm"], folder
        )
        _check_sanitizer(Path(output))
    return library


def build_parts(folder: Path, library: Path, parts: Mapping[str, Sequence[str]]) -> Path:
    """Compile sources in parallel into a shared library, and return the path of the library.

    ``parts`` maps each source in ``folder`` to its compiler flags, which follow the flags of strict C and
    ``$CFLAGS``.  The cache stores an object file for each preprocessed source and its flags, so that libraries can
    share object files.

    Raises:
        CompilerError: No compiler exists, or the compiler failed; the error contains the first error line and the
            command.
        OutputError: The library or the cache cannot be written.
    """
    compiler = require_compiler("codegen")
    library = library.absolute()
    _check_sources(folder)
    cached = cache_folder("objects")
    with building(library) as scratch:
        commands = [[*compiler, *_FLAGS, *words_of("CFLAGS"), *flags, name] for name, flags in parts.items()]
        texts = [scratch / f"{name}.i" for name in parts]
        run_compilers([[*c, "-E", "-P", "-o", str(text)] for c, text in zip(commands, texts, strict=True)], folder)
        objects = {
            cached / f"{source_key([repr(command), text.read_text(encoding='utf-8')])}.o": command
            for command, text in zip(commands, texts, strict=True)
        }
        with ExitStack() as finished:
            missing = {part: command for part, command in objects.items() if not is_cached(part)}
            outputs = [str(finished.enter_context(building(part)) / part.name) for part in missing]
            run_compilers([[*c, "-c", "-o", out] for c, out in zip(missing.values(), outputs, strict=True)], folder)
        run_compiler([*compiler, "-shared", *map(str, objects), "-o", str(scratch / library.name), "-lm"], folder)
        _check_sanitizer(scratch / library.name)
    return library


def _check_sources(folder: Path) -> None:
    """Raise an error if a source or header is a pipe, for which the compiler would wait forever."""
    for path in folder.glob("*.[ch]"):
        try:
            open_regular(path).close()
        except OSError as error:
            raise CompilerError.unreadable(path, error) from None


@contextmanager
def building(library: Path) -> Iterator[Path]:
    """Yield a temporary folder.  After the block, the library that was built in this folder replaces ``library``.

    A SHA-256 file is written beside the library.  An interruption leaves either the old library, or the new library
    without a SHA-256 file.

    Raises:
        OutputError: The library cannot be written, for example because the disk is full.
    """
    try:
        with scratch_folder(library.parent) as folder:
            yield folder
            if (built := folder / library.name).is_file():
                _replace(library, built)
    except OSError as error:
        hint = "free some space or check the permissions; IMPACT_POSTURE_CACHE names another cache"
        raise OutputError.unwritable(library.parent, error, hint) from None


def _replace(library: Path, built: Path) -> None:
    hash_path(built).write_text(f"{sha256_of(built)}  {library.name}\n", encoding="utf-8")
    hash_path(library).unlink(missing_ok=True)
    os.replace(built, library)
    os.replace(hash_path(built), hash_path(library))


def hash_path(library: Path) -> Path:
    """Return the path of the SHA-256 file of a library.  ``sha256sum --check`` can read this file."""
    return library.with_name(f"{library.name}.sha256")


def has_its_hash(library: Path) -> bool | None:
    """Return whether a library matches the SHA-256 file beside it; ``None`` if the file is missing."""
    try:
        words = read_bytes(hash_path(library)).decode(errors="replace").split()
    except FileNotFoundError:
        return None
    return words[:1] == [sha256_of(library)]


def _check_sanitizer(library: Path) -> None:
    """Check that another process can load a library that needs the runtime of a sanitizer.

    The runtime of AddressSanitizer ends a process that does not load it first, without an exception.

    Raises:
        CompilerError: Loading the library ends the process.
    """
    if not re.search(rb"san\.so|__[a-z]+san_", read_bytes(library)):
        return
    program = "import ctypes, sys; ctypes.CDLL(sys.argv[1])"
    trial = subprocess.run(
        [sys.executable, "-I", "-c", program, str(library)], capture_output=True, text=True, errors="replace",
        check=False,
    )  # fmt: skip
    if trial.returncode:
        reason = trial.stderr.strip().rpartition("\n")[2] or f"exit code {trial.returncode}"
        hint = "leave -fsanitize out of CFLAGS and CC, or preload the runtime"
        raise CompilerError(f"cannot be loaded ({reason})", where=library.name, hint=hint)


def load_library(library: Path) -> ctypes.CDLL:
    """Load a shared library.  Loading runs code of the library.

    Raises:
        CompilerError: The library needs a sanitizer, whose runtime would end this process.
        SpecError: The library differs from the SHA-256 beside it, is truncated, or cannot be loaded.
    """
    hint = "delete this file, so that it is built again"
    try:
        unchanged = has_its_hash(library)
        if unchanged is False:
            fault = "is not the library that was built here (another SHA-256)"
            hint += f"; if you built it yourself, delete {hash_path(library).name}"
        elif unchanged is None and _is_truncated(library):
            fault = "is truncated (shorter than its ELF header states)"
        else:
            _check_sanitizer(library)
            return ctypes.CDLL(str(library.absolute()))
    except OSError as error:
        fault = f"cannot be loaded ({error.strerror or error})"
    raise SpecError(fault, where=str(library), hint=hint)


def _is_truncated(library: Path) -> bool:
    """Return whether a 64-bit ELF file ends before its section headers, which linkers write last.

    The system kills a process that loads a truncated file and reads a missing page (SIGBUS).
    """
    with open_regular(library) as file:
        header = file.read(64)
    if len(header) < 64 or header[:5] != b"\x7fELF\2":
        return False
    order = "<" if header[5] == 1 else ">"
    (offset,) = struct.unpack_from(f"{order}Q", header, 40)
    size, count = struct.unpack_from(f"{order}HH", header, 58)
    return bool(library.stat().st_size < offset + size * count)


def cache_path() -> Path:
    """Return the path of the cache: ``$IMPACT_POSTURE_CACHE``, or else a folder in the user's cache folder.

    Raises:
        OutputError: The user has no home folder, or the path is not UTF-8, which CasADi requires.
    """
    # The XDG specification says to ignore a relative path.
    base = Path(os.environ.get("XDG_CACHE_HOME", ""))
    try:
        if chosen := os.environ.get("IMPACT_POSTURE_CACHE"):
            path = Path(chosen).absolute()
        else:
            path = (base if base.is_absolute() else Path.home() / ".cache") / "impact-posture"
        str(path).encode("utf-8")
    except RuntimeError:
        raise OutputError("the user has no home folder", where="cache", hint="set IMPACT_POSTURE_CACHE") from None
    except UnicodeEncodeError:
        hint = "set IMPACT_POSTURE_CACHE to another folder"
        raise OutputError("is not UTF-8", where=str(path), hint=hint) from None
    return path


def cache_folder(*parts: str) -> Path:
    """Return a folder of the cache; if the folder is missing, make it with mode 0700.

    Raises:
        OutputError: The folder cannot be made, or another user owns the folder or may write to it.
    """
    folder = cache_path()
    try:
        for part in ("", *parts):
            folder = folder / part
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            check_private(folder)
    except OSError as error:
        raise OutputError.unwritable(folder, error, "set IMPACT_POSTURE_CACHE to a folder") from None
    return folder


def source_key(content: Iterable[str], *packages: str) -> str:
    """Return a short hash of everything that compiled code depends on.

    The hash includes the texts in ``content`` and the source code of ``packages`` below ``impact_posture``, which
    generates the compiled code.
    """
    text = "\n".join([__version__, *content, *map(_source_hash, packages)])
    return hashlib.sha256(text.encode()).hexdigest()[:32]


@cache
def _source_hash(package: str) -> str:
    digest = hashlib.sha256()
    for path in sorted((Path(__file__).parents[1] / package).glob("**/*")):
        if path.suffix in (".py", ".jinja", ".c", ".h"):
            digest.update(path.read_bytes())
    return digest.hexdigest()


def check_private(path: Path) -> None:
    """Raise an error if another user controls a path, because the other user could choose the code that runs.

    Raises:
        OutputError: Another user owns the path or may write to it.
    """
    status = path.stat()
    if status.st_uid not in (os.geteuid(), 0):
        raise OutputError("belongs to another user", where=str(path), hint="set IMPACT_POSTURE_CACHE to a folder")
    if status.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        raise OutputError("can be written by others", where=str(path), hint=f"chmod go-w {path}, if you trust it")


def is_cached(library: Path) -> bool:
    """Return whether the cache has a library that matches its SHA-256; delete a library that does not match.

    Raises:
        OutputError: Another user owns the library or its folder, or may write to them.
    """
    with suppress(OSError):
        check_private(library.parent)
        check_private(library)
        if has_its_hash(library):
            return True
        library.unlink()
    return False
