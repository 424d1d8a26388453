"""``H, G, V, S, E, Λ_c``, gradients and lifted form, by three methods: symbolic, Pinocchio, finite differences."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import replace

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest

from impact_posture.config.problem_settings import ObjectiveKind
from impact_posture.dynamics.tree import Tree
from impact_posture.impact.impact_case import ImpactCase
from impact_posture.impact.impact_contact import ImpactContact
from impact_posture.impact.metric import Metric, build_metric
from impact_posture.impact.quantities.impact_kernel import ImpactKernel
from impact_posture.impact.quantities.impact_oracle import ImpactOracle
from impact_posture.impact.support_compliance import default_compliance
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.robot.robot import Robot
from impact_posture.robot.robot_spec import Support
from tests.support.helpers import NAMES, Vector, assert_close, contact_frame, random_configurations, rng, robot, unit
from tests.support.pinocchio_values import central_gradient, frame_jacobian, frame_placement, mass_matrix

KINDS: tuple[ObjectiveKind, ...] = ("impulse", "speed", "sticking", "energy")
OFFSET = (0.01, -0.02, 0.03)
VALUE, GRADIENT = 1e-9, 1e-6
# Best step of finite differences for values with an accuracy of 1e-11 (stiff feet).  The derivative then has a
# relative error of 1e-9.
STEP = 2e-4


def supports_of(loaded: Robot) -> tuple[Support, ...]:
    """Return the robot's feet, or a point support in the kinematic chain of a robot without feet."""
    if loaded.spec.supports:
        return loaded.spec.supports
    joint = loaded.model.frames[loaded.frame_id(contact_frame(loaded))].parentJoint
    path = list(loaded.model.supports[joint])[1:]
    braced = path[len(path) // 3]
    frame = next(f for f in loaded.model.frames if f.parentJoint == braced and f.type == pin.FrameType.BODY)
    return (Support(str(frame.name), "point", (0.02, 0.03, -0.01)),)


# Robots tested with all combinations, and robots tested with three combinations.  The robots cover continuous and
# prismatic joints, branches and feet.  test_dynamics.py tests the dynamics of every known robot.
WHOLE = ("solo8", "panda", "tilthex_arm")
SOME = (*WHOLE, "kinova", "tiago", "talos", "anymal_kinova", "borinot", "bolt", "ur5")


def combinations(name: str) -> Iterator[tuple[Robot, ImpactContact, Metric, tuple[Support, ...]]]:
    """Yield combinations of metric, supports and normal frame: all twelve, or three with different metrics."""
    loaded, generator = robot(name), rng(name, "combinations")
    weights = tuple(float(w) for w in generator.uniform(0.5, 2.0, loaded.nv))
    metrics = (Metric(), Metric("kinetic"), Metric("weighted", weights))
    pairs = list(itertools.product(((), supports_of(loaded)), ("world", "contact")))
    for (i, metric), (k, (supports, axes)) in itertools.product(enumerate(metrics), enumerate(pairs)):
        if name in WHOLE or k == (NAMES.index(name) + i) % 4:
            normal = unit(generator)
            yield loaded, ImpactContact(contact_frame(loaded), tuple(normal), OFFSET, axes, 3.0), metric, supports


def describe(contact: ImpactContact, metric: Metric, supports: tuple[Support, ...]) -> str:
    return f"{metric.kind}, normal in {contact.normal_frame}, {len(supports)} supports"


@pytest.mark.long(but=("solo8", "tilthex_arm", "kinova", "anymal_kinova", "bolt", "ur5", "borinot", "tiago"))
@pytest.mark.parametrize("name", SOME)
def test_symbolic_oracle_and_differences_agree(name: str) -> None:
    for loaded, contact, metric, supports in combinations(name):
        compliance = default_compliance(loaded)
        q, n = ca.SX.sym("q", loaded.nq), ca.SX.sym("n", 3)
        k = ImpactKernel(ImpactCase(loaded, contact, metric, supports, compliance), q, n)
        kernel_fun = ca.Function(
            "kernel", [q, n],
            [k.H, k.G, k.V, k.S, k.E, k.ellipsoid, k.mobility, k.jump.a, k.world_normal,
             k.grad_H, k.grad_G, k.grad_V, k.grad_S, k.grad_E],
        )  # fmt: skip
        oracle = ImpactOracle(ImpactCase(loaded, contact, metric, supports, compliance))

        def values(at: Vector, oracle: ImpactOracle = oracle) -> Vector:
            o = oracle.quantities(at)
            assert o.S is not None
            return np.array([o.H, o.G, o.V, o.S, o.E])

        where = describe(contact, metric, supports)
        (at,) = random_configurations(loaded.model, 1, name, where)
        out = [np.array(value) for value in kernel_fun(at, contact.normal)]
        o = oracle.quantities(at)
        expected = [o.H, o.G, o.V, o.S, o.E, o.ellipsoid, o.mobility, o.jump, o.normal]
        words = ["H", "G", "V", "S", "E", "ellipsoid", "mobility", "jump", "normal"]
        for what, value, numbers in zip(words, out, expected, strict=False):
            assert_close(value, np.asarray(numbers), VALUE, f"{what} ({where})")
        gradients = dict(zip("HGVSE", (g.reshape(-1) for g in out[9:]), strict=True))
        differences = dict(zip("HGVSE", central_gradient(values, loaded.model, at, STEP), strict=True))
        for what, gradient in gradients.items():
            assert_close(gradient, differences[what], GRADIENT, f"grad {what} ({where})")
        for what, gradient in {
            "H": oracle.gradient_H(at), "G": oracle.gradient_G(at), "S": oracle.gradient_S(at)
        }.items():  # fmt: skip
            assert_close(gradient, differences[what], GRADIENT, f"oracle's grad {what} ({where})")


@pytest.mark.parametrize("name", NAMES)
def test_oracle_by_its_definition(name: str) -> None:
    """Compute all quantities with explicit inverses of Pinocchio's matrices."""
    for loaded, contact, metric, supports in combinations(name):
        if metric.kind == "weighted":
            continue
        model, where = loaded.model, describe(contact, metric, supports)
        (q,) = random_configurations(model, 1, name, where, "definition")
        frame, epsilon = loaded.frame_id(contact.frame), default_compliance(loaded)
        M, J = mass_matrix(model, q), frame_jacobian(model, q, frame, contact.offset)[:3]
        held = M.copy()
        for support in supports:
            J_s = frame_jacobian(model, q, loaded.frame_id(support.frame), support.offset)[: support.rows]
            held += J_s.T @ J_s / epsilon
        n = np.array(contact.normal)
        if contact.normal_frame == "contact":
            n = frame_placement(model, q, frame).rotation @ n
        # The fingers of panda are coupled, so ν = C ν.  The metric does not count the follower.
        C, followers = loaded.coupling_matrix, np.diag(1.0 * loaded.followers)
        W = M if metric.kind == "kinetic" else np.eye(loaded.nv) - followers
        A = C @ np.linalg.solve(C.T @ held @ C + followers, C.T @ J.T)
        ellipsoid, mobility = A.T @ W @ A, J @ A
        s = np.linalg.solve(mobility, n)
        G = n @ mobility @ n
        o = ImpactOracle(ImpactCase(loaded, contact, metric, supports, epsilon)).quantities(q)
        # Computing M + JᵀJ/ε loses digits that the KKT system of the oracle preserves.
        tolerance = 1e-8 if supports else 1e-10
        assert o.S is not None
        for what, value, expected in (
            ("H", o.H, n @ ellipsoid @ n), ("G", o.G, G), ("V", o.V, n @ ellipsoid @ n / G**2),
            ("S", o.S, s @ ellipsoid @ s), ("E", o.E, 0.5 / G),
        ):  # fmt: skip
            assert_close(value, expected, tolerance, f"{what} ({where})")
        assert_close(o.ellipsoid, ellipsoid, tolerance, f"ellipsoid ({where})")


@pytest.mark.long(but=("solo8", "talos", "kinova", "bolt", "borinot"))
@pytest.mark.parametrize("name", SOME)
def test_lifted_form(name: str) -> None:
    """The initial guess is an isolated solution of the equations of the lifted form, and gives the oracle's value."""
    for k, (loaded, contact, metric, supports) in enumerate(combinations(name)):
        # Robots in WHOLE are tested with every objective kind for each combination, other robots with one kind.
        for kind in KINDS if name in WHOLE else [KINDS[(NAMES.index(name) + k) % len(KINDS)]]:
            objective = WorstCaseObjective(loaded, contact, metric, kind, supports)
            q, n = ca.SX.sym("q", loaded.nq), ca.SX.sym("n", 3)
            lifted = objective.lift(Tree(loaded.model, q), n, ca.SX(1))
            assert lifted.variables.shape == lifted.residual.shape
            lifted_fun = ca.Function("lifted", [q, n, lifted.variables], [lifted.residual, lifted.value])
            where = f"{kind}, {describe(contact, metric, supports)}"
            (at,) = random_configurations(loaded.model, 1, name, where)
            guess = objective.guess(at, 1.0).values
            residual, value = (np.array(o) for o in lifted_fun(at, contact.normal, guess))
            assert np.abs(residual).max() < 1e-9 * max(1.0, np.abs(guess).max()), where
            assert_close(value, objective.value(at), VALUE, where)
            if metric.kind == "euclidean":
                system = ca.Function("J", [q, n, lifted.variables], [ca.jacobian(lifted.residual, lifted.variables)])
                assert np.linalg.matrix_rank(np.array(system(at, contact.normal, guess)), tol=1e-12) == guess.size


@pytest.mark.long(
    but=(
        "solo8-sticking",
        "solo8-coulomb",
        "solo8-impulse",
        "panda-effective-mass",
        "panda-speed",
        "tilthex_arm-energy",
        "tilthex_arm-sticking",
        "tilthex_arm-coulomb",
    )
)
@pytest.mark.parametrize("kind", (*KINDS, "coulomb", "effective-mass"))
@pytest.mark.parametrize("name", WHOLE)
def test_objective_functions_agree_with_its_own_numbers(name: str, kind: ObjectiveKind) -> None:
    all_of_them = list(combinations(name))
    # Four of the twelve combinations cover all metrics, both frames, and cases with and without supports.  The
    # remaining combinations are left out, because CasADi's search for common subexpressions is slow.
    for result, contact, metric, supports in (all_of_them[k] for k in (0, 5, 7, 10)):
        objective = WorstCaseObjective(result, contact, metric, kind, supports)
        where = describe(contact, metric, supports)
        (q,) = random_configurations(result.model, 1, name, kind, where)
        value, gradient = (np.array(o) for o in objective.gradient_fun()(q, contact.normal))
        assert_close(value, objective.value(q), VALUE, f"value ({where})")
        if metric.kind == "euclidean":
            assert_close(objective.value_fun()(q, contact.normal), objective.value(q), VALUE, f"value_fun ({where})")
        # With stiff feet, the accuracy decreases if the contact can hardly move, because its inverse mobility is
        # large.
        agreed = GRADIENT if supports else 1e-8
        assert_close(gradient, objective.gradient(q), agreed, f"gradient ({where})")
        differences = central_gradient(lambda at, o=objective: o.value(at), result.model, q, STEP)
        assert_close(objective.gradient(q), differences, GRADIENT, f"differences ({where})")
        if kind == "impulse":
            assert objective.scale == 9.0
            assert_close(value, 9.0 * objective.oracle.quantities(q).H, VALUE, f"bound squared ({where})")
        assert objective.name == kind
        assert objective.units


def test_an_oracle_that_returns_to_a_posture_has_the_same_numbers() -> None:
    """The test visits more postures than the cache of the oracle can contain."""
    talos = robot("talos")
    contact = ImpactContact("gripper_right_base_link", normal=(0, 0.6, 0.8))
    postures = random_configurations(talos.model, 36, "returns", spread=0.2)
    kept = WorstCaseObjective(talos, contact, kind="speed", supports=talos.spec.supports)
    for k in [*range(36), 35, 34, 0, 0, 35, 10, 11]:
        q = postures[k]
        fresh = WorstCaseObjective(talos, contact, kind="speed", supports=kept.supports)
        assert kept.value(q) == fresh.value(q)
        if k % 5 == 0:
            np.testing.assert_array_equal(kept.gradient(q), fresh.gradient(q))
            at = [o.oracle.numeric.placement(o.oracle.point).translation for o in (kept, fresh)]
            np.testing.assert_array_equal(*at)


@pytest.mark.parametrize(("name", "frame"), [("panda", "panda_hand"), ("solo8", "base_link")])
def test_degenerate_combinations_have_warnings(name: str, frame: str) -> None:
    loaded = robot(name)
    contact, feet = ImpactContact(frame, (1.0, 0.0, 0.2)), loaded.spec.supports
    impulse = WorstCaseObjective(loaded, contact, Metric("kinetic"), "impulse", feet)
    at = impulse.oracle.quantities(loaded.posture())
    assert abs(at.H - at.G) / at.G < 1e-4
    speed = replace(impulse, kind="speed")
    assert "effective mass" in impulse.warnings[0] and "opposite" in speed.warnings[0]
    assert replace(impulse, kind="sticking").warnings == replace(speed, metric=Metric()).warnings == ()


def test_velocity_limit_weights_are_inverse_squares() -> None:
    loaded = robot("panda")
    metric = build_metric(loaded, "weighted", "velocity-limits")
    np.testing.assert_allclose(metric.diagonal(loaded.nv), 1 / np.array(loaded.model.upperVelocityLimit) ** 2)
    floating = build_metric(robot("solo8"), "weighted", "velocity-limits").diagonal(14)
    np.testing.assert_array_equal(floating[:6], np.ones(6))
    np.testing.assert_allclose(floating[6:], 80.0**-2)
