"""Traces of many ticks, compared with single ticks; contact forces, compared with MuJoCo."""

from __future__ import annotations

import numpy as np
import pytest

from impact_posture.errors import InputError
from impact_posture.simulation.world import contact_forces
from impact_posture.simulation.world.actuator_command import ActuatorCommand
from impact_posture.simulation.world.world import World
from tests.simulation.factories import shared_setup
from tests.support.helpers import rng

mujoco = pytest.importorskip("mujoco", reason="mujoco is not installed (the extra 'sim')")

# A flying robot, a standing robot and a fixed-base robot, which all move into their surfaces.
SCENARIOS = ("aerial-vertical", "solo8-push", "panda-tap")


def shaken(name: str, ticks: int = 40) -> tuple[World, list[ActuatorCommand]]:
    """Return a world near its surface, and commands that move the robot toward it."""
    setup, random = shared_setup(name), rng(name)
    robot, world = setup.robot, setup.world
    rotors = 0 if robot.spec.propulsion is None else len(robot.spec.propulsion.rotors)
    joints = robot.nv - robot.first_joint
    v = np.zeros(robot.nv)
    if robot.floating:
        # The flying robot must reach the surface within the simulated ticks.
        v[2] = -10.0 if rotors else -1.0
    world.reset(setup.q, v, seed=1)
    return world, [ActuatorCommand(random.normal(size=joints), np.full(rotors, 16.0)) for _ in range(ticks)]


@pytest.mark.parametrize("name", SCENARIOS)
def test_a_trace_has_the_state_of_every_tick(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    world, commands = shaken(name)
    truths = []
    for command in commands:
        world.step(command, 3)
        truths.append(world.truth())
    shaken(name)
    monkeypatch.setattr(contact_forces, "_MOST", 5)
    for k, command in enumerate(commands):
        world.step(command, 3)
        # The trace is marked only after the first ticks, so all earlier steps are evaluated at the first mark.
        if k > 15:
            world.mark()
    trace = world.trace()
    for k, truth in enumerate(truths[16:]):
        for key in ("t", "q", "v", "rotor_speeds", "torques"):
            np.testing.assert_array_equal(getattr(trace, key)[k], getattr(truth, key), key)
        stops = [name for name, stopped in zip(world.stops.names, trace.stopped[k], strict=True) if stopped]
        assert tuple(stops) == truth.at_stops
        for j, shape in enumerate(truth.shapes):
            assert trace.touching[k, j] == shape.touching and trace.slip[k, j] == shape.slip
            np.testing.assert_array_equal(trace.force[k, j], shape.force)
            np.testing.assert_allclose(trace.impulse[k, j], shape.impulse, rtol=1e-12, atol=1e-15)
            if k:
                assert trace.peak[k, j] == shape.peak
                assert np.isnan(trace.began[k, j]) if shape.began is None else trace.began[k, j] == shape.began
    # The first mark of a trace includes the force peaks and touches of all ticks before this mark.
    for j in range(len(truths[0].shapes)):
        assert trace.peak[0, j] == max(truth.shapes[j].peak for truth in truths[:17])
        began = [t.shapes[j].began for t in truths[:17] if t.shapes[j].began is not None]
        assert np.isnan(trace.began[0, j]) if not began else trace.began[0, j] == began[0]
    assert name == "panda-tap" or trace.touching.any()


def test_forces_agree_with_mujoco() -> None:
    world, commands = shaken("solo8-push")
    model, data, copy = world._model, world._data, mujoco.MjData(world._model)
    shape_of = {model.geom(name).id: k for k, (name,) in enumerate(world.built.shape_geoms)}
    pushed = 0
    for command in commands:
        mujoco.mj_copyData(copy, model, data)
        world.step(command)
        truth = world.truth()
        # Use the contacts from the beginning of the step.  Compute the contacts in a copy, because the step of the
        # world has overwritten them.
        copy.ctrl[:] = truth.torques
        mujoco.mj_step2(model, copy)
        forces = np.zeros((len(shape_of), 3))
        for k in range(copy.ncon):
            wrench = np.zeros(6)
            mujoco.mj_contactForce(model, copy, k, wrench)
            forces[shape_of[int(copy.contact.geom[k, 1])]] += wrench[:3] @ copy.contact.frame[k].reshape(3, 3)
        pushed += bool(np.any(forces))
        for shape, force in zip(truth.shapes, forces, strict=True):
            np.testing.assert_allclose(shape.force, force, rtol=1e-12, atol=1e-12)
    assert pushed > 10


def test_a_trace_without_marks_is_refused() -> None:
    world, _ = shaken("solo8-push")
    with pytest.raises(InputError, match="call mark"):
        world.trace()
