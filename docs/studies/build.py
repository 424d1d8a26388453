"""Compile sources into a shared library.  A cache stores the library under a hash of command and sources."""

from __future__ import annotations

import ctypes
import hashlib
import platform
import resource
import shlex
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from impact_posture.system.libraries import building, cache_folder, is_cached, load_library
from impact_posture.system.toolchain import run_compiler

# In strict C and C++, compilers fuse a multiplication and an addition only with this flag.
CONTRACT = "-ffp-contract=fast"
# Processor features that gcc and clang require for x86-64-v3.
_V3 = frozenset({"avx2", "bmi1", "bmi2", "f16c", "fma", "abm", "movbe"})


@dataclass(frozen=True)
class Built:
    """Loaded library, its compiler command (without header folders), and the processor time of the compiler, s."""

    library: ctypes.CDLL
    flags: str
    compile_s: float

    def symbol(self, name: str) -> ctypes.c_void_p:
        return ctypes.cast(getattr(self.library, name), ctypes.c_void_p)


def build(
    sources: Mapping[str, str], compiler: Sequence[str], flags: Sequence[str], headers: Sequence[Path] = ()
) -> Built:
    """Compile sources, a mapping of file names to texts, into a library.

    Raises:
        CompilerError: The compiler failed.
    """
    shown = shlex.join([*compiler, *flags])
    parts = [shown, compiler_version(compiler), *(processor().values() if "-march=native" in flags else ())]
    parts += [f"{name}\n{text}" for name, text in sources.items()]
    library = cache_folder("bench") / f"{hashlib.sha256(chr(0).join(parts).encode()).hexdigest()[:32]}.so"
    seconds = library.with_suffix(".seconds")
    if not is_cached(library):
        before = _compilers_time()
        with building(library) as folder:
            for name, text in sources.items():
                (folder / name).write_text(text, encoding="utf-8")
            names = [name for name in sources if not name.endswith(".h")]
            include = [word for header in headers for word in ("-isystem", str(header))]
            command = [*compiler, *flags, *include, "-fPIC", "-shared", *names, "-o", library.name, "-lm"]
            run_compiler(command, folder)
        seconds.write_text(str(_compilers_time() - before), encoding="utf-8")
    return Built(load_library(library), shown, float(seconds.read_text(encoding="utf-8")))


def _compilers_time() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def flag_sets() -> dict[str, list[str]]:
    """Return sets of compiler flags by name.  A set for AVX2 is included only if the processor supports AVX2."""
    avx2 = {"-O3 AVX2": ["-O3", "-march=x86-64-v3"]} if set(processor()["flags"].split()) >= _V3 else {}
    return {"-O2": ["-O2"], **avx2, "-O3 native": ["-O3", "-march=native"]}


def processor() -> dict[str, str]:
    """Return the name and the features of the first processor; empty if the system does not report them."""
    file = Path("/proc/cpuinfo")
    lines = file.read_text(encoding="utf-8").splitlines() if file.is_file() else []
    entries = {key.strip(): value.strip() for key, _, value in (line.partition(":") for line in reversed(lines))}
    return {"name": entries.get("model name", platform.processor()), "flags": entries.get("flags", "")}


def compiler_version(compiler: Sequence[str]) -> str:
    """Return the first line that a compiler prints about its version."""
    done = subprocess.run([*compiler, "--version"], capture_output=True, text=True, errors="replace", check=True)
    return done.stdout.splitlines()[0]
