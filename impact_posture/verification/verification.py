"""Compare the quantities of an impact from every source with the reference values from Pinocchio."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from functools import partial
from typing import Literal

import numpy as np

from impact_posture.codegen.compile_and_check import Deviation, deviation
from impact_posture.config.checked import checked
from impact_posture.config.demand import OneOrMore, ZeroOrMore
from impact_posture.errors import InputError
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.robot.robot import Robot
from impact_posture.system.optional_package import import_mujoco
from impact_posture.system.toolchain import GET_ONE, find_compiler
from impact_posture.verification.quantity_sources import (
    MujocoSource,
    Numbers,
    PostureSample,
    Source,
    casadi_source,
    compiled_source,
    pinocchio_differences,
    pinocchio_numbers,
    random_samples,
)

Verdict = Literal["pass", "fail", "skipped"]

REFERENCE = "Pinocchio"
CASADI, COMPILED, DIFFERENCES, MUJOCO = "CasADi", "compiled C", "finite differences", "MuJoCo"
NO_COMPILER = f"no C compiler: {GET_ONE}"

# Largest relative errors that pass.  ``_MODEL`` is for M and J.  ``_VALUES`` is for H, G, Λ_c and analytic gradients.
# ``_DIFFERENCES`` is for finite differences.
_MODEL, _VALUES, _DIFFERENCES = 1e-9, 1e-9, 1e-8
# Replacements of ``_VALUES`` and ``_DIFFERENCES`` for standing robots.  The errors are larger, because the condition
# number of the linear system is about 1/ε, where ε is the compliance of the supports.
_ON_FEET = 1e-7, 1e-6


@dataclass(frozen=True)
class VerificationRow:
    """Comparison of one quantity from one source with the value from Pinocchio.

    Attributes:
        source: ``CasADi``, ``compiled C``, ``finite differences`` or ``MuJoCo``.
        quantity: Name of the quantity: ``H``, ``G``, ``Λ_c``, ``∇H``, ``M`` or ``J``; empty if the whole source is
            skipped or fails.
        verdict: ``pass``, ``fail``, or ``skipped`` if the source is not available on this machine.
        error: Largest relative error over all samples; ``None`` if it is not finite or was not computed.
        tolerance: Largest relative error that passes; ``None`` if nothing was compared.
        sample: Number of the sample with the largest error, starting at 0; ``None`` if nothing was compared.
        entry: Entry of the quantity with the largest error; empty for a scalar.
        note: Reason why the source is skipped or fails.
    """

    source: str
    quantity: str
    verdict: Verdict
    error: float | None = None
    tolerance: float | None = None
    sample: int | None = None
    entry: str = ""
    note: str = ""


@dataclass(frozen=True, eq=False)
class VerificationReport:
    """Comparison of all sources with Pinocchio.

    Attributes:
        rows: One row for each source and quantity, sorted by source.
        samples: Random samples at which the sources were compared.
        seed: Seed of the samples.
    """

    rows: tuple[VerificationRow, ...]
    samples: tuple[PostureSample, ...]
    seed: int

    @property
    def passed(self) -> bool:
        """True if no row fails.  Skipped rows are ignored."""
        return all(row.verdict != "fail" for row in self.rows)

    def to_dict(self) -> dict[str, object]:
        """Return the JSON content: verdict, rows, and the samples with the largest errors."""
        named = sorted({row.sample for row in self.rows if row.sample is not None})
        return {
            "passed": self.passed,
            "reference": REFERENCE,
            "seed": self.seed,
            "count": len(self.samples),
            "rows": [asdict(row) for row in self.rows],
            "samples": [
                {"sample": k, "q": self.samples[k].q.tolist(), "normal": self.samples[k].normal.tolist()}
                for k in named
            ],
        }


@checked
def verify(
    objective: WorstCaseObjective,
    samples: OneOrMore = 10,
    seed: ZeroOrMore = 0,
    progress: Callable[[int, int], None] | None = None,
) -> VerificationReport:
    """Compare ``H``, ``G``, ``Λ_c`` and ``∇H`` from four sources with the reference values from Pinocchio.

    The sources are the CasADi interpreter, the C export if there is a compiler, finite differences, and MuJoCo if it
    is installed.  The finite differences approximate ``∇H`` from the ``H`` of Pinocchio.  MuJoCo computes ``M`` and
    ``J`` with a MuJoCo model that is built from the same ``pin.Model``.  From ``M`` and ``J``, this function computes
    ``H``, and ``∇H`` by finite differences.

    The error of a quantity is relative to its largest entry.  ``H``, ``G`` and ``∇H`` are zero if the contact cannot
    move along the normal.  Therefore, the denominator of the errors of ``H`` and ``∇H`` is at least a thousandth of
    the largest entry of ``Λ_c``.  The denominator of the error of ``G`` is at least a thousandth of the largest entry
    of ``JM⁻¹Jᵀ``.

    Args:
        objective: Objective with the robot, contact, metric and supports.
        samples: Number of random postures and normals.  The first normal is the normal of the contact.
        seed: Seed of the samples.
        progress: Callback with the number of finished comparisons and the number of all comparisons.

    Raises:
        InputError: ``samples`` is smaller than one, or the seed is negative.
        CompilerError: The compiler failed.  The error contains the command and its output.
    """
    drawn = random_samples(objective.robot, samples, seed, np.array(objective.contact.normal))
    expected = [pinocchio_numbers(objective, sample) for sample in drawn]
    allowed, by_differences = _ON_FEET if objective.supports else (_VALUES, _DIFFERENCES)
    values = dict.fromkeys(("H", "G", "Λ_c", "∇H"), allowed)
    tolerances = {CASADI: values, COMPILED: values, DIFFERENCES: {"∇H": by_differences},
                  MUJOCO: {"M": _MODEL, "J": _MODEL, **values, "∇H": by_differences}}  # fmt: skip
    with ExitStack() as stack:
        compiled: Source | VerificationRow = VerificationRow(COMPILED, "", "skipped", note=NO_COMPILER)
        if find_compiler() is not None:
            compiled = stack.enter_context(compiled_source(objective))
        sources: dict[str, Source | VerificationRow] = {
            CASADI: casadi_source(objective),
            COMPILED: compiled,
            DIFFERENCES: partial(pinocchio_differences, objective),
            MUJOCO: _mujoco(objective),
        }
        compared, total = 0, sum(not isinstance(source, VerificationRow) for source in sources.values()) * len(drawn)
        rows: list[VerificationRow] = []
        for name, source in sources.items():
            if isinstance(source, VerificationRow):
                rows.append(source)
                continue
            numbers: list[Numbers] = []
            for sample in drawn:
                numbers.append(source(sample))
                compared += 1
                if progress is not None:
                    progress(compared, total)
            for quantity, tolerance in tolerances[name].items():
                rows.append(_row(objective.robot, name, quantity, tolerance, numbers, expected))
    return VerificationReport(tuple(rows), drawn, seed)


def _mujoco(objective: WorstCaseObjective) -> Source | VerificationRow:
    try:
        import_mujoco()
    except InputError as error:
        return VerificationRow(MUJOCO, "", "skipped", note=f"not installed: {error.hint}")
    try:
        return MujocoSource(objective)
    except InputError as error:
        # Report the failure as a row, so that the other sources are still compared.
        return VerificationRow(MUJOCO, "", "fail", note=error.line)


def _row(
    robot: Robot, name: str, quantity: str, tolerance: float, numbers: Sequence[Numbers], expected: Sequence[Numbers]
) -> VerificationRow:
    """Compare one quantity at all samples.  Return the row for the sample with the largest error."""
    deviations = [
        deviation(actual.values[quantity], reference.values[quantity], reference.scales.get(quantity, 0.0))
        for actual, reference in zip(numbers, expected, strict=True)
    ]
    worst = max(range(len(deviations)), key=lambda k: deviations[k].error)
    largest = deviations[worst]
    finite = bool(np.isfinite(largest.error))
    return VerificationRow(
        source=name,
        quantity=quantity,
        verdict="pass" if finite and largest.error <= tolerance else "fail",
        tolerance=tolerance,
        error=largest.error if finite else None,
        sample=worst,
        entry=_entry(robot, quantity, largest),
        note="" if finite else "not finite",
    )


def _entry(robot: Robot, quantity: str, largest: Deviation) -> str:
    names, axes, index = robot.tangent_names, "xyz", largest.index
    if quantity == "∇H":
        return names[index[0]]
    if quantity == "Λ_c":
        return "".join(axes[k] for k in index)
    if quantity == "M":
        return ", ".join(dict.fromkeys(names[k] for k in index))
    if quantity == "J":
        return f"{axes[index[0]]}, {names[index[1]]}"
    return ""
