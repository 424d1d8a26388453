"""Stick or slip at one contact: Coulomb's law, its limit cases, and gradients by finite differences."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from impact_posture.dynamics.tree import Tree
from impact_posture.errors import InputError, MetricError
from impact_posture.impact.evaluation.evaluation import evaluate
from impact_posture.impact.friction.coulomb_impact import coulomb_direction, coulomb_gradient, coulomb_impact
from impact_posture.impact.impact_contact import ImpactContact
from impact_posture.impact.metric import Metric
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.robot.robot import Robot
from tests.impact.test_impact import SOME, WHOLE, combinations, describe
from tests.support.arms import TIP, X, Y, Z, arm
from tests.support.helpers import Vector, assert_close, random_configurations, rng, unit
from tests.support.pinocchio_values import central_gradient

FRICTIONS = (0.0, 0.1, 0.5, 2.0)
STEP = 2e-4


def required(B: Vector, n: Vector) -> float:
    """Return the least friction at which a point of mobility B sticks: tangential over normal part of ``B⁻¹n``."""
    s = np.linalg.solve(B, n)
    return float(np.linalg.norm(s - (n @ s) * n) / (n @ s))


def assert_coulomb(B: Vector, n: Vector, friction: float, impulse: Vector, tolerance: float) -> None:
    """Check Coulomb's law for the plastic impact of a point with approach velocity ``−n``."""
    after = B @ impulse - n
    normal, tangential = float(n @ impulse), impulse - (n @ impulse) * n
    size, slip = float(np.linalg.norm(tangential)), float(np.linalg.norm(after))
    # Scale of the rounding errors of the velocity after the impact.
    scale = float(np.linalg.norm(B) * np.linalg.norm(impulse)) + 1
    assert abs(n @ after) <= tolerance * scale
    assert normal > 0 and size <= friction * normal + tolerance * (1 + normal + size)
    if slip > tolerance * scale:
        assert abs(size - friction * normal) <= tolerance * (1 + normal + size)
        opposed = np.linalg.norm(tangential * slip + after * friction * normal)
        assert opposed <= tolerance * scale * (1 + normal + size)
    # The impact does not add energy.  The energy change is the impulse times the mean velocity of the point.
    assert impulse @ (after - n) / 2 <= tolerance * scale


@cache
def _direction() -> ca.Function:
    B, n, friction = ca.SX.sym("B", 3, 3), ca.SX.sym("n", 3), ca.SX.sym("mu")
    return ca.Function("direction", [B, n, friction], [coulomb_direction(B, n, friction)[0]])


@given(st.integers(0, 2**32 - 1), st.lists(st.floats(-5, 0), min_size=3, max_size=3), st.floats(-10, 0.3))
def test_a_fixed_number_of_steps_solves_the_secular_equation_to_rounding(
    seed: int, powers: list[float], share: float
) -> None:
    """Random B with condition up to 1e5; friction is 1e-10 to 2 times the least value at which the point sticks."""
    generator = np.random.default_rng(seed)
    n, Q = unit(generator), np.linalg.qr(generator.normal(size=(3, 3)))[0]
    B = Q @ np.diag(10.0 ** np.array(powers)) @ Q.T
    B = (B + B.T) / 2
    friction = required(B, n) * 10**share
    assume(friction > 1e-12)
    direction = np.array(_direction()(B, n, friction)).ravel()
    tolerance = 1e-15 * np.linalg.cond(B)
    assert_coulomb(B, n, friction, direction / (n @ B @ direction), tolerance)
    if share > 0:
        s = np.linalg.solve(B, n)
        assert_close(direction, s / (n @ s), tolerance, "sticking")


@given(st.integers(0, 2**32 - 1))
def test_kinetic_energy_rises_with_friction_from_frictionless_to_sticking(seed: int) -> None:
    """For W = M and unit approach speed, the value is ``p B p``: 1/G without friction, ``nB⁻¹n`` for sticking."""
    generator = np.random.default_rng(seed)
    n, A = unit(generator), generator.normal(size=(3, 3))
    B = A @ A.T + 1e-3 * np.eye(3)
    shares = np.linspace(0.01, 1.2, 8) * required(B, n)
    impulses = [np.array(_direction()(B, n, mu)).ravel() for mu in shares]
    values = [p @ B @ p / (n @ B @ p) ** 2 for p in impulses]
    bounds = [1 / (n @ B @ n), *values, n @ np.linalg.solve(B, n)]
    assert np.all(np.diff(bounds) >= -1e-9 * bounds[-1])


@pytest.mark.long(but=("solo8", "talos", "kinova", "tiago", "anymal_kinova", "borinot", "bolt", "ur5"))
@pytest.mark.parametrize("name", SOME)
def test_value_and_gradient_agree_three_ways(name: str) -> None:
    """Pinocchio, the symbolic kernel and finite differences agree for any friction, metric and supports."""
    for index, (loaded, contact, metric, supports) in enumerate(combinations(name)):
        friction = FRICTIONS[index % len(FRICTIONS)]
        objective = WorstCaseObjective(loaded, replace(contact, friction=friction), metric, "coulomb", supports)
        where = f"μ = {friction}, {describe(contact, metric, supports)}"
        (q,) = random_configurations(loaded.model, 1, name, where)
        oracle, value, gradient = objective.oracle, objective.value(q), objective.gradient(q)
        o, impact = oracle.quantities(q), coulomb_impact(oracle, q)
        assert o.S is not None
        assert_coulomb(o.mobility, o.normal, friction, impact.impulse, 1e-8)
        assert_close(oracle.at(q).solve(oracle.J.T @ impact.impulse), impact.jump, 1e-8, where)
        limit = o.S if impact.sticks else o.V if friction == 0 else None
        # Both implementations solve linear systems with M, but in different orders, so rounding differs.
        rounding = 4 * np.finfo(float).eps * np.linalg.cond(oracle.M)
        assert limit is None or abs(value / limit - 1) < rounding, where
        differences = central_gradient(objective.value, loaded.model, q, STEP)
        assert_close(gradient, differences, 1e-6, f"differences ({where})", value)
        if name in WHOLE or index == 0:
            numbers = [np.array(x).ravel() for x in objective.gradient_fun()(q, contact.normal)]
            # Stiff feet reduce the number of accurate digits.
            assert_close(numbers[0], value, 1e-9, where)
            assert_close(numbers[1], gradient, 1e-6 if supports else 1e-9, where, value)


def hung(loaded: Robot, normal: tuple[float, float, float], friction: float) -> WorstCaseObjective:
    return WorstCaseObjective(loaded, ImpactContact(TIP, normal, friction=friction), Metric(), "coulomb", ())


@pytest.mark.parametrize("friction", (0.0, 0.05, 0.5, 5.0))
def test_planar_robots(friction: float) -> None:
    """The tip cannot move across the plane, so JM⁻¹Jᵀ is singular in every posture."""
    loaded = arm([Y, Y, Y], [0.3, 0.7, -0.5], floating=False)
    for normal in ((0.0, 0.0, 1.0), (0.6, 0.0, 0.8), (-1.0, 0.0, 0.0)):
        objective, contact = hung(loaded, normal, friction), np.array(normal)
        for q in random_configurations(loaded.model, 3, friction, normal):
            impact, o = coulomb_impact(objective.oracle, q), objective.oracle.quantities(q)
            assert_coulomb(o.mobility, o.normal, friction, impact.impulse, 1e-9)
            assert abs(impact.impulse[1]) < 1e-9
            value, gradient = objective.value(q), objective.gradient(q)
            assert_close(gradient, central_gradient(objective.value, loaded.model, q, STEP), 1e-6, "gradient", value)
            numbers = [np.array(x).ravel() for x in objective.gradient_fun()(q, contact)]
            assert_close(numbers[0], value, 1e-10, "value")
            assert_close(numbers[1], gradient, 1e-8, "symbolic gradient", value)
            assert o.S is not None
            assert not impact.sticks or abs(value / o.S - 1) < 1e-12


def test_a_point_on_a_line_slides_or_jams() -> None:
    """With one hinge, the tip moves in one direction, oblique to the normal; enough friction prevents the motion."""
    loaded = arm([Y], [0.0], floating=False)
    q, normal = np.array([0.4]), (0.0, 0.0, 1.0)
    slides, jams = hung(loaded, normal, 0.1), hung(loaded, normal, 5.0)
    impact, o = coulomb_impact(slides.oracle, q), slides.oracle.quantities(q)
    assert not impact.sticks and o.S is None
    assert_coulomb(o.mobility, o.normal, 0.1, impact.impulse, 1e-12)
    value, gradient = (np.array(x).ravel() for x in slides.gradient_fun()(q, normal))
    assert_close(value, slides.value(q), 1e-12, "value")
    assert_close(gradient, central_gradient(slides.value, loaded.model, q, STEP), 1e-7, "gradient")
    with pytest.raises(MetricError, match="S does not exist"):
        jams.value(q)
    assert evaluate(jams, q).coulomb is None


def test_a_blocked_contact_has_no_value() -> None:
    loaded = arm([Y, Y], [0.3, 0.4], floating=False)
    with pytest.raises(MetricError, match="S does not exist"):
        hung(loaded, (0.0, 1.0, 0.0), 0.5).value(loaded.posture())


def test_a_point_that_moves_along_the_normal_alone_meets_no_friction() -> None:
    model = pin.Model()
    joint = model.addJoint(0, pin.JointModelPZ(), pin.SE3.Identity(), "lift")
    model.appendBodyToJoint(joint, pin.Inertia.Random(), pin.SE3.Identity())
    model.addFrame(pin.Frame(TIP, joint, 0, pin.SE3.Identity(), pin.FrameType.BODY))
    loaded = replace(arm([Y], [0.0], floating=False), model=model, postures={"home": np.zeros(1)})
    objective = hung(loaded, (0.0, 0.0, 1.0), 0.5)
    o = objective.oracle.quantities(np.zeros(1))
    assert objective.value(np.zeros(1)) == pytest.approx(o.V, rel=1e-14)
    value, gradient = objective.gradient_fun()(np.zeros(1), (0, 0, 1))
    assert float(value) == pytest.approx(o.V, rel=1e-14) and float(gradient) == 0.0


@pytest.mark.parametrize("metric", ("euclidean", "kinetic"))
def test_the_value_is_continuous_at_the_switch_and_has_one_gradient_on_each_side(metric: str) -> None:
    loaded = arm([Z, Y, Y, X, Y], [0.3, -0.8, 1.2, -0.5, 0.4], floating=False)
    for seed in range(4):
        generator = rng("switch", seed)
        objective = hung(loaded, tuple(unit(generator)), 0.0)
        objective = replace(objective, metric=Metric(metric))  # type: ignore[arg-type]
        q = np.array(pin.integrate(loaded.model, loaded.posture(), generator.normal(size=loaded.nv)))
        o = objective.oracle.quantities(q)
        friction = required(o.mobility, o.normal)
        objective = replace(objective, contact=replace(objective.contact, friction=friction * (1 + 1e-12)))
        stuck = coulomb_impact(objective.oracle, q)
        slid = coulomb_impact(objective.oracle, q, other=True)
        assert stuck.sticks and not slid.sticks
        assert_close(slid.jump, stuck.jump, 1e-9, "jump")
        sides = [coulomb_gradient(objective.oracle, q, impact) for impact in (stuck, slid)]
        outward = central_gradient(
            lambda at, o=objective.oracle: required(o.quantities(at).mobility, o.n), loaded.model, q, 1e-5
        )
        step = 1e-6 * outward / (outward @ outward)
        for sign, side in zip((-1, 1), sides, strict=True):
            there = np.array(pin.integrate(loaded.model, q, sign * step))
            assert coulomb_impact(objective.oracle, there).sticks == (sign < 0)
            assert_close(objective.gradient(there), side, 1e-4, f"side {sign}")
        # For W = M, the slope of the objective always decreases at the posture where the contact begins to slip.
        assert metric == "euclidean" or (sides[1] - sides[0]) @ outward < 0
        exported = np.array(objective.gradient_fun()(q, objective.contact.normal)[1]).ravel()
        assert_close(exported, sides[0], 1e-6, "at the switch the gradient of sticking")


@pytest.mark.parametrize("name", WHOLE)
def test_lifted_form_holds_at_its_guess(name: str) -> None:
    for index, (loaded, contact, metric, supports) in enumerate(combinations(name)):
        friction = FRICTIONS[index % len(FRICTIONS)]
        objective = WorstCaseObjective(loaded, replace(contact, friction=friction), metric, "coulomb", supports)
        q, n = ca.SX.sym("q", loaded.nq), ca.SX.sym("n", 3)
        lifted = objective.lift(Tree(loaded.model, q), n, ca.SX(1))
        outputs = [lifted.residual, lifted.value, lifted.inequalities]
        lifted_fun = ca.Function("lifted", [q, n, lifted.variables], outputs)
        (at,) = random_configurations(loaded.model, 1, name, index)
        guess = objective.guess(at, 1.0)
        residual, value, rows = (np.array(x) for x in lifted_fun(at, contact.normal, guess.values))
        assert np.abs(residual).max() < 1e-8 * max(1.0, np.abs(guess.values).max())
        assert rows.max() < 1e-12 and (guess.values >= guess.lower).all()
        assert_close(value, objective.value(at), 1e-8, "value")


def test_impossible_frictions_are_refused() -> None:
    for value in (-0.1, float("nan"), float("inf")):
        with pytest.raises(InputError, match="friction: "):
            ImpactContact("panda_hand", (0, 0, 1), friction=value)
