"""The controllers `reference-spreading` and `impact-aware`, in single ticks and in runs."""

from __future__ import annotations

import numpy as np
import pytest

from impact_posture.simulation.controllers.contact_reference import Reference
from impact_posture.simulation.controllers.impact_baselines import ImpactAwareDriver, ReferenceSpreadingDriver
from impact_posture.simulation.metrics import before
from impact_posture.simulation.scenario_file import RepeatedContacts
from impact_posture.simulation.world.sensor_noise import Reading
from tests.simulation.factories import lived, shared_factory
from tests.support.helpers import Vector, rng
from tests.support.pinocchio_values import frame_jacobian, mass_matrix

NAME = "aerial-vertical"


def spreading() -> tuple[ReferenceSpreadingDriver, Reference]:
    """Return a driver in its first approach, and the reference motion of the scenario."""
    factory = shared_factory(NAME)
    driver, task = factory.driver("reference-spreading"), factory.setup.scenario.task
    assert isinstance(driver, ReferenceSpreadingDriver)
    assert isinstance(task, RepeatedContacts)
    driver.reset(factory.setup.q)
    reference = Reference(task, factory.setup.gap)
    driver.expect(reference.start(0) + reference.inward)
    return driver, reference


def reading(t: float, deeper: float, v: Vector, force: float = 0.0) -> Reading:
    """Return a sensor reading of the robot at its start, but shifted into the surface."""
    q = shared_factory(NAME).setup.q.copy()
    q[2] -= deeper
    return Reading(t, q, v, np.array([0.0, 0.0, force]))


def test_before_the_impact_the_reference_is_a_function_of_the_position() -> None:
    driver, reference = spreading()
    task, t = reference.task, reference.start(0) + 0.1
    for deeper in (0.01, 0.03, 0.4):
        led = driver._end_effector
        assert led is not None
        # The reference velocity depends on the distance to the surface, not on time.
        for late in (0.0, 0.05):
            driver.tick(reading(t + late, deeper, np.zeros(9)), reference.at(t + late))
            expected = min(np.sqrt(2 * task.acceleration * deeper), task.speed)
            np.testing.assert_allclose(led.target_velocity, [0, 0, -expected, 0, 0, 0], atol=1e-9)
            np.testing.assert_allclose(led.error(driver.controller.state), 0, atol=1e-9)


def test_the_interim_mode_has_no_velocity_feedback() -> None:
    driver, reference = spreading()
    t, period = reference.start(0) + reference.inward - 0.05, driver.controller.period
    driver.tick(reading(t, 0.1, np.zeros(9)), reference.at(t))
    generator = rng("interim")
    for k in range(2):
        v = generator.normal(size=9)
        driver.tick(reading(t + period * (k + 1), 0.1, v, 50.0), reference.at(t))
        for task in driver.controller.formulation.tasks:
            slow = task.target_velocity - task.jacobian(driver.controller.state) @ v
            np.testing.assert_allclose(slow, 0, atol=1e-9)
        led = driver._end_effector
        assert led is not None
        ahead = led.error(driver.controller.state)[:3] @ [0, 0, -1]
        assert ahead == pytest.approx((k + 1) * period * reference.task.speed)


def test_after_the_impact_the_targets_begin_at_the_rigid_impact() -> None:
    driver, reference = spreading()
    t, v = reference.start(0) + reference.inward - 0.05, np.zeros(9)
    v[2] = -0.5
    driver.tick(reading(t, 0.1, v), reference.at(t))
    for k in range(1, 7):
        driver.tick(reading(t + 1e-3 * k, 0.1, v, 50.0), reference.at(t))
    assert driver._done is not None
    factory = shared_factory(NAME).setup
    q = reading(t, 0.1, v).q
    J = frame_jacobian(factory.robot.model, q, factory.robot.frame_id("ee"))[:3]
    spread = np.linalg.solve(mass_matrix(factory.robot.model, q), J.T)
    after = v - spread @ np.linalg.solve(J @ spread, [0, 0, 1]) * (J @ v)[2]
    fade = np.exp(-(reading(t + 6e-3, 0.1, v).t - driver._done) / driver.SETTLE)
    for task in driver.controller.formulation.tasks:
        wanted = fade * task.jacobian(driver.controller.state) @ after
        np.testing.assert_allclose(task.target_velocity, wanted, atol=1e-6)
    # After the impact, the contact point is at rest, but the robot moves.
    assert abs((J @ after)[2]) < 1e-9
    assert np.linalg.norm(after) > 0.3


def test_reference_spreading_makes_its_contact() -> None:
    run = lived(NAME, "reference-spreading", "live", None)
    assert [window.touched for window in run.of("impact")] == [True]
    # For a contact, the reference always moves at the contact speed of the scenario.
    k = before(run.series, run.of("impact")[0])
    assert run.series.v[k, 2] == pytest.approx(-0.5, abs=0.06)


def test_without_contacts_reference_spreading_equals_nominal() -> None:
    factory = shared_factory("solo8-push")
    spread, nominal = factory.driver("reference-spreading"), factory.driver("nominal")
    spread.reset(factory.setup.q)
    nominal.reset(factory.setup.q)
    spread.expect(0.01)
    for k in range(20):
        at = Reading(1e-3 * k, factory.setup.q, 0.1 * rng("push", k).normal(size=14), None)
        np.testing.assert_array_equal(spread.tick(at).u, nominal.tick(at).u)


def test_impact_aware_equals_nominal_before_an_approach() -> None:
    factory = shared_factory(NAME)
    aware, nominal = factory.driver("impact-aware"), factory.driver("nominal")
    assert isinstance(aware, ImpactAwareDriver)
    aware.reset(factory.setup.q)
    nominal.reset(factory.setup.q)
    for k in range(20):
        at = Reading(1e-3 * k, factory.setup.q, 0.1 * rng("aware", k).normal(size=9), None)
        np.testing.assert_allclose(aware.tick(at).u, nominal.tick(at).u, atol=1e-9)
    aware.expect(1.0)
    fast = np.zeros(9)
    fast[2] = -2.0
    first, second = (
        driver.tick(Reading(0.5, factory.setup.q, fast, None)).acceleration for driver in (aware, nominal)
    )
    assert not np.allclose(first, second)


def test_impact_aware_keeps_the_limits_of_the_joints() -> None:
    factory, shares = shared_factory(NAME), {}
    for name in ("nominal", "impact-aware"):
        run = lived(NAME, name, "live", None)
        q, v = (part[before(run.series, run.of("impact")[0])] for part in (run.series.q, run.series.v))
        J = frame_jacobian(factory.setup.robot.model, q, factory.setup.robot.frame_id("ee"))[:3]
        impulse = np.linalg.solve(
            J @ np.linalg.solve(mass_matrix(factory.setup.robot.model, q), J.T), [0, 0, -(J @ v)[2]]
        )
        torques = np.abs(J.T @ impulse)[6:] / 5e-3
        shares[name] = float((torques / factory.setup.robot.model.effortLimit[6:]).max())
    assert shares["nominal"] > 1.5
    assert shares["impact-aware"] < 1.1
