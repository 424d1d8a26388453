"""Compare every way of computing an impact with Pinocchio's numbers."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass

import numpy as np

from impact_posture.dynamics.mjcf import import_mujoco
from impact_posture.errors import InputError
from impact_posture.impact.objective import ImpactObjective
from impact_posture.robot.robot import Robot
from impact_posture.toolchain import find_compiler
from impact_posture.verification.samples import random_samples
from impact_posture.verification.sources import (
    MujocoSource,
    Numbers,
    Source,
    casadi_source,
    compiled_source,
    pinocchio_differences,
    pinocchio_numbers,
)
from impact_posture.verification.verification_report import Deviation, Row, VerificationReport, deviation

CASADI, COMPILED, DIFFERENCES, MUJOCO = "CasADi", "compiled C", "finite differences", "MuJoCo"
NO_COMPILER = "no C compiler: install gcc or clang, or set CC"


@dataclass(frozen=True)
class Tolerances:
    """Largest relative errors that pass.

    Attributes:
        model: Of MuJoCo's ``M`` and ``J``: the same rigid bodies, no system solved.
        values: Of ``H``, ``G``, ``Λ_c``, and of gradients by adjoints.
        differences: Of gradients by finite differences.
    """

    model: float = 1e-9
    values: float = 1e-9
    differences: float = 1e-8

    @staticmethod
    def of(objective: ImpactObjective) -> Tolerances:
        """The tolerances in force: heavy feet at compliance ε make a system of condition 1/ε, which costs digits."""
        return Tolerances(values=1e-7, differences=1e-6) if objective.supports else Tolerances()


def verify(
    objective: ImpactObjective,
    samples: int = 10,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> VerificationReport:
    """Compare ``H``, ``G``, ``Λ_c`` and ``∇H`` from every way there is with Pinocchio's numbers.

    The ways: CasADi's interpreter; the compiled C export, where a compiler is there; ``∇H`` by finite differences of
    Pinocchio's ``H``; MuJoCo's ``M`` and ``J`` of a model written out of the same ``pin.Model``, where it is
    installed, and ``∇H`` by finite differences of the ``H`` that follows from them.

    A quantity's error is relative to its largest entry; ``H``, ``G`` and ``∇H``, which vanish where the contact
    cannot move along the normal, at least to a thousandth of the largest entry of ``Λ_c`` (``G``: of ``JM⁻¹Jᵀ``).

    Args:
        objective: Robot, contact, metric and supports.
        samples: How many random postures and normals; the first normal is the contact's.
        seed: Of the samples.
        progress: Called with comparisons done and comparisons in all.

    Raises:
        InputError: No sample, or a negative seed.
        CompilerError: There is a compiler and it failed: its words and the command.
    """
    if samples < 1:
        raise InputError(f"asked for {samples}", where="--samples", hint="give one or more")
    if seed < 0:
        raise InputError(f"the seed is {seed}", where="--seed", hint="give zero or more")
    drawn = random_samples(objective.robot, samples, seed, np.array(objective.contact.normal))
    expected = [pinocchio_numbers(objective, sample) for sample in drawn]
    allowed = Tolerances.of(objective)
    values = dict.fromkeys(("H", "G", "Λ_c", "∇H"), allowed.values)
    of_mujoco = {"M": allowed.model, "J": allowed.model} | values | {"∇H": allowed.differences}
    with ExitStack() as stack:
        ways: list[_Way] = [_Way(CASADI, values, casadi_source(objective))]
        if find_compiler() is None:
            ways.append(_Way(COMPILED, values, note=NO_COMPILER))
        else:
            ways.append(_Way(COMPILED, values, stack.enter_context(compiled_source(objective))))
        ways.append(
            _Way(DIFFERENCES, {"∇H": allowed.differences}, lambda sample: pinocchio_differences(objective, sample))
        )
        ways.append(_mujoco(objective, of_mujoco))
        compared, total = 0, sum(way.source is not None for way in ways) * len(drawn)
        rows: list[Row] = []
        for way in ways:
            if way.source is None:
                rows.append(Row(way.name, "", "fail" if way.failed else "skipped", note=way.note))
                continue
            found: list[Numbers] = []
            for sample in drawn:
                found.append(way.source(sample))
                compared += 1
                if progress is not None:
                    progress(compared, total)
            rows += [
                _row(objective.robot, way.name, quantity, tolerance, found, expected)
                for quantity, tolerance in way.tolerances.items()
            ]
    return VerificationReport(tuple(rows), drawn, seed)


@dataclass(frozen=True, eq=False)
class _Way:
    """A source with its tolerances by quantity; without a source, why there is none."""

    name: str
    tolerances: Mapping[str, float]
    source: Source | None = None
    note: str = ""
    failed: bool = False


def _mujoco(objective: ImpactObjective, tolerances: Mapping[str, float]) -> _Way:
    try:
        import_mujoco()
    except InputError as error:
        return _Way(MUJOCO, tolerances, note=f"not installed: {error.hint}")
    try:
        return _Way(MUJOCO, tolerances, MujocoSource(objective))
    except InputError as error:
        # The other ways stand all the same.
        return _Way(MUJOCO, tolerances, note=error.line, failed=True)


def _row(
    robot: Robot, name: str, quantity: str, tolerance: float, found: Sequence[Numbers], expected: Sequence[Numbers]
) -> Row:
    """The worst sample of one quantity."""
    deviations = [
        deviation(mine.values[quantity], reference.values[quantity], reference.scales.get(quantity, 0.0))
        for mine, reference in zip(found, expected, strict=True)
    ]
    worst = max(range(len(deviations)), key=lambda k: deviations[k].error)
    largest = deviations[worst]
    finite = bool(np.isfinite(largest.error))
    return Row(
        source=name,
        quantity=quantity,
        verdict="pass" if finite and largest.error <= tolerance else "fail",
        tolerance=tolerance,
        error=largest.error if finite else None,
        sample=worst,
        entry=_entry(robot, quantity, largest),
        note="" if finite else "not finite",
    )


def _entry(robot: Robot, quantity: str, found: Deviation) -> str:
    names, axes = robot.tangent_names, "xyz"
    if quantity == "∇H":
        return names[found.index[0]]
    if quantity == "Λ_c":
        return "".join(axes[k] for k in found.index)
    if quantity == "M":
        return ", ".join(dict.fromkeys(names[k] for k in found.index))
    if quantity == "J":
        return f"{axes[found.index[0]]}, {names[found.index[1]]}"
    return ""
