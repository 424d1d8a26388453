"""The search ``global`` from the settings to the result folder, and its estimates of missed optima."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import impact_posture as ip
from impact_posture.errors import InputError
from impact_posture.output.result_reader import load_view
from impact_posture.posture.formulation.problem_file import prepare, read_settings
from impact_posture.posture.search.global_search import GlobalSearch
from impact_posture.posture.search.multistart import solve
from impact_posture.posture.search.unseen_optima import estimated_optima, unseen_share
from tests.docs.test_docs_reference import DOCS, rows
from tests.support.command import refused, run, succeed
from tests.support.settings import make_settings


def searched(
    robot: str, normal: tuple[float, float, float], starts: int, seed: int = 0
) -> tuple[ip.PostureResult, GlobalSearch]:
    problem = ip.PostureProblem.of(prepare(make_settings({"robot": robot, "normal": normal})))
    result = ip.optimize(problem, starts=starts, seed=seed, jobs=1, compile="never", search="global")
    assert result.global_search is not None
    return result, result.global_search


def test_a_map_finds_the_component_that_few_starts_miss() -> None:
    result, search = searched("ur5", (1, 0, 0), starts=2, seed=2)
    document = result.document["global"]
    assert document["method"] == "self-motion"
    assert search.redundancy == 1 and len(document["components"]) == 8
    # The two starts end at objectives far above the optimum.  The self-motion map reaches the objective of many
    # starts or a better objective.
    many = solve(result.problem.problem, starts=24, jobs=1, compile="never")
    assert many.problem.objective.value(result.q) <= many.optima[0].objective * (1 + 1e-6)
    assert search.missed_rate == 1 and search.improvement > 0.1
    assert result.certificate.holds()
    assert document["lower"] <= many.optima[0].objective
    assert 0 <= document["gap"] <= 0.01 and document["finished"] and document["word"] == "bounded"
    best = min(part["objective"] for part in document["components"])
    assert best == pytest.approx(document["lower"], rel=0.02)
    # The statistics of the starts must not include optima from the map.
    assert sum(o.hits for o in result.solution.optima) == result.solution.certified_starts <= 2
    json.dumps(document, allow_nan=False)


def test_without_a_map_the_search_is_the_adaptive_one() -> None:
    result, search = searched("hextilt", (1, 0, 0), starts=64)
    assert result.document["global"]["method"] == "basin-hopping"
    assert search.redundancy == 3 and search.improvement == 0 and search.word is None
    adaptive = ip.optimize(result.problem, starts=64, jobs=2, compile="never")
    np.testing.assert_allclose(adaptive.q, result.q, atol=1e-9)
    assert result.document["search"] == adaptive.document["search"]


def test_the_command_writes_the_map_and_the_block(tmp_path: Path) -> None:
    options = ("--search", "global", "--starts", 2, "--jobs", 1, "--no-codegen", "--out", "found")
    done = succeed("optimize", "tilthex_arm", "--normal", 0, 0, 1, *options, cwd=tmp_path, pictures=("self_motion",))
    found = tmp_path / "found"
    block = json.loads((found / "result.json").read_text())["global"]
    assert " ".join(block["line"].split()) in " ".join(done.stdout.split())
    (row,) = rows(DOCS / "reference" / "result-json.md")["global"]
    for key in (*block, *block["components"][0]):
        assert f"`{key}`" in row, key
    assert (found / "self_motion.png").stat().st_size > 8_000
    view = load_view(found)
    assert view.self_motion is not None
    model = view.robot.model
    for place, q in ((view.self_motion.optimum, view.q_optimal), (view.self_motion.start, view.q_initial)):
        assert np.linalg.norm(pin.difference(model, view.self_motion.q[place[0]], q)) < 0.05
    assert read_settings(found / "problem.toml").search == "global"


def test_a_problem_that_cannot_be_searched_is_refused_before_solving(tmp_path: Path) -> None:
    options = ("--search", "global", "--regularization", 0.1)
    refused(
        run("optimize", "panda", "--normal", 0, 0, 1, *options, cwd=tmp_path), 1, "regularization", "search global"
    )
    problem = ip.PostureProblem.of(prepare(make_settings({"robot": "panda", "normal": (0, 0, 1)})))
    with pytest.raises(InputError, match="multistart"):
        ip.optimize(problem, search="gobal")  # type: ignore[arg-type]


# ---- estimates -----------------------------------------------------------------------------------------------


def test_estimates_of_known_counts() -> None:
    assert unseen_share([5, 1, 1, 3]) == pytest.approx(0.2)
    assert estimated_optima([5, 3]) == 2
    assert estimated_optima([5, 2, 1, 1, 1]) == pytest.approx(5 + 3 * 2 / (2 * 2))


@settings(max_examples=20, deadline=None)
@given(st.integers(2, 12), st.integers(0, 10_000))
def test_estimates_are_right_in_the_mean(optima: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    shares = rng.dirichlet(np.ones(optima))
    estimates, truths, numbers = [], [], []
    for _ in range(400):
        hits = rng.multinomial(16, shares)
        estimates.append(unseen_share(hits[hits > 0]))
        truths.append(shares[hits == 0].sum())
        numbers.append(estimated_optima(hits[hits > 0]))
    # For any probabilities of the optima, Good–Turing errs by less than 1/16 on average.  Chao's bound is valid.
    assert abs(np.mean(estimates) - np.mean(truths)) < 1 / 16 + 0.02
    assert np.mean(numbers) < optima * 1.3 + 1
