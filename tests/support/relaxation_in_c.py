"""The relaxation in C for tests: its compiled library, one call, and a certificate of its solutions."""

from __future__ import annotations

import ctypes
import re
import subprocess
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy.linalg
import scipy.optimize

from impact_posture.controller_export import controller_source as render
from impact_posture.controller_export import daqp_sources
from tests.support.daqp import sources_or_skip
from tests.support.relaxed_ticks import RelaxedTick

SOURCES = Path(daqp_sources.__file__).parent / "c"
SOLVED, WITHOUT_COST, INFEASIBLE, BUDGET, UNSOLVED = 1, 2, -1, -4, -8
_STRICT = ("-std=c99", "-Wall", "-Wextra", "-Wconversion", "-pedantic", "-Werror")
FORCE_UNIT = float(re.findall(r"#define IP_FORCE_UNIT (\S+)", (SOURCES / "give_way.c").read_text())[0])
_ARRAYS = ("A", "lower", "upper", "level", "H", "g", "unit")


class _Problem(ctypes.Structure):
    _fields_ = [
        *((name, ctypes.c_int) for name in ("n", "m", "levels")),
        *((name, ctypes.c_void_p) for name in _ARRAYS),
    ]


class _Report(ctypes.Structure):
    _fields_ = [("iterations", ctypes.c_int), ("violation", ctypes.c_double)]


@dataclass(frozen=True)
class Answer:
    """Return code, solution, number of iterations, largest violation of level 0, and shortest time of a call (s)."""

    code: int
    z: np.ndarray
    iterations: int
    violation: float
    seconds: float


class Relaxation:
    """Compiled relaxation with one workspace per problem size; a workspace remembers its active rows."""

    def __init__(self, folder: Path, *flags: str) -> None:
        """Compile in a folder; warnings about the project's code are errors."""
        for name, content in sources_or_skip().items():
            (folder / name).write_bytes(content)
        for name, text in render.relaxation_sources().items():
            (folder / name).write_text(text, encoding="utf-8")
        compiler = ["cc", "-O1", "-fPIC", *flags]
        subprocess.run(
            [*compiler, *_STRICT, "-isystem", str(folder), "-c", "relaxation.c"],
            cwd=folder, check=True,
        )  # fmt: skip
        subprocess.run(
            [*compiler, "-shared", "relaxation.o", *daqp_sources.SOURCES, "-o", "relaxation.so", "-lm"],
            cwd=folder, check=True,
        )  # fmt: skip
        library = ctypes.CDLL(str(folder / "relaxation.so"))
        library.relaxation_bytes.restype = ctypes.c_size_t
        self._bytes: Callable[..., int] = library.relaxation_bytes
        self._solve: Callable[..., int] = library.relaxation_solve
        self._work = dict[tuple[int, ...], np.ndarray]()

    def forget(self) -> None:
        """Delete the stored active rows, so that the next problem starts without active rows."""
        self._work.clear()

    def solve(self, tick: RelaxedTick, budget: int = 2000, repeats: int = 1) -> Answer:
        """Solve the program of a tick repeatedly, each time from the same active rows."""
        m, n = tick.A.shape
        levels = int(tick.level.max())
        values = {name: np.ascontiguousarray(getattr(tick, name), dtype=float) for name in _ARRAYS}
        # The C search scales forces as give_way.c does, but the certificate keeps the units of Python.
        values["unit"] = np.where(tick.unit == 1.0, 1.0, FORCE_UNIT * tick.unit)
        values["level"] = np.ascontiguousarray(tick.level, dtype=np.intc)
        problem = _Problem(n, m, levels, *(values[name].ctypes.data for name in _ARRAYS))
        work = self._work.setdefault((n, m, levels), np.zeros(self._bytes(n, m, levels) // 8 + 1))
        z, report, before, shortest = np.zeros(n), _Report(), work.copy(), np.inf
        arguments = [ctypes.byref(problem), ctypes.c_void_p(work.ctypes.data), budget, ctypes.c_void_p(z.ctypes.data)]
        for _ in range(repeats):
            work[:] = before
            began = time.thread_time_ns()
            code = self._solve(*arguments, ctypes.byref(report))
            shortest = min(shortest, (time.thread_time_ns() - began) / 1e9)
        return Answer(code, z, report.iterations, report.violation, shortest)


# Smallest violation that counts, relative to the norm of a row of A times the norm of z.
COUNTS = 1e-7


def violations(tick: RelaxedTick, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the signed violation of each entry of ``[z; A z]``, and the smallest violation that is significant."""
    values = np.concatenate([z, tick.A @ z])
    rows = np.vstack([np.diag(tick.unit), tick.A * tick.unit])
    size, lengths = max(1.0, float(np.max(np.abs(z) / tick.unit))), np.linalg.norm(rows, axis=1)
    # A row of zeros cannot be satisfied by any z, so its violation is ignored.
    return np.where(lengths > 0, values - np.clip(values, tick.lower, tick.upper), 0.0), COUNTS * size * lengths


def missed(tick: RelaxedTick, z: np.ndarray) -> list[float]:
    """Return the largest relative violation of each level, starting with level 0 (relative to the size of ``z``)."""
    over, counts = violations(tick, z)
    sizes = COUNTS * np.abs(over) / np.where(counts > 0, counts, np.inf)
    return [float(np.max(sizes[tick.level == k], initial=0.0)) for k in range(int(tick.level.max()) + 1)]


def stationarity(tick: RelaxedTick, z: np.ndarray) -> list[float]:
    """Return the stationarity residual of each level's sum of squares, followed by the residual of the cost.

    At the lexicographic solution, the negative gradient is a combination of the rows of higher levels.  The
    coefficients of active bounds are non-negative; equations and violated rows have coefficients of any sign.  The
    residual is relative to the terms of the gradient.  The residual of a satisfied level is 0.  This function shares
    no code with the C solver.
    """
    rows = np.vstack([np.diag(tick.unit), tick.A * tick.unit])
    lengths = np.linalg.norm(rows, axis=1)
    lengths[lengths == 0.0] = 1.0
    over, counts = violations(tick, z)
    values, levels, distances = np.concatenate([z, tick.A @ z]), int(tick.level.max()), []
    for k in range(1, levels + 2):
        here = tick.level == k
        if k <= levels and (np.abs(over) <= counts)[here].all():
            distances.append(0.0)
            continue
        if k <= levels:
            gradient, terms = rows[here].T @ over[here], float(np.abs(over[here]) @ lengths[here])
        else:
            gradient = (tick.H @ z + tick.g) * tick.unit
            terms = float(np.linalg.norm((np.abs(tick.H) @ np.abs(z) + np.abs(tick.g)) * tick.unit))
        above = tick.level < k
        fixed = above & ((tick.lower == tick.upper) | ((np.abs(over) > counts) & (tick.level > 0)))
        upper = above & ~fixed & (values >= tick.upper - counts)
        lower = above & ~fixed & (values <= tick.lower + counts)
        unit = rows / lengths[:, None]
        kept = _complement(unit[fixed])
        normals = kept @ np.vstack([unit[upper], -unit[lower]]).T
        left = kept @ -gradient
        rest = scipy.optimize.nnls(normals, left, maxiter=10_000)[1] if normals.size else np.linalg.norm(left)
        distances.append(float(rest) / max(terms, 1e-300))
    return distances


def _complement(rows: np.ndarray) -> np.ndarray:
    """Return an orthonormal basis of the space orthogonal to the rows; each basis vector is a row."""
    if not rows.size:
        return np.eye(rows.shape[1])
    return scipy.linalg.null_space(rows, rcond=1e-9).T
