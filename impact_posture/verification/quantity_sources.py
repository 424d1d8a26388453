"""Sources that compute the quantities of an impact by different means, and random samples for them."""

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
from impact_posture.dynamics.numeric import hold_locked
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.robot.model_joints import finite_armature
from impact_posture.robot.robot import Robot
from impact_posture.system.arrays import Array
from impact_posture.system.libraries import build_library, load_library
from impact_posture.system.scratch_folder import scratch_folder

# First step of the finite differences, and their number, each half of the one before.
_FIRST_STEP, _LEVELS = 0.02, 7
# H, G and ∇H vanish where the contact cannot move along n.  So the scale of their errors is at least this share of
# their largest value over all normals.
_FLOOR = 1e-3


@dataclass(frozen=True, eq=False)
class PostureSample:
    """Configuration, shape (nq,), and unit normal, shape (3,), in the normal frame of the contact."""

    q: Array
    normal: Array


def random_samples(robot: Robot, count: int, seed: int, normal: Array | None = None) -> tuple[PostureSample, ...]:
    """Return random postures with random normals, which depend on the seed only.  ``normal`` replaces the first one.

    Joints are uniform within their limits.  Without limits, angles are within ±π and lengths within 1 m of the
    default posture, and orientations are uniform.  A limit that is missing on one side is at this distance from the
    default posture.
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
    """Return a uniformly distributed unit vector."""
    vector = generator.normal(size=size)
    return np.asarray(vector / np.linalg.norm(vector))


@dataclass(frozen=True, eq=False)
class Numbers:
    """Quantities of one source at one sample: ``H``, ``G``, ``Λ_c``, ``∇H``, ``M``, ``J``.

    Attributes:
        values: Array of each quantity that the source computes.
        scales: Least scale of the relative error of each quantity.  The largest entry replaces a smaller scale.
    """

    values: dict[str, Array]
    scales: dict[str, float] = field(default_factory=dict)


Source = Callable[[PostureSample], Numbers]


def pinocchio_numbers(objective: WorstCaseObjective, sample: PostureSample) -> Numbers:
    """Return the reference from ``M``, ``J`` and derivatives of Pinocchio by dense linear algebra."""
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
    """Return ``∇H`` from finite differences of ``H`` from Pinocchio."""
    oracle = oracle_along(objective, sample.normal)

    def value(q: Array) -> float:
        oracle.at(q)
        a = oracle.solve(oracle.J.T @ oracle.n)
        return float(a @ oracle.weigh(a))

    return Numbers({"∇H": difference_gradient(value, objective.robot.model, sample.q)})


def casadi_source(objective: WorstCaseObjective) -> Source:
    """Return the source of the symbolic expressions, interpreted by CasADi."""
    reference = casadi_reference(_impulse(objective))
    return lambda sample: _named(reference(sample.q, sample.normal))


@contextmanager
def compiled_source(objective: WorstCaseObjective) -> Iterator[Source]:
    """Yield the source of the C export, built in a temporary folder.

    Raises:
        CompilerError: There is no compiler, or it failed.
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
    """Return the objective ``impulse``, which is defined everywhere and has the same ``H`` and ``∇H``."""
    return replace(objective, kind="impulse")


def _named(values: dict[str, Array]) -> Numbers:
    return Numbers(
        {"H": values["H"], "G": values["G"], "Λ_c": values["ellipsoid"].reshape(3, 3), "∇H": values["grad"]}
    )


class MujocoSource:
    """Source of ``M`` and ``J`` from MuJoCo.  The other quantities follow from one dense solve."""

    def __init__(self, objective: WorstCaseObjective) -> None:
        self._objective = objective
        model = objective.robot.model.copy()
        model.armature, self._locked = finite_armature(model)
        self._numeric = MujocoNumeric(model)

    def __call__(self, sample: PostureSample) -> Numbers:
        """Return the numbers at one sample, with ``∇H`` from finite differences of ``H``."""

        def value(q: Array) -> float:
            return float(self._values(q, sample.normal)["H"][0])

        gradient = difference_gradient(value, self._objective.robot.model, sample.q)
        return Numbers({**self._values(sample.q, sample.normal), "∇H": gradient})

    def _values(self, q: Array, normal: Array) -> dict[str, Array]:
        """``[M, −J_sᵀ; J_s, εI] [A; f] = [Jᵀ; 0]``, ``Λ_c = AᵀWA``, ``H = nᵀΛ_c n``, ``G = nᵀJA n``."""
        objective, numeric = self._objective, self._numeric.at(q)
        contact, metric = objective.contact, objective.metric
        M, J = numeric.mass_matrix(), numeric.jacobian(contact.frame, contact.offset)[:3]
        feet = [numeric.jacobian(s.frame, s.offset)[: s.rows] for s in objective.supports]
        M, J, Js = hold_locked(self._locked, M, J, np.vstack([np.zeros((0, len(M))), *feet]))
        system = np.block([[M, -Js.T], [Js, objective.compliance * np.eye(len(Js))]])
        A = np.linalg.solve(system, np.vstack([J.T, np.zeros((len(Js), 3))]))[: len(M)]
        weighed = M @ A if metric.kind == "kinetic" else metric.diagonal(len(M))[:, None] * A
        n = normal if contact.normal_frame == "world" else numeric.rotation(contact.frame) @ normal
        ellipsoid, mobility = A.T @ weighed, J @ A
        H, G = np.array([n @ ellipsoid @ n]), np.array([n @ mobility @ n])
        return {"H": H, "G": G, "Λ_c": ellipsoid, "M": M, "J": J}


def difference_gradient(value: Callable[[Array], float], model: pin.Model, q: Array) -> Array:
    """Return ``d/dε value(q ⊕ ε e_i)``, shape (nv,), by Ridders' extrapolation of central differences.

    Each entry is the extrapolation of its tableau that differs least from its neighbors.  So stiff supports and flat
    directions need no tuned steps (Ridders 1982, "Accurate computation of F'(x) and F'(x)F''(x)").  ``model`` defines
    ``⊕``.
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
