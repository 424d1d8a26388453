"""The user's C compiler, and the proof that what it makes of an export computes the right numbers."""

from __future__ import annotations

import ctypes
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from impact_posture.codegen.manifest import sample_postures
from impact_posture.errors import CompilerError
from impact_posture.impact.objective import ImpactObjective
from impact_posture.impact.oracle import ImpactOracle
from impact_posture.toolchain import find_compiler, run_compiler

Vector = NDArray[np.float64]

FLAGS = ("-std=c99", "-O2", "-fPIC", "-shared")

# Compiled and interpreted code do the same operations in the same order: what is left is the compiler's rounding.
_CASADI_TOLERANCE = 1e-9
# The oracle factorizes another matrix; feet at compliance ε cost digits there (condition about 1/ε).
_ORACLE_TOLERANCE = 1e-5


class CompiledExport:
    """The three functions of a built export.  For checks; it allocates on every call."""

    def __init__(self, library: Path, prefix: str, nq: int, nv: int) -> None:
        self._nq, self._nv = nq, nv
        loaded = ctypes.CDLL(str(library))
        self._eval, self._objective, self._value = (
            getattr(loaded, f"{prefix}_{name}") for name in ("eval", "objective", "value")
        )
        self.library = loaded

    def eval(self, q: Vector, n: Vector) -> tuple[int, float, Vector]:
        """Code, H and its tangent gradient, shape (nv,)."""
        value, gradient = np.full(1, np.nan), np.full(self._nv, np.nan)
        code = self._eval(*(_pointer(v) for v in (self._check(q), _check3(n), value, gradient)))
        return int(code), float(value[0]), gradient

    def objective(self, q: Vector) -> tuple[int, float, Vector]:
        """Code, the objective and its tangent gradient, shape (nv,)."""
        value, gradient = np.full(1, np.nan), np.full(self._nv, np.nan)
        code = self._objective(*(_pointer(v) for v in (self._check(q), value, gradient)))
        return int(code), float(value[0]), gradient

    def value(self, q: Vector, n: Vector) -> tuple[int, float]:
        """Code and H."""
        value = np.full(1, np.nan)
        code = self._value(*(_pointer(v) for v in (self._check(q), _check3(n), value)))
        return int(code), float(value[0])

    def _check(self, q: Vector) -> Vector:
        return np.ascontiguousarray(q, dtype=float).reshape(self._nq)


def _check3(n: Vector) -> Vector:
    return np.ascontiguousarray(n, dtype=float).reshape(3)


def _pointer(values: Vector) -> object:
    return values.ctypes.data_as(ctypes.POINTER(ctypes.c_double))


@contextmanager
def compiled(
    export_dir: Path, prefix: str, nq: int, nv: int, extra_flags: tuple[str, ...] = ()
) -> Iterator[CompiledExport]:
    """Build an export as a shared library in a temporary folder and load it.

    Raises:
        CompilerError: No compiler, or it failed: its first error line and the command.
    """
    compiler = find_compiler()
    if compiler is None:
        raise CompilerError("no C compiler found", where="codegen", mend="install gcc or clang, or set CC")
    with tempfile.TemporaryDirectory(prefix="impact-posture-") as folder:
        library = Path(folder) / f"lib{prefix}.so"
        command = [*compiler, *FLAGS, *extra_flags, f"{prefix}.c", "-o", str(library), "-lm"]
        run_compiler(command, export_dir)
        yield CompiledExport(library, prefix, nq, nv)


def compile_and_check(export_dir: Path, prefix: str, objective: ImpactObjective, samples: int = 20) -> float:
    """Build an export and compare it at random postures and normals; return the largest relative difference.

    Gradients are compared relative to their largest entry, or to a thousandth of the value where that is more.

    Raises:
        CompilerError: No compiler, it failed, or what it made computes other numbers.
    """
    robot = objective.robot
    with compiled(export_dir, prefix, robot.nq, robot.nv) as library:
        from_casadi = casadi_difference(library, objective, samples)
        from_oracle = oracle_difference(library, objective, samples)
    for difference, tolerance, other in (
        (from_casadi, _CASADI_TOLERANCE, "CasADi's"),
        (from_oracle, _ORACLE_TOLERANCE, "Pinocchio's"),
    ):
        # Not "> tolerance": that is false for a NaN.
        if not difference <= tolerance:
            raise CompilerError(
                f"the compiled code differs from {other} numbers by {difference:.3g}, relative",
                where=f"{prefix}.c",
                mend="try another compiler (set CC), without -ffast-math",
            )
    return max(from_casadi, from_oracle)


def casadi_difference(library: CompiledExport, objective: ImpactObjective, samples: int) -> float:
    """Largest relative difference of all outputs from CasADi's interpreted functions."""
    metric, own = objective.metric_fun(), objective.gradient_fun()
    fixed = ca.DM(objective.contact.normal)
    worst = 0.0
    for q, n in _samples(objective, samples):
        H, gradient = (np.array(v, dtype=float).ravel() for v in metric(q, n))
        value, objective_gradient = (np.array(v, dtype=float).ravel() for v in own(q, fixed))
        worst = _worst(worst, library.eval(q, n), float(H[0]), gradient)
        worst = _worst(worst, library.objective(q), float(value[0]), objective_gradient)
        worst = _worst(worst, (*library.value(q, n), gradient), float(H[0]), gradient)
    return worst


def oracle_difference(library: CompiledExport, objective: ImpactObjective, samples: int) -> float:
    """Largest relative difference of all outputs from Pinocchio's numbers."""
    contact, worst = objective.contact, 0.0
    for q, n in _samples(objective, samples):
        turned = replace(contact, normal=(float(n[0]), float(n[1]), float(n[2])))
        oracle = ImpactOracle(objective.robot, turned, objective.metric, objective.supports, objective.compliance)
        H, gradient = oracle.quantities(q).H, oracle.gradient_H(q)
        worst = _worst(worst, library.eval(q, n), H, gradient)
        worst = _worst(worst, library.objective(q), objective.value(q), objective.gradient(q))
        worst = _worst(worst, (*library.value(q, n), gradient), H, gradient)
    return worst


def _samples(objective: ImpactObjective, count: int) -> Iterator[tuple[Vector, Vector]]:
    normals = np.random.default_rng(2).normal(size=(count, 3))
    for q, n in zip(sample_postures(objective.robot, count, 1), normals, strict=True):
        yield q, n / np.linalg.norm(n)


def _worst(so_far: float, result: tuple[int, float, Vector], value: float, gradient: Vector) -> float:
    code, found, found_gradient = result
    if code != 0:
        return float("inf")
    scale = max(float(np.abs(gradient).max(initial=0.0)), 1e-3 * abs(value))
    difference = float(np.abs(found_gradient - gradient).max(initial=0.0))
    relative = [abs(found - value) / abs(value) if found != value else 0.0]
    relative.append(difference / scale if difference else 0.0)
    # np.max keeps a NaN, which max() may drop.
    return float(np.max([so_far, *relative]))
