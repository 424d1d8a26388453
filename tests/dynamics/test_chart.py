"""Coordinate chart of the optimizer, and gradients on the tangent space."""

from __future__ import annotations

import functools

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest

from impact_posture.dynamics.chart import Chart
from impact_posture.dynamics.tree import PointOnLink, Tree, Wrench
from tests.support.helpers import NAMES, Vector, assert_close, random_configurations, rng, robot
from tests.support.tangent import tangent_map


@functools.cache
def mixed_model() -> pin.Model:
    """Return a chain of joints with every kind of rotation."""
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
def chart_of(name: str) -> Chart:
    return Chart(_model(name))


@pytest.mark.parametrize("name", [*NAMES, "mixed"])
def test_tangent_map_is_the_derivative_of_pinocchios_integrate(name: str) -> None:
    model, symbol = _model(name), ca.SX.sym("q", _model(name).nq)
    tangent_fun = ca.Function("tangent", [symbol], [tangent_map(chart_of(name), symbol)])
    step = 1e-3
    for q in random_configurations(model, 2, name, "tangent"):

        def at(v: Vector, q: Vector = q) -> Vector:
            return np.array(pin.integrate(model, q, v))

        columns = [
            (8 * (at(step * e) - at(-step * e)) - (at(2 * step * e) - at(-2 * step * e))) / (12 * step)
            for e in np.eye(model.nv)
        ]
        assert_close(tangent_fun(q), np.column_stack(columns), 1e-10, "tangent map")


@pytest.mark.parametrize("lean", [False, True])
@pytest.mark.parametrize("name", ["mixed", "solo8", "kinova", "talos", "panda"])
def test_adjoint_gradients_are_casadis_derivatives_on_the_tangent_space(name: str, lean: bool) -> None:
    """``∂/∂q`` by reverse AD, times the tangent map, equals the backward sweep."""
    model = _model(name)
    generator = rng(name, "adjoint")
    q = ca.SX.sym("q", model.nq)
    tree = Tree(model, q, visits=[] if lean else None)
    point = PointOnLink(model.njoints - 1, generator.normal(size=3), np.array(pin.SE3.Random().rotation))
    v, tau, other_tau = (ca.SX(generator.normal(size=model.nv)) for _ in range(3))
    force, moment = ca.SX(generator.normal(size=3)), ca.SX(generator.normal(size=3))
    energy = ca.dot(v, tree.mass_times(v))
    cases: dict[str, tuple[ca.SX, ca.SX]] = {"vMv": (energy, tree.energy_gradient(tree.velocities(v)))}
    direction = tree.rotation(point) @ force
    cases["turning"] = (ca.dot(direction, moment), tree.turning_gradient(point, direction, moment))
    # The derivative treats both accelerations as constant although they depend on q: d(τᵀM⁻¹τ') = −a'ᵀ dM a.
    x, y = tree.respond(tau=tau), tree.respond(tau=other_tau)
    cases["τᵀM⁻¹τ'"] = (ca.dot(other_tau, x.a), tree.pair_gradient(x, y))
    for in_frame in (False, True):
        # With x = M⁻¹(τ + Jᵀw) and y = M⁻¹τ': d(τ'ᵀx) = wᵀ dJ y − yᵀ dM x.
        pushed = tree.respond(tau=tau, wrenches=[Wrench(point, force, moment, in_frame=in_frame)])
        cases[f"τᵀM⁻¹Jᵀw {in_frame}"] = (ca.dot(other_tau, pushed.a), tree.pair_gradient(pushed, y))
    tangent = tangent_map(tree.chart, q)
    for what, (value, gradient) in cases.items():
        pair = ca.Function("pair", [q], [ca.gradient(value, q).T @ tangent, gradient])
        for at in random_configurations(model, 2, name, what):
            expected, result = pair(at)
            assert_close(np.array(result).reshape(1, -1), expected, 1e-11, what)


@pytest.mark.parametrize("name", [*NAMES, "mixed"])
def test_chart_round_trip(name: str) -> None:
    model = _model(name)
    chart = chart_of(name)
    x = ca.SX.sym("x", chart.nx)
    configuration_fun = ca.Function("q", [x], [chart.configuration(x), chart.norms(x)])
    for q in random_configurations(model, 4, name, "chart", spread=3.0):
        coordinates = chart.to_x(q)
        assert coordinates.shape == (chart.nx,)
        assert_close(chart.to_q(coordinates), q, 1e-14, "to_q(to_x(q))")
        result, norms = configuration_fun(coordinates)
        assert_close(result, q, 1e-14, "q(x)")
        assert np.abs(np.array(norms)).max(initial=0.0) < 1e-14
        assert np.array(norms).size == sum(slot.kind.family in ("free-flyer", "spherical") for slot in chart.slots)


def test_to_q_normalizes_quaternions() -> None:
    chart = chart_of("mixed")
    x = chart.to_x(random_configurations(mixed_model(), 1, "normalize")[0])
    stretched = x.copy()
    for part in chart.quaternion_slices():
        stretched[part] *= 1.7
    np.testing.assert_allclose(chart.to_q(stretched), chart.to_q(x), atol=1e-15)


def test_several_turns_of_a_continuous_joint_are_one_configuration() -> None:
    chart = chart_of("kinova")
    (slot, *_) = [s for s in chart.slots if s.kind.family == "continuous"]
    x = chart.to_x(robot("kinova").posture())
    turned = x.copy()
    turned[slot.x] += 4 * np.pi
    np.testing.assert_allclose(chart.to_q(turned), chart.to_q(x), atol=1e-14)


@pytest.mark.parametrize("name", [*NAMES, "mixed"])
def test_bounds_are_the_models(name: str) -> None:
    model = _model(name)
    chart = chart_of(name)
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
