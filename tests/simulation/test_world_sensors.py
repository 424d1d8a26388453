"""Simulated world: sensors, restitution of contact laws, and invalid input."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from impact_posture.errors import (
    ContactError,
    FrameNotFound,
    ImpactPostureError,
    InputError,
    PostureError,
    SimulationDiverged,
    UnsupportedJoint,
)
from impact_posture.robot.actuation import hover
from impact_posture.robot.robot import Robot
from impact_posture.robot.robot_spec import RobotSpec
from impact_posture.simulation.world.actuator_command import ActuatorCommand, Push
from impact_posture.simulation.world.contact_law import ContactLaw
from impact_posture.simulation.world.rotors import Vibration
from impact_posture.simulation.world.scene import Physics, Scene, Sensors, Shape, Surface
from impact_posture.simulation.world.world import World, build_world
from tests.support.helpers import assert_close, random_configurations
from tests.support.helpers import robot as known_robot
from tests.support.pinocchio_values import mass_matrix
from tests.support.restitution import ball, ideal_restitution, measure_restitution

PAGE = Path(__file__).parents[2] / "docs" / "generated" / "restitution.md"
NONE = np.zeros(0)
IDLE = ActuatorCommand(NONE, NONE)


def hovering(sensors: Sensors) -> tuple[Robot, World, ActuatorCommand]:
    robot = known_robot("tilthex_arm")
    assert robot.spec.propulsion is not None
    wanted = hover(robot.model, robot.spec.propulsion, robot.posture())
    world = build_world(robot, Scene(sensors=sensors))
    world.reset(robot.posture(), seed=3)
    return robot, world, ActuatorCommand(wanted.joint_torques, wanted.speeds)


# ---- sensors ----------------------------------------------------------------------------------------------------


def test_a_perfect_sensor_measures_the_true_state() -> None:
    _, world, drive = hovering(Sensors())
    world.push(Push("ee", (1, 0, 0), 0.1))
    world.step(drive, 100)
    reading, truth = world.read(), world.truth()
    assert reading.t == truth.t and reading.force is None
    np.testing.assert_array_equal(reading.q, truth.q)
    np.testing.assert_array_equal(reading.v, truth.v)


def test_noise_has_the_stated_deviation() -> None:
    base = {"base_position": 1e-3, "base_angle": 2e-3, "base_velocity": 3e-3, "base_rate": 4e-3}
    robot, world, _ = hovering(Sensors(**base, joint_angle=5e-3, joint_rate=6e-3))
    truth = world.truth()
    readings = [world.read() for _ in range(2000)]
    q = np.array([pin.difference(robot.model, truth.q, r.q) for r in readings])
    v = np.array([r.v - truth.v for r in readings])
    expected = np.repeat([1e-3, 2e-3, 5e-3], 3), np.repeat([3e-3, 4e-3, 6e-3], 3)
    for noise, sigma in zip((q, v), expected, strict=True):
        np.testing.assert_allclose(noise.std(axis=0), sigma, rtol=0.08)
        assert (np.abs(noise.mean(axis=0)) < 4 * sigma / np.sqrt(2000)).all()
        # Successive noise values are uncorrelated.
        assert np.abs(np.mean(noise[1:] * noise[:-1], axis=0) / sigma**2).max() < 0.1
    np.testing.assert_array_equal(world.truth().q, truth.q)


def test_encoders_round_the_joints_only() -> None:
    _, world, drive = hovering(Sensors(joint_resolution=0.01))
    world.push(Push("ee", (1, 0, 0), 0.1))
    world.step(drive, 77)
    reading, truth = world.read(), world.truth()
    np.testing.assert_allclose(reading.q[7:] / 0.01, np.round(truth.q[7:] / 0.01), atol=1e-9)
    assert 0 < np.abs(reading.q[7:] - truth.q[7:]).max() <= 0.005
    np.testing.assert_array_equal(reading.q[:7], truth.q[:7])


def test_a_delayed_reading_is_an_earlier_state() -> None:
    _, world, drive = hovering(Sensors(delay=0.0015))
    world.push(Push("ee", (1, 0, 0), 0.1))
    past = [world.truth().q]
    for k in range(1, 20):
        world.step(drive)
        np.testing.assert_array_equal(world.read().q, past[max(0, k - 6)])
        past.append(world.truth().q)
    assert not np.array_equal(past[-1], past[-7])


def test_the_measured_force_is_filtered() -> None:
    scene = Scene(
        (Surface("floor", (0, 0, 1), gap=1e-4),), (Shape("ball", size=(0.02,)),),
        sensors=Sensors(force_frame="ball", force_cutoff=100.0),
    )  # fmt: skip
    world = build_world(ball(), scene)
    world.reset([0, 0, 0, 0, 0, 0, 1], [0.1, 0, -0.5, 0, 0, 0])
    filtered, share = np.zeros(3), 1 - np.exp(-2 * np.pi * 100 * world.timestep)
    largest = 0.0
    for _ in range(200):
        world.step(IDLE)
        force = world.truth().shapes[0].force
        filtered += share * (force - filtered)
        largest = max(largest, force[2])
        measured = world.read().force
        assert measured is not None
        np.testing.assert_allclose(measured, filtered, atol=1e-12)
    assert measured is not None and measured[2] == pytest.approx(9.81, rel=0.02)
    assert largest > 50


def test_unbalanced_propellers_disturb_the_gyroscope_at_their_frequencies() -> None:
    _, world, drive = hovering(Sensors(unbalance=1e-6))
    rates = []
    for _ in range(2000):
        world.step(drive, 4)
        rates.append(world.read().v[3:6])
    assert np.abs(world.truth().v).max() < 1e-9, "only the sensors shake"
    spectrum = np.abs(np.fft.rfft(np.array(rates) * np.hanning(2000)[:, None], axis=0)).sum(axis=1)
    frequencies = np.fft.rfftfreq(2000, 1e-3)
    near = np.min(np.abs(frequencies[:, None] - drive.rotor_speed[None, :]), axis=1) < 2.5
    assert spectrum[near].sum() > 0.98 * spectrum.sum()
    assert 1e-3 < np.std(rates) < 0.1


def test_the_vibration_follows_from_the_forces_of_the_unbalance() -> None:
    robot = known_robot("tilthex_arm")
    spec, q = robot.spec.propulsion, robot.posture()
    assert spec is not None
    vibration, U = Vibration(robot.model, spec, 2e-6), 2e-6
    phases, speeds = np.linspace(0, 5, 6), np.linspace(30, 90, 6)
    vibration.reset(q, phases)
    inertia = mass_matrix(robot.model, q)[:6, :6]
    step = 1e-7
    ahead = vibration.twist(speeds, phases + 2 * np.pi * speeds * step)
    back = vibration.twist(speeds, phases - 2 * np.pi * speeds * step)
    wrench = inertia @ (ahead - back) / (2 * step)
    # The imbalance force of a propeller is perpendicular to its axis and has magnitude U(2πω)².  The total wrench is
    # the sum over all propellers.
    total = np.zeros(6)
    for k, rotor in enumerate(spec.rotors):
        turn = pin.Quaternion.FromTwoVectors(np.array([0.0, 0, 1]), np.array(rotor.direction)).matrix()
        pull = U * (2 * np.pi * speeds[k]) ** 2 * (turn @ [np.cos(phases[k]), rotor.spin * np.sin(phases[k]), 0])
        total += np.concatenate([pull, np.cross(rotor.position, pull)])
    assert_close(wrench, total, 1e-5, "wrench")


# ---- the contact law --------------------------------------------------------------------------------------------


def test_restitution_agrees_with_the_page() -> None:
    rows = [line.split("|")[1:-1] for line in PAGE.read_text(encoding="utf-8").splitlines() if line.startswith("| ")]
    table = {tuple(float(re.sub(r"[^\d.]", "", cell)) for cell in row[:3]): row for row in rows[1:]}
    assert len(table) > 30
    for step, time, damping in ((0.25, 2, 1), (0.25, 2, 0.3), (1, 10, 0.5)):
        bounce = measure_restitution(ContactLaw(solref=(time * 1e-3, damping)), timestep=step * 1e-3)
        row = table[step, time, damping]
        assert f"{bounce.restitution:.3f}" == row[3].strip()
        assert f"{bounce.duration * 1e3:.1f} ms" == row[6].strip()


@pytest.mark.parametrize(
    ("law", "speed", "timestep"),
    [
        (ContactLaw(), 0.1, 2.5e-4),
        (ContactLaw(solref=(0.004, 0.3)), 1.0, 5e-4),
        (ContactLaw(solref=(-1e5, -100.0), solimp=(0.5, 0.9, 0.01)), 0.5, 2.5e-4),
    ],
)
def test_the_restitution_of_a_law_agrees_with_a_ball_in_mujoco(
    law: ContactLaw, speed: float, timestep: float
) -> None:
    measured = measure_restitution(law, speed=speed, timestep=timestep).restitution
    assert law.restitution(speed, timestep) == pytest.approx(measured, rel=1e-9) and measured > 0.05


def test_nothing_rebounds_without_an_approach_or_from_a_law_without_a_spring() -> None:
    assert ContactLaw().restitution(0.0, 2.5e-4) == ContactLaw().restitution(-0.1, 2.5e-4) == 0.0
    assert ContactLaw(solref=(-1e-6, -1e3)).restitution(0.5, 2.5e-4) == pytest.approx(0.0, abs=1e-9)


@pytest.mark.long(but=("0.2", "1.8"))
@pytest.mark.parametrize("damping", [0.2, 0.6, 1.0, 1.8])
def test_restitution_converges_to_the_ideal_spring(damping: float) -> None:
    ideal, errors = ideal_restitution(damping), []
    for timestep in (4e-4, 1e-4):
        law = ContactLaw(solref=(0.01, damping), solimp=(0.9999, 0.9999, 0.001))
        errors.append(abs(measure_restitution(law, timestep=timestep).restitution - ideal))
    assert errors[1] < 0.004
    assert errors[1] < errors[0]


def test_the_restitution_of_the_ideal_spring_solves_its_equation() -> None:
    assert ideal_restitution(0.0) == 1.0
    assert ideal_restitution(1 - 1e-7) == pytest.approx(np.exp(-2), rel=1e-6)
    assert ideal_restitution(1 + 1e-7) == pytest.approx(np.exp(-2), rel=1e-6)
    for damping in (0.3, 1.5):
        r, speed, step = 0.0, -1.0, 1e-5
        while (pull := -2 * damping * speed - r) >= 0:
            speed += step * pull
            r += step * speed
        assert speed == pytest.approx(ideal_restitution(damping), rel=1e-3)


@pytest.mark.parametrize("solref", [(0.002, 0.5), (0.00199, 1.0), (-1.1e6, -1e3)])
def test_contact_laws_faster_than_the_time_step_are_refused(solref: tuple[float, float]) -> None:
    step = 1e-3 if solref[0] < 0.002 else 1.01e-3
    with pytest.raises(InputError, match="time step") as caught:
        Scene((Surface("wall", (0, 0, 1), solref=solref),), physics=Physics(step, stop_solref=(0.01, 1)))
    assert caught.value.where == "wall"


# ---- rejected input ---------------------------------------------------------------------------------------------


def one_line(error: ImpactPostureError) -> str:
    assert "\n" not in error.line and error.hint
    return error.line


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: ContactLaw(solref=(0.002, -1.0)), "solref"),
        (lambda: ContactLaw(solimp=(0.99, 0.9, 0.001)), "solimp"),
        (lambda: ContactLaw(friction=-1.0), "friction"),
        (lambda: Surface("s", (0, 0, 0)), "not all zero"),
        (lambda: Surface("s", (0, 0, 1), point=(0, 0, np.nan)), "point: .*nan.*; give three finite numbers"),
        (lambda: Shape("ee", (0.1, 0.1, 0.1), "sphere"), "a radius"),
        (lambda: Shape("ee", (0.1, 0.1, -0.1), "box"), "size: .*-0.1.*; give a list of a number above zero"),
        (lambda: Shape("ee", (0.1, 0.1), "box"), "half extents"),
        (lambda: Physics(0.0), "timestep"),
        (lambda: Sensors(joint_rate=-1.0), "joint_rate"),
        (lambda: Scene((Surface("s", (0, 0, 1)), Surface("s", (1, 0, 0)))), "two surfaces are called 's'"),
        (lambda: Scene(shapes=(Shape("ee", (0.1,)), Shape("ee", (0.1,)))), "two shapes are at 'ee'"),
        (lambda: Scene(sensors=Sensors(force_frame="ee")), "there is no shape at force_frame"),
    ],
)
def test_wrong_scenes_are_refused(make: Any, words: str) -> None:
    with pytest.raises(InputError, match=words) as caught:
        make()
    one_line(caught.value)


def test_scenes_that_do_not_fit_the_robot_are_refused() -> None:
    robot = known_robot("panda")
    for scene, kind, words in (
        (Scene((Surface("s", (0, 0, 1)),), (Shape("hand", (0.1,)),)), FrameNotFound, "panda_hand"),
        (Scene((Surface("s", (0, 0, 1)),), (Shape("panda_link0", (0.1,)),)), ContactError, "welded"),
        (Scene(shapes=(Shape("panda_hand_tcp", (0.1,)),)), InputError, "no center"),
        (Scene((Surface("s", (0, 0, 1)),)), InputError, "neither a point nor a shape"),
    ):
        with pytest.raises(kind, match=words) as caught:
            build_world(robot, scene)
        one_line(caught.value)


def test_wrong_use_is_refused() -> None:
    robot, world, drive = hovering(Sensors())
    fresh = build_world(robot, Scene())
    for use in (fresh.read, fresh.truth, lambda: fresh.step(drive)):
        with pytest.raises(InputError, match="reset"):
            use()
    for torque, speeds, words in (
        (np.zeros(2), np.zeros(6), "2 torques"),
        (np.zeros(3), np.zeros(4), "4 rotor speeds"),
        (np.array([0, np.nan, 0]), np.zeros(6), "not finite"),
    ):
        with pytest.raises(InputError, match=words):
            world.step(ActuatorCommand(torque, speeds))
    with pytest.raises(PostureError, match="give 9 finite numbers"):
        world.reset(robot.posture(), [0.0, 1.0])
    with pytest.raises(InputError, match="give 6 finite numbers"):
        world.reset(robot.posture(), rotor_speed=[50.0, 50.0])
    for push in (Push("ee", (1, 0, 0), 0.0), Push("ee", (np.inf, 0, 0), 1.0)):
        with pytest.raises(InputError, match="the force or the duration is invalid"):
            world.push(push)
    with pytest.raises(FrameNotFound, match="ee"):
        world.push(Push("e", (1, 0, 0), 1.0))


def test_a_joint_without_motor_is_refused() -> None:
    model = pin.Model()
    joint = model.addJoint(0, pin.JointModelPlanar(), pin.SE3.Identity(), "cart")
    model.appendBodyToJoint(joint, pin.Inertia.FromSphere(1.0, 0.1), pin.SE3.Identity())
    q = np.asarray(pin.neutral(model))
    with pytest.raises(UnsupportedJoint, match="no motor drives joint 'cart'"):
        build_world(Robot("cart", "", model, "fixed", {"neutral": q}, "neutral", RobotSpec()), Scene())


def test_ball_joints_and_translations_have_the_axes_of_pinocchio() -> None:
    model = pin.Model()
    parent = 0
    for kind in (pin.JointModelSpherical(), pin.JointModelTranslation(), pin.JointModelRUBX()):
        parent = model.addJoint(parent, kind, pin.SE3.Random(), kind.shortname())
        model.appendBodyToJoint(parent, pin.Inertia.FromSphere(1.0, 0.1), pin.SE3.Identity())
    (q,) = random_configurations(model, 1, "ball joints")
    robot = Robot("chain", "", model, "fixed", {"start": q}, "start", RobotSpec())
    world = build_world(robot, Scene())
    world.reset(q)
    u = np.arange(1.0, 8.0)
    world.step(ActuatorCommand(u, NONE))
    a = pin.aba(model, model.createData(), q, np.zeros(7), u)
    assert_close(world.truth().v, a * world.timestep, 1e-9, "first step")


def test_a_diverged_state_is_an_error_without_a_log_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    robot = known_robot("solo8")
    world = build_world(robot, Scene(physics=Physics(0.05, stop_solref=(0.2, 1.0))))
    world.reset(robot.posture())
    with pytest.raises(SimulationDiverged, match="diverged at t = ") as caught:
        # The commanded damping is so large that each step overshoots more, so the simulation diverges.
        for _ in range(400):
            world.step(ActuatorCommand(-2.7 * np.sign(world.truth().v[6:] + 1e-3), NONE))
            world.push(Push("base_link", tuple(-2e3 * world.truth().v[:3] + 1.0), 0.05))  # type: ignore[arg-type]
    one_line(caught.value)
    assert not list(tmp_path.iterdir())


def test_without_mujoco_the_error_says_what_to_install() -> None:
    script = """
import sys
sys.modules["mujoco"] = None
import importlib, pkgutil
import impact_posture.simulation as simulation
for module in pkgutil.walk_packages(simulation.__path__, "impact_posture.simulation."):
    importlib.import_module(module.name)
from impact_posture.errors import InputError
from impact_posture.robot.robot_loader import load_robot
from impact_posture.simulation.world.scene import Scene
from impact_posture.simulation.world.world import build_world
try:
    build_world(load_robot("ur5"), Scene())
except InputError as error:
    print(error.line)
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout == "the extra 'sim': MuJoCo is not installed; pip install 'impact-posture[sim]'\n"
