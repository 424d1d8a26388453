"""Simulated world: dynamics compared with Pinocchio, impacts compared with the rigid model, and actuators."""

from __future__ import annotations

import functools
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from impact_posture.impact.impact_contact import ImpactContact
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.robot.actuation import actuation_matrix, hover
from impact_posture.robot.robot import Robot
from impact_posture.robot.robot_loader import load_robot
from impact_posture.simulation.world.actuator_command import ActuatorCommand, Push, Truth
from impact_posture.simulation.world.contact_law import ContactLaw
from impact_posture.simulation.world.scene import Physics, Scene, Sensors, Shape, Surface
from impact_posture.simulation.world.world import World, build_world
from impact_posture.simulation.world.world_builder import build_scene
from tests.dynamics.test_mjcf import qacc
from tests.support.helpers import NAMES, Vector, assert_close, random_configurations, rng
from tests.support.helpers import robot as known_robot
from tests.support.mjcfs import ARM as MJCF_ARM
from tests.support.pinocchio_values import mass_matrix
from tests.support.restitution import ball

mujoco = pytest.importorskip("mujoco", reason="mujoco is not installed (the extra 'sim')")

NONE = np.zeros(0)
WEIGHTLESS = Physics(gravity=(0, 0, 0))
FLOOR = Surface("floor", (0, 0, 1))


@functools.cache
def without_rotors(name: str) -> Robot:
    robot = known_robot(name)
    return replace(robot, spec=replace(robot.spec, propulsion=None))


def idle(robot: Robot) -> ActuatorCommand:
    joints = robot.nv - robot.first_joint
    return ActuatorCommand(np.zeros(joints), NONE)


# ---- dynamics ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", NAMES)
def test_shapes_surfaces_and_actuators_do_not_change_the_dynamics(name: str) -> None:
    robot = known_robot(name)
    frame = robot.spec.contact.frame or robot.frame_names[-1]
    scene = Scene((FLOOR,), (Shape(frame, (0.05, 0.04, 0.03), "box"),))
    built = build_scene(robot, scene, robot.posture())
    model, layout = built.mjcf.compile(), built.mjcf.layout
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    data, G = mujoco.MjData(model), actuation_matrix(robot.model, robot.spec.propulsion)
    assert model.nu == G.shape[1]
    for k, q in enumerate([robot.posture(), *random_configurations(robot.model, 2, name, "world")]):
        generator = rng(name, "world", k)
        v, u = generator.normal(size=robot.nv), generator.normal(size=model.nu)
        data.qpos[:], data.qvel[:], data.ctrl[:] = layout.qpos(q), layout.qvel(q, v), u
        mujoco.mj_forward(model, data)
        M, T = np.zeros((robot.nv, robot.nv)), layout.velocity_map(q)
        mujoco.mj_fullM(model, data, M)
        assert_close(T.T @ M @ T, mass_matrix(robot.model, q), 1e-9, "M")
        a = pin.aba(robot.model, robot.model.createData(), q, v, G @ u)
        assert_close(data.qacc, qacc(layout, q, v, a), 1e-9, "acceleration")


def test_joints_of_an_mjcf_have_its_passive_forces(tmp_path: Path) -> None:
    text = MJCF_ARM.replace('damping="1"', 'damping="1 .2" stiffness="3 .5" springref=".2"')
    (tmp_path / "arm.xml").write_text(text)
    robot = load_robot(str(tmp_path / "arm.xml"), lock=("shoulder",))
    built = build_scene(robot, Scene(), robot.posture()).mjcf
    source, model = mujoco.MjModel.from_xml_string(text), built.compile()
    own, ours = mujoco.MjData(source), mujoco.MjData(model)
    for q in random_configurations(robot.model, 3, "passive"):
        v = rng("passive").normal(size=robot.nv)
        ours.qpos[:], ours.qvel[:] = built.layout.qpos(q), v
        own.qpos[:], own.qvel[:] = np.r_[0.5, ours.qpos], np.r_[0, v]
        mujoco.mj_forward(model, ours)
        mujoco.mj_forward(source, own)
        assert np.abs(ours.qfrc_passive[0]) > 0.1
        assert_close(ours.qfrc_passive, own.qfrc_passive[1:], 1e-12, "passive forces")
    assert np.array_equal(model.dof_frictionloss, [0, 0.1, 0])


def flight(timestep: float, seconds: float = 0.2) -> tuple[Robot, Truth, Truth]:
    robot = known_robot("solo8")
    world = build_world(robot, Scene(physics=Physics(timestep)))
    v = rng("flight").normal(size=robot.nv)
    v[3:6] *= 2
    world.reset(robot.posture(), v)
    before = world.truth()
    world.step(idle(robot), round(seconds / timestep))
    return robot, before, world.truth()


def momentum_and_energy(robot: Robot, truth: Truth) -> tuple[Vector, float]:
    data = robot.model.createData()
    momentum = np.array(pin.computeCentroidalMomentum(robot.model, data, truth.q, truth.v).vector)
    kinetic = pin.computeKineticEnergy(robot.model, data, truth.q, truth.v)
    return momentum, float(kinetic + pin.computePotentialEnergy(robot.model, data, truth.q))


def test_free_flight_keeps_momentum_and_energy() -> None:
    errors = []
    for timestep in (5e-4, 2.5e-4):
        robot, before, after = flight(timestep)
        assert not after.at_stops
        (h0, e0), (h1, e1) = momentum_and_energy(robot, before), momentum_and_energy(robot, after)
        fallen = robot.mass * np.array(robot.model.gravity.linear) * after.t
        assert after.t == pytest.approx(0.2)
        errors.append([np.abs(h1[:3] - h0[:3] - fallen).max(), np.abs(h1[3:] - h0[3:]).max(), abs(e1 - e0)])
        scale = [np.abs(h0[:3]).max(), np.abs(h0[3:]).max(), e0]
        assert (np.array(errors[-1]) < 2e-3 * np.array(scale)).all(), errors
    # The integration errors are of first order in the time step.
    np.testing.assert_allclose(np.array(errors[0]) / errors[1], 2, rtol=0.3)


# ---- impacts ------------------------------------------------------------------------------------------------------


def impact(law: ContactLaw, timestep: float, speed: float = 0.5) -> tuple[WorstCaseObjective, Vector, Vector, Truth]:
    """Let a flying arm hit the floor; return the objective, q, Δν, and the true state after the impact."""
    robot = without_rotors("tilthex_arm")
    q = robot.posture()
    scene = Scene(
        (Surface("floor", (0, 0, 1), gap=1e-6, **vars(law)),), (Shape("ee", size=(0.015,)),),
        replace(WEIGHTLESS, timestep=timestep),
    )  # fmt: skip
    world = build_world(robot, scene)
    before = np.zeros(robot.nv)
    before[2] = -speed
    world.reset(q, before)
    touched = False
    for _ in range(2000):
        world.step(idle(robot))
        truth = world.truth()
        touched |= truth.shapes[0].touching
        if touched and not truth.shapes[0].touching:
            break
    assert touched and not truth.shapes[0].touching
    return WorstCaseObjective(robot, ImpactContact("ee", (0, 0, 1))), q, truth.v - before, truth


def restitution(objective: WorstCaseObjective, truth: Truth, speed: float) -> float:
    oracle = objective.oracle.at(truth.q)
    return float(oracle.n @ oracle.J @ truth.v) / speed


@pytest.mark.parametrize(("scale", "tolerance"), [(1.0, 0.03), (0.1, 0.003)])
def test_a_frictionless_impact_agrees_with_the_rigid_model(scale: float, tolerance: float) -> None:
    default = ContactLaw(friction=0.0)
    law = replace(default, solref=(default.solref[0] * scale, 1.0))
    objective, q, jump, truth = impact(law, 2.5e-4 * scale)
    quantities = objective.oracle.quantities(q)
    impulse = float(truth.shapes[0].impulse[2])
    e = restitution(objective, truth, 0.5)
    assert 0.05 < e < 0.2
    assert impulse == pytest.approx((1 + e) * 0.5 / quantities.G, rel=tolerance)
    assert_close(jump, quantities.jump * impulse, tolerance, "jump")


def test_a_sticking_impact_agrees_with_the_rigid_model() -> None:
    law = ContactLaw(solref=(2e-4, 1.0), solimp=(0.9999, 0.9999, 0.001), friction=10.0)
    objective, q, jump, truth = impact(law, 2.5e-5)
    quantities = objective.oracle.quantities(q)
    assert quantities.sticking_jump is not None
    e = restitution(objective, truth, 0.5)
    predicted = (1 + e) * 0.5 * np.asarray(quantities.sticking_jump)
    assert_close(jump, predicted, 0.03, "jump")
    # The frictionless jump differs clearly from the simulated jump.
    assert np.linalg.norm(jump - (1 + e) * 0.5 * quantities.jump / quantities.G) > 0.2 * np.linalg.norm(jump)


def test_the_impulse_of_the_surface_changes_the_momentum() -> None:
    objective, q, _, truth = impact(ContactLaw(friction=0.3), 2.5e-4)
    robot = objective.robot
    before, data = np.zeros(robot.nv), robot.model.createData()
    before[2] = -0.5
    h0 = np.array(pin.computeCentroidalMomentum(robot.model, data, q, before).linear)
    h1 = np.array(pin.computeCentroidalMomentum(robot.model, data, truth.q, truth.v).linear)
    assert_close(h1 - h0, truth.shapes[0].impulse, 1e-3, "momentum")
    f = truth.shapes[0].impulse
    # The contact slides at times, so the tangential impulse must stay within the Coulomb limit.
    assert 0 < np.linalg.norm(f[:2]) <= 0.3 * f[2] * (1 + 1e-6)


@pytest.mark.parametrize("normal", [(0, 0, 1), (-1, 0, 0), (1, 2, -2)])
def test_a_ball_hits_surfaces_of_any_direction(normal: tuple[float, float, float]) -> None:
    n = np.array(normal) / np.linalg.norm(normal)
    scene = Scene((Surface("s", normal, gap=0.1),), (Shape("ball", size=(0.02,)),), WEIGHTLESS)
    world = build_world(ball(), scene)
    world.reset([0, 0, 0, 0, 0, 0, 1], [*(-2 * n), 0, 0, 0])
    assert world.built.gaps["s", "ball"] == pytest.approx(0.1)
    world.step(ActuatorCommand(NONE, NONE), 240)
    truth = world.truth()
    (shape,) = truth.shapes
    assert shape.began == pytest.approx(0.05, abs=5e-4)
    assert shape.peak > 0 and not shape.touching
    assert_close(shape.impulse, np.linalg.norm(shape.impulse) * n, 1e-6, "direction")
    assert truth.v[:3] @ n > 0
    # The first touch is reported only once.
    assert world.truth().shapes[0].began is None


def test_a_box_rests_on_a_face() -> None:
    turned = pin.SE3ToXYZQUAT(pin.SE3(pin.utils.rotate("y", np.pi / 2), np.zeros(3)))
    scene = Scene((FLOOR,), (Shape("ball", (0.1, 0.06, 0.02), "box", offset=(0.0, 0.0, 0.0)),))
    world = build_world(ball(2.0), scene, turned)
    # The axis −x of the frame points up, so the frame origin is on the bottom face of the shape.
    assert world.built.points["floor"][2] == pytest.approx(0.0, abs=1e-12)
    world.reset(turned)
    world.step(ActuatorCommand(NONE, NONE), 4000)
    truth = world.truth()
    assert truth.shapes[0].touching
    assert truth.shapes[0].force[2] == pytest.approx(2 * 9.81, rel=1e-3)
    assert truth.shapes[0].slip < 1e-3
    assert np.abs(truth.q[3:] - turned[3:]).max() < 1e-3


def test_a_shape_has_the_friction_of_each_surface() -> None:
    smooth = Surface("smooth", (0, 0, 1), friction=0.0)
    rough = Surface("rough", (-1, 0, 0), point=(0.02, 0, 0), friction=0.5)
    world = build_world(ball(), Scene((smooth, rough), (Shape("ball", size=(0.02,), center=(0, 0, 0)),)))
    world.reset([0, 0, 0, 0, 0, 0, 1], [1, 0.5, 0, 0, 0, 0])
    world.step(ActuatorCommand(NONE, NONE), 100)
    (shape,) = world.truth().shapes
    assert shape.impulse[0] < -1 and shape.impulse[2] > 0
    # Only the wall has friction, so the tangential force stays below the friction limit of the wall.
    assert -0.5 * abs(shape.impulse[0]) * (1 + 1e-9) <= shape.impulse[1] < -0.05


# ---- actuators --------------------------------------------------------------------------------------------------


def flying(**sensors: Any) -> tuple[Robot, World, ActuatorCommand]:
    robot = known_robot("tilthex_arm")
    assert robot.spec.propulsion is not None
    wanted = hover(robot.model, robot.spec.propulsion, robot.posture())
    world = build_world(robot, Scene(sensors=Sensors(**sensors)))
    world.reset(robot.posture())
    return robot, world, ActuatorCommand(wanted.joint_torques, wanted.speeds)


def test_a_hovering_robot_stays_in_place() -> None:
    robot, world, drive = flying()
    world.step(drive, 400)
    truth = world.truth()
    assert np.abs(truth.v).max() < 1e-9
    assert np.abs(pin.difference(robot.model, robot.posture(), truth.q)).max() < 1e-9
    assert_close(truth.rotor_speeds, drive.rotor_speed, 1e-12, "speeds")


def test_rotors_lag_and_stay_within_their_limits() -> None:
    robot, world, drive = flying()
    spec = robot.spec.propulsion
    assert spec is not None
    start = drive.rotor_speed
    for wanted, constant in ((start + 10, spec.time_constant_up), (start - 10, spec.time_constant_down)):
        world.reset(robot.posture())
        world.step(ActuatorCommand(drive.torque, wanted), 50)
        truth = world.truth()
        expected = wanted + (start - wanted) * np.exp(-0.0125 / constant)
        assert_close(truth.rotor_speeds, expected, 1e-12, "speeds")
        assert_close(truth.thrusts, spec.thrust_coefficient * expected**2, 1e-12, "thrusts")
    for wanted, limit in ((500.0, spec.speed_max), (-3.0, spec.speed_min)):
        world.reset(robot.posture())
        world.step(ActuatorCommand(drive.torque, np.full(6, wanted)), 4000)
        assert_close(world.truth().rotor_speeds, np.full(6, limit), 1e-9, "limit")


def test_motors_stay_within_their_limits() -> None:
    robot, world, drive = flying()
    limits = np.asarray(robot.model.effortLimit)[6:]
    world.step(ActuatorCommand(np.array([99.0, -99.0, 1.0]), drive.rotor_speed))
    np.testing.assert_array_equal(world.truth().torques, [limits[0], -limits[1], 1.0])


def test_a_joint_at_its_stop_is_named() -> None:
    robot = without_rotors("tilthex_arm")
    world = build_world(robot, Scene(physics=WEIGHTLESS))
    world.reset(robot.posture())
    assert world.truth().at_stops == ()
    world.step(ActuatorCommand(np.array([0.0, 0.0, 3.0]), NONE), 4000)
    truth = world.truth()
    assert truth.at_stops == ("elbow_pitch",)
    assert robot.model.upperPositionLimit[9] <= truth.q[9] < robot.model.upperPositionLimit[9] + 0.02


def test_a_push_acts_at_its_point_and_ends() -> None:
    robot = known_robot("talos")
    q, frame, offset, force = robot.posture(), "torso_2_link", (0.1, -0.2, 0.3), np.array([32.0, -5.0, 9.0])
    world = build_world(robot, Scene(physics=WEIGHTLESS))
    world.reset(q)
    world.push(Push(frame, (32.0, -5.0, 9.0), 0.01, offset))
    world.step(idle(robot))
    data, index = robot.model.createData(), robot.frame_id(frame)
    J = pin.computeFrameJacobian(robot.model, data, q, index, pin.LOCAL_WORLD_ALIGNED)
    pin.framesForwardKinematics(robot.model, data, q)
    arm = data.oMf[index].rotation @ np.array(offset)
    wrench = np.concatenate([force, np.cross(arm, force)])
    expected = np.linalg.solve(mass_matrix(robot.model, q), J.T @ wrench) * world.timestep
    assert_close(world.truth().v, expected, 1e-6, "first step")
    world.step(idle(robot), 99)
    for _ in range(2):
        truth = world.truth()
        momentum = pin.computeCentroidalMomentum(robot.model, data, truth.q, truth.v).linear
        assert_close(momentum, 0.01 * force, 1e-3, "momentum")
        world.step(idle(robot), 60)


# ---- reproducibility --------------------------------------------------------------------------------------------


def run(world: World, seed: int) -> list[Vector]:
    robot = world.robot
    drive = ActuatorCommand(np.array([0.1, 0.4, 0.2]), np.full(6, 60.0))
    world.reset(robot.posture(), seed=seed)
    world.push(Push("ee", (1.0, 2.0, 0.0), 0.02))
    rows = []
    for _ in range(60):
        world.step(drive, 4)
        reading, truth = world.read(), world.truth()
        assert reading.force is not None
        rows.append(np.concatenate([reading.q, reading.v, reading.force, truth.q, truth.v, truth.shapes[0].impulse]))
    return rows


def test_the_seed_determines_noise_only() -> None:
    robot = known_robot("tilthex_arm")
    sensors = Sensors(base_angle=1e-3, joint_rate=0.1, unbalance=1e-6, force_frame="ee", force=0.1, delay=2e-3)
    scene = Scene((Surface("floor", (0, 0, 1), gap=0.002),), (Shape("ee", size=(0.015,)),), sensors=sensors)
    first, again = (build_world(robot, scene) for _ in range(2))
    a, b, other = run(first, 5), run(again, 5), run(again, 6)
    np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(a, run(first, 5))
    # Another seed changes the noise, but not the true state.
    truth = robot.nq + robot.nv + 3
    assert not np.array_equal(np.array(a)[:, :truth], np.array(other)[:, :truth])
    np.testing.assert_array_equal(np.array(a)[:, truth:], np.array(other)[:, truth:])
    assert np.array(a)[-1, -1] > 0, "the arm touches the floor in this run"
