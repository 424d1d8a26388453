"""``optimize`` rejects invalid input and conflicts, can be interrupted, and leaves no partial files behind."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.support.command import refused, run, succeed
from tests.support.tools import files_of

COMMAND = Path(sys.executable).parent / "impact-posture"
FAST = ("--starts", "2", "--jobs", "1", "--no-codegen", "--format", "png")
BASE = ("optimize", "tilthex_arm", "--normal", 0, 0, 1, *FAST)


def untouched(folder: Path, *expected: str) -> None:
    assert sorted(p.name for p in folder.iterdir()) == sorted(expected)


URDF = """<robot name="two"><link name="world"/><link name="b"><inertial><mass value="1"/>
 <inertia ixx="0.01" iyy="0.01" izz="0.05" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="j" type="revolute"><parent link="world"/><child link="b"/><axis xyz="0 1 0"/>
 <limit lower="-2" upper="2" effort="1" velocity="1"/></joint></robot>"""
PANDA = 'robot = "panda"\nnormal = [0, 0, 1]\n'
NAMES = '{"joint_names": ["shoulder_roll", "shoulder_pitch", "elbow_pitch"], "q": '


@pytest.mark.parametrize(
    ("name", "content", "argv", "words"),
    [
        ("p.toml", PANDA + 'objectiv = "speed"', ("p.toml",), ("objectiv", "did you mean objective")),
        ("p.toml", PANDA.replace("1]", "0]"), ("p.toml",), ("'normal'", "not all zero")),
        ("p.toml", PANDA + 'com = "yes"', ("p.toml",), ("'com'",)),
        ("p.toml", "robot = ", ("p.toml",), ("p.toml", "TOML")),
        ("q.json", NAMES + "[0, 0, 0, 1, 0, 0, 0, 0, 0.45, -0.9]}", (*BASE[1:], "--posture", "q.json"), ("w x y z",)),
        ("q.json", NAMES + "[0, 0, 0, 0, 0, 0, 1, 0, 0.45, -9]}", (*BASE[1:], "--posture", "q.json"), ("limits",)),
        (
            "w.toml", "elbow_pitch = -1", (*BASE[1:], "--metric", "weighted", "--weights", "w.toml"),
            ("elbow", "above zero"),
        ),
        ("two.urdf", URDF, ("two.urdf", "--frame", "b", "--normal", 1, 0, 0), ("two.urdf", "'b'", "triangle")),
        (
            "p.toml", 'robot="panda"\ncontact=["panda_hand_tcp:0,0,1", "panda_hand:0,0,1"]\nobjective="sticking"',
            ("p.toml",), ("objective sticking: the velocities of the contact points", "(--no-codegen)"),
        ),
        ("x.urdf", "solid stl", ("x.urdf", "--frame", "b", "--normal", 1, 0, 0), ("x.urdf", "not XML")),
    ],
)  # fmt: skip
def test_a_wrong_file_is_named(
    name: str, content: str, argv: tuple[object, ...], words: tuple[str, ...], tmp_path: Path
) -> None:
    (tmp_path / name).write_text(content)
    refused(run("optimize", *argv, cwd=tmp_path), 1, *words)
    untouched(tmp_path, name)


def test_a_result_folder_is_not_a_robot_except_where_a_robot_has_its_name(tmp_path: Path) -> None:
    for name in ("out", "tilthex_arm"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "problem.toml").write_text("")
    for more in (("--normal", 0, 0, 1), ()):
        done = run("optimize", "out", *more, *FAST, cwd=tmp_path)
        assert done.returncode == 2 and "out/problem.toml" in done.stderr
    succeed(*BASE, "--out", "new", "--no-report", cwd=tmp_path)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--hold", "elbwo"), ("elbwo", "elbow")),
        (("--keep", "nothing"), ("nothing",)),
        (("--package-dir", "nowhere"), ("nowhere",)),
        (("--config", "nowhere.toml"), ("nowhere.toml",)),
        (("--armature", "elbow=-1"), ("elbow",)),
    ],
)
def test_wrong_options(arguments: tuple[str, str], words: tuple[str, ...], tmp_path: Path) -> None:
    refused(run(*BASE, *arguments, cwd=tmp_path), 1, *words)
    untouched(tmp_path)


def test_existing_output_is_kept(tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / "thesis.txt").write_text("ten years")
    refused(run(*BASE, "--out", "out", cwd=tmp_path), 1, "out", "--force")
    written = "out: holds thesis.txt, which this command did not write"
    refused(run(*BASE, "--out", "out", "--force", cwd=tmp_path), 1, written)
    assert (out / "thesis.txt").read_text() == "ten years"
    (out / "thesis.txt").unlink()
    succeed(*BASE, "--out", "out", cwd=tmp_path)
    refused(run(*BASE, "--out", "out", cwd=tmp_path), 1, "--force")
    succeed(*BASE, "--out", "out", "--force", cwd=tmp_path)
    untouched(tmp_path, "out")


def test_the_home_folder_in_the_output(tmp_path: Path) -> None:
    """A shell does not expand the tilde in ``--out=~/taken``."""
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
    refused(run(*BASE, "--out", "out", cwd=tmp_path, prepare=files_of(20_000), pictures=("ellipsoid",)), 1, "out")
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


@pytest.mark.usefixtures("few_tries")
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
        command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    assert process.stdout is not None
    while "joint limits" not in process.stdout.readline():
        assert process.poll() is None
    time.sleep(0.7)
    # Send SIGINT to every process of the group, as a terminal does on Ctrl-C.
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
