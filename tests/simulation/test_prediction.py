"""Predicted impacts, compared with simulated impacts of an uncontrolled robot."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

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
from impact_posture.simulation.world.scene import Physics, Sensors
from impact_posture.simulation.world.world import build_world
from impact_posture.tsid.controller import Command, Status
from tests.simulation.factories import driven, shared_factory
from tests.support.helpers import Vector
from tests.support.pinocchio_values import frame_jacobian, mass_matrix

NONE = np.zeros(0)
WEIGHTLESS = Physics(gravity=(0.0, 0.0, 0.0))


@functools.cache
def adrift(law: ContactLaw, timestep: float) -> Setup:
    """Set up the aerial robot without rotors and gravity, with its tip 2 mm above the floor."""
    scenario, original = read_scenario("aerial-vertical"), shared_factory("aerial-vertical").setup
    body = replace(original.robot, spec=replace(original.robot.spec, propulsion=None))
    floor = replace(scenario.surfaces[0], gap=0.002, **vars(law))
    scenario = replace(scenario, surfaces=(floor,), physics=replace(WEIGHTLESS, timestep=timestep), sensors=Sensors())
    return Setup(scenario, body, original.q, build_world(body, scenario, original.q))


def drop(law: ContactLaw, q: Vector, speed: float = 0.5, timestep: float = 2.5e-4) -> tuple[Prediction, Run, Setup]:
    """Let the robot drift into the floor with its motors off."""
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
    (touch,) = recorder.first_touches(0.0, np.inf)
    run = Run(recorder.series(), (Window("impact", 0, touch, touch + 0.03, True),))
    (prediction,) = predict(setup, objective, run)
    return prediction, run, setup


def restitution(setup: Setup, run: Run, speed: float) -> float:
    """Return the restitution, from the largest normal speed of the tip after the touch."""
    k = before(run.series, run.windows[0])
    frame = setup.robot.frame_id("ee")
    ticks = zip(run.series.q[k + 1 : k + 9], run.series.v[k + 1 : k + 9], strict=True)
    return float(max(frame_jacobian(setup.robot.model, q, frame)[2] @ v for q, v in ticks)) / speed


def postures() -> list[Vector]:
    """Return the start and other postures whose lower link is vertical, so that the same point touches."""
    start = shared_factory("aerial-vertical").setup.q
    configurations = [start]
    for pitch, elbow in ((-0.3, 0.3), (-1.2, 1.2)):
        q = start.copy()
        q[8:10] = pitch, elbow
        configurations.append(q)
    return configurations


@pytest.mark.parametrize("k", range(3))
def test_a_frictionless_impact_jumps_as_predicted(k: int) -> None:
    # Raise the robot so that its tip is 1 mm above the surface.
    q = postures()[k]
    setup = adrift(ContactLaw(friction=0.0), 2.5e-4)
    frame, data = setup.robot.frame_id("ee"), setup.robot.model.createData()
    heights = []
    for at in (setup.q, q):
        pin.framesForwardKinematics(setup.robot.model, data, at)
        heights.append(data.oMf[frame].translation[2])
    q = q.copy()
    q[2] += heights[0] - heights[1] - 0.001
    prediction, run, setup = drop(ContactLaw(friction=0.0), q)
    assert prediction.approach == pytest.approx(0.5, rel=1e-6)
    e = prediction.restitution
    assert e is not None and 0.05 < e < 0.25
    # The tolerance is 5 %, because the contact lasts 4 ms (test_world.py allows 3 % for the impact alone).
    measured = restitution(setup, run, 0.5)
    assert prediction.measured == pytest.approx((1 + measured) * 0.5 * np.sqrt(prediction.V), rel=0.05)
    assert prediction.frictionless == pytest.approx((1 + e) * 0.5 * np.sqrt(prediction.V))
    assert prediction.measured == pytest.approx(prediction.frictionless, rel=0.05)
    assert prediction.coulomb == pytest.approx(prediction.frictionless)
    # V, H and G agree with their formulas.
    M = mass_matrix(setup.robot.model, q)
    J = frame_jacobian(setup.robot.model, q, frame)[2]
    a = np.linalg.solve(M, J)
    assert pytest.approx(a @ a / (J @ a) ** 2, rel=1e-3) == prediction.V
    assert pytest.approx(a @ a, rel=1e-3) == prediction.H and pytest.approx(J @ a, rel=1e-3) == prediction.G


def test_a_sticking_impact_jumps_as_predicted() -> None:
    law = ContactLaw(solref=(2e-4, 1.0), solimp=(0.9999, 0.9999, 0.001), friction=10.0)
    prediction, run, setup = drop(law, shared_factory("aerial-vertical").setup.q, timestep=2.5e-5)
    e, measured = prediction.restitution, restitution(setup, run, 0.5)
    assert e is not None and prediction.S is not None
    assert prediction.sticking == pytest.approx((1 + e) * 0.5 * np.sqrt(prediction.S))
    assert prediction.coulomb == pytest.approx(prediction.sticking)
    assert prediction.measured == pytest.approx((1 + measured) * 0.5 * np.sqrt(prediction.S), rel=0.05)
    assert prediction.measured == pytest.approx(prediction.coulomb, rel=0.05)
    # The frictionless prediction differs strongly from the measurement.
    assert abs(prediction.measured / prediction.frictionless - 1) > 0.2


@pytest.mark.parametrize("friction", [0.1, 0.3])
def test_a_sliding_impact_jumps_as_predicted(friction: float) -> None:
    law = ContactLaw(solref=(2e-4, 1.0), solimp=(0.9999, 0.9999, 0.001), friction=friction)
    prediction, run, setup = drop(law, shared_factory("aerial-vertical").setup.q, timestep=2.5e-5)
    assert prediction.restitution is not None and prediction.coulomb is not None and prediction.sticking is not None
    # The convex model of MuJoCo lifts a sliding contact, so the measured restitution is larger than the restitution
    # of the law.
    more = (1 + restitution(setup, run, 0.5)) / (1 + prediction.restitution)
    assert prediction.measured == pytest.approx(more * prediction.coulomb, rel=0.05)
    assert prediction.ratio == pytest.approx(prediction.measured / prediction.coulomb)
    # Base, worst joint and normal impulse also contain the rebound.
    predicted, measured = prediction.predicted_impact, prediction.measured_impact
    for name in ("base_linear", "base_angular", "impulse"):
        assert getattr(measured, name) == pytest.approx(more * getattr(predicted, name), rel=0.05), name
    assert measured.joint is not None and predicted.joint is not None and measured.joint.name == predicted.joint.name
    assert measured.joint.share == pytest.approx(more * (predicted.joint.share or 0), rel=0.05)
    assert (predicted.jump, measured.jump) == (prediction.coulomb, prediction.measured)


def test_the_peak_jump_is_the_jump_of_the_impact() -> None:
    prediction, run, setup = drop(ContactLaw(friction=0.0), shared_factory("aerial-vertical").setup.q)
    metrics = measure(setup, run)
    assert metrics.peak_jump == prediction.measured and metrics.contacts == 1
    k = before(run.series, run.windows[0])
    ahead = run.series.v[k + 1 : k + 1 + round(JUMP / 1e-3)] - run.series.v[k]
    assert metrics.peak_jump == pytest.approx(np.linalg.norm(ahead, axis=1).max())
    # Nothing else acts on the drifting robot, so the impulse is the change of its momentum.
    model, momentum = setup.robot.model, []
    for at in (k, k + round(JUMP / 1e-3)):
        data = model.createData()
        pin.centerOfMass(model, data, run.series.q[at], run.series.v[at])
        momentum.append(data.mass[0] * data.vcom[0] @ setup.scenario.normal)
    assert metrics.impulse == pytest.approx(momentum[1] - momentum[0], rel=1e-3) and metrics.impulse > 0.1
    assert not run.series.touching[:k].any() and run.series.touching.any()
    assert np.isnan(run.series.objective[1]) and run.series.objective[0] == pytest.approx(prediction.H, rel=1e-2)


def test_the_prediction_of_a_push_follows_from_its_impulse() -> None:
    factory = shared_factory("solo8-push")
    run = driven(factory, "nominal")
    (prediction,) = predict(factory.setup, factory.objective(), run)
    assert prediction.approach == pytest.approx(6.5 * 0.2) and prediction.sticking is None
    assert prediction.frictionless == pytest.approx(6.5 * 0.2 * np.sqrt(prediction.H))
    assert prediction.H == pytest.approx(factory.objective().value(factory.setup.q), rel=0.02)
    assert prediction.ratio == pytest.approx(prediction.measured / prediction.frictionless)
    assert prediction.predicted_impact.impulse == pytest.approx(6.5 * 0.2)
    assert prediction.measured_impact.impulse == pytest.approx(6.5 * 0.2)
    assert prediction.predicted_impact.peak_force == prediction.measured_impact.peak_force == pytest.approx(6.5)
    q = run.series.q[before(run.series, run.windows[0])]
    velocity = prediction.approach * factory.objective().oracle.quantities(q).jump
    assert prediction.predicted_impact.base_linear == pytest.approx(np.linalg.norm(velocity[:3]))
