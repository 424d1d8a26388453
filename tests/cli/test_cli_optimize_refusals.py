"""``optimize`` refuses bad input, conflicts and interrupts, and leaves nothing behind."""

from __future__ import annotations

import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.support.command import refused, run

COMMAND = Path(sys.executable).parent / "impact-posture"
FAST = ("--starts", "2", "--jobs", "1", "--no-codegen", "--format", "png")
BASE = ("optimize", "tilthex_arm", "--normal", 0, 0, 1, *FAST)


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


def test_a_result_folder_is_no_robot_but_where_a_robot_has_its_name(tmp_path: Path) -> None:
    for name in ("out", "tilthex_arm"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "problem.toml").write_text("")
    done = run("optimize", "out", "--normal", 0, 0, 1, *FAST, cwd=tmp_path)
    assert done.returncode == 2 and "out/problem.toml" in done.stderr
    assert run(*BASE, "--out", "new", "--no-report", cwd=tmp_path).returncode == 0


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
        (INERTIAL.format(m=1, x="nan", y=0.01, z=0.01), ("'b'", "not a number")),
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


def test_a_result_folder_in_place_of_its_problem(tmp_path: Path) -> None:
    (tmp_path / "result").mkdir()
    (tmp_path / "result/problem.toml").write_text("")
    done = run("optimize", "result", cwd=tmp_path)
    assert done.returncode == 2 and "result/problem.toml" in done.stderr


def test_the_home_folder_in_the_output(tmp_path: Path) -> None:
    """A shell does not replace the tilde of ``--out=~/taken``."""
    (tmp_path / "home/taken").mkdir(parents=True)
    (tmp_path / "home/taken/note").touch()
    done = run(*BASE, "--out=~/taken", cwd=tmp_path, env={"HOME": str(tmp_path / "home")})
    refused(done, 1, f"{tmp_path}/home/taken", "exists")
    untouched(tmp_path, "home")


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

    refused(run(*BASE, "--out", "out", cwd=tmp_path, prepare=limit, pictures=("ellipsoid",)), 1, "out")
    untouched(tmp_path)


def test_full_disk_leaves_nothing(tmp_path: Path) -> None:
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = shutil.which("mount")
    small = ["-t", "tmpfs", "-o", "size=16k", "tmpfs", str(disk)]
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
    time.sleep(0.7)
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


@pytest.mark.parametrize(
    "arguments",
    [
        ("--box", 1, 1, 1),
        ("--base-box", 1, 1, 1),
        ("--no-com", "--com-margin", 0.1),
        ("--no-collision", "--clearance", 0.1),
        ("--no-collision", "--surface", "plane"),
        ("--no-holdable", "--hold-force", 10),
    ],
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
