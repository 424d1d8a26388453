"""Fixed feet, compared with sixty digits and Pinocchio's impulse dynamics, at every rank of their Jacobian."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from decimal import Decimal
from pathlib import Path

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest

from impact_posture.codegen.export import export
from impact_posture.codegen.impact_gradient import ImpactGradient
from impact_posture.config.problem_settings import ImpactSettings
from impact_posture.errors import InputError
from impact_posture.impact.impact_contact import ImpactContact
from impact_posture.impact.quantities.impact_oracle import ImpactOracle
from impact_posture.impact.resolved_impact import resolve
from impact_posture.impact.support_compliance import least_compliance
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.robot.robot import Robot
from impact_posture.robot.robot_spec import Support
from impact_posture.verification.verification import verify
from tests.support.exact import Exact, ExactImpact, digits, distance, exact, rounded
from tests.support.exact_bounds import Bounded
from tests.support.exported import Exported, built
from tests.support.helpers import Vector, contact_frame, random_configurations, rng, robot, unit
from tests.support.pinocchio_values import central_gradient
from tests.support.rigid import Rigid
from tests.support.rounding import other_rounding

# Values of compliance times robot mass: the default, and values for stiffer feet.
STIFFNESS = (1e-4, 1e-6, 1e-9)
ENDS = STIFFNESS[::2]
# Postures in which the four feet of solo8 (at their centers) have different ranks: straight legs, equal knees,
# unequal knees.
SOLO8 = {"straight": 9, "equal knees": 10, "one knee moved by 1e-6": 11, "one knee moved by 1e-3": 11, "random": 11}
CASES = [*[("solo8", posture) for posture in SOLO8], ("solo12", "random"), ("bolt", "random"), ("talos", "random")]
STIFFENED = [(*case, e) for case in CASES for e in (ENDS if case[0] == "talos" else STIFFNESS)]

# Seeds of the simulated rounding: None for this processor, 1 for another processor.
SEEDS = (None, 1)


@pytest.fixture(autouse=True)
def sixty_digits() -> Iterator[None]:
    with digits():
        yield


def feet(loaded: Robot) -> tuple[Support, ...]:
    """Return the feet of a robot.  For solo8, use the foot centers, which are singular when the legs are straight."""
    own = loaded.spec.supports
    return tuple(replace(s, offset=(0.0, 0.0, 0.0)) for s in own) if loaded.name == "solo8" else own


def objective(name: str, relative_compliance: float, normal: Vector | None = None) -> WorstCaseObjective:
    loaded = robot(name)
    n = unit(rng(name, "exact normal")) if normal is None else normal
    contact = ImpactContact(contact_frame(loaded), tuple(n))
    return WorstCaseObjective(loaded, contact, supports=feet(loaded), compliance=relative_compliance / loaded.mass)


def posture(name: str, label: str) -> Vector:
    model = robot(name).model
    if label == "random":
        return random_configurations(model, 1, name, "exact")[0]
    q = np.array(pin.neutral(model))
    if label != "straight":
        q[7:] = np.tile([0.3, -0.8], 4)
    if label.startswith("one knee moved"):
        q[-1] += float(label.split()[-1])
    return q


@functools.cache
def bounded(name: str, label: str, relative_compliance: float) -> Bounded:
    with digits():
        oracle = objective(name, relative_compliance).oracle.at(posture(name, label))
        return Bounded(oracle, oracle.compliance)


def within(values: object, expected: Exact | Decimal, bound: Vector | float, what: str) -> None:
    """Check that the error of every entry is within its bound."""
    error = distance(values, np.asarray(expected, dtype=object))
    assert (error <= bound).all(), f"{what}: error {error.max():.1e}, allowed {np.max(bound):.1e}"


def elsewhere(seed: int | None) -> AbstractContextManager[None]:
    return nullcontext() if seed is None else other_rounding(seed)


def size(values: object) -> float:
    return float(np.abs(np.asarray(values, dtype=float)).max())


# ---- accuracy in double precision ---------------------------------------------------------------------------------


@pytest.mark.parametrize(("label", "rank"), SOLO8.items())
def test_solo8_has_every_rank(label: str, rank: int) -> None:
    Js = objective("solo8", 1e-4).oracle.at(posture("solo8", label)).Js
    assert Js.shape == (12, 14)
    assert np.linalg.matrix_rank(Js, tol=1e-12) == rank


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize(("name", "label", "relative_compliance"), STIFFENED)
def test_the_oracle_solves_what_it_is_given(
    name: str, label: str, relative_compliance: float, seed: int | None
) -> None:
    """The errors are within the bounds of elimination on the KKT system, and the jump has nine correct digits."""
    x = bounded(name, label, relative_compliance)
    with elsewhere(seed):
        oracle = objective(name, relative_compliance).oracle
        result, gradient = oracle.quantities(x.oracle.numeric.q), oracle.gradient_H(x.oracle.numeric.q)
    lost, nv = x.lost_by_elimination, x.nv
    within(result.jump, x.jump, lost[:nv], "jump")
    within(result.support_impulse, x.impulse, lost[nv:], "support impulses")
    within(result.H, x.H, x.H_by_elimination, "H")
    within(result.G, x.G, x.G_by_elimination, "G")
    lost_V = float(x.V) * (x.H_by_elimination / float(x.H) + 2 * x.G_by_elimination / float(x.G))
    within(result.V, x.V, 1.01 * lost_V, "V")
    within(gradient, x.grad_H, x.gradient_by_elimination, "∇H")
    # The accuracy of the jump depends on the condition number of the motion, not on 1/ε.
    assert size(distance(result.jump, x.jump)) <= 1e-9 * size(x.jump)


@pytest.mark.long(
    but=(
        "solo8-straight-None",
        "solo8-equal knees-None",
        "solo8-one knee moved by 1e-6-None",
        "solo12-random-None",
        "bolt-random-None",
    )
)
@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize(("name", "label"), CASES)
def test_the_oracles_sticking_impact(name: str, label: str, seed: int | None) -> None:
    """S and ∇S are as accurate as for rounded matrices: no error grows with the square of a condition number."""
    x = bounded(name, label, 1e-4)
    with elsewhere(seed):
        oracle = objective(name, 1e-4).oracle
        result, gradient = oracle.quantities(x.oracle.numeric.q), oracle.gradient_S(x.oracle.numeric.q)
    lost_S, lost_gradient = x.sticking_by_elimination
    assert result.S is not None
    within(result.S, x.S, lost_S, "S")
    within(gradient, x.grad_S, lost_gradient, "∇S")


def heavy_feet(x: Bounded, H: object, gradient: object, jump: object, G: object) -> None:
    """Check the error bounds of a factorization with 1/ε at the feet; by default, nine digits are correct."""
    within(jump, x.jump, x.jump_by_heavy_feet, "jump")
    within(H, x.H, x.H_by_heavy_feet, "H")
    within(G, x.G, x.G_by_heavy_feet, "G")
    within(gradient, x.grad_H, x.gradient_by_heavy_feet, "∇H")
    if x.compliance * x.oracle.robot.mass >= 0.99e-4:
        for value, expected in ((H, x.H), (G, x.G), (gradient, x.grad_H), (jump, x.jump)):
            worst = size(distance(value, np.asarray(expected, dtype=object)))
            assert worst <= 1e-9 * max(size(expected), 1e-3 * float(x.H))


@functools.cache
def kernel_fun(name: str, relative_compliance: float) -> ca.Function:
    k = objective(name, relative_compliance).kernel
    return ca.Function("kernel", [k.q, k.n], [k.H, k.grad_H, k.jump.a, k.G])


@pytest.mark.long(
    but=(
        "solo8-straight-1e-09",
        "solo8-equal knees-1e-06",
        "solo8-one knee moved by 1e-6-1e-09",
        "solo8-one knee moved by 1e-3-0.0001",
        "solo8-random-1e-06",
        "solo12-random-1e-09",
        "bolt-random-0.0001",
        "talos-random-1e-09",
    )
)
@pytest.mark.parametrize(("name", "label", "relative_compliance"), STIFFENED)
def test_the_kernel_loses_what_heavy_feet_must(name: str, label: str, relative_compliance: float) -> None:
    x = bounded(name, label, relative_compliance)
    out = kernel_fun(name, relative_compliance)(x.oracle.numeric.q, x.oracle.n)
    heavy_feet(x, *[np.array(value).reshape(-1) if value.numel() > 1 else float(value) for value in out])


@pytest.mark.long(but=("1e-09",))
@pytest.mark.parametrize("relative_compliance", ENDS)
def test_the_compiled_code_loses_no_more(tmp_path: Path, relative_compliance: float) -> None:
    written = objective("solo8", relative_compliance)
    export(written, tmp_path, prefix="feet", check=False)
    with built(tmp_path, "feet") as library:
        for label in SOLO8:
            _compiled(library, bounded("solo8", label, relative_compliance))


def _compiled(library: Exported, x: Bounded) -> None:
    q, n = np.array(x.oracle.numeric.q), np.array(x.oracle.n)
    code, H, gradient = library.eval(q, n)
    code_too, jump, G, _ = library.jump(q, n)
    assert code == code_too == 0
    heavy_feet(x, H, gradient, jump, G)


# ---- effect of the compliance -------------------------------------------------------------------------------------


@pytest.mark.parametrize("relative_compliance", [1e-4, 1e-5, 1e-6])
@pytest.mark.parametrize(
    ("name", "label"), [("solo8", "straight"), ("solo8", "equal knees"), ("solo12", "random"), ("talos", "random")]
)
def test_the_effect_of_compliance_is_bounded(name: str, label: str, relative_compliance: float) -> None:
    """The compliance ε changes the effect of the feet by at most ``ε/(σ+ε)``; σ is the least nonzero eigenvalue."""
    x = bounded(name, label, relative_compliance)
    # The reference compliance is so small that its bias is below double precision, but larger than rounding of J_s.
    rigid = ExactImpact(x.oracle, 1e-14 / x.oracle.robot.mass)
    M, Js = x.oracle.M, x.oracle.Js
    share = x.share
    free = np.linalg.solve(M, x.oracle.J.T @ x.oracle.n)
    off, done = rounded(x.jump - rigid.jump), free - rounded(rigid.jump)
    kinetic = np.sqrt(off @ M @ off)
    assert 0 < kinetic <= share * np.sqrt(done @ M @ done) * (1 + 1e-6)
    G_free = float(x.oracle.n @ x.oracle.J @ free)
    assert 0 <= float(x.G - rigid.G) <= share * (G_free - float(rigid.G)) * (1 + 1e-6)
    least = np.sqrt(np.linalg.eigvalsh(M)[0])
    assert abs(np.sqrt(float(x.H)) - np.sqrt(float(rigid.H))) <= kinetic / least * (1 + 1e-6)
    # Along motions that the feet allow, the momentum change equals the impulse for any compliance.
    allowed = np.linalg.svd(Js)[2][np.linalg.matrix_rank(Js, tol=1e-9) :]
    assert np.abs(allowed @ M @ off).max() <= 1e-9 * np.abs(M @ off).max()


def test_the_limit_of_no_compliance_is_not_smooth() -> None:
    """Moving one knee of solo8 by 1e-6 rad changes the rigid limit, but not the value at the default compliance."""
    sideways = np.array([0.0, 1.0, 0.0])
    values = {}
    for label in ("equal knees", "one knee moved by 1e-6"):
        oracle = objective("solo8", 1e-4, sideways).oracle.at(posture("solo8", label))
        # The compliance 1e-22 is between 1e-12 (the effect of the moved knee) and 1e-32 (the effect of rounding).
        values[label] = [float(ExactImpact(oracle, e).H) for e in (1e-22, oracle.compliance)]
    (rigid, soft), (rigid_moved, soft_moved) = values.values()
    assert rigid_moved < 1e-6 * rigid
    assert soft_moved == pytest.approx(soft, rel=1e-6)
    assert soft == pytest.approx(rigid, rel=1e-2)


# ---- Pinocchio's impulse dynamics ---------------------------------------------------------------------------------


@pytest.mark.long(but=("g1-2", "solo12-4", "anymal_c-4", "bolt-2"))
@pytest.mark.parametrize(
    ("name", "count"),
    [("talos", 1), ("talos", 2), ("g1", 2), ("solo12", 4), ("go2", 4), ("anymal_c", 4), ("bolt", 2)],
)
def test_full_rank_feet_tend_to_impulse_dynamics(name: str, count: int) -> None:
    """Compare with rigid contacts of Pinocchio: within ``ε/(σ+ε)``, and after extrapolation to zero compliance."""
    loaded = robot(name)
    supports = loaded.spec.supports[:count]
    base = replace(objective(name, 1e-4), supports=supports)
    (q,) = random_configurations(loaded.model, 1, name, count, "full rank", spread=0.5)
    rigid = Rigid(base, q)
    case = replace(base.case, robot=loaded, supports=supports)
    oracles = [ImpactOracle(replace(case, compliance=base.compliance / k)) for k in (1, 2, 4)]
    M, n = oracles[0].at(q).M, oracles[0].n
    held = np.linalg.svd(np.linalg.solve(np.linalg.cholesky(M), rigid.Js.T), compute_uv=False)[-1] ** 2
    all_of_them = [oracle.quantities(q) for oracle in oracles]
    off, done = all_of_them[0].jump - rigid.jumps @ n, rigid.free @ n - rigid.jumps @ n
    share = base.compliance / (held + base.compliance)
    assert share < 0.02
    assert 0 < np.sqrt(off @ M @ off) <= share * np.sqrt(done @ M @ done) * (1 + 1e-9)
    # The extrapolation removes the errors of first and second order in ε/σ.  The error of third order remains, and
    # each matrix inverse increases the error.
    tolerance = 20 * share**3 + 1e-10
    expected = rigid.quantities(q)
    for what in ("H", "G", "V", "S", "jump", "support_impulse", "ellipsoid"):
        _near(_extrapolated([getattr(o, what) for o in all_of_them]), expected[what], tolerance, what)
    gradients = _extrapolated([oracle.gradient_H(q) for oracle in oracles])
    differences = central_gradient(lambda at: rigid.quantities(at)["H"], loaded.model, q, 1e-3)
    _near(gradients, differences, tolerance + 1e-8, "∇H")


def _extrapolated(values: list[object]) -> Vector:
    """Extrapolate values at ε, ε/2 and ε/4 to zero compliance (Richardson)."""
    one, half, quarter = (np.asarray(v, dtype=float) for v in values)
    return np.asarray(one / 3 - 2 * half + 8 * quarter / 3)


def _near(values: Vector, expected: object, tolerance: float, what: str) -> None:
    error = size(values - np.asarray(expected)) / size(expected)
    assert error <= tolerance, f"{what}: relative error {error:.1e} above {tolerance:.1e}"


def test_decimal_elimination_by_its_residual() -> None:
    """At the posture with the largest condition number, the reference has ``K K⁻¹ = 1`` to forty digits."""
    x = bounded("solo8", "straight", 1e-9)
    residual = x.K @ x.inverse - exact(np.eye(len(x.K)))
    assert abs(residual).max() < Decimal("1e-40")


# ---- largest permitted stiffness of feet --------------------------------------------------------------------------


def test_the_stiffest_feet_pass_every_check(tmp_path: Path) -> None:
    """``codegen``, the loader and ``verify`` accept the stiffest feet that ``problem.toml`` accepts."""
    stiffest = objective("bolt", least_compliance(robot("bolt")) * robot("bolt").mass)
    written = export(stiffest, tmp_path)
    assert written.compiled and written.agreement is not None
    ImpactGradient.load(tmp_path)
    assert verify(stiffest, samples=3).passed


@pytest.mark.parametrize("share", [0.99, 0.0, -1.0, np.nan, np.inf])
def test_stiffer_feet_are_refused(share: float) -> None:
    compliance = share * least_compliance(robot("bolt"))
    with pytest.raises(InputError, match=r"at least 7\.98e-07"):
        resolve(ImpactSettings(robot="bolt", normal=(1, 0, 0), support_compliance=compliance))
