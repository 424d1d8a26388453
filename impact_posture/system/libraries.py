"""Shared libraries: build them, seal them, check them before they are loaded, and keep them in the cache of the user.

Loading a library runs its code, and a damaged library ends the process.  So a library that is built here has its
SHA-256 beside it.  Any other library must at least be as long as its header says.  Nobody but the user may write the
cache.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import stat
import struct
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from functools import cache
from pathlib import Path

from impact_posture.errors import OutputError, SpecError
from impact_posture.system.scratch_folder import scratch_folder
from impact_posture.system.toolchain import find_compiler, no_compiler, run_compiler, run_compilers, words_of
from impact_posture.version import __version__

_REBUILD = "delete it: it is built again"
# Fields of an ELF header after its 16 bytes of identity, and of a program header up to the length in the file.
_HEADER = {1: "HHIIIIIHHHHHH", 2: "HHIQQQIHHHHHH"}
_SEGMENT = {1: "IIIII", 2: "IIQQQQ"}


# ---- building -----------------------------------------------------------------------------------------------------

# Strict C forbids fused multiply-adds by default.
_FLAGS = ("-std=c99", "-O2", "-ffp-contract=fast", "-fPIC")


def library_path(folder: Path, prefix: str) -> Path:
    """Return ``lib<prefix>.so`` in a folder."""
    return folder / f"lib{prefix}.so"


def build_library(folder: Path, prefix: str, library: Path | None = None, flags: Sequence[str] = ()) -> Path:
    """Compile ``<prefix>.c`` in ``folder`` into a sealed shared library, and return where it is.

    Args:
        folder: The folder of the source.
        prefix: The name of the source without its ending.
        library: The library to write; ``lib<prefix>.so`` beside the source by default.
        flags: Flags of the compiler after those of strict C and of ``$CFLAGS``.

    Raises:
        CompilerError: There is no compiler, or it failed; with its first error line and the command.
        OutputError: The library cannot be written.
    """
    compiler = find_compiler()
    if compiler is None:
        raise no_compiler("codegen")
    library = (library_path(folder, prefix) if library is None else library).absolute()
    with building(library) as scratch:
        built = str(scratch / library.name)
        run_compiler(
            [*compiler, *_FLAGS, "-shared", *words_of("CFLAGS"), *flags, f"{prefix}.c", "-o", built, "-lm"], folder
        )
    return library


def build_parts(folder: Path, library: Path, parts: Mapping[str, Sequence[str]]) -> Path:
    """Compile sources at once into a sealed shared library, and return where it is.

    What other libraries have in common with this one, their preprocessed text and flags, is compiled once.

    Args:
        folder: The folder of the sources.
        library: The library to write.
        parts: Source → flags of the compiler after those of strict C and of ``$CFLAGS``.

    Raises:
        CompilerError: There is no compiler, or it failed; with its first error line and the command.
        OutputError: The library or the cache cannot be written.
    """
    compiler = find_compiler()
    if compiler is None:
        raise no_compiler("codegen")
    library = library.absolute()
    cached = cache_folder("objects")
    with building(library) as scratch:
        commands = [[*compiler, *_FLAGS, *words_of("CFLAGS"), *flags, name] for name, flags in parts.items()]
        texts = [scratch / f"{name}.i" for name in parts]
        run_compilers([[*c, "-E", "-P", "-o", str(text)] for c, text in zip(commands, texts, strict=True)], folder)
        objects = [
            cached / f"{source_key([repr(command), text.read_text(encoding='utf-8')])}.o"
            for command, text in zip(commands, texts, strict=True)
        ]
        with ExitStack() as finished:
            missing = []
            for command, part in zip(commands, objects, strict=True):
                if not is_cached(part):
                    beside = finished.enter_context(building(part)) / part.name
                    missing.append([*command, "-c", "-o", str(beside)])
            run_compilers(missing, folder)
        run_compiler([*compiler, "-shared", *map(str, objects), "-o", str(scratch / library.name), "-lm"], folder)
    return library


@contextmanager
def building(library: Path) -> Iterator[Path]:
    """Yield a folder to build in; a library of that name in it then takes its place, with its seal.

    An interruption leaves the earlier library, or the new one without a seal.

    Raises:
        OutputError: The library cannot be written, for example because the disk is full.
    """
    try:
        with scratch_folder(library.parent) as folder:
            yield folder
            if (built := folder / library.name).is_file():
                _put(built, library)
    except OSError as error:
        raise OutputError(
            f"cannot be written ({error.strerror or error})",
            where=str(library.parent),
            hint="free some space or check the permissions; IMPACT_POSTURE_CACHE names another cache",
        ) from None


def _put(built: Path, library: Path) -> None:
    seal, beside = seal_path(library), seal_path(built)
    beside.write_text(f"{_digest(built)}  {library.name}\n", encoding="utf-8")
    seal.unlink(missing_ok=True)
    os.replace(built, library)
    os.replace(beside, seal)


def seal_path(library: Path) -> Path:
    """Return where the seal of a library is; ``sha256sum --check`` reads it."""
    return library.with_name(f"{library.name}.sha256")


def is_sealed(library: Path) -> bool | None:
    """Return whether a library still has the content that was sealed; ``None`` where there is no seal."""
    try:
        words = seal_path(library).read_text(encoding="utf-8", errors="replace").split()
    except FileNotFoundError:
        return None
    return bool(words) and words[0] == _digest(library)


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


# ---- loading ------------------------------------------------------------------------------------------------------


def load_library(library: Path) -> ctypes.CDLL:
    """Load a whole library, which runs its code.

    Raises:
        SpecError: The library differs from what was sealed, or cannot be loaded.  A library without a seal is refused
            if it is shorter than its header says or is for another processor.
    """
    try:
        sealed = is_sealed(library)
        fault = "is not the library that was built here (another SHA-256)" if sealed is False else ""
        fault = fault or ("" if sealed else _fault(library))
        if not fault:
            return ctypes.CDLL(str(library.absolute()))
    except OSError as error:
        fault = f"cannot be loaded ({error.strerror or error})"
    hint = f"{_REBUILD}; if you built it yourself, delete {seal_path(library).name}" if sealed is False else _REBUILD
    raise SpecError(fault, where=str(library), hint=hint)


def _fault(library: Path) -> str:
    """Return what an ELF header says against loading; empty for other formats, because their loaders check them."""
    size = library.stat().st_size
    with library.open("rb") as file:
        start = file.read(64)
        if start[:4] != b"\x7fELF":
            return "is no shared library" if sys.platform == "linux" or not start else ""
        try:
            order = {1: "<", 2: ">"}[start[5]]
            header, segment = order + _HEADER[start[4]], order + _SEGMENT[start[4]]
            found = struct.unpack_from(header, start, 16)
            machine, segments, sections = found[1], found[4], found[5]
            segment_size, segment_count, section_size, section_count = found[8:12]
            end = max(segments + segment_size * segment_count, sections + section_size * section_count)
            for k in range(segment_count if end <= size else 0):
                file.seek(segments + k * segment_size)
                entry = struct.unpack(segment, file.read(struct.calcsize(segment)))
                offset, length = (entry[1], entry[4]) if start[4] == 1 else (entry[2], entry[5])
                end = max(end, offset + length)
        except (KeyError, IndexError, struct.error):
            return "is damaged: its header is none of a shared library"
    if end > size:
        return f"is damaged: {size} bytes, where its header speaks of {end}"
    ours = _machine()
    return f"is for another processor (ELF machine {machine}, here {ours})" if ours not in (None, machine) else ""


def _machine() -> int | None:
    """Return the ELF number of this processor; ``None`` where the interpreter is no ELF file."""
    with suppress(OSError), open(os.path.realpath(sys.executable), "rb") as file:
        start = file.read(20)
        if start[:4] == b"\x7fELF":
            return int.from_bytes(start[18:20], "little" if start[5] == 1 else "big")
    return None


# ---- the cache ----------------------------------------------------------------------------------------------------


def cache_path() -> Path:
    """Return the folder of compiled code: ``$IMPACT_POSTURE_CACHE``, else one in the user's cache folder."""
    own = os.environ.get("IMPACT_POSTURE_CACHE")
    if own:
        return Path(own).absolute()
    # The XDG specification says to ignore a relative path.
    base = Path(os.environ.get("XDG_CACHE_HOME", ""))
    try:
        return (base if base.is_absolute() else Path.home() / ".cache") / "impact-posture"
    except RuntimeError:
        raise OutputError("there is no home folder", where="cache", hint="set IMPACT_POSTURE_CACHE") from None


def cache_folder(*parts: str) -> Path:
    """Return a folder of the cache; make it for its user alone where it is missing.

    Raises:
        OutputError: The folder cannot be made, or others may write it.
    """
    folder = cache_path()
    try:
        for part in ("", *parts):
            folder = folder / part
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            check_private(folder)
    except OSError as error:
        raise OutputError(
            f"cannot be written ({error.strerror})", where=str(folder), hint="set IMPACT_POSTURE_CACHE to a folder"
        ) from None
    return folder


def source_key(content: Iterable[str], *packages: str) -> str:
    """Return a short hash of what shapes compiled code.

    Args:
        content: What the code depends on.
        packages: Packages of this library whose formulas write the code; a changed formula gives another key.
    """
    text = "\n".join([__version__, *content, *map(_formulas, packages)])
    return hashlib.sha256(text.encode()).hexdigest()[:32]


@cache
def _formulas(package: str) -> str:
    """Return a hash of the source code of a package, as it was when this process first asked."""
    digest = hashlib.sha256()
    for path in sorted((Path(__file__).parents[1] / package).glob("**/*")):
        if path.suffix in (".py", ".jinja", ".c", ".h"):
            digest.update(path.read_bytes())
    return digest.hexdigest()


def check_private(path: Path) -> None:
    """Refuse a path that another user controls, because that user chooses the code that runs.

    Raises:
        OutputError: Another user owns the path or may write it.
    """
    found = path.stat()
    if found.st_uid not in (os.geteuid(), 0):
        raise OutputError("belongs to another user", where=str(path), hint="set IMPACT_POSTURE_CACHE to a folder")
    if found.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        raise OutputError("can be written by others", where=str(path), hint=f"chmod go-w {path}, if you trust it")


def is_cached(library: Path) -> bool:
    """Return whether the cache has a library as it was built; delete a damaged one.

    Raises:
        OutputError: Others may write the library, or a folder of the cache that holds it.
    """
    root = cache_path()
    try:
        for path in (library, *library.parents):
            check_private(path)
            if path == root:
                break
        if is_sealed(library):
            return True
        library.unlink()
    except OSError:
        pass
    return False
