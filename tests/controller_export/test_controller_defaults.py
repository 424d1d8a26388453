"""With default gains, the end effector task of the controller leaves the same motions free as `optimize`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from impact_posture.controller_export.default_formulation import ControllerKind, default_formulation
from impact_posture.errors import InputError
from impact_posture.impact.impact_contact import ImpactContact
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.robot.robot_loader import load_robot
from impact_posture.tsid.controller import Controller
from impact_posture.tsid.task_formulation import TaskFormulation
from impact_posture.tsid.tasks.frame_tasks import FrameAligned, FramePose, FramePosition, FrameTask
from impact_posture.tsid.tasks.impact_robust import ImpactRobustPosture
from tests.support.command import run, succeed
from tests.support.daqp import sources_or_skip

INERTIAL = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
BARE_ARM = f"""<robot name="bare"><link name="base">{INERTIAL}</link><link name="arm">{INERTIAL}</link>
<joint name="turn" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 0 1"/>
<limit lower="-1" upper="1" effort="9" velocity="9"/></joint></robot>"""


def tip(formulation: TaskFormulation) -> FrameTask[Any]:
    """Return the task of the end effector in the formulation."""
    task = formulation.levels[-1][0]
    assert isinstance(task, FrameTask)
    return task


@pytest.mark.parametrize(
    ("name", "kind", "kept"),
    [("borinot", "aerial", FramePosition), ("ur5", "arm", FrameAligned), ("panda", "arm", FramePose)],
)
def test_the_task_has_the_rows_of_the_contact_pose(
    name: str, kind: ControllerKind, kept: type[FrameTask[Any]]
) -> None:
    robot = load_robot(name)
    frame = robot.spec.contact.frame or ""
    objective = WorstCaseObjective(robot, ImpactContact(frame, (0, 0, 1)))
    assert type(tip(default_formulation(robot, kind, objective))) is kept
    assert tip(default_formulation(robot, kind, objective)).point.frame == frame
    # Without an impact, the task `aligned` has no normal to which the end effector could be aligned.
    assert type(tip(default_formulation(robot, kind))) is (FramePose if kept is FrameAligned else kept)


def test_the_aligned_axis_is_the_normal_in_the_frame() -> None:
    robot = load_robot("ur5")
    data = robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, robot.posture())
    rotation = data.oMf[robot.frame_id("tool0")].rotation
    n = (0.6, 0.0, 0.8)
    x, y, z = rotation.T @ n
    for contact in (ImpactContact("tool0", n), ImpactContact("tool0", (x, y, z), normal_frame="contact")):
        task = tip(default_formulation(robot, "arm", WorstCaseObjective(robot, contact)))
        assert isinstance(task, FrameAligned)
        np.testing.assert_allclose(rotation @ task._axis, n, atol=1e-12)


def test_the_frame_of_the_impact_is_held_unless_it_is_pushed() -> None:
    panda, flying = load_robot("panda"), load_robot("tilthex_arm")
    link = default_formulation(panda, "arm", WorstCaseObjective(panda, ImpactContact("panda_link6", (0, 0, 1))))
    assert tip(link).point.frame == "panda_link6"
    push = default_formulation(flying, "aerial", WorstCaseObjective(flying, ImpactContact("base_link", (1, 0, 0))))
    assert tip(push).point.frame == "ee"


def test_the_aligned_arm_lowers_its_objective() -> None:
    robot = load_robot("z1")
    objective = WorstCaseObjective(robot, ImpactContact("link06", (0, 0, 1)))
    formulation = default_formulation(robot, "arm", objective)
    controller, posture = Controller(robot, formulation), formulation.posture
    assert isinstance(posture, ImpactRobustPosture)
    q, v = robot.posture(), np.zeros(robot.nv)
    before = objective.value(q)
    controller.reset(q, v)
    posture.brace()
    for k in range(1000):
        v = v + 1e-3 * controller.tick(1e-3 * k, q, v).acceleration
        q = pin.integrate(robot.model, q, 1e-3 * v)
    assert objective.value(q) < 0.8 * before


def test_an_arm_without_data_needs_the_frame_of_the_impact_only(tmp_path: Path) -> None:
    (tmp_path / "bare.urdf").write_text(BARE_ARM)
    robot = load_robot(str(tmp_path / "bare.urdf"))
    impact = WorstCaseObjective(robot, ImpactContact("arm", (0, 1, 0), offset=(1, 0, 0)))
    assert tip(default_formulation(robot, "arm", impact)).point.offset == (1, 0, 0)
    with pytest.raises(InputError, match="no default contact frame") as caught:
        default_formulation(robot, "arm")
    assert "`frame`" in str(caught.value)


@pytest.mark.parametrize("kind", ["aerial", "arm", "legged"])
def test_a_floating_robot_without_rotors_and_feet_is_refused(kind: ControllerKind, tmp_path: Path) -> None:
    (tmp_path / "bare.urdf").write_text(BARE_ARM)
    (tmp_path / "robot.toml").write_text('[model]\nroot = "free-flyer"\n')
    with pytest.raises(InputError, match="propulsion"):
        default_formulation(load_robot(str(tmp_path / "bare.urdf")), kind)


SCENARIO = """name = "mine"
robot = "bare.urdf"
surfaces = [{ name = "wall", normal = [0, -1, 0], gap = 0.01 }]
shapes = [{ frame = "arm", size = [0.01], offset = [1, 0.01, 0] }]
contacts = { frame = "arm", surface = "wall", speed = 0.1 }
[control]
end_effector = { kp = 100, pose = "position" }
posture = { kp = 10 }
robust = { gain = 20 }
"""


def test_a_scenario_is_of_the_urdf_that_both_name(tmp_path: Path) -> None:
    pytest.importorskip("mujoco", reason="mujoco is not installed (the extra 'sim')")
    sources_or_skip()
    (tmp_path / "bare.urdf").write_text(BARE_ARM)
    (tmp_path / "mine.toml").write_text(SCENARIO)
    (tmp_path / "other.urdf").write_text(BARE_ARM)
    asked = ["--controller", "arm", "--scenario", str(tmp_path / "mine.toml"), "--out", str(tmp_path / "out")]
    refused = run("codegen", str(tmp_path / "other.urdf"), *asked)
    assert refused.returncode == 2 and "give bare" in " ".join(refused.stderr.split())
    succeed("codegen", str(tmp_path / "bare.urdf"), *asked)
    assert (tmp_path / "out" / "bare_controller.h").is_file()
