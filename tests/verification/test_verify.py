"""``verify``: agreement passes, an injected difference fails in its table row, and missing sources are skipped."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from impact_posture.codegen.compile_and_check import deviation
from impact_posture.config.problem_settings import ImpactSettings
from impact_posture.dynamics.chart import Chart
from impact_posture.errors import InputError
from impact_posture.impact.resolved_impact import resolve
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.system.toolchain import find_compiler
from impact_posture.verification import verification as module
from impact_posture.verification.quantity_sources import (
    Numbers,
    PostureSample,
    casadi_source,
    difference_gradient,
    pinocchio_numbers,
    random_samples,
)
from impact_posture.verification.verification import (
    CASADI,
    COMPILED,
    DIFFERENCES,
    MUJOCO,
    VerificationReport,
    VerificationRow,
    verify,
)
from tests.dynamics.test_dynamics import write_urdf
from tests.support.command import run
from tests.support.helpers import NAMES, Vector, robot
from tests.support.urdfs import joint, link, write

QUANTITIES = ["H", "G", "Λ_c", "∇H"]
HAS_MUJOCO = importlib.util.find_spec("mujoco") is not None


def objective(name: str, **more: Any) -> WorstCaseObjective:
    return resolve(ImpactSettings(robot=name, normal=(0.3, -0.2, 1.0), **more)).objective


def rows_of(report: VerificationReport, source: str) -> list[VerificationRow]:
    return [row for row in report.rows if row.source == source]


def assert_all_there(report: VerificationReport) -> None:
    """Check that every available source of values computed all its quantities and passed."""
    available = {CASADI: QUANTITIES, DIFFERENCES: ["∇H"]}
    if find_compiler() is not None:
        available[COMPILED] = QUANTITIES
    if HAS_MUJOCO:
        available[MUJOCO] = ["M", "J", *QUANTITIES]
    for source in (CASADI, COMPILED, DIFFERENCES, MUJOCO):
        rows = rows_of(report, source)
        if source in available:
            assert [row.quantity for row in rows] == available[source]
            assert all(row.verdict == "pass" for row in rows), rows
            assert all(row.error is not None and row.error <= (row.tolerance or 0) for row in rows)
        else:
            assert [row.verdict for row in rows] == ["skipped"]
    assert report.passed


# ---- agreement ---------------------------------------------------------------------------------------------------


@pytest.mark.long(but=("tilthex_arm", "panda"))
@pytest.mark.parametrize("name", ["solo8", "tilthex_arm", "panda"])
def test_known_robots_pass(name: str) -> None:
    assert_all_there(verify(objective(name), samples=2))


@pytest.mark.long(but=("bolt-more1", "tilthex_arm-more2", "ur5-more3"))
@pytest.mark.parametrize(
    ("name", "more"),
    [
        ("solo8", {"metric": "kinetic", "normal_frame": "contact", "offset": (0.1, 0.0, -0.05)}),
        ("bolt", {"metric": "kinetic", "frame": "base_link"}),
        ("tilthex_arm", {"metric": "weighted", "weights": "velocity-limits", "normal_frame": "contact"}),
        ("ur5", {"armature": {"elbow_joint": 0.2}, "lock": ("wrist_3_joint",)}),
    ],
)
def test_metrics_normal_frames_and_options_pass(name: str, more: dict[str, Any]) -> None:
    assert_all_there(verify(objective(name, **more), samples=1, seed=3))


@pytest.mark.parametrize("root", ["free-flyer", "fixed"])
def test_a_urdf_of_a_user_passes(tmp_path: Path, root: Any) -> None:
    joints = [("planar", "0 0 1"), ("continuous", "1 2 3"), ("prismatic", "0 -1 0"), ("fixed", "")]
    path = write_urdf(tmp_path / "odd.urdf", [*joints, ("revolute", "1 0 0")])
    assert_all_there(verify(objective(str(path), frame="l5", root=root), samples=1))


def test_a_contact_with_one_direction_of_motion_passes(tmp_path: Path) -> None:
    path = write_urdf(tmp_path / "one.urdf", [("revolute", "0 0 1")])
    assert_all_there(verify(objective(str(path), frame="l1", offset=(0.3, 0.0, 0.0)), samples=3))


@pytest.mark.parametrize("joints", [1, 3])
def test_an_impact_across_the_plane_of_a_planar_robot_passes(tmp_path: Path, joints: int) -> None:
    """G and H are exactly zero, so V is undefined.  All compared quantities are defined."""
    parts = [link(f"l{k}", 1) for k in range(joints + 1)]
    parts += [joint(f"j{k}", f"l{k} l{k + 1}", "0 0 1", "0.5 0 0", "continuous", "") for k in range(joints)]
    options = {"frame": f"l{joints}", "normal": (0, 0, 1), "offset": (0.5, 0, 0)}
    planar = resolve(ImpactSettings(robot=str(write(tmp_path, *parts)), **options)).objective
    report = verify(planar, samples=1)
    assert planar.oracle.quantities(report.samples[0].q).G == 0.0
    assert_all_there(report)


# ---- differences -------------------------------------------------------------------------------------------------


def test_another_armature_fails_in_its_source(monkeypatch: pytest.MonkeyPatch) -> None:
    wrong = objective("ur5", armature={"elbow_joint": 1e-5})
    monkeypatch.setattr(module, "casadi_source", lambda _: casadi_source(wrong))
    monkeypatch.setattr(module, "find_compiler", lambda: None)
    report = verify(objective("ur5", armature="none"), samples=1)
    assert {row.verdict for row in rows_of(report, CASADI)} == {"fail"}
    assert {row.verdict for row in rows_of(report, DIFFERENCES)} == {"pass"}
    assert not report.passed


def altered(how: Any) -> Any:
    """Return a source of values: the values of Pinocchio, modified by ``how(number of the sample, values)``."""

    def build(objective: WorstCaseObjective) -> Any:
        count = iter(range(100))

        def numbers(sample: PostureSample) -> Numbers:
            values = {k: np.array(v) for k, v in pinocchio_numbers(objective, sample).values.items()}
            how(next(count), values)
            return Numbers(values)

        return numbers

    return build


def test_the_worst_sample_and_entry_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def spoil(k: int, values: dict[str, Vector]) -> None:
        if k == 1:
            values["∇H"][4] += 1e-3 * np.abs(values["∇H"]).max()
            values["Λ_c"][0, 2] += 1e-4 * np.abs(values["Λ_c"]).max()
        if k == 2:
            values["∇H"][2] += 1e-5 * np.abs(values["∇H"]).max()

    monkeypatch.setattr(module, "casadi_source", altered(spoil))
    monkeypatch.setattr(module, "find_compiler", lambda: None)
    rows = {row.quantity: row for row in rows_of(verify(objective("ur5"), samples=3), CASADI)}
    joint = robot("ur5").tangent_names[4]
    assert (rows["∇H"].verdict, rows["∇H"].sample, rows["∇H"].entry) == ("fail", 1, joint)
    assert rows["∇H"].error == pytest.approx(1e-3)
    assert (rows["Λ_c"].verdict, rows["Λ_c"].sample, rows["Λ_c"].entry) == ("fail", 1, "xz")
    assert rows["Λ_c"].error == pytest.approx(1e-4)
    assert rows["H"].verdict == rows["G"].verdict == "pass"


def test_numbers_that_are_not_finite_fail(monkeypatch: pytest.MonkeyPatch) -> None:
    def spoil(k: int, values: dict[str, Vector]) -> None:
        if k == 0:
            values["∇H"][3] = np.inf

    monkeypatch.setattr(module, "casadi_source", altered(spoil))
    monkeypatch.setattr(module, "find_compiler", lambda: None)
    report = verify(objective("ur5"), samples=2)
    (row,) = [row for row in rows_of(report, CASADI) if row.quantity == "∇H"]
    assert (row.verdict, row.error, row.sample, row.note) == ("fail", None, 0, "not finite")
    json.dumps(report.to_dict(), allow_nan=False)


@pytest.mark.skipif(not HAS_MUJOCO, reason="mujoco is not installed (the extra 'sim')")
def test_another_inertia_fails_in_mujoco(monkeypatch: pytest.MonkeyPatch) -> None:
    right = objective("ur5")
    other = right.robot.model.copy()
    other.inertias[4].mass *= 1 + 1e-6
    wrong = replace(right, robot=replace(right.robot, model=other))
    real = module.MujocoSource
    monkeypatch.setattr(module, "MujocoSource", lambda _: real(wrong))
    monkeypatch.setattr(module, "find_compiler", lambda: None)
    report = verify(right, samples=1)
    verdicts = {row.quantity: row.verdict for row in rows_of(report, MUJOCO)}
    assert (verdicts["M"], verdicts["J"], verdicts["H"]) == ("fail", "pass", "fail")


@pytest.mark.skipif(not HAS_MUJOCO, reason="mujoco is not installed (the extra 'sim')")
def test_a_model_that_mujoco_refuses_fails_in_its_row(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(_: object) -> Any:
        raise InputError("MuJoCo refuses the model", where="MJCF", hint="correct it")

    monkeypatch.setattr(module, "MujocoSource", refuse)
    monkeypatch.setattr(module, "find_compiler", lambda: None)
    report = verify(objective("ur5"), samples=1)
    (row,) = rows_of(report, MUJOCO)
    assert (row.verdict, row.note) == ("fail", "MJCF: MuJoCo refuses the model; correct it")
    assert rows_of(report, CASADI)[0].verdict == "pass"


# ---- missing sources ---------------------------------------------------------------------------------------------


def test_without_mujoco_and_without_a_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mujoco", None)
    monkeypatch.setattr(module, "find_compiler", lambda: None)
    report = verify(objective("ur5"), samples=1)
    (of_mujoco,), (of_c,) = rows_of(report, MUJOCO), rows_of(report, COMPILED)
    assert of_mujoco.verdict == of_c.verdict == "skipped"
    assert of_mujoco.note == "not installed: pip install 'impact-posture[sim]'"
    assert of_c.note == "no C compiler: install gcc or clang, or set CC"
    assert report.passed


# ---- parts -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", NAMES)
def test_samples_are_within_limits_and_on_the_manifold(name: str) -> None:
    known = robot(name)
    samples = random_samples(known, 20, 5)
    for sample in samples:
        known.check_limits(sample.q)
        np.testing.assert_allclose(pin.normalize(known.model, sample.q), sample.q, atol=1e-12)
        assert np.linalg.norm(sample.normal) == pytest.approx(1)
    again, other = random_samples(known, 20, 5), random_samples(known, 20, 6)
    assert all(np.array_equal(a.q, b.q) for a, b in zip(samples, again, strict=True))
    assert not any(np.array_equal(a.q, b.q) for a, b in zip(samples, other, strict=True))
    lower, upper = Chart(known.model).bounds()
    reached = np.ptp([Chart(known.model).to_x(s.q) for s in samples], axis=0)
    width = upper - lower
    assert (reached[np.isfinite(width)] > 0.5 * width[np.isfinite(width)]).all()


def test_a_limit_missing_on_one_side() -> None:
    known = robot("ur5")
    model = known.model.copy()
    upper = model.upperPositionLimit.copy()
    upper[1] = np.inf
    model.upperPositionLimit = upper
    values = [s.q[1] for s in random_samples(replace(known, model=model), 50, 0)]
    assert min(values) >= model.lowerPositionLimit[1]
    assert max(values) <= known.posture()[1] + np.pi


def test_the_first_normal_is_the_normal_of_the_contact() -> None:
    normal, samples = objective("ur5").contact.normal, verify(objective("ur5"), samples=2).samples
    np.testing.assert_array_equal(samples[0].normal, normal)
    assert not np.allclose(samples[1].normal, normal)


def test_differences_of_a_known_function() -> None:
    model = robot("solo8").model
    q = random_samples(robot("solo8"), 1, 0)[0].q
    weights = np.linspace(-1, 2, model.nv)

    def value(at: Vector) -> float:
        step = pin.difference(model, q, at)
        return float(np.sin(weights @ step) + 100 * (step @ step) ** 2)

    np.testing.assert_allclose(difference_gradient(value, model, q), weights, rtol=1e-10, atol=1e-10)
    assert np.isnan(difference_gradient(lambda _: float("nan"), model, q)).all()
    # The function varies on a scale of 0.01, less than the first step.  Objectives of standing robots near singular
    # postures behave like this function.
    stiff = difference_gradient(lambda at: float(np.tanh(100 * weights @ pin.difference(model, q, at))), model, q)
    np.testing.assert_allclose(stiff, 100 * weights, rtol=1e-7)


def test_deviation() -> None:
    expected = np.array([[2.0, -4.0], [0.0, 1.0]])
    actual = expected + np.array([[0.0, 0.0], [0.2, 0.1]])
    assert deviation(actual, expected).index == (1, 0)
    assert deviation(actual, expected).error == pytest.approx(0.05)
    assert deviation(actual, expected, scale=40).error == pytest.approx(0.005)
    assert deviation(np.zeros(2), np.zeros(2)).error == 0
    assert deviation(np.array([0.0, 1e-30]), np.zeros(2)).error == np.inf
    for bad in (np.nan, np.inf):
        for number, other in ((bad, 1.0), (1.0, bad), (bad, bad)):
            assert deviation(np.array([1.0, number]), np.array([1.0, other])).error == np.inf


@pytest.mark.parametrize(("samples", "seed"), [(0, 0), (1, -1)])
def test_bad_counts_are_refused(samples: int, seed: int) -> None:
    with pytest.raises(InputError, match=r"^(samples|seed): "):
        verify(objective("ur5"), samples=samples, seed=seed)


def test_progress_reaches_its_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "find_compiler", lambda: None)
    steps: list[tuple[int, int]] = []
    verify(objective("ur5"), samples=2, progress=lambda done, total: steps.append((done, total)))
    total = 2 * (2 + HAS_MUJOCO)
    assert steps == [(k + 1, total) for k in range(total)]


# ---- the command -------------------------------------------------------------------------------------------------


def start(*arguments: str, **env: str) -> subprocess.CompletedProcess[str]:
    return run("verify", *arguments, env=env)


def test_the_command_prints_a_table(tmp_path: Path) -> None:
    done = start("ur5", "--samples", "1", "--seed", "4", "--quiet")
    assert (done.returncode, done.stderr) == (0, "")
    assert "ur5 at tool0" in done.stdout and "seed 4" in done.stdout
    assert all(name in done.stdout for name in (CASADI, COMPILED, DIFFERENCES, MUJOCO, "Λ_c", "∇H", "pass"))
    assert "fail" not in done.stdout
    assert max(len(line.rstrip()) for line in done.stdout.splitlines()) <= 80


def test_the_command_prints_json() -> None:
    arguments = ("solo8", "--frame", "base_link", "--contact", "base_link:0,0,1", "--samples", "2")
    assert start(*arguments).returncode == 2
    done = start("solo8", "--contact", "base_link:0,0,1", "--samples", "2", "--json")
    assert (done.returncode, done.stderr) == (0, "")
    document = json.loads(done.stdout)
    assert document["schema"] == "impact-posture/verification/1"
    assert document["passed"] is True
    assert (document["count"], document["seed"], len(document["supports"])) == (2, 0, 4)
    assert document["rows"] == [asdict(VerificationRow(**row)) for row in document["rows"]]
    first = next(s for s in document["samples"] if s["sample"] == 0)
    assert first["normal"] == [0, 0, 1]
    assert len(first["q"]) == 15


def test_a_failure_ends_with_exit_code_1_and_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from impact_posture_cli.app import app
    from impact_posture_cli.error_boundary import run

    typer_main = pytest.importorskip("typer.main")

    def spoil(_: int, values: dict[str, Vector]) -> None:
        values["G"] *= 1.001

    monkeypatch.setattr(module, "casadi_source", altered(spoil))
    monkeypatch.setattr(module, "find_compiler", lambda: None)
    command = typer_main.get_command(app)
    assert run(command, ["verify", "ur5", "--samples", "1", "--quiet"]) == 1
    shown = capsys.readouterr()
    assert "fail" in shown.out
    assert shown.err.splitlines() == ["error: ur5: numbers differ from Pinocchio: CasADi G; please report it"]
    assert run(command, ["verify", "ur5", "--samples", "1", "--json"]) == 1
    shown = capsys.readouterr()
    assert json.loads(shown.out)["passed"] is False
    assert len(shown.err.splitlines()) == 1


@pytest.mark.parametrize(
    "arguments",
    [("--samples", "0"), ("--seed", "-1"), ("--normal", "0", "0", "0"), ("--support", "x", "--no-support")],
)
def test_wrong_arguments_end_with_exit_code_2(arguments: tuple[str, ...]) -> None:
    assert start("ur5", *arguments).returncode == 2


def test_a_misspelt_frame_is_refused_in_one_line() -> None:
    done = start("ur5", "--frame", "tool")
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1].startswith("error: ") and "tool0" in done.stderr


def test_the_output_of_a_broken_compiler_is_shown(tmp_path: Path) -> None:
    broken = tmp_path / "mycc"
    broken.write_text("#!/bin/sh\necho 'mycc: error: no luck today' >&2\nexit 1\n")
    broken.chmod(0o755)
    done = start("ur5", "--samples", "1", CC=str(broken))
    assert done.returncode == 1
    assert "no luck today" in done.stderr and str(broken) in done.stderr
