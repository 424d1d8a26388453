"""The complete controller of an aerial manipulator: dynamics, limits, hierarchy, relaxation, invalid input."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from impact_posture.errors import InputError, PostureError
from impact_posture.robot.robot import Robot
from impact_posture.robot.robot_spec import RotorSpec
from impact_posture.tsid import relaxation
from impact_posture.tsid.controller import Command, Controller, Status
from impact_posture.tsid.joint_ranges import JointRanges
from impact_posture.tsid.limits.acceleration_bounds import AccelerationBounds, LimitLaw
from impact_posture.tsid.point_kinematics import Point
from impact_posture.tsid.relaxation import solve
from impact_posture.tsid.state import State
from impact_posture.tsid.support_contact import SupportContact
from impact_posture.tsid.task_formulation import TaskFormulation, aerial_formulation
from impact_posture.tsid.tasks.body_tasks import Tilt
from impact_posture.tsid.tasks.frame_tasks import FramePose, FramePosition, Impedance
from impact_posture.tsid.tasks.joint_posture import JointPosture
from tests.support.helpers import rng, robot

DT = 1e-3
ARM = "tilthex_arm"


def integrate(r: Robot, q: np.ndarray, v: np.ndarray, command: Command) -> tuple[np.ndarray, np.ndarray]:
    """Integrate the planned acceleration, which assumes perfect dynamics."""
    v = v + DT * command.acceleration
    return np.array(pin.integrate(r.model, q, DT * v)), v


def run(
    controller: Controller, q: np.ndarray, v: np.ndarray, ticks: int
) -> Iterator[tuple[int, Command, np.ndarray, np.ndarray]]:
    for k in range(ticks):
        command = controller.tick(k * DT, q, v)
        yield k, command, q, v
        q, v = integrate(controller.robot, q, v, command)


def far_posture(r: Robot) -> np.ndarray:
    q = r.posture()
    q[7:] += (0.8, -0.7, 0.9)
    return q


def assert_dynamics(controller: Controller, command: Command, force: np.ndarray | None = None) -> None:
    """Compare the command with the recursive Newton-Euler algorithm of Pinocchio for the same forces."""
    state, r = controller.state, controller.robot
    load = pin.rnea(r.model, r.model.createData(), state.q, state.v, command.acceleration)
    applied = controller.actuators.G @ command.u
    for contact, rows in zip(controller.formulation.contacts, controller.assembly.contacts.rows, strict=True):
        applied = applied + state.at(contact.point).jacobian[: contact.size].T @ command.forces[rows]
    if force is not None:
        assert controller.formulation.force_point is not None
        applied = applied + state.at(controller.formulation.force_point).jacobian[: force.size].T @ force
    assert np.abs(load - applied).max() <= 1e-8


def assert_limits(controller: Controller, command: Command) -> None:
    actuators = controller.actuators
    assert (command.u >= actuators.lower - 1e-7).all() and (command.u <= actuators.upper + 1e-7).all()


def test_a_conflicting_posture_moves_neither_tilt_nor_end_effector() -> None:
    r = robot(ARM)
    posture = JointPosture(r, far_posture(r), kp=6.0)
    controller = Controller(r, aerial_formulation(r, posture))
    q, v = r.posture(), np.zeros(r.nv)
    controller.reset(q, v)
    start = State(r, controller.formulation.points).update(q, v)
    pose = start.at(controller.formulation.points[0]).position.copy()
    moved = 0.0
    for _, command, now, _ in run(controller, q, v, 600):
        report = controller.report()
        assert command.status is Status.SOLVED and not report.active
        assert np.abs(report.residuals["tilt"]).max() <= 1e-8
        assert np.abs(report.residuals["ee pose"]).max() <= 1e-8
        here = controller.state.at(controller.formulation.points[0]).position
        # Integration in steps of a millisecond has a second-order error, which the feedback of the task corrects.
        assert np.linalg.norm(here - pose) < 1e-4
        moved = float(np.abs(now[7:] - r.posture()[7:]).max())
    assert moved > 0.1


def pushed(r: Robot, meters: float) -> Controller:
    """Return a controller whose end effector target is far to the side, so that a level base lacks the thrust."""
    ee = FramePose(Point("ee"), kp=60.0)
    controller = Controller(r, aerial_formulation(r, JointPosture(r), end_effector=ee))
    controller.reset(r.posture(), np.zeros(r.nv))
    assert ee.target is not None
    ee.target = pin.SE3(ee.target.rotation, ee.target.translation + np.array([0, meters, 0]))
    return controller


def test_limits_relax_the_lower_level_first_and_say_how_far() -> None:
    r = robot(ARM)
    controller = pushed(r, 1.5)
    command = controller.tick(0.0, r.posture(), np.zeros(r.nv))
    report = controller.report()
    assert command.status is Status.RELAXED
    assert [x.level for x in report.relaxed] == ["ee pose"]
    assert np.abs(report.residuals["tilt"]).max() <= 1e-8
    assert report.relaxed[0].amount == pytest.approx(np.linalg.norm(report.residuals["ee pose"]), rel=1e-6)
    assert report.active
    assert_limits(controller, command)
    assert_dynamics(controller, command)


def test_a_saturated_flight_never_fails() -> None:
    r = robot(ARM)
    controller = pushed(r, 3.0)
    seen = set()
    for _, command, q, _ in run(controller, r.posture(), np.zeros(r.nv), 500):
        seen.add(command.status)
        assert_limits(controller, command)
        assert np.isfinite(command.u).all() and controller.report().dynamics <= 1e-8
        assert abs(2 * np.arccos(min(1.0, abs(float(q[6]))))) < 1.0
    assert seen <= {Status.SOLVED, Status.RELAXED} and Status.RELAXED in seen


def test_measured_force_enters_the_dynamics() -> None:
    r = robot(ARM)
    ee = FramePose(Point("ee"), kp=60.0, impedance=Impedance(3.0, 1.0))
    controller = Controller(r, aerial_formulation(r, JointPosture(r), end_effector=ee))
    q, v = r.posture(), np.zeros(r.nv)
    controller.reset(q, v)
    force = np.array([0.5, 0.2, 3.0])
    command = controller.tick(0.0, q, v, force)
    assert_dynamics(controller, command, force)
    there = controller.state.at(ee.point)
    assert np.allclose(there.jacobian[:3] @ command.acceleration, force / 3.0, atol=1e-8)
    # A tick without a measured force does not use an earlier force.
    assert_dynamics(controller, controller.tick(1e-3, q, v))


class Refusing:
    """Solver that always fails."""

    infeasible = False

    def reset(self) -> None:
        pass

    def solve(self, qp: object) -> None:
        return None


def _without_cost(solve: Callable[..., Any]) -> Callable[..., Any]:
    """Return a solver that solves only programs of the levels, which have no cost."""
    return lambda H, *rest, **settings: (None, 0.0, -1, {}) if H is not None else solve(H, *rest, **settings)


def test_a_solver_that_gives_up_holds_the_last_command(monkeypatch: pytest.MonkeyPatch) -> None:
    r = robot(ARM)
    controller = Controller(r, aerial_formulation(r, JointPosture(r)))
    controller.reset(r.posture(), np.zeros(r.nv))
    before = controller.tick(0.0, r.posture(), np.zeros(r.nv))
    working = controller._solver
    # If the solver of the ticks fails, the relaxation solves the tick ...
    controller._solver = Refusing()
    monkeypatch.setattr(relaxation, "DaqpSolver", lambda n, m, **options: Refusing())
    command = controller.tick(0.001, r.posture(), np.zeros(r.nv))
    assert command.status is Status.SOLVED and np.allclose(command.u, before.u, rtol=0, atol=1e-6)
    # ... if the program with the cost fails, the solution of the levels without the cost is used ...
    monkeypatch.setattr(relaxation.daqp, "solve", _without_cost(relaxation.daqp.solve))
    bare = controller.tick(0.001, r.posture(), 0.05 * rng("bare").normal(size=r.nv))
    assert bare.status is Status.SOLVED
    assert np.abs(controller.report().residuals["tilt"]).max() <= 1e-5
    assert np.abs(controller.report().residuals["ee pose"]).max() <= 1e-4
    assert_limits(controller, bare)
    # ... and if the levels have no solution either, the last command is repeated.
    monkeypatch.setattr(relaxation, "lexicographic", lambda levels, units: None)
    held = controller.tick(0.001, r.posture(), np.zeros(r.nv))
    assert held.status is Status.UNSOLVED
    assert np.allclose(held.u, bare.u, rtol=0, atol=1e-8)
    monkeypatch.undo()
    controller._solver = working
    assert solve(controller.assembly, working).solved is not None


@pytest.mark.parametrize("margin", [0.0, 0.1])
def test_joints_stop_at_their_limits(margin: float) -> None:
    r = robot(ARM)
    target, end = r.posture(), np.asarray(r.model.upperPositionLimit)[7:] - margin
    target[7:] = end + 2.0
    formulation = TaskFormulation(
        (), (Tilt(weight=10.0),), JointPosture(r, target, kp=60.0), law=LimitLaw(margin=margin)
    )
    controller = Controller(r, formulation)
    controller.reset(r.posture(), np.zeros(r.nv))
    touched = np.zeros(3, dtype=bool)
    for _, command, q, _ in run(controller, r.posture(), np.zeros(r.nv), 1500):
        assert (q[7:] <= end + 1e-6).all()
        touched |= q[7:] > end - 0.02
        assert command.status is Status.SOLVED
    assert touched.all()


def test_acceleration_bounds_never_cross() -> None:
    """The states are within the limits or far outside, and slow or too fast."""
    for name in ("tilthex_arm", "talos", "panda"):
        r = robot(name)
        for law in (LimitLaw(), LimitLaw(acceleration=30.0, margin=0.1)):
            bounds, state, generator = AccelerationBounds(r, law), State(r), rng(name, law)
            for _ in range(200):
                q = pin.integrate(r.model, r.posture(), generator.normal(size=r.nv) * generator.choice([0.1, 1, 10]))
                bounds.update(state.update(q, generator.normal(size=r.nv) * generator.choice([0.1, 1, 100])))
                assert (bounds.lower <= bounds.upper).all()
                assert not np.isnan(bounds.lower).any() and not np.isnan(bounds.upper).any()


def test_joint_ranges_equal_the_limits_of_the_model() -> None:
    r = robot("talos")
    ranges = JointRanges(r)
    for name in r.joint_names:
        joint = r.model.getJointId(name)
        iv, iq = r.model.idx_vs[joint], r.model.idx_qs[joint]
        assert ranges.upper[iv] == r.model.upperPositionLimit[iq]
        assert ranges.index[iv] == iq
    assert np.isinf(ranges.upper[:6]).all()


def more_rotors(r: Robot) -> Robot:
    """Return the same hexarotor with two additional rotors."""
    assert r.spec.propulsion is not None
    rotors = r.spec.propulsion.rotors
    return with_rotors(r, (*rotors, *(replace(rotors[k], name=f"extra_{k}") for k in (0, 3))))


def with_rotors(r: Robot, rotors: tuple[RotorSpec, ...]) -> Robot:
    assert r.spec.propulsion is not None
    propulsion = replace(r.spec.propulsion, rotors=rotors)
    return replace(r, spec=replace(r.spec, propulsion=propulsion))


def assert_solved_flight(controller: Controller, v: np.ndarray) -> Command:
    q = controller.robot.posture()
    controller.reset(q, v)
    for _, command, _, _ in run(controller, q, v, 30):
        assert command.status is Status.SOLVED
        assert_dynamics(controller, command)
        assert_limits(controller, command)
    return command


def test_more_rotors_than_needed() -> None:
    r = more_rotors(robot(ARM))
    controller = Controller(r, aerial_formulation(r, JointPosture(r, far_posture(r))))
    assert controller.actuators.rank == 6 and controller.actuators.spare.shape == (8, 2)
    command = assert_solved_flight(controller, np.zeros(r.nv))
    assert np.allclose(command.rotor_speed**2 * r.spec.propulsion.thrust_coefficient, command.u[:8])  # type: ignore[union-attr]
    assert np.array_equal(command.torque, command.u[8:])


def test_rotors_that_cannot_push_sideways() -> None:
    """A hexarotor with parallel propellers has rank 4, so two rows of the dynamics constrain the accelerations."""
    r = robot(ARM)
    assert r.spec.propulsion is not None
    up = (replace(rotor, direction=(0.0, 0.0, 1.0)) for rotor in r.spec.propulsion.rotors)
    r, point = with_rotors(r, tuple(up)), Point("ee")
    controller = Controller(
        r, TaskFormulation((), (FramePosition(point, kp=20.0),), JointPosture(r), force_point=point)
    )
    assert controller.actuators.rank == 4 and controller.actuators.blind.shape == (6, 2)
    assert_solved_flight(controller, 0.1 * rng("borinot").normal(size=r.nv))


@pytest.mark.parametrize("wrong", ["program", "names", "period", "early", "report", "velocity", "shape", "size"])
def test_mistakes_are_refused(wrong: str) -> None:
    r = robot(ARM)
    with pytest.raises((InputError, PostureError)):
        if wrong == "program":
            TaskFormulation()
        elif wrong == "names":
            TaskFormulation((), (Tilt(), Tilt()))
        controller = Controller(r, aerial_formulation(r, JointPosture(r)), period=0.0 if wrong == "period" else DT)
        if wrong == "early":
            controller.tick(0.0, r.posture(), np.zeros(r.nv))
        if wrong == "report":
            controller.report()
        # At this extreme velocity, the computed torques are not finite.
        controller.reset(r.posture(), np.full(r.nv, 1e200 if wrong == "size" else 0.0))
        controller.reset(r.posture(), np.full(r.nv, np.nan if wrong == "velocity" else 0.0))
        controller.reset(r.posture(), np.zeros(3 if wrong == "shape" else r.nv))


@pytest.mark.parametrize(
    "arguments", [{"kind": "sole"}, {"least": -1.0}, {"least": np.nan}, {"kp": np.nan}, {"kd": np.inf}], ids=str
)
def test_invalid_supports_are_refused(arguments: dict[str, object]) -> None:
    with pytest.raises(InputError):
        SupportContact(Point("ee"), **arguments)  # type: ignore[arg-type]
