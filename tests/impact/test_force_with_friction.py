"""Peak force, compression time and effective mass with friction, compared with an integrated contact; gradients."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from docs.studies.verdict.impact_simulation import ImpactSimulation, Point, SimulatedImpact, Surface
from impact_posture.config.problem_settings import ProblemSettings
from impact_posture.config.table_validation import validate
from impact_posture.dynamics.numeric import Numeric
from impact_posture.impact.elasticity.contact_compression import ContactStiffness, compression
from impact_posture.impact.friction.coulomb_impact import coulomb_impact
from impact_posture.impact.impact_contact import ImpactContact, point_on
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.posture.analysis.verdict import verdict
from impact_posture.posture.constraints.impact_bounds import ImpactBounds
from impact_posture.posture.formulation.problem_file import prepare
from impact_posture.posture.manifold.feasible_start import feasible_start
from impact_posture.posture.search.growing_search import feasible
from impact_posture.posture.search.multistart import solve
from tests.support.command import refused, run
from tests.support.helpers import Vector, random_configurations, relative, uncoupled
from tests.support.pinocchio_values import central_gradient
from tests.support.settings import make_settings

FRAMES = {"tilthex_arm": "ee", "panda": "panda_hand_tcp", "ur5": "tool0"}


def struck(name: str, friction: float, normal: tuple[float, float, float] = (0.3, 0.1, 1.0)) -> WorstCaseObjective:
    return WorstCaseObjective(uncoupled(name), ImpactContact(FRAMES[name], normal, friction=friction))


def simulated(objective: WorstCaseObjective, q: Vector, surface: Surface) -> SimulatedImpact:
    """Simulate the impact of a robot whose mass matrix and Jacobian do not change."""
    point = point_on(objective.robot, objective.contact.frame, objective.contact.offset)
    simulation = ImpactSimulation(objective.robot.model, q, Point(point.joint, point.position), still=True)
    return simulation.run(surface)


@pytest.mark.parametrize("name", FRAMES)
@pytest.mark.parametrize("friction", [0.0, 0.2, 3.0])
def test_force_and_time_equal_an_integrated_contact_with_friction(name: str, friction: float) -> None:
    objective, speed, seen = struck(name, friction), 0.7, set()
    (q,) = random_configurations(objective.robot.model, 1, name, "force")
    n = np.array(objective.contact.normal)
    for contact, power in ((ContactStiffness(linear=2e5), 1.0), (ContactStiffness(hertz=3e7), 1.5)):
        stiffness = contact.linear or contact.hertz or 0.0
        stepped = simulated(objective, q, Surface(n, speed, stiffness, friction, power))
        predicted = compression(objective, q, speed, contact)
        assert predicted is not None and predicted.peak_force is not None and predicted.time is not None
        assert predicted.peak_force == pytest.approx(stepped.force, rel=1e-3)
        assert predicted.time == pytest.approx(stepped.time, rel=1e-3)
        assert predicted.mass * speed == pytest.approx(n @ stepped.impulse, rel=1e-3)
        impact = coulomb_impact(objective.oracle, q)
        assert relative(speed * impact.jump, stepped.jump) < 1e-3
        assert impact.sticks == (stepped.slip < 1e-5 * speed)
        seen.add(impact.sticks)
    assert seen == {friction == 3.0}
    G = objective.oracle.quantities(q).G
    assert (predicted.mass * G == pytest.approx(1)) == (friction == 0.0)


def test_the_force_of_the_first_example_grows() -> None:
    """Without friction the force would fall by 23 %; with friction 0.7 the contact sticks, and the force grows."""
    settings = validate(ProblemSettings, {"robot": "tilthex_arm", "frame": "ee", "normal": (0, 0, 1)}, "options")
    prepared = prepare(settings)
    solution = solve(prepared.problem, starts=4, compile="never")
    objective, surface = prepared.impact.objective, Surface(np.array([0.0, 0, 1]), 1.0, 1e5, 0.7)
    forces = [simulated(objective, q, surface).force for q in (solution.initial, solution.q)]
    told = verdict(prepared.impact, *map(prepared.impact.evaluate, (solution.initial, solution.q)))
    assert told.peak_force == pytest.approx(forces[1] / forces[0] - 1, abs=0.01)
    assert forces[1] / forces[0] == pytest.approx(1.51, abs=0.02)
    free = replace(objective.contact, friction=0.0)
    masses = [
        1 / WorstCaseObjective(objective.robot, free).oracle.quantities(q).G for q in (solution.initial, solution.q)
    ]
    assert np.sqrt(masses[1] / masses[0]) == pytest.approx(0.77, abs=0.02)


@pytest.mark.long(
    but=(
        "world-0.0-panda",
        "world-0.15-tilthex_arm",
        "world-3.0-ur5",
        "contact-0.0-tilthex_arm",
        "contact-0.15-panda",
        "contact-3.0-tilthex_arm",
    )
)
@pytest.mark.parametrize("name", FRAMES)
@pytest.mark.parametrize("friction", [0.0, 0.15, 3.0])
@pytest.mark.parametrize("frame", ["world", "contact"])
def test_gradients_of_mass_and_jumps_equal_differences(name: str, friction: float, frame: str) -> None:
    plain = struck(name, friction)
    objective = replace(plain, contact=replace(plain.contact, normal_frame=frame))
    (q,) = random_configurations(objective.robot.model, 1, name, "slopes", friction)
    bounds, numeric = ImpactBounds(objective, 1.0, 1.0), Numeric(objective.robot.model)
    value, jacobian = bounds.evaluate(numeric.at(q))
    assert value[0] == coulomb_impact(objective.oracle, q).mass
    measured = central_gradient(lambda q: bounds.value(numeric.at(q)), objective.robot.model, q, 1e-4)
    assert relative(jacobian, measured) < 1e-5
    mass = replace(objective, kind="effective-mass")
    assert relative(mass.gradient(q), measured[0]) < 1e-5 and mass.value(q) == value[0]
    expressed, gradient = (np.array(v).ravel() for v in mass.gradient_fun()(q, objective.contact.normal))
    assert relative(expressed, value[:1]) < 1e-9 and relative(gradient, mass.gradient(q)) < 1e-8
    # In the literature, the effective mass is the inverse of the mobility along the normal.  Friction never reduces
    # the effective mass.
    G = objective.oracle.quantities(q).G
    assert value[0] * G == pytest.approx(1) if friction == 0 else value[0] * G > 1


@pytest.mark.parametrize("friction", [0.0, 0.1, 0.7])
def test_no_posture_exceeds_a_bound_on_the_simulated_force(friction: float) -> None:
    """The program, the certificate and an integrated contact agree on the force, sticking and slipping."""
    task = {"robot": "tilthex_arm", "normal": (0, 0, 1), "objective": "speed", "friction": friction}
    task |= {"contact_stiffness": 1e5}
    free = prepare(make_settings(task))
    start = free.impact.evaluate().compression
    assert start is not None and start.peak_force is not None
    bounded = prepare(make_settings({**task, "max_force": 0.9 * start.peak_force}))
    solution = solve(bounded.problem, starts=4, compile="never")
    assert solution.certificate.holds()
    surface = Surface(np.array([0.0, 0, 1]), 1.0, 1e5, friction)
    stepped = simulated(bounded.impact.objective, solution.q, surface)
    assert stepped.force <= 0.9 * start.peak_force * 1.001


@pytest.mark.usefixtures("few_tries")
def test_a_bound_that_no_posture_keeps_names_the_least_force(tmp_path: Path) -> None:
    """No random feasible posture has less than the least force in the error, and this force is a valid bound."""
    task = {"robot": "tilthex_arm", "normal": (0, 0, 1), "contact_stiffness": 1e5, "approach": True}
    words = "optimize tilthex_arm --normal 0 0 1 --contact-stiffness 1e5 --no-codegen --no-report --max-force"
    done = run(*words.split(), 20, cwd=tmp_path)
    refused(done, 3, "--max-force: 20 N cannot be kept: the least peak force that 16 starts reached")
    (least,) = map(float, re.findall(r"under the other constraints is ([\d.]+) N; permit more", done.stderr))
    free = prepare(make_settings(task))
    starts = (feasible_start(free.problem, index, 0) for index in range(1, 40))
    feasible_starts = [q for q in starts if q is not None and feasible(free.problem, q)]
    solved = solve(prepare(make_settings({**task, "max_force": 1.01 * least})).problem, starts=4, compile="never")
    forces = [
        at.peak_force or 0.0 for q in (*feasible_starts, solved.q) if (at := free.impact.evaluate(q).compression)
    ]
    assert len(forces) > 10 and min(forces) > least * (1 - 1e-3)
    assert solved.certificate.holds() and forces[-1] <= 1.01 * least * (1 + 1e-6)
