"""User scenarios: fixed-base arms with and without robot.toml, and other standing robots."""

from __future__ import annotations

import functools
import shutil
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from impact_posture.dynamics.mjcf import build_mjcf
from impact_posture.dynamics.numeric import Numeric
from impact_posture.errors import ImpactPostureError
from impact_posture.impact.impact_contact import point_on
from impact_posture.robot.robot_loader import load_robot
from impact_posture.simulation.controllers.controller_factory import CONTROLLERS, ControllerFactory
from impact_posture.simulation.metrics import measure
from impact_posture.simulation.prediction import predict
from impact_posture.simulation.run import run
from impact_posture.simulation.scenario_file import read_scenario
from impact_posture.simulation.setup import set_up
from tests.simulation.factories import HIT, controller_factory, driven, fields_of
from tests.support.helpers import robot as known_robot

RAIL = Path(__file__).parents[2] / "docs" / "examples" / "rail_arm"

PUSH = """
name = "mine"
robot = "{robot}"

[physics]
timestep = 0.001

[[surfaces]]
name = "ground"
normal = [0, 0, 1]

{shapes}

[push]
frame = "{frame}"
force = [{force}, 0, 0]
duration = 0.2
settle = 0.1
patience = 0.3
after = 0.05

[control]
period = 0.002

[control.center_of_mass]
kp = 65
weight = 10

[control.base]
kp = 65

[control.posture]
kp = 65
weight = 0.1

[control.footing]
least = 0.1

[control.robust]
gain = 130
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("own")


@functools.cache
def arm(folder: Path, which: str) -> ControllerFactory:
    """Return the factory of a fixed-base arm above a table."""
    path, more = folder / f"{which}.toml", ""
    name, frame = which, known_robot(which).spec.contact.frame if which in ("panda", "ur5") else "tool"
    if which == "rail_arm":
        shutil.copytree(RAIL, folder / "rail")
        name = "rail/rail_arm.urdf"
    elif which == "mjcf":
        mjcf = build_mjcf(load_robot(str(RAIL / "rail_arm.urdf")).model)
        mjcf.compile()
        (folder / "rail.xml").write_text(mjcf.spec.to_xml(), encoding="utf-8")
        shutil.copy(RAIL / "robot.toml", folder / "rail.toml")
        name, more = "rail.xml", 'config = "rail.toml"'
    elif which == "stranger":
        # The folder of the URDF contains no robot.toml.
        shutil.copy(RAIL / "rail_arm.urdf", folder / "stranger.urdf")
        name = "stranger.urdf"
        more = "armature = { rail = 6.0 }\njoints = { shoulder_pitch = 0.6, elbow = 1.2, wrist_pitch = 0.9 }"
    path.write_text(HIT.format(robot=name, frame=frame, more=more), encoding="utf-8")
    return controller_factory(set_up(read_scenario(path)))


def standing(folder: Path, name: str, force: float) -> ControllerFactory:
    """Return the factory of a known robot that stands on its feet."""
    robot = known_robot(name)
    shapes = "\n".join(f'[[shapes]]\nframe = "{s.frame}"\nsize = [0.016]' for s in robot.spec.supports)
    path = folder / f"{name}.toml"
    text = PUSH.format(robot=name, frame=robot.spec.contact.frame, shapes=shapes, force=force)
    path.write_text(text, encoding="utf-8")
    return controller_factory(set_up(read_scenario(path)))


@pytest.mark.long(
    but=(
        "stranger-path",
        "stranger-strike",
        "stranger-robust-flow",
        "stranger-impact-aware",
        "stranger-posture-stiff",
        "stranger-walker",
        "panda-robust",
        "rail_arm-nominal",
        "mjcf-robust",
    )
)
@pytest.mark.parametrize(
    ("which", "controller"),
    [("stranger", c) for c in CONTROLLERS]
    + [(w, c) for w in ("panda", "rail_arm", "mjcf") for c in ("nominal", "robust", "walker")],
)
def test_an_arm_on_a_fixed_base_meets_a_table(folder: Path, which: str, controller: str) -> None:
    factory = arm(folder, which)
    record = driven(factory, controller)
    for name, column in fields_of(record.series).items():
        assert name == "objective" or np.isfinite(column).all(), name
    metrics = measure(factory.setup, record)
    assert metrics.contacts == 1 and metrics.failed_ticks == 0 and metrics.relaxed_ticks < 30
    assert 0 < metrics.q_total_impact < 1
    # The base is fixed, so only joints move.
    assert metrics.q_total_impact_base == 0 and metrics.q_total_impact_joints == metrics.q_total_impact
    (impact,) = predict(factory.setup, factory.objective(), record)
    # The arm reaches the surface at its reference speed, unless joint limits slow it down.
    assert controller == "impact-aware" or impact.approach == pytest.approx(0.2, rel=0.1)


@pytest.mark.long(but=("aligned-5",))
@pytest.mark.parametrize(("pose", "size"), [("position", 3), ("aligned", 5)])
def test_the_end_effector_task_can_leave_the_spin_or_orientation_free(folder: Path, pose: str, size: int) -> None:
    """All controllers use this end effector task, and the motion to the offline optimum turns the free axes."""
    text = HIT.format(robot="panda", frame=known_robot("panda").spec.contact.frame, more="")
    path = folder / f"{pose}.toml"
    path.write_text(text.replace("kp = 100", f'pose = "{pose}"\nkp = 100'), encoding="utf-8")
    factory = controller_factory(set_up(read_scenario(path)))
    record = driven(factory, "posture")
    metrics = measure(factory.setup, record)
    assert metrics.contacts == 1 and metrics.failed_ticks == 0 and metrics.relaxed_ticks < 30
    for controller in CONTROLLERS:
        formulation = factory.driver(controller).controller.formulation
        assert [[task.size for task in level] for level in formulation.levels] == [[size]], controller
    (impact,) = predict(factory.setup, factory.objective(), record)
    assert impact.approach == pytest.approx(0.2, rel=0.1)
    point = point_on(factory.setup.robot, factory.setup.scenario.task.frame)
    begin, end = (Numeric(factory.setup.robot.model).at(q).placement(point) for q in record.series.q[[0, -1]])
    axis = begin.rotation.T @ factory.setup.scenario.normal
    tilted = np.arccos(np.clip(factory.setup.scenario.normal @ (end.rotation @ axis), -1.0, 1.0))
    spun = np.linalg.norm(pin.log3(begin.rotation.T @ end.rotation))
    assert spun > 0.05 and (tilted < 0.03 if pose == "aligned" else tilted > 0.05)


@pytest.mark.long(but=("go2-30.0",))
@pytest.mark.parametrize(("name", "force"), [("solo12", 6.5), ("go2", 30.0)])
def test_another_standing_robot_is_pushed(folder: Path, name: str, force: float) -> None:
    factory = standing(folder, name, force)
    for controller in ("nominal", "robust", "walker"):
        record = driven(factory, controller)
        metrics = measure(factory.setup, record)
        assert np.isfinite(record.series.v).all() and metrics.failed_ticks == 0
        assert np.abs(record.series.q[:, :3] - factory.setup.q[:3]).max() < 0.1, controller
        assert (record.series.touching[record.series.t > 0.05] == 4).mean() > 0.9, controller
        assert 0 < metrics.q_total_impact < 1


def test_a_standing_robot_hits_a_wall(folder: Path) -> None:
    standing(folder, "solo12", 1.0)
    text = (folder / "solo12.toml").read_text(encoding="utf-8")
    # The base moves into the wall, so the scenario must have no other task for the base.
    begin, end = text.index("[push]"), text.index("[control.posture]")
    wall = (
        '[[surfaces]]\nname = "wall"\nnormal = [-1, 0, 0]\npoint = [0.27, 0, 0]\n\n'
        '[[shapes]]\nframe = "base_link"\nsize = [0.02]\noffset = [0.24, 0, 0]\ncenter = [0.22, 0, 0]\n\n'
        '[contacts]\nframe = "base_link"\nsurface = "wall"\nspeed = 0.15\ncount = 1\nsettle = 0.2\ndwell = 0.2\n'
        "pause = 0.05\nbeyond = 0.01\n\n[control.end_effector]\nkp = 65\nweight = 1000\n\n"
    )
    path = folder / "bump.toml"
    path.write_text(text[:begin] + wall + text[end:], encoding="utf-8")
    factory = controller_factory(set_up(read_scenario(path)))
    for controller in ("nominal", "robust"):
        (bump,) = run(factory, controller)
        metrics = measure(factory.setup, bump)
        assert metrics.failed_ticks == 0 and np.isfinite(bump.series.v).all()
        assert metrics.contacts == 1, controller
        assert np.abs(bump.series.q[:, 2] - factory.setup.q[2]).max() < 0.08


def test_a_pushed_arm_without_an_end_effector_task(folder: Path) -> None:
    text = HIT.format(robot="ur5", frame="tool0", more="")
    begin, end = text.index("[[surfaces]]"), text.index("[control.posture]")
    push = (
        '[push]\nframe = "tool0"\nforce = [20, 0, 0]\nduration = 0.1\nsettle = 0.1\npatience = 0.1\nafter = 0.05\n\n'
    )
    path = folder / "pushed.toml"
    path.write_text(text[:begin] + push + text[end:], encoding="utf-8")
    factory = controller_factory(set_up(read_scenario(path)))
    for controller in ("nominal", "robust", "posture", "invariant"):
        record = driven(factory, controller)
        assert np.isfinite(record.series.v).all() and measure(factory.setup, record).q_total_impact > 0, controller


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("[control.end_effector]\nkp = 100\n", "", r"no gains for the end effector"),
        ("[control.posture]", "[control.footing]\n\n[control.posture]", r"\[control.footing\], but a base that is"),
        ("speed = 0.2", "speed = 0.9", r"the gap is 0.04 m"),
        ("[control.posture]\nkp = 10", "[control.posture]\nkp = [1, 2]", r"kp: has shape"),
        ("kp = 100", 'pose = "aligned"\nkp = [1, 2, 3, 4, 5, 6]', r"end effector: kp: has shape \(6,\).*or 5"),
        ("kp = 100", 'pose = "align"\nkp = 100', r"control.end_effector.pose"),
    ],
)
def test_keys_that_do_not_fit_the_arm_are_refused(folder: Path, old: str, new: str, words: str) -> None:
    text = HIT.format(robot="ur5", frame="tool0", more="")
    assert old in text
    path = folder / "wrong.toml"
    path.write_text(text.replace(old, new), encoding="utf-8")
    with pytest.raises(ImpactPostureError, match=words) as caught:
        run(controller_factory(set_up(read_scenario(path))), "nominal")
    assert "\n" not in caught.value.line
