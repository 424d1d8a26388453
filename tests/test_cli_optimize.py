"""``optimize`` and ``plot`` as a user runs them: what they write, and what they refuse."""

from __future__ import annotations

import contextlib
import json
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from impact_posture import plot
from impact_posture.plot.view import header_lines
from impact_posture.result_folder import load_view
from tests.command import run

COMMAND = Path(sys.executable).parent / "impact-posture"
FAST = ("--starts", "2", "--jobs", "1", "--no-codegen", "--format", "png")


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One result of the main job, pictures and C code included."""
    folder = tmp_path_factory.mktemp("main-job")
    done = run("optimize", "tilthex_arm", "--frame", "ee", "--normal", 0, 0, 1, cwd=folder, pictures=True)
    assert done.returncode == 0, done.stderr
    return folder / "tilthex_arm-ee"


def test_main_job_leaves_everything(result: Path) -> None:
    names = {p.name for p in result.iterdir()}
    assert {"result.json", "result.npz", "posture.json", "problem.toml", "c"} <= names
    for figure in ("ellipsoid", "postures", "jump", "nullspace"):
        assert (result / f"{figure}.png").stat().st_size > 3000
    assert not [name for name in names if name.endswith((".svg", ".pdf"))]
    # Only where it is asked for.
    assert not (result / "tradeoff.png").exists()
    assert "tradeoff" not in json.loads((result / "result.json").read_text())
    assert any((result / "c").glob("*.c")) and any((result / "c").glob("*.h"))
    assert not [p for p in result.parent.iterdir() if p.name.startswith(".")]


def test_result_json_has_the_contract_keys(result: Path) -> None:
    document = json.loads((result / "result.json").read_text())
    assert document["schema"] == "impact-posture/result/1"
    top = "robot contacts supports support_compliance metric initial optimal reduction redundancy certificate active"
    assert set(f"{top} solver versions".split()) <= set(document)
    robot = "name source model_sha256 nq nv joint_names root convention armature locked"
    assert set(robot.split()) <= set(document["robot"])
    posture = "q objective H G V S E effective_mass gradient objective_gradient worst_normal ellipsoid pose"
    assert set(posture.split()) <= set(document["optimal"])
    assert {"given_q", "moved", *posture.split()} <= set(document["initial"])
    certificate = "stationarity primal complementarity pose_error_m pose_error_rad limits recomputed_with"
    assert set(certificate.split()) <= set(document["certificate"])
    assert set("status iterations solve_time_s starts feasible_starts optima".split()) <= set(document["solver"])
    assert {"axes", "radii"} <= set(document["optimal"]["ellipsoid"])
    assert {"position", "quaternion_xyzw"} == set(document["optimal"]["pose"])
    before, after = document["initial"]["objective"], document["optimal"]["objective"]
    assert document["reduction"] == pytest.approx(1 - after / before)
    assert len(document["optimal"]["gradient"]) == document["robot"]["nv"]
    radii = document["optimal"]["ellipsoid"]["radii"]
    assert radii == sorted(radii, reverse=True)


def test_result_arrays_match_the_document(result: Path) -> None:
    document = json.loads((result / "result.json").read_text())
    with np.load(result / "result.npz") as arrays:
        assert arrays["optimal_q"] == pytest.approx(document["optimal"]["q"], abs=0)
        jump, n = arrays["optimal_jump"], np.array(document["contacts"][0]["normal"])
        assert jump @ jump == pytest.approx(document["optimal"]["H"], rel=1e-12)
        assert n @ arrays["optimal_ellipsoid"] @ n == pytest.approx(document["optimal"]["H"], rel=1e-9)


def test_solved_again_from_its_own_problem(result: Path, tmp_path: Path) -> None:
    done = run("optimize", result / "problem.toml", "--out", "again", "--json", *FAST[4:], cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    first = json.loads((result / "result.json").read_text())
    again = json.loads(done.stdout)
    for key in ("reduction", "redundancy", "contacts", "metric", "robot"):
        assert again[key] == first[key]
    assert again["optimal"]["q"] == first["optimal"]["q"]


def test_plot_draws_again(result: Path, tmp_path: Path) -> None:
    done = run(
        "plot",
        result,
        "--out",
        tmp_path / "pictures",
        "--format",
        "svg",
        "--figure",
        "ellipsoid",
        cwd=tmp_path,
        pictures=True,
    )
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "pictures" / "ellipsoid.svg").is_file()
    refused = run("plot", tmp_path, cwd=tmp_path)
    assert refused.returncode == 1 and "result.json" in refused.stderr


def test_verify_takes_the_problem_of_a_result(result: Path, tmp_path: Path) -> None:
    done = run("verify", result, "--samples", 1, "--json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    document, known = json.loads(done.stdout), json.loads((result / "result.json").read_text())
    assert document["passed"] and document["robot"]["model_sha256"] == known["robot"]["model_sha256"]
    assert document["contacts"] == known["contacts"] and document["supports"] == known["supports"]
    refused = run("verify", result, "--frame", "ee", cwd=tmp_path)
    assert refused.returncode == 2 and "--frame contradicts RESULT_DIR" in " ".join(refused.stderr.split())


def test_energy_has_one_unit_in_pictures_and_tables(result: Path, tmp_path: Path) -> None:
    (line,) = [line for line in header_lines(load_view(result))[1] if " E " in line]
    assert re.search(r"\bE [\d.]+ → [\d.]+ kg", line), line
    done = run("evaluate", "tilthex_arm", "--normal", 0, 0, 1, cwd=tmp_path)
    assert re.search(r"^ *E +[\d.]+ +kg ", done.stdout, re.MULTILINE), done.stdout


def test_posture_file_starts_the_next_optimization(result: Path, tmp_path: Path) -> None:
    done = run(
        "optimize",
        "tilthex_arm",
        "--normal",
        0,
        0,
        1,
        "--posture",
        result / "posture.json",
        "--json",
        *FAST,
        cwd=tmp_path,
    )
    assert done.returncode == 0, done.stderr
    document = json.loads(done.stdout)
    assert document["reduction"] == pytest.approx(0.0, abs=1e-6)
    assert any("no better posture" in note for note in document["notes"])


def test_human_output_fits_80_columns(tmp_path: Path) -> None:
    done = run("optimize", "solo8", "--normal", 1, 0, 0, *FAST, cwd=tmp_path)
    assert done.returncode == 0
    assert max(len(line.rstrip()) for line in done.stdout.splitlines()) <= 80
    for word in ("constraints", "reduction", "certificate", "base roll", "before", "after"):
        assert word in done.stdout


def test_no_redundancy_is_said(tmp_path: Path) -> None:
    done = run("optimize", "ur5", "--normal", 0, 0, 1, "--contact-pose", "full", *FAST, cwd=tmp_path)
    assert done.returncode == 0
    assert "no redundancy left" in done.stdout


# ---- bad input --------------------------------------------------------------------------------------------------

BASE = ("optimize", "tilthex_arm", "--normal", 0, 0, 1, *FAST)


def refused(done: subprocess.CompletedProcess[str], code: int, *words: str) -> None:
    """One line, the right code, no traceback."""
    assert done.returncode == code, (done.returncode, done.stdout, done.stderr)
    lines = [line for line in done.stderr.splitlines() if line.startswith("error:")]
    assert len(lines) == 1, done.stderr
    assert "Traceback" not in done.stderr
    for word in words:
        assert word in lines[0], lines[0]


def untouched(folder: Path, *expected: str) -> None:
    assert sorted(p.name for p in folder.iterdir()) == sorted(expected)


@pytest.mark.parametrize("normal", [("0", "0", "0"), ("nan", "0", "1"), ("inf", "0", "0"), ("0", "zero", "1")])
def test_normal_without_a_direction_is_a_usage_error(normal: tuple[str, str, str], tmp_path: Path) -> None:
    done = run("optimize", "tilthex_arm", "--normal", *normal, *FAST, cwd=tmp_path)
    assert done.returncode == 2
    assert "--normal" in done.stderr and "Traceback" not in done.stderr
    untouched(tmp_path)


@pytest.mark.parametrize("normal", ["[0, 0, 0]", "[nan, 0, 1]"])
def test_normal_without_a_direction_in_a_file(normal: str, tmp_path: Path) -> None:
    (tmp_path / "p.toml").write_text(f'robot = "tilthex_arm"\nnormal = {normal}\n')
    refused(run("optimize", "p.toml", *FAST, cwd=tmp_path), 1, "normal")
    untouched(tmp_path, "p.toml")


def _posture(folder: Path, q: list[float]) -> str:
    names = ["shoulder_roll", "shoulder_pitch", "elbow_pitch"]
    (folder / "q.json").write_text(json.dumps({"joint_names": names, "q": q}))
    return "q.json"


@pytest.mark.parametrize(
    ("q", "words"),
    [
        ([0, 0, 0, 1, 0, 0, 0, 0, 0.45, -0.9], ("w x y z", "scalar last")),
        ([0, 0, 0, 0, 0, 0, 2, 0, 0.45, -0.9], ("norm",)),
        ([0, 0, 0, 0, 0, 0, 1, 0, 0.45], ("10",)),
        ([0, 0, 0, 0, 0, 0, 1, 0, 0.45, -9.0], ("elbow", "limits")),
        ([0, 0, 0, 0, 0, 0, 1, 0, float("nan"), 0], ("finite",)),
    ],
)
def test_wrong_posture(q: list[float], words: tuple[str, ...], tmp_path: Path) -> None:
    refused(run(*BASE, "--posture", _posture(tmp_path, q), cwd=tmp_path), 1, *words)
    untouched(tmp_path, "q.json")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--frame", "eee"), ("eee", "ee")),
        (("--posture", "hme"), ("hme", "home")),
        (("--hold", "elbwo"), ("elbwo", "elbow")),
        (("--keep", "nothing"), ("nothing",)),
        (("--lock", "elbwo"), ("elbow",)),
        (("--package-dir", "nowhere"), ("nowhere",)),
        (("--config", "nowhere.toml"), ("nowhere.toml",)),
        (("--weights", "velocity-limits"), ("--metric weighted",)),
        (("--armature", "elbow=-1"), ("elbow",)),
    ],
)
def test_wrong_options(arguments: tuple[str, str], words: tuple[str, ...], tmp_path: Path) -> None:
    refused(run(*BASE, *arguments, cwd=tmp_path), 1, *words)
    untouched(tmp_path)


@pytest.mark.parametrize("weight", [0.0, -1.0])
def test_metric_weight_of_zero_or_below(weight: float, tmp_path: Path) -> None:
    (tmp_path / "w.toml").write_text(f"elbow_pitch = {weight}\n")
    refused(run(*BASE, "--metric", "weighted", "--weights", "w.toml", cwd=tmp_path), 1, "elbow", "above zero")


URDF = """<robot name="two">
<link name="world"/>
<link name="a"><inertial><origin xyz="0 0 0.2"/><mass value="1"/>
 <inertia ixx="0.02" iyy="0.02" izz="0.002" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="b">{inertial}</link>
<joint name="j1" type="revolute"><parent link="world"/><child link="a"/><axis xyz="0 1 0"/>
 <limit lower="-2" upper="2" effort="1" velocity="1"/></joint>
<joint name="j2" type="revolute"><parent link="a"/><child link="b"/><origin xyz="0 0 0.4"/><axis xyz="0 1 0"/>
 <limit lower="-2" upper="2" effort="1" velocity="1"/></joint>
</robot>"""
INERTIAL = (
    """<inertial><mass value="{m}"/><inertia ixx="{x}" iyy="{y}" izz="{z}" ixy="0" ixz="0" iyz="0"/></inertial>"""
)


@pytest.mark.parametrize(
    ("inertial", "words"),
    [
        (INERTIAL.format(m=0, x=0.01, y=0.01, z=0.01), ("'b'", "no mass")),
        (INERTIAL.format(m=-1, x=0.01, y=0.01, z=0.01), ("'b'", "-1 kg")),
        (INERTIAL.format(m=1, x=0.01, y=0.01, z=0.05), ("'b'", "triangle")),
        (INERTIAL.format(m=1, x=-0.01, y=0.01, z=0.01), ("'b'", "negative")),
        (INERTIAL.format(m=1, x="nan", y=0.01, z=0.01), ("'b'", "no number")),
        ("", ("'j2'", "moves no mass")),
    ],
)
def test_inconsistent_inertia_and_massless_chain(inertial: str, words: tuple[str, ...], tmp_path: Path) -> None:
    (tmp_path / "two.urdf").write_text(URDF.format(inertial=inertial))
    done = run("optimize", "two.urdf", "--frame", "b", "--normal", 1, 0, 0, *FAST, cwd=tmp_path)
    refused(done, 1, "two.urdf", *words)
    untouched(tmp_path, "two.urdf")


@pytest.mark.parametrize(
    ("content", "words"),
    [(None, ("no such file",)), ("<robot", ("not XML",)), ("solid stl", ("not XML",)), ("<sdf/>", ("not a URDF",))],
)
def test_what_is_no_urdf(content: str | None, words: tuple[str, ...], tmp_path: Path) -> None:
    if content is not None:
        (tmp_path / "x.urdf").write_text(content)
    refused(run("optimize", "x.urdf", "--frame", "b", "--normal", 1, 0, 0, *FAST, cwd=tmp_path), 1, *words)


def test_unknown_key_and_broken_toml(tmp_path: Path) -> None:
    (tmp_path / "p.toml").write_text('robot = "panda"\nnormal = [0, 0, 1]\nobjectiv = "speed"\n')
    refused(run("optimize", "p.toml", *FAST, cwd=tmp_path), 1, "objectiv", "objective")
    (tmp_path / "p.toml").write_text("robot = ")
    refused(run("optimize", "p.toml", *FAST, cwd=tmp_path), 1, "p.toml", "TOML")


def test_existing_output_is_kept(tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / "thesis.txt").write_text("ten years")
    refused(run(*BASE, "--out", "out", cwd=tmp_path), 1, "out", "--force")
    written = "out: holds thesis.txt, which this command did not write"
    refused(run(*BASE, "--out", "out", "--force", cwd=tmp_path), 1, written)
    assert (out / "thesis.txt").read_text() == "ten years"
    (out / "thesis.txt").unlink()
    assert run(*BASE, "--out", "out", cwd=tmp_path).returncode == 0
    refused(run(*BASE, "--out", "out", cwd=tmp_path), 1, "--force")
    assert run(*BASE, "--out", "out", "--force", cwd=tmp_path).returncode == 0
    untouched(tmp_path, "out")


def test_output_that_cannot_be_made(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    refused(run(*BASE, "--out", "file", cwd=tmp_path), 1, "file")
    refused(run(*BASE, "--out", "file/below", cwd=tmp_path), 1, "file")
    if os.geteuid() != 0:
        (tmp_path / "locked").mkdir(mode=0o500)
        refused(run(*BASE, "--out", "locked/out", cwd=tmp_path), 1, "locked")


def test_file_size_limit_leaves_nothing(tmp_path: Path) -> None:
    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))

    refused(run(*BASE, "--out", "out", cwd=tmp_path, prepare=limit, pictures=True), 1, "out")
    untouched(tmp_path)


def test_full_disk_leaves_nothing(tmp_path: Path) -> None:
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = shutil.which("mount")
    small = ["-t", "tmpfs", "-o", "size=64k", "tmpfs", str(disk)]
    if mount is None or subprocess.run([mount, *small], capture_output=True, check=False).returncode != 0:
        pytest.skip("mount: no small disk can be made here")
    try:
        refused(run(*BASE, "--out", "disk/out", cwd=tmp_path), 1, "No space left")
        untouched(disk)
    finally:
        subprocess.run(["umount", str(disk)], check=True)


def test_infeasible_exits_3_and_names_the_conflict(tmp_path: Path) -> None:
    done = run("optimize", "panda", "--normal", 0, 0, 1, "--target-position", 3, 0, 0, "--json", *FAST, cwd=tmp_path)
    refused(done, 3, "pose of panda_hand_tcp")
    error = json.loads(done.stdout)["error"]
    assert error["code"] == 3 and {"what", "where", "hint"} <= set(error)
    untouched(tmp_path)


@pytest.mark.parametrize("jobs", [1, 2])
def test_interrupt_in_mid_solve_leaves_nothing(jobs: int, tmp_path: Path) -> None:
    command = [str(COMMAND), *map(str, BASE), "--starts", "100000", "--jobs", str(jobs)]
    process = subprocess.Popen(
        command,
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        # A shell that runs this in the background would have it ignored.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    assert process.stdout is not None
    while "joint limits" not in process.stdout.readline():
        assert process.poll() is None
    time.sleep(1.5)
    # As a terminal does: to every process of the group.
    os.killpg(process.pid, signal.SIGINT)
    try:
        _, errors = process.communicate(timeout=30)
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
    assert process.returncode == 130, errors
    assert "Traceback" not in errors
    untouched(tmp_path)
    with pytest.raises(ProcessLookupError):
        os.killpg(process.pid, 0)


def test_aerial_robot_that_cannot_hover_is_warned_about(tmp_path: Path) -> None:
    """Rotors that reach half of their speed leave the weight unbalanced; the optimum does not hide it."""
    from impact_posture_robots import DATA

    spec = (DATA / "tilthex_arm" / "robot.toml").read_text().replace("speed_max = 100.0", "speed_max = 50.0")
    assert "speed_max = 50.0" in spec
    for name in ("tilthex_arm.urdf", "tilthex_arm.srdf"):
        shutil.copy(DATA / "tilthex_arm" / name, tmp_path)
    (tmp_path / "robot.toml").write_text(spec)
    done = run("optimize", "tilthex_arm.urdf", "--normal", 0, 0, 1, "--json", *FAST, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert any("cannot hover" in warning for warning in json.loads(done.stdout)["warnings"])


@pytest.mark.parametrize(
    "arguments", [("--box", 1, 1, 1), ("--base-box", 1, 1, 1), ("--no-com", "--com-margin", 0.1)]
)
def test_options_that_would_do_nothing_are_refused(arguments: tuple[object, ...], tmp_path: Path) -> None:
    done = run("optimize", "solo12", "--normal", 1, 0, 0, *arguments, *FAST, cwd=tmp_path)
    assert done.returncode == 2 and "does nothing without" in done.stderr
    untouched(tmp_path)


@pytest.mark.parametrize("line", ['starts = "4"', "speed = true", 'impulse = "3"', 'com = "yes"', 'normal = "up"'])
def test_problem_file_takes_values_of_the_right_type_only(line: str, tmp_path: Path) -> None:
    normal = "" if line.startswith("normal") else "normal = [0, 0, 1]\n"
    (tmp_path / "p.toml").write_text(f'robot = "panda"\n{normal}{line}\n')
    refused(run("optimize", "p.toml", *FAST[2:], cwd=tmp_path), 1, line.split()[0])


@pytest.mark.parametrize("scale", ["1e-6", "1e300"])
def test_normal_of_any_length(scale: str, tmp_path: Path) -> None:
    done = run("evaluate", "panda", "--normal", scale, scale, 0, "--json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["contacts"][0]["normal"] == pytest.approx([0.5**0.5, 0.5**0.5, 0])


def test_failing_compiler_does_not_cost_the_posture(tmp_path: Path) -> None:
    arguments = ("optimize", "tilthex_arm", "--normal", 0, 0, 1, "--starts", 2, "--format", "png")
    done = run(*arguments, cwd=tmp_path, env={"CC": "false"})
    assert done.returncode == 0
    assert "could not be built" in done.stderr
    assert (tmp_path / "tilthex_arm-ee" / "posture.json").is_file()
    assert list((tmp_path / "tilthex_arm-ee" / "c").glob("*.c"))


def test_broken_result_is_refused(result: Path, tmp_path: Path) -> None:
    broken = tmp_path / "broken"
    shutil.copytree(result, broken)
    (broken / "result.npz").write_bytes(b"")
    refused(run("plot", broken, cwd=tmp_path), 1, "broken", "no whole result")


def test_surface_and_locking_are_warned_about(tmp_path: Path) -> None:
    """A normal that points into the surface puts the whole robot behind it."""
    done = run("optimize", "tilthex_arm", "--normal", 0, 0, -1, "--json", *FAST, cwd=tmp_path)
    assert any("check its sign" in w for w in json.loads(done.stdout)["warnings"])
    done = run("optimize", "tilthex_arm", "--normal", 0, 0, 1, "--out", "right", "--json", *FAST, cwd=tmp_path)
    assert not any("surface" in w for w in json.loads(done.stdout)["warnings"])


def test_knees_below_the_ground_and_a_growing_jump_are_said(tmp_path: Path) -> None:
    """The best posture of this quadruped folds two knees under its feet, and V rises while H falls."""
    done = run("optimize", "anymal_c", "--normal", 0, 1, 0, "--json", "--no-codegen", "--format", "png", cwd=tmp_path)
    document = json.loads(done.stdout)
    assert document["optimal"]["V"] > document["initial"]["V"]
    assert any("the jump grows" in note for note in document["notes"])
    assert any("below the lowest foot" in warning for warning in document["warnings"])


# ---- the answer first ---------------------------------------------------------------------------------------------

SMALL = ("ur5", "--frame", "tool0", "--normal", 0, 0, 1, "--starts", 2, "--jobs", 1)


def terminal(*arguments: object, cwd: Path) -> tuple[str, str]:
    """Run with standard error on a terminal; return what came on standard output and there."""
    ours, theirs = os.openpty()
    with subprocess.Popen(
        [str(COMMAND), *map(str, arguments)], cwd=cwd, stdout=subprocess.PIPE, stderr=theirs
    ) as process:
        os.close(theirs)
        said = b""
        with contextlib.suppress(OSError):
            while part := os.read(ours, 4096):
                said += part
        assert process.stdout is not None
        out = process.stdout.read().decode()
    os.close(ours)
    assert process.returncode == 0, said.decode()
    return out, said.decode()


def test_progress_is_shown_on_a_terminal_only(tmp_path: Path) -> None:
    _, said = terminal("optimize", *SMALL, "--no-codegen", cwd=tmp_path)
    assert [word in said for word in ("building the expressions …", "solving", "starts", "drawing")] == [True] * 4
    quiet = run("optimize", *SMALL, "--no-codegen", "--force", cwd=tmp_path)
    assert quiet.returncode == 0 and "solving" not in quiet.stderr and "drawing" not in quiet.stderr
    for other in ("--quiet", "--json"):
        assert terminal("plot", "ur5-tool0", "--figure", "jump", other, cwd=tmp_path)[1] == ""
    assert "drawing" in terminal("plot", "ur5-tool0", "--figure", "jump", cwd=tmp_path)[1]


def test_the_answer_stands_before_pictures_and_c_code(tmp_path: Path) -> None:
    """A compiler that waits for a file: the answer is there before it ends, and what it says comes after."""
    compiler = tmp_path / "cc"
    compiler.write_text(
        '#!/bin/sh\nwhile [ ! -e go ] && [ ! -e "$GO" ]; do sleep 0.05; done\necho "error: no" >&2\nexit 1\n'
    )
    compiler.chmod(0o755)
    environment = os.environ | {"CC": str(compiler), "GO": str(tmp_path / "go")}
    command = [str(COMMAND), *map(str, ("optimize", *SMALL, "--compile", "never"))]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, cwd=tmp_path, stdout=pipe, stderr=pipe, text=True, env=environment) as process:
        assert process.stdout is not None and process.stderr is not None
        first = ""
        for line in process.stdout:
            first += line
            if line.startswith("optima") or "starts certified" in line:
                break
        # Nothing has been written yet, and the compiler still waits.
        assert "reduction" in first and "certificate" in first and not (tmp_path / "ur5-tool0").exists()
        (tmp_path / "go").touch()
        rest, said = process.stdout.read(), process.stderr.read()
    assert process.returncode == 0
    assert "written to ur5-tool0" in rest and "(not compiled)" in " ".join(rest.split())
    assert "could not be built" in said
    assert (tmp_path / "ur5-tool0" / "jump.png").is_file()


def test_pictures_that_fail_after_the_answer_end_in_one_line(tmp_path: Path) -> None:
    def fail(*arguments: object) -> None:
        raise OSError(28, "No space left on device")

    done = run("optimize", *SMALL, cwd=tmp_path, prepare=lambda: setattr(plot, "draw_all", fail))
    assert done.returncode == 1 and "reduction" in done.stdout and "written to" not in done.stdout
    assert done.stderr.count("error:") == 1 and "Traceback" not in done.stderr
    assert not (tmp_path / "ur5-tool0").exists()
    assert not [p for p in tmp_path.iterdir() if p.name.startswith(".")]
