"""Strikes of arms in one piece: no instant of rest between start and contact, within all limits."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from impact_posture.path import posture_path as module
from impact_posture.path.path_reference import PathReference
from impact_posture.path.path_timing import RATE
from impact_posture.path.posture_path import PosturePath, posture_path
from impact_posture.path.stroke import SHARE
from impact_posture.path.time_law import RAMP, stepped
from impact_posture.tsid.limits.acceleration_bounds import LimitLaw
from tests.path.test_strike import SPEED, contact_of, slider, struck
from tests.support.struck_paths import reference_of


def moments(path: PosturePath) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    return [path.at(t) for t in np.linspace(0.0, path.duration, 8 * len(path.t))]


@pytest.mark.parametrize("name", ["ur5", "panda"])
def test_an_arm_is_not_at_rest_between_start_and_contact(name: str) -> None:
    solution, path = struck(name)
    strike, n = path.strike, np.array(solution.problem.objective.contacts[0].normal)
    assert strike is not None and path.timing == "time-optimal" and strike.rest_s == 0 < strike.run_up_s
    fastest = solution.problem.robot.velocity_limits
    assert min((np.abs(v) / fastest).max() for _, v, _ in moments(path)[8:]) > 0.01
    assert (np.abs(path.v[1:]) / fastest).max(axis=1).min() > 0
    twist = contact_of(solution.problem, path.q[-1])[1] @ path.v[-1]
    assert np.abs(twist[:3] + SPEED * n).max() < 1e-9


@pytest.mark.parametrize("name", ["ur5", "panda"])
def test_a_strike_in_one_piece_keeps_the_limits_of_the_robot_and_of_its_controller(name: str) -> None:
    """The oracles are finite differences and RNEA.  Between the grid of TOPP-RA, a limit is exceeded by up to 1 %."""
    solution, path = struck(name)
    robot, h = solution.problem.robot, 1e-5
    model, fastest = robot.model.copy(), robot.velocity_limits
    model.armature = np.where(np.isfinite(robot.armature), robot.armature, 0.0)
    data, effort = model.createData(), np.where(model.effortLimit > 0, model.effortLimit, np.inf)
    for t in np.linspace(h, path.duration - h, 6 * len(path.t)):
        q, v, a = path.at(t)
        (before, slow, _), (after, fast, _) = path.at(t - h), path.at(t + h)
        np.testing.assert_allclose(v, pin.difference(model, before, after) / (2 * h), atol=1e-3)
        np.testing.assert_allclose(a, (fast - slow) / (2 * h), atol=0.05 * np.abs(path.a).max())
        assert (np.abs(v) <= 1.01 * fastest).all()
        assert (np.abs(pin.rnea(model, data, q, v, a)) <= 1.02 * SHARE * effort).all()
        assert ((np.abs(v) + np.abs(a) / RATE) / fastest).max() <= 1.02
    assert LimitLaw().rate == RATE


@pytest.mark.parametrize("name", ["ur5", "panda"])
def test_a_strike_in_one_piece_is_shorter_than_with_a_rest(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    solution, path = struck(name)
    monkeypatch.setattr(module, "_in_one_piece", lambda *_: None)
    rested = posture_path(solution, strike=SPEED)
    assert rested.strike is not None and rested.strike.rest_s == rested.strike.run_up_s > 0
    assert path.duration < 0.98 * rested.duration


def test_a_run_up_that_reverses_the_way_begins_at_rest(tmp_path: Path) -> None:
    strike = posture_path(slider(tmp_path, 4000.0, 9.0), strike=1.0).strike
    assert strike is not None and strike.rest_s == strike.run_up_s > 0


def test_a_time_law_that_does_not_end_at_rest_ends_with_its_last_speed() -> None:
    s, rates = np.array([0.0, 0.3, 0.9, 1.0]), np.array([0.0, 4.0, 2.0, 2.0])
    law = stepped(s, rates)
    end, speed, rise = (float(x[0]) for x in law.at(np.array([law.duration])))
    assert (end, speed, rise) == pytest.approx((1.0, 2.0, 0.0), abs=1e-9)
    exact = 2 * 0.3 / 4 + 2 * 0.6 / 6 + 0.1 / 2
    assert law.duration == pytest.approx(exact + RAMP / 2, abs=1e-9) and law.when(1.0) == pytest.approx(law.duration)


def test_a_repeated_run_up_follows_the_path_from_rest() -> None:
    reference, h = PathReference(reference_of("panda", rest=0.0).path), 1e-6
    path, still = reference.path, np.zeros(reference.path.model.nv)
    reference.start(0.0)
    for t in np.arange(0.0, 0.5, 1e-3):
        reference.tick(t, path.q[-1], still, 60.0 if t > 0.39 else None)
    reference.back(0.2)
    reference.expect(1.0)
    beginning, again = path.at(reference.again)[0], PathReference.tick
    np.testing.assert_allclose(again(reference, 0.85, beginning, still)[0], beginning, atol=1e-12)
    for t in (0.92, 0.95, 0.98):
        (early, slow, _), (_, v, a), (late, fast, _) = (
            again(reference, x, beginning, still) for x in (t - h, t, t + h)
        )
        np.testing.assert_allclose(v, pin.difference(path.model, early, late) / (2 * h), atol=1e-6)
        np.testing.assert_allclose(a, (fast - slow) / (2 * h), atol=1e-3)
    np.testing.assert_allclose(again(reference, 1.0, beginning, still)[1], path.v[-1], atol=1e-9)
