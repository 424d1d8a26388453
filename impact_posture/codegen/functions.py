"""The CasADi functions that an export is made of, all of them of an objective's configuration and normal."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from impact_posture.codegen.graph import Graph, graph_of
from impact_posture.codegen.simd_lanes import Seed, packed
from impact_posture.dynamics.chart import Chart
from impact_posture.dynamics.repeated_limbs import RepeatedLimbs
from impact_posture.impact.objective import ImpactObjective
from impact_posture.impact.oracle import ImpactOracle

Vector = NDArray[np.float64]
Reference = Callable[[Vector, Vector], dict[str, Vector]]
"""Quantities at a configuration ``q`` (nq,) and a normal ``n`` (3,), by name, each a flat array."""


def casadi_reference(objective: ImpactObjective) -> Reference:
    """Return the quantities of an export as CasADi interprets them.

    The names are ``H``, ``grad`` (nv,), ``jump`` (nv,), ``G``, ``V = H/G²``, ``ellipsoid`` (9,).  ``objective`` and
    ``objective_grad`` (nv,) are at the objective's own normal; several contacts at once have these two only.
    """
    k = objective.kernel
    value, gradient = objective.gradient_fun().call([k.q, ca.DM(objective.contact.normal)])
    outputs = {} if objective.others else {"H": k.H, "grad": k.grad_H}
    outputs |= {"objective": value, "objective_grad": gradient}
    outputs |= {} if objective.others else {"jump": k.jump.a, "G": k.G, "V": k.V, "ellipsoid": k.ellipsoid}
    function = ca.Function("reference", [k.q, k.n], [*outputs.values()], ["q", "n"], [*outputs], {"cse": True})

    def evaluate(q: Vector, n: Vector) -> dict[str, Vector]:
        return {name: np.array(x, dtype=float).ravel() for name, x in zip(outputs, function(q, n), strict=True)}

    return evaluate


def oracle_reference(objective: ImpactObjective) -> Reference:
    """Return the same quantities from the numbers of Pinocchio."""

    def evaluate(q: Vector, n: Vector) -> dict[str, Vector]:
        found = {"objective": objective.value(q), "objective_grad": objective.gradient(q)}
        if not objective.others:
            oracle = oracle_along(objective, n)
            at = oracle.quantities(q)
            found |= {"H": at.H, "grad": oracle.gradient_H(q), "jump": at.jump, "G": at.G, "V": at.V}
            found["ellipsoid"] = at.ellipsoid
        return {name: np.ravel(value) for name, value in found.items()}

    return evaluate


def oracle_along(objective: ImpactObjective, normal: Vector) -> ImpactOracle:
    """Return the oracle of the leading contact along another normal, shape (3,), in the axes of its own."""
    x, y, z = (float(v) for v in normal)
    return ImpactOracle(replace(objective.case, contact=replace(objective.contact, normal=(x, y, z))))


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

    def graph(self) -> Graph:
        """Return the operations on single numbers, with the constants as numbers."""
        *inputs, _ = self.function.sx_in()
        values = self.function.call([*inputs, ca.DM(self.constants)])
        names = self.function.name_in()[:-1], self.function.name_out()
        return graph_of(ca.Function("numbers", inputs, values, *names, {"cse": True}))

    def vector_graph(self) -> Graph:
        """Return the same operations with one vector operation for those that repeated limbs share."""
        return packed(graph_of(self.function), self.seeds, {"constants": self.constants})


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
