"""Tools that a machine may lack, such as compilers.  A test that needs a missing tool is skipped."""

from __future__ import annotations

import os
import resource
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from impact_posture.system.toolchain import find_compiler, words_of

# The generated C must compile without these warnings.
STRICT = ("-Wall", "-Wextra", "-pedantic", "-Werror")


def need_compiler() -> list[str]:
    compiler = find_compiler()
    if compiler is None:
        pytest.skip("no C compiler (cc, gcc, clang)")
    return compiler


def need(tool: str) -> str:
    path = shutil.which(tool)
    if path is None:
        pytest.skip(f"no {tool}")
    return path


def files_of(size: int) -> Callable[[], None]:
    """Return a function after which no file of this process grows beyond a size, as on a full disk."""

    def limit() -> None:
        # Python 3.11 would leave truncated bytecode, with which later imports fail.
        sys.dont_write_bytecode = True
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))

    return limit


def cxx_compiler() -> list[str] | None:
    """Return the compiler ``$CXX``, g++, clang++ or c++, or ``None`` if there is no compiler."""
    candidates = (words_of("CXX"), ["g++"], ["clang++"], ["c++"])
    return next((words for words in candidates if words and shutil.which(words[0])), None)


def eigen_headers() -> Path | None:
    """Return the Eigen headers of ``$EIGEN3_INCLUDE_DIR``, the wheel cmeel-eigen, the system, or CasADi."""
    installed = [Path(folder) for folder in sys.path]
    folders = [folder / "cmeel.prefix" / "include" for folder in installed]
    folders += [
        Path("/usr/include"),
        Path("/usr/local/include"),
        *[folder / "casadi" / "include" for folder in installed],
    ]
    candidates = [Path(os.environ.get("EIGEN3_INCLUDE_DIR") or "/nonexistent"), *[f / "eigen3" for f in folders]]
    return next((folder for folder in candidates if (folder / "Eigen" / "Cholesky").is_file()), None)
