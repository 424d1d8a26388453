"""Impacts of a robot that nobody controls against the rigid model, and flights without any."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

from impact_posture.robot.robot import Robot
from impact_posture.simulation.metrics import JUMP, before, measure
from impact_posture.simulation.prediction import Prediction, predict
from impact_posture.simulation.recorder import Recorder
from impact_posture.simulation.run import Run
from impact_posture.simulation.scenario_file import read_scenario
from impact_posture.simulation.scenario_objective import scenario_objective
from impact_posture.simulation.series import Window
from impact_posture.simulation.setup import Setup
from impact_posture.simulation.world.actuator_command import ActuatorCommand
from impact_posture.simulation.world.contact_law import ContactLaw
from impact_posture.simulation.world.scene import Physics, Scene, Sensors
from impact_posture.simulation.world.world import build_world
from impact_posture.tsid.controller import Command, Status
from tests.simulation.factories import driven, factory, needs_mujoco
from tests.support.helpers import Vector, frame_jacobian, mass_matrix, rng, robot

NONE = np.zeros(0)
WEIGHTLESS = Physics(gravity=(0.0, 0.0, 0.0))


@pytest.fixture(scope="module", autouse=True)
def _mujoco() -> None:
    needs_mujoco()


@functools.cache
def adrift(law: ContactLaw, timestep: float) -> Setup:
    """The vertical scenario's robot without rotors and weight, its tip 2 mm above the floor."""
    scenario, found = read_scenario("aerial-vertical"), factory("aerial-vertical").setup
    body = replace(found.robot, spec=replace(found.robot.spec, propulsion=None))
    floor = replace(scenario.surfaces[0], gap=0.002, **vars(law))
    scenario = replace(scenario, surfaces=(floor,), physics=replace(WEIGHTLESS, timestep=timestep), sensors=Sensors())
    return Setup(scenario, body, found.q, build_world(body, scenario, found.q))


def drop(law: ContactLaw, q: Vector, speed: float = 0.5, timestep: float = 2.5e-4) -> tuple[Prediction, Run, Setup]:
    """Let it drift into the floor as one body, its motors at rest."""
    setup = adrift(law, timestep)
    objective, world = scenario_objective(setup), setup.world
    v = np.zeros(9)
    v[:3] = pin.Quaternion(q[3:7]).matrix().T @ np.array([0, 0, -speed])
    world.reset(q, v)
    recorder = Recorder(setup, objective.value)
    rest = Command(np.zeros(3), np.zeros(3), NONE, Status.SOLVED, np.zeros(9), NONE)
    for _ in range(60):
        world.step(ActuatorCommand(np.zeros(3), NONE), round(1e-3 / timestep))
        recorder.take(rest, 0.0, 0.0)
    touch = recorder.first_touch(0.0, np.inf)
    assert touch is not None
    run = Run(recorder.series(), (Window("impact", 0, touch, touch + 0.03, True),))
    (found,) = predict(setup, objective, run)
    return found, run, setup


def restitution(setup: Setup, run: Run, speed: float) -> float:
    """From the normal speed of the tip when its jump is over."""
    k = before(run.series, run.windows[0])
    frame = setup.robot.frame_id("ee")
    away = [
        frame_jacobian(setup.robot.model, run.series.q[k + i], frame)[2] @ run.series.v[k + i] for i in range(1, 9)
    ]
    return float(max(away)) / speed


def postures() -> list[Vector]:
    """The scenario's start and others in which the lower link, too, hangs straight down: the same point touches."""
    start = factory("aerial-vertical").setup.q
    found = [start]
    for pitch, elbow in ((-0.3, 0.3), (-0.6, 0.6), (-1.2, 1.2)):
        q = start.copy()
        q[8:10] = pitch, elbow
        found.append(q)
    return found


@pytest.mark.parametrize("k", range(4))
def test_a_drop_without_friction_jumps_as_predicted(k: int) -> None:
    # The surface stands where the start posture's tip is 2 mm above it: others begin as far above it.
    q = postures()[k]
    setup = adrift(ContactLaw(friction=0.0), 2.5e-4)
    frame, data = setup.robot.frame_id("ee"), setup.robot.model.createData()
    heights = []
    for at in (setup.q, q):
        pin.framesForwardKinematics(setup.robot.model, data, at)
        heights.append(data.oMf[frame].translation[2])
    q = q.copy()
    q[2] += heights[0] - heights[1] - 0.001
    found, run, setup = drop(ContactLaw(friction=0.0), q)
    assert found.approach == pytest.approx(0.5, rel=1e-6)
    e = restitution(setup, run, 0.5)
    assert 0.05 < e < 0.25
    # Stated band: 5 %, for the 4 ms that the contact takes (tests/simulation/test_world.py has 3 % for the impact
    # alone).
    assert found.measured == pytest.approx((1 + e) * 0.5 * np.sqrt(found.V), rel=0.05)
    assert found.frictionless == pytest.approx(0.5 * np.sqrt(found.V))
    assert found.coulomb == pytest.approx(found.frictionless)
    # And V is the formula's.
    M = mass_matrix(setup.robot.model, q)
    J = frame_jacobian(setup.robot.model, q, frame)[2]
    a = np.linalg.solve(M, J)
    assert pytest.approx(a @ a / (J @ a) ** 2, rel=1e-3) == found.V
    assert pytest.approx(a @ a, rel=1e-3) == found.H and pytest.approx(J @ a, rel=1e-3) == found.G


def test_a_drop_that_sticks_jumps_as_predicted() -> None:
    law = ContactLaw(solref=(2e-4, 1.0), solimp=(0.9999, 0.9999, 0.001), friction=10.0)
    found, run, setup = drop(law, factory("aerial-vertical").setup.q, timestep=2.5e-5)
    e = restitution(setup, run, 0.5)
    assert found.S is not None and found.sticking == pytest.approx(0.5 * np.sqrt(found.S))
    assert found.coulomb == pytest.approx(found.sticking)
    # Stated band: 5 %; the frictionless prediction is far off.
    assert found.measured == pytest.approx((1 + e) * 0.5 * np.sqrt(found.S), rel=0.05)
    assert abs(found.measured / ((1 + e) * found.frictionless) - 1) > 0.2


@pytest.mark.parametrize("friction", [0.1, 0.3])
def test_a_drop_that_slides_jumps_as_predicted(friction: float) -> None:
    law = ContactLaw(solref=(2e-4, 1.0), solimp=(0.9999, 0.9999, 0.001), friction=friction)
    found, run, setup = drop(law, factory("aerial-vertical").setup.q, timestep=2.5e-5)
    e = restitution(setup, run, 0.5)
    assert found.coulomb is not None and found.sticking is not None
    assert found.measured == pytest.approx((1 + e) * found.coulomb, rel=0.05)
    assert found.ratio == pytest.approx(found.measured / found.coulomb)


def test_the_peak_is_the_impacts_and_nothing_else_moves_it() -> None:
    found, run, setup = drop(ContactLaw(friction=0.0), factory("aerial-vertical").setup.q)
    metrics = measure(setup, run)
    assert metrics.peak_jump == found.measured and metrics.contacts == 1
    k = before(run.series, run.windows[0])
    ahead = run.series.v[k + 1 : k + 1 + round(JUMP / 1e-3)] - run.series.v[k]
    assert metrics.peak_jump == pytest.approx(np.linalg.norm(ahead, axis=1).max())
    assert not run.series.touching[:k].any() and run.series.touching.any()
    assert np.isnan(run.series.objective[1]) and run.series.objective[0] == pytest.approx(found.H, rel=1e-2)


def test_a_pushs_prediction_is_the_impulses() -> None:
    made = factory("solo8-push")
    run = driven(made, "nominal")
    (found,) = predict(made.setup, made.objective(), run)
    assert found.approach == pytest.approx(6.5 * 0.2) and found.sticking is None
    assert found.frictionless == pytest.approx(6.5 * 0.2 * np.sqrt(found.H))
    assert found.H == pytest.approx(made.objective().value(made.setup.q), rel=0.02)
    assert found.ratio == pytest.approx(found.measured / found.frictionless)


# ---- flight -------------------------------------------------------------------------------------------------------


def free_body(name: str) -> Robot:
    found = robot(name)
    return replace(found, spec=replace(found.spec, propulsion=None))


@pytest.mark.parametrize("name", ["solo8", "go2", "talos"])
def test_a_robot_thrown_through_the_air_keeps_momentum_and_energy(name: str) -> None:
    found = free_body(name)
    world = build_world(found, Scene(physics=Physics(timestep=1e-4)))
    model, data = found.model, found.model.createData()
    v = 0.3 * rng(name, "thrown").normal(size=found.nv)
    v[:3] += [1.0, 0.5, 2.0]
    q = found.posture()
    # Off the stops on which grippers begin.
    low, high = np.asarray(model.lowerPositionLimit)[7:], np.asarray(model.upperPositionLimit)[7:]
    room = np.minimum(0.1, (high - low) / 4)
    q[7:] = np.clip(q[7:], low + room, high - room)
    world.reset(q, v)
    rows = []
    for steps in (0, 1000):
        world.step(ActuatorCommand(np.zeros(found.nv - 6), NONE), steps)
        truth = world.truth()
        assert not truth.at_stops
        momentum = np.array(pin.computeCentroidalMomentum(model, data, truth.q, truth.v).vector)
        kinetic = pin.computeKineticEnergy(model, data, truth.q, truth.v)
        rows.append((momentum, kinetic + pin.computePotentialEnergy(model, data, truth.q), kinetic))
    (h0, e0, kinetic), (h1, e1, _) = rows
    fallen = found.mass * np.array([0, 0, -9.81]) * 0.1
    # First order in the time step; bands ten times what 0.1 ms leaves.
    np.testing.assert_allclose(h1[:3], h0[:3] + fallen, atol=2e-3 * np.abs(h0[:3]).max())
    np.testing.assert_allclose(h1[3:], h0[3:], atol=5e-3 * np.abs(h0[3:]).max())
    assert abs(e1 - e0) < 5e-3 * kinetic


def test_rotors_give_the_momentum_that_their_thrust_is() -> None:
    setup = factory("aerial-vertical").setup
    found, world, propulsion = setup.robot, setup.world, setup.robot.spec.propulsion
    assert propulsion is not None
    speeds = np.full(6, 60.0)
    world.reset(setup.q, rotor_speed=speeds)
    data, momenta = found.model.createData(), []
    for steps in (0, 80):
        world.step(ActuatorCommand(np.zeros(3), speeds), steps)
        truth = world.truth()
        momenta.append(np.array(pin.computeCentroidalMomentum(found.model, data, truth.q, truth.v).linear))
    thrust = sum(propulsion.thrust_coefficient * 3600 * np.array(r.direction) for r in propulsion.rotors)
    turned = pin.Quaternion(truth.q[3:7]).matrix()
    assert np.abs(turned - np.eye(3)).max() < 0.02
    expected = 0.02 * (thrust + found.mass * np.array([0, 0, -9.81]))
    np.testing.assert_allclose(momenta[1] - momenta[0], expected, atol=0.02 * np.abs(expected).max())
