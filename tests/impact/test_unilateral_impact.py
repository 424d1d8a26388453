"""Feet that lift and slide: active sets without friction, feet that stay, the weight, and Coulomb's law."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from impact_posture.dynamics.numeric import Numeric
from impact_posture.impact.evaluation.coulomb_jump import coulomb_jump
from impact_posture.impact.friction.unilateral_impact import StandingFeet, longest_lifting_time, unilateral_impact
from impact_posture.impact.impact_contact import ImpactContact
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from tests.support.helpers import Vector, assert_close, contact_frame, robot, unit

STANDING = ("solo12", "go2", "talos", "g1")


def hit(name: str, normal: Vector, friction: float) -> tuple[WorstCaseObjective, Vector]:
    """Return the objective of an impact at the default contact of a standing robot, and its default posture."""
    loaded = robot(name)
    contact = ImpactContact(contact_frame(loaded), tuple(normal), friction=friction)
    return WorstCaseObjective(loaded, contact, supports=loaded.spec.supports), loaded.posture()


@pytest.mark.parametrize("name", STANDING)
def test_loaded_feet_stay_as_the_metric_assumes(name: str) -> None:
    objective, q = hit(name, np.array([1.0, 0.2, 0.1]), 0.7)
    feet = StandingFeet(objective.oracle, objective.supports, q, 0.7)
    impact = unilateral_impact(feet, [objective.oracle], 1.0, 1.0)
    held = coulomb_jump(objective, q, 1.0)
    assert impact is not None and held is not None
    assert impact.lifts == impact.slides == ()
    # The compliance of the supports changes the jump by up to 1e-4.
    assert_close(impact.jump, held.velocity, 3e-4, name)
    assert_close(impact.impulses[0], held.impulse, 3e-4, name)


@pytest.mark.parametrize("name", STANDING)
def test_the_feet_carry_the_weight(name: str) -> None:
    objective, q = hit(name, np.array([1.0, 0.0, 0.0]), 0.7)
    feet = StandingFeet(objective.oracle, objective.supports, q, 0.7)
    assert feet.forces is not None
    # Virtual work of the rigid body: the forces balance gravity in all six base coordinates.
    numeric = Numeric(objective.robot.model).at(q)
    _, J = numeric.center_of_mass()
    weight = objective.robot.mass * np.array([0.0, 0.0, -9.81])
    residual = feet.jacobian[:, :6].T @ feet.forces.ravel() + J[:, :6].T @ weight
    assert np.abs(residual).max() < 1e-6 * np.abs(weight).max()


@pytest.mark.parametrize("name", ("solo12", "go2"))
@pytest.mark.parametrize("normal", ((1.0, 0.0, 0.0), (0.3, -0.8, 0.4), (0.0, 0.2, -1.0)))
@pytest.mark.parametrize("time", (0.0, 2e-3))
def test_without_friction_an_active_set_gives_the_same_jump(
    name: str, normal: tuple[float, float, float], time: float
) -> None:
    objective, q = hit(name, np.array(normal), 0.0)
    feet = StandingFeet(objective.oracle, objective.supports, q, 0.0)
    impact = unilateral_impact(feet, [objective.oracle], 1.0, time if feet.forces is not None else 0.0)
    assert impact is not None
    oracle = objective.oracle.at(q)
    rows = np.vstack([oracle.n @ oracle.J, feet.jacobian[2::3]])
    response = np.linalg.solve(oracle.M, rows.T)
    A = rows @ response
    forces = np.zeros(len(A)) if feet.forces is None else np.concatenate([[0.0], feet.forces[:, 2]])
    steps = 8 if time and feet.forces is not None else 1
    jump = np.zeros(objective.robot.nv)
    for k in range(1, steps + 1):
        carried = forces * time / steps
        start = rows @ jump - A @ carried
        # The approach speed falls like the velocity of a mass on a spring.
        start[0] -= 1 - (np.cos(np.pi / 2 * k / steps) if steps > 1 else 0.0)
        jump = jump + response @ (active_set(A, start) - carried)
    assert_close(impact.jump, jump, 1e-6, name)


def active_set(A: Vector, start: Vector) -> Vector:
    """Return ``p ≥ 0`` with ``u = start + A p ≥ 0`` and ``p·u = 0``, by trying every active set."""
    for active in product((False, True), repeat=len(A)):
        on = np.array(active)
        p = np.zeros(len(A))
        p[on] = np.linalg.lstsq(A[np.ix_(on, on)], -start[on], rcond=None)[0]
        if p.min() >= -1e-9 and (start + A @ p).min() >= -1e-9:
            return p
    raise AssertionError("no active set fulfills the conditions")


@given(st.integers(0, 2**32 - 1), st.sampled_from(STANDING))
@example(42, "solo12")
@example(19, "go2")
@example(19, "g1")
def test_feet_lift_only_without_load(seed: int, name: str) -> None:
    generator = np.random.default_rng(seed)
    objective, q = hit(name, unit(generator), float(generator.uniform(0.1, 1.2)))
    feet = StandingFeet(objective.oracle, objective.supports, q, objective.contact.friction)
    impact = unilateral_impact(feet, [objective.oracle], 1.0)
    if impact is None:
        return
    # The kinetic energy that the impact dissipates is not negative: the work of p at the mean contact velocity.
    oracle = objective.oracle.at(q)
    u = oracle.J @ impact.jump
    assert impact.impulses[0] @ (u - 2 * oracle.n) <= 1e-7
    assert oracle.n @ u >= 1 - 1e-6
    velocities = (feet.jacobian @ impact.jump).reshape(-1, 3)
    assert velocities[:, 2].min() > -1e-6
    moving = {f for f, v in zip(feet.frames, velocities, strict=True) if np.linalg.norm(v) > 0.02}
    assert moving <= {*impact.lifts, *impact.slides}
    # A foot that slides stays on the ground.
    sliding = np.isin(feet.frames, impact.slides) & (np.linalg.norm(velocities, axis=1) > 0.01)
    assert velocities[sliding, 2].max(initial=0.0) <= 1e-3
    staying = {f for f, v in zip(feet.frames, velocities, strict=True) if np.linalg.norm(v) < 5e-3}
    assert not staying & set(impact.lifts) or any(s.has_sole for s in objective.supports)


def test_the_time_above_which_the_weight_holds_the_feet() -> None:
    objective, q = hit("solo12", np.array([1.0, 0.0, 0.0]), 0.7)
    feet = StandingFeet(objective.oracle, objective.supports, q, 0.7)
    time = longest_lifting_time(feet, [objective.oracle], 1.0)
    before = unilateral_impact(feet, [objective.oracle], 1.0, 0.9 * time)
    after = unilateral_impact(feet, [objective.oracle], 1.0, time)
    assert before is not None and after is not None
    assert before.lifts or before.slides
    assert not (after.lifts or after.slides)
    # If the speed doubles, the feet stay only if their weight acts for twice the time.
    assert longest_lifting_time(feet, [objective.oracle], 2.0) == pytest.approx(2 * time, rel=0.1)


def test_a_robot_that_cannot_stand_has_no_prediction_with_weight() -> None:
    objective, q = hit("solo12", np.array([1.0, 0.0, 0.0]), 0.7)
    one = replace(objective, supports=objective.supports[:1])
    feet = StandingFeet(one.oracle, one.supports, q, 0.7)
    assert feet.forces is None
    assert unilateral_impact(feet, [one.oracle], 1.0, 0.01) is None
    assert unilateral_impact(feet, [one.oracle], 1.0) is not None


def test_a_robot_beside_its_feet_cannot_stand() -> None:
    """The center of mass of bolt is behind the line of its two feet, so it falls although its feet do not move."""
    objective, q = hit("bolt", np.array([1.0, 0.0, 0.0]), 0.7)
    assert StandingFeet(objective.oracle, objective.supports, q, 0.7).forces is None
