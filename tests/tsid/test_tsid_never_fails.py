"""A tick always returns a command: at extreme states, with invalid input, and after jumps of the clock."""

from __future__ import annotations

import itertools
import warnings

import numpy as np
import pinocchio as pin
import pytest

from impact_posture.robot.robot import Robot
from impact_posture.tsid.controller import Controller, Status
from impact_posture.tsid.point_kinematics import Point
from impact_posture.tsid.qp import hierarchy
from impact_posture.tsid.qp.hierarchy import Level, balanced, lexicographic
from impact_posture.tsid.task_formulation import (
    TaskFormulation,
    aerial_formulation,
    arm_formulation,
    legged_formulation,
)
from impact_posture.tsid.tasks.frame_tasks import FramePose, Impedance
from impact_posture.tsid.tasks.impact_robust import Gradient, ImpactRobustPosture, Spring
from impact_posture.tsid.tasks.joint_posture import JointPosture
from tests.support.helpers import rng, robot
from tests.support.step_bounds import level_bound
from tests.tsid.test_tsid_controller import DT, assert_dynamics, assert_limits

ANSWERED = (Status.SOLVED, Status.RELAXED)
PROGRAMS = [
    ("tilthex_arm", "strict"), ("tilthex_arm", "weighted"), ("panda", "arm"), ("kinova", "arm"),
    ("solo8", "legged"), ("bolt", "legged"), ("talos", "legged"), ("g1", "legged"),
]  # fmt: skip


def well(r: Robot) -> Gradient:
    """Return the gradient of a quadratic objective around another posture."""
    goal = np.array(pin.integrate(r.model, r.posture(), 0.3 * rng(r.name, "well").normal(size=r.nv)))

    def gradient(q: np.ndarray) -> tuple[float, np.ndarray]:
        away = pin.difference(r.model, goal, q)
        return 1.0 + 0.5 * float(away @ away), away

    return gradient


def program_of(r: Robot, kind: str, posture: JointPosture) -> TaskFormulation:
    if kind == "legged":
        return legged_formulation(r, posture)
    point = Point(r.spec.contact.frame or "")
    ee = FramePose(point, kp=60.0, impedance=Impedance(3.0, 1.0))
    if kind == "arm":
        return arm_formulation(r, posture, end_effector=ee)
    return aerial_formulation(r, posture, end_effector=ee, order=kind)  # type: ignore[arg-type]


def bracing(name: str, kind: str, spring: Spring = "keep") -> tuple[Controller, ImpactRobustPosture]:
    r = robot(name)
    posture = ImpactRobustPosture(r, well(r), K=20.0, kp=20.0, weight=0.1, base_weight=0.0, spring=spring)
    controller = Controller(r, program_of(r, kind, posture))
    controller.reset(r.posture(), np.zeros(r.nv))
    posture.brace()
    return controller, posture


@pytest.mark.parametrize(("name", "kind"), PROGRAMS)
def test_hard_states_are_answered(name: str, kind: str) -> None:
    """Far from the posture, too fast, or pushed with up to 10 kN, a tick satisfies the hard constraints."""
    controller, _ = bracing(name, kind)
    r, generator = controller.robot, rng(name, kind)
    seen = set()
    cases = itertools.product(
        (0.0, 0.1, 1.0), (0.0, 1.0, 10.0, 30.0), (0.0,) if kind == "legged" else (0.0, 1e2, 1e4)
    )
    for k, (far, fast, push) in enumerate(cases):
        q = np.array(pin.integrate(r.model, r.posture(), far * generator.normal(size=r.nv)))
        force = None if kind == "legged" else push * generator.normal(size=6)
        v = fast * generator.normal(size=r.nv)
        command = controller.tick(k * DT, q, v, force)
        report = controller.report()
        assert command.status in ANSWERED, (far, fast, push, command.status)
        assert (command.status is Status.RELAXED) == bool(report.relaxed)
        seen.add(command.status)
        load = np.abs(controller.state.h).max() + np.abs(controller.state.M @ command.acceleration).max()
        assert report.dynamics <= 1e-8 + 1e-12 * load
        assert_limits(controller, command)
        contacts = controller.assembly.contacts
        assert (contacts.cone @ command.forces >= contacts.least - 1e-6).all()
    assert seen == set(ANSWERED)


@pytest.mark.parametrize(("name", "kind"), [("tilthex_arm", "strict"), ("kinova", "arm"), ("talos", "legged")])
def test_broken_measurements_hold_the_command_and_are_forgotten(name: str, kind: str) -> None:
    """Invalid measurements between valid ones do not change the last command."""
    controller, posture = bracing(name, kind)
    r = controller.robot
    q, v, force = r.posture(), 0.01 * rng(name).normal(size=r.nv), np.zeros(6)
    broken = []
    for bad in (np.nan, np.inf, -np.inf, 1e9, 1e150):
        for which in range(3):
            arrays = [q.copy(), v.copy(), force.copy()]
            arrays[which][-1] = bad
            broken.append((arrays[0], arrays[1], arrays[2]))
    for part in controller.state.unit_parts:
        for factor in (0.0, 0.5, 2.0):
            turned = q.copy()
            turned[part] *= factor
            broken.append((turned, v, force))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for k, (bad_q, bad_v, bad_force) in enumerate(broken):
            good = controller.tick(k * DT, q, v, force)
            assert good.status is Status.SOLVED
            assert controller.tick(np.nan, q, v, force).status is Status.NON_FINITE
            term = posture.term.copy()
            held = controller.tick((k + 0.5) * DT, bad_q, bad_v, bad_force)
            assert held.status is Status.NON_FINITE and np.array_equal(posture.term, term)
            rotors = controller.actuators.rotors
            known = np.where(np.abs(bad_v) < 1e8, bad_v, 0.0)[controller.actuators.base :]
            damped = good.u.copy()
            damped[rotors:] -= 10.0 * np.diag(controller.state.M)[controller.actuators.base :] * known
            expected = np.clip(damped, controller.actuators.lower, controller.actuators.upper)
            assert np.allclose(held.u, expected, rtol=1e-9, atol=1e-7)
            assert np.isfinite(held.rotor_speed).all() and not held.acceleration.any()
    other, _ = bracing(name, kind)
    for k in range(len(broken)):
        clean = other.tick(k * DT, q, v, force)
    assert np.allclose(clean.u, good.u, rtol=0, atol=1e-9)


def test_arrays_of_another_shape_are_refused() -> None:
    controller, _ = bracing("tilthex_arm", "strict")
    q, v = controller.robot.posture(), np.zeros(controller.robot.nv)
    for bad in (
        (q[:1], v, None),
        (q, v[:1], None),
        (q, v, np.zeros(4)),
        (q, v, np.zeros((3, 1))),
        (q[None], v, None),
    ):
        with pytest.raises(ValueError, match="shape"):
            controller.tick(0.0, *bad)


def test_nearly_unit_numbers_are_normalized() -> None:
    """Estimators return quaternions, and pairs of cosine and sine, whose length is not exactly one."""
    for name, kind in (("tilthex_arm", "strict"), ("kinova", "arm")):
        controller, posture = bracing(name, kind)
        q, v = controller.robot.posture(), np.zeros(controller.robot.nv)
        exact = controller.tick(0.0, q, v)
        off = q.copy()
        for part in controller.state.unit_parts:
            off[part] *= 1.003
        controller.reset(q, v)
        posture.brace()
        assert np.allclose(controller.tick(0.0, off, v).u, exact.u, rtol=0, atol=1e-9)
        # At the call of `contact`, the reached posture becomes the target without further checks.
        posture.contact()
        assert controller.tick(DT, off, v).status is Status.SOLVED


def test_phases_upside_down_are_answered() -> None:
    controller, posture = bracing("tilthex_arm", "strict")
    q, v = controller.robot.posture(), np.zeros(controller.robot.nv)
    q[3:7] = (1.0, 0.0, 0.0, 0.0)
    posture.contact()
    assert controller.tick(0.0, q, v).status in ANSWERED
    posture.release()
    assert controller.tick(DT, q, v).status in ANSWERED


@pytest.mark.parametrize("how", ["raises", "nan", "inf", "shape", "none"])
def test_a_gradient_that_fails_keeps_the_last_term(how: str) -> None:
    r, works = robot("tilthex_arm"), True
    good = well(r)

    def function(q: np.ndarray) -> tuple[float, np.ndarray]:
        if works:
            return good(q)
        if how == "raises":
            raise ZeroDivisionError
        bad = {"nan": np.full(r.nv, np.nan), "inf": np.full(r.nv, np.inf), "shape": np.zeros(3), "none": None}[how]
        return 1.0, bad  # type: ignore[return-value]

    posture = ImpactRobustPosture(r, function, every=1)
    controller = Controller(r, aerial_formulation(r, posture))
    q, v = r.posture(), np.zeros(r.nv)
    controller.reset(q, v)
    posture.brace()
    controller.tick(0.0, q, v)
    term, value = posture.term.copy(), posture.value
    works = False
    with np.errstate(invalid="ignore"):
        assert controller.tick(DT, q, v).status is Status.SOLVED
    assert posture.failed and posture.value == value and np.array_equal(posture.term, term)
    works = True
    assert controller.tick(2 * DT, q, v).status is Status.SOLVED and not posture.failed


def test_clocks_that_stand_jump_and_run_backwards() -> None:
    """A tick advances the time by 0 to 10 periods, and the controller continues after each jump of the clock."""
    controller, posture = bracing("tilthex_arm", "strict")
    q, v = controller.robot.posture(), np.zeros(controller.robot.nv)
    level, longest = 0.0, level_bound(posture.activation, 10 * DT)
    for t in (0.0, 1.0, 1.0, -5.0, -4.999, 1e9, 1e9 + 1.0, -1e300, 0.0):
        assert controller.tick(t, q, v).status is Status.SOLVED
        assert level <= posture.activation.level <= level + longest
        level = posture.activation.level
    assert level > 0


def test_motors_without_torque() -> None:
    """With almost no torque, all levels are relaxed, but the command satisfies dynamics, limits and cones."""
    for name, kind in (("panda", "arm"), ("solo8", "legged")):
        controller, _ = bracing(name, kind)
        for bound, sign in ((controller.actuators.lower, -1.0), (controller.actuators.upper, 1.0)):
            bound[:] = sign * 1e-6
        q, v = controller.robot.posture(), 0.1 * rng(name, "weak").normal(size=controller.robot.nv)
        for k in range(5):
            command = controller.tick(k * DT, q, v)
            assert command.status in ANSWERED
            assert_limits(controller, command)
            assert_dynamics(controller, command)


# ---- levels ----------------------------------------------------------------------------------------------------


def test_balanced_rows_keep_the_least_squares() -> None:
    generator = rng("balanced")
    for k, n in ((1, 3), (2, 5), (6, 9), (6, 4), (12, 38)):
        A, b = generator.normal(size=(k, n)) * 10.0 ** generator.uniform(-2, 2, size=(k, 1)), generator.normal(size=k)
        turned, wanted = balanced(A, b)
        assert np.allclose((turned * turned).sum(axis=1), (A * A).sum() / k, rtol=1e-9)
        assert np.allclose(turned.T @ turned, A.T @ A, rtol=1e-9, atol=1e-9 * (A * A).sum())
        assert np.allclose(turned.T @ wanted, A.T @ b, rtol=1e-9, atol=1e-9 * np.abs(A).max())


@pytest.mark.parametrize("refined", [True, False])
def test_levels_against_one_quadratic_program_after_the_other(refined: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """quadprog solves each level; equations keep the results of the higher levels."""
    quadprog = pytest.importorskip("quadprog")
    if not refined:
        monkeypatch.setattr(hierarchy, "_no_worse", lambda *points: False)
    generator = rng("levels")
    for _ in range(20):
        n = 8
        C, d = generator.normal(size=(10, n)), generator.uniform(0.1, 1, 10)
        first, second = generator.normal(size=(2, n)), generator.normal(size=(4, n)) * [[1], [3], [0.3], [10]]
        wanted = 5 * generator.normal(size=2), 5 * generator.normal(size=4)
        z = lexicographic([Level(C, -d, d), Level(first, wanted[0], wanted[0]), Level(second, wanted[1], wanted[1])])
        assert z is not None and (np.abs(C @ z) <= d + 1e-10).all()
        rows, least = np.vstack([C, -C]), np.concatenate([-d, -d])
        for A, b in ((first, wanted[0]), (second, wanted[1])):
            x = quadprog.solve_qp(A.T @ A + 1e-9 * np.eye(n), A.T @ b, rows.T, least)[0]
            assert np.linalg.norm(A @ z - b) == pytest.approx(np.linalg.norm(A @ x - b), rel=1e-4, abs=1e-4)
            # The values reached at a level become bounds for lower levels, with a tolerance for rounding.
            rows = np.vstack([rows, A, -A])
            least = np.concatenate([least, A @ x - 1e-7, -A @ x - 1e-7])


def test_a_level_that_can_hold_holds_though_the_solver_gives_it_up(monkeypatch: pytest.MonkeyPatch) -> None:
    generator, n = rng("given up"), 8
    C, d = generator.normal(size=(10, n)), generator.uniform(0.1, 1, 10)
    inside, below = 0.01 * generator.normal(size=n), generator.normal(size=(3, n))
    limits = Level(np.eye(n), inside - 0.01, inside + 0.01)
    levels = [Level(C, -d, d), limits, Level(below, *2 * [5 * generator.normal(size=3)])]
    assert (np.abs(C @ inside) < d).all()
    right, nearest, calls = lexicographic(levels), hierarchy._nearest, []

    def gives_up(given: list[Level]) -> np.ndarray | None:
        calls.append(len(given))
        return nearest([given[0], given[2]] if len(calls) == 1 else given)

    monkeypatch.setattr(hierarchy, "_nearest", gives_up)
    z = lexicographic(levels)
    assert calls == [3, 2] and right is not None and z is not None
    assert np.allclose(z, right, rtol=0, atol=1e-9)
