"""The exported controller returns the commands, statuses and reports of the Python controller."""

from __future__ import annotations

import ctypes
import re
from pathlib import Path
from typing import get_args

import numpy as np
import pinocchio as pin
import pytest

from impact_posture.controller_export.compiled_controller import CompiledController
from impact_posture.controller_export.controller_structure import structure_of
from impact_posture.controller_export.export_controller import export_controller
from impact_posture.errors import ContactError, InputError
from impact_posture.system.arrays import Array
from impact_posture.tsid.controller import Command, Controller, Report, Status
from impact_posture.tsid.state import State
from impact_posture.tsid.tasks.impact_robust import ImpactRobustPosture, Spring, gradient_of
from impact_posture.tsid.tasks.task import TargetTask
from tests.support.exported_controller import (
    compiled,
    exported,
    formulation_of,
    gradient_beside,
    impact_of,
    random_state,
)
from tests.support.relaxation_in_c import missed, stationarity
from tests.support.relaxed_ticks import problem_of


def difference(a: Command, b: Command) -> float:
    """Largest permitted relative difference of controls, accelerations and forces."""
    pairs = ((a.u, b.u), (a.acceleration, b.acceleration), (a.forces, b.forces), (a.rotor_speed, b.rotor_speed))
    return max(float(np.max(np.abs(x - y)) / max(1.0, float(np.max(np.abs(x))))) for x, y in pairs if x.size)


def assert_same_report(a: Report, b: Report, size: float) -> None:
    assert a.residuals.keys() == b.residuals.keys()
    for name, residual in a.residuals.items():
        assert np.allclose(residual, b.residuals[name], rtol=1e-7, atol=1e-9 * size), name
    assert set(a.active) == set(b.active)
    assert abs(a.dynamics - b.dynamics) < 1e-8 * size
    assert (a.level, a.objective) == pytest.approx((b.level, b.objective), nan_ok=True)


def both_at_rest(name: str) -> tuple[Controller, CompiledController, Array, Array]:
    """Return the Python and C controllers, reset at rest in the default posture, and the state of the robot."""
    robot, formulation = formulation_of(name)
    python, c = Controller(robot, formulation), compiled(name)
    q, v = robot.posture(), np.zeros(robot.nv)
    assert difference(python.reset(q, v), c.reset(q, v)) < 1e-9
    return python, c, q, v


# The study of the controller (make study-controller) tests the other robots of KINDS.
@pytest.mark.parametrize("name", ["tilthex_arm", "panda", "solo8", "talos"])
def test_commands_agree_with_python(name: str) -> None:
    python, c, q, v = both_at_rest(name)
    robot, rng, seen = python.robot, np.random.default_rng(4), set()
    for k in range(40):
        force = None if k % 3 else rng.normal(size=6 if k % 2 else 3)
        if k >= 20:
            q, v = random_state(robot, rng, 0.03)
        a, b = python.tick(1e-3 * k, q, v, force), c.tick(1e-3 * k, q, v, force)
        assert a.status is b.status
        seen.add(a.status)
        if a.status is Status.SOLVED:
            assert difference(a, b) < 1e-9
            assert_same_report(python.report(), c.report(), max(1.0, float(np.abs(a.u).max())))
        v = v + 1e-3 * (a.acceleration + rng.normal(size=robot.nv))
        q = np.asarray(pin.integrate(robot.model, q, 1e-3 * v))
    assert Status.SOLVED in seen


def test_commands_in_long_saturation_are_optimal() -> None:
    """The cost has condition number 4e10, so the controls agree only to a few digits; the certificate is exact."""
    python, c, q, v = both_at_rest("solo8")
    rng, push, checked = np.random.default_rng(7), np.zeros(python.robot.nv), 0
    for k in range(800):
        command = c.tick(1e-3 * k, q, v)
        if command.status is Status.SOLVED and k >= 220 and k % 20 in (0, 1):
            assert python.tick(1e-3 * k, q, v).status is Status.SOLVED
            z = np.concatenate([command.acceleration, command.forces])
            program = problem_of(python.assembly, z)
            assert missed(program, z)[0] <= 1e-9 and max(missed(program, z)) <= 1e-7
            assert max(stationarity(program, z)) <= 1e-7
            checked += 1
        if k % 50 == 0:
            push = 30.0 * rng.normal(size=python.robot.nv) * (k % 100 == 0)
        v = v + 1e-3 * (command.acceleration + push)
        q = np.asarray(pin.integrate(python.robot.model, q, 1e-3 * v))
    assert checked >= 20


def test_the_iterations_of_a_tick_are_bounded_and_suffice() -> None:
    """Random states need more iterations than the states of a run, but at most half of the limit in the header."""
    robot, rng = formulation_of("talos")[0], np.random.default_rng(3)
    c = compiled("talos")
    c.reset(robot.posture(), np.zeros(robot.nv))
    header = (exported("talos") / "ctl.h").read_text(encoding="utf-8")
    most = int(re.findall(r"#define CTL_MOST_ITERATIONS (\d+)", header)[0])
    counts = []
    for k in range(100):
        command = c.tick(1e-3 * k, *random_state(robot, rng, 0.3))
        assert command.status in (Status.SOLVED, Status.RELAXED)
        counts.append(c.report().iterations)
    assert 100 < max(counts) <= most / 2


@pytest.mark.parametrize("name", ["tilthex_arm", "talos"])
def test_a_relaxed_tick_misses_its_levels_as_in_python(name: str) -> None:
    python, c, _, _ = both_at_rest(name)
    robot, rng, relaxed = python.robot, np.random.default_rng(1), 0
    for k in range(12):
        q, v = random_state(robot, rng, 0.3)
        a, b = python.tick(1e-3 * k, q, v), c.tick(1e-3 * k, q, v)
        if a.status is not Status.RELAXED or b.status is not Status.RELAXED:
            continue
        relaxed += 1
        in_python, in_c = ({r.level: r.amount for r in x.report().relaxed} for x in (python, c))
        # Compare only the first relaxed level.  The lower levels depend on the first one and agree to fewer digits.
        first = next(iter(in_python))
        assert in_c.get(first, 0.0) <= in_python[first] * (1 + 1e-5) + 1e-6
        assert np.all(b.u <= python.actuators.upper * (1 + 1e-6))
        assert np.all(b.u >= python.actuators.lower - 1e-6 * np.abs(python.actuators.lower))
        assert c.report().dynamics < 1e-6 * max(1.0, float(np.abs(b.u).max()))
    assert relaxed >= 3


@pytest.mark.long(but=("solo8-base_link-release", "tilthex_arm-ee-keep", "tilthex_arm-ee-follow"))
@pytest.mark.parametrize(
    ("name", "frame", "spring"),
    [("tilthex_arm", "ee", "keep"), ("tilthex_arm", "ee", "follow"), ("tilthex_arm", "ee", "release"),
     ("solo8", "base_link", "release")],
)  # fmt: skip
def test_the_impact_robust_term_agrees_with_python_in_all_phases(name: str, frame: str, spring: Spring) -> None:
    robot, formulation = formulation_of(name)
    objective = impact_of(robot, frame, (0.0, 0.0, 1.0))
    c = compiled(name, objective)
    posture = formulation.posture
    assert posture is not None
    gradient = gradient_of(gradient_beside(name, objective))
    robust = ImpactRobustPosture(robot, gradient, kp=posture.kp, weight=posture.weight, spring=spring, follow=0.02)
    robust.activation.ramp = 0.01
    for parameter, value in (("ramp", 0.01), ("follow", 0.02), ("spring", get_args(Spring).index(spring))):
        c.parameters[f"robust_{parameter}"][:] = value
    python = Controller(robot, type(formulation)(
        formulation.levels, formulation.weighted, robust, formulation.contacts, formulation.force_point,
    ))  # fmt: skip
    q, v = robot.posture(), np.zeros(robot.nv)
    python.reset(q, v)
    c.reset(q, v)
    levels = set()
    phases = (("brace", 3), ("contact", 40), ("release", 75))
    # In Python, a phase begins when its method is called.  In C, each phase has a start time, and the call may come
    # before this time.
    for phase, at in phases[:2]:
        getattr(c, phase)(1e-3 * at)
    for wrong, at in (("brace", 0.08), ("contact", 0.08), ("release", 0.03), ("release", np.nan)):
        with pytest.raises(InputError, match="follow"):
            getattr(c, wrong)(at)
    for k in range(110):
        for phase, at in phases:
            if k == at:
                getattr(robust, phase)()
                if phase == "release":
                    c.release()
        a, b = python.tick(1e-3 * k, q, v), c.tick(1e-3 * k, q, v)
        assert a.status is b.status is Status.SOLVED
        assert difference(a, b) < 1e-9
        assert c.level == c.report().level == robust.level
        levels.add(round(c.level, 3))
        v = v + 1e-3 * a.acceleration
        q = np.asarray(pin.integrate(robot.model, q, 1e-3 * v))
    assert {0.0, 1.0} < levels


def test_a_stiffened_posture_agrees_with_python(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    robot, formulation = formulation_of("panda")
    root = np.random.default_rng(2).normal(size=(robot.nv, robot.nv))
    assert formulation.posture is not None
    formulation.posture.stiffen(3.0 * root @ root.T)
    monkeypatch.setenv("CFLAGS", "-O0")
    written = export_controller(robot, formulation, tmp_path / "c", daqp=exported("panda") / "daqp", build=True)
    python, c, q, v = Controller(robot, formulation), written.load(), robot.posture(), np.zeros(robot.nv)
    for controller in (python, c):
        controller.reset(q, v)
    rng = np.random.default_rng(3)
    for k in range(5):
        state = random_state(robot, rng, 0.03)
        assert difference(python.tick(1e-3 * k, *state), c.tick(1e-3 * k, *state)) < 1e-9


def test_a_sole_on_its_edge_is_refused_until_it_stands() -> None:
    python, c, q, v = both_at_rest("talos")
    turned = q.copy()
    turned[3:7] = [0.0, np.sqrt(0.5), 0.0, np.sqrt(0.5)]
    for controller in (python, c):
        with pytest.raises(ContactError, match="stands on its edge"):
            controller.reset(turned, v)
    with pytest.raises(InputError, match="has not been reset"):
        c.tick(0.0, q, v)
    assert difference(python.reset(q, v), c.reset(q, v)) < 1e-9
    assert difference(python.tick(0.0, q, v), c.tick(0.0, q, v)) < 1e-9


def test_an_export_leaves_the_tasks_of_a_running_controller_alone() -> None:
    robot, formulation = formulation_of("panda")
    controller, task = Controller(robot, formulation), formulation.levels[0][0]
    controller.reset(robot.posture(), np.zeros(robot.nv))
    structure_of(robot, formulation)
    before = controller.tick(0.0, robot.posture(), np.zeros(robot.nv))
    task.target_velocity = np.full(task.size, 0.1)
    after = controller.tick(1e-3, robot.posture(), np.zeros(robot.nv))
    assert difference(before, after) > 0.1


def test_a_singular_arm_is_damped_as_in_python() -> None:
    python, c, _, _ = both_at_rest("panda")
    rng, deficient = np.random.default_rng(0), 0
    for k in range(280):
        q, v = random_state(python.robot, rng, 1.0)
        a, b = python.tick(1e-3 * k, q, 0.2 * v), c.tick(1e-3 * k, q, 0.2 * v)
        assert a.status is b.status
        if a.status is Status.SOLVED and python.report().deficient:
            deficient += 1
            assert difference(a, b) < 1e-9
            in_python, in_c = (x.report().deficient[0].amount for x in (python, c))
            assert in_c == pytest.approx(in_python, rel=1e-7)
    assert deficient >= 2


def test_targets_are_set_by_the_name_of_their_task() -> None:
    python, c, q, v = both_at_rest("panda")
    robot, task = python.robot, python.formulation.levels[0][0]
    name = task.name
    turn = pin.exp3(np.array([0.1, -0.2, 0.3]))
    target = pin.SE3(task.target.rotation @ turn, task.target.translation + 0.01)  # type: ignore[attr-defined]
    task.target, task.target_velocity, task.target_acceleration = target, np.full(6, 0.1), np.full(6, -0.2)  # type: ignore[attr-defined]
    c.set_target(name, target, 0.1, -0.2)
    goal = robot.posture() + 0.1
    python.formulation.posture.move_to(goal, 0.01)  # type: ignore[union-attr]
    c.move_to(goal, 0.01)
    for k in range(4):
        assert difference(python.tick(0.004 * k, q, v), c.tick(0.004 * k, q, v)) < 1e-9
    # If the target is deleted, the task holds the pose that the end effector has at the next reset.
    c.forget_target(name)
    fresh = compiled("panda")
    for controller in (c, fresh):
        controller.reset(q, v)
    assert difference(c.tick(0.0, q, v), fresh.tick(0.0, q, v)) < 1e-12
    with pytest.raises(InputError, match="there is no task 'hand'"):
        c.forget_target("hand")


def test_a_moving_reference_leads_the_posture() -> None:
    python, c, q, v = both_at_rest("solo8")
    robot, posture = python.robot, python.formulation.posture
    assert posture is not None
    goal = np.asarray(pin.integrate(robot.model, q, np.full(robot.nv, 0.02)))
    posture._target[:], posture.target_velocity, posture.target_acceleration = goal, 0.3, -2.0
    rate = np.ones(robot.nv)
    c.lead_posture(goal, 0.3 * rate, -2.0 * rate)
    a, b = python.tick(0.0, q, v), c.tick(0.0, q, v)
    assert difference(a, b) < 1e-9
    assert difference(a, c.reset(q, v)) > 1e-3


@pytest.mark.parametrize("name", ["tilthex_arm", "panda", "solo8"])
def test_a_motion_leads_all_tasks_as_in_python(name: str) -> None:
    python, c, q, v = both_at_rest(name)
    robot, formulation, rng = python.robot, python.formulation, np.random.default_rng(6)
    (q_led, v_led), a_led = random_state(robot, rng, 0.01), 0.3 * rng.normal(size=robot.nv)
    formulation.lead(State(robot, formulation.points).update(q_led, v_led), a_led)
    c.lead(q_led, v_led, a_led)
    a, b = python.tick(0.0, q, v), c.tick(0.0, q, v)
    assert a.status is b.status is Status.SOLVED and difference(a, b) < 1e-9
    for task in formulation.tasks:
        if isinstance(task, TargetTask):
            wanted = np.concatenate([task.target_velocity, task.target_acceleration])
            row = c.targets[task.name]
            have = np.concatenate([row[13 : 13 + task.size], row[19 : 19 + task.size]])
            np.testing.assert_allclose(have, wanted, rtol=0, atol=1e-9)
            assert np.abs(wanted).max() > 0.05
            before = row.copy()
            c.set_target(task.name, task.required_target(), *np.split(wanted, 2))
            np.testing.assert_allclose(row, before, rtol=0, atol=1e-9)
    with pytest.raises(InputError, match="a number is invalid"):
        c.lead(q, v, np.full(robot.nv, np.nan))


def test_a_reset_forgets_a_led_posture() -> None:
    _, c, q, v = both_at_rest("panda")
    first = c.reset(q, v)
    c.lead_posture(q, v + 0.5, v + 2.0)
    # Programs in C call the reset function like this, without ip_init.
    c._call("reset", *c._pointers[:2], ctypes.byref(c._command))
    np.testing.assert_allclose(c._commanded().u, first.u, rtol=0, atol=1e-9)


def test_arrays_of_another_shape_are_refused() -> None:
    _, c, q, v = both_at_rest("panda")
    c.tick(0.0, q, v)
    pose = next(iter(c.targets))
    moves = [
        lambda: c.tick(0.1, q, 0.1), lambda: c.tick(0.1, q, v[:1]), lambda: c.tick(0.1, q[None], v),
        lambda: c.reset(0.3, v), lambda: c.move_to(0.3), lambda: c.lead_posture(q, 0.1, v),
        lambda: c.set_target(pose, 0.5), lambda: c.set_target(pose, q[:3]),
    ]  # fmt: skip
    for move in moves:
        with pytest.raises(ValueError):
            move()
    c.move_to(q + 0.1)
    assert np.array_equal(c.measured[0], q)


def test_two_contexts_of_a_library_do_not_disturb_each_other() -> None:
    robot = formulation_of("panda")[0]
    one, other = compiled("panda"), compiled("panda")
    q, v = robot.posture(), np.zeros(robot.nv)
    one.reset(q, v)
    first = one.tick(0.0, q, v)
    one.reset(q, v)
    other.reset(q + 0.1, v + 0.1)
    other.tick(0.0, q - 0.1, v)
    assert np.array_equal(one.tick(0.0, q, v).u, first.u)
    with pytest.raises(InputError, match="no reference flow"):
        one.brace(t_impact=1.0)
