"""The user's C compiler, and the proof that what it makes of an export computes the right numbers."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from impact_posture.codegen.emitter import DOUBLE, Real
from impact_posture.codegen.functions import ellipsoid_fun, jump_fun, objective_fun
from impact_posture.codegen.library import build_library, library_path
from impact_posture.codegen.manifest import sample_postures
from impact_posture.codegen.naming import FUNCTIONS
from impact_posture.codegen.variants import Variant, variants
from impact_posture.errors import CompilerError
from impact_posture.impact.contact import heavy_feet_rounding
from impact_posture.impact.objective import ImpactObjective
from impact_posture.impact.oracle import ImpactOracle
from impact_posture.libraries import load_library
from impact_posture.output_folder import scratch_folder

Vector = NDArray[np.float64]

# The oracle factorizes another matrix; feet at compliance ε cost digits there (condition about 1/ε).
_ORACLE_TOLERANCE = 1e-5


def self_test_tolerance(objective: ImpactObjective, real: Real) -> float:
    """Largest relative difference from CasADi's numbers that is put down to rounding.

    Divisions are by reciprocals, sums may be fused with products.  In float the model's own condition shows.
    """
    if real.name == "double":
        return 1e-9 * (heavy_feet_rounding(objective.robot, objective.compliance) if objective.supports else 1.0)
    return 0.05 if objective.supports else 2e-3


class CompiledExport:
    """The functions of one frame of a built export, with their codes.  For checks; it allocates on every call."""

    def __init__(
        self,
        library: Path | ctypes.CDLL,
        stem: str,
        nq: int,
        nv: int,
        real: Real = DOUBLE,
        names: Sequence[str] = FUNCTIONS,
    ) -> None:
        self._nq, self._nv, self._real = nq, nv, real.dtype
        self.library = load_library(library) if isinstance(library, Path) else library
        self.real = real
        self._functions = {name: getattr(self.library, f"{stem}_{name}") for name in names}

    def at(self, stem: str) -> CompiledExport:
        """The same library's functions of another frame."""
        return CompiledExport(self.library, stem, self._nq, self._nv, self.real)

    def eval(self, q: Vector, n: Vector) -> tuple[int, float, Vector]:
        """Code, H and its tangent gradient, shape (nv,)."""
        value, gradient = self._empty(1), self._empty(self._nv)
        code = self._call("eval", self._input(q), self._input(n), value, gradient)
        return code, float(value[0]), gradient

    def objective(self, q: Vector) -> tuple[int, float, Vector]:
        """Code, the objective and its tangent gradient, shape (nv,)."""
        value, gradient = self._empty(1), self._empty(self._nv)
        code = self._call("objective", self._input(q), value, gradient)
        return code, float(value[0]), gradient

    def value(self, q: Vector, n: Vector) -> tuple[int, float]:
        """Code and H."""
        value = self._empty(1)
        code = self._call("value", self._input(q), self._input(n), value)
        return code, float(value[0])

    def jump(self, q: Vector, n: Vector) -> tuple[int, Vector, float, float]:
        """Code, a, shape (nv,), G and V."""
        jump, G, V = self._empty(self._nv), self._empty(1), self._empty(1)
        code = self._call("jump", self._input(q), self._input(n), jump, G, V)
        return code, jump, float(G[0]), float(V[0])

    def ellipsoid(self, q: Vector) -> tuple[int, Vector]:
        """Code and Λ_c, shape (3, 3)."""
        found = self._empty(9)
        return self._call("ellipsoid", self._input(q), found), found.reshape(3, 3)

    def eval_batch(self, q: Vector, n: Vector) -> tuple[int, Vector, Vector]:
        """Code, H, shape (N,), and gradients, shape (N, nv), of configurations, shape (N, nq)."""
        count = len(q)
        H, gradients = self._empty(count), self._empty(count * self._nv)
        code = self._call("eval_batch", self._input(q), self._input(n), count, H, gradients)
        return code, H, gradients.reshape(count, self._nv)

    def _call(self, name: str, *arguments: Any) -> int:
        return int(
            self._functions[name](
                *[a if isinstance(a, int) else a.ctypes.data_as(ctypes.c_void_p) for a in arguments]
            )
        )

    def _input(self, values: Vector) -> NDArray[Any]:
        return np.ascontiguousarray(values, dtype=self._real)

    def _empty(self, size: int) -> NDArray[Any]:
        return np.full(size, np.nan, dtype=self._real)


@contextmanager
def compiled(
    export_dir: Path, prefix: str, nq: int, nv: int, extra_flags: tuple[str, ...] = (), real: Real = DOUBLE
) -> Iterator[CompiledExport]:
    """Build an export of one frame as a shared library in a temporary folder and load it.

    Raises:
        CompilerError: No compiler, or it failed: its first error line and the command.
    """
    with scratch_folder() as folder:
        library = build_library(export_dir, prefix, library_path(folder, prefix), extra_flags)
        yield CompiledExport(library, prefix, nq, nv, real)


def compile_and_check(
    export_dir: Path,
    prefix: str,
    objective: ImpactObjective | Sequence[ImpactObjective],
    samples: int = 20,
    *,
    real: Real = DOUBLE,
    keep: bool = False,
) -> float:
    """Build an export and compare it at random postures and normals; return the largest relative difference.

    Gradients are compared relative to their largest entry, or to a thousandth of the value where that is more.

    Args:
        export_dir: The export's folder.
        prefix: Its prefix.
        objective: What it is an export of: one, or one for each frame.
        samples: Postures.
        real: The C type that it computes in.
        keep: Leave the library in the export's folder, also one that did not pass.

    Raises:
        CompilerError: No compiler, it failed, or what it made computes other numbers.
    """
    objectives = (objective,) if isinstance(objective, ImpactObjective) else tuple(objective)
    worst = 0.0
    with scratch_folder() as folder:
        target = library_path(export_dir if keep else folder, prefix)
        loaded = load_library(build_library(export_dir, prefix, target))
        for variant in variants(objectives, prefix):
            one = variant.objective
            if variant.joint:
                worst = max(worst, _checked(_joint_difference(loaded, variant, real, samples),
                                            _oracle_tolerance(one, real), "Pinocchio's", prefix))  # fmt: skip
                continue
            functions = CompiledExport(loaded, variant.stem, one.robot.nq, one.robot.nv, real)
            for found, tolerance, other in (
                (casadi_difference(functions, one, samples), self_test_tolerance(one, real), "CasADi's"),
                (oracle_difference(functions, one, samples), _oracle_tolerance(one, real), "Pinocchio's"),
            ):
                worst = max(worst, _checked(found, tolerance, other, prefix))
    return worst


def _oracle_tolerance(objective: ImpactObjective, real: Real) -> float:
    return max(_ORACLE_TOLERANCE, self_test_tolerance(objective, real))


def _checked(difference: float, tolerance: float, other: str, prefix: str) -> float:
    # Not "> tolerance": that is false for a NaN.
    if not difference <= tolerance:
        raise CompilerError(
            f"the compiled code differs from {other} numbers by {difference:.3g}, relative",
            where=f"{prefix}.c",
            hint="try another compiler (set CC) without -ffast-math, or double instead of float",
        )
    return difference


def casadi_difference(library: CompiledExport, objective: ImpactObjective, samples: int) -> float:
    """Largest relative difference of all outputs from CasADi's interpreted functions."""
    metric, own = objective.metric_fun(), objective_fun(objective)
    jumps, ellipsoids = jump_fun(objective), ellipsoid_fun(objective)
    worst = 0.0
    for q, n in _samples(objective, samples, library.real):
        H, gradient = (np.array(v, dtype=float).ravel() for v in metric(q, n))
        value, objective_gradient = (np.array(v, dtype=float).ravel() for v in own(q))
        jump, G = (np.array(v, dtype=float).ravel() for v in jumps(q, n)[:2])
        worst = _worst(worst, library.eval(q, n), float(H[0]), gradient)
        worst = _worst(worst, library.objective(q), float(value[0]), objective_gradient)
        worst = _worst(worst, (*library.value(q, n), gradient), float(H[0]), gradient)
        worst = _others(worst, library, (q, n), (jump, float(G[0]), float(H[0]), np.array(ellipsoids(q))))
    return worst


def oracle_difference(library: CompiledExport, objective: ImpactObjective, samples: int) -> float:
    """Largest relative difference of all outputs from Pinocchio's numbers."""
    contact, worst = objective.contact, 0.0
    for q, n in _samples(objective, samples, library.real):
        turned = replace(contact, normal=(float(n[0]), float(n[1]), float(n[2])))
        oracle = ImpactOracle(replace(objective.case, contact=turned))
        found, gradient = oracle.quantities(q), oracle.gradient_H(q)
        worst = _worst(worst, library.eval(q, n), found.H, gradient)
        worst = _worst(worst, library.objective(q), objective.value(q), objective.gradient(q))
        worst = _worst(worst, (*library.value(q, n), gradient), found.H, gradient)
        worst = _others(worst, library, (q, n), (found.jump, found.G, found.H, found.ellipsoid))
    return worst


def _joint_difference(library: ctypes.CDLL, variant: Variant, real: Real, samples: int) -> float:
    """Largest relative difference of the objective of several contacts from CasADi's and Pinocchio's numbers."""
    objective, worst = variant.objective, 0.0
    functions = CompiledExport(library, variant.stem, objective.robot.nq, objective.robot.nv, real, ("objective",))
    own = objective_fun(objective)
    for q, _ in _samples(objective, samples, real):
        value, gradient = (np.array(v, dtype=float).ravel() for v in own(q))
        worst = _worst(worst, functions.objective(q), float(value[0]), gradient)
        worst = _worst(worst, functions.objective(q), objective.value(q), objective.gradient(q))
    return worst


def _others(
    so_far: float,
    library: CompiledExport,
    at: tuple[Vector, Vector],
    expected: tuple[Vector, float, float, Vector],
) -> float:
    """Jump, G, V and ellipsoid, and a batch against single calls."""
    (q, n), (a, G, H, ellipsoid) = at, expected
    code, jump, found_G, found_V = library.jump(q, n)
    so_far = _worst(so_far, (code, found_G, jump), G, a)
    so_far = _worst(so_far, (code, found_V, jump), H / G**2, jump)
    code, found_ellipsoid = library.ellipsoid(q)
    so_far = _worst(so_far, (code, 0.0, found_ellipsoid), 0.0, ellipsoid)
    single, twice = library.eval(q, n), library.eval_batch(np.stack([q, q]), np.stack([n, n]))
    return _worst(so_far, (twice[0], twice[1][1], twice[2][1]), single[1], single[2])


def _samples(objective: ImpactObjective, count: int, real: Real) -> Iterator[tuple[Vector, Vector]]:
    """Postures and unit normals, of the C type so that handing them over changes nothing."""
    normals = np.random.default_rng(2).normal(size=(count, 3))
    for q, n in zip(sample_postures(objective.robot, count, 1), normals, strict=True):
        yield real.rounded(q), real.rounded(n / np.linalg.norm(n))


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
