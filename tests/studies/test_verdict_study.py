"""The simulation behind the study of verdicts: closed forms, balance of energy, and rows of the study."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

from docs.studies.cases import BACK, DOWN
from docs.studies.core import Request, Vector
from docs.studies.verdict import impact_simulation, page
from docs.studies.verdict.impact_simulation import ImpactSimulation, Point, SimulatedImpact, Surface
from docs.studies.verdict.study import Case, Compared, Numbers, Pair, Row, compare, feet_of
from impact_posture.impact.impact_contact import point_on
from impact_posture.robot.posture_files import read_posture
from tests.support.helpers import robot

MASS, HALF, HEIGHT = 2.0, 0.2, 0.3  # mass of a box, kg; half of its edge along x and y, m; half of its height, m
INERTIA = np.array([0.07, 0.09, 0.05])
AHEAD, SPEED, STIFF = np.array([1.0, 0.0, 0.0]), 0.8, 2e5
CORNERS = [np.array([x, y, -HEIGHT]) for x in (-HALF, HALF) for y in (-HALF, HALF)]


def box(gravity: float) -> pin.Model:
    model = pin.Model()
    joint = model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "root_joint")
    model.appendBodyToJoint(joint, pin.Inertia(MASS, np.zeros(3), np.diag(INERTIA)), pin.SE3.Identity())
    model.gravity.linear = np.array([0.0, 0.0, -gravity])
    return model


def hit_box(
    at: Vector,
    friction: float,
    *,
    gravity: float = 0.0,
    feet: bool = False,
    normal: Vector = AHEAD,
    speed: float = SPEED,
) -> SimulatedImpact:
    """Hit the box at a point, with feet at its lower corners or in free flight."""
    model = box(gravity)
    points = [Point(1, corner) for corner in CORNERS] if feet else []
    simulation = ImpactSimulation(model, pin.neutral(model), Point(1, at), points, still=True)
    assert simulation.stands
    return simulation.run(Surface(normal, speed, STIFF, friction))


def mobility(at: Vector) -> Vector:
    across = pin.skew(at)
    return np.eye(3) / MASS - across @ np.diag(1 / INERTIA) @ across


def test_a_point_mass() -> None:
    result = hit_box(np.zeros(3), 0.5, gravity=9.81)
    assert result.jump == pytest.approx([SPEED, 0, 0, 0, 0, 0], abs=1e-9)
    assert result.impulse == pytest.approx(MASS * SPEED * AHEAD, rel=1e-4)
    assert result.force == pytest.approx(SPEED * np.sqrt(STIFF * MASS), rel=1e-4)
    assert result.time == pytest.approx(np.pi / 2 * np.sqrt(MASS / STIFF), rel=1e-4)


@pytest.mark.parametrize("friction", [0.0, 0.2, 3.0])
def test_a_free_box_slides_or_sticks(friction: float) -> None:
    """Hit in its plane of symmetry, the box slides along one line; the impulse then follows from the mobility."""
    at = np.array([-HALF, 0.0, 0.25])
    B, up = mobility(at), np.array([0.0, 0.0, 1.0])
    direction = AHEAD - friction * np.sign((B @ AHEAD)[2]) * up
    expected = SPEED * direction / (AHEAD @ B @ direction)
    if friction == 3.0:
        expected = np.linalg.solve(B, SPEED * AHEAD)
        assert np.hypot(*expected[1:]) < friction * expected[0]
    result = hit_box(at, friction)
    assert result.impulse == pytest.approx(expected, rel=1e-4, abs=1e-4)
    assert (result.slip < 1e-5) == (friction == 3.0)
    assert result.force == pytest.approx(np.sqrt(STIFF * SPEED * expected[0]), rel=1e-4)


def test_sliding_turns_the_direction_of_friction() -> None:
    """If the box is hit outside of its planes of symmetry, the slip and the friction stay opposite to each other."""
    result = hit_box(np.array([-HALF, 0.11, 0.17]), 0.2)
    slip = (mobility(np.array([-HALF, 0.11, 0.17])) @ result.impulse)[1:]
    assert np.linalg.norm(slip) == pytest.approx(result.slip, rel=1e-3)
    assert result.impulse[1:] == pytest.approx(-0.2 * result.impulse[0] * slip / np.linalg.norm(slip), rel=1e-3)


def test_a_standing_box_tips_about_an_edge() -> None:
    """The box turns about the edge as soon as the moment of the force exceeds the moment of the weight."""
    height, gravity, speed = 0.5, 9.81, 0.05
    mass = (INERTIA[1] + MASS * (HALF**2 + HEIGHT**2)) / height**2
    # The point is above the edge, so it moves only along the normal.
    result = hit_box(np.array([HALF, 0.0, height - HEIGHT]), 2.0, gravity=gravity, feet=True, speed=speed)
    least = MASS * gravity * HALF / height
    assert result.force == pytest.approx(least + speed * np.sqrt(STIFF * mass), rel=5e-3)
    assert result.jump[4] == pytest.approx(speed / height, rel=5e-3)
    # Only the first two corners lift.
    assert result.up == pytest.approx([2 * HALF * speed / height] * 2 + [0.0, 0.0], rel=1e-2, abs=1e-4)
    assert result.feet[2:] == pytest.approx(0.0, abs=1e-4)


def test_a_standing_box_slides() -> None:
    friction, gravity, speed = 0.3, 9.81, 0.05
    result = hit_box(np.zeros(3), friction, gravity=gravity, feet=True, speed=speed)
    assert result.force == pytest.approx(friction * MASS * gravity + speed * np.sqrt(STIFF * MASS), rel=5e-3)
    assert result.jump == pytest.approx([speed, 0, 0, 0, 0, 0], abs=1e-4)
    assert result.feet == pytest.approx(speed, rel=1e-3) and result.up == pytest.approx(0.0, abs=1e-4)


def test_a_box_hit_from_below_leaves_the_ground() -> None:
    """The surface lifts the box as soon as its force exceeds the weight."""
    result = hit_box(np.zeros(3), 0.5, gravity=9.81, feet=True, normal=np.array(DOWN), speed=0.05)
    assert result.force == pytest.approx(MASS * 9.81 + 0.05 * np.sqrt(STIFF * MASS), rel=5e-3)
    assert result.up == pytest.approx(0.05, rel=1e-6)


@pytest.mark.parametrize("friction", [0.0, 0.1])
def test_the_energy_of_the_surface_is_the_energy_of_the_robot(friction: float) -> None:
    panda = robot("panda")
    model, q = panda.model.copy(), read_posture(panda, None)
    model.gravity.linear = np.zeros(3)
    point = point_on(panda, "panda_hand_tcp")
    simulation = ImpactSimulation(model, q, Point(point.joint, point.position))
    result = simulation.run(Surface(np.array(DOWN), 1.0, 1e6, friction))
    kinetic = pin.computeKineticEnergy(model, model.createData(), result.q, result.jump)
    assert result.work == pytest.approx(kinetic + result.stored + result.lost, rel=1e-3)
    assert (result.lost > 1e-3 * result.work) == (friction > 0)


def test_feet_that_are_held_take_part_as_rigid_supports() -> None:
    """The reference is the KKT system of robot and feet, which the simulation does not use."""
    solo = robot("solo8")
    q, n, (points, _) = read_posture(solo, None), np.array(BACK), feet_of(solo)
    base = Point(1, np.zeros(3))
    simulation = ImpactSimulation(solo.model, q, base, points, held=True, still=True)
    result = simulation.run(Surface(n, 1.0, 1e6, 0.0))
    model, data = solo.model, solo.model.createData()
    M = pin.crba(model, data, q)
    pin.computeJointJacobians(model, data, q)
    rows = [
        pin.getFrameJacobian(model, data, p.joint, pin.SE3(np.eye(3), p.position), pin.LOCAL_WORLD_ALIGNED)[:3]
        for p in (base, *points)
    ]
    j, feet = n @ rows[0], np.vstack(rows[1:])
    size, held = model.nv, len(feet)
    kkt = np.block([[np.triu(M) + np.triu(M, 1).T, -feet.T], [feet, 1e-10 * np.eye(held)]])
    a = np.linalg.solve(kkt, np.append(j, np.zeros(held)))[:size]
    assert result.jump == pytest.approx(a / (j @ a), rel=1e-3, abs=1e-5)


def test_a_shorter_time_step_does_not_change_the_result(monkeypatch: pytest.MonkeyPatch) -> None:
    """Feet lift and slide in this impact."""
    first, second = _steps(monkeypatch, 150), _steps(monkeypatch, 600)
    assert first.jump == pytest.approx(second.jump, abs=2e-3 * np.linalg.norm(second.jump))
    assert first.impulse == pytest.approx(second.impulse, rel=2e-3, abs=1e-3)
    assert first.unsolved == second.unsolved == 0
    assert second.feet.max() > 0.05


def _steps(monkeypatch: pytest.MonkeyPatch, count: int) -> SimulatedImpact:
    monkeypatch.setattr(impact_simulation, "_STEPS", count)
    solo = robot("solo8")
    simulation = ImpactSimulation(solo.model, read_posture(solo, None), Point(1, np.zeros(3)), feet_of(solo)[0])
    return simulation.run(Surface(np.array(BACK), 1.0, 1e6, 0.3))


def test_wrong_predictions_are_worst_and_missed(monkeypatch: pytest.MonkeyPatch) -> None:
    """A predicted impulse that is 8 % too large is the first row of the page."""
    monkeypatch.setattr(page, "CASES", (Case("tilthex_arm", BACK),))
    monkeypatch.setattr(page, "HELD_OUT", ())
    monkeypatch.setattr(page, "FRICTIONS", (1.0,))
    request = Request(count=1, jobs=1)
    assert "| normal impulse | 5 % | 4 of 4 |" in "\n".join(page.lines(request)) and not request.missed

    def wrong(case: Case, friction: float, starts: int) -> Compared:
        compared = compare(case, friction, starts)
        rows = [replace(row, before=_larger(row.before)) for row in compared.rows]
        return replace(compared, rows=tuple(rows))

    monkeypatch.setattr(page, "compare", wrong)
    text = "\n".join(page.lines(request))
    assert request.missed == ["normal impulse, no feet: 2 of 4 beyond 5 %"]
    first = next(line for line in text.splitlines() if line.startswith("| tilthex_arm"))
    assert "| normal impulse | before |" in first and "+8" in first


def _larger(pair: Pair) -> Pair:
    return replace(pair, predicted=replace(pair.predicted, impulse=1.08 * pair.predicted.impulse))


@pytest.mark.parametrize(
    ("angular", "still", "long", "reason"),
    [
        (1.04, 1.00, False, None),
        (1.06, 1.00, False, ""),
        (1.06, 1.00, True, "robot moves"),
        (1.06, 1.06, True, ""),
        (0.06, 0.06, False, "negligible"),
    ],
)
def test_a_number_beyond_its_bar_needs_a_reason(angular: float, still: float, long: bool, reason: str | None) -> None:
    """The predicted angular velocity is 1 or 0.05 rad/s, at an approach speed of 1 m/s."""
    predicted = Numbers(1.0, 1.0, 1.0 if angular > 1 else 0.05, 1.0, 1.0, 1.0, False, {}, frozenset())
    sides = (replace(predicted, angular=value) for value in (angular, still))
    pair = Pair(predicted, *sides, named=True, speed=1.0, time=0.02, unsolved=0)
    row = Row(Case("solo8", BACK), 0.3, 1e5, "free", long, pair, pair)
    assert page._reason(row, pair, "angular") == reason
