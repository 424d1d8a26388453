"""The installed ``impact-posture``: commands, JSON, exit codes, one-line errors, and how fast the help appears."""

from __future__ import annotations

import errno
import functools
import json
import os
import resource
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from impact_posture import __version__
from impact_posture.errors import Infeasible, SolverFailed
from impact_posture.robot.robot_loader import known_robots
from impact_posture_cli import error_boundary as boundary
from impact_posture_cli.argv import split_vectors
from tests.support.command import run as start
from tests.support.command import succeed
from tests.support.helpers import relative, robot
from tests.support.pinocchio_values import frame_jacobian, mass_matrix

COMMAND = Path(sys.executable).parent / "impact-posture"
HEAVY = ("numpy", "casadi", "pinocchio", "matplotlib", "pydantic", "scipy", "yaml")
INSPECT = ("inspect", "tilthex_arm")
PUSH = ("evaluate", "tilthex_arm", "--normal", "0", "0", "1")


@functools.cache
def document(*arguments: str) -> dict[str, Any]:
    """Return the JSON document of a successful run, parsed strictly."""

    def refuse(constant: str) -> None:
        raise AssertionError(f"{constant} is not JSON")

    done = start(*arguments, "--json")
    assert (done.returncode, done.stderr) == (0, "")
    parsed = json.loads(done.stdout, parse_constant=refuse)
    assert isinstance(parsed, dict)
    return parsed


# ---- printed results --------------------------------------------------------------------------------------------


def test_help_comes_at_once_and_names_the_commands() -> None:
    times = []
    for _ in range(3):
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        done = subprocess.run([str(COMMAND), "--help"], capture_output=True, text=True, timeout=60)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        # Measure processor time instead of elapsed time, because the machine may be busy.
        times.append(after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime)
        assert done.returncode == 0
        if times[-1] < 1.0:
            break
    for name in ("robots", "inspect", "evaluate", "optimize", "plot"):
        assert f" {name} " in done.stdout
    # The help must appear within 0.3 s plus a margin for slow processors.
    assert min(times) < 1.0


def test_help_imports_nothing_heavy() -> None:
    code = (
        "import atexit, sys\nfrom impact_posture_cli.main import main\n"
        f"atexit.register(lambda: print('heavy:', *[m for m in {HEAVY} if m in sys.modules]))\n"
        "sys.argv = ['impact-posture', '--help']\nmain()\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert "evaluate" in done.stdout
    assert done.stdout.splitlines()[-1] == "heavy:"


def test_exit_handlers_run() -> None:
    code = (
        "import atexit, sys\nfrom impact_posture_cli import main, process\n"
        "begin = process.prepare\n"
        "def prepare():\n    begin()\n    atexit.register(print, 'the end')\n"
        "main.prepare = prepare\n"
        "sys.argv = ['impact-posture', *sys.argv[1:]]\nmain.main()\n"
    )
    for argument, expected in (("--version", 0), ("--nonsense", 2)):
        done = subprocess.run([sys.executable, "-c", code, argument], capture_output=True, text=True, timeout=60)
        assert (done.returncode, done.stdout.splitlines()[-1]) == (expected, "the end")


@pytest.mark.parametrize(
    ("arguments", "code"), [(("--version",), 0), (("evalute",), 2), (("inspect", "nowhere"), 1)], ids=lambda a: str(a)
)
def test_the_module_is_the_same_program(arguments: tuple[str, ...], code: int) -> None:
    done = start(*arguments)
    command = [sys.executable, "-m", "impact_posture", *arguments]
    module = subprocess.run(command, capture_output=True, text=True, timeout=60, env=os.environ | {"COLUMNS": "80"})
    assert (module.returncode, module.stdout, module.stderr) == (code, done.stdout, done.stderr)
    assert code or done.stdout == f"impact-posture {__version__}\n"


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("op", ["optimize"]),
        ("optimize --contact-s", ["--contact-stiffness"]),
        ("evaluate panda --metric k", ["kinetic"]),
    ],
)
def test_the_shell_completes_commands_options_and_choices(words: str, expected: list[str]) -> None:
    count = str(len(words.split()))
    request = {"COMP_WORDS": f"impact-posture {words}", "COMP_CWORD": count}
    done = start("robots", env=request | {"_IMPACT_POSTURE_COMPLETE": "complete_bash"})
    assert (done.returncode, done.stderr, done.stdout.split()) == (0, "", expected)


def test_the_shell_gets_a_script_for_completion() -> None:
    done = start("robots", env={"_IMPACT_POSTURE_COMPLETE": "source_bash"})
    assert done.returncode == 0 and "_IMPACT_POSTURE_COMPLETE=complete_bash" in done.stdout
    assert {"--install-completion", "--show-completion"} <= set(start("--help").stdout.split())


def test_robots() -> None:
    listed = document("robots")
    assert [entry["name"] for entry in listed["robots"]] == list(known_robots())
    assert any("example-robot-data:" in way for way in listed["ways_to_name"])
    page = start("robots")
    assert page.returncode == 0 and page.stderr == ""
    assert all(name in page.stdout for name in known_robots())
    assert max(len(line) for line in page.stdout.splitlines()) <= 80


def test_inspect_shows_joints_frames_postures_and_rotors() -> None:
    summary, loaded = document("inspect", "tilthex_arm"), robot("tilthex_arm")
    assert [j["name"] for j in summary["joints"]] == list(loaded.joint_names)
    elbow = summary["joints"][2]
    assert (elbow["lower"], elbow["upper"]) == (-2.4, 2.4)
    assert (elbow["effort"], elbow["armature"]) == (3.0, 0.01)
    assert summary["mass"] == pytest.approx(loaded.mass)
    assert "ee" in [f["name"] for f in summary["frames"] if f["link"]]
    assert {p["name"] for p in summary["postures"]} >= {"home", "tucked"}
    assert summary["contact"]["frame"] == "ee"
    assert summary["actuation"]["rank"] == 6
    assert all(at["feasible"] for at in summary["actuation"]["postures"])
    assert 0 < summary["actuation"]["postures"][0]["lateral_force"]["left"] < 10


def test_inspect_pages_fit_the_terminal() -> None:
    for name in ("panda", "tilthex_arm", "talos"):
        page = succeed("inspect", name)
        assert ("fixed to the world" in page.stdout) == (name == "panda")
        assert max(len(line) for line in page.stdout.splitlines()) <= 80
    assert "left_sole_link (surface)" in page.stdout
    assert "half_sitting" in page.stdout


def test_evaluate_numbers_against_pinocchio() -> None:
    output = document(
        *PUSH, "--objective", "impulse", "--speed", "0.5", "--restitution", "0.2", "--offset", "0", "0", "0.02"
    )
    loaded = robot("tilthex_arm")
    q, n = loaded.posture(), np.array([0.0, 0.0, 1.0])
    M = mass_matrix(loaded.model, q)
    J = frame_jacobian(loaded.model, q, loaded.frame_id("ee"), (0, 0, 0.02))[:3]
    A = np.linalg.inv(M) @ J.T
    a, G = A @ n, n @ J @ A @ n
    stuck = A @ np.linalg.inv(J @ A) @ n
    block = output["evaluation"]
    H, S = a @ a, stuck @ stuck
    expected = {"H": H, "G": G, "V": H / G**2, "S": S, "E": 0.5 / G, "effective_mass": 1 / G, "objective": H}
    for key, value in expected.items():
        assert block[key] == pytest.approx(value, rel=1e-9), key
    assert relative(block["jump"]["frictionless"]["velocity"], a * 0.6 / G) < 1e-9
    assert relative(block["jump"]["sticking"]["velocity"], stuck * 0.6) < 1e-9
    axes, radii = np.array(block["ellipsoid"]["axes"]), np.array(block["ellipsoid"]["radii"])
    assert relative(axes @ np.diag(radii**2) @ axes.T, A.T @ A) < 1e-9
    assert output["posture"] == "home" and output["robot"]["armature"][6:] == [0.01] * 3
    assert set(output["classical"]) == {"velocity", "force"}


def test_evaluate_prints_all_quantities() -> None:
    task = ("--frame", "torso_2_link", "--normal", "-1", "0", "0", "--speed", "0.5", "--contact-point", "front")
    page = start("evaluate", "talos", *task)
    # The springs of the arms are not known.
    assert page.returncode == 0 and [line[:26] for line in page.stderr.splitlines()] == ["warning: x is unknown: the"]
    assert max(len(line) for line in page.stdout.splitlines()) <= 80
    for words in (
        "torso_2_link", "-1.000  0.000  0.000", "left_sole_link (surface)", "compliance", "standing", "free", "1/kg",
        "effective mass", "ellipsoid", "gradient of H", "sticking", "N·s", "rad/s", "dominates H", "SRDF",
    ):  # fmt: skip
        assert words in page.stdout, words


def test_quiet_leaves_the_result_alone() -> None:
    arguments = ("evaluate", "hextilt", "--normal", "1", "0", "0")
    loud, quiet = start(*arguments), start(*arguments, "--quiet")
    assert loud.stderr.startswith("warning: armature is zero")
    assert "\nwarning: a flat surface touches flying_arm_5__link_5 first, " in loud.stderr
    assert loud.stderr.count("\n") == 2
    assert (quiet.stderr, quiet.stdout) == ("", loud.stdout)


def test_an_undefined_value_is_null_and_a_warning() -> None:
    arguments = ("evaluate", "ur5", "--frame", "upper_arm_link", "--normal", "1", "1", "1", "--objective", "sticking")
    output = document(*arguments)
    assert output["evaluation"]["S"] is None and output["evaluation"]["objective"] is None
    assert any("S is undefined" in line for line in output["warnings"])
    page = start(*arguments)
    assert page.returncode == 0 and "undefined" in page.stdout and "S is undefined" in page.stderr


def test_options_reach_the_library(tmp_path: Path) -> None:
    state = tmp_path / "state.yaml"
    state.write_text("name: [elbow_pitch]\nposition: [0.5]\n")
    weights = tmp_path / "weights.toml"
    weights.write_text("elbow_pitch = 0.25\n")
    output = document(
        "evaluate", "tilthex_arm", "--contact", "ee:0,0,-1:2", "--normal-frame", "contact", "--posture", str(state),
        "--metric", "weighted", "--weights", str(weights), "--armature", "elbow_pitch=0.02",
        "--lock", "shoulder_roll",
    )  # fmt: skip
    assert output["robot"]["locked"] == ["shoulder_roll"]
    assert output["robot"]["armature"][6:] == [0.01, 0.02]
    assert output["evaluation"]["q"][8] == 0.5
    assert output["metric"]["weights"] == [1.0] * 7 + [0.25]
    assert output["contacts"][0]["normal_frame"] == "contact"
    assert output["evaluation"]["objective"] == pytest.approx(4 * output["evaluation"]["H"])


def test_supports_by_option_without_and_by_default() -> None:
    push = ("evaluate", "solo8", "--normal", "1", "0", "0")
    assert len(document(*push)["supports"]) == 4
    bare = document(*push, "--no-support")
    assert bare["supports"] == [] and bare["support_compliance"] is None and "free" not in bare["evaluation"]
    two = document(*push, "--support", "FL_FOOT", "--support", "HR_FOOT:point")
    assert [s["frame"] for s in two["supports"]] == ["FL_FOOT", "HR_FOOT"]
    assert two["evaluation"]["free"]["H"] == pytest.approx(bare["evaluation"]["H"], rel=1e-12)


# ---- rejected input ---------------------------------------------------------------------------------------------

USAGE = [
    (("evaluate", "tilthex_arm", "--normal", "0", "0", "0"), "--normal"),
    (("evaluate", "tilthex_arm", "--normal", "nan", "0", "1"), "--normal"),
    (("evaluate", "tilthex_arm", "--normal", "0", "1"), "--normal"),
    (("evaluate", "tilthex_arm"), "Missing option '--normal"),
    (("evaluate", "tilthex_arm", "--contact", "ee:0,0,0"), "--contact"),
    ((*PUSH, "--contact", "ee:0,0,1"), "--contact replaces"),
    ((*PUSH, "--support", "ee", "--no-support"), "--no-support"),
    ((*PUSH, "--restitution", "1.5"), "--restitution"),
    ((*PUSH, "--impulse", "0"), "--impulse"),
    ((*PUSH, "--offset", "0", "inf", "0"), "--offset"),
    ((*PUSH, "--metric", "manhattan"), "euclidean"),
    (("optimize", *PUSH[1:], "--target-quaternion", "0", "0", "0", "0"), "norm 0"),
    (("optimize", *PUSH[1:], "--target-quaternion", "0", "nan", "0", "1"), "norm nan"),
    (("evalute",), "evalute"),
]


def test_codegen_of_a_folder_without_a_result_says_so(tmp_path: Path) -> None:
    done = start("codegen", str(tmp_path), "--json")
    assert done.returncode == 1 and json.loads(done.stdout)["error"]["what"] == "holds no result.json"


@pytest.mark.parametrize(("arguments", "words"), USAGE, ids=[" ".join(a) for a, _ in USAGE])
def test_a_wrong_command_line_is_exit_2(arguments: tuple[str, ...], words: str) -> None:
    done = start(*arguments, "--json")
    assert done.returncode == 2
    assert done.stderr.startswith("Usage: impact-posture") and words in done.stderr
    error = json.loads(done.stdout)["error"]
    assert set(error) == {"code", "kind", "what", "where", "hint"}
    assert error["code"] == 2 and words in error["what"]


ERRORS = [
    (("inspect", "tilthexarm"), "RobotNotFound", "did you mean tilthex_arm"),
    ((*PUSH, "--frame", "upperarm"), "FrameNotFound", "upper_arm"),
    ((*INSPECT, "--lock", "elbow"), "JointNotFound", "did you mean elbow_pitch"),
    ((*INSPECT, "--armature", "shoulder_rol=1"), "JointNotFound", "did you mean shoulder_roll"),
    ((*INSPECT, "--armature", "default=0.05"), "InputError", "for all joints, set [armature] default in robot.toml"),
    ((*PUSH, "--posture", "hom"), "PostureNotFound", "did you mean home"),
    ((*PUSH, "--posture", "nowhere.json"), "PostureError", "nowhere.json: no such file"),
    ((*PUSH, "--support", "tipp"), "FrameNotFound", "did you mean tip"),
    ((*PUSH, "--weights", "velocity-limits"), "MetricError", "add --metric weighted"),
    (("inspect", "nowhere/arm.urdf"), "UrdfError", "nowhere/arm.urdf: no such file"),
    (
        ("inspect", "example-robot-data:panda_description/urdf/pnda.urdf"),
        "PackageNotFound",
        "panda_description/urdf/panda.urdf",
    ),
]


@pytest.mark.parametrize(("arguments", "kind", "words"), ERRORS, ids=[" ".join(a[0][1:]) for a in ERRORS])
def test_an_error_is_one_line_and_exit_1(arguments: tuple[str, ...], kind: str, words: str) -> None:
    done = start(*arguments, "--json")
    assert done.returncode == 1
    assert done.stderr.startswith("error: ") and done.stderr.count("\n") == 1
    assert words in done.stderr
    error = json.loads(done.stdout)["error"]
    assert (error["code"], error["kind"]) == (1, kind)
    line = f"{error['where']}: {error['what']}" if error["where"] else error["what"]
    assert done.stderr == f"error: {line}; {error['hint']}\n"


def test_a_package_folder_is_looked_for_where_the_user_is(tmp_path: Path) -> None:
    (tmp_path / "meshes").mkdir()
    done = start(*INSPECT, "--package-dir", "mesh", cwd=tmp_path)
    assert done.returncode == 1 and "did you mean meshes?" in done.stderr and done.stdout == ""
    succeed(*INSPECT, "--package-dir", "meshes", cwd=tmp_path)


@pytest.mark.parametrize("normal", [["0,-0.6,0.8"], ["0,", "-0.6,", "0.8"], ["[0, -0.6, 0.8]"], ["0 -0.6 0.8"]])
def test_vectors_may_have_commas_and_brackets(normal: list[str]) -> None:
    plain = document("evaluate", "ur5", "--normal", "0", "-0.6", "0.8")
    assert document("evaluate", "ur5", "--normal", *normal) == plain
    assert split_vectors(["--normal=0,0,1", "a,b", "--box", "1", "2"], {"--normal": 3, "--box": 3}) == [
        *("--normal", "0", "0", "1"), "a,b", "--box", "1", "2",
    ]  # fmt: skip


# ---- error boundary ---------------------------------------------------------------------------------------------


class Raises:
    """Command for this test that raises an error."""

    def __init__(self, error: BaseException) -> None:
        self.error = error

    def main(self, **_: object) -> None:
        raise self.error


BOUNDARY = [
    (Infeasible({"elbow": 0.25}), 3, "error: problem: the constraints conflict: elbow (off by 0.25); relax"),
    (Infeasible({"e": 1.0}, {"e": "needs 2 N"}), 3, "error: problem: the constraints conflict: e (needs 2 N); relax"),
    (SolverFailed("no start converged", hint="more --starts"), 4, "error: no start converged; more --starts"),
    (KeyboardInterrupt(), 130, "error: interrupted\n"),
    (OSError(errno.ENOSPC, "No space left on device", "out"), 1, "error: out: No space left on device; free some"),
    (PermissionError(errno.EACCES, "Permission denied", "out"), 1, "error: out: Permission denied; check the path"),
    (RecursionError("maximum recursion depth exceeded"), 1, "error: an input is nested too deeply; correct the file"),
    (MemoryError(), 1, "error: out of memory; free some"),
    (RuntimeError("std::bad_alloc"), 1, "error: out of memory; free some"),
    (ValueError("two\nlines"), 1, "error: internal error: ValueError: two lines; please report it"),
]


@pytest.mark.parametrize(("error", "code", "line"), BOUNDARY, ids=[type(e).__name__ for e, _, _ in BOUNDARY])
def test_exceptions_become_one_line(
    error: BaseException, code: int, line: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv(boundary.DEBUG_VARIABLE, raising=False)
    assert boundary.run(Raises(error), ["optimize", "--json"]) == code
    out, err = capsys.readouterr()
    assert err.startswith(line) and err.count("\n") == 1
    assert json.loads(out)["error"]["code"] == code
    assert boundary.run(Raises(error), ["optimize"]) == code
    assert capsys.readouterr().out == ""


def test_the_debug_variable_prints_a_traceback(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(boundary.DEBUG_VARIABLE, "1")
    assert boundary.run(Raises(ValueError("wrong")), []) == 1
    assert "Traceback" in capsys.readouterr().err


def test_a_long_wait_is_estimated_from_the_pace_so_far() -> None:
    from impact_posture_cli.progress_line import _time_left

    assert _time_left(30.0, 10, 20) == ", 0:01:00 left"
    # No remaining time is shown before the first item is finished, or after the last item.
    assert [_time_left(1.0, 10, 20), _time_left(30.0, 0, 20), _time_left(30.0, 30, 0)] == ["", "", ""]
