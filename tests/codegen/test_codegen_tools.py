"""The C export with various compilers and build tools, and the errors that the export reports."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import numpy as np
import pytest

from impact_posture.codegen.c_names import c_identifier
from impact_posture.codegen.compile_and_check import compile_and_check
from impact_posture.codegen.export import export
from impact_posture.errors import CompilerError, InputError, MetricError, OutputError, PostureError
from impact_posture.impact.impact_contact import ImpactContact
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.robot.robot_loader import load_robot
from impact_posture.system.escape import c_comment
from impact_posture.system.toolchain import find_compiler, run_compiler
from tests.support import exported
from tests.support.tools import STRICT, need, need_compiler
from tests.support.urdfs import joint, link, write

OPTIMIZED = True


@pytest.fixture
def pendulum(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Return a robot with one link along x that rotates about z: its tip cannot move along x."""
    parts = [
        link("base"), link("arm", 2, "0.5 0 0"), link("tip"),
        joint("swing", "base arm", "0 0 1"), joint("end", "arm tip", None, "1 0 0", "fixed", ""),
    ]  # fmt: skip
    return str(write(tmp_path_factory.mktemp("robot"), *parts))


@pytest.fixture
def slanted(pendulum: str) -> WorstCaseObjective:
    return WorstCaseObjective(load_robot(pendulum), ImpactContact("tip", (1.0, 1.0, 0.0)))


# ---- undefined quantities -----------------------------------------------------------------------------------------


def test_code_for_a_quantity_that_does_not_exist(pendulum: str, tmp_path: Path) -> None:
    need_compiler()
    robot = load_robot(pendulum)
    objective = WorstCaseObjective(robot, ImpactContact("tip", (1.0, 0.0, 0.0)), kind="speed")
    export(objective, tmp_path, prefix="pend")
    with exported.built(tmp_path, "pend") as library:
        assert library.objective(np.zeros(1))[0] == 3
        assert library.objective(np.full(1, 0.1))[0] == 0
        assert library.eval(np.zeros(1), np.array([1.0, 0.0, 0.0])) == (0, 0.0, np.zeros(1))


def test_objective_that_exists_nowhere(pendulum: str, tmp_path: Path) -> None:
    objective = WorstCaseObjective(load_robot(pendulum), ImpactContact("tip", (0.0, 0.0, 1.0)), kind="speed")
    with pytest.raises(MetricError, match="not finite"):
        export(objective, tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_example_notices_a_wrong_number(slanted: WorstCaseObjective, tmp_path: Path) -> None:
    make = need("make")
    need_compiler()
    written = export(slanted, tmp_path, prefix="pend", check=False)
    example = (tmp_path / "example.c").read_text()
    H = repr(written.manifest["self_test"]["H"])
    assert example.count(H) == 1
    (tmp_path / "example.c").write_text(example.replace(H, f"{H} * (1.0 + 1e-8)"))
    subprocess.run([make, "-s"], cwd=tmp_path, check=True)
    done = subprocess.run([tmp_path / "example"], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "DISAGREES" in done.stdout


def test_two_exports_in_one_program(pendulum: str, tmp_path: Path) -> None:
    compiler = need_compiler()
    robot = load_robot(pendulum)
    values = []
    for prefix, normal in (("first", (0.0, 1.0, 0.0)), ("second", (1.0, 1.0, 0.0))):
        objective = WorstCaseObjective(robot, ImpactContact("tip", normal))
        export(objective, tmp_path, prefix=prefix, posture=robot.posture(), check=False, force=True)
        values.append(objective.value(robot.posture()))
    (tmp_path / "both.c").write_text(
        '#include <stdio.h>\n#include "first.h"\n#include "second.h"\n'
        "int main(void) { double a, b, g[FIRST_NV];\n"
        "  int code = first_objective(first_posture, &a, g) + second_objective(second_posture, &b, g);\n"
        '  printf("%.17g %.17g\\n", a, b); return code; }\n'
    )
    # Compile the C files separately and link them, then compile all files as one translation unit.
    (tmp_path / "unity.c").write_text('#include "first.c"\n#include "second.c"\n#include "both.c"\n')
    for sources in (["first.c", "second.c", "both.c"], ["unity.c"]):
        program = tmp_path / "program"
        run_compiler([*compiler, "-std=c99", *STRICT, *sources, "-o", str(program), "-lm"], tmp_path)
        done = subprocess.run([program], capture_output=True, text=True, check=True)
        np.testing.assert_allclose([float(v) for v in done.stdout.split()], values, rtol=1e-12)


def test_no_compiler(small: WorstCaseObjective, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CC", raising=False)
    assert find_compiler() is None
    written = export(small, tmp_path)
    assert not written.compiled
    assert written.agreement is None
    assert all(p.is_file() for p in written.files)
    with pytest.raises(CompilerError, match="no C compiler"):
        compile_and_check(tmp_path, written.prefix, [small])


def test_compiler_that_fails(slanted: WorstCaseObjective, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    need("false")
    monkeypatch.setenv("CC", "false")
    with pytest.raises(CompilerError) as caught:
        export(slanted, tmp_path, prefix="pend")
    assert "exit code 1" in caught.value.line
    assert "command: false -std=c99 -O2 -ffp-contract=fast -fPIC -shared pend.c" in caught.value.line
    assert "\n" not in caught.value.line
    assert (tmp_path / "pend.c").is_file()


def test_the_message_of_the_compiler_is_shown(slanted: WorstCaseObjective, tmp_path: Path) -> None:
    need_compiler()
    export(slanted, tmp_path, prefix="pend", check=False)
    source = tmp_path / "pend.c"
    source.write_text(source.read_text().replace("return 0;", "return nothing_of_that_name;"))
    with pytest.raises(CompilerError, match=r"pend\.c:\d+.*error.*nothing_of_that_name.*command: ") as caught:
        compile_and_check(tmp_path, "pend", [slanted])
    assert "\n" not in caught.value.line


def test_compiled_code_that_computes_something_else(slanted: WorstCaseObjective, tmp_path: Path) -> None:
    need_compiler()
    export(slanted, tmp_path, prefix="pend", check=False)
    source = tmp_path / "pend.c"
    changed = source.read_text().replace("*H = ", "*H = 1.000001 * ")
    assert changed != source.read_text()
    source.write_text(changed)
    with pytest.raises(CompilerError, match="differs from CasADi"):
        compile_and_check(tmp_path, "pend", [slanted])


def test_cc_may_carry_options(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    tool = tmp_path / "mycc"
    tool.write_text("#!/bin/sh\n")
    tool.chmod(0o755)
    monkeypatch.setenv("CC", f"{tool} -m64")
    assert find_compiler() == [str(tool), "-m64"]
    monkeypatch.setenv("CC", "no-such-compiler")
    assert find_compiler() != ["no-such-compiler"]


@pytest.mark.parametrize(
    ("robot", "frame", "expected"),
    [
        ("solo8", "FL_FOOT", "solo8_FL_FOOT"),
        ("my robot-2", "tool/0", "my_robot_2_tool_0"),
        ("7dof", "tip", "robot_7dof_tip"),
        ("ürdf", "ende", "rdf_ende"),
    ],
)
def test_c_identifier(robot: str, frame: str, expected: str) -> None:
    assert c_identifier(robot, frame) == expected


@pytest.mark.parametrize("prefix", ["", "1a", "a-b", "a b", "_a", "ä", "a\n", "example", "Example"])
def test_bad_prefix(small: WorstCaseObjective, tmp_path: Path, prefix: str) -> None:
    with pytest.raises(InputError, match="prefix"):
        export(small, tmp_path, prefix=prefix)
    assert not list(tmp_path.iterdir())


def test_never_overwrites_without_force(slanted: WorstCaseObjective, tmp_path: Path) -> None:
    (tmp_path / "README.md").write_text("mine")
    with pytest.raises(OutputError, match=r"README\.md"):
        export(slanted, tmp_path, check=False)
    assert (tmp_path / "README.md").read_text() == "mine"
    export(slanted, tmp_path, check=False, force=True)
    assert "written" in (tmp_path / "README.md").read_text()


def test_bad_folder_and_posture(slanted: WorstCaseObjective, tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="no such folder"):
        export(slanted, tmp_path / "absent", check=False)
    with pytest.raises(PostureError):
        export(slanted, tmp_path, posture=np.zeros(2), check=False)
    with pytest.raises(PostureError):
        export(slanted, tmp_path, posture=np.full(1, np.nan), check=False)
    (tmp_path / f".written_tip.h.{os.getpid()}.part").mkdir()
    with pytest.raises(OutputError, match="cannot be written"):
        export(slanted, tmp_path, check=False)


def test_names_cannot_end_a_comment() -> None:
    assert c_comment("a*/ int x; /* \\ ??/ \n ü") == "a_/ int x; /_ _ __/ _ _"
