"""Offline posture of a scenario: the constraints of `optimize`, and the load of the motors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pinocchio as pin
import pytest
from scipy.optimize import linprog

from docs.studies.robustness.outcomes import is_held
from impact_posture.errors import Infeasible
from impact_posture.posture.constraints.requirements import Requirements
from impact_posture.posture.formulation.build_problem import build_problem
from impact_posture.posture.loads.load_cases import load_cases
from impact_posture.posture.search.growing_search import feasible
from impact_posture.robot.actuation import allocation_matrix, thrust_limits
from impact_posture.simulation import offline_posture as offline
from impact_posture.simulation.offline_posture import SHARE, offline_posture, scenario_requirements
from impact_posture.simulation.scenario_file import Spread, read_scenario
from impact_posture.simulation.scenario_objective import scenario_objective
from impact_posture.simulation.setup import set_up
from impact_posture.tsid.flow.flow_direction import FlowOptions


@pytest.mark.parametrize("name", ["aerial-vertical", "aerial-lateral", "solo8-push"])
def test_the_posture_satisfies_the_constraints_of_optimize(name: str) -> None:
    setup = set_up(read_scenario(name))
    objective = scenario_objective(setup)
    posture, demands = offline_posture(setup, objective, starts=3), scenario_requirements(setup, objective)
    assert demands.collision and demands.holdable and demands.limit_share == SHARE
    problem = build_problem(setup.robot, objective, setup.q, demands)
    assert problem.surroundings is not None
    assert not problem.surroundings.collisions(posture.q)
    assert feasible(problem, posture.q)
    assert posture.note == "" and posture.objective < posture.initial and posture.distance > 0.1
    assert posture.objective == pytest.approx(objective.value(posture.q))


def test_the_posture_of_a_strike_reaches_its_speed_within_the_velocity_limits() -> None:
    """The oracle is the least largest share of a velocity limit with ``J q̇ = −v n`` and no tilt, by SciPy."""
    setup = set_up(replace(read_scenario("panda-wall"), spread=Spread(speed=0.1)))
    objective, model = scenario_objective(setup, "sticking"), setup.robot.model
    posture = offline_posture(setup, objective, strikes=True)
    frame, data = model.getFrameId("panda_hand_tcp"), model.createData()
    pin.framesForwardKinematics(model, data, posture.q)
    J = pin.computeFrameJacobian(model, data, posture.q, frame, pin.LOCAL_WORLD_ALIGNED)
    J[:3] -= pin.skew(data.oMf[frame].rotation @ np.array(objective.contact.offset)) @ J[3:]
    limits, moving = setup.robot.velocity_limits[:7], slice(0, 7)
    A = np.column_stack([J[[0, 1, 2, 4, 5], moving], np.zeros(5)])
    sides = np.vstack([np.column_stack([sign * np.diag(1 / limits), -np.ones(7)]) for sign in (1, -1)])
    bounds = [(None, None)] * 7 + [(0, None)]
    best = linprog(np.eye(8)[-1], sides, np.zeros(14), A, [1.1 * 0.5, 0, 0, 0, 0], bounds)
    assert best.status == 0 and best.fun <= 1
    assert scenario_requirements(setup, objective).approach_speed == 0


@pytest.mark.parametrize("name", ["aerial-vertical", "aerial-lateral"])
def test_a_flying_robot_can_hold_the_posture(name: str) -> None:
    """The expected loads come from inverse dynamics and the rotor allocation."""
    setup = set_up(read_scenario(name))
    q, robot = offline_posture(setup, scenario_objective(setup), starts=1).q, setup.robot
    torque = pin.computeGeneralizedGravity(robot.model, robot.model.createData(), q)
    effort = np.asarray(robot.model.effortLimit)
    assert (np.abs(torque[6:]) <= SHARE * effort[6:] + 1e-9).all()
    propulsion = robot.spec.propulsion
    assert propulsion is not None
    low, high = thrust_limits(propulsion)
    thrusts = np.linalg.solve(allocation_matrix(robot.model, propulsion), torque[:6])
    assert (np.abs(thrusts - (low + high) / 2) <= SHARE * (high - low) / 2 + 1e-9).all()


def test_the_share_of_the_limits_counts() -> None:
    """A posture is feasible if ``limit_share`` is at least its largest load, measured from the rotors' mid-range."""
    setup = set_up(read_scenario("aerial-lateral"))
    objective = scenario_objective(setup)
    assert is_held(setup, objective)
    demands = scenario_requirements(setup, objective)
    whole = load_cases(objective, setup.q, replace(demands, limit_share=1.0)).holding(setup.q)
    assert whole is not None
    for share, fits in ((1.01 * whole.largest_share, True), (0.99 * whole.largest_share, False)):
        cases = load_cases(objective, setup.q, replace(demands, limit_share=share))
        part = cases.holding(setup.q)
        assert part is not None and part.feasible is fits
        assert part.largest_share == pytest.approx(whole.largest_share / share)
        assert f"within {100 * share:g} % of their limits at rest" in cases.cases[0].description


@pytest.mark.usefixtures("few_tries")
def test_a_note_reports_possible_collisions(monkeypatch: pytest.MonkeyPatch) -> None:
    setup = set_up(read_scenario("aerial-vertical"))
    objective = scenario_objective(setup)
    # No posture keeps a distance of one meter between all links.
    demands = replace(scenario_requirements(setup, objective), clearance=1.0)
    monkeypatch.setattr(offline, "scenario_requirements", lambda *_, **__: demands)
    monkeypatch.setattr(offline, "_MARGINS", offline._MARGINS[-1:])
    posture = offline_posture(setup, objective, starts=1)
    assert posture.note.startswith("links may touch in the offline posture, because none without collisions is known")
    assert "\n" not in posture.note and posture.objective < posture.initial


@pytest.mark.parametrize(
    ("works", "words"),
    [
        (lambda r: not r.keep_contacts and not r.limit_margin, ["feet may lift"]),
        (lambda r: not r.collision, ["feet may lift", "links may touch"]),
        (lambda r: not r.limit_margin, []),
    ],
)
def test_a_note_names_all_dropped_requirements(
    works: Callable[[Requirements], bool], words: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    setup = set_up(read_scenario("solo8-push"))
    monkeypatch.setattr(offline, "build_problem", lambda *arguments: arguments[-1])

    def solve(requirements: Requirements, **_: object) -> SimpleNamespace:
        if works(requirements):
            return SimpleNamespace(q=setup.q, initial=setup.q, problem=SimpleNamespace(requirements=requirements))
        raise Infeasible({"all": 1.0})

    monkeypatch.setattr(offline, "solve", solve)
    note = offline_posture(setup, scenario_objective(setup), strikes=True).note
    assert [word for word in ("feet may lift", "links may touch") if word in note] == words
    assert bool(note) == bool(words)


def test_free_objectives_have_no_requirements_on_the_feet() -> None:
    setup = set_up(read_scenario("solo8-push"))
    objective = scenario_objective(setup, free=True)
    assert not scenario_requirements(setup, objective).com_over_feet
    assert offline_posture(setup, objective, starts=1).objective < objective.value(setup.q)


def test_the_end_effector_is_at_the_surface() -> None:
    setup = set_up(read_scenario("solo12-landing"))
    objective = scenario_objective(setup, "sticking")
    model, data = setup.robot.model, setup.robot.model.createData()
    frame = model.getFrameId(objective.contact.frame)

    def place(q: np.ndarray) -> np.ndarray:
        pin.framesForwardKinematics(model, data, q)
        return np.array(data.oMf[frame].translation)

    there, here = (offline_posture(setup, objective, starts=2, at_contact=met).q for met in (True, False))
    start = place(setup.q)
    np.testing.assert_allclose(place(there), start - setup.gap * setup.scenario.normal, atol=1e-8)
    np.testing.assert_allclose(place(here), start, atol=1e-8)
    # The base tilts at most by the tilt limit of the reference flow.
    for q in (there, here):
        assert pin.Quaternion(q[3:7]).matrix()[2, 2] >= np.cos(FlowOptions().tilt) - 1e-9
