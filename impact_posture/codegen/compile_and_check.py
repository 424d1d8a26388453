"""Compile an export, and compare the results of its functions with CasADi and Pinocchio."""

from __future__ import annotations

import platform
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from impact_posture.codegen.c_literals import REALS
from impact_posture.codegen.export_library import named_objectives
from impact_posture.codegen.impact_gradient import ImpactGradient
from impact_posture.codegen.manifest_reader import read_manifest
from impact_posture.codegen.self_test import (
    RESULTS,
    Reference,
    casadi_reference,
    oracle_reference,
    sample_postures,
    self_test_tolerance,
)
from impact_posture.errors import CompilerError, OutputError
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.system.arrays import Array
from impact_posture.system.libraries import (
    build_library,
    cache_folder,
    hash_path,
    is_cached,
    library_path,
    load_library,
    source_key,
)
from impact_posture.system.scratch_folder import scratch_folder
from impact_posture.system.text_files import read_text
from impact_posture.system.toolchain import find_compiler, words_of

# Relative tolerance for the comparison with :class:`ImpactOracle`.  With supports of compliance ε, the condition
# number of the matrix in this class is about 1/ε.
_ORACLE_TOLERANCE = 1e-5
# Number of random pairs of posture and normal in a comparison.
_SAMPLES = 20
# Largest number of libraries in the cache; if there are more, the oldest are deleted.
_CACHED = 16
# Name of a gradient → name of the quantity whose gradient it is.  The error of a gradient is relative to the largest
# entry of the gradient, or to ``_SHARE`` times the quantity if this product is larger.
_LEAST = {"grad": "H", "objective_grad": "objective"}
_SHARE = 1e-3


def compile_and_check(
    export_dir: Path, prefix: str, objectives: Sequence[WorstCaseObjective], *, keep: bool = False
) -> float:
    """Build an export and compare its results at random postures and normals; return the largest relative difference.

    ``objectives`` contains one objective per frame.  If ``keep``, the library stays in the folder of the export, even
    if its results are wrong.

    Raises:
        CompilerError: No compiler is installed, the compiler failed, or the results of the compiled code are wrong.
    """
    manifest, _ = read_manifest(export_dir / f"{prefix}.json")
    real, worst = REALS[manifest["real"]], 0.0
    # A killed process cannot delete its temporary files.  Temporary files are in the folder of the export, so that
    # they are deleted together with the export.
    with scratch_folder(export_dir) as folder:
        if keep or (built := _cached_library(export_dir, prefix)) is None:
            built = build_library(export_dir, prefix, library_path(export_dir if keep else folder, prefix))
        library = load_library(built)
        for v in named_objectives(objectives, prefix):
            objective = v.objective
            # Remove ``several``, because ImpactGradient would use the objective of all contacts for each frame.
            block = manifest if v.joint else manifest | {"several": None}
            gradient = ImpactGradient(library, block, objective.contact.frame, free=v.free)
            tolerance = self_test_tolerance(objective, real)
            for reference, allowed, name in (
                (casadi_reference, tolerance, "CasADi"),
                (oracle_reference, max(_ORACLE_TOLERANCE, tolerance), "Pinocchio"),
            ):
                difference = largest_difference(gradient, objective, reference, _SAMPLES)
                if difference > allowed:
                    what = f"the compiled code differs from {name} by {difference:.3g}, relative"
                    hint = "try another compiler (set CC) without -ffast-math, or double instead of float"
                    raise CompilerError(what, where=f"{prefix}.c", hint=hint)
                worst = max(worst, difference)
    return worst


def _cached_library(export_dir: Path, prefix: str) -> Path | None:
    """Return the library of an export from the cache; build it if it is missing.

    Return ``None`` if the cache is not writable.  The cache saves time, because compiling the code of a humanoid
    takes seconds and many exports differ only in the constant posture.
    """
    source = read_text(export_dir / f"{prefix}.c")
    content = [re.sub(rf"^const \w+ {prefix}_(posture|manifest)\[.*?;$", "", source, flags=re.DOTALL | re.MULTILINE)]
    content += [platform.machine(), *(find_compiler() or ()), *words_of("CFLAGS")]
    try:
        library = cache_folder("exports") / f"{source_key(content)}.so"
        if not is_cached(library):
            build_library(export_dir, prefix, library)
        library.touch()
        for old in sorted(library.parent.glob("*.so"), key=lambda path: path.stat().st_mtime)[:-_CACHED]:
            old.unlink()
            hash_path(old).unlink(missing_ok=True)
    except (OutputError, OSError):
        return None
    return library


def largest_difference(
    gradient: ImpactGradient,
    objective: WorstCaseObjective,
    build_reference: Callable[[WorstCaseObjective], Reference],
    samples: int,
) -> float:
    """Return the largest relative difference between an export and a reference at random postures and normals.

    ``build_reference`` is :func:`~impact_posture.codegen.self_test.casadi_reference` or ``oracle_reference``.  The
    difference is infinite if a C function returns an error code.
    """
    reference = build_reference(objective)
    normals = np.random.default_rng(2).normal(size=(samples, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    worst = 0.0
    for k, q in enumerate(sample_postures(objective.robot, samples, 1)):
        # Round the inputs to the C type, so that reference and export have the same inputs.
        q, n = (np.array(v, dtype=gradient.dtype).astype(float) for v in (q, normals[k]))
        expected = reference(q, n)
        for name, quantities in RESULTS.items():
            if not set(quantities) <= set(expected):
                continue
            code, results = gradient.call(name, q, n)
            if code != 0:
                return float("inf")
            for quantity, result in zip(quantities, results, strict=True):
                least = _SHARE * abs(float(expected[_LEAST[quantity]][0])) if quantity in _LEAST else 0.0
                worst = max(worst, deviation(result, expected[quantity], least).error)
        if not objective.others:
            H, rows = gradient.value_and_gradient_batch(np.stack([q, q]), np.stack([n, n]))
            value, row = gradient.value_and_gradient(q, n)
            worst = max(worst, deviation(H[1:], np.array([value])).error)
            worst = max(worst, deviation(rows[1], row, _SHARE * abs(value)).error)
    return worst


@dataclass(frozen=True)
class Deviation:
    """Largest relative error among the entries of one quantity at one sample.

    Attributes:
        error: Largest ``|value − expected|`` divided by the scale; infinite if a value is not finite.
        index: Index of the entry with the largest error.
    """

    error: float
    index: tuple[int, ...]


def deviation(values: Array, expected: Array, scale: float = 0.0) -> Deviation:
    """Return the largest error, relative to the largest expected entry, or to ``scale`` if ``scale`` is larger."""
    with np.errstate(invalid="ignore"):
        difference = np.abs(values - expected)
    difference[~np.isfinite(difference)] = np.inf
    index = tuple(int(k) for k in np.unravel_index(int(np.argmax(difference)), difference.shape))
    largest, size = float(difference[index]), max(float(np.abs(expected).max()), scale)
    return Deviation(largest / size if 0 < size < np.inf else (np.inf if largest > 0 else 0.0), index)
