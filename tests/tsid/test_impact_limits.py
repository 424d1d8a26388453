"""Limits on the effects of an impact: the jump obeys a rigid impact model, and a controller obeys the limits."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given
from hypothesis import strategies as st

from impact_posture.tsid.controller import Controller, Status
from impact_posture.tsid.limits.impact_limits import ImpactLimits
from impact_posture.tsid.point_kinematics import Point
from impact_posture.tsid.state import State
from impact_posture.tsid.support_contact import SupportContact, support_contacts
from impact_posture.tsid.task_formulation import TaskFormulation
from impact_posture.tsid.tasks.frame_tasks import FramePosition
from impact_posture.tsid.tasks.joint_posture import JointPosture
from tests.support.helpers import Vector, rng, robot, unit
from tests.support.pinocchio_values import frame_jacobian, mass_matrix

ROBOTS = {"tilthex_arm": "ee", "panda": "panda_hand", "solo12": "base_link", "talos": "gripper_left_base_link"}


def limits_of(name: str, normal: Vector, **options: float) -> tuple[ImpactLimits, State, tuple[SupportContact, ...]]:
    """Return the limits of an impact at a frame, a state near the default posture, and the foot contacts."""
    r, generator = robot(name), rng(name, "impact limits")
    contacts, point = support_contacts(r), Point(ROBOTS[name])
    limits = ImpactLimits(r, point, normal, contacts)
    for key, value in {**options, "active": True}.items():
        setattr(limits, key, value)
    q = np.array(pin.integrate(r.model, r.posture(), 0.1 * generator.normal(size=r.nv)))
    return limits, State(r, limits.points).update(q, generator.normal(size=r.nv)), contacts


@pytest.mark.parametrize("name", ROBOTS)
def test_the_jump_is_the_least_change_of_energy(name: str) -> None:
    normal, e = unit(rng(name, "normal")), 0.3
    limits, state, contacts = limits_of(name, normal, restitution=e)
    model, q, v = robot(name).model, state.q, state.v
    M, J = mass_matrix(model, q), frame_jacobian(model, q, robot(name).frame_id(ROBOTS[name]))[:3]
    feet = [frame_jacobian(model, q, robot(name).frame_id(c.point.frame), c.point.offset)[: c.size] for c in contacts]
    # The couplings of joints allow the velocities v = C v.
    C = robot(name).coupling_matrix
    rows = np.vstack([J, *feet, (np.eye(model.nv) - C)[robot(name).followers]])
    wanted = np.zeros(rows.shape[0])
    wanted[:3] = -(1 + e) * normal * (normal @ J @ v)
    # Gauss: of all jumps that contacts and couplings allow, the impact causes the jump with the least kinetic energy.
    root = np.linalg.cholesky(M).T
    expected = np.linalg.solve(root, np.linalg.lstsq(rows @ np.linalg.inv(root), wanted, rcond=1e-7)[0])
    jump, impulse = limits.jump(state)
    np.testing.assert_allclose(jump @ v, expected, atol=1e-5 * np.abs(expected).max())
    # The impulses of the contact and of the feet cause exactly the computed jump.
    rest = C.T @ (M @ (jump @ v) - impulse @ v)
    if contacts:
        rest -= np.vstack(feet).T @ np.linalg.lstsq(np.vstack(feet).T, rest, rcond=1e-9)[0]
    assert np.abs(rest).max() < 1e-5 * np.abs(impulse @ v).max()


@given(seed=st.integers(0, 10_000), name=st.sampled_from(sorted(ROBOTS)))
def test_each_row_has_the_room_of_its_limit(seed: int, name: str) -> None:
    limits, state, _ = limits_of(name, np.array([0.0, 0.6, 0.8]), duration=4e-3)
    r = robot(name)
    first, acceleration = r.first_joint, 300 * rng(seed).normal(size=r.nv)
    A, lower, upper = limits.rows(state)
    before = state.v + 1e-3 * acceleration
    jump, impulse = (part @ before for part in limits.jump(state))
    rates, torques = (before + jump)[first:], impulse[first:] / 4e-3
    speed, effort = r.model.velocityLimit[first:], r.model.effortLimit[first:]
    allowed = np.concatenate([np.where(speed > 0, speed, np.inf), np.where(effort > 0, effort, np.inf)])
    room = allowed - np.abs(np.concatenate([rates, torques]))
    of_rows = np.minimum(A @ acceleration - lower, upper - A @ acceleration)
    np.testing.assert_allclose(of_rows, room, rtol=1e-9, atol=1e-6)


def test_a_controller_approaches_only_as_fast_as_the_limits_allow() -> None:
    r, point = robot("panda"), Point("panda_hand")
    speeds = {}
    for active in (False, True):
        limits = ImpactLimits(r, point, [0, 0, 1])
        limits.active = active
        task = FramePosition(point, kp=0.0, kd=50.0, weight=1.0)
        controller = Controller(r, TaskFormulation(((task,),), (), JointPosture(r, kp=10.0), row_limits=(limits,)))
        q, v = r.posture(), np.zeros(r.nv)
        controller.reset(q, v)
        task.target_velocity = np.array([0.0, 0.0, -1.0])
        for k in range(200):
            command = controller.tick(1e-3 * k, q, v)
            assert command.status in (Status.SOLVED, Status.RELAXED)
            v = v + 1e-3 * command.acceleration
            q = pin.integrate(r.model, q, 1e-3 * v)
        state = controller.state.update(q, v)
        speeds[active] = -float(state.at(point).jacobian[2] @ v)
        limits.active = True
        _, lower, upper = limits.rows(state)
        # Return the largest violation by an impact in the present state, relative to the limits.
        over = np.maximum(lower, -upper).max() / np.abs(upper).max()
        assert (over > 1e-3) if not active else (over < 1e-3), over
    assert speeds[False] == pytest.approx(1.0, abs=0.05)
    assert 0.05 < speeds[True] < 0.9


def test_without_an_impact_nothing_is_limited() -> None:
    limits, state, _ = limits_of("panda", np.array([0.0, 0.0, 1.0]))
    limits.active = False
    A, lower, upper = limits.rows(state)
    assert not A.any()
    assert np.isinf(lower).all()
    assert np.isinf(upper).all()
