"""Strict levels of any rank: dependent rows, contradictory rows, and postures near a singularity."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from impact_posture.robot.robot import Robot
from impact_posture.tsid.controller import Command, Controller, Status
from impact_posture.tsid.limits.acceleration_bounds import LimitLaw
from impact_posture.tsid.point_kinematics import Point
from impact_posture.tsid.qp.level_rank import SINGULAR
from impact_posture.tsid.qp.quadratic_program import EQUALITY
from impact_posture.tsid.state import State
from impact_posture.tsid.task_formulation import TaskFormulation, aerial_formulation, arm_formulation
from impact_posture.tsid.tasks.body_tasks import BaseOrientation, Tilt
from impact_posture.tsid.tasks.frame_tasks import EndEffector, FrameAligned, FramePose, FramePosition
from impact_posture.tsid.tasks.joint_posture import JointPosture
from impact_posture.tsid.tasks.task import Task
from tests.support.arms import TIP, X, Y, Z, arm, yaw_and_pitches
from tests.support.helpers import rng, robot
from tests.tsid.test_tsid_controller import DT, assert_dynamics, assert_limits, integrate
from tests.tsid.test_tsid_never_fails import bracing

Vector = np.ndarray[Any, Any]


def borinot() -> Robot:
    """Return borinot with the rotors of another robot, because the rotor data of borinot are not published."""
    r, rotors = robot("borinot"), robot("tilthex_arm").spec.propulsion
    assert rotors is not None
    return replace(r, spec=replace(r.spec, propulsion=replace(rotors, frame="borinot__base_link")))


FLYING_ARMS: dict[str, Callable[[], Robot]] = {"yaw, three pitches": yaw_and_pitches, "borinot": borinot}


# ---- free flight ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("noise", [0.0, 1e-3])
@pytest.mark.parametrize("name", FLYING_ARMS)
def test_gentle_flight_is_solved_at_every_tick(name: str, noise: float) -> None:
    """The arm cannot roll the end effector, so base tilt and end effector pose share a row."""
    r = FLYING_ARMS[name]()
    controller, generator = Controller(r, aerial_formulation(r, JointPosture(r))), rng(name, noise)
    # At a small velocity, the two tasks demand accelerations along the shared row that differ in the seventh digit.
    q, v = r.posture(), 1e-7 * generator.normal(size=r.nv)
    assert controller.reset(q, v).status is Status.SOLVED
    for k in range(300):
        seen = pin.integrate(r.model, q, noise * generator.normal(size=r.nv)), v + noise * generator.normal(size=r.nv)
        command = controller.tick(k * DT, *seen)
        assert command.status is Status.SOLVED, k
        assert np.abs(controller.report().residuals["tilt"]).max() <= 1e-8
        q, v = integrate(r, q, v, command)
    assert_dynamics(controller, command)
    assert np.linalg.norm(v) < (0.05 if noise else 1e-6)


@pytest.mark.parametrize("name", FLYING_ARMS)
def test_rows_that_agree_hold_exactly_and_others_are_reported(name: str) -> None:
    r = FLYING_ARMS[name]()
    away = pin.integrate(r.model, r.posture(), np.r_[np.zeros(6), 0.3 * rng(name).normal(size=r.nv - 6)])
    controller = Controller(r, aerial_formulation(r, JointPosture(r, away)))
    controller.reset(r.posture(), np.zeros(r.nv))
    report = controller.report()
    hand = controller.formulation.levels[1][0]
    assert report.status is Status.SOLVED and report.relaxed == report.deficient == ()
    assert np.abs(report.residuals["tilt"]).max() <= 1e-8 and np.abs(report.residuals[hand.name]).max() <= 1e-8
    # For a target rolled about the arm's plane, the tilt is exact and the pose error is as small as possible.
    assert isinstance(hand, FramePose) and hand.target is not None
    hand.target = pin.SE3(pin.exp3(np.array([0.1, 0.05, 0.0])) @ hand.target.rotation, hand.target.translation)
    command, report = controller.tick(0.0, r.posture(), np.zeros(r.nv)), controller.report()
    assert command.status is Status.SOLVED and not report.relaxed
    assert np.abs(report.residuals["tilt"]).max() <= 1e-8
    (short,) = report.deficient
    assert short.level == hand.name
    assert short.amount == pytest.approx(np.linalg.norm(report.residuals[hand.name]), rel=1e-6)
    assert short.amount == pytest.approx(free_answer(controller)[2][1], rel=1e-6) and short.amount > 1.0


@pytest.mark.parametrize(("kind", "rows"), [(FramePosition, 3), (FrameAligned, 5)])
def test_a_task_with_fewer_rows_is_not_deficient(kind: type[EndEffector], rows: int) -> None:
    """The task does not constrain the spin about the tool axis, which this arm cannot produce."""
    r = arm([Z, Y, Y, Y], [0.3, -0.8, 0.3, -0.5], floating=True)
    axis: Any = {} if kind is FramePosition else {"axis": rotation(r).T @ np.array([np.cos(0.3), np.sin(0.3), 0.0])}
    task = kind(Point(TIP), kp=60.0, **axis)
    controller = Controller(r, aerial_formulation(r, JointPosture(r), end_effector=task))
    controller.reset(r.posture(), np.zeros(r.nv))
    v = 0.1 * rng(kind.__name__).normal(size=r.nv)
    assert controller.tick(0.0, r.posture(), v).status is Status.SOLVED
    report = controller.report()
    assert task.size == rows and not report.deficient
    assert np.abs(report.residuals[task.name]).max() <= 1e-8 and np.abs(report.residuals["tilt"]).max() <= 1e-8


def rotation(r: Robot) -> Vector:
    return np.array(State(r, [point := Point(TIP)]).update(r.posture(), np.zeros(r.nv)).at(point).rotation)


# ---- random stacks on random arms -------------------------------------------------------------------------------


class Scaled(Task):
    """Task ``inner`` in another unit, ``factor`` times as large."""

    def __init__(self, inner: Task, factor: float) -> None:
        super().__init__(f"{inner.name}, scaled", inner.size, kp=inner.kp, kd=inner.kd)
        self.inner, self.factor, self.points = inner, factor, inner.points

    def reset(self, state: State) -> None:
        self.inner.reset(state)

    def error(self, state: State) -> Vector:
        return self.factor * self.inner.error(state)

    def jacobian(self, state: State) -> Vector:
        return self.factor * self.inner.jacobian(state)

    def drift(self, state: State) -> Vector:
        return self.factor * self.inner.drift(state)


def task_of(kind: str, link: int, name: str) -> Task:
    if kind == "tilt":
        return Tilt(name=name)
    if kind == "base":
        return BaseOrientation(name=name)
    if kind == "link":
        return FramePosition(Point(f"link_{link}", (0.0, 0.0, -0.1)), kp=60.0, name=name)
    return {"pose": FramePose, "position": FramePosition, "aligned": FrameAligned}[kind](
        Point(TIP), kp=60.0, name=name
    )


def turn_away(task: Task, by: Vector) -> None:
    task = task.inner if isinstance(task, Scaled) else task
    if isinstance(task, FramePosition):
        task.target = task.target + by[:3]
    elif isinstance(task, FramePose | FrameAligned):
        task.target = task.target * pin.exp6(by)
    elif isinstance(task, Tilt):
        task.target = np.array([*by[:2], 1.0]) / np.hypot(1.0, np.hypot(*by[:2]))
    elif isinstance(task, BaseOrientation):
        task.target = task.target @ pin.exp3(by[3:])


@st.composite
def stacks(draw: st.DrawFn, *, limited: bool, far: float, fast: float) -> tuple[Controller, Vector, Vector]:
    """Return a controller of a random arm, with copied, scaled and contradictory tasks, and a random state."""
    floating, generator = draw(st.booleans()), np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    axes = draw(st.lists(st.sampled_from([X, Y, Z, None]), min_size=1 if floating else 2, max_size=7))
    n = len(axes)
    rods = [draw(st.sampled_from([(0, 0, -0.3), (0.2, 0, 0), None])) for _ in axes]
    stretched = draw(st.integers(0, 4)) == 0
    r = arm(
        [generator.normal(size=3) if axis is None else axis for axis in axes],
        np.zeros(n) if stretched else generator.uniform(-1.5, 1.5, n),
        floating=floating,
        rods=[generator.uniform(-0.3, 0.3, 3) if rod is None else rod for rod in rods],
        effort=5.0 if limited else 0.0,
    )
    kinds = ["pose", "position", "aligned", "link", *(["tilt", "base"] if floating else [])]
    tasks: list[tuple[str, int, Task]] = []
    for k in range(draw(st.integers(1, 4))):
        copied = tasks[draw(st.integers(0, k - 1))] if k and draw(st.booleans()) else None
        kind, link = copied[:2] if copied else (draw(st.sampled_from(kinds)), draw(st.integers(0, n - 1)))
        task = task_of(kind, link, f"{kind} {k}")
        tasks.append((kind, link, Scaled(task, draw(st.sampled_from([0.1, 7.0]))) if draw(st.booleans()) else task))
    levels: list[list[Task]] = []
    for *_, task in tasks:
        if levels and draw(st.booleans()):
            levels[-1].append(task)
        else:
            levels.append([task])
    posture = JointPosture(r, base_weight=draw(st.sampled_from([None, 0.0])))
    law = LimitLaw() if limited else None
    controller = Controller(r, TaskFormulation(tuple(map(tuple, levels)), (), posture, law=law))
    if not limited:
        controller.actuators.lower[:], controller.actuators.upper[:] = -np.inf, np.inf
    controller.reset(r.posture(), np.zeros(r.nv))
    for *_, task in tasks:
        if draw(st.booleans()):
            turn_away(task, far * generator.normal(size=6))
    still = draw(st.booleans())
    q = r.posture() if still else pin.integrate(r.model, r.posture(), far * generator.normal(size=r.nv))
    return controller, np.array(q), (0.0 if still else fast) * generator.normal(size=r.nv)


def levels_of(controller: Controller) -> list[tuple[Vector, Vector]]:
    """Return ``J`` and ``ÿ* − J̇ν`` of each level, computed from the tasks."""
    state = controller.state
    return [
        (
            np.vstack([task.jacobian(state) for task in level]),
            np.concatenate([task.desired(state) - task.drift(state) for task in level]),
        )
        for level in controller.formulation.levels
    ]


def free_answer(controller: Controller) -> tuple[Vector, Vector, list[float], float]:
    """Return the solution without limits, the free directions, the residuals, and the least singular value."""
    x, Zs, missed, least = np.zeros(controller.robot.nv), np.eye(controller.robot.nv), [], np.inf
    for J, b in levels_of(controller):
        values = np.linalg.svd(J @ Zs, compute_uv=False) / max(np.linalg.norm(J, axis=1).max(), 1e-3)
        rank = int(np.count_nonzero(values > 1e-7))
        least = min(least, *values[:rank], np.inf)
        x = x + Zs @ np.linalg.lstsq(J @ Zs, b - J @ x, rcond=1e-7 / max(1.0, *values))[0] if rank else x
        Zs = Zs @ np.linalg.svd(J @ Zs)[2][rank:].T
        missed.append(float(np.linalg.norm(J @ x - b)))
    return x, Zs, missed, least


def reached(controller: Controller, command: Command) -> list[float]:
    return [float(np.linalg.norm(J @ command.acceleration - b)) for J, b in levels_of(controller)]


@settings(max_examples=60)
@given(stacks(limited=False, far=0.1, fast=0.3))
def test_any_stack_has_the_lexicographic_answer(drawn: tuple[Controller, Vector, Vector]) -> None:
    """NumPy solves the levels one after the other by least squares, then the posture task in the free directions."""
    controller, q, v = drawn
    command = controller.tick(0.0, q, v)
    assert command.status is Status.SOLVED
    x, Zs, missed, least = free_answer(controller)
    assume(least > 1.5 * SINGULAR)
    posture = controller.formulation.posture
    assert posture is not None
    # Accelerations without a weight get a small weight that pulls them to zero.
    weight, wanted = np.maximum(posture.weight, 1e-8), posture.weight * posture.desired(controller.state)
    best = x + Zs @ np.linalg.solve(Zs.T @ (weight[:, None] * Zs), Zs.T @ (wanted - weight * x))
    np.testing.assert_allclose(command.acceleration, best, rtol=0, atol=1e-6 * (1 + np.abs(best).max()))
    for (J, b), miss in zip(levels_of(controller), missed, strict=True):
        scale = 1.0 + float(np.abs(b).max())
        off = float(np.linalg.norm(J @ command.acceleration - b))
        assert abs(off - miss) <= 1e-8 * scale
    named = {short.level for short in controller.report().deficient}
    for (name, _), (_, b), miss in zip(controller.assembly.levels, levels_of(controller), missed, strict=True):
        assert (name in named) == (miss > 1e-5 * (1 + np.abs(b).max())) or miss < 1e-3


@settings(max_examples=40)
@given(stacks(limited=True, far=0.5, fast=3.0))
def test_any_stack_is_answered_within_limits(drawn: tuple[Controller, Vector, Vector]) -> None:
    """quadprog solves one quadratic program per level, in the directions that the higher levels leave free."""
    quadprog = pytest.importorskip("quadprog")
    controller, q, v = drawn
    command = controller.tick(0.0, q, v)
    assert command.status in (Status.SOLVED, Status.RELAXED)
    assert np.isfinite(command.u).all()
    assert_limits(controller, command)
    _, _, free, least = free_answer(controller)
    report, qp = controller.report(), controller.assembly.qp
    assume(least > 1.5 * SINGULAR and all(gave.level != "joint limits" for gave in report.relaxed))
    count = sum(task.size for level in controller.formulation.levels for task in level)
    rows, n = np.vstack([np.eye(qp.n), qp.A[count:]]), qp.n
    lower, upper = np.delete(qp.lower, np.s_[n : n + count]), np.delete(qp.upper, np.s_[n : n + count])
    below, above = np.isfinite(lower), np.isfinite(upper)
    C, d = np.vstack([rows[below], -rows[above]]), np.concatenate([lower[below], -upper[above]])
    x, Zs, misses = command.acceleration, np.eye(n), reached(controller, command)
    for k, (J, b) in enumerate(levels_of(controller)):
        A = J @ Zs
        # No step in the free directions may reduce the residual of the level.
        step = quadprog.solve_qp(
            A.T @ A + 1e-9 * np.eye(A.shape[1]), A.T @ (b - J @ x), (C @ Zs).T, d - C @ x - 1e-7 * (1 + np.abs(d))
        )[0]
        # A relaxed level is accurate to four digits, relative to the terms of its rows.
        assert misses[k] <= np.linalg.norm(A @ step + J @ x - b) + 1e-4 * (1 + (np.abs(J) @ np.abs(x)).max())
        values, right = np.linalg.svd(A)[1:]
        Zs = Zs @ right[np.count_nonzero(values > 1e-7) :].T
        if not Zs.shape[1]:
            break
    if command.status is Status.SOLVED:
        np.testing.assert_allclose(misses, free, rtol=0, atol=1e-5 * (1 + max(free)))
    else:
        assert any(miss > best + 1e-9 for miss, best in zip(misses, free, strict=True))


# ---- near a singularity -----------------------------------------------------------------------------------------


def planar(position: type[EndEffector] = FramePosition) -> tuple[Robot, TaskFormulation]:
    """Three parallel hinges cannot move the tip sideways, and a stretched arm cannot move the tip along itself."""
    r = arm([Y, Y, Y], [0.3, 0.4, -0.2], floating=False, effort=0.0)
    return r, arm_formulation(r, JointPosture(r), end_effector=position(Point(TIP), kp=60.0))


def wrist() -> tuple[Robot, TaskFormulation]:
    r = arm([Z, Y, Y, X, Y, X], [0.3, 0.4, 0.8, 0.2, 0.5, 0.1], floating=False, effort=0.0)
    return r, arm_formulation(r, JointPosture(r), law=None)


def flying() -> tuple[Robot, TaskFormulation]:
    """The second hinge rolls the tip.  If the first link is vertical, the second hinge and the base yaw the tip."""
    r = arm([Y, Z, Y], [0.3, 0.4, -0.2], floating=True)
    return r, aerial_formulation(r, JointPosture(r), law=None)


def two_levels() -> tuple[Robot, TaskFormulation]:
    """Both levels are singular at one posture.  There, the upper level frees a direction for the lower level."""
    r = arm([Z, Y, Y, X, Y, X], [0.3, 0.4, 0.8, 0.2, 0.5, 0.1], floating=False, effort=0.0)
    tip, elbow = FramePosition(Point(TIP), kp=60.0), FramePosition(Point("link_2", (0, 0, -0.3)), kp=60.0)
    return r, TaskFormulation(((tip,), (elbow,)), (), JointPosture(r), law=None)


# Distance of the targets from the states of a sweep (m or rad), so small that no limit becomes active.
AHEAD = {"flying": 1e-3}
SWEEPS: dict[str, tuple[Callable[[], tuple[Robot, TaskFormulation]], list[float], list[float]]] = {
    "planar": (planar, [0.3, 0.0, 0.0], [0.0, 0.8, 0.5]),
    "wrist": (wrist, [0.3, 0.4, 0.2, 0.3, 0.0, 0.1], [0.0, 0.5, 0.8, 0.0, 0.6, 0.0]),
    "flying": (flying, [0.0, 0.1, 0.4], [0.5, 0.1, 0.2]),
    "two levels": (two_levels, [0.3, 0.4, 0.0, 0.3, 0.0, 0.1], [0.0, 0.5, 0.8, 0.0, 0.6, 0.0]),
}


def swept(
    name: str,
    count: int,
    indices: Vector | None = None,
    torque: float = np.inf,
    look: Callable[[Controller, Command], None] = lambda controller, command: None,
) -> tuple[Vector, set[Status], Controller]:
    """Return accelerations at ``count`` states on a line through the singular posture, for nearby targets."""
    make, through, along = SWEEPS[name]
    r, formulation = make()
    controller, state = Controller(r, formulation), State(r, formulation.points)
    controller.reset(r.posture(), np.zeros(r.nv))
    if torque < np.inf:
        controller.actuators.lower[:], controller.actuators.upper[:] = -torque, torque
    accelerations, seen, places = [], set(), np.linspace(-1.0, 1.0, count)
    for k in range(count) if indices is None else indices:
        q, v = r.posture(), np.zeros(r.nv)
        q[-len(along) :], v[-len(along) :] = np.array(through) + places[k] * np.array(along), 0.05 * np.array(along)
        state.update(q, v)
        for task in (task for level in formulation.levels for task in level):
            if not isinstance(task, Tilt):
                task.target = None  # type: ignore[attr-defined]
                task.reset(state)
            turn_away(task, AHEAD.get(name, 0.01) * np.array([0.3, 0.2, -1.0, 0.5, -0.4, 0.3]))
        command = controller.tick(k * DT, q, v)
        look(controller, command)
        accelerations.append(command.acceleration)
        seen.add(command.status)
    return np.array(accelerations), seen, controller


@pytest.mark.parametrize("name", SWEEPS)
def test_a_slow_sweep_through_a_singular_posture_is_continuous(name: str) -> None:
    """A step of half the size halves the change of the accelerations, so accelerations are continuous and bounded."""
    coarse, seen, _ = swept(name, 401)
    fine, again, controller = swept(name, 801)
    assert seen == again == {Status.SOLVED}
    steps = [float(np.abs(np.diff(x, axis=0)).max()) for x in (coarse, fine)]
    assert steps[1] < 0.6 * steps[0]
    asked = max(float(np.linalg.norm(b)) for _, b in levels_of(controller))
    length = min(float(np.linalg.norm(J, axis=1).max()) for J, _ in levels_of(controller))
    assert np.abs(fine).max() < len(controller.formulation.levels) * 3 * asked / (SINGULAR * length)


@pytest.mark.parametrize(("name", "torque"), [("wrist", 1.0), ("two levels", 0.3)])
def test_a_relaxed_answer_is_damped_alike(name: str, torque: float) -> None:
    """If limits are active near a singularity, quadprog computes the same minimum of the damped cost."""
    quadprog, damped = pytest.importorskip("quadprog"), []

    def look(controller: Controller, command: Command) -> None:
        qp, full, solved = controller.assembly.rank.qp, controller.assembly.qp, controller._outcome.solved
        if command.status is not Status.RELAXED or qp is full or np.array_equal(qp.H, full.H):
            return
        assert solved is not None
        damped.append(command)
        equations = qp.sense[qp.n :] == EQUALITY
        rows, reached = qp.A[equations], qp.A[equations] @ solved.z
        below, above = -qp.A[~equations], qp.A[~equations]
        low, high = qp.lower[qp.n :][~equations], qp.upper[qp.n :][~equations]
        C = np.vstack([rows, -below[np.isfinite(low)], -above[np.isfinite(high)]])
        d = np.concatenate([reached, low[np.isfinite(low)], -high[np.isfinite(high)]])
        d[rows.shape[0] :] -= 1e-9 * (1 + np.abs(d[rows.shape[0] :]))
        best = quadprog.solve_qp(qp.H, -qp.g, C.T, d, rows.shape[0])[0]
        np.testing.assert_allclose(solved.z, best, rtol=0, atol=1e-4 * (1 + np.abs(best).max()))

    swept(name, 201, torque=torque, look=look)
    assert len(damped) > 20


@pytest.mark.parametrize("name", SWEEPS)
def test_there_is_no_hysteresis(name: str) -> None:
    """The same states in another order give the same commands, so earlier states have no influence."""
    count = 201
    forth, _, _ = swept(name, count)
    order = rng(name, "order").permutation(count)
    shuffled, _, _ = swept(name, count, order)
    np.testing.assert_allclose(shuffled, forth[order], rtol=0, atol=1e-7 * (1 + np.abs(forth).max()))


@pytest.mark.parametrize("name", ["tilthex_arm", "panda", "talos"])
def test_independent_levels_are_left_as_they_are(name: str) -> None:
    r = robot(name)
    controller, _ = bracing(name, {"tilthex_arm": "strict", "panda": "arm", "talos": "legged"}[name])
    for k in range(5):
        q = pin.integrate(r.model, r.posture(), 0.05 * rng(name, k).normal(size=r.nv))
        controller.tick(k * DT, q, np.zeros(r.nv))
        assert controller.assembly.rank.qp is controller.assembly.qp
