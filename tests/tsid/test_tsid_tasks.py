"""Tasks of the controller: Jacobians and drifts compared with finite differences, errors, desired accelerations."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from impact_posture.errors import InputError, PostureError
from impact_posture.tsid.point_kinematics import Point
from impact_posture.tsid.state import State
from impact_posture.tsid.tasks.body_tasks import BaseOrientation, CenterOfMass, Tilt
from impact_posture.tsid.tasks.frame_tasks import FrameAligned, FramePose, FramePosition, Impedance
from impact_posture.tsid.tasks.joint_posture import JointPosture
from impact_posture.tsid.tasks.task import Task, TaskStack
from tests.support.helpers import assert_close, random_configurations, rng, robot
from tests.support.pinocchio_values import frame_jacobian, frame_placement, mass_matrix
from tests.support.step_bounds import step_bound

H = 1e-6

FRAMES = {"tilthex_arm": "ee", "solo8": "FL_FOOT", "talos": "gripper_right_base_link", "panda": "panda_hand_tcp"}
OFFSET = (0.03, -0.02, 0.05)


def tasks(name: str) -> list[Task]:
    point, bare = Point(FRAMES[name], OFFSET), Point(FRAMES[name])
    body = [Tilt(), BaseOrientation(), CenterOfMass()] if robot(name).floating else []
    aligned = FrameAligned(point, (0.3, -0.5, 0.8))
    return [FramePose(point), FramePosition(bare), JointPosture(robot(name)), *body, aligned]


def state_of(name: str, task: Task, q: np.ndarray, v: np.ndarray) -> State:
    return State(robot(name), task.points).update(q, v)


CASES = [pytest.param(n, k, id=f"{n}-{t.name}") for n in FRAMES for k, t in enumerate(tasks(n))]


def sample(name: str, key: object) -> tuple[np.ndarray, np.ndarray]:
    (q,) = random_configurations(robot(name).model, 1, name, key, spread=0.7)
    return q, rng(name, key, "v").normal(size=robot(name).nv)


@pytest.mark.parametrize(("name", "k"), CASES)
def test_error_falls_by_jacobian(name: str, k: int) -> None:
    """``ė = −Jν`` is exact at the target, because small errors behave like vectors."""
    task, model = tasks(name)[k], robot(name).model
    q, _ = sample(name, k)
    at_target = state_of(name, task, q, np.zeros(model.nv))
    task.reset(at_target)
    if isinstance(task, Tilt):
        task.target = at_target.base_rotation[:, 2].copy()
    if isinstance(task, JointPosture):
        task.move_to(q, 1.0)
        task.advance(at_target, 2.0)
    J = np.array(task.jacobian(at_target))
    columns = []
    for e in np.eye(model.nv):
        ahead, behind = (
            np.array(task.error(state_of(name, task, pin.integrate(model, q, s * H * e), np.zeros(model.nv))))
            for s in (1, -1)
        )
        columns.append((ahead - behind) / (2 * H))
    assert_close(np.column_stack(columns), -J, 1e-6, f"{name} {task.name}")


@pytest.mark.parametrize(("name", "k"), CASES)
def test_drift_is_the_rate_of_the_jacobian_along_the_motion(name: str, k: int) -> None:
    task = tasks(name)[k]
    q, v = sample(name, k)
    state = state_of(name, task, q, v)
    if isinstance(task, FramePose):
        # The task output is the body twist in world axes; the drift is its time derivative at zero acceleration.
        def rate(s: float) -> np.ndarray:
            there = state_of(name, task, pin.integrate(robot(name).model, q, s * v), v).at(task.points[0])
            return np.concatenate([there.rotation.T @ there.velocity[:3], there.rotation.T @ there.velocity[3:]])

        turned = (rate(H) - rate(-H)) / (2 * H)
        R = state.at(task.points[0]).rotation
        expected = np.concatenate([R @ turned[:3], R @ turned[3:]])
    else:
        expected = Task.drift(task, state)
    assert_close(task.drift(state), expected, 1e-6, f"{name} {task.name}", scale=1.0)


@pytest.mark.parametrize("name", FRAMES)
def test_the_state_agrees_with_pinocchio(name: str) -> None:
    model, point = robot(name).model, Point(FRAMES[name], OFFSET)
    q, v = sample(name, "state")
    state = State(robot(name), [point]).update(q, v)
    index = robot(name).frame_id(point.frame)
    data = model.createData()
    assert_close(state.M, mass_matrix(model, q), 1e-12, "M")
    assert_close(state.h, pin.rnea(model, data, q, v, np.zeros(model.nv)), 1e-10, "h")
    here = state.at(point)
    assert_close(here.jacobian, frame_jacobian(model, q, index, OFFSET), 1e-12, "J")
    assert_close(here.position, frame_placement(model, q, index).act(np.array(OFFSET)), 1e-12, "p")
    assert_close(here.velocity, here.jacobian @ v, 1e-12, "Jv")
    if robot(name).floating:
        position, J, drift = state.center_of_mass()
        assert_close(position, pin.centerOfMass(model, data, q, v, np.zeros(model.nv)), 1e-12, "com")
        assert_close(drift, data.acom[0], 1e-9, "com drift")
        assert_close(J, pin.jacobianCenterOfMass(model, data, q), 1e-12, "J com")


def test_an_updated_state_equals_a_new_one() -> None:
    """Views on Pinocchio's data remain valid after an update."""
    point = Point("ee")
    old = State(robot("tilthex_arm"), [point])
    for k in range(5):
        q, v = sample("tilthex_arm", k)
        old.update(q, v)
        new = State(robot("tilthex_arm"), [point]).update(q, v)
        for a, b in ((old.M, new.M), (old.h, new.h), (old.at(point).drift, new.at(point).drift)):
            assert np.array_equal(a, b)


class Reach(Task):
    """User-defined task with two methods: distance of a point from the vertical axis through the origin."""

    def __init__(self, point: Point) -> None:
        super().__init__("reach", 1, kp=50.0)
        self.point, self.points = point, (point,)

    def error(self, state: State) -> np.ndarray:
        return np.array([0.5 - np.hypot(*state.at(self.point).position[:2])])

    def jacobian(self, state: State) -> np.ndarray:
        here = state.at(self.point)
        return (here.position[:2] / np.hypot(*here.position[:2]))[None] @ here.jacobian[:2]


def test_the_task_in_the_documentation_is_the_tested_one() -> None:
    page = (Path(__file__).parents[2] / "docs" / "tsid.md").read_text(encoding="utf-8")
    (shown,) = (block for block in re.findall(r"```python\n(.*?)```", page, re.DOTALL) if "class Reach" in block)
    there: dict[str, Any] = {"Task": Task, "Point": Point, "State": State, "np": np}
    exec(shown, there)
    q, v = sample("panda", "shown")
    documented, tested = (kind(Point("panda_hand_tcp")) for kind in (there["Reach"], Reach))
    state = State(robot("panda"), [documented.point, tested.point]).update(q, v)
    assert np.array_equal(documented.desired(state), tested.desired(state))
    assert documented.size == tested.size and documented.name == tested.name


def test_two_methods_make_a_task() -> None:
    task, model = Reach(Point("panda_hand_tcp")), robot("panda").model
    q, v = sample("panda", "reach")
    state = State(robot("panda"), task.points).update(q, v)
    stack = TaskStack([task], model.nv)
    stack.update(state)
    acceleration = np.linalg.lstsq(stack.J, stack.a, rcond=None)[0]

    def reach(t: float) -> float:
        """Return the distance at time t of a motion with constant acceleration; panda has vector coordinates."""
        there = state_of("panda", task, q + t * v + 0.5 * t**2 * acceleration, v)
        return 0.5 - float(task.error(there)[0])

    step = 1e-4
    output = (reach(step) - 2 * reach(0) + reach(-step)) / step**2
    assert_close(output, task.desired(state), 1e-5, "acceleration of the output")


@pytest.mark.parametrize(("name", "k"), CASES)
def test_an_unconstrained_solution_has_the_desired_acceleration(name: str, k: int) -> None:
    task, model = tasks(name)[k], robot(name).model
    q, v = sample(name, k)
    state = state_of(name, task, q, v)
    task.reset(state)
    target = rng(name, k, "target").normal(size=task.size)
    task.target_velocity, task.target_acceleration = target, 2 * target
    wanted = task.desired(state)
    stack = TaskStack([task], model.nv)
    stack.refresh(state)
    stack.update(state)
    acceleration = np.linalg.lstsq(stack.J, stack.a, rcond=None)[0]
    left = stack.residuals(acceleration)[task.name]
    assert_close(left + wanted, wanted, 1e-9, task.name)
    assert_close(stack.J @ acceleration + task.drift(state), wanted, 1e-9, task.name)


def test_measured_force_softens_the_end_effector() -> None:
    point = Point("ee")
    q, v = sample("tilthex_arm", "force")
    stiff, soft = FramePose(point), FramePose(point, impedance=Impedance(3.0, 0.5))
    state = State(robot("tilthex_arm"), [point]).update(q, v)
    state.push(np.array([1, 2, 3, 0.1, 0.2, 0.3]))
    for task in (stiff, soft):
        task.reset(state)
    assert_close(soft.desired(state) - stiff.desired(state), [1 / 3, 2 / 3, 1, 0.2, 0.4, 0.6], 1e-12, "F/M")


def test_tilt_takes_the_shortest_rotation_and_leaves_yaw() -> None:
    task, model = Tilt(kp=1.0), robot("tilthex_arm").model
    q = robot("tilthex_arm").posture()
    for yaw in (0.0, 1.0, 3.0):
        for axis in (np.array([1.0, 0, 0]), np.array([0.6, 0.8, 0])):
            R = pin.exp3(np.array([0, 0, yaw])) @ pin.exp3(0.4 * axis)
            q[3:7] = pin.Quaternion(R).coeffs()
            error = task.error(State(robot("tilthex_arm")).update(q, np.zeros(model.nv)))
            assert_close(error, -0.4 * axis[:2], 1e-12, "tilt error")
    q[3:7] = (1, 0, 0, 0)
    upside_down = task.error(State(robot("tilthex_arm")).update(q, np.zeros(model.nv)))
    assert_close(np.linalg.norm(upside_down), np.pi, 1e-12, "upside down")


def test_posture_fades_without_a_step() -> None:
    r = robot("talos")
    task, state = JointPosture(r, kp=30.0), State(r)
    task.reset(state)
    away = pin.integrate(r.model, r.posture(), 0.3 * rng("fade").normal(size=r.nv))
    before = task.desired(state)
    task.move_to(away, 0.2)
    for k in range(260):
        if k == 90:
            task.move_to(r.posture(), 0.1)
        bound = step_bound(task, state, 1e-3)
        task.advance(state, 1e-3)
        now = task.desired(state)
        # The test covers only joints, because base orientations are blended by logarithms, which is not exact.
        assert np.abs(now - before)[6:].max() <= bound + 1e-9
        before = now
    assert_close(task.target, r.posture(), 1e-12, "target")


@pytest.mark.parametrize(
    "make",
    [
        lambda: FramePose(Point("ee"), kp=-1.0),
        lambda: FramePose(Point("ee"), kp=(1.0, 2.0)),
        lambda: FramePose(Point("ee"), kd=np.nan),
        lambda: Impedance(0.0),
        lambda: FramePose(Point("ee")).error(State(robot("tilthex_arm"), [Point("ee")])),
        lambda: CenterOfMass().reset(State(robot("panda"))),
        lambda: JointPosture(robot("panda"), np.zeros(3)),
        lambda: JointPosture(robot("panda")).move_to(robot("panda").posture(), 0.0),
        lambda: State(robot("panda"), [Point("panda_hand_tpc")]),
    ],
)
def test_invalid_tasks_are_refused(make: Callable[[], object]) -> None:
    with pytest.raises((InputError, PostureError)):
        make()


def test_no_casadi_online() -> None:
    """A controller imports only NumPy, Pinocchio and DAQP."""
    code = """
import sys, numpy as np
from impact_posture.robot.robot_loader import load_robot
from impact_posture.tsid.controller import Controller
from impact_posture.tsid.tasks.impact_robust import ImpactRobustPosture
from impact_posture.tsid.task_formulation import aerial_formulation
robot = load_robot("tilthex_arm")
posture = ImpactRobustPosture(robot, lambda q: (1.0, np.ones(robot.nv)))
controller = Controller(robot, aerial_formulation(robot, posture))
controller.reset(robot.posture(), np.zeros(robot.nv))
controller.tick(0.0, robot.posture(), np.zeros(robot.nv))
import impact_posture.codegen.impact_gradient
bad = [m for m in ("casadi", "mujoco", "matplotlib", "scipy") if m in sys.modules]
sys.exit(f"loaded: {bad}" if bad else 0)
"""
    subprocess.run([sys.executable, "-c", code], check=True)
