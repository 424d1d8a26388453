"""The export for all joint types, metrics, objectives and number types; build tools, export folder and command."""

from __future__ import annotations

import json
import subprocess
from importlib import util
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from impact_posture.codegen.c_literals import DOUBLE, FLOAT, Real
from impact_posture.codegen.c_names import products
from impact_posture.codegen.compile_and_check import largest_difference
from impact_posture.codegen.export import export, write_export
from impact_posture.codegen.impact_gradient import ImpactGradient
from impact_posture.codegen.self_test import casadi_reference, oracle_reference, sample_postures, self_test_tolerance
from impact_posture.config.problem_settings import LoadOptions
from impact_posture.errors import CompilerError, InputError, OutputError
from impact_posture.impact.impact_contact import ImpactContact
from impact_posture.impact.metric import Metric
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.robot.robot_loader import load_robot
from impact_posture.system.scratch_folder import RECORD
from impact_posture.system.toolchain import run_compiler
from tests.support import command, exported
from tests.support.tools import STRICT, need, need_compiler

JOINTS = [
    ("revolute", "1 0 0"), ("revolute", "0.6 0 0.8"), ("prismatic", "0 1 0"), ("prismatic", "0 -0.6 0.8"),
    ("continuous", "0 0 1"), ("continuous", "0.6 0.8 0"), ("planar", "0 0 1"), ("floating", "0 0 1"),
]  # fmt: skip


def chain(joints: list[tuple[str, str]] = JOINTS) -> str:
    """Return a robot with every joint type of the URDF format, or with the given joint types."""
    inertial = (
        '<inertial><origin xyz="0.05 0.02 -0.03" rpy="0.1 0.2 0.3"/><mass value="{m}"/>'
        '<inertia ixx="0.02" ixy="0.001" ixz="0" iyy="0.03" iyz="-0.002" izz="0.025"/></inertial>'
    )
    parts = [f'<link name="l0">{inertial.format(m=3)}</link>']
    for k, (kind, axis) in enumerate(joints):
        parts.append(f'<link name="l{k + 1}">{inertial.format(m=1.5 - 0.1 * k)}</link>')
        limit = '<limit lower="-2" upper="2" effort="10" velocity="3"/>' if kind in ("revolute", "prismatic") else ""
        parts.append(
            f'<joint name="j{k}" type="{kind}"><parent link="l{k}"/><child link="l{k + 1}"/>'
            f'<origin xyz="0.1 {0.03 * k} 0.15" rpy="{0.2 * k} 0.1 -0.3"/><axis xyz="{axis}"/>{limit}</joint>'
        )
    return f'<robot name="chain">{"".join(parts)}</robot>'


def run(command: list[str], folder: Path) -> str:
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout + done.stderr


# Every objective, metric, joint type, base type and number type occurs in at least one combination.
GRID = [
    ("euclidean", "impulse", "fixed", DOUBLE, JOINTS),
    ("weighted", "speed", "free-flyer", DOUBLE, JOINTS),
    ("kinetic", "sticking", "fixed", DOUBLE, JOINTS[:4]),
    ("euclidean", "energy", "free-flyer", FLOAT, JOINTS[4:]),
    ("kinetic", "impulse", "free-flyer", FLOAT, JOINTS),
    ("weighted", "sticking", "fixed", FLOAT, JOINTS[4:]),
]


@pytest.mark.long(
    but=(
        "weighted-speed-free-flyer-double-8 joints",
        "euclidean-energy-free-flyer-float-4 joints",
        "kinetic-impulse-free-flyer-float-8 joints",
        "weighted-sticking-fixed-float-4 joints",
    )
)
@pytest.mark.parametrize(
    ("metric", "kind", "root", "real", "joints"),
    GRID,
    ids=lambda v: f"{len(v)} joints" if isinstance(v, list) else getattr(v, "name", v),
)
def test_every_joint_type_metric_and_objective(
    tmp_path: Path, metric: Any, kind: Any, root: Any, real: Real, joints: list[tuple[str, str]]
) -> None:
    need_compiler()
    (tmp_path / "chain.urdf").write_text(chain(joints))
    robot = load_robot(str(tmp_path / "chain.urdf"), LoadOptions(root=root))
    families = {robot.model.joints[i].shortname() for i in range(1, robot.model.njoints)}
    assert len(families) == len(joints) + (root == "free-flyer" and joints[-1][0] != "floating")
    weights = tuple(np.linspace(0.5, 2.0, robot.nv)) if metric == "weighted" else None
    objective = WorstCaseObjective(
        robot,
        ImpactContact(f"l{len(joints)}", (1.0, 0.3, -0.2), (0.02, 0, 0.1), impulse=1.3),
        Metric(metric, weights),
        kind,
    )
    written = export(objective, tmp_path, prefix="chain", real=real, check=False)
    with exported.built(tmp_path, "chain", ("-O0", *STRICT)) as library:
        tolerance = 1e-11 if real is DOUBLE else self_test_tolerance(objective, real)
        assert largest_difference(library.gradient, objective, casadi_reference, 5) <= tolerance
        assert largest_difference(library.gradient, objective, oracle_reference, 5) <= max(tolerance, 1e-10)
    assert written.manifest["real"] == real.name


@pytest.fixture(scope="module")
def arm() -> WorstCaseObjective:
    return WorstCaseObjective(load_robot("tilthex_arm"), ImpactContact("ee", (0, 0.6, 0.8)))


@pytest.fixture(scope="module")
def two(arm: WorstCaseObjective) -> tuple[WorstCaseObjective, WorstCaseObjective]:
    return arm, WorstCaseObjective(arm.robot, ImpactContact("base_link", (1, 0, 0)), arm.metric)


# ---- builds by users ----------------------------------------------------------------------------------------------


@pytest.mark.long(but=("double",))
@pytest.mark.parametrize("real", [DOUBLE, FLOAT], ids=lambda r: r.name)
def test_several_frames_in_one_library(two: tuple[WorstCaseObjective, ...], tmp_path: Path, real: Real) -> None:
    make = need("make")
    need_compiler()
    written = export(two, tmp_path, prefix="two", real=real)
    assert written.compiled
    assert [b["symbols"]["eval"] for b in written.manifest["frames"]] == ["two_ee_eval", "two_base_link_eval"]
    run([make, "-s", "CFLAGS=-O1 -Wall -Wextra -Werror"], tmp_path)
    output = run(["./example"], tmp_path)
    assert "two_ee: H" in output and "two_base_link: H" in output and "agrees" in output
    source = (tmp_path / "two.c").read_text()
    assert ("double" in source) == (real is DOUBLE)
    assert ("sinf(" in source) == (real is FLOAT)


def test_frames_must_differ_in_the_contact_alone(two: tuple[WorstCaseObjective, ...], tmp_path: Path) -> None:
    with pytest.raises(InputError, match="given twice"):
        export([two[0], two[0]], tmp_path, prefix="x")
    other = WorstCaseObjective(two[0].robot, two[1].contact, Metric("kinetic"))
    with pytest.raises(InputError, match="differ in more than the contact"):
        export([two[0], other], tmp_path, prefix="x")
    with pytest.raises(InputError, match="no objective"):
        export([], tmp_path)
    assert not list(tmp_path.iterdir())


# Compiler flags for every lane width, also widths that this processor lacks, with and without inlining.
STACK_FLAGS = ("-O0", "-O3 -march=native", "-O3 -mavx2 -mfma", "-O3 -mavx512f -mfma", "-O0 -mavx512f")


@pytest.mark.long(but=("double-gcc", "float-clang"))
@pytest.mark.parametrize("tool", ["gcc", "clang"])
@pytest.mark.parametrize("real", [DOUBLE, FLOAT], ids=lambda r: r.name)
def test_stack_stays_below_its_bound(arm: WorstCaseObjective, tmp_path: Path, real: Real, tool: str) -> None:
    need(tool)
    bound = export(arm, tmp_path, prefix="arm", real=real, check=False).manifest["stack_bytes"]
    assert f"#define ARM_STACK_BYTES {bound}\n" in (tmp_path / "arm.h").read_text()
    assert f"at most {bound} bytes" in (tmp_path / "README.md").read_text()
    # Floats need half the stack of doubles, so two of the flag sets suffice: without vectors, and with wide vectors.
    for flags in STACK_FLAGS if real is DOUBLE else STACK_FLAGS[::3]:
        if deepest := deepest_stack(tmp_path, "arm", tool, flags):
            assert deepest <= bound, flags


@pytest.mark.long(but=("gcc",))
@pytest.mark.parametrize("tool", ["gcc", "clang"])
def test_stack_of_a_robot_that_stands(tmp_path: Path, tool: str) -> None:
    need(tool)
    solo8 = load_robot("solo8")
    feet = solo8.spec.supports
    objective = WorstCaseObjective(solo8, ImpactContact("base_link", (1, 0, 0)), supports=feet)
    bound = export(objective, tmp_path, prefix="solo8", check=False).manifest["stack_bytes"]
    deepest = deepest_stack(tmp_path, "solo8", tool, "-O3 -mavx512f -mfma")
    # The bound is at most twice the measured depth, because users reserve a stack of this size.
    assert bound / 2 <= deepest <= bound


def deepest_stack(folder: Path, prefix: str, tool: str, flags: str) -> int:
    """Return the stack bytes of the deepest call, as reported by the compiler; 0 if the flags are unsupported."""
    command = [tool, "-std=c99", "-ffp-contract=fast", *flags.split(), "-fstack-usage", "-c", f"{prefix}.c"]
    try:
        run_compiler([*command, "-o", str(folder / "made.o")], folder)
    except CompilerError:
        return 0
    (usage,) = folder.glob("*.su")
    rows = [line.split("\t") for line in usage.read_text().splitlines()]
    usage.unlink()
    # In the compiler report, "dynamic,bounded" is an aligned stack frame, but "dynamic" alone would be an alloca.
    assert {row[2] for row in rows} <= {"static", "dynamic,bounded"}
    sizes = {row[0].split(":")[-1]: int(row[1]) for row in rows}
    inner = [size for name, size in sizes.items() if "_block" in name or "sincos" in name]
    lanes = [
        size for name, size in sizes.items() if "_lanes" in name and "_block" not in name and "sincos" not in name
    ]
    entries = [size for name, size in sizes.items() if "_block" not in name and "_lanes" not in name]
    # The deepest call has three functions.  An entry function or the batch function calls an entry function, which
    # calls a block or sine function.  Each call adds a return address to the stack.
    outer = max(sum(sorted(entries)[-2:]), max(entries) + max(lanes, default=0))
    return outer + max(inner) + 4 * 8


def test_example_for_eigen(arm: WorstCaseObjective, tmp_path: Path) -> None:
    make, _ = need("make"), need("g++")
    need_compiler()
    spec = util.find_spec("casadi")
    bundled = Path(spec.origin).parent / "include" / "eigen3" if spec is not None and spec.origin else Path()
    folders = [p for p in (bundled, Path("/usr/include/eigen3"), Path("/usr/local/include/eigen3")) if p.is_dir()]
    if not any((p / "Eigen" / "Core").is_file() for p in folders):
        pytest.skip("no Eigen headers")
    export(arm, tmp_path, prefix="arm", real=FLOAT, check=False)
    flags = ["CXX=g++", "CXXFLAGS=-O0 -Wall -Wextra -Werror", "CFLAGS=-O0", f"EIGEN={folders[0]}"]
    run([make, "-s", "example_cpp", *flags], tmp_path)
    assert "H = " in run(["./example_cpp"], tmp_path)


def test_cmake_make_and_the_target_names_that_they_reserve(arm: WorstCaseObjective, tmp_path: Path) -> None:
    cmake, make = need("cmake"), need("make")
    need_compiler()
    prefixes, user = ("test", "all", "install", "clean", "Arm_C"), tmp_path / "user"
    for folder in (*prefixes, "user"):
        (tmp_path / folder).mkdir()
    for prefix in prefixes:
        export(arm, tmp_path / prefix, prefix=prefix, posture=arm.robot.posture(), check=False)
    folders = "\n".join(f"add_subdirectory({prefix})" for prefix in prefixes)
    (tmp_path / "CMakeLists.txt").write_text(f"cmake_minimum_required(VERSION 3.16)\nproject(user C)\n{folders}\n")
    run([cmake, "-S", ".", "-B", "build", f"-DCMAKE_INSTALL_PREFIX={tmp_path / 'there'}"], tmp_path)
    run([cmake, "--build", "build", "--target", "Arm_C_library"], tmp_path)
    run([cmake, "--install", "build/Arm_C"], tmp_path)
    run([cmake, "-S", "test", "-B", "alone"], tmp_path)
    run([cmake, "--build", "alone"], tmp_path)
    assert "agrees" in run(["alone/example"], tmp_path)
    run([make, "-s", "CFLAGS=-O0", "check"], tmp_path / "all")
    (user / "CMakeLists.txt").write_text(
        "cmake_minimum_required(VERSION 3.16)\nproject(controller C)\nfind_package(Arm_C REQUIRED)\n"
        "add_executable(controller main.c)\ntarget_link_libraries(controller PRIVATE Arm_C::Arm_C)\n"
    )
    (user / "main.c").write_text(
        "#include <Arm_C.h>\n"
        "int main(void) { double v, g[ARM_C_NV]; return Arm_C_objective(Arm_C_posture, &v, g); }\n"
    )
    run([cmake, "-S", ".", "-B", "build", f"-DCMAKE_PREFIX_PATH={tmp_path / 'there'}"], user)
    run([cmake, "--build", "build"], user)
    run(["build/controller"], user)


def test_a_prefix_that_hides_a_header_of_c(arm: WorstCaseObjective, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"name of the C header math\.h"):
        export(arm, tmp_path, prefix="math")


@pytest.fixture(scope="module")
def plain_export(two: tuple[WorstCaseObjective, ...], tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("two")
    export(two, folder, prefix="two", posture=two[0].robot.posture(), check=False)
    return folder


def test_example_under_valgrind(plain_export: Path, tmp_path: Path) -> None:
    valgrind, compiler = need("valgrind"), need_compiler()
    target = tmp_path / "example"
    run_compiler([*compiler, "-std=c99", "-O0", "-g", "example.c", "two.c", "-o", str(target), "-lm"], plain_export)
    output = run([valgrind, "--error-exitcode=9", "--leak-check=full", str(target)], tmp_path)
    assert "ERROR SUMMARY: 0 errors" in output and "total heap usage: 1 allocs" in output  # printf's buffer


def test_example_under_sanitizers(plain_export: Path, tmp_path: Path) -> None:
    compiler, target = need_compiler(), tmp_path / "example"
    flags = ["-std=c99", "-O0", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
    try:
        run_compiler([*compiler, *flags, "example.c", "two.c", "-o", str(target), "-lm"], plain_export)
    except CompilerError as error:
        pytest.skip(f"{compiler[0]} has no sanitizers: {error.what}")
    assert "agrees" in run([str(target)], tmp_path)


# ---- the folder ---------------------------------------------------------------------------------------------------


def test_folder_is_replaced_only_if_it_is_an_export(arm: WorstCaseObjective, tmp_path: Path) -> None:
    out = tmp_path / "project"
    out.mkdir()
    # A folder with a file named like a manifest is not yet an export.
    (out / "arm.json").write_text('{"name": "mine"}')
    for force in (False, True):
        with pytest.raises(OutputError):
            write_export([arm], out, prefix="arm", force=force)
    assert [p.name for p in out.iterdir()] == ["arm.json"]
    ours = tmp_path / "ours"
    write_export([arm], ours, prefix="first")
    with pytest.raises(OutputError, match="`force`"):
        write_export([arm], ours, prefix="second")
    assert (ours / "first.c").is_file()
    written = write_export([arm], ours, prefix="second", force=True)
    assert sorted(p.name for p in ours.iterdir()) == sorted([RECORD, *(p.name for p in written.files)])


def test_build_in_the_folder(arm: WorstCaseObjective, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    need_compiler()
    written = write_export([arm], tmp_path / "c", prefix="arm", build=True, posture=arm.robot.posture())
    assert written.library is not None and written.library.is_file()
    q = sample_postures(arm.robot, 1, 31)[0]
    H, _ = ImpactGradient.load(tmp_path / "c", robot=arm.robot).objective(q)
    assert {path.name for path in (tmp_path / "c").glob("lib*")} <= set(products("arm")), "--force replaces them"
    assert pytest.approx(arm.value(q), rel=1e-10) == H
    assert (tmp_path / "c" / "libarm.so.sha256").is_file()
    monkeypatch.setenv("PATH", str(tmp_path))
    without = write_export([arm], tmp_path / "none", prefix="arm", build=True)
    assert without.library is None and "install gcc or clang" in without.verdict
    assert (tmp_path / "none" / "arm.c").is_file()


@pytest.mark.parametrize("how", ["compiler fails", "other numbers", "interrupted"])
def test_a_build_that_fails_leaves_what_was_there(
    arm: WorstCaseObjective, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, how: str
) -> None:
    need_compiler()
    kept = tmp_path / "kept"
    write_export([arm], kept, prefix="old")
    before = {path.name: path.read_bytes() for path in kept.iterdir()}
    error: type[BaseException] = CompilerError
    monkeypatch.setenv("CFLAGS", "-O0")
    if how == "compiler fails":
        monkeypatch.setenv("CC", need("false"))
    elif how == "other numbers":
        monkeypatch.setattr("impact_posture.codegen.compile_and_check._ORACLE_TOLERANCE", -1.0)
        monkeypatch.setattr("impact_posture.codegen.compile_and_check.self_test_tolerance", lambda *_: -1.0)
    else:
        error = KeyboardInterrupt

        def interrupt(*_: object) -> None:
            raise KeyboardInterrupt

        monkeypatch.setattr("impact_posture.system.libraries.run_compiler", interrupt)
    for out in (kept, tmp_path / "none"):
        with pytest.raises(error):
            write_export([arm], out, prefix="arm", build=True, force=True)
    assert {path.name: path.read_bytes() for path in kept.iterdir()} == before
    assert [path.name for path in tmp_path.iterdir()] == ["kept"]


# ---- the command --------------------------------------------------------------------------------------------------


def call(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return command.run("codegen", *arguments, cwd=folder)


def test_command_for_a_robot(tmp_path: Path) -> None:
    need_compiler()
    push = ("tilthex_arm", "--normal", "0", "0", "1", "--frame", "ee", "--frame", "base_link", "--prefix", "two")
    done = call(tmp_path, *push, "--float", "--compile", "--json")
    assert done.returncode == 0, done.stderr
    document = json.loads(done.stdout)
    assert document["library"] == "libtwo.so" and document["real"] == "float"
    assert (tmp_path / "two-c" / "libtwo.so").is_file()
    built = {"libtwo.so", "libtwo.so.sha256", RECORD}
    assert set(document["files"]) == {p.name for p in (tmp_path / "two-c").iterdir()} - built
    assert "two_ee_eval_batch" in document["functions"]
    again = call(tmp_path, *push)
    assert again.returncode == 1 and "exists" in again.stderr and again.stderr.count("\n") == 1


def test_command_for_a_result(tmp_path: Path) -> None:
    solve = ("tilthex_arm", "--normal", "0", "0", "1", "--objective", "speed", "--starts", "1", "--out", "r")
    quick = ("--no-codegen", "--format", "png", "--compile", "never", "--jobs", "1")
    assert command.run("optimize", *solve, *quick, cwd=tmp_path).returncode == 0
    done = call(tmp_path, "r", "--out", "c", "--quiet")
    assert done.returncode == 0, done.stderr
    result = json.loads((tmp_path / "r" / "result.json").read_text())
    manifest = json.loads(next((tmp_path / "c").glob("*.json")).read_text())
    assert manifest["posture"] == result["optimal"]["q"]
    assert manifest["objective"] == "speed"
    assert manifest["model_sha256"] == result["robot"]["model_sha256"]
    wrong = call(tmp_path, "r", "--metric", "kinetic")
    assert wrong.returncode == 2 and "--metric contradicts RESULT_DIR" in wrong.stderr


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (("tilthex_arm",), 2, "--normal"),
        (("tilthexarm", "--normal", "0", "0", "1"), 1, "tilthex_arm"),
        (("tilthex_arm", "--normal", "0", "0", "1", "--frame", "eee"), 1, "no frame 'eee'"),
        (("tilthex_arm", "--normal", "0", "0", "1", "--prefix", "1x"), 2, "not a C identifier"),
        (("tilthex_arm", "--normal", "0", "0", "1", "--prefix", "math"), 2, "C header math.h"),
    ],
)
def test_command_refuses(tmp_path: Path, arguments: tuple[str, ...], code: int, message: str) -> None:
    done = call(tmp_path, *arguments)
    assert done.returncode == code and message in done.stderr
    assert not list(tmp_path.iterdir())


def test_one_library_checks_a_source_with_any_posture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    need_compiler()
    monkeypatch.setenv("IMPACT_POSTURE_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("CFLAGS", "-O0")
    objective = WorstCaseObjective(load_robot("panda"), ImpactContact("panda_link8", (0, 0, 1)))
    written = []
    for number, posture in enumerate(sample_postures(objective.robot, 2, 0)):
        (folder := tmp_path / str(number)).mkdir()
        written.append(export(objective, folder, posture=posture))
    assert written[0].agreement == written[1].agreement and written[0].manifest != written[1].manifest
    (library,) = (tmp_path / "cache" / "exports").glob("*.so")
    # A damaged library is rebuilt.  If the cache is not writable, the library is built in another folder.
    library.unlink()
    library.write_bytes(b"")
    assert export(objective, folder, posture=posture, force=True).agreement == written[0].agreement
    assert library.stat().st_size > 1000
    monkeypatch.setenv("IMPACT_POSTURE_CACHE", "/proc/nothing")
    assert export(objective, folder, posture=posture, force=True).agreement == written[0].agreement
