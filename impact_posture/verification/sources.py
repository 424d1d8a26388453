"""The ways of computing an impact: each gives the same numbers at a sample by other means."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from impact_posture.codegen.build_check import compiled
from impact_posture.codegen.export import export
from impact_posture.dynamics.mjcf_numeric import MujocoNumeric
from impact_posture.impact.objective import ImpactObjective
from impact_posture.impact.oracle import ImpactOracle
from impact_posture.output_folder import scratch_folder
from impact_posture.verification.differences import difference_gradient
from impact_posture.verification.samples import Sample

Vector = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Numbers:
    """What one way computes at one sample, by quantity: ``H``, ``G``, ``Λ_c``, ``∇H``, ``M``, ``J``.

    Attributes:
        values: Arrays by quantity; a way need not have all.
        scales: By quantity, what an error is relative to if that is more than the quantity's largest entry.
    """

    values: dict[str, Vector]
    scales: dict[str, float] = field(default_factory=dict)


Source = Callable[[Sample], Numbers]

# Where n lies across the ways the contact can move, H, G and ∇H vanish: they count relative to this part of their
# largest value over all normals.
_FLOOR = 1e-3


def pinocchio_numbers(objective: ImpactObjective, sample: Sample) -> Numbers:
    """The reference: Pinocchio's ``M``, ``J`` and derivatives, dense linear algebra."""
    oracle = _oracle(objective, sample)
    found = oracle.quantities(sample.q)
    values = {
        "H": np.array([found.H]),
        "G": np.array([found.G]),
        "Λ_c": found.ellipsoid,
        "∇H": oracle.gradient_H(sample.q),
        "M": oracle.M,
        "J": oracle.J,
    }
    of_H, of_G = (_FLOOR * float(np.abs(matrix).max()) for matrix in (found.ellipsoid, found.mobility))
    return Numbers(values, {"H": of_H, "∇H": of_H, "G": of_G})


def pinocchio_differences(objective: ImpactObjective, sample: Sample) -> Numbers:
    """``∇H`` from Pinocchio's values of ``H`` alone."""
    oracle = _oracle(objective, sample)

    def value(q: Vector) -> float:
        oracle.at(q)
        a = oracle.solve(oracle.J.T @ oracle.n)
        return float(a @ oracle.weigh(a))

    return Numbers({"∇H": difference_gradient(value, objective.robot.model, sample.q)})


def _oracle(objective: ImpactObjective, sample: Sample) -> ImpactOracle:
    x, y, z = (float(v) for v in sample.normal)
    contact = replace(objective.contact, normal=(x, y, z))
    return ImpactOracle(replace(objective.case, contact=contact))


def casadi_source(objective: ImpactObjective) -> Source:
    """CasADi's interpreter of the symbolic kernel."""
    k = objective.kernel
    outputs = {"H": k.H, "G": k.G, "Λ_c": k.ellipsoid, "∇H": k.grad_H}
    fun = ca.Function("all", [k.q, k.n], list(outputs.values()), {"cse": True})

    def numbers(sample: Sample) -> Numbers:
        found = fun(sample.q, sample.normal)
        shapes = {"Λ_c": (3, 3)}
        return Numbers({
            name: np.array(value, dtype=float).reshape(shapes.get(name, (-1,)))
            for name, value in zip(outputs, found, strict=True)
        })  # fmt: skip

    return numbers


@contextmanager
def compiled_source(objective: ImpactObjective) -> Iterator[Source]:
    """The C export, built by the user's compiler in a temporary folder.

    Raises:
        CompilerError: No compiler, or it failed.
    """
    # The export's H and ∇H are the same whatever the objective; this one exists everywhere.
    objective, robot, prefix = replace(objective, kind="impulse"), objective.robot, "verified"
    with scratch_folder() as folder:
        export(objective, folder, prefix=prefix, check=False)
        with compiled(folder, prefix, robot.nq, robot.nv) as library:

            def numbers(sample: Sample) -> Numbers:
                code, H, gradient = library.eval(sample.q, sample.normal)
                jump_code, _, G, _ = library.jump(sample.q, sample.normal)
                ellipsoid_code, ellipsoid = library.ellipsoid(sample.q)
                return Numbers({
                    "H": _accepted(code, np.array([H])),
                    # Code 3: V does not exist where G is zero; G does, and the comparison refuses what is not finite.
                    "G": _accepted(0 if jump_code == 3 else jump_code, np.array([G])),
                    "Λ_c": _accepted(ellipsoid_code, ellipsoid),
                    "∇H": _accepted(code, gradient),
                })  # fmt: skip

            yield numbers


def _accepted(code: int, values: Vector) -> Vector:
    """The values of a call that returned 0; no numbers where the code refused its input."""
    return values if code == 0 else np.full(values.shape, np.nan)


class MujocoSource:
    """MuJoCo's ``M`` and ``J``, and what follows from them by one dense solve."""

    def __init__(self, objective: ImpactObjective) -> None:
        self._objective = objective
        self._numeric = MujocoNumeric(objective.robot.model)

    def __call__(self, sample: Sample) -> Numbers:
        """Numbers at one sample; ``∇H`` by differences of MuJoCo's own ``H``."""

        def value(q: Vector) -> float:
            return float(self._values(q, sample.normal)["H"][0])

        gradient = difference_gradient(value, self._objective.robot.model, sample.q)
        return Numbers({**self._values(sample.q, sample.normal), "∇H": gradient})

    def _values(self, q: Vector, normal: Vector) -> dict[str, Vector]:
        """``[M, −J_sᵀ; J_s, εI] [A; f] = [Jᵀ; 0]``, ``Λ_c = AᵀWA``, ``H = nᵀΛ_c n``, ``G = nᵀJA n``."""
        objective, numeric = self._objective, self._numeric.at(q)
        contact, metric = objective.contact, objective.metric
        M, J = numeric.mass_matrix(), numeric.jacobian(contact.frame, contact.offset)[:3]
        feet = [numeric.jacobian(s.frame, s.offset)[: s.rows] for s in objective.supports]
        Js = np.vstack([np.zeros((0, len(M))), *feet])
        system = np.block([[M, -Js.T], [Js, objective.compliance * np.eye(len(Js))]])
        A = np.linalg.solve(system, np.vstack([J.T, np.zeros((len(Js), 3))]))[: len(M)]
        weighed = M @ A if metric.kind == "kinetic" else metric.diagonal(len(M))[:, None] * A
        n = normal if contact.normal_frame == "world" else numeric.rotation(contact.frame) @ normal
        ellipsoid, mobility = A.T @ weighed, J @ A
        H, G = np.array([n @ ellipsoid @ n]), np.array([n @ mobility @ n])
        return {"H": H, "G": G, "Λ_c": ellipsoid, "M": M, "J": J}
