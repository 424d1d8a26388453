"""Compile a benchmark's sources once; results are kept in the cache by the hash of command and content."""

from __future__ import annotations

import ctypes
import hashlib
import json
import os
import platform
import resource
import shlex
import shutil
import signal
import subprocess
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

from impact_posture.errors import CompilerError, OutputError, SpecError
from impact_posture.libraries import building, cache_folder, is_cached, load_library
from impact_posture.toolchain import find_compiler

HERE = Path(__file__).parent
# Strict C forbids fused multiply-adds unless asked; so does strict C++.
CONTRACT = "-ffp-contract=fast"


class Absent(Exception):
    """A peer that cannot run here, and why, in one line."""


@dataclass(frozen=True)
class Built:
    """A shared library.

    Attributes:
        library: Loaded.
        flags: What made it: compiler and options, without the folders of headers.
        compile_s: Processor seconds of the compiler.
    """

    library: ctypes.CDLL
    flags: str
    compile_s: float

    def symbol(self, name: str) -> ctypes.c_void_p:
        """Address of a function, for the harness."""
        return ctypes.cast(getattr(self.library, name), ctypes.c_void_p)


@dataclass(frozen=True)
class Skipped:
    """What is not in the table, and why."""

    name: str
    reason: str


@dataclass(frozen=True)
class _Outcome:
    """Of a compiler: its processor seconds, and where it was stopped the limit."""

    compile_s: float
    stopped_after_s: float = 0.0


@dataclass
class Workbench:
    """Builds for one robot, with what there is to say about them.

    Attributes:
        patience_s: Processor seconds that a compiler may take: another user of the machine does not count.
        say: Called with what is being done.
        skipped: Rows that are not there.
        notes: Remarks.
    """

    patience_s: float = 240.0
    say: Callable[[str], None] = lambda _: None
    skipped: list[Skipped] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def skip(self, name: str, reason: object) -> None:
        """Leave a row out."""
        self.skipped.append(Skipped(name, " ".join(str(reason).split())))

    def build(
        self,
        what: str,
        sources: Mapping[str, str],
        compiler: Sequence[str],
        flags: Sequence[str],
        after: Sequence[str] = ("-lm",),
    ) -> Built:
        """Compile ``name → text`` into a shared library.

        Raises:
            Absent: It failed, or took longer than the patience, which is remembered.
        """
        try:
            folder = cache_folder("bench")
        except OutputError as error:
            raise Absent(f"no cache folder: {error.line}") from None
        key = _hash(_version(compiler), shlex.join([*compiler, *flags, *after]), _cpu(flags), *_named(sources))
        library, notes = folder / f"{key}.so", folder / f"{key}.json"
        found = _read(notes)
        if found is None or not (is_cached(library) or found.stopped_after_s >= self.patience_s):
            self.say(f"compiling {what} (kept for the next run)")
            found = _compile(sources, [*compiler, *flags], after, library, self.patience_s)
            beside = notes.with_suffix(f".{os.getpid()}.part")
            beside.write_text(json.dumps(asdict(found)))
            os.replace(beside, notes)
        if found.stopped_after_s:
            raise Absent(f"the compiler was stopped after {found.stopped_after_s:.0f} s; see --patience")
        try:
            loaded = load_library(library)
        except SpecError as error:
            raise Absent(f"what was built: {error.what}") from None
        return Built(loaded, shlex.join([*compiler, *_shown(flags)]), found.compile_s)


def c_compiler() -> list[str]:
    """The user's C compiler.

    Raises:
        CompilerError: There is none.
    """
    found = find_compiler()
    if found is None:
        raise CompilerError("no C compiler found", where="bench", hint="install gcc or clang, or set CC")
    return found


def cxx_compiler() -> list[str]:
    """``$CXX``, g++, clang++ or c++.

    Raises:
        Absent: There is none.
    """
    for text in (os.environ.get("CXX", ""), "g++", "clang++", "c++"):
        words = shlex.split(text)
        if words and shutil.which(words[0]):
            return words
    raise Absent("no C++ compiler (install g++ or clang++, or set CXX)")


def processor() -> dict[str, str]:
    """Name, and the instructions that it has, of the first processor; empty where the system does not say."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    pairs = [line.partition(":") for line in lines]
    found = {key.strip(): value.strip() for key, _, value in reversed(pairs)}
    return {"name": found.get("model name", platform.processor()), "flags": found.get("flags", "")}


def _version(compiler: Sequence[str]) -> str:
    try:
        done = subprocess.run([*compiler, "--version"], capture_output=True, text=True, errors="replace", check=False)
    except OSError as error:
        raise Absent(f"{compiler[0]}: {error.strerror}") from None
    return done.stdout


def compiler_version(compiler: Sequence[str]) -> str:
    """The first line of what a compiler says of itself."""
    return (_version(compiler).splitlines() or [compiler[0]])[0]


def _read(notes: Path) -> _Outcome | None:
    try:
        return _Outcome(**json.loads(notes.read_text()))
    except (OSError, ValueError, TypeError):
        return None


def _compile(
    sources: Mapping[str, str], command: Sequence[str], after: Sequence[str], library: Path, patience_s: float
) -> _Outcome:
    names = [n for n in sources if not n.endswith((".h", ".hpp"))]
    limit = max(1, int(patience_s))
    with building(library) as folder:
        for file, text in sources.items():
            (folder / file).write_text(text)
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        done = subprocess.run(
            [*command, "-fPIC", "-shared", *names, "-o", library.name, *after],
            cwd=folder,
            capture_output=True,
            text=True,
            errors="replace",
            check=False,
            preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_CPU, (limit, limit)),
        )
        used = resource.getrusage(resource.RUSAGE_CHILDREN)
        took = used.ru_utime + used.ru_stime - before.ru_utime - before.ru_stime
        # The system counts by ticks and rounds: one who was stopped may be charged less than the limit.
        stopped = done.returncode in (-signal.SIGKILL, -signal.SIGXCPU) or "Killed" in done.stderr
        if done.returncode and (took > 0.95 * limit or (stopped and took > 0.5 * limit)):
            return _Outcome(took, patience_s)
        if done.returncode:
            lines = [line for line in done.stderr.splitlines() if "error" in line] or done.stderr.splitlines() or [""]
            raise Absent(f"the compiler failed: {lines[0][:200]}")
    return _Outcome(took)


def _shown(flags: Sequence[str]) -> list[str]:
    pairs = zip(["", *flags], flags, strict=False)
    return [flag for before, flag in pairs if "-isystem" not in (before, flag)]


def _named(sources: Mapping[str, str]) -> list[str]:
    return [f"{name}\n{text}" for name, text in sources.items()]


def _cpu(flags: Sequence[str]) -> str:
    """``-march=native`` means something else on another machine."""
    found = processor()
    return f"{found['name']} {found['flags']}" if "-march=native" in flags else ""


def _hash(*parts: str) -> str:
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()[:32]
