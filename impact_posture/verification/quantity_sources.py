"""Compute H, G, Λ_c and ∇H from CasADi, compiled C, MuJoCo and finite differences, at random postures."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

import numpy as np
import pinocchio as pin

from impact_posture.codegen.export import export
from impact_posture.codegen.impact_gradient import ImpactGradient
from impact_posture.codegen.self_test import RESULTS, casadi_reference, oracle_along
from impact_posture.dynamics.chart import Chart
from impact_posture.dynamics.mujoco_numeric import MujocoNumeric
from impact_posture.dynamics.numeric import reduced
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.robot.robot import Robot
from impact_posture.system.arrays import Array
from impact_posture.system.libraries import build_library, load_library
from impact_posture.system.scratch_folder import scratch_folder

# ``_FIRST_STEP`` is the first step of the finite differences, rad (m), and ``_LEVELS`` is the number of steps.  Each
# step is half as long as the previous step.
_FIRST_STEP, _LEVELS = 0.02, 7
# The scale of the relative errors of H, G and ∇H is at least this fraction of the largest H or G over all normals.
# Without this lower bound, the scale would be zero if the contact cannot move along n.
_FLOOR = 1e-3


@dataclass(frozen=True, eq=False)
class PostureSample:
    """Configuration ``q``, shape (nq,), and unit ``normal``, shape (3,), in :attr:`ImpactContact.normal_frame`."""

    q: Array
    normal: Array


def random_samples(robot: Robot, count: int, seed: int, normal: Array | None = None) -> tuple[PostureSample, ...]:
    """Return random postures with random normals, which depend only on the seed.

    If ``normal`` is given, it replaces the first random normal.  Joint positions are distributed uniformly within
    their limits.  A missing limit is replaced by a limit at a distance of π (angles) or 1 m (lengths) from the
    default posture.  Orientations are distributed uniformly.
    """
    generator, chart = np.random.default_rng(seed), Chart(robot.model)
    start = chart.to_x(robot.posture())
    lower, upper = chart.bounds()
    reach = np.ones(chart.nx)
    for slot in chart.slots:
        if slot.kind.family in ("revolute", "continuous", "planar"):
            reach[slot.x.stop - 1] = np.pi
    lower = np.where(np.isfinite(lower), lower, np.minimum(start, upper) - reach)
    upper = np.where(np.isfinite(upper), upper, np.maximum(start, lower) + reach)
    samples = []
    for k in range(count):
        x = generator.uniform(lower, upper)
        for quaternion in chart.quaternion_slices():
            x[quaternion] = _direction(generator, 4)
        drawn = _direction(generator, 3)
        samples.append(PostureSample(chart.to_q(x), drawn if k or normal is None else normal))
    return tuple(samples)


def _direction(generator: np.random.Generator, size: int) -> Array:
    vector = generator.normal(size=size)
    return np.asarray(vector / np.linalg.norm(vector))


@dataclass(frozen=True, eq=False)
class Numbers:
    """Quantities that one source computes at one sample: some of ``H``, ``G``, ``Λ_c``, ``∇H``, ``M`` and ``J``.

    Attributes:
        values: Name of the quantity → value.
        scales: Name of the quantity → smallest denominator of the relative error.  If the quantity has a larger
            entry, this entry is the denominator.
    """

    values: dict[str, Array]
    scales: dict[str, float] = field(default_factory=dict)


Source = Callable[[PostureSample], Numbers]


def pinocchio_numbers(objective: WorstCaseObjective, sample: PostureSample) -> Numbers:
    """Return the reference values, computed by dense linear algebra from ``M``, ``J`` and Pinocchio derivatives."""
    oracle = oracle_along(objective, sample.normal)
    quantities = oracle.quantities(sample.q)
    values = {
        "H": np.array([quantities.H]),
        "G": np.array([quantities.G]),
        "Λ_c": quantities.ellipsoid,
        "∇H": oracle.gradient_H(sample.q),
        "M": oracle.M,
        "J": oracle.J,
    }
    of_H, of_G = (_FLOOR * float(np.abs(matrix).max()) for matrix in (quantities.ellipsoid, quantities.mobility))
    return Numbers(values, {"H": of_H, "∇H": of_H, "G": of_G})


def pinocchio_differences(objective: WorstCaseObjective, sample: PostureSample) -> Numbers:
    """Return ``∇H``, computed by finite differences of the ``H`` that :func:`pinocchio_numbers` computes."""
    oracle = oracle_along(objective, sample.normal)

    def value(q: Array) -> float:
        oracle.at(q)
        a = oracle.solve(oracle.J.T @ oracle.n)
        return float(a @ oracle.weigh(a))

    return Numbers({"∇H": difference_gradient(value, objective.robot.model, sample.q)})


def casadi_source(objective: WorstCaseObjective) -> Source:
    """Return the function that evaluates the symbolic expressions with the CasADi interpreter."""
    reference = casadi_reference(_impulse(objective))
    return lambda sample: _named(reference(sample.q, sample.normal))


@contextmanager
def compiled_source(objective: WorstCaseObjective) -> Iterator[Source]:
    """Yield a function that calls the C export of the objective.  The export is built in a temporary folder.

    Raises:
        CompilerError: No compiler is installed, or the compiler failed.
    """
    with scratch_folder() as folder:
        made = export(_impulse(objective), folder, prefix="verified", check=False)
        compiled = ImpactGradient(load_library(build_library(folder, made.prefix)), made.manifest)

        def numbers(sample: PostureSample) -> Numbers:
            values: dict[str, Array] = {}
            for function in ("eval", "jump", "ellipsoid"):
                code, results = compiled.call(function, sample.q, sample.normal)
                # Code 3 of `jump` means that V is undefined because G is zero.  The other results are valid.
                good = code == 0 or (function, code) == ("jump", 3)
                for name, result in zip(RESULTS[function], results, strict=True):
                    values[name] = result.copy() if good else np.full(result.shape, np.nan)
            return _named(values)

        yield numbers


def _impulse(objective: WorstCaseObjective) -> WorstCaseObjective:
    """Return an objective with the same ``H``, but of the type ``impulse``, which exists at every posture."""
    return replace(objective, kind="impulse")


def _named(values: dict[str, Array]) -> Numbers:
    return Numbers(
        {"H": values["H"], "G": values["G"], "Λ_c": values["ellipsoid"].reshape(3, 3), "∇H": values["grad"]}
    )


class MujocoSource:
    """Get ``M`` and ``J`` from MuJoCo, and compute the other quantities by one dense linear solve."""

    def __init__(self, objective: WorstCaseObjective) -> None:
        self._objective = objective
        frames = [contact.frame for contact in objective.contacts] + [foot.frame for foot in objective.supports]
        self._numeric = MujocoNumeric(objective.robot, frames)

    def __call__(self, sample: PostureSample) -> Numbers:
        """Return the quantities at one sample.  ``∇H`` is computed by finite differences of ``H``."""

        def value(q: Array) -> float:
            return float(self._values(q, sample.normal)["H"][0])

        gradient = difference_gradient(value, self._objective.robot.model, sample.q)
        return Numbers({**self._values(sample.q, sample.normal), "∇H": gradient})

    def _values(self, q: Array, normal: Array) -> dict[str, Array]:
        """Solve ``[M, −J_sᵀ; J_s, εI] [A; f] = [Jᵀ; 0]``; return ``Λ_c = AᵀWA``, ``H = nᵀΛ_c n``, ``G = nᵀJA n``."""
        objective, numeric = self._objective, self._numeric.at(q)
        contact, metric = objective.contact, objective.metric
        M, J = numeric.mass_matrix(), numeric.jacobian(contact.frame, contact.offset)[:3]
        feet = [numeric.jacobian(s.frame, s.offset)[: s.rows] for s in objective.supports]
        M, J, Js = reduced(objective.robot.projector, M, J, np.vstack([np.zeros((0, len(M))), *feet]))
        system = np.block([[M, -Js.T], [Js, objective.compliance * np.eye(len(Js))]])
        # The projector sets the entries of coupled and locked joints to zero.
        A = np.linalg.solve(system, np.vstack([J.T, np.zeros((len(Js), 3))]))[: len(M)]
        weighed = M @ A if metric.kind == "kinetic" else metric.diagonal(len(M))[:, None] * A
        n = normal if contact.normal_frame == "world" else numeric.rotation(contact.frame) @ normal
        ellipsoid, mobility = A.T @ weighed, J @ A
        H, G = np.array([n @ ellipsoid @ n]), np.array([n @ mobility @ n])
        return {"H": H, "G": G, "Λ_c": ellipsoid, "M": M, "J": J}


def difference_gradient(value: Callable[[Array], float], model: pin.Model, q: Array) -> Array:
    """Return ``d/dε value(q ⊕ ε e_i)``, shape (nv,), by Ridders' extrapolation of central differences.

    For each entry, the result is the extrapolated value that differs least from its neighbors in the extrapolation
    table.  Therefore, the step needs no tuning (Ridders 1982, "Accurate computation of F'(x) and F'(x)F''(x)").
    ``model`` defines ``⊕``.
    """
    directions = np.eye(model.nv)

    def central(step: float) -> Array:
        ahead, behind = ([value(pin.integrate(model, q, s * e)) for e in directions] for s in (step, -step))
        return np.asarray((np.array(ahead) - np.array(behind)) / (2 * step))

    best, least = np.full(model.nv, np.nan), np.full(model.nv, np.inf)
    before: list[Array] = []
    for level in range(_LEVELS):
        row = [central(_FIRST_STEP / 2**level)]
        for order, old in enumerate(before, start=1):
            factor = 4.0**order
            better = (factor * row[-1] - old) / (factor - 1)
            doubt = np.maximum(np.abs(better - row[-1]), np.abs(better - old))
            closer = doubt < least
            best, least = np.where(closer, better, best), np.where(closer, doubt, least)
            row.append(better)
        before = row
    return best
