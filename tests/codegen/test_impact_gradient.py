"""The compiled export in Python: numbers, views, batches, errors and threads."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from impact_posture.codegen.c_literals import DOUBLE, FLOAT, Real
from impact_posture.codegen.export import export
from impact_posture.codegen.impact_gradient import ImpactGradient
from impact_posture.codegen.self_test import sample_postures
from impact_posture.config.problem_settings import LoadOptions
from impact_posture.errors import (
    CompilerError,
    FrameNotFound,
    InputError,
    ManifestMismatch,
    MetricError,
    PostureError,
    SpecError,
)
from impact_posture.impact.impact_contact import ImpactContact
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.robot.robot_loader import load_robot
from impact_posture.system.toolchain import find_compiler

UNIT = np.array([0.6, 0.0, 0.8])
FRAMES = ("ee", "base_link")


@dataclass(frozen=True)
class Loaded:
    objectives: tuple[WorstCaseObjective, ...]
    gradient: ImpactGradient
    folder: Path
    tolerance: float


@pytest.fixture(scope="module", params=[DOUBLE, FLOAT], ids=["double", "float"])
def loaded(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Loaded]:
    if find_compiler() is None:
        pytest.skip("no C compiler (cc, gcc, clang)")
    real: Real = request.param
    robot = load_robot("tilthex_arm")
    objectives = tuple(WorstCaseObjective(robot, ImpactContact(f, (0, 0.6, 0.8)), kind="speed") for f in FRAMES)
    folder = tmp_path_factory.mktemp(real.name)
    export(objectives, folder, prefix="arm", real=real, check=False)
    assert not (folder / "libarm.so").exists()
    gradient = ImpactGradient.load(folder, robot=robot)
    assert (folder / "libarm.so").is_file(), "load builds the library where there is none"
    yield Loaded(objectives, gradient, folder, 1e-11 if real is DOUBLE else 1e-3)


def close(values: object, expected: object, tolerance: float) -> None:
    expected = np.asarray(expected, dtype=float)
    np.testing.assert_allclose(np.asarray(values), expected, rtol=0, atol=tolerance * np.abs(expected).max())


@pytest.mark.parametrize("k", range(len(FRAMES)))
def test_every_function_against_pinocchio(loaded: Loaded, k: int) -> None:
    objective = loaded.objectives[k]
    gradient = ImpactGradient.load(loaded.folder / "arm.json", frame=FRAMES[k])
    assert gradient.frame == FRAMES[k]
    turned = replace(objective, contact=replace(objective.contact, normal=(0.6, 0.0, 0.8)), kind="impulse")
    for q in sample_postures(objective.robot, 3, 21):
        expected = turned.oracle.quantities(q)
        H, grad = gradient.value_and_gradient(q, UNIT)
        close(H, expected.H, loaded.tolerance)
        close(grad, turned.oracle.gradient_H(q), loaded.tolerance)
        close(gradient.value(q, UNIT), expected.H, loaded.tolerance)
        value, own = gradient.objective(q)
        close(value, objective.value(q), loaded.tolerance)
        close(own, objective.gradient(q), 10 * loaded.tolerance)
        a, G, V = gradient.jump(q, UNIT)
        close(a, expected.jump, loaded.tolerance)
        close([G, V], [expected.G, expected.V], loaded.tolerance)
        close(gradient.ellipsoid(q), expected.ellipsoid, loaded.tolerance)


def test_results_are_views_that_the_next_call_overwrites(loaded: Loaded) -> None:
    one, other = sample_postures(loaded.objectives[0].robot, 2, 22)
    gradient = loaded.gradient.copy()
    _, first = gradient.value_and_gradient(one, UNIT)
    kept = first.copy()
    _, second = gradient.value_and_gradient(other, UNIT)
    assert second is first
    assert not np.array_equal(first, kept)
    _, own = gradient.objective(one)
    np.testing.assert_array_equal(second, first)
    assert not np.shares_memory(own, second)
    elsewhere = gradient.copy().value_and_gradient(one, UNIT)[1]
    assert not np.shares_memory(elsewhere, first)


@pytest.mark.parametrize("count", [0, 7, 200])
def test_batches(loaded: Loaded, count: int) -> None:
    gradient, robot = loaded.gradient, loaded.objectives[0].robot
    q = np.array(sample_postures(robot, count, 23)).reshape(count, robot.nq)
    n = np.random.default_rng(3).normal(size=(count, 3))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    H, grad = gradient.value_and_gradient_batch(q, n)
    assert H.shape == (count,) and grad.shape == (count, robot.nv)
    # A batch adds terms in another order than a single call, so the results differ by rounding.
    tolerance = 1e-12 if gradient.dtype == np.float64 else 1e-5
    for k in range(count):
        value, row = gradient.value_and_gradient(q[k], n[k])
        assert H[k] == pytest.approx(value, rel=tolerance)
        close(grad[k], row, tolerance)
    out = np.empty(count, gradient.dtype), np.empty((count, robot.nv), gradient.dtype)
    written = gradient.value_and_gradient_batch(q, UNIT, out)
    assert written[0] is out[0] and written[1] is out[1]
    for k in range(min(count, 8)):
        assert out[0][k] == pytest.approx(gradient.value(q[k], UNIT), rel=1e-5)
    values, rows = gradient.objective_batch(q)
    for k in range(count):
        value, row = gradient.objective(q[k])
        assert values[k] == value and rows[k].tolist() == row.tolist()


def test_exports_of_earlier_versions_lack_a_batch_of_the_objective(loaded: Loaded) -> None:
    gradient = loaded.gradient
    frames = [
        {**f, "symbols": {k: v for k, v in f["symbols"].items() if k != "objective_batch"}}
        for f in gradient.manifest["frames"]
    ]
    earlier = ImpactGradient(gradient._library, {**gradient.manifest, "frames": frames})
    q = loaded.objectives[0].robot.posture()
    assert earlier.objective(q)[0] == gradient.objective(q)[0]
    with pytest.raises(SpecError, match="run codegen again"):
        earlier.objective_batch(q[None])


def test_a_bad_row_spoils_no_other(loaded: Loaded) -> None:
    gradient, robot = loaded.gradient, loaded.objectives[0].robot
    q = np.array(sample_postures(robot, 5, 24))
    good, _ = gradient.value_and_gradient_batch(q, UNIT)
    q[1, -1] = np.nan
    q[3, 3:7] *= 2
    H, grad = gradient.value_and_gradient_batch(q, UNIT)
    assert np.isnan(H).tolist() == [False, True, False, True, False]
    np.testing.assert_array_equal(np.isnan(grad).all(axis=1), np.isnan(H))
    np.testing.assert_array_equal(H[::2], good[::2])


def test_bad_inputs(loaded: Loaded) -> None:
    gradient, robot = loaded.gradient, loaded.objectives[0].robot
    q = robot.posture()
    with pytest.raises(InputError, match="not finite"):
        gradient.value_and_gradient(q, [np.nan, 0, 1])
    twice = q.copy()
    twice[3:7] *= 2
    for call in (gradient.objective, gradient.ellipsoid):
        with pytest.raises(PostureError, match="unit norm"):
            call(twice)
    with pytest.raises(PostureError, match="unit norm"):
        gradient.jump(twice, UNIT)
    with pytest.raises(PostureError, match="unit norm"):
        gradient.value(twice, UNIT)
    with pytest.raises(MetricError, match="not finite"):
        gradient.jump(q, np.zeros(3))  # G = 0
    with pytest.raises(ValueError, match=f"q has length {len(q) - 1}, not {len(q)}"):
        gradient.value_and_gradient(q[:-1], UNIT)
    with pytest.raises(InputError, match=r"q: has shape \(\d+,\)"):
        gradient.value_and_gradient_batch(q, UNIT)
    with pytest.raises(InputError, match=r"n: has shape \(2, 3\)"):
        gradient.value_and_gradient_batch(q[None], np.zeros((2, 3)))
    with pytest.raises(InputError, match="out: has shape"):
        gradient.value_and_gradient_batch(q[None], UNIT, (np.empty(2), np.empty((1, robot.nv))))


def test_threads_with_objects_of_their_own(loaded: Loaded) -> None:
    robot = loaded.objectives[0].robot
    q = np.array(sample_postures(robot, 400, 25))
    expected = loaded.gradient.value_and_gradient_batch(q, UNIT)

    def run(own: ImpactGradient) -> tuple[np.ndarray, np.ndarray]:
        results = [(H, grad.copy()) for H, grad in (own.value_and_gradient(row, UNIT) for row in q)]
        return np.array([r[0] for r in results]), np.array([r[1] for r in results])

    with ThreadPoolExecutor(4) as pool:
        for H, grad in pool.map(run, [loaded.gradient.copy() for _ in range(4)]):
            np.testing.assert_allclose(H, expected[0], rtol=1e-6)
            close(grad, expected[1], 1e-6)


def test_no_casadi_and_no_pinocchio(loaded: Loaded) -> None:
    program = (
        "import sys\nfrom impact_posture.codegen.impact_gradient import ImpactGradient\n"
        "g = ImpactGradient.load(sys.argv[1])\nt = g.manifest['self_test']\n"
        "g.value_and_gradient(t['q'], t['n'])\n"
        "assert not {'casadi', 'pinocchio', 'scipy'} & set(sys.modules), 'heavy'\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program, str(loaded.folder)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


# ---- refusals -----------------------------------------------------------------------------------------------------


def test_another_robot_is_refused_by_name(loaded: Loaded) -> None:
    robot = loaded.objectives[0].robot
    with pytest.raises(ManifestMismatch, match="joint 0 is") as caught:
        ImpactGradient.load(loaded.folder, robot=load_robot("panda"))
    assert caught.value.exported == robot.joint_names[0]
    last = robot.joint_names[-1]
    with pytest.raises(ManifestMismatch, match=rf"armature of {last} is") as caught:
        ImpactGradient.load(loaded.folder, robot=load_robot("tilthex_arm", LoadOptions(armature={last: 0.5})))
    assert caught.value.found == 0.5


def test_changed_manifests_are_refused(loaded: Loaded, tmp_path: Path) -> None:
    folder, robot = shutil.copytree(loaded.folder, tmp_path / "c"), loaded.objectives[0].robot
    manifest, names = json.loads((folder / "arm.json").read_text()), list(robot.joint_names)
    frames = json.loads(json.dumps(manifest["frames"]))
    frames[0]["self_test"]["H"] *= 1.5
    for key, value, message in (
        ("convention", "q = w first", "convention is 'q = w first' in the export"),
        ("model_sha256", "0" * 64, "model_sha256 (inertias, placements or axes)"),
        ("joint_names", [*names[:-2], *names[:-3:-1]], f"joint {len(names) - 2} is '{names[-1]}' in the export"),
        ("frames", frames, "the manifest's hash is"),
    ):
        (folder / "arm.json").write_text(json.dumps(manifest | {key: value}))
        with pytest.raises(ManifestMismatch) as caught:
            ImpactGradient.load(folder, robot=robot)
        assert message in caught.value.line and "\n" not in caught.value.line


def test_library_that_computes_other_numbers(loaded: Loaded, tmp_path: Path) -> None:
    folder = shutil.copytree(loaded.folder, tmp_path / "c", ignore=shutil.ignore_patterns("lib*"))
    source = (folder / "arm.c").read_text()
    (folder / "arm.c").write_text(source.replace("  *H = ", "  *H = 2 * "))
    with pytest.raises(ManifestMismatch, match="reference value of H"):
        ImpactGradient.load(folder)


def test_folders_without_a_valid_export_are_refused(
    loaded: Loaded, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(SpecError, match="contains no export"):
        ImpactGradient.load(tmp_path)
    with pytest.raises(SpecError, match="no such file"):
        ImpactGradient.load(tmp_path / "absent.json")
    (tmp_path / "other.json").write_text("{}")
    with pytest.raises(SpecError, match="is not a manifest"):
        ImpactGradient.load(tmp_path / "other.json")
    with pytest.raises(FrameNotFound, match="did you mean"):
        ImpactGradient.load(loaded.folder, frame="eee")
    folder = shutil.copytree(loaded.folder, tmp_path / "c")
    (folder / "libarm.so").write_text("no library")
    with pytest.raises(SpecError, match="another SHA-256"):
        ImpactGradient.load(folder)
    (folder / "libarm.so").unlink()
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CC", raising=False)
    with pytest.raises(CompilerError, match=r"no C compiler found.*install gcc"):
        ImpactGradient.load(folder)
