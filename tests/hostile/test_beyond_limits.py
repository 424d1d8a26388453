"""Inputs that are too large or too deeply nested give an error in one line."""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import typer

from impact_posture.codegen.manifest_reader import read_manifest
from impact_posture.config.problem_settings import ImpactSettings
from impact_posture.errors import CompilerError, InputError, PostureError, SpecError, UrdfError
from impact_posture.impact.evaluation.evaluation import evaluate
from impact_posture.impact.impact_contact import ImpactContact
from impact_posture.impact.resolved_impact import resolve
from impact_posture.output.result_reader import load_view
from impact_posture.posture.analysis.result_document import SCHEMA
from impact_posture.posture.formulation.problem_file import read_settings
from impact_posture.robot.robot_loader import load_robot
from impact_posture.robot.robot_spec import read_spec
from impact_posture.robot.urdf import MOST_DEGREES_OF_FREEDOM, build_model
from impact_posture.system.toolchain import find_compiler, words_of
from impact_posture_cli.error_boundary import run
from tests.support.urdfs import joint, link, write


@pytest.mark.parametrize("root", ["fixed", "free-flyer"])
@pytest.mark.parametrize("joints", [MOST_DEGREES_OF_FREEDOM + 1, 1000])
def test_too_many_joints_are_refused_before_anything_is_allocated(tmp_path: Path, joints: int, root: str) -> None:
    parts = [link(f"l{k}", 1) for k in range(joints + 1)]
    parts += [joint(f"j{k}", f"l{k} l{k + 1}", "0 0 1", kind="continuous", more="") for k in range(joints)]
    with pytest.raises(UrdfError, match=f"more than the supported {MOST_DEGREES_OF_FREEDOM}"):
        build_model(write(tmp_path, *parts), free_flyer=root == "free-flyer")


@pytest.mark.parametrize("impulse", [1e308, 1e200, 1e-200, 5e-324])
def test_an_impulse_whose_objective_overflows(impulse: float) -> None:
    with pytest.raises(InputError, match=r"impulse: .* 1e-100 to 1e\+100"):
        ImpactContact("ee", (0, 0, 1), impulse=impulse)


def test_a_speed_whose_jump_overflows() -> None:
    resolved = resolve(ImpactSettings(robot="tilthex_arm", normal=(0, 0, 1)))
    with pytest.raises(InputError, match="0 to 1e"):
        evaluate(resolved.objective, resolved.q, speed=1e308)


@pytest.mark.parametrize("read", [read_settings, read_spec], ids=["problem.toml", "robot.toml"])
@pytest.mark.parametrize("deep", ["a = " + "[" * 5000 + "]" * 5000, "a = " + "{b=" * 3000 + "1" + "}" * 3000])
def test_deep_toml(tmp_path: Path, read: Callable[[Path], object], deep: str) -> None:
    (tmp_path / "deep.toml").write_text(deep)
    with pytest.raises(SpecError, match="nested too deeply"):
        read(tmp_path / "deep.toml")


def test_a_deep_manifest(tmp_path: Path) -> None:
    (tmp_path / "x.json").write_text("[" * 100_000 + "]" * 100_000)
    with pytest.raises(SpecError, match="cannot be read"):
        read_manifest(tmp_path / "x.json")


@pytest.mark.parametrize("variable", ["CC", "CFLAGS"])
def test_an_open_quote_in_the_environment(monkeypatch: pytest.MonkeyPatch, variable: str) -> None:
    monkeypatch.setenv(variable, "gcc 'x")
    with pytest.raises(CompilerError, match=r"cannot be split into words.*close the quote"):
        words_of(variable)
    if variable == "CC":
        with pytest.raises(CompilerError):
            find_compiler()


def test_warnings_of_libraries_are_not_printed(capfd: pytest.CaptureFixture[str]) -> None:
    app = typer.Typer()

    @app.command()
    def overflow() -> None:
        assert np.float64(1e308) * 10 == np.inf
        warnings.warn("a library's own", UserWarning, stacklevel=1)

    assert run(typer.main.get_command(app), []) == 0
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("size", [0, 3, 500])
def test_a_result_with_a_posture_of_another_length(tmp_path: Path, size: int) -> None:
    robot = load_robot("tilthex_arm")
    q = {"initial": {"q": robot.posture().tolist()}, "optimal": {"q": [0.0] * size}}
    (tmp_path / "problem.toml").write_text('robot = "tilthex_arm"\nnormal = [0, 0, 1]\n')
    (tmp_path / "result.json").write_text(
        json.dumps({"schema": SCHEMA, "robot": {"model_sha256": robot.model_sha256}, **q})
    )
    path = {f"path_{key}": np.zeros(1) for key in ("s", "H", "G", "V", "S", "objective")}
    path["path_q"] = robot.posture()[None]
    np.savez(tmp_path / "result.npz", **path)
    with pytest.raises(PostureError, match=rf"optimal\.q: a posture of tilthex_arm has .* numbers, this one {size}"):
        load_view(tmp_path)


@pytest.mark.skipif(sys.platform != "linux", reason="needs a limit on the address space (Linux)")
@pytest.mark.parametrize("command", ["inspect", "codegen"])
def test_too_little_memory_is_one_line_and_no_hang(command: str, tmp_path: Path) -> None:
    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_AS, (300 << 20, 300 << 20))

    entry = str(Path(sys.executable).parent / "impact-posture")
    argv = [entry, command, "talos", "--json"]
    done = subprocess.run(argv, cwd=tmp_path, capture_output=True, text=True, timeout=60, preexec_fn=limit)
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1 and "ulimit -v" in done.stderr
    assert json.loads(done.stdout)["error"]["code"] == 1
