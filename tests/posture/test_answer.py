"""Caches, foot polygons and search rounds make answers faster and must not change them."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull, QhullError

from impact_posture.codegen import c_source as code_module
from impact_posture.codegen.c_literals import DOUBLE, FLOAT
from impact_posture.codegen.c_source import build_c_source
from impact_posture.codegen.export_library import named_objectives
from impact_posture.config.problem_settings import ProblemSettings
from impact_posture.dynamics.numeric import Numeric
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.output.report import drawn_robot as report_shapes
from impact_posture.output.report.drawn_robot import DrawnRobot, draw_robot
from impact_posture.posture.formulation.problem_file import prepare
from impact_posture.posture.loads.load_cases import load_cases
from impact_posture.posture.manifold.feasible_start import Projector, feasible_start
from impact_posture.posture.search import growing_search as search_module
from impact_posture.posture.search.growing_search import GrowingSearch
from impact_posture.posture.search.multistart import solve
from impact_posture.posture.search.start_draws import StartDraws
from impact_posture.robot.robot_loader import load_robot
from impact_posture.robot.support_polygon import polygon_edges


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("IMPACT_POSTURE_CACHE", str(tmp_path))
    draw_robot.cache_clear()
    return tmp_path


points = st.lists(
    st.tuples(*[st.floats(-1, 1).map(lambda x: round(x, 2))] * 2), min_size=0, max_size=14
)  # fmt: skip


@given(points)
@settings(max_examples=60, deadline=None)
def test_the_polygon_of_the_feet_is_the_convex_hull(corners: list[tuple[float, float]]) -> None:
    edges = polygon_edges([np.array(corner) for corner in corners])
    try:
        hull = ConvexHull(np.array(corners).reshape(-1, 2))
    except (QhullError, ValueError):
        assert edges is None
        return
    assert edges is not None
    normals, offsets = edges
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-9)
    # The polygon has one edge per corner of the convex hull, and the same half-planes as the hull.
    expected = np.unique(np.round(hull.equations, 7), axis=0)
    assert len(normals) == len(expected)
    for *n, b in hull.equations:
        assert np.abs(np.column_stack([normals, -offsets]) - [*n, b]).max(axis=1).min() < 1e-6


coarse = st.lists(st.tuples(*[st.sampled_from([-0.1, 0.0, 0.1])] * 2), min_size=3, max_size=9)


@given(coarse, st.integers(0, 10**6))
@settings(max_examples=60, deadline=None)
def test_feet_in_a_row_whose_places_are_inexact_keep_their_corners(
    corners: list[tuple[float, float]], seed: int
) -> None:
    points = np.array(corners) + 1e-10 * np.random.default_rng(seed).normal(size=(len(corners), 2))
    edges = polygon_edges(points)
    if edges is not None:
        assert (points @ edges[0].T <= edges[1] + 1e-8).all()


def _objective(robot: str, frame: str) -> WorstCaseObjective:
    problem = prepare(ProblemSettings(robot=robot, frame=frame, normal=(0.0, 0.0, 1.0), collision=False)).problem
    return problem.impact


@pytest.mark.long(but=("tilthex_arm-ee",))
@pytest.mark.parametrize("robot, frame", [("tilthex_arm", "ee"), ("z1", "link06")])
def test_code_from_the_cache_is_the_code(
    cache: Path, monkeypatch: pytest.MonkeyPatch, robot: str, frame: str
) -> None:
    objective, generate, count = _objective(robot, frame), code_module._generate, []
    monkeypatch.setattr(code_module, "_generate", lambda *a, **k: count.append(1) or generate(*a, **k))

    def texts(**changed: object) -> list[str]:
        exported = named_objectives([changed.pop("objective", objective)], "a")
        code = build_c_source(exported, "a", changed.pop("real", DOUBLE), **changed)
        from impact_posture.codegen.export_files import render_files
        from impact_posture.codegen.manifest_builder import build_manifest

        manifest = build_manifest([v.objective for v in exported][:1], "a", None, None, DOUBLE, code.stack_bytes)
        return list(render_files(exported, "a", manifest, code, DOUBLE).values())

    first = texts()
    assert texts() == first and len(count) == 1
    # If the objective or an option changes, the cache entry has another key.
    other = replace(objective, contact=replace(objective.contact, normal=(0.0, 0.6, 0.8)))
    for changed in ({"objective": other}, {"real": FLOAT}, {"portable": True}):
        assert texts(**changed) != first
    assert len(count) == 4
    (kept, *_) = sorted((cache / "code").glob("*.json"), key=os.path.getmtime)
    kept.write_text(kept.read_text()[:-9])
    assert texts() == first and len(count) == 5


def _numbers(drawn: DrawnRobot) -> list[object]:
    solids = [(s.corners.tolist(), s.faces.tolist(), s.low.tolist(), s.step) for s in drawn.solids]
    parts = [(joint, k, at.homogeneous.tolist(), color) for joint, k, at, color in drawn.parts]
    return [solids, parts, drawn.licenses, drawn.notes]


@pytest.mark.parametrize(
    "robot, damage", [("hextilt", ""), ("tilthex_arm", ""), ("tilthex_arm", "cut"), ("tilthex_arm", "other")]
)
def test_drawn_shapes_from_the_cache_are_the_shapes(
    cache: Path, monkeypatch: pytest.MonkeyPatch, robot: str, damage: str
) -> None:
    first = _numbers(draw_robot(load_robot(robot)))
    (kept,) = (cache / "solids").glob("*.json")
    if damage:
        kept.write_text({"cut": kept.read_text()[:-9], "other": "{}"}[damage])
    else:
        monkeypatch.setattr(report_shapes, "load_geometry", None)
    draw_robot.cache_clear()
    assert _numbers(draw_robot(load_robot(robot))) == first


def test_an_end_that_lacks_parts_is_certified_in_the_last_round_only(monkeypatch: pytest.MonkeyPatch) -> None:
    problem = prepare(ProblemSettings(robot="panda", frame="panda_hand_tcp", normal=(-1.0, 0.0, 0.0))).problem
    scale = problem.objective.value(problem.given)
    draws = StartDraws(problem, (problem.given,), 2, 0)
    search = GrowingSearch(problem, draws, scale, compile="never", finish_all=True)
    runs = [search._run(index, last=False) for index in range(2)]
    lacking = [index for index, run in enumerate(runs) if run.lacks]
    # The test needs at least one run that ended without the required constraint rows.
    assert lacking
    for index, run in enumerate(runs):
        assert (run.certificate is None) == run.lacks
        if run.lacks:
            ended = search._run(index, last=True)
            assert ended.certificate is not None and not ended.good
    monkeypatch.setattr(search_module, "_ROUNDS", 1)
    assert [run.good for run in search.run(1, None)][lacking[0]] is False


def test_postures_held_by_even_forces_need_no_linear_program(monkeypatch: pytest.MonkeyPatch) -> None:
    problem = prepare(
        ProblemSettings(robot="talos", frame="gripper_right_base_link", normal=(-1.0, 0.0, 0.0))
    ).problem
    held = [c for c in problem.constraints if c.name == "holding at rest"]
    assert len(held) == 1 and load_cases(problem.objective, problem.given, problem.requirements).cases
    model = Numeric(problem.robot.model).at(problem.given)
    exact = held[0].evaluate(model)[0]
    monkeypatch.setattr(held[0], "evaluate", None)
    # The exact evaluation and the bound both report no violation.
    assert (exact <= 1e-8).all() and (held[0].value(model) <= held[0].upper).all()


def test_an_answer_of_a_small_robot_imports_no_part_of_scipy() -> None:
    """Importing a part of SciPy takes longer than solving this problem."""
    program = """if True:
        import sys
        from impact_posture.api.posture_result import optimize
        from impact_posture.api.posture_problem import PostureProblem
        from impact_posture.posture.formulation.problem_file import prepare
        from impact_posture.config.problem_settings import ProblemSettings

        prepared = prepare(ProblemSettings(robot="tilthex_arm", frame="ee", normal=(0, 0, 1)))
        assert optimize(PostureProblem.of(prepared), starts=2, jobs=1).document
        print([part for part in ("linalg", "spatial", "optimize") if f"scipy.{part}" in sys.modules])
        """
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert (done.stdout, done.stderr) == ("[]\n", "")


@pytest.mark.long(but=("tiago-normal1",))
@pytest.mark.parametrize(("robot", "normal"), [("bolt", (0, 0, 1)), ("tiago", (-1, 0, 0))])
def test_starts_that_share_a_run_end_where_their_own_runs_would(
    robot: str, normal: tuple[float, float, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    problem = prepare(ProblemSettings(robot=robot, normal=normal)).problem
    ran, run = list[int](), GrowingSearch._run

    def counted(search: GrowingSearch, index: int, *, last: bool) -> search_module.SolverRun:
        ran.append(index)
        return run(search, index, last=last)

    monkeypatch.setattr(GrowingSearch, "_run", counted)
    together = solve(problem, starts=16, jobs=1, compile="never", finish_all=True)
    shared = len(ran)
    monkeypatch.setattr(search_module, "_SAME", 0.0)
    apart = solve(problem, starts=16, jobs=1, compile="never", finish_all=True)
    assert shared < len(ran) - shared
    assert together.certified_starts == apart.certified_starts
    assert [o.hits for o in together.optima] == [o.hits for o in apart.optima]
    np.testing.assert_allclose([o.objective for o in together.optima], [o.objective for o in apart.optima], rtol=1e-6)


@pytest.mark.long(but=("solo8-normal0-12",))
@pytest.mark.parametrize("robot, normal, starts", [("solo8", (0.0, 0.0, 1.0), 12), ("tiago", (-1.0, 0.0, 0.0), 24)])
def test_a_start_that_is_left_would_not_have_been_the_best(
    robot: str, normal: tuple[float, float, float], starts: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Lower the size thresholds, so that a small program is treated like a large program.
    monkeypatch.setattr(search_module, "_SMALL", 0)
    monkeypatch.setattr(search_module, "_BATCH", 500)
    problem = prepare(ProblemSettings(robot=robot, normal=normal, offset=(0.0, 0.0, 0.0))).problem
    few, all_ = (
        solve(problem, starts=starts, jobs=2, compile="never", finish_all=finish_all) for finish_all in (False, True)
    )
    assert all_.dominated_starts == 0 < few.dominated_starts
    assert few.certified_starts + few.dominated_starts + few.colliding_starts <= few.starts
    best = [one.problem.objective.value(one.q) for one in (few, all_)]
    assert best[0] == pytest.approx(best[1], rel=1e-5)
    assert few.optima[0].hits <= all_.optima[0].hits


@pytest.mark.long(but=("tilthex_arm",))
@pytest.mark.parametrize("robot", ["solo8", "tilthex_arm"])
def test_a_small_program_finishes_every_start(robot: str) -> None:
    solution = solve(prepare(ProblemSettings(robot=robot, normal=(0.0, 0.0, 1.0))).problem, compile="never")
    assert solution.dominated_starts == 0 and solution.certified_starts == solution.starts == 16


@pytest.mark.parametrize("robot", ["xarm7", "anymal_c"])
def test_more_candidates_make_a_start_clearer(robot: str) -> None:
    problem = prepare(ProblemSettings(robot=robot, normal=(-1, 0, 0))).problem
    projector, gained = Projector(problem), 0
    for index in range(1, 7):
        few, many = (feasible_start(problem, index, 0, count) for count in (1, 8))
        assert few is not None and many is not None
        violations = projector.outside(few), projector.outside(many)
        assert violations[1] <= violations[0]
        gained += violations[1] < violations[0]
        assert projector.project(many).violation <= 1e-8
    assert gained or violations == (0.0, 0.0)
