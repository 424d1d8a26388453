"""Robots in collections of other packages; small packages replace the packages that download robots."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from impact_posture.config.problem_settings import LoadOptions
from impact_posture.draft.draft import write_draft
from impact_posture.errors import InputError, RobotNotFound
from impact_posture.robot.robot_collections import ways_to_name
from impact_posture.robot.robot_loader import load_robot
from impact_posture.system.progress import listening
from tests.support.mjcfs import ARM, QUADRUPED

URDF = """<robot name="two"><link name="base"/>
<link name="a"><inertial><mass value="1"/><inertia ixx=".1" iyy=".1" izz=".1" ixy="0" ixz="0" iyz="0"/></inertial>
<collision><geometry><mesh filename="package://two_description/a.stl"/></geometry></collision></link>
<joint name="j" type="revolute"><parent link="base"/><child link="a"/><axis xyz="0 0 1"/>
<limit lower="-1" upper="1" effort="5" velocity="2"/></joint></robot>"""

SRDF = '<robot name="two"><group_state name="ready" group="all"><joint name="j" value="0.5"/></group_state></robot>'

MENAGERIE = """
from pathlib import Path
class MenagerieError(Exception): pass
class Cache:
    root, dir = None, Path("the cache")
    def is_cached(self, robot): return False
class Entry:
    def __init__(self, file): self.file = file
class Robot:
    download_size, default_model, entry_names = 2_400_000, "dog", ("dog", "arm", "scene")
    def path(self, cache, progress):
        print("a progress bar") if progress else None
        if not HERE.is_dir(): raise MenagerieError("https://github.com/...: HTTP 404")
        return HERE
    def entry(self, name): return Entry(f"{name}.xml")
HERE = Path(__file__).parent / "files"
def names(): return ["some_dog", "some_cat"]
def get(name): return Robot()
"""

DESCRIPTION = """
print("Cloning https://github.com/...")
from pathlib import Path
REPOSITORY_PATH = str(Path(__file__).parent / "repository")
PACKAGE_PATH = REPOSITORY_PATH + "/two_description"
"""


@pytest.fixture
def packages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Yield a folder on sys.path with packages like mujoco_menagerie and robot_descriptions."""
    files = {
        "mujoco_menagerie/__init__.py": MENAGERIE,
        "mujoco_menagerie/files/dog.xml": QUADRUPED,
        "mujoco_menagerie/files/arm.xml": ARM,
        "robot_descriptions/__init__.py": "DESCRIPTIONS = ['two_description', 'arm_mj_description', 'x']",
        "robot_descriptions/two_description.py": DESCRIPTION + "URDF_PATH = PACKAGE_PATH + '/urdf/two.urdf'\n"
        "SRDF_PATH = PACKAGE_PATH + '/two.srdf'\n",
        "robot_descriptions/arm_mj_description.py": DESCRIPTION + "MJCF_PATH = REPOSITORY_PATH + '/arm.xml'\n",
        "robot_descriptions/x.py": "raise OSError('Cmd failed\\n  Could not resolve host: github.com')",
        "robot_descriptions/repository/two_description/urdf/two.urdf": URDF,
        "robot_descriptions/repository/two_description/two.srdf": SRDF,
        "robot_descriptions/repository/two_description/a.stl": "",
        "robot_descriptions/repository/arm.xml": ARM,
    }
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.chdir(tmp_path)
    for name in [name for name in sys.modules if name.startswith(("mujoco_menagerie", "robot_descriptions"))]:
        monkeypatch.delitem(sys.modules, name)
    yield tmp_path
    for name in [name for name in sys.modules if name.startswith(("mujoco_menagerie", "robot_descriptions"))]:
        del sys.modules[name]


def test_menagerie(packages: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("mujoco")
    said: list[str] = []
    with listening(lambda doing, share: said.append(doing)):
        dog = load_robot("menagerie:some_dog")
    assert said[0] == "downloading some_dog (2.4 MB) into the cache"
    assert (dog.name, dog.source, dog.nv) == ("dog", "menagerie:some_dog", 18)
    assert load_robot("menagerie:some_dog/arm").nv == 4
    assert capsys.readouterr().out == ""
    with pytest.raises(RobotNotFound, match="no robot 'some_dgo'; did you mean some_dog"):
        load_robot("menagerie:some_dgo")
    with pytest.raises(RobotNotFound, match=r"menagerie:some_dog\?"):
        load_robot("some_dog")
    with pytest.raises(RobotNotFound, match="menagerie:some_dog: no robot 'am'; did you mean arm"):
        load_robot("menagerie:some_dog/am")


def test_download_fails(packages: Path) -> None:
    (packages / "mujoco_menagerie/files").rename(packages / "gone")
    with pytest.raises(InputError, match=r"menagerie:some_dog: cannot be downloaded \(https://.*HTTP 404\)"):
        load_robot("menagerie:some_dog")
    with pytest.raises(InputError, match=r":x: cannot be cloned \(Could not resolve host: github.com\)"):
        load_robot("robot_descriptions:x")


def test_robot_descriptions(packages: Path, capsys: pytest.CaptureFixture[str]) -> None:
    robot = load_robot("robot_descriptions:two_description")
    assert (robot.name, robot.nv, robot.default_posture) == ("two", 1, "ready")
    assert robot.files is not None and packages / "robot_descriptions/repository" in robot.files.folders
    with pytest.raises(RobotNotFound, match="no robot 'two'; did you mean two_description"):
        load_robot("robot_descriptions:two")
    pytest.importorskip("mujoco")
    assert load_robot("robot_descriptions:arm_mj_description").nv == 4
    assert capsys.readouterr() == ("", "")


def test_draft_is_not_written_into_a_collection(packages: Path) -> None:
    path, _ = write_draft("robot_descriptions:two_description", LoadOptions(), None)
    assert path == Path("two.toml") and "srdf" not in path.read_text()
    assert load_robot("robot_descriptions:two_description", config="two.toml").default_posture == "ready"


def test_packages_that_are_not_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in ("mujoco_menagerie", "robot_descriptions"):
        monkeypatch.setitem(sys.modules, module, None)
    for robot in ("menagerie:unitree_g1", "robot_descriptions:panda_description"):
        with pytest.raises(InputError, match=r"is not installed; pip install 'impact-posture\[robots\]'"):
            load_robot(robot)


def test_the_list_of_robots_says_what_is_installed(packages: Path) -> None:
    assert sum("(installed)" in way for way in ways_to_name()) == 2
