"""Uncertain models in the C export and on the command line."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from impact_posture.codegen.c_literals import DOUBLE, FLOAT, Real
from impact_posture.codegen.export import export
from impact_posture.codegen.impact_gradient import ImpactGradient
from impact_posture.codegen.self_test import sample_postures
from impact_posture.system.libraries import build_library, library_path
from tests.posture.test_model_variants import MORE, objective_of
from tests.support.command import run, succeed
from tests.support.helpers import assert_close
from tests.support.tools import need_compiler

# ---- the C export -------------------------------------------------------------------------------------------------


@pytest.mark.long(but=("cone-real0",))
@pytest.mark.parametrize(("kind", "real"), [("cone", DOUBLE), ("contacts", FLOAT)])
def test_export_has_the_worst_model_variant(tmp_path: Path, kind: str, real: Real) -> None:
    need_compiler()
    objective = objective_of("tilthex_arm", MORE[kind])
    objective = replace(objective, model_variants=objective.model_variants[::4])
    written = export(objective, tmp_path, prefix="arm", real=real, check=False)
    assert [s["name"] for s in written.manifest["scenarios"]] == [s.name for s in objective.model_variants]
    assert written.manifest["model_sha256"] == objective.robot.model_sha256
    header = (tmp_path / "arm.h").read_text()
    assert "armature x 0.4, 0.8 kg at ee" in " ".join(header.replace("*", " ").split())
    build_library(tmp_path, "arm", library_path(tmp_path, "arm"), ("-O0",))
    loaded = ImpactGradient.load(tmp_path, robot=objective.robot)
    tolerance = 1e-9 if real is DOUBLE else 1e-4
    for q in sample_postures(objective.robot, 5, 1):
        value, gradient = loaded.objective(q)
        assert_close(value, objective.value(q), tolerance, "value")
        assert_close(gradient, objective.gradient(q), 10 * tolerance, "gradient", scale=value)
        H, _ = loaded.value_and_gradient(q, objective.contact.normal)
        assert_close(H, objective.oracle.quantities(q).H, tolerance, "H of the robot without variants")


# ---- the command line ---------------------------------------------------------------------------------------------


def test_optimize(tmp_path: Path) -> None:
    done = succeed(
        "optimize", "tilthex_arm", "--contact", "ee:0,0,1", "--contact", "base_link:1,0,0:2",
        "--armature-range", 0.5, 2, "--payload", "base_link", 0.5,
        "--starts", 1, "--jobs", 1, "--no-codegen", "--format", "png", cwd=tmp_path,
    )  # fmt: skip
    lines = done.stdout.splitlines()
    assert max(map(len, lines)) <= 80
    (row,) = [line for line in lines if line.startswith("  armature × 0.5, 0.5 kg at base_link ")]
    assert len(row.split()) >= 9, "its name and both values in one row"
    assert "the optimum moves by" in done.stdout and "←" in done.stdout
    document = json.loads((tmp_path / "tilthex_arm-ee" / "result.json").read_text())
    assert len(document["scenarios"]) == 6 and len(document["robustness"]["scenarios"]) == 6
    robustness, optimal = document["robustness"], document["optimal"]
    assert robustness["worst_robust"] == pytest.approx(optimal["objective"], rel=1e-12)
    assert optimal["worst_scenario"] in [s["name"] for s in document["scenarios"]]
    assert robustness["between"]["drawn"] == 60
    assert [c["impulse_bound"] for c in document["contacts"]] == [1.0, 2.0] and "up to 2 N·s" in done.stdout
    worst = optimal["worst_impulses"]
    assert worst["jump_norm"] ** 2 == pytest.approx(optimal["objective"], rel=1e-9), "of the worst model variant"
    assert "worst impulses after: 1 N·s at ee" in done.stdout
    assert robustness["line"] in " ".join(done.stdout.split())


def test_bad_input(tmp_path: Path) -> None:
    for arguments, code, text in (
        (("--payload", "ee", "heavy"), 2, "is not a payload"),
        (("--payload", "ee", -1), 2, "above zero"),
        (("--armature-range", 2, 0.5), 2, "the lower first"),
        (("--armature-range", 0.5, "nan"), 2, "two factors"),
        (("--payload", "ee", 1, "--payload", "ee", 1), 1, "given twice"),
    ):
        done = run("evaluate", "tilthex_arm", "--normal", 0, 0, 1, *arguments, cwd=tmp_path)
        assert done.returncode == code and "Traceback" not in done.stderr
        assert text in " ".join(done.stderr.split())
