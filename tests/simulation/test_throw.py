"""Thrown balls, compared with mechanics and the rigid model, and the scenarios with real impacts."""

from __future__ import annotations

import functools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from impact_posture.errors import ImpactPostureError, InputError, SpecError
from impact_posture.simulation.controllers.controller_factory import ControllerFactory
from impact_posture.simulation.metrics import measure
from impact_posture.simulation.outcome import judge
from impact_posture.simulation.prediction import predict
from impact_posture.simulation.run import run
from impact_posture.simulation.scenario_file import SHIPPED, read_scenario
from impact_posture.simulation.setup import Setup, set_up
from impact_posture.simulation.world.actuator_command import ActuatorCommand
from impact_posture.simulation.world.throw import FLIGHT, Throw, thrown_jumps
from impact_posture.simulation.world.world import World, build_world
from tests.simulation.factories import controller_factory
from tests.support.helpers import Vector
from tests.support.pinocchio_values import frame_jacobian, mass_matrix

# Scenario of a throw, flight direction of the ball, and sign of the throw.
THROWS = [("solo8-throw", (-1, 0, 0), 1), ("solo8-throw", (0.3, -0.4, -1.0), -1), ("talos-throw", (0.5, 1.0, 0.0), 1)]


@functools.cache
def thrown(name: str, direction: tuple[float, float, float] = (-1, 0, 0)) -> Setup:
    """Set up a scenario with an early throw along a direction and a short contact."""
    scenario = read_scenario(name)
    assert scenario.throw is not None
    quick = {"settle": 0.1, "patience": 0.2, "after": 0.1, "solref": (0.002, 1.0)}
    throw = replace(scenario.throw, direction=direction, friction=0.5, **quick)
    return set_up(replace(scenario, throw=throw, physics=replace(scenario.physics, timestep=0.0005)))


def ball(world: World) -> tuple[Vector, Vector]:
    """Return the position and the velocity of the ball, which belong to the last joint."""
    return world._data.qpos[-7:-4].copy(), world._data.qvel[-6:-3].copy()


@pytest.mark.parametrize(("name", "direction", "sign"), THROWS)
def test_a_ball_obeys_mechanics(name: str, direction: tuple[float, float, float], sign: int) -> None:
    setup = thrown(name, direction)
    world, throw, robot = setup.world, setup.scenario.throw, setup.robot
    assert throw is not None
    # Without gravity and motor torques, only the contact force acts on ball and robot.
    scene = replace(setup.scenario, physics=replace(setup.scenario.physics, gravity=(0, 0, 0)), surfaces=())
    world = build_world(robot, scene, setup.q, throw)
    world.reset(setup.q)
    world.throw(sign)
    assert world.ball is not None
    target = world._data.geom_xpos[world.ball._target].copy()
    begin, speed = ball(world)
    np.testing.assert_allclose(speed, sign * throw.speed * setup.scenario.normal, atol=1e-12)
    # The ball flies toward the center of the shape and touches at the expected time.
    np.testing.assert_allclose(np.cross(target - begin, speed), 0, atol=1e-9)
    still = ActuatorCommand(np.zeros(robot.nv - 6), np.zeros(0))
    frame = [s.frame for s in setup.scenario.shapes].index(throw.frame)
    reach = throw.radius + setup.scenario.shape.size[0]
    touches, depth = [], 0.0
    for _ in range(80):
        world.step(still)
        position, _ = ball(world)
        depth = max(depth, reach - float(np.linalg.norm(position - world._data.geom_xpos[world.ball._target])))
        shape = world.truth().shapes[frame]
        touches += [] if shape.began is None else [shape.began]
    assert touches[0] == pytest.approx(FLIGHT, abs=2 * world.timestep)
    # The impulse on the shape equals the momentum that the ball loses and the robot gains.
    impulse, after = shape.impulse, ball(world)[1]
    np.testing.assert_allclose(throw.mass * (speed - after), impulse, rtol=1e-6, atol=1e-9)
    data = robot.model.createData()
    truth = world.truth()
    momentum = pin.computeCentroidalMomentum(robot.model, data, truth.q, truth.v)
    # The momentum balance does not include the armature of the motors.
    np.testing.assert_allclose(momentum.linear, impulse, rtol=2e-3, atol=1e-3 * np.linalg.norm(impulse))
    # The ball neither sticks to the shape nor passes through it.
    assert 0 < depth < 0.5 * throw.speed * throw.solref[0] * 2
    assert sign * setup.scenario.normal @ impulse > throw.mass * throw.speed * 0.5


@pytest.mark.parametrize("name", ["solo8-throw", "talos-throw"])
def test_the_prediction_is_the_rigid_impact_of_two_bodies(name: str) -> None:
    setup = thrown(name, (0.5, 1.0, 0.0))
    objective = controller_factory(setup, free=True).objective()
    throw, q, model = setup.scenario.throw, setup.q, setup.robot.model
    assert throw is not None
    # Robot and ball form one system with six additional velocities.
    J = frame_jacobian(model, q, setup.robot.frame_id(throw.frame))[:3]
    M = np.zeros((setup.robot.nv + 6,) * 2)
    M[:-6, :-6] = mass_matrix(model, q)
    M[-6:-3, -6:-3], M[-3:, -3:] = throw.mass * np.eye(3), 0.4 * throw.mass * throw.radius**2 * np.eye(3)
    n = setup.scenario.normal
    # The contact point of the ball is at r n from its center.
    arm = throw.radius * np.array([[0, -n[2], n[1]], [n[2], 0, -n[0]], [-n[1], n[0], 0]])
    gap = np.hstack([J, -np.eye(3), arm])
    spread = np.linalg.solve(M, gap.T)
    before = np.zeros(len(M))
    before[-6:-3] = throw.speed * n
    stuck = spread @ np.linalg.solve(gap @ spread, -gap @ before)
    smooth = spread @ n * float(-n @ gap @ before) / float(n @ gap @ spread @ n)
    free, sticking, coulomb = thrown_jumps(objective.oracle, q, replace(throw, friction=50.0), throw.speed)
    assert free == pytest.approx(float(np.linalg.norm(smooth[:-6])), rel=1e-9)
    assert sticking == coulomb == pytest.approx(float(np.linalg.norm(stuck[:-6])), rel=1e-9)
    assert thrown_jumps(objective.oracle, q, replace(throw, friction=0.0), throw.speed)[2] == pytest.approx(free)


def test_a_standing_robot_jumps_as_predicted() -> None:
    setup = thrown("solo8-throw")
    factory = controller_factory(setup)
    (record,) = run(factory, "nominal", only=1)
    metrics = measure(setup, record)
    assert judge(setup, record) == ()
    assert metrics.contacts == metrics.contacts_asked == 1
    (impact,) = predict(setup, factory.objective(), record)
    assert impact.approach == pytest.approx(3.0, abs=0.02)
    # The ball rebounds with restitution 0.13, and the controller acts during the contact of 15 ms.
    assert impact.coulomb is not None
    assert 0.95 < metrics.peak_jump / impact.coulomb < 1.25
    assert 0.95 < metrics.impulse / impact.predicted_impact.impulse < 1.25
    assert (
        impact.predicted_impact.jump == pytest.approx(impact.coulomb) and impact.predicted_impact.peak_force is None
    )
    assert metrics.peak_force > 10
    window = record.of("impact")[0]
    assert window.begin == pytest.approx(record.waited) and window.end - window.begin == pytest.approx(0.3)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('"base_link"\nmass', '"base"\nmass', r"key 'throw.frame': there is no 'base'; one of: .*base_link"),
        ("mass = 0.2", "mass = 0.0", r"throw.mass.*above zero"),
        ("direction = [-1, 0, 0]", "direction = [0, 0, 0]", "key 'throw.direction'.*not all zero"),
        ("speed = 3.0", "sped = 3.0", r"throw.*sped.*speed"),
        ("leather on plastic\nsolref = [0.004", "leather on plastic\nsolref = [0.0004", "throw: solref"),
        ('size = [0.05]', 'kind = "box"\nsize = [0.05, 0.05, 0.05]', r"thrown at the box.*a sphere"),
        ("least = 0.1 ", 'lifted = ["FL_FOT"]\nleast = 0.1 ', r"no frame 'FL_FOT'.*FL_FOOT"),
    ],
)  # fmt: skip
def test_a_wrong_throw_is_refused(tmp_path: Path, old: str, new: str, words: str) -> None:
    text = (SHIPPED / "solo8-throw.toml").read_text(encoding="utf-8")
    assert text.count(old) == 1
    path = tmp_path / "mine.toml"
    path.write_text(text.replace(old, new), encoding="utf-8")
    with pytest.raises(ImpactPostureError, match=words) as caught:
        ControllerFactory(set_up(read_scenario(path))).driver("nominal")
    assert "\n" not in caught.value.line and caught.value.hint


def test_a_world_without_a_ball_cannot_throw() -> None:
    setup = set_up(read_scenario("solo8-push"))
    setup.world.reset(setup.q)
    with pytest.raises(InputError, match=r"has no ball.*\[throw\]"):
        setup.world.throw()
    with pytest.raises((InputError, SpecError), match="not all zero"):
        Throw(frame="a", mass=1.0, radius=0.1, speed=1.0, direction=(0.0, 0.0, 0.0))
