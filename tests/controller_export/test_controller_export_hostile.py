"""Calling errors that an exported controller rejects, and states that no robot can have."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from impact_posture.controller_export.compiled_controller import CompiledController
from impact_posture.controller_export.controller_structure import structure_of
from impact_posture.controller_export.export_controller import export_controller
from impact_posture.errors import InputError, ManifestMismatch, SpecError
from impact_posture.system.libraries import library_path
from impact_posture.system.toolchain import find_compiler
from impact_posture.tsid.controller import Status
from impact_posture.tsid.task_formulation import TaskFormulation
from impact_posture.tsid.tasks.body_tasks import CenterOfMass
from impact_posture.tsid.tasks.joint_posture import JointPosture
from tests.support.command import run
from tests.support.exported_controller import ABUSE, abuse_program, compiled, exported, formulation_of, impact_of
from tests.support.tools import need

STRICT = ["-Wall", "-Wextra", "-Wconversion", "-pedantic", "-Werror"]


def compile_c(folder: Path, *flags: str) -> subprocess.CompletedProcess[str]:
    command = [*(find_compiler() or ["cc"]), "-std=c99", "-isystem", "daqp", *flags]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True)


def abuse_with(sanitizers: str, folder: Path, program: Path, *more: str) -> None:
    """Build the abuse program with the controller sources and sanitizers; skip the test if the build fails."""
    flags = [f"-fsanitize={sanitizers}", "-fno-sanitize-recover=all", "-O0", "-g0", f"-I{folder}", str(ABUSE)]
    sources = ["ctl.c", "ctl_defaults.c", "ctl_dynamics.c", "ctl_relaxation.c", "ctl_daqp.c", *more]
    built = compile_c(folder, *flags, *sources, "-o", str(program), "-lm", "-lpthread")
    if (built.returncode and "sanit" in built.stderr + built.stdout) or "cannot find -l" in built.stderr:
        pytest.skip(f"the compiler has no -fsanitize={sanitizers}")
    assert built.returncode == 0, built.stderr


@pytest.mark.parametrize(("name", "frame"), [("panda", None), ("solo8", None), ("tilthex_arm", "ee")])
def test_no_state_leads_to_undefined_behavior_or_out_of_the_limits(
    name: str, frame: str | None, tmp_path: Path, hostile_full: bool
) -> None:
    if name != "panda" and not hostile_full:
        pytest.skip("--hostile-full: compilers take long to put sanitizers into straight-line code")
    robot = formulation_of(name)[0]
    folder = exported(name, None if frame is None else impact_of(robot, frame, (0.0, 0.0, 1.0)))
    abuse_with("address,undefined", folder, tmp_path / "abuse", *([] if frame is None else ["ctl_metric.c"]))
    ran = subprocess.run([tmp_path / "abuse"], capture_output=True, text=True)
    assert ran.returncode == 0, ran.stdout + ran.stderr


def test_contexts_in_threads_share_nothing(tmp_path: Path) -> None:
    abuse_with("thread", exported("panda"), tmp_path / "abuse")
    ran = subprocess.run([tmp_path / "abuse", "80", "3"], capture_output=True, text=True)
    if "unexpected memory mapping" in ran.stderr:
        pytest.skip("this kernel places memory where the thread sanitizer does not expect it")
    assert ran.returncode == 0, ran.stdout + ran.stderr


@pytest.mark.long(but=("tilthex_arm",))
@pytest.mark.parametrize("name", ["panda", "tilthex_arm"])
def test_ten_thousand_random_ticks_take_no_memory_and_stay_within_the_limits(name: str, tmp_path: Path) -> None:
    program = abuse_program(exported(name), tmp_path)
    ran = subprocess.run([program, "10000"], capture_output=True, text=True)
    assert ran.returncode == 0 and ran.stdout.startswith("growth 0 B, 0 kB"), ran.stdout


def test_no_tick_reads_unwritten_memory(tmp_path: Path) -> None:
    """valgrind also reports reads and writes outside arrays."""
    valgrind, program = need("valgrind"), abuse_program(exported("panda"), tmp_path)
    ran = subprocess.run([valgrind, "-q", "--error-exitcode=9", program, "24"], capture_output=True, text=True)
    assert ran.returncode == 0 and not ran.stderr, ran.stderr


@pytest.mark.parametrize("name", ["tilthex_arm", "solo8"])
def test_the_code_has_no_warnings(name: str) -> None:
    sources = ("ctl.c", "ctl_defaults.c", "ctl_dynamics.c", "ctl_relaxation.c")
    checked = compile_c(exported(name), *STRICT, "-fsyntax-only", *sources)
    assert checked.returncode == 0, checked.stderr


def test_a_held_command_is_within_its_limits_and_damps_the_joints() -> None:
    controller = compiled("panda")
    robot = formulation_of("panda")[0]
    q, v = robot.posture(), np.zeros(robot.nv)
    first = controller.reset(q, v)
    for wrong in (np.nan, 1e200):
        held = controller.tick(0.0, np.full(robot.nq, wrong), v)
        assert held.status is Status.NON_FINITE
        assert np.array_equal(held.u, first.u)
    # The controller ignores a velocity that no sensor can measure, and repeats the last command.
    for rate in (2e8, -np.inf, np.nan):
        glitch = v.copy()
        glitch[0] = rate
        assert np.array_equal(controller.tick(0.0, q, glitch).u, first.u)
    fast = controller.tick(np.nan, q, v + 1.0)
    assert fast.status is Status.NON_FINITE
    assert (fast.u <= first.u).all() and (fast.u < first.u).any()
    assert controller.tick(0.0, q, v).status is Status.SOLVED


@given(data=st.data())
def test_init_refuses_invalid_parameters(data: st.DataObject) -> None:
    controller = compiled("solo8")
    name = data.draw(st.sampled_from(sorted(controller.parameters)))
    values = controller.parameters[name]
    k = data.draw(st.integers(0, values.size - 1))
    before = values[k]
    values[k] = np.nan
    robot = formulation_of("solo8")[0]
    with pytest.raises(InputError, match="out of range") as refused:
        controller.reset(robot.posture(), np.zeros(robot.nv))
    assert name in str(refused.value)
    values[k] = before
    assert controller.reset(robot.posture(), np.zeros(robot.nv)).status is Status.SOLVED


def test_limits_that_contradict_each_other_are_refused() -> None:
    controller = compiled("panda")
    robot = formulation_of("panda")[0]
    controller.parameters["control_lower"][0] = 1e3
    with pytest.raises(InputError, match="control_upper"):
        controller.reset(robot.posture(), np.zeros(robot.nv))


def test_tasks_without_c_code_are_refused_by_name(tmp_path: Path) -> None:
    class Strange(JointPosture):
        pass

    robot, _ = formulation_of("panda")
    with pytest.raises(InputError, match=r"'mine' \(Strange\) has no C code"):
        structure_of(robot, TaskFormulation(posture=Strange(robot, name="mine")))
    humanoid, formulation = formulation_of("talos")
    with pytest.raises(InputError, match="no task uses the objective"):
        export_controller(
            humanoid, formulation, tmp_path / "x", objective=impact_of(humanoid, "base_link", (1, 0, 0))
        )
    assert CenterOfMass in {type(task) for task in formulation.weighted}
    assert not (tmp_path / "x").exists()


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("nq", 8),
        ("nv", 10**9),
        ("sizes", {"CONTROLS": 10**9}),
        ("sources", ["../evil.c"]),
        ("parameters", {"kp": -1}),
    ],
)
def test_a_changed_manifest_is_refused_before_anything_is_sized(key: str, value: object, tmp_path: Path) -> None:
    folder = shutil.copytree(exported("panda"), tmp_path / "copy")
    manifest = json.loads((folder / "ctl.json").read_text(encoding="utf-8"))
    manifest[key] = manifest[key] | value if isinstance(value, dict) else value
    (folder / "ctl.json").write_text(json.dumps(manifest), encoding="utf-8")
    with pytest.raises((SpecError, ManifestMismatch)):
        CompiledController.load(folder)


def test_the_controller_of_another_robot_is_refused() -> None:
    with pytest.raises(ManifestMismatch):
        CompiledController.load(exported("panda"), robot=formulation_of("solo8")[0])


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["solo8", "--controller", "aerial"], "try legged"),
        (["panda", "--controller", "arm", "--float"], "--controller always writes C99"),
        (["panda", "--daqp", "x", "--normal", "0", "0", "1"], "belong to --controller"),
        (["panda", "--controller", "arm", "--scenario", "solo8-push"], "has another robot than panda: give solo8"),
        (["panda", "--controller", "arm", "--daqp", "/nowhere"], "has no file"),
        (["panda", "--controller", "arm", "--frame", "panda_hand"], "belongs to an impact"),
    ],
)
def test_the_command_says_what_is_wrong_in_a_line(arguments: list[str], words: str, tmp_path: Path) -> None:
    ran = run("codegen", *arguments, "--out", str(tmp_path / "out"))
    assert ran.returncode in (1, 2)
    assert words in " ".join(ran.stderr.split())
    assert "Traceback" not in ran.stderr
    assert not (tmp_path / "out").exists()


def test_cmake_builds_two_controllers_into_a_program_one_with_an_installed_daqp(tmp_path: Path) -> None:
    cmake = need("cmake")
    folder, other = exported("panda"), tmp_path / "other"
    export_controller(*formulation_of("panda"), other, prefix="other", daqp=folder / "daqp")
    run_one = """
static int run_ctl(double *u) {
  ctl_context *c = malloc(sizeof *c); ctl_params p; ctl_command out;
  double q[CTL_NQ] = {0}, v[CTL_NV] = {0};
  ctl_default_params(&p);
  if (ctl_init(c, &p) || ctl_reset(c, q, v, &out) || out.status > CTL_RELAXED) return 1;
  memcpy(u, out.u, sizeof out.u);
  return 0;
}
"""
    (tmp_path / "main.c").write_text(
        '#include "ctl.h"\n#include "other.h"\n#include <stdlib.h>\n#include <string.h>\n'
        + run_one
        + run_one.replace("ctl", "other").replace("CTL", "OTHER")
        + "int main(void) {\n  double u[2][CTL_CONTROLS];\n"
        "  return run_ctl(u[0]) || run_other(u[1]) || memcmp(u[0], u[1], sizeof u[0]);\n}\n"
    )
    (tmp_path / "CMakeLists.txt").write_text(
        "cmake_minimum_required(VERSION 3.16)\nproject(user C)\n"
        f'file(GLOB daqp "{folder}/daqp/*.c")\nadd_library(installed EXCLUDE_FROM_ALL ${{daqp}})\n'
        f'add_subdirectory("{folder}" controller)\nadd_subdirectory(other)\n'
        "add_executable(user main.c)\ntarget_link_libraries(user PRIVATE ctl::ctl other::other)\n"
    )
    build = tmp_path / "build"
    options = ["-DCMAKE_C_FLAGS_RELEASE=-O0", "-Dother_DAQP=installed"]
    for command in ([cmake, "-S", tmp_path, "-B", build, *options], [cmake, "--build", build], [build / "user"]):
        subprocess.run(command, check=True, capture_output=True)
    names = subprocess.run(
        [need("nm"), "-g", "--defined-only", library_path(folder, "ctl")], capture_output=True, text=True
    )
    assert all(line.split()[-1].startswith("ctl_") for line in names.stdout.splitlines()), names.stdout
