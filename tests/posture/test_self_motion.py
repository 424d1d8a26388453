"""Self-motion manifolds of planar arms with known topology, and of catalogue robots."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

import impact_posture as ip
from impact_posture.dynamics.numeric import Numeric
from impact_posture.errors import InputError
from impact_posture.posture.constraints.posture_distance import WithinDistance, distance
from impact_posture.posture.formulation.problem_file import prepare
from impact_posture.posture.manifold.constraint_manifold import ConstraintManifold
from impact_posture.posture.manifold.feasible_start import random_posture
from impact_posture.posture.manifold.optimality_bound import bound_objective
from impact_posture.posture.manifold.self_motion import SelfMotion, map_self_motion
from impact_posture.posture.program.constrained_problem import ConstrainedProblem, equality_jacobian
from tests.support.arms import TIP, Y, Z, arm
from tests.support.settings import make_settings

Vector = NDArray[np.float64]


def planar(rods: list[float], joints: list[float]) -> ConstrainedProblem:
    """Return a problem with hinges about y in series that hold the position of the tip."""
    robot = arm([Y] * len(rods), joints, floating=False, rods=[(0, 0, -rod) for rod in rods])
    objective = ip.ImpactObjective(robot, ip.ImpactContact(TIP, (0.3, 0, 1)))
    return ip.PostureProblem(objective, contact_pose="position").problem


def mapped(problem: ConstrainedProblem, dimension: int, patience: int = 100) -> SelfMotion:
    manifold = ConstraintManifold(problem)
    return map_self_motion(manifold, dimension, np.zeros((0, manifold.chart.nx)), patience=patience)


def catalogue(robot: str, **more: object) -> ConstrainedProblem:
    return prepare(make_settings({"robot": robot, "normal": (0, 0, 1), **more})).problem


def drawn(manifold: ConstraintManifold, count: int, seed: int) -> Vector:
    rng = np.random.default_rng(seed)
    postures = [random_posture(manifold.problem, manifold.chart, rng) for _ in range(count)]
    return np.array([manifold.chart.to_x(q) for q in postures])


def reach(rods: list[float], joints: list[float]) -> float:
    angles = np.cumsum(joints)
    return float(np.hypot((rods * np.sin(angles)).sum(), (rods * np.cos(angles)).sum()))


def scan(problem: ConstrainedProblem, rods: list[float], count: int) -> Vector:
    """Return the objective of a planar arm by brute force: first hinges on a grid, last two hinges solved."""
    model, q = problem.robot.model, problem.given
    tip = model.getFrameId(TIP)
    data = model.createData()
    pin.framesForwardKinematics(model, data, q)
    target = np.array(data.oMf[tip].translation)[[0, 2]]
    grid = np.linspace(-np.pi, np.pi, count, endpoint=False)
    values = []
    for first in np.stack(np.meshgrid(*[grid] * (len(rods) - 2)), axis=-1).reshape(-1, len(rods) - 2):
        angles = np.cumsum(first)
        # At zero angle, a rod hangs straight down.  Rotated about y, it points along (−sin, −cos).
        elbow = -np.array([np.sin(angles), np.cos(angles)]) @ rods[: len(first)]
        gap = target - elbow
        length = np.hypot(*gap)
        cosine = (length**2 - rods[-2] ** 2 - rods[-1] ** 2) / (2 * rods[-2] * rods[-1])
        if abs(cosine) <= 1:
            for bend in (np.arccos(cosine), -np.arccos(cosine)):
                side = np.arctan2(rods[-1] * np.sin(bend), rods[-2] + rods[-1] * np.cos(bend))
                heading = np.arctan2(-gap[0], -gap[1]) - side
                values.append([*first, heading - angles[-1], bend])
    wrapped = (np.array(values) + np.pi) % (2 * np.pi) - np.pi
    manifold = ConstraintManifold(problem)
    assert np.abs(manifold.equalities(wrapped[:20])[0]).max() < 1e-12
    return manifold.objective(wrapped)[0]


LENGTHS = st.floats(0.1, 0.5)
ANGLES = st.floats(-2.5, 2.5)


@settings(max_examples=12, deadline=None)
@given(st.lists(LENGTHS, min_size=3, max_size=3), st.lists(ANGLES, min_size=3, max_size=3))
def test_a_planar_arm_of_three_hinges_has_the_components_of_its_four_bar_linkage(rods, joints):
    # Grashof: a four-bar linkage has two components if shortest plus longest bar is below the sum of the other two.
    bars = np.sort([*rods, reach(rods, joints)])
    margin = bars[1] + bars[2] - bars[0] - bars[3]
    if abs(margin) < 0.02 or bars[0] < 0.02 or bars[3] > bars[:3].sum() - 0.02:
        return
    problem = planar(rods, joints)
    motion = mapped(problem, 1)
    assert len(motion.components) == (2 if margin > 0 else 1)
    assert all(component.closed for component in motion.components)
    bound = bound_objective(motion, np.inf, gap=0.005)
    truth = scan(problem, rods, 2000).min()
    assert bound.finished and bound.gap <= 0.005 + 1e-9
    assert bound.lower <= truth * (1 + 1e-9)
    # The value `bound.best` belongs to a posture, so the value is not below the optimum.  The scan on a grid may miss
    # the posture of `bound.best`.
    assert bound.best <= truth * 1.0051
    at = motion.manifold.project(bound.x[None])
    assert at.converged[0]
    assert bound.best == pytest.approx(problem.objective.value(motion.manifold.to_q(at.x[0])), rel=1e-9)


def test_a_planar_arm_of_four_hinges_is_covered_and_its_bound_holds():
    rods = [0.3, 0.3, 0.3, 0.2]
    problem = planar(rods, [0.3, 0.9, 0.7, 0.5])
    motion = mapped(problem, 2)
    (component,) = motion.components
    manifold = motion.manifold
    points = manifold.embed(manifold.project(drawn(manifold, 300, seed=1)).x)
    nodes = manifold.embed(component.x)
    nearest = np.array([np.linalg.norm(nodes - point, axis=1).min() for point in points])
    assert (nearest <= component.radius[0]).all()
    bound = bound_objective(motion, np.inf)
    truth = scan(problem, rods, 150).min()
    assert bound.finished
    assert bound.lower <= truth
    assert bound.best == pytest.approx(truth, rel=0.011)


def test_three_position_joints_on_a_base_that_flies_are_followed_from_limit_to_limit():
    motion = mapped(catalogue("tilthex_arm"), 1)
    (component,) = motion.components
    assert component.ends == ("limit", "limit")
    manifold = motion.manifold
    for end in component.x[[0, -1]]:
        assert np.minimum(end - manifold.lower, manifold.upper - end).min() == pytest.approx(0, abs=1e-5)
    numeric = Numeric(manifold.problem.robot.model)
    for x in component.x[::10]:
        assert max(np.abs(v).max() for v in manifold.problem.violations(numeric.at(manifold.to_q(x)))) < 1e-8
    # Path length is measured in the tangent space of Pinocchio.
    steps = [
        np.linalg.norm(pin.difference(manifold.problem.robot.model, manifold.to_q(a), manifold.to_q(b)))
        for a, b in zip(component.x[:-1], component.x[1:], strict=True)
    ]
    np.testing.assert_allclose(np.diff(component.s), steps, rtol=2e-3)


@pytest.mark.long(but=("panda-3", "ur5-8"))
@pytest.mark.parametrize(("robot", "components"), [("panda", 3), ("ur5", 8), ("xarm7", 4)])
def test_arms_of_the_catalogue_have_all_their_components_and_no_random_posture_is_better_than_the_bound(
    robot, components
):
    motion = mapped(catalogue(robot), 1, patience=300)
    assert len(motion.components) == components
    manifold = motion.manifold
    there = manifold.project(drawn(manifold, 400, seed=7), within=True)
    x = there.x[there.converged]
    assert len(x) > 50
    assert (motion.component_of(x) >= 0).all()
    bound = bound_objective(motion, np.inf)
    assert bound.finished and bound.gap <= 0.01
    assert bound.lower <= manifold.objective(x)[0].min()


@pytest.mark.parametrize("robot", ["tilthex_arm", "panda", "solo12"])
def test_a_batch_has_the_numbers_of_pinocchio(robot):
    problem = catalogue(robot)
    manifold, rng = ConstraintManifold(problem), np.random.default_rng(3)
    q = [random_posture(problem, manifold.chart, rng, problem.given) for _ in range(4)]
    x = manifold.project(np.array([manifold.chart.to_x(one) for one in q])).x
    values, gradients = manifold.objective(x)
    numeric = Numeric(problem.robot.model)
    for k, one in enumerate(x):
        posture = manifold.to_q(one)
        assert values[k] == pytest.approx(problem.objective.value(posture), rel=1e-9)
        gradient = problem.objective.gradient(posture)
        np.testing.assert_allclose(gradients[k], gradient, atol=1e-8 * np.abs(gradient).max())
        # The Jacobians of the manifold and of the problem have the same null space.
        own = manifold.equalities(one[None])[1][0]
        theirs = equality_jacobian(problem, numeric.at(posture))
        free = np.linalg.svd(theirs)[2][np.linalg.matrix_rank(theirs, tol=1e-7) :]
        np.testing.assert_allclose(own @ free.T, 0, atol=1e-7)
        step = 1e-6 * rng.normal(size=problem.robot.nv)
        moved = manifold.to_q(manifold.move(one[None], step[None])[0])
        np.testing.assert_allclose(pin.difference(problem.robot.model, posture, moved), step, atol=1e-10)


def test_points_of_the_embedding_are_as_far_apart_as_the_postures():
    problem = catalogue("tilthex_arm")
    manifold = ConstraintManifold(problem)
    x = drawn(manifold, 20, seed=5)
    steps = 0.01 * np.random.default_rng(6).normal(size=(20, problem.robot.nv))
    far = np.linalg.norm(manifold.embed(manifold.move(x, steps)) - manifold.embed(x), axis=1)
    np.testing.assert_allclose(far, np.linalg.norm(steps, axis=1), rtol=1e-3)


class WithoutExpression(WithinDistance):
    """A constraint without an expression in q alone, like constraints with auxiliary variables."""

    projected = False

    def symbolic(self, tree, parameters):
        raise AssertionError("the manifold requests an expression, but this constraint has none")


@pytest.mark.long(but=("WithinDistance",))
@pytest.mark.parametrize("kind", [WithinDistance, WithoutExpression])
def test_the_bound_leaves_out_infeasible_parts(kind):
    problem = catalogue("panda", normal=(1, 0, 0))
    chart = ConstraintManifold(problem).chart
    ball = kind(chart, problem.given, 0.8)
    motion = mapped(replace(problem, constraints=(*problem.constraints, ball)), 1)
    manifold = motion.manifold
    x = np.concatenate([component.x for component in motion.components])
    inside = np.array([distance(chart, manifold.to_q(one), problem.given) <= 0.8 for one in x])
    assert 0 < inside.sum() < len(x)
    assert ((manifold.distance_to_feasible(x) == 0) == inside).all()
    values = manifold.objective(x)[0]
    bound = bound_objective(motion, np.inf)
    assert values.min() < 0.99 * values[inside].min()
    assert bound.finished
    assert bound.lower <= values[inside].min()
    assert bound.best == pytest.approx(values[inside].min(), rel=0.02)
    assert bound.lower > values.min()


def test_three_degrees_of_freedom_are_refused():
    problem = planar([0.3] * 5, [0.3, 0.5, 0.7, 0.2, 0.4])
    with pytest.raises(InputError, match="3 degrees of freedom are left"):
        mapped(problem, 3)


def test_a_spatial_arm_has_closed_self_motions():
    robot = arm([Z, Y, Y, Y], [0.3, -0.8, 1.2, -0.5], floating=False)
    objective = ip.ImpactObjective(robot, ip.ImpactContact(TIP, (0, 0, 1)))
    motion = mapped(ip.PostureProblem(objective, contact_pose="position").problem, 1)
    assert motion.components and all(component.closed for component in motion.components)
