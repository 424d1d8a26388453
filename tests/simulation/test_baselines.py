"""Comparison controllers follow the equations of their papers."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from impact_posture.simulation.controllers.baselines import (
    ReleaseDriver,
    WalkerDriver,
    resting_posture,
    spring_of_term,
)
from impact_posture.simulation.controllers.contact_reference import Reference
from impact_posture.simulation.controllers.controller_factory import ControllerFactory
from impact_posture.simulation.controllers.driver import RobustDriver
from impact_posture.simulation.controllers.impact_baselines import InvariantDriver
from impact_posture.simulation.scenario_file import RepeatedContacts, read_scenario
from impact_posture.simulation.setup import set_up
from impact_posture.simulation.world.actuator_command import ActuatorCommand
from impact_posture.simulation.world.sensor_noise import Reading
from impact_posture.tsid.tasks.task import Task
from tests.simulation.factories import SHIPPED, shared_factory
from tests.support.helpers import Vector, rng
from tests.support.pinocchio_values import central_gradient, frame_jacobian, mass_matrix


def moving(factory: ControllerFactory, *key: object) -> Reading:
    """Return a state near the start with non-zero velocity."""
    generator, robot = rng(*key), factory.setup.robot
    q = np.array(pin.integrate(robot.model, factory.setup.q, 0.02 * generator.normal(size=robot.nv)))
    return Reading(0.5, q, 0.3 * generator.normal(size=robot.nv), None)


# ---- stiff --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SHIPPED)
def test_the_spring_of_the_term_is_its_hessian(name: str) -> None:
    factory = shared_factory(name)
    robot, objective, q = factory.setup.robot, factory.objective(), factory.setup.q
    # Differentiate the gradients of the oracle with a larger step and fourth-order differences.
    hessian = central_gradient(objective.gradient, robot.model, q, 1e-3)
    joints = (hessian + hessian.T)[6:, 6:] / 2
    values, vectors = np.linalg.eigh(joints)
    expected = np.zeros((robot.nv, robot.nv))
    expected[6:, 6:] = (vectors * np.maximum(values, 0)) @ vectors.T
    spring = spring_of_term(robot, factory.gradient(), q, 1.0)
    np.testing.assert_allclose(spring, expected, atol=1e-3 * np.abs(values).max())
    np.testing.assert_array_equal(spring, spring.T)
    assert np.linalg.eigvalsh(spring)[0] > -1e-9 * np.abs(values).max()


@pytest.mark.parametrize("name", ["aerial-vertical", "solo8-push"])
def test_stiff_has_the_spring_of_robust_at_rest(name: str) -> None:
    factory = shared_factory(name)
    robust, setup = factory.driver("robust"), factory.setup
    assert isinstance(robust, RobustDriver)
    reached = resting_posture(robust, setup.scenario.task.settle)
    # The target posture differs from the start and has a smaller H.
    assert factory.objective().value(reached) < factory.objective().value(setup.q)
    posture, control = factory.driver("stiff").posture, setup.scenario.control
    assert posture.stiffness is not None
    assert posture.damping is not None
    spring = spring_of_term(setup.robot, factory.gradient(), reached, control.robust.gain / robust.posture.scale)
    np.testing.assert_allclose(posture.stiffness, np.diag(posture.kp) + spring, rtol=1e-9, atol=1e-9)
    # Each direction is critically damped: (s + K^½)² = s² + D s + K.
    np.testing.assert_allclose(posture.damping @ posture.damping / 4, posture.stiffness, rtol=1e-9, atol=1e-9)


# ---- posture-sticking ------------------------------------------------------------------------------------------


def test_the_offline_posture_of_S_is_reached_at_the_surface() -> None:
    setup = set_up(read_scenario("solo12-landing"))
    factory = ControllerFactory(setup, starts=1)
    optimum, sticking = factory.offline("posture-sticking"), factory.objective("sticking").value
    assert optimum is not None and factory.offline("nominal") is None
    there = resting_posture(factory.driver("posture-sticking"), 3.0, ahead=setup.gap)
    # If the foot does not move, the robot cannot reach the target posture.
    here = resting_posture(factory.driver("posture-sticking"), 3.0)
    away = [np.linalg.norm(pin.difference(setup.robot.model, q, optimum.q)) for q in (there, here)]
    assert away[0] < 0.01 < away[1]
    assert sticking(there) == pytest.approx(optimum.objective, rel=0.01)
    assert sticking(there) < 0.6 * sticking(resting_posture(factory.driver("nominal"), 3.0, ahead=setup.gap))


# ---- robust-release -----------------------------------------------------------------------------------------------


def test_robust_release_moves_further_and_holds(monkeypatch: pytest.MonkeyPatch) -> None:
    factory = shared_factory("aerial-vertical")
    value, setup = factory.objective().value, factory.setup
    monkeypatch.setattr(factory, "starts", 1)
    driver = factory.driver("robust-release")
    assert isinstance(driver, ReleaseDriver)
    reached = resting_posture(driver, 6.0)
    assert driver.level == 0
    assert not driver.posture.activation.live
    assert value(reached) < 0.5 * value(resting_posture(factory.driver("robust"), 3.0))
    assert value(reached) < 1.05 * value(factory.offline().q)
    # The controller holds the last posture that the impact term has reached.
    away = pin.difference(setup.robot.model, reached, driver.posture.target)[6:]
    assert np.abs(away).max() < 0.02
    driver.reset(setup.q)
    assert driver.level == 0
    assert driver.posture.scale >= factory.driver("robust").posture.scale


@pytest.mark.parametrize("name", ["aerial-lateral", "solo8-push"])
def test_a_stiffened_posture_task_is_a_spring_and_a_damper(name: str) -> None:
    factory = shared_factory(name)
    driver = factory.driver("nominal")
    driver.reset(factory.setup.q)
    root = rng(name, "root").normal(size=(factory.setup.robot.nv,) * 2)
    driver.posture.stiffen(root @ root.T)
    reading, state = moving(factory, name, "spring"), driver.controller.state
    state.update(reading.q, reading.v)
    away = pin.difference(factory.setup.robot.model, reading.q, factory.setup.q)
    K, D = driver.posture.stiffness, driver.posture.damping
    assert K is not None
    assert D is not None
    np.testing.assert_allclose(K, np.diag(driver.posture.kp) + root @ root.T)
    np.testing.assert_allclose(driver.posture.desired(state), K @ away - D @ reading.v, atol=1e-9)


@pytest.mark.parametrize("name", ["aerial-vertical", "talos-push"])
def test_the_simulated_robot_reaches_the_resting_posture(name: str) -> None:
    factory = shared_factory(name)
    driver, world, q = factory.driver("robust"), factory.setup.world, factory.setup.q
    predicted = resting_posture(driver, 0.6)
    command = driver.reset(q)
    world.reset(q, rotor_speed=command.rotor_speed)
    driver.brace()
    period = factory.setup.scenario.control.period
    for _ in range(round(0.6 / period)):
        command = driver.tick(world.read())
        world.step(command, round(period / world.timestep))
    joints = slice(6, None)
    moved = pin.difference(factory.setup.robot.model, q, predicted)[joints]
    missed = pin.difference(factory.setup.robot.model, world.truth().q, predicted)[joints]
    assert np.linalg.norm(missed) < 0.15 * np.linalg.norm(moved)


# ---- walker -------------------------------------------------------------------------------------------------------


def walk(name: str, seconds: float) -> tuple[WalkerDriver, Any, Vector]:
    """Run the controller `walker`; return the driver, the world, and the last velocity of the reference flow."""
    factory = shared_factory(name)
    driver, world = factory.driver("walker"), factory.setup.world
    assert isinstance(driver, WalkerDriver)
    command = driver.reset(factory.setup.q)
    world.reset(factory.setup.q, rotor_speed=command.rotor_speed)
    period = factory.setup.scenario.control.period
    count = round(period / world.timestep)
    driver.brace()
    for _ in range(round(seconds / period)):
        before = driver.posture.target.copy()
        command = driver.tick(world.read())
        world.step(ActuatorCommand(command.torque, command.rotor_speed), count)
    return driver, world, pin.difference(factory.setup.robot.model, before, driver.posture.target) / period


@pytest.mark.parametrize("name", SHIPPED)
def test_the_flow_is_free_of_other_tasks_and_lowers_the_metric(name: str) -> None:
    driver, world, flow = walk(name, 0.5)
    factory, assembly, state = shared_factory(name), driver.controller.assembly, driver.controller.state
    assert np.linalg.norm(flow) > 1e-3
    rows = np.vstack([assembly.contacts.J, assembly.strict.J, assembly.weighted.J])
    rank = np.linalg.matrix_rank(rows, tol=1e-6 * np.linalg.norm(rows, 2))
    if rank == state.nv:
        # If the weighted tasks leave no free motion, only contacts and strict levels constrain the flow.
        rows = np.vstack([assembly.contacts.J, assembly.strict.J])
    # The tolerance is loose, because the projector is updated only every fifth tick.
    assert np.linalg.norm(rows @ flow) < 0.02 * np.linalg.norm(rows, 2) * np.linalg.norm(flow)
    objective = factory.objective()
    assert objective.gradient(state.q) @ flow < 0
    assert objective.value(world.truth().q) < objective.value(factory.setup.q) * (1 - 2e-3)


def test_the_flow_is_the_projected_gradient() -> None:
    factory = shared_factory("aerial-vertical")
    driver = factory.driver("walker")
    assert isinstance(driver, WalkerDriver)
    driver.reset(factory.setup.q)
    driver.brace()
    control = factory.setup.scenario.control
    q, v = factory.setup.q, np.zeros(9)
    for k in range(400):
        # The robot does not move; only the reference flow advances.
        last = driver.posture.target.copy()
        driver.tick(Reading(1e-3 * k, q, v, None))
    assert driver.level == 1
    J = np.vstack([np.eye(2, 9, 3), frame_jacobian(factory.setup.robot.model, q, factory.setup.robot.frame_id("ee"))])
    Z = np.linalg.svd(J)[2][8:].T
    assert Z.shape == (9, 1)
    term = -control.robust.gain / driver.posture.scale * factory.objective().gradient(q)
    # The impact term is at most K times the option `reach`.
    bound = control.robust.gain * driver.posture.reach
    term *= min(1.0, bound / np.linalg.norm(term))
    expected = Z @ (Z.T @ term) / control.posture.kd
    flow = pin.difference(factory.setup.robot.model, last, driver.posture.target) / 1e-3
    np.testing.assert_allclose(flow, expected, rtol=1e-5, atol=1e-6)


def test_the_posture_does_not_flow_before_brace() -> None:
    factory = shared_factory("aerial-vertical")
    driver = factory.driver("walker")
    driver.reset(factory.setup.q)
    for k in range(50):
        driver.tick(Reading(1e-3 * k, factory.setup.q, np.zeros(9), None))
    np.testing.assert_array_equal(driver.posture.target, factory.setup.q)


# ---- invariant ----------------------------------------------------------------------------------------------------


def invariant(name: str) -> InvariantDriver:
    driver = shared_factory(name).driver("invariant")
    assert isinstance(driver, InvariantDriver)
    driver.reset(shared_factory(name).setup.q)
    return driver


def impulses(name: str, q: Vector) -> Vector:
    """Return ``M⁻¹Jᵀ`` of the impact with fixed feet, shape (nv, 3), computed with Pinocchio."""
    setup = shared_factory(name).setup
    model, frame = setup.robot.model, setup.scenario.task.frame
    M = mass_matrix(model, q)
    J = frame_jacobian(model, q, setup.robot.frame_id(frame))[:3]
    free = np.linalg.solve(M, J.T)
    if setup.scenario.control.footing is None:
        return free
    feet = np.vstack([
        frame_jacobian(model, q, setup.robot.frame_id(s.frame), s.offset)[: 3 if s.kind == "point" else 6]
        for s in setup.robot.spec.supports
    ])  # fmt: skip
    back = np.linalg.solve(M, feet.T)
    return np.asarray(free - back @ np.linalg.pinv(feet @ back, rcond=1e-6) @ (feet @ free))


def leading(driver: InvariantDriver) -> list[Task]:
    return [task for task in driver.controller.formulation.tasks if task is not driver.posture]


@pytest.mark.parametrize("name", SHIPPED)
def test_the_correction_removes_velocities_of_impulses_only(name: str) -> None:
    factory, driver = shared_factory(name), invariant(name)
    generator = rng(name, "impulse")
    quiet = moving(factory, name, "invariant")
    quiet = Reading(quiet.t, quiet.q, np.zeros_like(quiet.v), None)
    change = impulses(name, quiet.q)
    for _ in range(5):
        impact = change @ generator.normal(size=3)
        correction = driver._correction(Reading(quiet.t, quiet.q, impact, None))
        # The corrected velocity is zero, as the limits demand.
        np.testing.assert_allclose(impact + correction, 0, atol=1e-6 * np.abs(impact).max())
    # If the task errors are orthogonal to the effect of impulses, no impulse improves the motion.
    state = driver._state.update(quiet.q, quiet.v)
    J = np.vstack([task.jacobian(state) for task in leading(driver)])
    v = generator.normal(size=quiet.v.size)
    error = J @ v
    possible = J @ change
    within = possible @ np.linalg.lstsq(possible, error, rcond=1e-9)[0]
    v = v - np.linalg.pinv(J) @ within
    correction = driver._correction(Reading(quiet.t, quiet.q, v, None))
    assert np.linalg.norm(correction) < 1e-6 * np.linalg.norm(v)


@pytest.mark.parametrize("name", ["aerial-vertical", "talos-push"])
def test_the_invariant_part_of_a_velocity_is_kept(name: str) -> None:
    factory, driver = shared_factory(name), invariant(name)
    reading = moving(factory, name, "kept")
    # Impulses do not change the components of the velocity in the null space of J M⁻¹.
    kept = np.linalg.svd(impulses(name, reading.q).T)[2][3:]
    correction = driver._correction(reading)
    np.testing.assert_allclose(kept @ (reading.v + correction), kept @ reading.v, atol=1e-9)
    assert np.linalg.norm(correction) > 1e-3


def test_the_approach_is_not_a_velocity_error() -> None:
    # During the approach, the end effector follows its reference, so the velocity correction is zero.
    factory = shared_factory("aerial-vertical")
    task = factory.setup.scenario.task
    assert isinstance(task, RepeatedContacts)
    reference, driver = Reference(task, factory.setup.gap), invariant("aerial-vertical")
    point = reference.at(task.settle + 0.4)
    assert point.speed == pytest.approx(0.5)
    v = np.zeros(9)
    v[2] = -point.speed
    driver._follow(point)
    assert np.abs(driver._correction(Reading(0.5, factory.setup.q, v, None))).max() < 1e-9


def test_the_correction_is_active_around_the_impact() -> None:
    driver = invariant("aerial-vertical")
    assert driver.share(1.0) == 0
    driver.expect(1.0)
    edge = 1 - np.exp(-0.4)
    for t, level in ((0.949, 0), (0.98, 1), (1.0, 1), (1.049, edge), (0.951, edge), (1.051, 0)):
        assert driver.share(t) == pytest.approx(level, abs=1e-3), t
    driver.reset(shared_factory("aerial-vertical").setup.q)
    assert driver.share(1.0) == 0


def test_only_the_feedback_is_corrected() -> None:
    factory, driver = shared_factory("aerial-vertical"), invariant("aerial-vertical")
    reading = moving(factory, "feedback")
    driver.expect(reading.t)
    driver.tick(reading)
    # The dynamics constraints use the measured velocity.
    np.testing.assert_array_equal(driver.controller.state.v, reading.v)
    seen = reading.v + driver.share(reading.t) * driver._correction(reading)
    state, posture = driver.controller.state, driver.posture
    away = pin.difference(factory.setup.robot.model, reading.q, factory.setup.q)
    driver._lead(None)
    driver._command(reading, seen - reading.v)
    np.testing.assert_allclose(posture.desired(state), posture.kp * away - posture.kd * seen, atol=1e-9)


def test_a_felt_impact_sets_the_time_once() -> None:
    factory, driver = shared_factory("aerial-vertical"), invariant("aerial-vertical")
    q, v = factory.setup.q, np.zeros(9)
    driver.expect(1.0)
    for t, force, expected in ((0.7, 50, 1.0), (0.9, 2, 1.0), (0.95, 50, 0.95), (0.97, 50, 0.95)):
        driver.tick(Reading(t, q, v, np.array([0.0, 0.0, force])))
        assert driver._at == expected
    driver.expect(4.0)
    driver.tick(Reading(3.9, q, v, np.array([0.0, 0.0, 50.0])))
    assert driver._at == 3.9


@pytest.mark.long(but=("solo8-push",))
@pytest.mark.parametrize("name", ["aerial-vertical", "solo8-push"])
def test_away_from_the_impact_the_command_equals_nominal(name: str) -> None:
    factory, driver, nominal = shared_factory(name), invariant(name), shared_factory(name).driver("nominal")
    nominal.reset(factory.setup.q)
    driver.expect(0.3)
    other = 0
    for k in range(500):
        t, still = 1e-3 * k, moving(factory, name, "bits", k)
        reading = Reading(t, still.q, 0.1 * still.v, None)
        a, b = driver.tick(reading).u, nominal.tick(reading).u
        if abs(t - 0.3) < 0.0499:
            other += not np.array_equal(a, b)
        elif abs(t - 0.3) > 0.0501:
            np.testing.assert_array_equal(a, b)
    assert other > 60
