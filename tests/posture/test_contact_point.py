"""The option ``--contact-point front`` and the warning about a contact point behind the front of its link."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import impact_posture as ip
from impact_posture.config.problem_settings import ImpactSettings
from impact_posture.impact.resolved_impact import resolve
from tests.support.command import refused, run, succeed

TASK = ("--normal", -1, 0, 0, "--starts", 2, "--jobs", 1, "--no-codegen", "--format", "png")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The result of a contact at the front of the last link of ur5.  The side of this link faces the surface."""
    here = tmp_path_factory.mktemp("front")
    done = succeed("optimize", "ur5", *TASK, "--contact-point", "front", "--out", "front", cwd=here)
    assert "a flat surface touches" not in done.stderr + done.stdout
    return here / "front"


def test_the_front_is_written_as_an_offset_and_reproduces(folder: Path, tmp_path: Path) -> None:
    document = json.loads((folder / "result.json").read_text())
    offset = document["contacts"][0]["offset"]
    assert 0.03 < np.linalg.norm(offset) < 0.06
    text = (folder / "problem.toml").read_text()
    assert f"offset = {offset}" in text and 'contact_point = "frame"' in text
    done = succeed("optimize", folder / "problem.toml", "--out", "again", "--json", *TASK[6:], cwd=tmp_path)
    again = json.loads(done.stdout)
    assert again["contacts"] == document["contacts"]
    assert again["optimal"]["q"] == pytest.approx(document["optimal"]["q"], abs=1e-9)


def test_python_and_the_option_have_the_same_front(folder: Path) -> None:
    offset = json.loads((folder / "result.json").read_text())["contacts"][0]["offset"]
    robot = ip.load_robot("ur5")
    contact = ip.ImpactContact("tool0", (-1, 0, 0))
    for posture in (None, robot.default_posture, robot.posture()):
        objective = ip.ImpactObjective(robot, contact, contact_point="front", posture=posture)
        assert objective.contact.offset == pytest.approx(offset, abs=1e-12)
    assert ip.ImpactObjective(robot, contact).contact.offset == (0, 0, 0)


def test_a_contact_point_behind_the_front_is_said_everywhere(tmp_path: Path) -> None:
    done = succeed("optimize", "ur5", *TASK, "--out", "behind", cwd=tmp_path)
    printed = " ".join((done.stdout + done.stderr).split())
    assert "a flat surface touches wrist_3_link first, " in printed
    assert " mm beyond the contact point at tool0: give --offset " in printed
    assert "or --contact-point front" in printed
    document = json.loads((tmp_path / "behind" / "result.json").read_text())
    (warning,) = (line for line in document["warnings"] if "a flat surface touches" in line)
    (condition,) = (c for c in document["verdict"]["conditions"] if c["key"] == "contact point")
    assert "a flat surface touches" in condition["line"] and condition["line"] in document["verdict"]["line"]
    succeed("report", "behind", cwd=tmp_path)
    assert "a flat surface touches" in (tmp_path / "behind" / "report.html").read_text(encoding="utf-8")
    numbers = warning.split("`offset` ")[1].split(",")[0].split()
    mended = succeed("evaluate", "ur5", *TASK[:4], "--offset", *numbers, "--json", cwd=tmp_path)
    assert not [line for line in json.loads(mended.stdout)["warnings"] if "a flat surface touches" in line]


def test_several_contacts_keep_the_option_because_one_offset_cannot_hold_them(tmp_path: Path) -> None:
    contacts = ("--contact", "ee_link:-1,0,0", "--contact", "wrist_1_link:0,0,1")
    done = succeed("evaluate", "ur5", *contacts, "--contact-point", "front", "--json", cwd=tmp_path)
    document = json.loads(done.stdout)
    assert all(np.linalg.norm(contact["offset"]) > 0.01 for contact in document["contacts"])
    assert not [line for line in document["warnings"] if "a flat surface touches" in line]
    impact = resolve(ImpactSettings(robot="ur5", contact=tuple(contacts[1::2])))
    lines = impact.touch_warnings(impact.q, "`contact_pose` full")
    assert lines and all(line.endswith(": give `contact_pose` full") for line in lines)


def test_front_and_offset_together_are_refused(tmp_path: Path) -> None:
    command = ("evaluate", "ur5", *TASK[:4], "--contact-point", "front", "--offset", 0, 0, 0.1)
    refused(run(*command, cwd=tmp_path), 1, "contradicts --offset")


def test_a_conflict_names_the_front_if_the_front_has_no_conflict(tmp_path: Path) -> None:
    """While the wrist stays in place, the elbow is in the ground.  With a fixed tip, the elbow can rise."""
    parts, angles = ['<link name="base"/>'], {"shoulder": 0.585, "elbow": -1.17, "wrist": 1.1}
    above = "base"
    for joint, at, length, high in (("shoulder", 0.0, 0.3, 1.6), ("elbow", 0.3, 0.3, -0.1), ("wrist", 0.3, 0.2, 2.5)):
        parts.append(
            f'<link name="{joint}_link"><inertial><origin xyz="{length / 2} 0 0"/><mass value="1"/>'
            '<inertia ixx=".01" iyy=".01" izz=".01" ixy="0" ixz="0" iyz="0"/></inertial>'
            f'<collision><origin xyz="{length} 0 0"/><geometry><sphere radius=".02"/></geometry></collision></link>'
            f'<joint name="{joint}" type="revolute"><origin xyz="{at} 0 0"/><axis xyz="0 1 0"/>'
            f'<parent link="{above}"/><child link="{joint}_link"/>'
            f'<limit lower="-2.5" upper="{high}" effort="100" velocity="3"/></joint>'
        )
        above = f"{joint}_link"
    (tmp_path / "arm.urdf").write_text(f'<robot name="arm">{"".join(parts)}</robot>')
    (tmp_path / "start.json").write_text(json.dumps({"joints": angles}))
    task = (
        "arm.urdf",
        "--frame",
        above,
        "--normal",
        0,
        0,
        1,
        "--posture",
        "start.json",
        "--contact-pose",
        "position",
    )
    more = ("--starts", 1, "--jobs", 1, "--no-codegen", "--format", "png", "--out", "out")
    done = run("optimize", *task, *more, cwd=tmp_path)
    hint = "put the contact point at the front of its links (--contact-point front), which is possible"
    refused(done, 3, "shoulder_link / surface at wrist_link", hint)
    assert "only the hulls" not in done.stderr
    assert run("optimize", *task, *more, "--contact-point", "front", cwd=tmp_path).returncode == 0
