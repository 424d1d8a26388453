"""Every catalogue robot and an unknown robot, with each formulation that is applicable."""

from __future__ import annotations

import gc
import tracemalloc
from contextlib import suppress
from itertools import pairwise
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from impact_posture.config.problem_settings import LoadOptions
from impact_posture.errors import InputError
from impact_posture.impact.impact_contact import ImpactContact
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.robot.robot import Robot
from impact_posture.robot.robot_loader import load_robot
from impact_posture.simulation.scenario_objective import interpreted
from impact_posture.tsid.controller import Controller, Status
from impact_posture.tsid.point_kinematics import Point
from impact_posture.tsid.state import State
from impact_posture.tsid.task_formulation import (
    TaskFormulation,
    aerial_formulation,
    arm_formulation,
    legged_formulation,
)
from impact_posture.tsid.tasks.activation import Activation
from impact_posture.tsid.tasks.frame_tasks import FramePosition
from impact_posture.tsid.tasks.impact_robust import Gradient, ImpactRobustPosture, Spring
from impact_posture.tsid.tasks.joint_posture import JointPosture
from tests.support.helpers import NAMES, contact_frame, rng, robot
from tests.support.step_bounds import step_bound
from tests.support.urdfs import joint, link, write
from tests.tsid.test_tsid_controller import DT, assert_dynamics, assert_limits, integrate, run
from tests.tsid.test_tsid_never_fails import ANSWERED, PROGRAMS, bracing, program_of, well


def formulations(r: Robot, posture: JointPosture) -> list[TaskFormulation]:
    """Return all formulations that are applicable to the robot."""
    result = []
    if not r.floating:
        result += [arm_formulation(r, posture, order=order) for order in ("strict", "weighted")]  # type: ignore[arg-type]
    if r.spec.propulsion is not None:
        result += [aerial_formulation(r, posture, order=order) for order in ("strict", "weighted")]  # type: ignore[arg-type]
    if r.spec.supports:
        result.append(legged_formulation(r, posture))
    return result


def assert_flies(r: Robot, formulation: TaskFormulation, ticks: int) -> None:
    """Check that the state stays finite and within all limits at each tick, under perfect dynamics."""
    controller = Controller(r, formulation)
    q, v = r.posture(), 0.05 * rng(r.name, "start").normal(size=r.nv)
    # A joint that starts at its limit with a velocity cannot stop at once.
    v[controller.state.update(q, v).room.min(axis=0) < 0.01] = 0.0
    controller.reset(q, v)
    if isinstance(formulation.posture, ImpactRobustPosture):
        formulation.posture.brace()
    contacts = controller.assembly.contacts
    for k, command, _, _ in run(controller, q, v, ticks):
        assert command.status is Status.SOLVED
        assert_limits(controller, command)
        assert (contacts.cone @ command.forces >= contacts.least - 1e-7).all()
        assert controller.state.least_room > -1e-6
        if k % 20 == 0:
            assert_dynamics(controller, command)
            assert controller.report().dynamics <= 1e-8


@pytest.mark.parametrize("name", NAMES)
def test_every_robot_under_every_formulation(name: str) -> None:
    r = robot(name)
    gains = {"kp": 20.0, "weight": 0.1, "base_weight": 0.0}
    count = len(formulations(r, JointPosture(r)))
    # Aerial robots without propeller data have no formulation.
    assert count or (r.spec.kind == "aerial" and r.spec.propulsion is None)
    for k in range(count):
        assert_flies(r, formulations(r, JointPosture(r, **gains))[k], 60)  # type: ignore[arg-type]
        robust = ImpactRobustPosture(r, well(r), K=20.0, **gains)  # type: ignore[arg-type]
        assert_flies(r, formulations(r, robust)[k], 60)


OWN = (
    *(link(name, 1, "0 0 0.2") for name in "abcd"), joint("turns", "a b", "1 2 3", kind="continuous", more=""),
    joint("stuck", "b c", "1 0 0", "0 0 0.4", "prismatic", '<limit lower="0" upper="0" effort="10" velocity="1"/>'),
    joint("bends", "c d", "0 1 0", "0 0 0.4", more='<limit lower="-1" upper="1" effort="0" velocity="0"/>'),
)  # fmt: skip


@pytest.mark.parametrize("root", ["fixed", "free-flyer"])
def test_an_unknown_urdf_is_controlled(root: str, tmp_path: Path) -> None:
    """The robot has a continuous joint about an oblique axis, a joint with equal limits, and an unlimited joint."""
    r = load_robot(str(write(tmp_path, *OWN)), LoadOptions(root=root))  # type: ignore[arg-type]
    # For a falling robot with an unlimited motor, a strict task would demand unlimited torque.
    for level in (((FramePosition(Point("d")),),), ()) if root == "fixed" else ((),):
        posture = ImpactRobustPosture(r, well(r), K=20.0, kp=20.0)
        controller = Controller(r, TaskFormulation(level, () if level else (FramePosition(Point("d")),), posture))
        q, v = r.posture(), 0.1 * rng("own").normal(size=r.nv)
        v[r.nv - 2] = 0.0
        controller.reset(q, v)
        posture.brace()
        for _, command, now, _ in run(controller, q, v, 200):
            assert command.status in ANSWERED and np.isfinite(command.u).all()
            assert_dynamics(controller, command)
            assert np.isfinite(posture.term).all()
            assert abs(now[r.model.idx_qs[r.model.getJointId("stuck")]]) < 1e-6


@pytest.mark.parametrize(
    ("name", "build", "hint"),
    [
        ("panda", aerial_formulation, "arm_formulation"),
        ("talos", aerial_formulation, "propulsion"),
        ("talos", arm_formulation, "legged_formulation"),
        ("panda", legged_formulation, "supports"),
    ],
)
def test_a_formulation_that_does_not_suit_a_robot_names_one_that_does(name: str, build: type, hint: str) -> None:
    with pytest.raises(InputError, match=hint):
        build(robot(name), JointPosture(robot(name)))


def test_a_push_at_a_standing_robot_enters_its_dynamics() -> None:
    r, force = robot("solo8"), np.array([3.0, 0.0, -1.0])
    formulation = legged_formulation(r, JointPosture(r, base_weight=0.0), force_point=Point("base_link"))
    controller = Controller(r, formulation)
    controller.reset(r.posture(), np.zeros(r.nv))
    command = controller.tick(0.0, r.posture(), np.zeros(r.nv), force)
    assert command.status is Status.SOLVED
    assert_dynamics(controller, command, force)


# ---- phases of an impact -----------------------------------------------------------------------------------------


@pytest.mark.long(but=("tilthex_arm-strict-follow", "kinova-arm-release"))
@pytest.mark.parametrize(
    ("name", "kind", "spring"),
    [("tilthex_arm", "strict", "keep"), ("tilthex_arm", "strict", "follow"), ("kinova", "arm", "release")],
)
def test_events_at_odd_moments_make_no_step(name: str, kind: str, spring: Spring) -> None:
    """If the state is constant, only ramps and fades change ``ν̇*``, by at most their bound."""
    r, generator = robot(name), rng(name, spring)
    posture = ImpactRobustPosture(
        r, well(r), K=20.0, kp=20.0, base_weight=0.0, spring=spring, every=3, activation=Activation(ramp=0.05)
    )
    controller = Controller(r, program_of(r, kind, posture))
    v = np.zeros(r.nv)
    controller.reset(r.posture(), v)
    q = np.array(pin.integrate(r.model, r.posture(), 0.2 * generator.normal(size=r.nv)))
    state = State(r, controller.formulation.points).update(q, v)
    base, steps, t = r.first_joint, [], 0.0
    for _ in range(300):
        before = posture.desired(state).copy()
        if generator.random() < 0.08:
            # A phase that cannot follow the present phase raises an error.
            with suppress(InputError):
                getattr(posture, generator.choice(["brace", "contact", "release"]))()
        # The call of a phase does not change the acceleration of the joints.  The base is excluded, because the
        # blending of its orientation by logarithms is not exact.
        assert np.abs(posture.desired(state) - before)[base:].max() <= 1e-9
        dt = float(generator.choice([0.0, DT, DT, 4 * DT, 1.0]))
        t += dt
        allowed = step_bound(posture, state, min(dt, 10 * DT))
        controller.tick(t, q, v)
        allowed = max(allowed, step_bound(posture, state, min(dt, 10 * DT)))
        steps.append(float(np.abs(posture.desired(state) - before)[base:].max()))
        # The method `follow` also moves the target, with its time constant.
        follows = 20.0 * 2.0 * min(dt, 10 * DT) / 0.5 if spring == "follow" else 0.0
        assert steps[-1] <= allowed + follows + 1e-9
    assert max(steps) > 0.1


@pytest.mark.parametrize(("name", "kind"), PROGRAMS)
def test_same_inputs_give_same_bits_under_every_formulation(name: str, kind: str) -> None:
    """The simulated course includes all phases, kicks, pushes and invalid measurements."""

    def record(controller: Controller, posture: ImpactRobustPosture) -> np.ndarray:
        r, generator, rows = controller.robot, rng(name, kind, "bits"), []
        q, v = r.posture(), np.zeros(r.nv)
        controller.reset(q, v)
        for k in range(60):
            if k in (2, 30, 35):
                (posture.brace if k == 2 else posture.contact if k == 30 else posture.release)()
            if k % 17 == 0:
                v = v + 0.5 * generator.normal(size=r.nv)
            push = 5.0 * generator.normal(size=6) if kind != "legged" and k % 7 == 0 else None
            command = controller.tick(k * DT, np.full_like(q, np.nan) if k % 20 == 19 else q, v, push)
            rows.append(np.concatenate([command.u, command.acceleration, command.forces, command.rotor_speed]))
            q, v = integrate(r, q, v, command)
        return np.array(rows)

    controllers = bracing(name, kind), bracing(name, kind)
    first = record(*controllers[0])
    for controller in controllers:
        assert np.array_equal(record(*controller), first)


@pytest.mark.long
def test_ticks_leave_no_memory_behind() -> None:
    """The course contains solved, relaxed and held ticks."""
    controller, _ = bracing("tilthex_arm", "strict")
    q, v = controller.robot.posture(), np.zeros(controller.robot.nv)
    hard, broken = np.array([0.0, 30.0, -20.0]), np.full(3, np.nan)

    def fly(ticks: int) -> int:
        for k in range(ticks):
            controller.tick(k * DT, q, v, (None, hard, broken)[k % 3])
        gc.collect()
        return tracemalloc.get_traced_memory()[0]

    tracemalloc.start()
    try:
        # Storing one number per tick would take 7,200 bytes per round.  The first rounds may allocate more, because
        # NumPy fills its cache for small arrays.
        assert any(after - before < 3_000 for before, after in pairwise(fly(300) for _ in range(9)))
    finally:
        tracemalloc.stop()


# ---- the flow on other robots ------------------------------------------------------------------------------------


def own_gradient(r: Robot, normal: tuple[float, float, float]) -> Gradient:
    """Return the interpreted gradient of ``H`` for the default contact frame."""
    return interpreted(WorstCaseObjective(r, ImpactContact(contact_frame(r), normal)))


@pytest.mark.long(but=("panda",))
@pytest.mark.parametrize("name", ["panda", "tiago"])
def test_energy_never_grows(name: str) -> None:
    """With damping only, ``K H/λ + ½‖ν‖²`` decreases until ``∇H`` cannot move any joint."""
    r, dt, K = robot(name), 2e-3, 10.0
    gradient = own_gradient(r, (0.0, 0.0, 1.0))
    posture = ImpactRobustPosture(
        r, gradient, K=K, kp=0.0, kd=6.0, every=1, fade=(1e-6, 2e-6), reach=1e6, activation=Activation(ramp=1e-6)
    )
    controller = Controller(r, arm_formulation(r, posture), period=dt)
    q, v = r.posture(), np.zeros(r.nv)
    controller.reset(q, v)
    Z = controller.assembly.redundancy(controller.state)
    start = float(np.linalg.norm(Z.T @ gradient(q)[1]))
    posture.brace()
    energy = []
    for k in range(1500):
        energy.append(K / posture.scale * gradient(q)[0] + 0.5 * float(v @ v))
        command = controller.tick(k * dt, q, v)
        assert command.status is Status.SOLVED
        v = v + dt * command.acceleration
        q = np.array(pin.integrate(r.model, q, dt * v))
    assert np.diff(energy).max() <= 1e-6 * energy[0] and energy[-1] < energy[0]
    # Directions of motion that the end effector task and the joint limits leave free.
    stopped = np.eye(r.nv)[controller.state.room.min(axis=0) < 1e-2]
    rows = np.vstack([controller.assembly.strict.J, stopped])
    Z = np.linalg.svd(rows)[2][np.linalg.matrix_rank(rows, tol=1e-6) :].T
    assert np.linalg.norm(Z.T @ gradient(q)[1]) < 0.2 * start
