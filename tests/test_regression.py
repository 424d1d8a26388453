"""The committed results are what the commands still give."""

from __future__ import annotations

import json

import pytest

from tests.regression.cases import CASES, EXPECTED, PAGE, Case


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_result_is_reproduced(case: Case) -> None:
    """Objective within 1e-6, redundancy exactly; the posture itself may be a mirror image."""
    expected = json.loads(EXPECTED.read_text())[case.name]
    prepared, solution = case.solve()
    assert prepared.impact.robot.model_sha256 == expected["model_sha256"], "the robot's data changed: make regression"
    assert expected["command"] == case.command
    assert solution.certificate.holds()
    assert solution.redundancy == expected["redundancy"]
    assert solution.reduction == pytest.approx(expected["reduction"], abs=1e-6)
    after = prepared.problem.impact.oracle.quantities(solution.q)
    assert pytest.approx(expected["after"]["H"], rel=1e-5) == after.H
    assert [s.frame for s in prepared.impact.supports] == expected["supports"]


def test_page_shows_the_committed_results() -> None:
    page = PAGE.read_text()
    for name, result in json.loads(EXPECTED.read_text()).items():
        assert f"| {name} | {result['redundancy']} | {result['reduction']:.1%} |" in page
        assert result["command"] in page
