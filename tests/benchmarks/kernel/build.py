"""Compile a benchmark's sources once: results are kept by the hash of command and content."""

from __future__ import annotations

import ctypes
import hashlib
import json
import os
import resource
import shlex
import shutil
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path

HERE = Path(__file__).parent
# Seconds of the compiler's own processor time: another user of the machine does not count.
COMPILE_LIMIT_S = 180.0


class Absent(Exception):
    """A peer that cannot run here, and why, in one line."""


@dataclass(frozen=True)
class Built:
    """A shared library.

    Attributes:
        library: Loaded.
        path: Where it is kept.
        command: What made it.
        compile_s: Processor seconds of the compiler.
    """

    library: ctypes.CDLL
    path: Path
    command: str
    compile_s: float


def cache_folder() -> Path:
    own = os.environ.get("IMPACT_POSTURE_CACHE")
    return (Path(own) if own else Path(tempfile.gettempdir()) / "impact-posture-cache") / "kernel-times"


def find(*compilers: str) -> str:
    for name in compilers:
        if name and shutil.which(name):
            return name
    raise Absent(f"no compiler ({', '.join(c for c in compilers if c)})")


def c_compiler() -> str:
    return find(os.environ.get("CC", ""), "cc", "gcc", "clang")


def build(
    sources: dict[str, str], compiler: str, flags: list[str], after: list[str], limit_s: float = COMPILE_LIMIT_S
) -> Built:
    """Compile ``name → text`` into a shared library.

    Raises:
        Absent: It failed or took longer than ``limit_s``; both are remembered.
    """
    version = subprocess.run([compiler, "--version"], capture_output=True, text=True, check=True).stdout
    key = _hash(version, shlex.join([*flags, *after]), *[f"{n}\n{t}" for n, t in sources.items()], _cpu(flags))
    folder = cache_folder()
    folder.mkdir(parents=True, exist_ok=True)
    library, notes = folder / f"{key}.so", folder / f"{key}.json"
    names = [n for n in sources if not n.endswith((".h", ".hpp"))]
    command = [compiler, *flags, "-fPIC", "-shared", *names, *after]
    if not notes.is_file():
        found = _compile(sources, command, library, limit_s)
        beside = notes.with_suffix(f".{os.getpid()}.part")
        beside.write_text(json.dumps(found))
        os.replace(beside, notes)
    found = json.loads(notes.read_text())
    if found["failed"] and found["limit_s"] < limit_s:
        notes.unlink()
        return build(sources, compiler, flags, after, limit_s)
    if found["failed"]:
        raise Absent(found["failed"])
    return Built(ctypes.CDLL(str(library)), library, shlex.join(command), found["compile_s"])


def _compile(sources: dict[str, str], command: list[str], library: Path, limit_s: float) -> dict[str, object]:
    with tempfile.TemporaryDirectory(dir=library.parent) as name:
        folder = Path(name)
        for file, text in sources.items():
            (folder / file).write_text(text)
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        done = subprocess.run(
            [*command, "-o", "built.so"],
            cwd=folder,
            capture_output=True,
            text=True,
            check=False,
            preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_CPU, (int(limit_s), int(limit_s))),
        )
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        took = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
        failed = ""
        if done.returncode:
            lines = [line for line in done.stderr.splitlines() if "error" in line] or done.stderr.splitlines() or [""]
            over = took > 0.95 * limit_s
            failed = f"compiler stopped after {limit_s:.0f} s" if over else f"compiler failed: {lines[0][:200]}"
        else:
            os.replace(folder / "built.so", library)
    return {"failed": failed, "compile_s": took, "limit_s": limit_s}


def _cpu(flags: list[str]) -> str:
    """``-march=native`` means something else on another machine."""
    if "-march=native" not in flags:
        return ""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return ""
    return "".join(line for line in lines if line.startswith(("model name", "flags")))[:4000]


def _hash(*parts: str) -> str:
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()[:32]


def symbol(library: ctypes.CDLL, name: str) -> ctypes.c_void_p:
    """Address of a function, for the harness."""
    return ctypes.cast(getattr(library, name), ctypes.c_void_p)
