"""The C export: generated, compiled, loaded, and compared with CasADi, finite differences and Pinocchio."""

from __future__ import annotations

import ctypes
import json
import os
import re
import subprocess
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from jinja2 import UndefinedError

from impact_posture.codegen.build_check import compile_and_check, largest_difference
from impact_posture.codegen.export import Export, export
from impact_posture.codegen.functions import casadi_reference, oracle_reference
from impact_posture.codegen.manifest import sample_postures
from impact_posture.codegen.naming import c_identifier
from impact_posture.codegen.render import Verbatim, _environment
from impact_posture.errors import CompilerError, InputError, MetricError, OutputError, PostureError
from impact_posture.escape import c_comment
from impact_posture.impact.contact import ImpactContact, Support
from impact_posture.impact.metric import Metric
from impact_posture.impact.objective import ImpactObjective
from impact_posture.robot.robot_loader import load_robot
from impact_posture.settings import ObjectiveKind
from impact_posture.toolchain import find_compiler, run_compiler
from tests import exported
from tests.exported import Exported
from tests.tools import need, need_compiler

KINOVA = "example-robot-data:kinova_description/robots/kinova.urdf"
STRICT = ("-Wall", "-Wextra", "-pedantic", "-Werror")
UNIT = np.array([0.6, 0.0, 0.8])

# One link about z: where it points along x, it cannot move along x at all.
PENDULUM = """<robot name="pendulum">
  <link name="base"/>
  <link name="arm"><inertial><origin xyz="0.5 0 0"/><mass value="2"/>
    <inertia ixx="0.1" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.1"/></inertial></link>
  <link name="tip"/>
  <joint name="swing" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 0 1"/>
    <limit lower="-3" upper="3" effort="1" velocity="1"/></joint>
  <joint name="end" type="fixed"><parent link="arm"/><child link="tip"/><origin xyz="1 0 0"/></joint>
</robot>
"""


@dataclass(frozen=True)
class Case:
    robot: str
    frame: str
    supported: bool = False
    kind: ObjectiveKind = "impulse"
    metric: str = "euclidean"
    in_frame: bool = False

    def build(self) -> ImpactObjective:
        robot = load_robot(self.robot)
        supports = tuple(Support.from_spec(s) for s in robot.spec.supports) if self.supported else ()
        metric = (
            Metric("weighted", tuple(np.linspace(0.5, 2.0, robot.nv)), "test")
            if self.metric == "weighted"
            else Metric("kinetic" if self.metric == "kinetic" else "euclidean")
        )
        contact = ImpactContact(
            self.frame, (1.0, 0.3, -0.2), (0.01, 0.02, 0.0), "contact" if self.in_frame else "world", 1.7
        )
        return ImpactObjective(robot, contact, metric, self.kind, supports)


CASES = {
    "solo8-standing": Case("solo8", "base_link", supported=True),
    "solo8-free": Case("solo8", "base_link", kind="speed"),
    "tilthex_arm": Case("tilthex_arm", "ee", kind="sticking"),
    "panda": Case("panda", "panda_hand_tcp", metric="weighted"),
    "kinova": Case(KINOVA, "j2s6s200_end_effector", kind="energy"),
    "hextilt": Case("hextilt", "flying_arm_5__gripper", metric="kinetic", in_frame=True),
}


@dataclass(frozen=True)
class Built:
    objective: ImpactObjective
    export: Export
    library: Exported
    folder: Path


@pytest.fixture(scope="module", params=list(CASES))
def built(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Built]:
    need_compiler()
    objective = CASES[request.param].build()
    folder = tmp_path_factory.mktemp(request.param)
    robot = objective.robot
    written = export(objective, folder, posture=sample_postures(robot, 1, 7)[0], check=False)
    with exported.built(folder, written.prefix, STRICT) as library:
        yield Built(objective, written, library, folder)


@pytest.fixture(scope="module")
def small() -> ImpactObjective:
    return CASES["tilthex_arm"].build()


@pytest.fixture
def pendulum(tmp_path: Path) -> str:
    path = tmp_path / "pendulum.urdf"
    path.write_text(PENDULUM)
    return str(path)


# ---- numbers ------------------------------------------------------------------------------------------------------


def test_agrees_with_casadi(built: Built) -> None:
    # The C divides by multiplying with reciprocals; stiff feet (1/ε of 1e4 robots) turn its last digits into this.
    tolerance = 1e-10 if built.objective.supports else 1e-12
    assert largest_difference(built.library.gradient, built.objective, casadi_reference, 10) <= tolerance


def test_agrees_with_pinocchio(built: Built) -> None:
    # The oracle solves the KKT system of feet at compliance 1e-4/m: its condition costs four digits and more.
    tolerance = 1e-8 if built.objective.supports else 1e-11
    assert largest_difference(built.library.gradient, built.objective, oracle_reference, 10) <= tolerance


def test_gradients_are_those_of_the_values(built: Built) -> None:
    robot, h = built.objective.robot, 1e-5
    q = sample_postures(robot, 1, 11)[0]
    _, H, gradient = built.library.eval(q, UNIT)
    _, value, own = built.library.objective(q)
    differences = np.zeros((2, robot.nv))
    for i in range(robot.nv):
        step = np.zeros(robot.nv)
        step[i] = h
        ahead, behind = pin.integrate(robot.model, q, step), pin.integrate(robot.model, q, -step)
        differences[0, i] = (built.library.value(ahead, UNIT)[1] - built.library.value(behind, UNIT)[1]) / (2 * h)
        differences[1, i] = (built.library.objective(ahead)[1] - built.library.objective(behind)[1]) / (2 * h)
    for found, expected, scale in ((gradient, differences[0], H), (own, differences[1], value)):
        np.testing.assert_allclose(found, expected, atol=1e-6 * max(np.abs(expected).max(), scale), rtol=0)


def test_free_beside_standing(built: Built) -> None:
    """What stands has the free robot's functions too, equal to Pinocchio's without supports."""
    objective, frame = built.objective, built.export.manifest["frames"][0]
    assert (frame["free"] is None) == (not objective.supports)
    if objective.supports:
        free = replace(objective, supports=())
        assert largest_difference(built.library.free().gradient, free, oracle_reference, 5) <= 1e-10
        q, n = np.array(frame["self_test"]["q"]), np.array(frame["self_test"]["n"])
        assert frame["free"]["self_test"]["q"] == frame["self_test"]["q"]
        assert abs(built.library.eval(q, n)[1] / frame["free"]["self_test"]["H"] - 1) > 1e-3


def test_objective_carries_the_impulse_bound(built: Built) -> None:
    if built.objective.kind != "impulse":
        assert built.objective.scale == 1.0
        return
    q = sample_postures(built.objective.robot, 1, 5)[0]
    _, H, _ = built.library.eval(q, np.array(built.objective.contact.normal))
    assert built.library.objective(q)[1] == pytest.approx(1.7**2 * H, rel=1e-14)


# ---- codes --------------------------------------------------------------------------------------------------------


def test_codes(built: Built) -> None:
    library, robot = built.library, built.objective.robot
    q = sample_postures(robot, 1, 3)[0]
    assert library.eval(q, UNIT)[0] == library.objective(q)[0] == library.value(q, UNIT)[0] == 0
    for bad in (np.nan, np.inf):
        broken = q.copy()
        broken[-1] = bad
        code, H, gradient = library.eval(broken, UNIT)
        assert code == library.objective(broken)[0] == library.value(broken, UNIT)[0] == 1
        assert np.isnan(H) and np.isnan(gradient).all()  # as the caller left them
        assert library.eval(q, np.array([bad, 0, 0]))[0] == library.value(q, np.array([0, bad, 0]))[0] == 1


def test_unit_norm_is_asked_for(built: Built) -> None:
    library, robot = built.library, built.objective.robot
    q = sample_postures(robot, 1, 3)[0]
    units = [slice(3, 7)] if robot.floating else []
    for i in range(1, robot.model.njoints):
        if robot.model.nqs[i] == 2:
            units.append(slice(robot.model.idx_qs[i], robot.model.idx_qs[i] + 2))
    assert bool(units) == (robot.name != "panda")
    for unit in units:
        near, far = q.copy(), q.copy()
        near[unit] *= 1 + 5e-7
        far[unit] *= 1 - 2e-6
        assert library.eval(near, UNIT)[0] == 0
        code, H, gradient = library.eval(far, UNIT)
        assert code == library.objective(far)[0] == library.value(far, UNIT)[0] == 2
        assert np.isnan(H) and np.isnan(gradient).all()


def test_code_for_a_quantity_that_does_not_exist(pendulum: str, tmp_path: Path) -> None:
    need_compiler()
    robot = load_robot(pendulum)
    objective = ImpactObjective(robot, ImpactContact("tip", (1.0, 0.0, 0.0)), kind="speed")
    export(objective, tmp_path, prefix="pend")
    with exported.built(tmp_path, "pend") as library:
        assert library.objective(np.zeros(1))[0] == 3
        assert library.objective(np.full(1, 0.1))[0] == 0
        assert library.eval(np.zeros(1), np.array([1.0, 0.0, 0.0])) == (0, 0.0, np.zeros(1))


def test_objective_that_exists_nowhere(pendulum: str, tmp_path: Path) -> None:
    objective = ImpactObjective(load_robot(pendulum), ImpactContact("tip", (0.0, 0.0, 1.0)), kind="speed")
    with pytest.raises(MetricError, match="not finite"):
        export(objective, tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["pendulum.urdf"]


# ---- the source ---------------------------------------------------------------------------------------------------


def test_no_allocation_and_no_state(built: Built) -> None:
    source = (built.folder / f"{built.export.prefix}.c").read_text()
    assert "alloc" not in source
    static = [line for line in source.splitlines() if re.search(r"\bstatic\b", line)]
    assert len(static) >= 4
    assert all(
        re.match(r"\s*(__attribute__\(\(unused\)\) )?(APART )?static (const |(int|void) \w+\()", line)
        for line in static
    )


def test_object_holds_no_writable_data(built: Built, tmp_path: Path) -> None:
    nm, compiler = need("nm"), need_compiler()
    prefix = built.export.prefix
    target = tmp_path / "one.o"
    run_compiler([*compiler, "-std=c99", "-O0", "-c", f"{prefix}.c", "-o", str(target)], built.folder)
    lines = subprocess.run([nm, str(target)], capture_output=True, text=True, check=True).stdout.splitlines()
    kinds = {line.split()[-2] for line in lines}
    assert not kinds & set("bBdDcCsSgG")
    names = {line.split()[-1].lstrip("_") for line in lines if line.split()[-2] in "TR"}
    free = built.export.manifest["frames"][0]["free"]
    expected = set(built.export.manifest["symbols"].values()) | set(free["symbols"].values() if free else ())
    assert names == expected


def test_works_from_several_threads(built: Built) -> None:
    postures = sample_postures(built.objective.robot, 200, 9)
    alone = [built.library.eval(q, UNIT) for q in postures]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(lambda q: built.library.eval(q, UNIT), postures))
    for one, other in zip(alone, together, strict=True):
        assert one[:2] == other[:2]
        np.testing.assert_array_equal(one[2], other[2])


def test_gradient_may_overwrite_the_configuration(built: Built) -> None:
    q = sample_postures(built.objective.robot, 1, 4)[0]
    _, H, gradient = built.library.eval(q, UNIT)
    shared, value, n = q.copy(), np.zeros(1), UNIT.copy()
    pointers = [v.ctypes.data_as(ctypes.POINTER(ctypes.c_double)) for v in (shared, n, value, shared)]
    assert getattr(built.library.gradient._library, f"{built.export.prefix}_eval")(*pointers) == 0
    assert value[0] == H
    np.testing.assert_array_equal(shared[: gradient.size], gradient)


def test_posture_is_a_constant(built: Built) -> None:
    robot, prefix = built.objective.robot, built.export.prefix
    array = (ctypes.c_double * robot.nq).in_dll(built.library.gradient._library, f"{prefix}_posture")
    np.testing.assert_array_equal(np.array(array), sample_postures(robot, 1, 7)[0])
    np.testing.assert_array_equal(built.export.manifest["posture"], np.array(array))


def test_compiles_as_cpp(built: Built, tmp_path: Path) -> None:
    compiler = need("g++")
    prefix = built.export.prefix
    use = tmp_path / "use.cpp"
    use.write_text(
        f'#include "{prefix}.h"\n'
        f"int main() {{ double H, g[{prefix.upper()}_NV]; const double n[3] = {{0, 0, 1}};\n"
        f"  return {prefix}_eval({prefix}_posture, n, &H, g) || !(H > 0); }}\n"
    )
    command = [compiler, "-x", "c++", "-std=c++17", *STRICT, "-I", ".", f"{prefix}.c", str(use)]
    run_compiler([*command, "-o", str(tmp_path / "use"), "-lm"], built.folder)
    assert subprocess.run([tmp_path / "use"], check=False).returncode == 0


def test_manifest(built: Built) -> None:
    manifest = json.loads((built.folder / f"{built.export.prefix}.json").read_text())
    assert manifest == built.export.manifest
    robot, contact = built.objective.robot, built.objective.contact
    assert manifest["schema"] == "impact-posture/codegen/1"
    assert manifest["model_sha256"] == robot.model_sha256
    assert manifest["joint_names"] == list(robot.joint_names)
    assert len(manifest["q_names"]) == manifest["nq"] == robot.nq
    assert len(manifest["v_names"]) == manifest["nv"] == robot.nv
    assert manifest["normal"] == list(contact.normal)
    assert [s["frame"] for s in manifest["supports"]] == [s.frame for s in built.objective.supports]
    assert (manifest["support_compliance"] is None) == (not built.objective.supports)
    test = manifest["self_test"]
    code, H, gradient = built.library.eval(np.array(test["q"]), np.array(test["n"]))
    assert code == 0
    tolerance = 1e-10 if built.objective.supports else 1e-12
    assert pytest.approx(test["H"], rel=tolerance) == H
    np.testing.assert_allclose(gradient, test["grad"], atol=tolerance * np.abs(test["grad"]).max())


def test_texts_name_what_they_are_of(built: Built) -> None:
    prefix, robot = built.export.prefix, built.objective.robot
    header, readme = (built.folder / f"{prefix}.h").read_text(), (built.folder / "README.md").read_text()
    for text in (header, readme):
        assert built.objective.contact.frame in text
        assert all(name in text for name in robot.joint_names)
        assert ("contact frame" in text) == (built.objective.contact.normal_frame == "contact")
    assert f"#define {prefix.upper()}_NQ {robot.nq}\n" in header
    assert f"#define {prefix.upper()}_NV {robot.nv}\n" in header
    assert all(line == line.rstrip() and line.isascii() for line in header.splitlines())


# ---- building -----------------------------------------------------------------------------------------------------


def test_example_agrees(small: ImpactObjective, tmp_path: Path) -> None:
    make = need("make")
    need_compiler()
    written = export(small, tmp_path, posture=small.robot.posture())
    assert written.compiled
    assert written.agreement is not None and written.agreement <= 1e-11
    assert {p.name for p in tmp_path.iterdir()} == {p.name for p in written.files}
    subprocess.run([make, "-s", "CFLAGS=-O1 -Wall -Wextra -Werror"], cwd=tmp_path, check=True)
    done = subprocess.run([tmp_path / "example"], capture_output=True, text=True, check=True)
    assert "agrees: largest relative difference" in done.stdout


def test_example_notices_a_wrong_number(pendulum: str, tmp_path: Path) -> None:
    make = need("make")
    need_compiler()
    objective = ImpactObjective(load_robot(pendulum), ImpactContact("tip", (1.0, 1.0, 0.0)))
    written = export(objective, tmp_path, prefix="pend", check=False)
    example = (tmp_path / "example.c").read_text()
    H = repr(written.manifest["self_test"]["H"])
    assert example.count(H) == 1
    (tmp_path / "example.c").write_text(example.replace(H, f"{H} * (1.0 + 1e-8)"))
    subprocess.run([make, "-s"], cwd=tmp_path, check=True)
    done = subprocess.run([tmp_path / "example"], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "DISAGREES" in done.stdout


def test_cmake_target_from_outside(pendulum: str, tmp_path: Path) -> None:
    cmake = need("cmake")
    need_compiler()
    inside = tmp_path / "c"
    inside.mkdir()
    robot = load_robot(pendulum)
    objective = ImpactObjective(robot, ImpactContact("tip", (1.0, 1.0, 0.0)))
    export(objective, inside, prefix="pend", posture=robot.posture(), check=False)
    (tmp_path / "CMakeLists.txt").write_text(
        "cmake_minimum_required(VERSION 3.16)\nproject(controller C)\nadd_subdirectory(c)\n"
        "add_executable(controller main.c)\ntarget_link_libraries(controller PRIVATE pend::pend)\n"
    )
    (tmp_path / "main.c").write_text(
        '#include "pend.h"\nint main(void) { double v, g[PEND_NV]; return pend_objective(pend_posture, &v, g); }\n'
    )
    for command in (["-S", ".", "-B", "build"], ["--build", "build"]):
        done = subprocess.run([cmake, *command], cwd=tmp_path, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
    assert subprocess.run([tmp_path / "build" / "controller"], check=False).returncode == 0


def test_two_exports_in_one_program(pendulum: str, tmp_path: Path) -> None:
    compiler = need_compiler()
    robot = load_robot(pendulum)
    values = []
    for prefix, normal in (("first", (0.0, 1.0, 0.0)), ("second", (1.0, 1.0, 0.0))):
        objective = ImpactObjective(robot, ImpactContact("tip", normal))
        export(objective, tmp_path, prefix=prefix, posture=robot.posture(), check=False, force=True)
        values.append(objective.value(robot.posture()))
    (tmp_path / "both.c").write_text(
        '#include <stdio.h>\n#include "first.h"\n#include "second.h"\n'
        "int main(void) { double a, b, g[FIRST_NV];\n"
        "  int code = first_objective(first_posture, &a, g) + second_objective(second_posture, &b, g);\n"
        '  printf("%.17g %.17g\\n", a, b); return code; }\n'
    )
    # Linked, and as one translation unit.
    (tmp_path / "unity.c").write_text('#include "first.c"\n#include "second.c"\n#include "both.c"\n')
    for sources in (["first.c", "second.c", "both.c"], ["unity.c"]):
        program = tmp_path / "program"
        run_compiler([*compiler, "-std=c99", *STRICT, *sources, "-o", str(program), "-lm"], tmp_path)
        done = subprocess.run([program], capture_output=True, text=True, check=True)
        np.testing.assert_allclose([float(v) for v in done.stdout.split()], values, rtol=1e-12)


def test_no_compiler(small: ImpactObjective, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CC", raising=False)
    assert find_compiler() is None
    written = export(small, tmp_path)
    assert not written.compiled
    assert written.agreement is None
    assert all(p.is_file() for p in written.files)
    with pytest.raises(CompilerError, match="no C compiler"):
        compile_and_check(tmp_path, written.prefix, small)


def test_compiler_that_fails(pendulum: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    need("false")
    monkeypatch.setenv("CC", "false")
    objective = ImpactObjective(load_robot(pendulum), ImpactContact("tip", (1.0, 1.0, 0.0)))
    with pytest.raises(CompilerError) as caught:
        export(objective, tmp_path, prefix="pend")
    assert "exit code 1" in caught.value.line
    assert "command: false -std=c99 -O2 -ffp-contract=fast -fPIC -shared pend.c" in caught.value.line
    assert "\n" not in caught.value.line
    assert (tmp_path / "pend.c").is_file()


def test_compiler_says_why(pendulum: str, tmp_path: Path) -> None:
    need_compiler()
    objective = ImpactObjective(load_robot(pendulum), ImpactContact("tip", (1.0, 1.0, 0.0)))
    export(objective, tmp_path, prefix="pend", check=False)
    source = tmp_path / "pend.c"
    source.write_text(source.read_text().replace("return 0;", "return nothing_of_that_name;"))
    with pytest.raises(CompilerError, match=r"pend\.c:\d+.*error.*nothing_of_that_name.*command: ") as caught:
        compile_and_check(tmp_path, "pend", objective)
    assert "\n" not in caught.value.line


def test_compiled_code_that_computes_something_else(pendulum: str, tmp_path: Path) -> None:
    need_compiler()
    objective = ImpactObjective(load_robot(pendulum), ImpactContact("tip", (1.0, 1.0, 0.0)))
    export(objective, tmp_path, prefix="pend", check=False)
    source = tmp_path / "pend.c"
    changed = source.read_text().replace("*H = ", "*H = 1.000001 * ")
    assert changed != source.read_text()
    source.write_text(changed)
    with pytest.raises(CompilerError, match="differ from those of CasADi"):
        compile_and_check(tmp_path, "pend", objective)


def test_cc_may_carry_options(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    tool = tmp_path / "mycc"
    tool.write_text("#!/bin/sh\n")
    tool.chmod(0o755)
    monkeypatch.setenv("CC", f"{tool} -m64")
    assert find_compiler() == [str(tool), "-m64"]
    monkeypatch.setenv("CC", "no-such-compiler")
    assert find_compiler() != ["no-such-compiler"]


# ---- names, folders, inputs ---------------------------------------------------------------------------------------


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
def test_bad_prefix(small: ImpactObjective, tmp_path: Path, prefix: str) -> None:
    with pytest.raises(InputError, match="prefix"):
        export(small, tmp_path, prefix=prefix)
    assert not list(tmp_path.iterdir())


def test_never_overwrites_without_force(pendulum: str, tmp_path: Path) -> None:
    objective = ImpactObjective(load_robot(pendulum), ImpactContact("tip", (1.0, 1.0, 0.0)))
    (tmp_path / "README.md").write_text("mine")
    with pytest.raises(OutputError, match=r"README\.md"):
        export(objective, tmp_path, check=False)
    assert (tmp_path / "README.md").read_text() == "mine"
    export(objective, tmp_path, check=False, force=True)
    assert "pendulum" in (tmp_path / "README.md").read_text()


def test_bad_folder_and_posture(pendulum: str, tmp_path: Path) -> None:
    objective = ImpactObjective(load_robot(pendulum), ImpactContact("tip", (1.0, 1.0, 0.0)))
    with pytest.raises(OutputError, match="no such folder"):
        export(objective, tmp_path / "absent", check=False)
    with pytest.raises(PostureError):
        export(objective, tmp_path, posture=np.zeros(2), check=False)
    with pytest.raises(PostureError):
        export(objective, tmp_path, posture=np.full(1, np.nan), check=False)
    (tmp_path / f".pendulum_tip.h.{os.getpid()}.part").mkdir()
    with pytest.raises(OutputError, match="cannot be written"):
        export(objective, tmp_path, check=False)


def test_names_cannot_end_a_comment() -> None:
    assert c_comment("a*/ int x; /* \\ ??/ \n ü") == "a_/ int x; /_ _ __/ _ _"


def test_templates_escape_every_text_and_refuse_unknown_names() -> None:
    environment = _environment(c_comment)
    assert environment.from_string("{{ name }} {{ code }}").render(name="*/", code=Verbatim("*/")) == "_/ */"
    assert environment.from_string("{{ values | doubles }}").render(values=[-1.5]) == "{\n    -1.5\n  }"
    for text in (
        "{{ nobody }}",
        "{{ name.nobody }}",
        "{% if nobody %}{% endif %}",
        "{% for x in nobody %}{% endfor %}",
    ):
        with pytest.raises(UndefinedError):
            environment.from_string(text).render(name="x")
