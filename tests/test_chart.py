"""The manifold as expressions: the retraction, its tangent map, and the chart that the optimizer moves in."""

from __future__ import annotations

import functools

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest

from impact_posture.dynamics.chart import Chart, integrate, tangent_map
from impact_posture.dynamics.tree import Coupling, PointOnLink, Product, Tree, Wrench
from tests.helpers import NAMES, Vector, assert_close, random_configurations, rng, robot

# From far below the series' switch, across it (1e-2), to several turns.
STEPS = [0.0, 1e-300, 1e-12, 1e-8, 1e-5, 1e-3, 9.9e-3, 1.01e-2, 0.1, 1.0, 3.1, 6.3, 20.0]


@functools.cache
def mixed_model() -> pin.Model:
    """Every joint with a rotation of its own kind, in one chain."""
    pin.seed(5)
    model, parent = pin.Model(), 0
    joints = [
        pin.JointModelFreeFlyer(), pin.JointModelPlanar(), pin.JointModelRUBY(), pin.JointModelSpherical(),
        pin.JointModelTranslation(), pin.JointModelPZ(), pin.JointModelRX(), pin.JointModelFreeFlyer(),
    ]  # fmt: skip
    for k, joint in enumerate(joints):
        parent = model.addJoint(parent, joint, pin.SE3.Random(), f"j{k}")
        model.appendBodyToJoint(parent, pin.Inertia.Random(), pin.SE3.Identity())
    return model


def _model(name: str) -> pin.Model:
    return mixed_model() if name == "mixed" else robot(name).model


@functools.cache
def functions(name: str) -> tuple[Chart, ca.Function, ca.Function]:
    model = _model(name)
    chart = Chart(model)
    q, v = ca.SX.sym("q", model.nq), ca.SX.sym("v", model.nv)
    return (
        chart,
        ca.Function("integrate", [q, v], [integrate(chart, q, v)]),
        ca.Function("tangent", [q], [tangent_map(chart, q)]),
    )


def same_side(chart: Chart, q: Vector, like: Vector) -> Vector:
    """Turn quaternions to the half that ``like`` lies in: both halves are the same rotation."""
    q = q.copy()
    for slot in chart.slots:
        if slot.kind.family in ("free-flyer", "spherical"):
            part = slice(slot.q.stop - 4, slot.q.stop)
            q[part] *= np.sign(q[part] @ like[part])
    return q


@pytest.mark.parametrize("name", [*NAMES, "mixed"])
def test_integrate_is_pinocchios(name: str) -> None:
    model = _model(name)
    chart, integrate_fun, _ = functions(name)
    generator = rng(name, "integrate")
    for q, size in zip(random_configurations(model, len(STEPS), name), STEPS, strict=True):
        v = size * generator.normal(size=model.nv)
        found = np.array(integrate_fun(q, v)).reshape(-1)
        expected = np.array(pin.integrate(model, q, v))
        assert_close(found, same_side(chart, expected, found), 1e-13, f"step {size:g}")


def test_integrate_by_hand() -> None:
    # A quarter turn to the left while driving ahead at speed v: an arc of radius 2v/π.
    model = pin.Model()
    model.addJoint(0, pin.JointModelPlanar(), pin.SE3.Identity(), "base")
    chart = Chart(model)
    q, v = ca.SX.sym("q", 4), ca.SX.sym("v", 3)
    integrate_fun = ca.Function("f", [q, v], [integrate(chart, q, v)])
    arc = np.array(integrate_fun([1.0, 2.0, 1.0, 0.0], [np.pi / 2, 0.0, np.pi / 2])).reshape(-1)
    np.testing.assert_allclose(arc, [2.0, 3.0, 0.0, 1.0], atol=1e-15)


@pytest.mark.parametrize("name", [*NAMES, "mixed"])
def test_integrate_is_smooth_at_zero(name: str) -> None:
    """First and second derivatives of ``q ⊕ v`` at ``v = 0`` are finite; the first is the tangent map."""
    model = _model(name)
    chart, _, tangent_fun = functions(name)
    q, v = ca.SX.sym("q", model.nq), ca.SX.sym("v", model.nv)
    step = integrate(chart, q, v)
    weight = rng(name, "weight").normal(size=model.nq)
    hessian, _ = ca.hessian(ca.dot(ca.SX(weight), step), v)
    derivatives = ca.Function("d", [q, v], [ca.jacobian(step, v), hessian])
    (at,) = random_configurations(model, 1, name, "smooth")
    first, second = (np.array(d) for d in derivatives(at, np.zeros(model.nv)))
    assert np.isfinite(second).all()
    assert_close(first, tangent_fun(at), 1e-14, "jacobian at zero")


@pytest.mark.parametrize("name", [*NAMES, "mixed"])
def test_tangent_map_is_the_derivative_of_pinocchios_integrate(name: str) -> None:
    model = _model(name)
    _, _, tangent_fun = functions(name)
    step = 1e-3
    for q in random_configurations(model, 2, name, "tangent"):

        def at(v: Vector, q: Vector = q) -> Vector:
            return np.array(pin.integrate(model, q, v))

        columns = [
            (8 * (at(step * e) - at(-step * e)) - (at(2 * step * e) - at(-2 * step * e))) / (12 * step)
            for e in np.eye(model.nv)
        ]
        assert_close(tangent_fun(q), np.column_stack(columns), 1e-10, "tangent map")


@pytest.mark.parametrize("name", ["mixed", "solo8", "kinova", "talos", "panda"])
def test_adjoint_gradients_are_casadis_derivatives_on_the_tangent_space(name: str) -> None:
    """``∂/∂q`` by reverse AD, times the tangent map, equals the backward sweep."""
    model = _model(name)
    generator = rng(name, "adjoint")
    q = ca.SX.sym("q", model.nq)
    tree = Tree(model, q)
    point = PointOnLink(model.njoints - 1, generator.normal(size=3), np.array(pin.SE3.Random().rotation))
    fixed = [ca.SX(generator.normal(size=model.nv)) for _ in range(2)]
    at_u, at_v = (tree.velocities(rate) for rate in fixed)
    force, moment = ca.SX(generator.normal(size=3)), ca.SX(generator.normal(size=3))
    cases: dict[str, tuple[ca.SX, ca.SX]] = {"uMv": (
        ca.dot(fixed[0], tree.mass_times(fixed[1])), tree.bracket_gradient(products=[Product(at_u, at_v)])
    )}  # fmt: skip
    for in_frame in (False, True):
        wrench = Wrench(point, force, moment, in_frame=in_frame)
        value = ca.dot(tree.generalized_force([wrench]), fixed[1])
        cases[f"wJv {in_frame}"] = (value, tree.bracket_gradient([Coupling(wrench, at_v)]))
    direction = tree.rotation(point) @ force
    cases["turning"] = (ca.dot(direction, moment), tree.turning_gradient(point, direction, moment))
    # d(τᵀM⁻¹τ) = −aᵀ dM a: the bracket holds a fixed although it depends on q.
    a, at_a = tree.solve(tau=fixed[0])
    half = tree.bracket_gradient(products=[Product(at_a, at_a, -1.0)])
    cases["τᵀM⁻¹τ"] = (ca.dot(fixed[0], a), half)
    tangent = tangent_map(tree.chart, q)
    for what, (value, gradient) in cases.items():
        pair = ca.Function("pair", [q], [ca.gradient(value, q).T @ tangent, gradient])
        for at in random_configurations(model, 2, name, what):
            expected, found = pair(at)
            assert_close(np.array(found).reshape(1, -1), expected, 1e-11, what)


@pytest.mark.parametrize("name", [*NAMES, "mixed"])
def test_chart_round_trip(name: str) -> None:
    model = _model(name)
    chart, _, _ = functions(name)
    x = ca.SX.sym("x", chart.nx)
    configuration_fun = ca.Function("q", [x], [chart.configuration(x), chart.norms(x)])
    for q in random_configurations(model, 4, name, "chart", spread=3.0):
        coordinates = chart.to_x(q)
        assert coordinates.shape == (chart.nx,)
        assert_close(chart.to_q(coordinates), q, 1e-14, "to_q(to_x(q))")
        found, norms = configuration_fun(coordinates)
        assert_close(found, q, 1e-14, "q(x)")
        assert np.abs(np.array(norms)).max(initial=0.0) < 1e-14
        assert np.array(norms).size == sum(slot.kind.family in ("free-flyer", "spherical") for slot in chart.slots)


def test_to_q_normalizes_quaternions() -> None:
    chart, _, _ = functions("mixed")
    x = chart.to_x(random_configurations(mixed_model(), 1, "normalize")[0])
    stretched = x.copy()
    for part in chart.quaternion_slices():
        stretched[part] *= 1.7
    np.testing.assert_allclose(chart.to_q(stretched), chart.to_q(x), atol=1e-15)


def test_several_turns_of_a_continuous_joint_are_one_configuration() -> None:
    chart, _, _ = functions("kinova")
    (slot, *_) = [s for s in chart.slots if s.kind.family == "continuous"]
    x = chart.to_x(robot("kinova").posture())
    turned = x.copy()
    turned[slot.x] += 4 * np.pi
    np.testing.assert_allclose(chart.to_q(turned), chart.to_q(x), atol=1e-14)


@pytest.mark.parametrize("name", [*NAMES, "mixed"])
def test_bounds_are_the_models(name: str) -> None:
    model = _model(name)
    chart, _, _ = functions(name)
    lower, upper = chart.bounds()
    assert (lower <= upper).all()
    for slot in chart.slots:
        one_number = slot.kind.family in ("revolute", "prismatic")
        low, high = lower[slot.x], upper[slot.x]
        if one_number and abs(model.lowerPositionLimit[slot.q.start]) < 1e9:
            assert low[0] == model.lowerPositionLimit[slot.q.start]
            assert high[0] == model.upperPositionLimit[slot.q.start]
        else:
            assert np.isinf(low).all()
            assert np.isinf(high).all()


def test_bounds_in_name_order() -> None:
    # ur5 has no free-flyer: x is q, and the bounds are the URDF's.
    found = robot("ur5")
    lower, upper = Chart(found.model).bounds()
    pairs: dict[str, tuple[float, float]] = dict(zip(found.joint_names, zip(lower, upper, strict=True), strict=True))
    assert pairs["elbow_joint"] == pytest.approx((-np.pi, np.pi), abs=1e-6)
