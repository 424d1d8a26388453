"""The trade-off between objective and distance: compared with brute force, its certificates, and its warnings."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from impact_posture.config.problem_settings import TRADEOFF_POINTS
from impact_posture.dynamics.chart import Chart
from impact_posture.errors import InputError
from impact_posture.posture.analysis import pareto_front as follow
from impact_posture.posture.analysis.pareto_front import pareto_front
from impact_posture.posture.analysis.trade_off import TradeOff, find_knee
from impact_posture.posture.constraints.posture_distance import distance, distance_gradient
from impact_posture.posture.formulation.problem_file import prepare
from impact_posture.posture.manifold.feasible_start import Projector
from impact_posture.posture.program import posture_nlp as nlp
from impact_posture.posture.program.constrained_problem import ConstrainedProblem
from impact_posture.posture.search.multistart import PostureSolution, solve
from impact_posture_cli.argv import put_right
from tests.posture.test_posture import walk
from tests.support.command import run, succeed
from tests.support.helpers import relative, rng
from tests.support.pinocchio_values import central_gradient
from tests.support.settings import make_settings

CASES: dict[str, dict[str, object]] = {
    "fixed": {"robot": "kinova", "normal": (0, 0, 1), "contact_pose": "position", "objective": "sticking"},
    "floating": {"robot": "tilthex_arm", "normal": (0, 0, 1)},
    "standing": {"robot": "solo12", "normal": (1, 0, 0)},
    "cone": {"robot": "tilthex_arm", "normal": (0, 0, 1), "normal_cone": 20.0},
    "separate": {"robot": "ur5", "normal": (0, 0, 1), "contact_pose": "full"},
}
EVERY = pytest.mark.parametrize("case", CASES)


@cache
def solved(case: str) -> tuple[PostureSolution, TradeOff]:
    solution = solve(prepare(make_settings(CASES[case])).problem, starts=16, jobs=1)
    return solution, pareto_front(solution, 10)


def moved(problem: ConstrainedProblem, q: np.ndarray, start: np.ndarray) -> float:
    """Return the distance by an independent formula; for a joint given by cosine and sine, use the chord."""
    step = np.array(q[-(problem.robot.nq - 7) :] - start[7:] if problem.robot.floating else q - start)
    base = 0.0
    if problem.robot.floating:
        turn = np.linalg.norm(pin.Quaternion(q[3:7]).matrix() - pin.Quaternion(start[3:7]).matrix()) ** 2
        # A rotation by Δ satisfies |R − R'|² = 4 (1 − cos Δ) and 4 sin²(Δ/2) = 2 (1 − cos Δ).
        base = float(np.sum((q[:3] - start[:3]) ** 2) + turn / 2)
    return float(np.sqrt(step @ step + base))


@pytest.mark.parametrize("case", ["fixed", "floating"])
def test_a_solve_goes_on_from_the_end_of_the_one_before(case: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the multipliers of the previous solve, the curve is the same but needs more iterations."""
    iterations: list[int] = []
    curves: list[list[float]] = []
    solution = solve(prepare(make_settings(CASES[case])).problem, starts=4, jobs=1)
    one_solve = nlp.PostureNLP.solve
    for warm in (True, False):
        taken: list[int] = []

        def run_and_count(
            self: nlp.PostureNLP, start: np.ndarray, *, goes_on: bool = warm, taken: list[int] = taken, **options: Any
        ) -> nlp.SolveRecord:
            record = one_solve(self, start, **options | ({} if goes_on else {"warm": None}))
            taken.append(record.iterations)
            return record

        monkeypatch.setattr(nlp.PostureNLP, "solve", run_and_count)
        curve = pareto_front(solution, 10, compile="never")
        iterations.append(sum(taken))
        curves.append([point.objective for point in curve.points])
    assert iterations[0] < iterations[1]
    np.testing.assert_allclose(curves[0], curves[1], rtol=1e-6)


# ---- the distance -----------------------------------------------------------------------------------------------


@cache
def all_joints() -> pin.Model:
    """Return a chain of all joint types of Pinocchio's URDF parser, and two more types."""
    model, parent = pin.Model(), 0
    kinds = [pin.JointModelFreeFlyer(), pin.JointModelRUBX(), pin.JointModelRX(), pin.JointModelPlanar()]
    kinds += [pin.JointModelPZ(), pin.JointModelSpherical(), pin.JointModelTranslation()]
    for number, kind in enumerate(kinds):
        parent = model.addJoint(parent, kind, pin.SE3.Random(), f"joint{number}")
        model.appendBodyToJoint(parent, pin.Inertia.Random(), pin.SE3.Identity())
    return model


@pytest.mark.parametrize("seed", range(3))
def test_distance_is_the_tangent_norm_of_small_moves_and_has_the_right_gradient(seed: int) -> None:
    model, generator = all_joints(), rng("distance", seed)
    chart = Chart(model)
    q, p = (np.array(pin.integrate(model, pin.neutral(model), generator.normal(size=model.nv))) for _ in range(2))
    near = np.array(pin.integrate(model, q, 1e-3 * generator.normal(size=model.nv)))
    assert distance(chart, near, q) == pytest.approx(np.linalg.norm(pin.difference(model, q, near)), rel=1e-5)
    # A quaternion and its negative describe the same posture.
    assert distance(chart, q, q) == pytest.approx(0, abs=1e-7)
    other = q.copy()
    other[3:7] *= -1
    assert distance(chart, p, other) == pytest.approx(distance(chart, p, q), rel=1e-12)
    expected = central_gradient(lambda x: distance(chart, x, p) ** 2, model, q, 1e-3)
    assert relative(distance_gradient(chart, q, p), expected) < 1e-8


# ---- the curve --------------------------------------------------------------------------------------------------


@pytest.mark.long(but=("standing", "cone", "floating"))
@EVERY
def test_the_curve_falls_from_the_initial_posture_to_the_optimum(case: str) -> None:
    solution, curve = solved(case)
    objective = solution.problem.objective
    first, last = curve.points[0], curve.points[-1]
    assert len(curve.points) == 11
    np.testing.assert_array_equal(first.q, solution.initial)
    assert first.within == first.distance == 0
    assert last.objective <= objective.value(solution.q) * (1 + 1e-9)
    assert last.within == pytest.approx(moved(solution.problem, solution.q, solution.initial), rel=1e-6)
    assert last.objective < 0.95 * first.objective
    steps = np.diff([p.within for p in curve.points])
    np.testing.assert_allclose(steps, steps[0], rtol=1e-9)
    for before, after in pairwise(curve.points):
        assert after.objective <= before.objective + 1e-8 * first.objective
    assert not curve.notes


@EVERY
def test_every_point_is_certified_and_has_the_stated_values(case: str) -> None:
    solution, curve = solved(case)
    projector = Projector(solution.problem)
    for point in curve.points:
        quantities = solution.problem.impact.oracle.quantities(point.q)
        assert (point.H, point.G, point.V, point.S) == (quantities.H, quantities.G, quantities.V, quantities.S)
        assert point.objective == solution.problem.objective.value(point.q)
        assert point.distance == pytest.approx(moved(solution.problem, point.q, solution.initial), abs=1e-6)
        assert point.distance <= point.within + 1e-7
        assert np.abs(projector.residual(point.q)[0]).max() < 1e-8
        assert np.abs(projector.clip(point.q) - point.q).max() < 1e-9
        assert point.certified
        if point.within:
            assert point.certificate.holds()


@pytest.mark.parametrize("case", ["floating", "cone"])
def test_no_posture_of_a_null_space_of_one_dimension_is_better(case: str) -> None:
    """Brute force covers every posture connected to the initial posture."""
    solution, curve = solved(case)
    problem, start = solution.problem, solution.initial
    assert solution.redundancy == 1
    line = walk(problem, start, 0.01, 250) + walk(problem, start, -0.01, 250)
    away = np.array([moved(problem, q, start) for q in line])
    values = np.array([problem.objective.value(q) for q in line])
    assert away.max() > curve.points[-1].within and len(line) > 200
    for point in curve.points:
        best = values[away <= point.within].min()
        assert point.objective <= best * (1 + 1e-9)
        # The objective is also not too low.  The walk may exceed the distance by 0.01, and the minimum of the walk
        # may exceed it by half of this value.
        assert point.objective >= values[away <= point.within + 0.011].min() - 1e-5 * values.max()


def test_no_feasible_neighbor_within_the_distance_is_better() -> None:
    solution, curve = solved("standing")
    problem, generator = solution.problem, rng("neighbors")
    projector, model = Projector(problem), problem.robot.model
    compared = 0
    for point in curve.points[1:-1]:
        for _ in range(12):
            # Half of the steps point towards the initial posture, because most random steps would exceed the
            # distance.
            inward = 0.03 * pin.difference(model, point.q, solution.initial)
            step = generator.normal(size=model.nv) * 0.01 + generator.integers(2) * inward
            there = projector.project(pin.integrate(model, point.q, step), tolerance=1e-12)
            if there.violation < 1e-9 and moved(problem, there.q, solution.initial) <= point.within:
                compared += 1
                assert problem.objective.value(there.q) >= point.objective * (1 - 1e-7)
    assert compared >= 40


def test_parts_that_are_not_convex_are_there() -> None:
    """A penalty on the distance would skip the non-convex parts of the curve."""
    _, curve = solved("fixed")
    y = np.array([p.objective for p in curve.points])
    bulge = y[1:-1] - (y[:-2] + y[2:]) / 2
    assert bulge.max() > 0.01 * y[0]
    assert (np.diff(y) <= 1e-8 * y[0]).all()


def test_separate_postures_make_steps() -> None:
    """Without redundancy, only a few postures are feasible, so a little more distance often does not help."""
    solution, curve = solved("separate")
    assert solution.redundancy == 0
    idle = [p for p in curve.points if p.distance < 0.9 * p.within]
    assert len(idle) >= 3
    assert all(p.certified for p in idle)


def test_one_program_serves_all_distances(monkeypatch: pytest.MonkeyPatch) -> None:
    solution, _ = solved("floating")
    built = []

    def count(*arguments: object, **more: object) -> nlp.PostureNLP:
        built.append(arguments)
        return nlp.build_nlp(*arguments, **more)  # type: ignore[arg-type]

    monkeypatch.setattr(follow, "build_nlp", count)
    seen: list[tuple[int, int]] = []
    curve = pareto_front(solution, 4, progress=lambda done, total: seen.append((done, total)))
    assert len(built) == 1 and curve.solves >= 7
    assert all(0 < done <= total for done, total in seen) and len(seen) == 7


def test_regularization_gives_way_to_the_bound() -> None:
    settings = make_settings({**CASES["floating"], "regularization": 0.3})
    solution = solve(prepare(settings).problem, starts=4, jobs=1)
    curve = pareto_front(solution, 4)
    far = solved("floating")[1].points[-1]
    last = curve.points[-1]
    assert last.within < 0.9 * far.within and last.objective > 1.01 * far.objective
    assert last.objective == pytest.approx(solution.problem.objective.value(solution.q), rel=1e-9)
    assert all(p.certified for p in curve.points) and not curve.notes


def test_nothing_to_trade_at_an_optimum() -> None:
    solution, _ = solved("floating")
    settings = {**CASES["floating"], "q": tuple(float(v) for v in solution.q)}
    again = solve(prepare(make_settings(settings)).problem, starts=2, jobs=1)
    assert distance(Chart(solution.problem.robot.model), again.q, again.initial) < 1e-6
    curve = pareto_front(again)
    assert len(curve.points) == 1 and curve.points[0].certified
    assert any("nothing to trade" in note for note in curve.notes)
    assert curve.knee is None and curve.solves == 0


def test_points_that_do_not_certify_are_kept_and_named(monkeypatch: pytest.MonkeyPatch) -> None:
    solution, _ = solved("floating")
    monkeypatch.setattr(nlp, "IPOPT_OPTIONS", nlp.IPOPT_OPTIONS | {"ipopt.max_iter": 1})
    curve = pareto_front(solution, 5)
    assert len(curve.points) == 6
    failed = [p for p in curve.points if not p.certified]
    assert len(failed) >= 3
    (note,) = [n for n in curve.notes if "not certified" in n]
    assert all(f"{p.within:.3g}" in note for p in failed)
    projector = Projector(solution.problem)
    for point in curve.points:
        assert np.abs(projector.residual(point.q)[0]).max() < 1e-8 and point.distance <= point.within + 1e-7


def test_a_better_posture_than_the_optimum_is_said() -> None:
    """Replace the optimum by a farther and worse posture, as if all starts had ended at this posture."""
    solution, curve = solved("floating")
    beyond = next(
        q for q in walk(solution.problem, solution.q, 0.02, 40) + walk(solution.problem, solution.q, -0.02, 40)
        if moved(solution.problem, q, solution.initial) > curve.points[-1].within + 0.2
    )  # fmt: skip
    longer = pareto_front(replace(solution, q=beyond), 6)
    assert any("found a better posture" in note for note in longer.notes)
    assert min(p.objective for p in longer.points) == pytest.approx(curve.points[-1].objective, rel=1e-6)
    # If the permitted distance exceeds the distance of the optimum, the optimum is the best posture.
    assert longer.points[-1].distance < longer.points[-1].within - 0.1


def test_knee_only_where_the_gain_comes_early() -> None:
    t = np.linspace(0, 1, 21)
    for curve in ((1 - t) ** 2, 1 - t, 1 - t**2, 0 * t + 3, 1 + t):
        assert find_knee(3 * t, 5 * curve) is None
    for curve in (np.maximum(1 - 4 * t, 0), np.exp(-8 * t)):
        assert find_knee(3 * t, 5 * curve) == 5
    assert find_knee(np.zeros(1), np.ones(1)) is None


def test_no_points_are_refused() -> None:
    with pytest.raises(InputError, match="points: is"):
        pareto_front(solved("floating")[0], 0)


# ---- the command line -------------------------------------------------------------------------------------------


BASE = ("optimize", "tilthex_arm", "--normal", 0, 0, 1, "--starts", 2, "--jobs", 1, "--no-codegen")


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    folder = tmp_path_factory.mktemp("tradeoff")
    done = succeed(*BASE, "--format", "png", "--tradeoff", 6, cwd=folder, pictures=("tradeoff",))
    return folder / "tilthex_arm-ee", done.stdout


def test_the_folder_holds_the_curve(written: tuple[Path, str]) -> None:
    folder, text = written
    document = json.loads((folder / "result.json").read_text())
    points = document["tradeoff"]
    assert len(points) == 7
    keys = {"within", "distance", "objective", "H", "G", "V", "S", "q", "certified", "knee"}
    assert all(set(point) == keys for point in points)
    assert points[0]["q"] == document["initial"]["q"] and points[0]["objective"] == document["initial"]["objective"]
    assert points[-1]["objective"] == pytest.approx(document["optimal"]["objective"], rel=1e-9)
    assert all(point["certified"] for point in points)
    with np.load(folder / "result.npz") as arrays:
        np.testing.assert_array_equal(arrays["tradeoff_q"], [p["q"] for p in points])
        for name in ("within", "distance", "objective", "H", "G", "V", "S", "certified"):
            np.testing.assert_array_equal(arrays[f"tradeoff_{name}"], [p[name] for p in points])
    assert (folder / "tradeoff.png").stat().st_size > 8000
    assert "tradeoff = 6" in (folder / "problem.toml").read_text()
    lines = [line for line in text.splitlines() if "%" in line and line.startswith("   ")]
    assert len(lines) == 7 and "100.0%" in lines[-1]
    assert max(len(line.rstrip()) for line in text.splitlines()) <= 80


def test_the_curve_is_drawn_again_and_only_where_there_is_one(written: tuple[Path, str], tmp_path: Path) -> None:
    folder, _ = written
    arguments = ("--figure", "tradeoff", "--format", "png", "--out", tmp_path)
    succeed("plot", folder, *arguments, cwd=tmp_path, pictures=("tradeoff",))
    assert (tmp_path / "tradeoff.png").read_bytes() == (folder / "tradeoff.png").read_bytes()
    plain = tmp_path / "plain"
    shutil.copytree(folder, plain)
    document = json.loads((plain / "result.json").read_text())
    del document["tradeoff"]
    (plain / "result.json").write_text(json.dumps(document))
    refused = run("plot", plain, *arguments, cwd=tmp_path, pictures=("tradeoff",))
    assert refused.returncode == 1 and "--tradeoff" in refused.stderr and "Traceback" not in refused.stderr
    negative = run(*BASE, "--tradeoff", -1, cwd=tmp_path)
    assert negative.returncode == 2 and "--tradeoff" in negative.stderr


def test_the_number_may_be_left_out() -> None:
    default = str(TRADEOFF_POINTS)
    assert put_right(["optimize", "--tradeoff", "ur5"]) == ["optimize", "--tradeoff", default, "ur5"]
    assert put_right(["ur5", "--tradeoff", "--json"]) == ["ur5", "--tradeoff", default, "--json"]
    assert put_right(["ur5", "--tradeoff"]) == ["ur5", "--tradeoff", default]
    for argv in (["--tradeoff", "5"], ["--tradeoff=5"], ["--tradeoff", "-1"], ["--tradeoff", "2.5"], ["--trade"], []):
        assert put_right(argv) == argv
