"""Controllers of a robot that falls and lands on its feet."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pinocchio as pin
import pytest

from impact_posture.dynamics.numeric import Numeric
from impact_posture.errors import InputError, SpecError
from impact_posture.impact.evaluation.coulomb_jump import coulomb_jumps
from impact_posture.impact.impact_contact import point_on
from impact_posture.path.actuator_limits import ActuatorLimits
from impact_posture.path.follow_through import follow_through
from impact_posture.path.strike_spaces import landed
from impact_posture.posture.formulation.build_problem import build_problem
from impact_posture.simulation.controllers.controller_factory import ControllerFactory
from impact_posture.simulation.metrics import before
from impact_posture.simulation.offline_posture import scenario_requirements
from impact_posture.simulation.outcome import judge
from impact_posture.simulation.prediction import predict
from impact_posture.simulation.run import Run
from impact_posture.simulation.scenario_file import Scenario, Spread, read_scenario
from impact_posture.simulation.seed_variation import set_up_with
from impact_posture.simulation.setup import set_up
from impact_posture.tsid.controller import Status
from tests.simulation.factories import controller_factory, driven

pytest.importorskip("toppra", reason="toppra is not installed (the extra 'path')")


def scenario_of() -> Scenario:
    scenario = read_scenario("solo12-drop")
    assert scenario.contacts is not None
    return replace(scenario, contacts=replace(scenario.contacts, dwell=0.15, window=0.1))


@cache
def dropped() -> tuple[ControllerFactory, Run]:
    factory = controller_factory(set_up(scenario_of()))
    return factory, driven(factory, "nominal")


def test_the_robot_falls_freely_in_its_posture_and_lands_on_time() -> None:
    factory, record = dropped()
    (window,), series, setup = record.of("impact"), record.series, factory.setup
    assert judge(setup, record) == () and window.touched
    (prediction,) = predict(setup, factory.objective(), record)
    assert prediction.approach == pytest.approx(1.0, rel=0.02)
    assert abs(window.begin - np.sqrt(2 * 0.051 / 9.81)) < 2e-3
    fall = series.slice(0.0, window.begin - 2e-3)
    assert np.abs(series.q[fall, 7:] - setup.q[7:]).max() < 1e-3
    np.testing.assert_allclose(series.q[fall, 2], factory.landing.q[0, 2] - 9.81 * series.t[fall] ** 2 / 2, atol=1e-3)
    # A controller that stands would push with the weight, which needs about 0.5 N m at the knees.
    assert np.abs(series.torque[fall]).max() < 0.1
    assert {Status.SOLVED} == {list(Status)[k] for k in series.status}


def test_the_robot_stands_after_the_landing() -> None:
    series, record = dropped()[1].series, dropped()[1]
    assert series.touching[-50:].min() == 4
    assert np.abs(pin.log3(pin.Quaternion(series.q[-1, 3:7]).matrix())).max() < 0.05
    assert abs(series.v[-1, 2]) < 0.4 < abs(series.v[before(series, record.of("impact")[0]), 2])


def test_a_leg_keeps_its_posture_until_its_foot_lands() -> None:
    """On tilted ground, a controller that stands too early would swing the legs in the air at 16 rad/s."""
    setup = set_up_with(replace(scenario_of(), spread=Spread(normal=5.0)), 4)
    record = driven(controller_factory(setup), "nominal")
    (window,), series, contacts = record.of("impact"), record.series, setup.scenario.contacts
    assert contacts is not None and 0.015 < window.landing < window.end - window.begin
    fall = series.slice(0.0, window.begin + window.landing - 2e-3)
    model = setup.robot.model
    frames = [model.frames[setup.robot.frame_id(frame)] for frame in contacts.frames]
    knees = [np.abs(series.v[fall, model.joints[frame.parentJoint].idx_v]).max() for frame in frames]
    assert min(knees) < 0.1 and sorted(knees)[1] > 3.0


def test_the_prediction_counts_all_feet() -> None:
    factory, record = dropped()
    (prediction,), (window,) = predict(factory.setup, factory.objective(), record), record.of("impact")
    assert prediction.restitution is not None
    q = record.series.q[before(record.series, window)]
    jumps = coulomb_jumps(factory.objective(), q, 1.0)
    oracles = [single.oracle.at(q) for single in factory.objective().singles]
    normal = np.array([oracle.n @ oracle.J for oracle in oracles])
    responses = oracles[0].solve(normal.T)
    smooth = responses @ np.linalg.solve(normal @ responses, np.ones(4))
    assert jumps is not None and len(jumps) == 4
    rebound = (1 + prediction.restitution) * prediction.approach
    assert prediction.predicted_impact.impulse == pytest.approx(rebound * sum(each.normal_impulse for each in jumps))
    assert prediction.coulomb == pytest.approx(rebound * np.linalg.norm(jumps[0].velocity))
    assert prediction.ratio == pytest.approx(1.0, abs=0.15)
    # Without friction, the normal velocities stop, which a linear system of the four normals states.
    assert prediction.frictionless == pytest.approx(rebound * np.linalg.norm(smooth), rel=1e-6)
    assert prediction.sticking is None


def test_after_the_contact_the_body_follows_the_planned_stop(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("impact_posture.path.follow_through.FACTORS", ())
    factory = controller_factory(set_up(scenario_of()))
    setup, path, objective = factory.setup, factory.landing, factory.objective()
    assert path.strike is not None and path.strike.follow_through is None
    demands = replace(scenario_requirements(setup, objective), collision=False)
    problem = build_problem(setup.robot, objective, setup.landed, demands)
    limits = ActuatorLimits(landed(problem, setup.landed).objective, setup.landed, demands)
    after = follow_through(problem, path.q[-1], path.v[-1], 0.0, limits)
    rows = after.rows
    assert rows is not None
    vars(factory)["strike"] = replace(path, strike=replace(path.strike, follow_through=after))
    record = driven(factory, "strike")
    (window,) = record.of("impact")
    assert judge(setup, record) == ()
    assert after.impacts == after.stopped == 1

    def away(run: Run, since: float, until: float) -> float:
        """Return the largest error of the height of the base, m, in an interval after the touch."""
        (touch,), (t, q) = run.of("impact"), (run.series.t, run.series.q)
        ticks = run.series.slice(touch.begin + since, touch.begin + until)
        return max(abs(z - rows.at(at - touch.begin)[0][2]) for at, z in zip(t[ticks], q[ticks, 2], strict=True))

    assert window.touched and away(record, 0.0, 0.28) < 5e-3
    # The controller without a planned stop returns to the height of the start posture.
    assert away(dropped()[1], 0.2, 0.28) > 0.01


def test_other_controllers_cannot_control_a_fall() -> None:
    with pytest.raises(InputError, match="'robust' cannot control a fall"):
        dropped()[0].driver("robust")


def test_a_robot_falls_only_once() -> None:
    scenario = scenario_of()
    assert scenario.contacts is not None
    with pytest.raises((InputError, SpecError), match="falls once"):
        replace(scenario, contacts=replace(scenario.contacts, count=2))
    with pytest.raises((InputError, SpecError), match="no 'NO_FOOT'"):
        replace(scenario, contacts=replace(scenario.contacts, others=("NO_FOOT",)))


def test_a_seed_varies_height_tilt_and_place_of_the_ground_under_the_feet() -> None:
    scenario = replace(scenario_of(), spread=Spread(speed=0.1, normal=5.0, gap=0.005))
    setup = set_up_with(scenario, 3)
    changed, built = setup.scenario, setup.world.built
    assert changed.contacts is not None and changed.contacts.speed != 1.0
    assert setup.gap == pytest.approx(0.051 * changed.contacts.speed**2)
    numeric = Numeric(setup.robot.model).at(setup.q)
    points = [numeric.placement(point_on(setup.robot, frame)) for frame in changed.contacts.frames]
    feet = np.mean([point.translation for point in points], axis=0)
    n, point = built.normals["ground"], built.points["ground"]
    assert n[2] < 1 and abs(n @ (feet - point) - 0.016 - setup.gap) < 0.0051
