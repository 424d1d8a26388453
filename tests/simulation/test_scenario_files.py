"""Scenario files: shipped scenarios, user scenarios, and invalid files."""

from __future__ import annotations

import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from impact_posture.dynamics.numeric import Numeric
from impact_posture.errors import (
    FrameNotFound,
    ImpactPostureError,
    Infeasible,
    InputError,
    ScenarioNotFound,
    SpecError,
)
from impact_posture.impact.impact_contact import point_on
from impact_posture.simulation.controller_gains import Gains, StanceGains
from impact_posture.simulation.controllers.contact_reference import Reference
from impact_posture.simulation.controllers.controller_factory import ControllerFactory
from impact_posture.simulation.recorder import feet_of
from impact_posture.simulation.run import run
from impact_posture.simulation.scenario_file import SHIPPED as SHIPPED_FOLDER
from impact_posture.simulation.scenario_file import (
    Bounds,
    RepeatedContacts,
    SinglePush,
    known_scenarios,
    read_scenario,
)
from impact_posture.simulation.setup import naming_keys, set_up
from impact_posture.simulation.world.actuator_command import ActuatorCommand

DOCS = Path(__file__).parents[2] / "docs"
ARM = DOCS / "examples" / "rail_arm"
SHIPPED = ("aerial-lateral", "aerial-vertical", "solo8-push", "talos-push")
REAL = (
    "g1-strike", "hextilt-poke", "panda-tap", "panda-wall", "solo12-drop", "solo12-landing", "solo8-throw",
    "talos-strike", "talos-throw", "ur5-strike",
)  # fmt: skip


# ---- shipped ----------------------------------------------------------------------------------------------------


def test_the_shipped_scenarios_are_known() -> None:
    assert set(known_scenarios()) == {*SHIPPED, *REAL}
    for name in known_scenarios():
        scenario = read_scenario(name)
        assert scenario.name == name and scenario.description


@pytest.mark.parametrize("name", [name for name in known_scenarios() if not read_scenario(name).falls])
def test_every_shipped_scenario_stays_at_its_start(name: str) -> None:
    setup = set_up(read_scenario(name))
    driver = ControllerFactory(setup).driver("nominal")
    command = driver.reset(setup.q)
    setup.world.reset(setup.q, rotor_speed=command.rotor_speed)
    count = round(setup.scenario.control.period / setup.world.timestep)
    for _ in range(100):
        command = driver.tick(setup.world.read())
        setup.world.step(command, count)
    truth = setup.world.truth()
    # The feet sink by less than a millimeter, and sensor noise moves the robot slightly.
    assert np.linalg.norm(pin.difference(setup.robot.model, setup.q, truth.q)) < 0.05
    # The feet touch the ground; other shapes do not touch anything yet.
    feet = feet_of(setup)
    assert all(s.touching == (s.frame in feet) for s in truth.shapes)
    lifted = () if setup.scenario.control.footing is None else setup.scenario.control.footing.lifted
    assert len(driver.controller.formulation.contacts) == len(feet) and not set(lifted) & set(feet)


def test_a_hand_touches_a_wall_with_its_contact_point() -> None:
    """The ground is the first surface of this scenario."""
    setup = set_up(read_scenario("g1-strike"))
    scenario, point = setup.scenario, point_on(setup.robot, setup.scenario.shape.frame, setup.scenario.offset)
    place = Numeric(setup.robot.model).at(setup.q).placement(point).translation
    height = scenario.normal @ (place - setup.world.built.points["wall"])
    assert height == pytest.approx(setup.gap, abs=1e-9) and setup.gap == pytest.approx(0.15)


def test_pushes_have_the_values_of_the_paper() -> None:
    for name, frame, force in (("solo8-push", "base_link", 6.5), ("talos-push", "torso_2_link", 32.0)):
        task = read_scenario(name).task
        assert isinstance(task, SinglePush)
        assert (task.frame, task.force, task.duration) == (frame, (force, 0, 0), 0.4)
        assert set(task.signs) == {1, -1} and task.quiet == 0.005
        assert task.push(-1).force == (-force, 0, 0)


def test_pushed_robots_have_armature_and_limits() -> None:
    solo = set_up(read_scenario("solo8-push")).robot
    np.testing.assert_allclose(solo.armature[6:], 3.6e-4, rtol=0.02)
    np.testing.assert_allclose(np.asarray(solo.model.effortLimit)[6:], 2.7)


# ---- scenarios of users -----------------------------------------------------------------------------------------

OWN = """
name = "mine"
robot = "rail_arm.urdf"
joints = { elbow = 0.9 }

[physics]
timestep = 0.0005

[[surfaces]]
name = "table"
normal = [0, 0, 2]
gap = 0.05
friction = 0.5

[[shapes]]
frame = "tool"
size = [0.01]

[contacts]
frame = "tool"
surface = "table"
speed = 0.2

[control.posture]
kp = 10

[control.robust]
gain = 20
"""


LED = f"{OWN}\n[control.end_effector]\npose = 'position'\nkp = 100\n"


def write(folder: Path, text: str) -> Path:
    path = folder / "my_scenario.toml"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    shutil.copytree(ARM, tmp_path / "own")
    return tmp_path / "own"


def test_a_scenario_of_a_user_runs_from_any_folder(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write(folder, OWN)
    monkeypatch.chdir(folder.parent)
    setup = set_up(read_scenario("own/my_scenario.toml"))
    assert setup.scenario.source.endswith("my_scenario.toml")
    assert setup.q[setup.robot.joint_names.index("elbow")] == 0.9
    np.testing.assert_allclose(setup.scenario.normal, [0, 0, 1])
    assert setup.gap == pytest.approx(0.05)
    setup.world.reset(setup.q)
    setup.world.step(ActuatorCommand(np.zeros(setup.robot.nv), np.zeros(0)), 10)
    assert read_scenario(path).control.posture == Gains(10)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("timestep =", "time_step =", r"unknown key 'physics.time_step'; did you mean timestep"),
        ("friction =", "fricton =", r"unknown key 'surfaces.0.fricton'; did you mean friction"),
        ("[control.robust]\ngain", "[control.robust]\nK", r"unknown key 'control.robust.K'"),
        ('name = "mine"', 'nam = "mine"', r"unknown key 'nam'; did you mean name"),
        ("speed = 0.2", 'speed = "0.2"', r"key 'contacts.speed'"),
        ("speed = 0.2", "speed = -0.2", r"key 'contacts.speed'"),
        ("normal = [0, 0, 2]", "normal = [0, 0]", r"key 'surfaces.0.normal"),
        ("normal = [0, 0, 2]", "normal = [0, 0, 0]", r"key 'surfaces.0.normal'.*not all zero"),
        ("normal = [0, 0, 2]", "normal = [1e308, 1e308, 1e308]", r"key 'surfaces.0.normal'.*not all zero"),
        ("[physics]", "[sensors]\ndelay = 1e300\n\n[physics]", r"key 'sensors.delay'"),
        ("timestep = 0.0005", "timestep = 1e-320", r"key 'physics.timestep'"),
        ("[control.posture]", "[control]\nperiod = 1e308\n\n[control.posture]", r"key 'control.period'"),
        ("timestep = 0.0005", "timestep = 0.005", r"table: solref|stops: solref"),
        ("kp = 10", "kp = [10, 0]", r"key 'control.posture.kp"),
        ('surface = "table"', 'surface = "tabel"', r"key 'contacts.surface': there is no 'tabel'; one of: table"),
        ('frame = "tool"\nsurface', 'frame = "hand"\nsurface', r"key 'contacts.frame': there is no 'hand'"),
        ("[contacts]", '[push]\nframe = "tool"\nforce = [1, 0, 0]\n\n[contacts]', r"has both"),
        ('name = "mine"', 'schema = "impact-posture/problem/1"\nname = "mine"', r"schema 'impact-posture/problem/1'"),
        ("[control.robust]\ngain = 20", "", r"key 'control.robust'"),
        (OWN[OWN.index("[contacts]") : OWN.index("[control.posture]")], "", r"neither \[contacts\], \[push\] nor"),
    ],
)
def test_a_wrong_file_is_refused_in_one_line(folder: Path, old: str, new: str, words: str) -> None:
    assert old in OWN
    with pytest.raises(SpecError, match=words) as caught:
        read_scenario(write(folder, OWN.replace(old, new)))
    assert "\n" not in caught.value.line and "my_scenario.toml" in caught.value.line


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("speed = 0.2", "speed = 0.2\ncount = 10000000000000", r"more than 1e\+07 ticks"),
        ("speed = 0.2", "speed = 0.2\ndwell = 1e308", r"more than 1e\+07 ticks"),
        ("speed = 0.2", "speed = 1e308", r"requires inf m"),
        ("[control.posture]", "[control]\nperiod = 1e2\n\n[control.posture]", r"more than 1e\+05 times the physics"),
        ("[control.posture]", "[control]\nperiod = 30.0\n\n[control.posture]", r"fewer than two ticks"),
        ("timestep = 0.0005", "timestep = 1e-12", r"more than 1e\+05 times the physics"),
    ],
)
def test_a_run_of_impossible_length_is_refused(folder: Path, old: str, new: str, words: str) -> None:
    assert old in OWN
    factory = ControllerFactory(set_up(read_scenario(write(folder, LED.replace(old, new)))))
    with pytest.raises(InputError, match=words) as caught:
        run(factory, "nominal")
    assert "\n" not in caught.value.line and caught.value.hint


def test_a_robot_with_one_joint_runs(folder: Path) -> None:
    setup = set_up(read_scenario(write(folder, OWN)))
    others = [name for name in setup.robot.joint_names if name != "elbow"]
    text = LED.replace('robot = "rail_arm.urdf"', f'robot = "rail_arm.urdf"\nlock = {others}'.replace("'", '"'))
    text = text.replace("speed = 0.2", "speed = 0.2\ncount = 1\nsettle = 1.0")
    text = text.replace("timestep = 0.0005", "timestep = 0.001").replace(
        "[control.posture]", "[control]\nperiod = 0.002\n\n[control.posture]"
    )
    one = set_up(read_scenario(write(folder, text)))
    assert one.robot.nv == 1
    factory = ControllerFactory(one)
    command = factory.driver("nominal").reset(one.q)
    assert command.torque.shape == (1,) and np.isfinite(command.torque).all()
    # The end effector task determines the only joint, so the posture term has no effect.
    (nominal,), (flow,) = (run(factory, name) for name in ("nominal", "robust-flow"))
    np.testing.assert_allclose(flow.series.q, nominal.series.q, atol=1e-9)
    assert flow.series.peak.max() == pytest.approx(nominal.series.peak.max(), rel=1e-6) and nominal.series.peak.any()


def test_a_misspelt_scenario_and_a_missing_file() -> None:
    with pytest.raises(ScenarioNotFound, match="did you mean aerial-lateral"):
        read_scenario("aerial-latral")
    with pytest.raises(SpecError, match="no such file"):
        read_scenario("nowhere/mine.toml")


def test_a_frame_that_the_robot_lacks_is_refused(folder: Path) -> None:
    path = write(folder, OWN.replace('frame = "', 'frame = "tool_tip" # '))
    with pytest.raises(ImpactPostureError, match="no frame 'tool_tip'") as caught:
        set_up(read_scenario(path))
    assert caught.value.where == str(path)


def test_surface_and_shape_of_a_push_are_refused() -> None:
    scenario = read_scenario("solo8-push")
    for ask in (lambda: scenario.surface, lambda: scenario.shape):
        with pytest.raises(InputError, match="there is no"):
            ask()


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: RepeatedContacts("ee", "wall", -0.5), "speed: is -0.5; give a number above zero"),
        (lambda: RepeatedContacts("ee", "wall", 0.5, count=0), "count: is 0; give a whole number, 1 or more"),
        (lambda: SinglePush("ee", (0, 0, 0)), "force: .*not all zero"),
        (lambda: SinglePush("ee", (1, 0, 0), signs=()), r"signs: is \(\)"),
        (lambda: SinglePush("ee", (1, 0, 0), signs=(2,)), r"signs: is \(2,\); give 1, -1 or both"),
        (lambda: Gains(0.0), "kp: is 0.0"),
        (lambda: Gains((10.0, -1.0)), r"kp: is \(10.0, -1.0\); give a number above zero"),
        (lambda: Bounds(relaxed=1.5), "relaxed: is 1.5; give a number from 0 to 1"),
        (lambda: StanceGains(friction=float("nan")), "friction: is nan"),
        (lambda: replace(read_scenario("solo8-push"), push=None), "has neither"),
    ],
)
def test_wrong_values_in_python_are_refused_in_one_line(make: Any, words: str) -> None:
    with pytest.raises(InputError, match=words) as caught:
        make()
    assert "\n" not in caught.value.line and caught.value.hint


# ---- the reference ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("acceleration", [0.7, 5.0])
@pytest.mark.parametrize("beyond", [0.0, 0.03])
def test_the_reference_hits_the_surface_at_its_speed_and_returns(acceleration: float, beyond: float) -> None:
    task = RepeatedContacts("ee", "wall", 0.5, acceleration=acceleration, count=2, settle=1.0, beyond=beyond)
    reference = Reference(task, 0.2)
    assert reference.total == pytest.approx(1.0 + 2 * reference.cycle)
    times = np.arange(0, reference.total, 1e-4)
    points = [reference.at(float(t)) for t in times]
    distance, speed = np.array([p.distance for p in points]), np.array([p.speed for p in points])
    slopes = np.array([p.acceleration for p in points])
    assert distance[0] == distance[-1] == 0 and distance.max() == pytest.approx(0.2 + beyond)
    assert np.abs(speed).max() == pytest.approx(0.5, rel=1e-3)
    # Distance, speed and acceleration are consistent.  If the braking distance is zero, the speed drops to zero at
    # once.
    errors = np.sort(np.abs(np.diff(distance) - speed[:-1] * 1e-4))
    assert errors[-3] < 1e-6 and errors[-1] < (1e-6 if beyond else 0.5e-4)
    steps = np.diff(speed) - slopes[:-1] * 1e-4
    assert np.sort(np.abs(steps))[-3] < 0.01 and (beyond == 0 or np.abs(steps).max() < 0.01)
    first = int(np.argmax(distance >= 0.2 - 1e-5))
    assert speed[first - 1] == pytest.approx(0.5)
    stay = np.flatnonzero((distance > 0.2 + beyond - 1e-9) & (speed == 0))
    assert len(stay) * 1e-4 == pytest.approx(2 * task.dwell, abs=1e-3)
    assert reference.at(reference.start(1)).distance == 0


def test_a_gap_that_is_too_short_for_the_speed_is_refused() -> None:
    with pytest.raises(InputError, match=r"requires 0\.125 m, but the gap is 0\.1 m"):
        Reference(RepeatedContacts("ee", "wall", 0.5), 0.1)


# ---- the pages --------------------------------------------------------------------------------------------------


def test_the_program_of_the_page_runs() -> None:
    (program,) = re.findall(
        r"^```python\n(.*?)^```", (DOCS / "simulation.md").read_text(encoding="utf-8"), re.M | re.S
    )
    names: dict[str, Any] = {}
    exec(program, names)
    assert names["truth"].t == pytest.approx(0.1)
    assert names["reading"].force.shape == (3,)


def test_the_scenario_of_the_page_is_valid(folder: Path) -> None:
    page = (DOCS / "reference" / "scenario-toml.md").read_text(encoding="utf-8")
    (text,) = re.findall(r"^```toml\n(.*?)^```", page, re.M | re.S)
    scenario = read_scenario(write(folder, text))
    assert isinstance(scenario.task, RepeatedContacts) and scenario.surface.gap == 0.1


@pytest.mark.parametrize(
    ("line", "where", "words"),
    [
        ('posture = "nope"', "posture", "no posture 'nope'"),
        ("armature = {panda_joint9 = 0.1}", "armature", "no joint 'panda_joint9'"),
        ('package_dir = ["nope"]', "package_dir", "no path"),
        ('lock = ["nope"]', "panda lock", "no joint 'nope'"),
        ('robot = "pandaa"', "", "no robot 'pandaa'"),
        ('srdf = "nope.srdf"', None, "check srdf or robot.toml"),
        ('robot = "tiago"\njoints = {wheel_left_joint = 0.3}', "", "'wheel_left_joint' is locked"),
    ],
)
def test_an_error_names_the_key_of_the_scenario_and_its_file(
    line: str, where: str | None, words: str, tmp_path: Path
) -> None:
    key = line.partition(" ")[0]
    text = re.sub(rf"(?m)^{key} = .*\n", "", (SHIPPED_FOLDER / "panda-tap.toml").read_text(encoding="utf-8"))
    path = tmp_path / "mine.toml"
    path.write_text(f"{line}\n{text}", encoding="utf-8")
    with pytest.raises(ImpactPostureError) as caught:
        set_up(read_scenario(path))
    assert words in caught.value.line == str(caught.value) and "`" not in caught.value.line
    if where is not None:
        assert caught.value.where == (f"{path}, {where}" if where else str(path))


def test_an_error_keeps_a_key_of_robot_toml() -> None:
    scenario = read_scenario("panda-tap")
    for where, named in (("propulsion.frame", "propulsion.frame"), ("panda", scenario.source)):
        with pytest.raises(FrameNotFound) as caught, naming_keys(scenario):
            raise FrameNotFound("nope", [], where=where)
        assert caught.value.where == named


@pytest.mark.usefixtures("few_tries")
def test_an_infeasible_offline_posture_names_keys(tmp_path: Path) -> None:
    text = (SHIPPED_FOLDER / "panda-tap.toml").read_text(encoding="utf-8")
    path = tmp_path / "mine.toml"
    path.write_text(text.replace("gap = 0.1 ", "gap = 3.0 "), encoding="utf-8")
    factory = ControllerFactory(set_up(read_scenario(path)), starts=1)
    with pytest.raises(Infeasible) as caught:
        factory.offline("posture")
    assert caught.value.where == str(path) and "start from another posture" in caught.value.hint
    assert "`" not in caught.value.line and caught.value.conflicts
