"""Stops after an impact: the velocity where they begin, their limits, and what prevents them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from impact_posture.dynamics.numeric import Numeric
from impact_posture.impact.evaluation.coulomb_jump import coulomb_jump
from impact_posture.path.actuator_limits import ActuatorLimits
from impact_posture.path.follow_through import _stop, _to_edges, after_impact, follow_through
from impact_posture.path.strike import StrikeSpaces
from impact_posture.path.stroke import SHARE
from impact_posture.posture.formulation.problem_file import prepare
from impact_posture_cli.optimize_summary import _path
from impact_posture_cli.output import Page
from tests.path.test_strike import SPEED, contact_of, slider, struck
from tests.support.settings import make_settings


@pytest.mark.parametrize("name", ["panda", "solo8"])
def test_the_stop_after_the_impact_starts_at_the_predicted_velocity(name: str) -> None:
    """The oracles are the predicted jump of evaluate, RNEA, and the frames of Pinocchio."""
    solution, path = struck(name)
    problem, strike = solution.problem, path.strike
    assert strike is not None and strike.follow_through is not None
    after, model = strike.follow_through, problem.robot.model
    jump = coulomb_jump(problem.impact, path.q[-1], SPEED)
    assert jump is not None and after.stopped == after.impacts == 7 and not after.hindrance
    np.testing.assert_allclose(after.velocity, path.v[-1] + jump.velocity, atol=1e-9)
    rows = after.rows
    assert rows is not None
    free = ~np.isin(problem.robot.tangent_names, problem.requirements.hold)
    np.testing.assert_allclose(rows.v[0][free], after.velocity[free], atol=1e-5)
    assert np.abs(rows.v[-1]).max() < 1e-12 and np.array_equal(rows.q[0], path.q[-1])
    n, h, data = np.array(problem.objective.contacts[0].normal), 1e-5, model.createData()
    home = contact_of(problem, path.q[-1])[0].translation
    for t in np.linspace(h, rows.t[-1] - h, 30):
        q, v, a = rows.at(t)
        (before, slow, _), (behind, fast, _) = rows.at(t - h), rows.at(t + h)
        assert np.abs(pin.difference(model, before, behind) / (2 * h) - v).max() < 1e-4
        assert np.abs((fast - slow) / (2 * h) - a).max() < 1e-2 * max(1.0, np.abs(rows.a).max())
        assert n @ (contact_of(problem, q)[0].translation - home) > -1e-6
        if not problem.robot.floating:
            assert (np.abs(pin.rnea(model, data, q, v, a)) <= model.effortLimit).all()
        for constraint in problem.constraints[: len(problem.objective.supports)]:
            assert np.abs(constraint.value(Numeric(model).at(q))).max() < 1e-5


def test_a_held_gripper_does_not_change_the_velocity_of_the_arm() -> None:
    problem = prepare(make_settings({"robot": "z1", "normal": (0, 0, 1), "contact_pose": "aligned"})).problem
    q, spaces = problem.given, StrikeSpaces(problem, problem.given)
    away = np.linalg.pinv(contact_of(problem, q)[1][:3]) @ [0.0, 0.0, 0.2]
    held = np.isin(problem.robot.tangent_names, problem.requirements.hold)
    limits = ActuatorLimits(problem.objective, q, problem.requirements)
    stop = _stop("", spaces, q, np.where(held, 5.0, away), limits, falls=False, sample=False)
    assert not isinstance(stop, str) and held.any()
    np.testing.assert_allclose(stop.moments[0][1], np.where(held, 0.0, away), atol=1e-6)


@pytest.mark.parametrize(("effort", "cone"), [(8.0, 0.0), (8.0, 10.0), (5.0, 0.0)])
def test_a_cart_stops_before_the_end_of_its_slide_or_says_why(tmp_path: Path, effort: float, cone: float) -> None:
    """The worst impact has 120 % of 1 m/s and restitution 0.5.  The stop takes T = 3/2 v m/F over v T/2."""
    problem = slider(tmp_path, effort, 9.0, cone).problem
    limits = ActuatorLimits(problem.objective, problem.given, problem.requirements)
    after = follow_through(problem, problem.given, np.array([1.0]), 0.25, limits)
    assert after.impacts == (31 if cone else 7) and after.velocity == pytest.approx([-0.25])
    duration = 1.5 * 0.6 * 2.0 / (SHARE * effort)
    if 0.3 * duration > 0.1:
        assert after.hindrance == (
            "no stop along the velocity exists, because of the torque of slide, and the motion cannot be longer "
            "because of joint limits, after restitution 0.5, 120% of the speed"
        )
        assert after.stopped == 6
        return
    assert not after.hindrance and after.longest_s == pytest.approx(duration, rel=0.02)
    assert after.joints is not None and after.joints.distance == pytest.approx(0.1 - 0.3 * duration, abs=2e-3)
    assert (after.joints.of, after.joints.impact[:32]) == ("joint slide", "restitution 0.5, 120% of the spe")
    assert after.clearance is None


def test_the_center_of_pressure_follows_from_the_momentum() -> None:
    """The oracle is the rate of the centroidal momentum, and the distances from lines through pairs of feet."""
    solution, path = struck("solo8")
    problem, after, model = solution.problem, path.strike and path.strike.follow_through, solution.problem.robot.model
    assert after and after.rows and after.center_of_pressure
    q, data, least = path.q[-1], model.createData(), np.inf
    pin.framesForwardKinematics(model, data, q)
    feet = np.array([data.oMf[model.getFrameId(foot.frame)].translation for foot in problem.objective.supports])
    height, around = feet[:, 2].mean(), feet[np.argsort(np.arctan2(*(feet - feet.mean(axis=0))[:, 1::-1].T)), :2]
    distance = _to_edges(problem, q, ActuatorLimits(problem.objective, q, problem.requirements))
    for t in np.linspace(0, after.rows.t[-1], 9):
        moment = after.rows.at(t)
        pin.computeCentroidalMomentumTimeVariation(model, data, *moment)
        force = np.array(data.dhg.linear) + data.mass[0] * 9.81 * np.array([0, 0, 1])
        arm = np.array(data.com[0]) - height * np.array([0, 0, 1])
        turn = np.array(data.dhg.angular) + np.cross(arm, force)
        center = np.array([-turn[1], turn[0]]) / force[2]
        sides = np.roll(around, -1, axis=0) - around
        inside = sides[:, 0] * (center - around)[:, 1] - sides[:, 1] * (center - around)[:, 0]
        assert distance(moment)[0] == pytest.approx((inside / np.linalg.norm(sides, axis=1)).min(), abs=1e-4)
        least = min(least, distance(moment)[0])
    assert 0 < after.center_of_pressure.distance <= least + 1e-3


def test_an_impact_on_a_tilted_surface_satisfies_the_laws_of_friction() -> None:
    solution, path = struck("panda")
    problem, q, v = solution.problem, path.q[-1], path.v[-1]
    n = np.array([np.sin(0.2), 0.0, np.cos(0.2)])
    tilted = StrikeSpaces(problem, q, normals=n[None])
    jump, plastic = (after_impact(problem, tilted, q, v, e) for e in (0.5, 0.0))
    assert jump is not None and plastic is not None
    np.testing.assert_allclose(jump - v, 1.5 * (plastic - v), atol=1e-12)
    J = contact_of(problem, q)[1][:3]
    M = pin.crba(problem.robot.model, problem.robot.model.createData(), q)
    M = np.triu(M) + np.triu(M, 1).T
    force, along = M @ (plastic - v), J @ plastic
    free = ~problem.robot.followers
    p = np.linalg.lstsq((J @ problem.robot.projector).T, problem.robot.projector.T @ force, rcond=None)[0]
    np.testing.assert_allclose((J @ problem.robot.projector).T @ p, problem.robot.projector.T @ force, atol=1e-8)
    assert free.any() and abs(n @ along) < 1e-8 and n @ p > 0
    side, slip = p - (n @ p) * n, along - (n @ along) * n
    friction = problem.objective.contacts[0].friction
    assert np.linalg.norm(side) <= friction * (n @ p) + 1e-7
    assert np.linalg.norm(slip) < 1e-6 or np.linalg.norm(side) == pytest.approx(friction * (n @ p))


def test_a_strike_without_any_stop_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    block = json.loads(json.dumps(struck("panda")[1].to_dict()))
    block["strike"]["follow_through"] |= {"stopped": 0, "longest_s": 0.0, "joints": None, "clearance": None}
    _path(Page(), block)
    text = " ".join(capsys.readouterr().out.split())
    assert f"a run-up of {1e3 * block['strike']['run_up_m']:.3g} mm that begins without a rest at 0.0" in text
    assert "no stop along the velocity exists after any of 7 considered impacts" in text and "then stops" not in text
