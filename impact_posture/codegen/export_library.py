"""The CasADi expressions of all functions of an export."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import casadi as ca

from impact_posture.codegen.export_functions import stems
from impact_posture.codegen.expression_graph import Graph, graph_of
from impact_posture.codegen.simd_lanes import LimbInput, pack_lanes
from impact_posture.dynamics.chart import Chart
from impact_posture.dynamics.kinematics import Visits
from impact_posture.dynamics.repeated_limbs import RepeatedLimbs
from impact_posture.errors import InputError
from impact_posture.impact.quantities.impact_kernel import ImpactKernel
from impact_posture.impact.worst_case_objective import WorstCaseObjective


@dataclass(frozen=True)
class NamedObjective:
    """An objective to export, with its C names.

    Attributes:
        stem: Text with which the C names of the objective begin.
        free: Whether this objective ignores the supports of a standing robot.
        joint: Whether this objective is for several simultaneous contacts; ``H`` of such an objective is not
            exported.
    """

    objective: WorstCaseObjective
    stem: str
    free: bool = False
    joint: bool = False


def named_objectives(objectives: Sequence[WorstCaseObjective], prefix: str) -> tuple[NamedObjective, ...]:
    """Return the objectives to export, each with the stem of its C names (:class:`NamedObjective`).

    If the robot has supports, the objective without supports follows each objective, with the stem ``<stem>_free``.
    An objective of several contacts becomes one objective per contact; the objective of all contacts is last.

    Raises:
        InputError: An objective of several contacts is exported together with other objectives.
    """
    several = [objective for objective in objectives if objective.others]
    if several and len(objectives) > 1:
        what = "a several-contact objective cannot be exported with others"
        raise InputError(what, where="codegen", hint="export each objective separately")
    # A frame with two contacts needs only one H, because the normal is a parameter of H.
    singles: dict[str, WorstCaseObjective] = {}
    for single in (single for objective in several for single in objective.singles):
        singles.setdefault(single.contact.frame, single)
    each = [*singles.values()] if several else [*objectives]
    frames = [o.contact.frame for o in each]
    names = stems(prefix, frames) if len(frames) > 1 or not several else (f"{prefix}_contact",)
    named: list[NamedObjective] = []
    for objective, stem in zip(each, names, strict=True):
        named.append(NamedObjective(objective, stem))
        if objective.supports:
            named.append(NamedObjective(replace(objective, supports=()), f"{stem}_free", free=True))
    return (*named, *[NamedObjective(objective, prefix, joint=True) for objective in several])


@dataclass(frozen=True)
class Exported:
    """One C function of the library.

    Attributes:
        stem: Text with which the C name of the function begins.
        name: Name of the function in :data:`~impact_posture.codegen.export_functions.SIGNATURES`.
        outputs: Outputs of :attr:`ExportLibrary.function` that are the results of this C function.
    """

    stem: str
    name: str
    outputs: tuple[str, ...]


@dataclass(frozen=True)
class ExportLibrary:
    """All results of a library as one CasADi function, so that common expressions are computed once.

    Attributes:
        function: CasADi function ``(q, n, constants)`` → all outputs.
        constants: Values of the input ``constants``, which contains the constants in which repeated limbs differ.
        seeds: (input name, index) → limb to which the input belongs.
        functions: Name and outputs of each C function.
        joints: For each entry of the output ``visits``, the joint at which a sweep computes it.
    """

    function: ca.Function
    constants: tuple[float, ...]
    seeds: Mapping[tuple[str, int], LimbInput]
    functions: tuple[Exported, ...]
    joints: tuple[int, ...] = ()

    def graph(self) -> Graph:
        """Return the graph of operations on single numbers, with numbers in place of the input ``constants``."""
        *inputs, _ = self.function.sx_in()
        values = self.function.call([*inputs, ca.DM(self.constants)])
        names = self.function.name_in()[:-1], self.function.name_out()
        return graph_of(ca.Function("numbers", inputs, values, *names, {"cse": True}))

    def vector_graph(self) -> Graph:
        """Return the graph in which one vector operation replaces the equal operations of repeated limbs."""
        if not self.seeds:
            return self.graph()
        return pack_lanes(graph_of(self.function), self.seeds, {"constants": self.constants})


def export_library(exported: Sequence[NamedObjective], *, lean: bool = False) -> ExportLibrary:
    """Return the expressions of the objectives of one robot.

    ``lean`` expressions need few values at a time, but more operations.  Their additional output ``visits`` contains
    the values of the sweeps in their order.

    ``V`` has no expression, because the C code computes it from ``H`` and ``G``.  If ``objective`` is a multiple of
    ``H``, the C code computes it from ``H``, so it has no expression either.
    """
    robot = exported[0].objective.robot
    model, q, n = robot.model, ca.SX.sym("q", robot.nq), ca.SX.sym("n", 3)
    limbs = RepeatedLimbs(model, robot.coupled_joints)
    outputs: dict[str, ca.SX] = {}
    functions: list[Exported] = []
    visits: Visits | None = [] if lean else None
    for number, v in enumerate(exported):
        k = ImpactKernel(v.objective.case, q, n, limbs, visits)
        parts: dict[str, dict[str, ca.SX]] = {}
        if not v.joint:
            parts["eval"], parts["value"] = {"H": k.H, "grad": k.grad_H}, {"H": k.H}
            parts["jump"], parts["ellipsoid"] = {"a": k.jump.a, "G": k.G, "H": k.H}, {"L": k.ellipsoid}
        if not v.objective.is_multiple_of_H:
            expressions = v.objective.worst_case.expressions(k)
            parts["objective"] = dict(zip(("value", "gradient"), expressions, strict=True))
        for name, part in parts.items():
            part_outputs = {f"o{number}_{output}": value for output, value in part.items()}
            functions.append(Exported(v.stem, name, tuple(part_outputs)))
            outputs |= part_outputs
    if visits is not None:
        outputs["visits"] = ca.vertcat(*[values for _, values in visits])
    joints = tuple(joint for joint, values in visits or () for _ in range(values.numel()))
    constants = [value for _, value in limbs.parameters.values()]
    inputs = [q, n, ca.vertcat(ca.SX(0, 1), *[symbol for symbol, _ in limbs.parameters.values()])]
    names = ["q", "n", "constants"], [*outputs]
    function = ca.Function("library", inputs, [*outputs.values()], *names, {"cse": True})
    return ExportLibrary(function, tuple(constants), _seeds(model, limbs), tuple(functions), joints)


def _seeds(model: object, limbs: RepeatedLimbs) -> dict[tuple[str, int], LimbInput]:
    seeds = {("constants", i): LimbInput(group, lane, name) for i, (group, lane, name) in enumerate(limbs.parameters)}
    for slot in Chart(model).slots:
        place = limbs.places.get(slot.index)
        if place is not None:
            for i in range(slot.q.start, slot.q.stop):
                seeds["q", i] = LimbInput(place.group, place.lane, f"{place.position}.q.{i - slot.q.start}")
    return seeds
