"""The CasADi functions that an export is made of, all of them of an objective's configuration and normal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import casadi as ca

from impact_posture.codegen.simd_lanes import Seed
from impact_posture.dynamics.chart import Chart
from impact_posture.dynamics.repeated_limbs import RepeatedLimbs
from impact_posture.impact.objective import ImpactObjective


def jump_fun(objective: ImpactObjective) -> ca.Function:
    """``(q, n) → a, G, H``: ``a = M⁻¹Jᵀn`` (nv), ``G = nᵀJa`` and ``H = aᵀWa``."""
    k = objective.kernel
    names = (["q", "n"], ["a", "G", "H"])
    return ca.Function("jump", [k.q, k.n], [k.jump.a, k.G, k.H], *names, {"cse": True})


def ellipsoid_fun(objective: ImpactObjective) -> ca.Function:
    """``q → Λ_c``, shape (3, 3), world axes."""
    k = objective.kernel
    return ca.Function("ellipsoid", [k.q], [k.ellipsoid], ["q"], ["L"], {"cse": True})


def objective_fun(objective: ImpactObjective) -> ca.Function:
    """``q → value, grad`` of the objective at its own normal."""
    q, _ = (general := objective.gradient_fun()).sx_in()
    fixed = general.call([q, ca.DM(objective.contact.normal)])
    return ca.Function("objective", [q], fixed, ["q"], ["value", "grad"], {"cse": True})


@dataclass(frozen=True)
class Exported:
    """One function of the library.

    Attributes:
        stem: Which objective it belongs to, by what its C name begins with.
        name: ``eval``, ``objective``, ``value``, ``jump`` or ``ellipsoid``.
        outputs: The outputs of :attr:`Library.function` that it gives.
    """

    stem: str
    name: str
    outputs: tuple[str, ...]


@dataclass(frozen=True)
class Library:
    """Everything that a library computes, as one function, so that what is common is there once.

    Attributes:
        function: ``(q, n, constants)`` → all outputs.
        constants: Values of the input ``constants``: what twin branches differ in.
        seeds: Input name and index → its place among twins.
        functions: What is exported.
    """

    function: ca.Function
    constants: tuple[float, ...]
    seeds: Mapping[tuple[str, int], Seed]
    functions: tuple[Exported, ...]


def library(
    objectives: Sequence[ImpactObjective], stems: Sequence[str], joint: tuple[ImpactObjective, str] | None = None
) -> Library:
    """The functions of objectives of one robot, and of one that is of several contacts at once, with its stem.

    ``objective`` is left out where it is a multiple of H, and so is what only ``V`` needs: C has it from ``H, G``.
    """
    robot = objectives[0].robot
    q, n, twins = ca.SX.sym("q", robot.nq), ca.SX.sym("n", 3), RepeatedLimbs(robot.model)
    values: list[ca.SX] = []
    names: list[str] = []
    functions: list[Exported] = []
    for number, (objective, stem) in enumerate(zip(objectives, stems, strict=True)):
        k = objective.kernel_of(q, n, twins)
        found = {"H": k.H, "grad": k.grad_H, "a": k.jump.a, "G": k.G, "L": k.ellipsoid}
        parts = {"eval": ("H", "grad"), "value": ("H",), "jump": ("a", "G", "H"), "ellipsoid": ("L",)}
        if not objective.is_multiple_of_H:
            found["value"], found["gradient"] = objective.expressions(k)
            parts["objective"] = ("value", "gradient")
        names += [f"o{number}_{name}" for name in found]
        values += found.values()
        functions += [
            Exported(stem, name, tuple(f"o{number}_{output}" for output in outputs))
            for name, outputs in parts.items()
        ]
    if joint is not None:
        objective, stem = joint
        values += objective.expressions(objective.kernel_of(q, n, twins))
        names += ["joint_value", "joint_gradient"]
        functions.append(Exported(stem, "objective", ("joint_value", "joint_gradient")))
    constants = ca.vertcat(ca.SX(0, 1), *twins.parameters)
    inputs = ["q", "n", "constants"]
    function = ca.Function("library", [q, n, constants], values, inputs, names, {"cse": True})
    return Library(function, tuple(twins.values), _seeds(robot.model, twins), tuple(functions))


def _seeds(model: object, twins: RepeatedLimbs) -> dict[tuple[str, int], Seed]:
    found = {("constants", i): Seed(group, lane, name) for i, (group, lane, name) in enumerate(twins.keys)}
    for slot in Chart(model).slots:
        place = twins.places.get(slot.index)
        if place is not None:
            for i in range(slot.q.start, slot.q.stop):
                found["q", i] = Seed(place.group, place.lane, f"{place.position}.q.{i - slot.q.start}")
    return found
