"""Compare every source of the quantities of an impact with the numbers of Pinocchio."""

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
from impact_posture.dynamics.mjcf import import_mujoco
from impact_posture.errors import InputError
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.robot.robot import Robot
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

# Largest relative errors that pass: M and J from MuJoCo; H, G, Λ_c and gradients by adjoints; and gradients by finite
# differences.
_MODEL, _VALUES, _DIFFERENCES = 1e-9, 1e-9, 1e-8
# The last two for robots on feet, because the compliance ε gives a system with the condition number 1/ε.
_ON_FEET = 1e-7, 1e-6


@dataclass(frozen=True)
class VerificationRow:
    """Comparison of a quantity of a source with Pinocchio.

    Attributes:
        source: Name of the source.
        quantity: ``H``, ``G``, ``Λ_c``, ``∇H``, ``M`` or ``J``.
        verdict: ``skipped`` if this machine lacks the source.
        error: Largest relative error over all samples; ``None`` if it is unknown or not finite.
        tolerance: Largest relative error that passes.
        sample: Number of the sample with that error, from 0.
        entry: Entry of the quantity with that error; empty for a scalar.
        note: Reason of a skip or failure.
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
    """Comparison of all sources, in their order, at samples that depend on the seed."""

    rows: tuple[VerificationRow, ...]
    samples: tuple[PostureSample, ...]
    seed: int

    @property
    def passed(self) -> bool:
        """Whether all rows passed; skipped rows do not count."""
        return all(row.verdict != "fail" for row in self.rows)

    def to_dict(self) -> dict[str, object]:
        """Return the JSON content: verdict, rows, and the samples that the rows name."""
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
    """Compare ``H``, ``G``, ``Λ_c`` and ``∇H`` from every source with the numbers of Pinocchio.

    The sources are the interpreter of CasADi, the C export if there is a compiler, finite differences of ``H`` from
    Pinocchio for ``∇H``, and MuJoCo if it is installed.  MuJoCo gives ``M`` and ``J`` of a model of the same
    ``pin.Model``.  ``H`` follows from them, and ``∇H`` from finite differences of this ``H``.

    The error of a quantity is relative to its largest entry.  ``H``, ``G`` and ``∇H`` vanish where the contact cannot
    move along the normal.  So their scale is at least a thousandth of the largest entry of ``Λ_c`` (``JM⁻¹Jᵀ`` for
    ``G``).

    Args:
        objective: Robot, contact, metric and supports.
        samples: Number of random postures and normals.  The first normal is the normal of the contact.
        seed: Seed of the samples.
        progress: Callback with (done, all) comparisons.

    Raises:
        InputError: ``samples`` is below one, or the seed is negative.
        CompilerError: The compiler failed.  The error has its output and the command.
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
    """Return the source of MuJoCo, or a row with the reason why it is missing."""
    try:
        import_mujoco()
    except InputError as error:
        return VerificationRow(MUJOCO, "", "skipped", note=f"not installed: {error.hint}")
    try:
        return MujocoSource(objective)
    except InputError as error:
        # The other sources remain.
        return VerificationRow(MUJOCO, "", "fail", note=error.line)


def _row(
    robot: Robot, name: str, quantity: str, tolerance: float, numbers: Sequence[Numbers], expected: Sequence[Numbers]
) -> VerificationRow:
    """Return the row of the worst sample of one quantity."""
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
