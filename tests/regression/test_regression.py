"""The commands still give the committed results."""

from __future__ import annotations

import json

import numpy as np
import pinocchio as pin
import pytest

from impact_posture.dynamics.numeric import Numeric
from impact_posture.posture.formulation.problem_file import Prepared, prepare
from impact_posture.posture.program.certificate import certify
from impact_posture.system.arrays import Array
from tests.regression.cases import CASES, EXPECTED, PAGE, Case


@pytest.mark.parametrize("case", [case for case in CASES if not case.many], ids=lambda case: case.name)
def test_result_is_reproduced(case: Case) -> None:
    """The objective agrees within 1e-6, the redundancy exactly; the posture itself may be mirrored."""
    expected = json.loads(EXPECTED.read_text())[case.name]
    prepared, solution = case.solve()
    assert solution.certificate.holds()
    assert solution.redundancy == expected["redundancy"]
    assert solution.reduction == pytest.approx(expected["reduction"], abs=1e-6)
    check(case, prepared, solution.q)


@pytest.mark.parametrize("case", [case for case in CASES if case.many], ids=lambda case: case.name)
def test_result_is_still_an_optimum(case: Case) -> None:
    """Recompute the certificate of the committed posture, because rounding decides which optimum a search returns."""
    expected = json.loads(EXPECTED.read_text())[case.name]
    prepared = prepare(case.settings)
    problem, q = prepared.problem, np.array(expected["q"])
    guess = problem.guess(Numeric(problem.robot.model).at(q))
    assert certify(problem, q, problem.objective.value(problem.given), guess.values).holds()
    moved = pin.integrate(problem.robot.model, q, np.full(problem.robot.nv, 1e-3))
    assert not certify(problem, moved, problem.objective.value(problem.given), guess.values).holds()
    assert problem.surroundings is not None and not problem.surroundings.collisions(q)
    check(case, prepared, q)


def check(case: Case, prepared: Prepared, q: Array) -> None:
    expected = json.loads(EXPECTED.read_text())[case.name]
    assert prepared.impact.robot.model_sha256 == expected["model_sha256"], "the robot's data changed: make regression"
    assert expected["command"] == case.command
    assert [s.frame for s in prepared.impact.supports] == expected["supports"]
    after = prepared.problem.impact.oracle.quantities(q)
    assert pytest.approx(expected["after"]["H"], rel=1e-5) == after.H


def test_page_shows_the_committed_results() -> None:
    page = PAGE.read_text()
    for name, result in json.loads(EXPECTED.read_text()).items():
        assert f"| {name} | {result['redundancy']} | {result['reduction']:.1%} |" in page
        assert result["command"] in page
