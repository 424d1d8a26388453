"""The reference flow lowers the objective, stays on the constraints and within limits, and comes to rest."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pinocchio as pin
import pytest
import scipy.optimize
from hypothesis import example, given, settings
from hypothesis import strategies as st

from docs.studies.flow_course import formulation_for
from impact_posture.errors import InputError, MetricError
from impact_posture.robot.robot import Robot
from impact_posture.tsid.actuators import Actuators
from impact_posture.tsid.controller import Controller, Status
from impact_posture.tsid.flow.flow_direction import FlowOptions
from impact_posture.tsid.flow.redundancy import Redundancy
from impact_posture.tsid.flow.reference_flow import UPDATE_TICKS, ReferenceFlow
from impact_posture.tsid.flow.reference_flow_posture import ReferenceFlowPosture
from impact_posture.tsid.flow.zero_moment_point import ZeroMomentPoint
from impact_posture.tsid.point_kinematics import Point
from impact_posture.tsid.support_contact import SupportContact
from impact_posture.tsid.task_formulation import TaskFormulation
from impact_posture.tsid.tasks.joint_posture import JointPosture
from tests.support.helpers import Vector, rng, robot
from tests.tsid.test_tsid_controller import DT, integrate

ROBOTS = ("tilthex_arm", "hextilt", "panda", "solo8")
Well = Callable[[Vector], tuple[float, Vector]]


def well(r: Robot, goal: Vector, depth: float = 0.1) -> Well:
    """Return a quadratic objective around a posture, with ``depth`` as its minimum."""
    base = r.first_joint

    def function(q: Vector) -> tuple[float, Vector]:
        away = np.array(pin.difference(r.model, goal, q))
        away[:base] = 0.0
        # Joint coordinates are vectors, so the gradient is the difference itself.
        return depth + 0.5 * float(away @ away), away

    return function


def goal_of(r: Robot, key: object, size: float) -> Vector:
    """Return a posture whose joints deviate by at most ``size`` rad from the default posture."""
    step = size * rng(r.name, key).uniform(-1, 1, r.nv)
    step[: r.first_joint] = 0.0
    return np.array(pin.integrate(r.model, r.posture(), step))


def flow_of(r: Robot, function: Well, weaker: float = 1.0, **options: float) -> ReferenceFlow:
    formulation, actuators = formulation_for(r, JointPosture(r)), Actuators(r)
    actuators.upper[actuators.rotors :] *= weaker
    actuators.lower[actuators.rotors :] *= weaker
    flow = ReferenceFlow(r, function, formulation, actuators, FlowOptions(**options))
    flow.reset(r.posture())
    return flow


@dataclass(frozen=True)
class Course:
    """Result of a flow: last posture, ``H/H₀`` at each update, time of rest (s), largest contact and task errors."""

    q: Vector
    values: Vector
    rested: float
    missed: float


def course(flow: ReferenceFlow, q: Vector, longest: float) -> Course:
    """Advance the flow from ``q`` until it rests; the robot follows the flow exactly."""
    flow.reset(q)
    flow.on = True
    values, missed = [flow.value], 0.0
    for k in range(round(longest / DT)):
        flow.advance(DT, flow.q)
        if k % UPDATE_TICKS == UPDATE_TICKS - 1:
            values.append(flow.value)
            missed = max(missed, float(np.abs(flow.error).max(initial=0.0)))
            if flow.resting and not np.abs(flow.velocity).max() > 1e-4:
                break
    rested = (k + 1) * DT if flow.resting else np.inf
    return Course(flow.q.copy(), np.array(values) / flow.start, rested, missed)


@pytest.mark.parametrize("name", ROBOTS)
def test_it_lowers_the_objective_and_rests(name: str) -> None:
    r = robot(name)
    flow = flow_of(r, well(r, goal_of(r, "rest", 0.6)))
    run = course(flow, r.posture(), 8.0)
    assert run.rested < 8.0 and run.missed < 1e-3
    assert np.diff(run.values).max() < 1e-6 and run.values[-1] < 0.999


@settings(max_examples=2, deadline=None)
@given(st.integers(0, 10**6))
@example(seed=205)
@pytest.mark.parametrize("name", ["panda", "talos"])
def test_no_limit_is_crossed_wherever_the_goal_is(name: str, seed: int) -> None:
    r = robot(name)
    flow = flow_of(r, well(r, goal_of(r, seed, 3.0)))
    options, start = flow.options, flow.shares.copy()
    lower, upper = (np.array(flow._state.room[k]) for k in (1, 0))
    worst = max(1.0, float(np.abs(start).max()))
    flow.on = True
    for _ in range(1500):
        before = flow.velocity.copy()
        flow.advance(DT, flow.q)
        assert np.abs(flow._governor.flow).max() <= options.speed * (1 + 1e-9)
        assert np.abs(flow.velocity - before).max() <= 1.6 * options.acceleration * DT
        assert np.abs(flow.shares).max() < worst + 0.03
    room = flow._state.update(flow.q, np.zeros(r.nv)).room
    for now, at_start in ((room[1], lower), (room[0], upper)):
        bounded = np.isfinite(now)
        margin = np.minimum(options.joint_margin, (room[0] + room[1])[bounded] / 8)
        assert (now[bounded] > np.minimum(margin, at_start[bounded]) - 5e-3).all()


def valley(r: Robot, key: object) -> Well:
    """Return an objective like a steep, curved valley, in which the flow must turn while it moves fast."""
    base = r.first_joint
    along, across = rng(r.name, key).normal(size=(2, r.nv - base)) / np.sqrt(r.nv - base)

    def function(q: Vector) -> tuple[float, Vector]:
        x = np.array(pin.difference(r.model, r.posture(), q))[base:]
        a = float(along @ x)
        off = float(across @ x) - 2 * a**2
        slope = np.zeros(r.nv)
        slope[base:] = (a - 1) * along + 20 * off * (across - 4 * a * along)
        return 0.1 + 0.5 * ((a - 1) ** 2 + 20 * off**2), slope

    return function


@pytest.mark.parametrize(
    ("key", "epsilon", "climb", "least", "rested"), [(3, 3e-6, 1e-3, 0.3, np.inf), (4, 0.05, 1e-5, np.inf, 2.5)]
)
def test_it_does_not_climb_where_it_turns_or_brakes(
    key: int, epsilon: float, climb: float, least: float, rested: float
) -> None:
    """In the first case the flow turns in the bend of the valley; in the second case the flow rests in the bend.

    If the flow ignored the slope at its stopping point, the objective would increase by 2e-2 and by 1e-1.
    """
    r = robot("talos")
    run = course(flow_of(r, valley(r, key), epsilon=epsilon), r.posture(), 3.0)
    assert (run.values - np.minimum.accumulate(run.values)).max() < climb
    assert run.values[-1] < least and (run.rested < rested or rested == np.inf)


@pytest.mark.long(but=("solo8",))
@pytest.mark.parametrize("name", ["solo8", "talos"])
def test_the_base_tilts_no_further_than_it_may(name: str) -> None:
    """The objective decreases as the base tilts about an axis between roll and pitch."""
    r, downhill = robot(name), np.array([0.4, 1.0, 0.0])

    def tilted(q: Vector) -> tuple[float, Vector]:
        vertical = pin.Quaternion(q[3:7]).matrix()[2]
        slope = np.zeros(r.nv)
        slope[3:6] = np.cross(downhill, vertical)
        return 2.0 + float(downhill @ vertical), slope

    def tilt(q: Vector) -> float:
        """Return the angle between the z axis of the base and the vertical."""
        return float(np.arccos(pin.Quaternion(q[3:7]).matrix()[2, 2]))

    bound = 0.12
    free, kept = (course(flow_of(r, tilted, tilt=t), r.posture(), 4.0) for t in (1.0, bound))
    assert tilt(free.q) > 1.5 * bound
    assert 0.9 * bound < tilt(kept.q) < bound + 2e-3


@pytest.mark.parametrize(("name", "weaker"), [("panda", 0.5), ("talos", 1.0)])
def test_acceleration_uses_its_share_of_the_torque_beside_rest(name: str, weaker: float) -> None:
    """The oracle is the recursive Newton-Euler algorithm; a least-norm solution distributes the base wrench."""
    r = robot(name)
    flow = flow_of(r, well(r, goal_of(r, "haste", 2.0)), weaker, speed=20.0, acceleration=100.0)
    data, none, base = r.model.createData(), np.zeros(r.nv), r.first_joint
    effort = weaker * r.model.effortLimit[base:]
    limited = effort > 0
    eased = np.sqrt(np.tile([1.0] * 3 + [100.0] * 3, 2))

    def torques(acceleration: Vector) -> Vector:
        force = pin.rnea(r.model, data, flow.q, none, acceleration)
        if base:
            feet = flow._J[:12] / eased[:, None]
            force = force - feet.T @ np.linalg.lstsq(feet[:, :6].T, force[:6], rcond=None)[0]
        return np.array(force[base:][limited] / effort[limited])

    flow.on = True
    ratios = []
    # Stop after 500 ticks, because later talos brakes before a joint limit with a larger share of its torques.
    for k in range(500):
        flow.advance(DT, flow.q)
        if k % UPDATE_TICKS == UPDATE_TICKS - 1:
            static, whole = torques(none), torques(flow.acceleration)
            taken = whole - static
            ratios.append(float((taken / (np.sign(taken) - static)).max()))
    assert 0.9 * flow.options.haste < max(ratios) < 1.1 * flow.options.haste


def test_the_zero_moment_point_stays_within_the_feet(monkeypatch: pytest.MonkeyPatch) -> None:
    """The contact force from the recursive Newton-Euler algorithm acts inside the support polygon."""
    r = robot("talos")
    data, none = r.model.createData(), np.zeros(r.nv)

    def least_room() -> float:
        """Return the smallest distance from the zero moment point to an edge of the support polygon, m."""
        flow = flow_of(r, well(r, goal_of(r, "feet", 2.0)), acceleration=10.0)
        ground = flow._state.at(flow._contacts[0].point).position[2]
        flow.on, least = True, np.inf
        for _ in range(400):
            flow.advance(DT, flow.q)
            wrench = pin.Force(pin.rnea(r.model, data, flow.q, none, flow.acceleration)[:6])
            base = pin.SE3(pin.Quaternion(flow.q[3:7]).matrix(), flow.q[:3] - [0, 0, ground])
            force, moment = (lambda w: (w.linear, w.angular))(base.act(wrench))
            point = np.array([-moment[1], moment[0]]) / force[2]
            least = min(least, float((-flow._offsets - flow._edges @ point).min()))
        return least

    assert least_room() > -1e-3
    monkeypatch.setattr(ZeroMomentPoint, "keep", lambda self, space, period, step: step)
    assert least_room() < -0.05


def test_feet_that_share_the_weight_with_a_fixed_base_are_refused() -> None:
    r = robot("panda")
    formulation = TaskFormulation(posture=JointPosture(r), contacts=(SupportContact(Point("panda_link4")),))
    flow = ReferenceFlow(r, well(r, r.posture()), formulation, Actuators(r), FlowOptions())
    with pytest.raises(InputError, match="panda: its base is fixed"):
        flow.reset(r.posture())


def test_the_rest_is_an_optimum_under_the_constraints() -> None:
    """SciPy's SLSQP cannot improve the posture at rest."""
    r = robot("panda")
    function = well(r, goal_of(r, "optimum", 1.0))
    flow = flow_of(r, function, rho=0.0, epsilon=1e-9)
    run = course(flow, r.posture(), 12.0)
    frame, data = r.frame_id("panda_hand_tcp"), r.model.createData()
    pin.framesForwardKinematics(r.model, data, r.posture())
    home = data.oMf[frame].copy()

    def pose(q: Vector) -> Vector:
        pin.framesForwardKinematics(r.model, data, q)
        return np.array(pin.log6(home.actInv(data.oMf[frame])).vector)

    room = np.minimum(0.1, (r.model.upperPositionLimit - r.model.lowerPositionLimit) / 8)
    bounds = list(zip(r.model.lowerPositionLimit + room, r.model.upperPositionLimit - room, strict=True))
    bounds[7:] = [(x, x) for x in r.posture()[7:]]
    best = scipy.optimize.minimize(
        function, run.q, jac=True, method="SLSQP", bounds=bounds, constraints={"type": "eq", "fun": pose},
        options={"ftol": 1e-14, "maxiter": 200},
    )  # fmt: skip
    assert best.success and run.values[-1] * function(r.posture())[0] == pytest.approx(best.fun, rel=1e-3)


def test_the_law_does_not_depend_on_the_basis_of_the_redundancy(monkeypatch: pytest.MonkeyPatch) -> None:
    r, decompose = robot("talos"), Redundancy.of
    function, ends = well(r, goal_of(r, "basis", 0.6)), []
    for turned in (False, True):

        def of(J: Vector, turned: bool = turned) -> Redundancy:
            space = decompose(J)
            Q = np.linalg.qr(rng("basis").normal(size=(space.basis.shape[1],) * 2))[0]
            return replace(space, basis=space.basis @ Q) if turned else space

        monkeypatch.setattr(Redundancy, "of", of)
        ends.append(course(flow_of(r, function), r.posture(), 0.5).q)
    assert np.abs(ends[0] - r.posture()).max() > 0.05
    np.testing.assert_allclose(ends[1], ends[0], rtol=0, atol=1e-9)


def test_a_tick_evaluates_at_most_one_gradient() -> None:
    r, calls = robot("solo8"), [0]
    inner = well(r, goal_of(r, "calls", 0.5))

    def function(q: Vector) -> tuple[float, Vector]:
        calls[0] += 1
        return inner(q)

    flow = flow_of(r, function)
    flow.on = True
    counts = []
    for _ in range(4 * UPDATE_TICKS):
        calls[0] = 0
        flow.advance(DT, flow.q)
        counts.append(calls[0])
    assert max(counts) == 1 and sum(counts) == 4 * 2


def flying(function: Well) -> tuple[Controller, ReferenceFlowPosture, Vector, Vector]:
    r = robot("tilthex_arm")
    posture = ReferenceFlowPosture(r, function)
    controller = Controller(r, formulation_for(r, posture))
    q, v = r.posture(), np.zeros(r.nv)
    controller.reset(q, v)
    return controller, posture, q, v


@functools.cache
def arm_well() -> Well:
    return well(robot("tilthex_arm"), goal_of(robot("tilthex_arm"), "arm", 1.0))


def test_it_rests_before_an_impact_at_a_known_time() -> None:
    t_impact = 1.6
    controller, posture, q, v = flying(arm_well())
    posture.brace(t_impact)
    moved, start = 0.0, q.copy()
    for k in range(round((t_impact + 0.5) / DT)):
        command = controller.tick(k * DT, q, v)
        assert command.status is Status.SOLVED
        if k * DT > t_impact - posture.settle + 0.01:
            # The remaining velocity only corrects contact and task errors.
            assert not np.abs(posture.flow.velocity).max() > 1e-3
        if k * DT >= t_impact:
            assert np.abs(v).max() < 5e-3
        q, v = integrate(robot("tilthex_arm"), q, v, command)
        moved = float(np.abs(posture.target[7:] - start[7:]).max())
    assert moved > 0.005
    # The flow rests until the next call of `brace`.
    posture.brace()
    for k in range(400):
        controller.tick(t_impact + 0.5 + k * DT, q, v)
    assert np.abs(posture.target[7:] - start[7:]).max() > moved + 0.05


def test_it_moves_for_its_duration_after_each_start() -> None:
    r = robot("tilthex_arm")
    flow = flow_of(r, arm_well(), duration=0.5)
    flow.on, moved = True, list[float]()
    for late in (0, UPDATE_TICKS):
        # After the second call of `brace`, the flow rests until the next update of the gradient.
        for _ in range(round(0.5 / DT) + late):
            flow.advance(DT, flow.q)
        assert not np.abs(flow.velocity).max() > 1e-4
        moved.append(float(np.abs(flow.q[7:] - r.posture()[7:]).max()))
        stopped = flow.q.copy()
        for _ in range(200):
            flow.advance(DT, flow.q)
        assert flow.resting and flow.direction.gain > 10 * flow.options.epsilon
        np.testing.assert_allclose(flow.q, stopped, atol=1e-4)
        flow.rest_at(np.inf)
    assert moved[1] > 1.2 * moved[0] > 0.01


def test_contact_and_release_stop_it_and_a_reset_forgets_all() -> None:
    controller, posture, q, v = flying(arm_well())

    def torques(count: int) -> list[Vector]:
        return [controller.tick(k * DT, q, v).u for k in range(count)]

    still = torques(20)
    posture.brace()
    assert posture.level == 1
    torques(300)
    for stop in (posture.contact, posture.release):
        stop()
        assert posture.level == 0
        torques(1000)
        assert not posture.flow.velocity.any() and not posture.flow.acceleration.any()
        target = posture.target.copy()
        torques(20)
        np.testing.assert_array_equal(posture.target, target)
    controller.reset(q, v)
    np.testing.assert_array_equal(torques(20), still)


@pytest.mark.parametrize("name", ["solo8", "talos"])
def test_a_reset_gives_led_tasks_their_present_output(name: str) -> None:
    r = robot(name)
    posture = ReferenceFlowPosture(r, well(r, goal_of(r, "reset", 0.6)))
    formulation = formulation_for(r, posture)
    controller = Controller(r, formulation)
    q, v = r.posture(), np.zeros(r.nv)
    first = controller.reset(q, v)
    posture.brace()
    for k in range(300):
        q, v = integrate(r, q, v, controller.tick(k * DT, q, v))
    assert all(np.abs(task.target_velocity).max() > 1e-3 for task in posture.flow.led)
    np.testing.assert_allclose(controller.reset(r.posture(), np.zeros(r.nv)).u, first.u, rtol=0, atol=1e-9)


def test_the_return_to_tasks_keeps_speed_and_acceleration() -> None:
    """The target of the end effector moves away before the flow begins."""
    r = robot("panda")
    flow = flow_of(r, well(r, goal_of(r, "back", 0.3)))
    task = flow._tasks[0]
    task.target = pin.SE3(task.target.rotation, task.target.translation + np.array([0.0, 0.0, -0.2]))  # type: ignore[attr-defined]
    flow.on, before = True, flow.velocity.copy()
    for _ in range(round(3.0 / DT)):
        flow.advance(DT, flow.q)
        # The flow and its correction have the same limits, so their sum can exceed these limits.
        assert np.abs(flow.velocity).max() < 1.5 * flow.options.speed
        assert np.abs(flow.velocity - before).max() < 2.1 * flow.options.acceleration * DT
        before = flow.velocity.copy()
    assert np.abs(flow.error).max() < 1e-4


def test_a_flow_goes_on_from_a_moved_posture() -> None:
    r = robot("panda")
    posture = ReferenceFlowPosture(r, well(r, goal_of(r, "moved", 0.3)))
    controller = Controller(r, TaskFormulation(posture=posture))
    q, v, last, steps = r.posture(), np.zeros(r.nv), np.zeros(r.nv), []
    other = np.array(q)
    other[0] += 0.6
    controller.reset(q, v)
    posture.move_to(other)
    for k in range(4000):
        if k in (200, 3000):
            # The first call of `brace` is in the middle of the fade, the second call at the end of the fade.
            posture.brace()
        if k == 400:
            posture.contact()
        if k == 1000:
            posture.move_to(other)
        command = controller.tick(k * DT, q, v)
        steps.append(float(np.abs(command.acceleration - last).max()))
        last = command.acceleration
        if k == 2999:
            np.testing.assert_allclose(q, other, atol=0.02)
        q, v = integrate(r, q, v, command)
    # The flow begins a few ticks after the phase begins.
    assert max(steps[200], steps[3000]) < 0.1


def test_a_reset_forgets_a_reference_that_was_led() -> None:
    r = robot("panda")
    posture = JointPosture(r)
    controller = Controller(r, TaskFormulation(posture=posture))
    q, v = r.posture(), np.zeros(r.nv)
    first = controller.reset(q, v)
    posture.lead(q, 0.5 + v, 2.0 + v)
    assert np.abs(controller.tick(0.0, q, v).acceleration).max() > 1.0
    np.testing.assert_allclose(controller.reset(q, v).acceleration, first.acceleration, rtol=0, atol=1e-9)
    posture.lead(q, 0.5 + v, 2.0 + v)
    posture.move_to(q)
    np.testing.assert_allclose(controller.tick(0.0, q, v).acceleration, first.acceleration, rtol=0, atol=1e-9)


def test_a_gradient_that_fails_stops_the_flow_until_it_is_back() -> None:
    fails = [False]

    def function(q: Vector) -> tuple[float, Vector]:
        if fails[0]:
            raise MetricError("is undefined at this posture", where="H", hint="start elsewhere")
        return arm_well()(q)

    controller, posture, q, v = flying(function)
    posture.brace()
    for k in range(900):
        fails[0] = 300 <= k < 800
        assert controller.tick(k * DT, q, v).status is Status.SOLVED
        if k == 750:
            # The flow brakes evenly.
            assert posture.flow.failed and not np.abs(posture.flow.velocity).max() > 1e-4
    assert not posture.flow.failed and np.abs(posture.flow.velocity).max() > 0.01


@pytest.mark.parametrize("options", [{"speed": 0.0}, {"share": 1.2}, {"tilt": float("nan")}], ids=str)
def test_options_out_of_range_are_refused(options: dict[str, float]) -> None:
    with pytest.raises(InputError):
        FlowOptions(**options)


def test_a_brace_needs_a_finite_time_and_a_reset() -> None:
    with pytest.raises(InputError, match="not finite"):
        flying(arm_well())[1].brace(float("nan"))
    with pytest.raises(InputError, match="reset the controller first"):
        ReferenceFlowPosture(robot("tilthex_arm"), arm_well()).brace()


@pytest.mark.parametrize(("value", "slope"), [(0.0, 0.0), (1.0, np.nan)])
def test_a_flow_does_not_start_without_an_objective(value: float, slope: float) -> None:
    with pytest.raises(MetricError, match="start at another posture"):
        flying(lambda q: (value, np.full(robot("tilthex_arm").nv, slope)))
