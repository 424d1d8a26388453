"""The controller that strikes along a planned path."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pinocchio as pin
import pytest

from impact_posture.path.posture_path import PosturePath
from impact_posture.path.strike import Strike
from impact_posture.simulation.controllers.contact_reference import Reference
from impact_posture.simulation.controllers.controller_factory import ControllerFactory
from impact_posture.simulation.controllers.strike_driver import StrikeDriver
from impact_posture.simulation.controllers.task_formulations import nominal_posture
from impact_posture.simulation.metrics import measure
from impact_posture.simulation.outcome import judge
from impact_posture.simulation.prediction import predict
from impact_posture.simulation.run import Run
from impact_posture.simulation.scenario_file import RepeatedContacts
from impact_posture.simulation.setup import set_up
from impact_posture.simulation.world.sensor_noise import Reading
from impact_posture.tsid.controller import Status
from impact_posture.tsid.state import State
from tests.simulation.factories import controller_factory, driven, shortened

pytest.importorskip("toppra", reason="toppra is not installed (the extra 'path')")


@cache
def factory_of(nearer: float = 0.0, count: int = 1) -> ControllerFactory:
    """Return a factory of an arm and a table.  The table is nearer than planned by the distance ``nearer``, m."""
    scenario = shortened("panda-tap", count=count, settle=0.8, pause=0.3 * (count > 1)).scenario
    surfaces = tuple(replace(s, gap=s.gap - nearer) for s in scenario.surfaces)
    factory = controller_factory(set_up(replace(scenario, surfaces=surfaces)))
    factory.starts = 1
    return factory


def expected(factory: ControllerFactory) -> list[float]:
    """Return the times at which the scenario expects the contacts, s."""
    task = factory.setup.scenario.contacts
    assert isinstance(task, RepeatedContacts)
    reference = Reference(task, factory.setup.gap)
    return [reference.start(k) + reference.crossing for k in range(task.count)]


@cache
def struck() -> tuple[ControllerFactory, Run, PosturePath]:
    factory = factory_of(count=2)
    return factory, driven(factory, "strike"), factory.strike


def test_speed_time_and_jump_of_the_contacts_are_as_planned() -> None:
    factory, record, path = struck()
    metrics = measure(factory.setup, record)
    assert judge(factory.setup, record) == () and metrics.contacts == 2 and metrics.failed_ticks == 0
    windows, predictions = list(record.of("impact")), predict(factory.setup, factory.objective(), record)
    assert path.strike is not None and path.strike.speed == 0.5 and len(predictions) == 2
    for window, prediction, at in zip(windows, predictions, expected(factory), strict=True):
        assert abs(window.begin - at) < 0.01
        assert prediction.approach == pytest.approx(0.5, rel=0.05)
        # The prediction contains the restitution 0.13 of the surface.
        assert prediction.ratio == pytest.approx(1.0, abs=0.05)
        # The posture at the contact is the planned one, up to the lag of the soft posture task.  No motor is at its
        # limit before the contact.
        k = int(np.searchsorted(record.series.t, window.begin)) - 1
        assert np.abs(record.series.q[k] - path.q[-1]).max() < 0.1
        effort = np.asarray(factory.setup.robot.model.effortLimit)
        assert (np.abs(record.series.torque[:k]) < 0.999 * effort).all()


def test_a_strike_reduces_the_jump_beside_the_nominal_posture() -> None:
    factory, record, _ = struck()
    nominal = driven(factory_of(), "nominal")
    ours, theirs = (predict(factory.setup, factory.objective(), each) for each in (record, nominal))
    assert ours[0].measured < 0.95 * theirs[0].measured


def height(path: PosturePath, t: float) -> float:
    data, frame = path.model.createData(), path.model.getFrameId("panda_hand_tcp")
    pin.framesForwardKinematics(path.model, data, path.at(t)[0])
    return float(data.oMf[frame].translation[2])


@pytest.mark.long(but=("-0.05",))
@pytest.mark.parametrize("late", [-0.05, 0.05])
def test_a_contact_50_ms_early_or_late_is_survived(late: float, monkeypatch: pytest.MonkeyPatch) -> None:
    *_, path = struck()
    end = path.duration
    # After the planned contact, the references continue with 0.5 m/s.
    factory = factory_of(height(path, end + late) - height(path, end) if late < 0 else -0.5 * late)
    # The path ends where the surface is believed to be.
    monkeypatch.setitem(vars(factory), "strike", path)
    record = driven(factory, "strike")
    metrics = measure(factory.setup, record)
    assert judge(factory.setup, record) == () and metrics.contacts == 1 and metrics.failed_ticks == 0
    window = next(iter(record.of("impact")))
    assert window.begin - expected(factory)[0] == pytest.approx(late, abs=0.01)
    (prediction,) = predict(factory.setup, factory.objective(), record)
    planned = (height(path, end + late) - height(path, end + late + 1e-4)) / 1e-4 if late < 0 else 0.5
    assert prediction.approach == pytest.approx(planned, rel=0.15)
    # No motor is at its limit, neither before nor after the contact.
    assert (np.abs(record.series.torque) < 0.999 * np.asarray(factory.setup.robot.model.effortLimit)).all()
    # The references stop at the contact, so the arm is at rest soon afterwards.
    after = (record.series.t > window.begin + 0.25) & (record.series.t < window.begin + 0.3)
    assert np.abs(record.series.v[after]).max() < 0.1


@pytest.mark.usefixtures("quick_builds")
def test_all_ticks_of_a_strike_in_c_are_those_in_python(monkeypatch: pytest.MonkeyPatch) -> None:
    factory, record, path = struck()
    in_c, series, contact = replace(factory, compile="always"), record.series, expected(factory)[0]
    monkeypatch.setitem(vars(in_c), "strike", path)
    both = factory.driver("strike"), in_c.driver("strike")
    assert in_c.in_c
    for driver in both:
        driver.reset(factory.setup.q)
    # Leave out the time at rest before the run-up.
    ticks = np.flatnonzero((series.t < 0.4) | ((series.t > 0.95) & (series.t < contact + 0.2)))
    solved = 0
    for t, q, v in zip(series.t[ticks], series.q[ticks], series.v[ticks], strict=True):
        for driver in both:
            if abs(t - 0.1) < 1e-6:
                driver.brace()
                driver.expect(contact)
        wanted, have = (driver.tick(Reading(float(t), q, v, None)) for driver in both)
        assert wanted.status is have.status
        # Relaxed ticks at the sudden start of the path have several solutions.
        if wanted.status is Status.SOLVED:
            np.testing.assert_allclose(have.u, wanted.u, rtol=0, atol=1e-8)
            solved += 1
    assert both[0].level == both[1].level == 1 and solved > 0.95 * len(ticks)


def test_a_push_is_awaited_in_the_optimum() -> None:
    factory = controller_factory(shortened("solo8-push"))
    factory.starts = 1
    driver = factory.driver("strike")
    assert not isinstance(driver, StrikeDriver) and factory.path_of("strike") is None


def test_accelerations_of_a_robot_with_rotors_are_ahead_by_the_lag_of_its_thrust() -> None:
    setup = shortened("aerial-vertical", count=1, settle=0.8)
    model, rotors = setup.robot.model, setup.robot.spec.propulsion
    assert rotors is not None
    # The robot descends by 5 cm in 0.2 s, and arrives at 0.5 m/s.
    times, down = np.linspace(0.0, 0.2, 21), np.eye(model.nv)[2]
    travel = np.polynomial.Polynomial([0.0, 0.0, 0.0, -0.5 / 0.2**2, 0.5 / 2 / 0.2**3])
    rows = [[float(p(t)) * down for t in times] for p in (travel, travel.deriv(), travel.deriv(2))]
    postures = np.array([pin.integrate(model, setup.q, step) for step in rows[0]])
    strike = Strike(0.5, 0.5, 0.0, 0.0, 0.05, 0.2, rows[1][-1], 0.0)
    path = PosturePath(
        model, times, postures, np.array(rows[1]), np.array(rows[2]), found=True, reason="", method="", timing="",
        objective=0.0, length=0.05, max_violation=0.0, strike=strike,
    )  # fmt: skip
    driver = StrikeDriver(setup, nominal_posture(setup), path)
    driver.reset(setup.q)
    driver.brace()
    driver.expect(0.2)
    lag = (rotors.time_constant_up + rotors.time_constant_down) / 2
    task = driver.posture
    for t in (0.05, 0.1, 0.15):
        driver.tick(Reading(t, *path.at(t)[:2], None))
        wanted = task.desired(State(setup.robot).update(path.at(t)[0], path.at(t)[1]))
        np.testing.assert_allclose(wanted, path.at(t + lag)[2], atol=1e-9)
        assert abs(wanted[2] - path.at(t)[2][2]) > 0.1
