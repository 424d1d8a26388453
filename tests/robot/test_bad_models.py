"""Invalid models and specs: each error is one line with the fault, the place and a hint."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from pathlib import Path

import pytest

from impact_posture.collision.robot_shapes import shape_warnings
from impact_posture.config.problem_settings import LoadOptions
from impact_posture.config.table_validation import validate
from impact_posture.draft.draft import write_draft
from impact_posture.errors import ImpactPostureError, InertiaError, SpecError, UrdfError
from impact_posture.robot.robot_loader import load_robot
from impact_posture.robot.robot_spec import RotorSpec

GOOD = '<mass value="1"/><inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/>'
OFF_AXIS = '<origin xyz="0.1 0.2 0.3"/>' + GOOD


def link(name: str, inertial: str | None) -> str:
    body = "" if inertial is None else f"<inertial>{inertial}</inertial>"
    return f'<link name="{name}">{body}</link>'


def joint(parent: str, child: str, axis: str = "0 0 1", kind: str = "revolute", origin: str = "0 0 0.5") -> str:
    return (
        f'<joint name="{parent}_{child}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{origin}"/><axis xyz="{axis}"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>'
    )


def inertia(xx: float, yy: float, zz: float, xy: float = 0.0, mass: float = 1.0) -> str:
    return f'<mass value="{mass}"/><inertia ixx="{xx}" iyy="{yy}" izz="{zz}" ixy="{xy}" ixz="0" iyz="0"/>'


@pytest.fixture
def load(tmp_path: Path) -> Callable[..., object]:
    """Load a robot that consists of the given elements, or a file with the given text."""

    def make(*elements: str, text: str | None = None, toml: str | None = None, **options: object) -> object:
        path = tmp_path / "bad.urdf"
        path.write_text(text if text is not None else f"<robot name='bad'>{''.join(elements)}</robot>", "utf-8")
        if toml is not None:
            config = tmp_path / "config.toml"
            config.write_text(toml, encoding="utf-8")
            options["config"] = str(config)
        return load_robot(str(path), LoadOptions(**options))  # type: ignore[arg-type]

    return make


Load = Callable[..., object]


def one_line(error: ImpactPostureError, *words: str) -> None:
    """Check that the error is one line with all words and an exit code, and that the error can be pickled."""
    assert "\n" not in error.line
    assert str(error) == error.line
    assert error.what and error.where and error.hint
    assert error.exit_code == 1
    for word in words:
        assert word in error.line, error.line
    twin = pickle.loads(pickle.dumps(error))
    assert type(twin) is type(error)
    assert twin.line == error.line


# ---- files ------------------------------------------------------------------------------------------------------


def test_the_good_model_of_these_tests_loads(load: Load) -> None:
    load(link("a", None), link("b", OFF_AXIS), joint("a", "b"))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("this is not XML", ("is not XML", "bad.urdf")),
        ("", ("is not XML",)),
        ("<robot name='r'><link name='a'>", ("is not XML",)),
        ("<sdf version='1.7'><model name='m'/></sdf>", ("not a URDF", "<sdf>")),
        ('<xacro:macro xmlns:xacro="http://x" name="m"><link name="a"/></xacro:macro>', ("not a URDF", "xacro")),
        ('<robot name="r" xmlns:xacro="http://x"><xacro:include filename="a"/></robot>', ("no <link>", "xacro")),
        ("<robot name='r'/>", ("no <link>",)),
        ("<robot name='r'><link name='a'/></robot>", ("no movable joint", "`root` free-flyer")),
        (f"<robot name='r'>{link('a', GOOD)}{joint('a', 'nowhere')}</robot>", ("makes no robot",)),
        (f"<robot name='r'>{link('a', GOOD)}{link('b', GOOD)}</robot>", ("makes no robot",)),
        (
            f"<robot name='r'>{link('a', GOOD)}{link('b', GOOD)}{joint('a', 'b')}{joint('b', 'a')}</robot>",
            ("is below itself", "joints"),
        ),
    ],
)
def test_files_that_are_no_robot(
    load: Load, text: str, words: tuple[str, ...], capfd: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(UrdfError) as caught:
        load(text=text)
    one_line(caught.value, *words)
    # Messages of the parser must not appear on the terminal.
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('value="1"', 'value="${m}"', ("'${m}' in <mass value>", "name the file .xacro")),
        ('upper="1"', 'upper="$(arg reach)"', ("'$(arg reach)' in <limit upper>", "name the file .xacro")),
        ("<robot name='bad'>", "<robot name='bad'><xacro:arm side='left'/>", ("<xacro:arm>", "name the file .xacro")),
        ('value="1"', 'value="1,5"', ("link 'a': mass value='1,5' is not a number", "correct it")),
        ('ixx="0.01"', "", ("link 'a': inertia ixx='' is not a number", "correct it")),
        ('xyz="0.1 0.2 0.3"', 'xyz="0.1 0.2"', ("link 'b': origin xyz='0.1 0.2' is not 3 numbers", "correct it")),
        ('upper="1"', 'upper="1,5"', ("upper value (1,5) is not a valid float", "correct the URDF")),
    ],
)
def test_values_that_cannot_be_read(load: Load, old: str, new: str, words: tuple[str, ...]) -> None:
    """Pinocchio drops an <inertial> that it cannot read, without an error."""
    text = f"<robot name='bad'>{link('a', GOOD)}{link('b', OFF_AXIS)}{joint('a', 'b')}</robot>"
    load(text=text)
    with pytest.raises(UrdfError) as caught:
        load(text=text.replace(old, new, 1))
    one_line(caught.value, *words)


_NAMED = f"{link('a', GOOD)}{link('Unterarm_ä', OFF_AXIS)}{joint('a', 'Unterarm_ä')}"


@pytest.mark.parametrize(
    "data",
    [
        f"<robot name='r'>{_NAMED}</robot>".encode("latin-1"),
        f'<?xml version="1.0" encoding="utf-8"?><robot name="r">{_NAMED}</robot>'.encode("latin-1"),
        f'<?xml version="1.0" encoding="iso-8859-1"?><robot name="r">{_NAMED}</robot>'.encode(),
        f'<?xml version="1.0" encoding="cp850"?><robot name="r">{_NAMED}</robot>'.encode("cp850"),
        f'\n <?xml version="1.0" encoding="no-codec"?><robot name="r">{_NAMED}</robot>'.encode("utf-8-sig"),
        f'<?xml version="1.0" encoding="utf-16"?><robot name="r">{_NAMED}</robot>'.encode("utf-16"),
        f"<robot xmlns='http://www.ros.org' name='r'>{_NAMED}</robot>".encode(),
        f"<robot name='r'><gazebo><sensor:camera name='eye'/></gazebo>{_NAMED}</robot>".encode(),
        f"<robot name='r & d'><!-- --- <arm> --- -->{_NAMED}</robot>".encode(),
        f"<robot name='r'><gazebo><file>$(find robot)/${{a}}</file></gazebo>{_NAMED}</robot>".encode(),
    ],
    ids=["latin1", "wrong-utf8", "wrong-latin1", "cp850", "bom", "utf16", "xmlns", "prefix", "comment", "gazebo"],
)
def test_files_that_urdfdom_reads(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "robot.urdf"
    path.write_bytes(data)
    robot = load_robot(str(path))
    assert robot.joint_names == ("a_Unterarm_ä",)
    assert "Unterarm_ä" in robot.frame_names
    assert shape_warnings(robot)[0].startswith("the robot has no shapes")
    assert 'frame = "Unterarm_ä"' in write_draft(str(path), LoadOptions(), None)[1].text


def test_a_mimic_of_a_joint_that_does_not_exist_is_a_warning(load: Load) -> None:
    """Pinocchio ignores such a mimic, and published robots contain such joints."""
    parts = link("a", GOOD), link("b", OFF_AXIS), link("c", OFF_AXIS), joint("a", "b")
    for other in ("a_bb", ""):
        loaded = load(*parts, joint("b", "c").replace("</joint>", f'<mimic joint="{other}"/></joint>'))
        warnings = [line for line in loaded.warnings if "mimics" in line]  # type: ignore[attr-defined]
        assert len(warnings) == 1
        assert f"'b_c' mimics '{other}', which is not a joint of the URDF (did you mean a_b?)" in warnings[0]


def test_swapped_limits(load: Load) -> None:
    swapped = joint("a", "b").replace('lower="-1" upper="1"', 'lower="1" upper="-1"')
    elements = (link("a", GOOD), link("b", OFF_AXIS), swapped)
    with pytest.raises(UrdfError, match="lower position limit of 'a_b' is above its upper limit"):
        load(*elements)
    load(*elements, toml="[limits.position]\na_b = [-1, 1]")


def test_binary_missing_and_folder(tmp_path: Path) -> None:
    binary = tmp_path / "binary.urdf"
    binary.write_bytes(bytes(range(256)))
    for path, words in (
        (binary, ("is not XML",)),
        (tmp_path / "missing.urdf", ("no such file", "missing.urdf")),
        (tmp_path, ("is a folder", "name the .urdf")),
    ):
        with pytest.raises(UrdfError) as caught:
            load_robot(str(path))
        one_line(caught.value, *words)


def test_bad_srdf(tmp_path: Path, load: Load) -> None:
    elements = (link("a", None), link("b", OFF_AXIS), joint("a", "b"))
    for text in ("no XML at all", "", "<robot"):
        path = tmp_path / "bad.srdf"
        path.write_text(text, encoding="utf-8")
        with pytest.raises(UrdfError) as caught:
            load(*elements, srdf=str(path))
        one_line(caught.value, "bad.srdf", "is not an SRDF")


# ---- inertias -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("inertial", "words"),
    [
        (inertia(0.01, 0.01, 0.01, mass=-1.0), ("link 'b'", "mass -1 kg")),
        (inertia(0.01, 0.01, 0.01, mass=0.0), ("link 'b'", "no mass but rotational inertia")),
        (inertia(0.01, 0.01, 0.05), ("link 'b'", "triangle inequality", "0.05")),
        (inertia(0.01, 0.01, 0.01, xy=0.02), ("link 'b'", "negative principal moment")),
        (inertia(-0.01, 0.01, 0.01), ("link 'b'", "negative principal moment")),
        ('<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>', ("link 'b'", "without <mass>")),
        (GOOD.replace('value="1"', 'value="heavy"'), ("link 'b'", "'heavy' is not a number")),
        (GOOD.replace('value="1"', 'value="nan"'), ("link 'b'", "is not a number")),
        (GOOD.replace('ixx="0.01"', 'ixx="inf"'), ("link 'b'", "is not a number")),
    ],
)
def test_impossible_inertias(load: Load, inertial: str, words: tuple[str, ...]) -> None:
    with pytest.raises(UrdfError) as caught:
        load(link("a", GOOD), link("b", inertial), joint("a", "b"))
    one_line(caught.value, *words)
    assert isinstance(caught.value, InertiaError) or "makes no robot" in caught.value.line


def test_rounding_in_an_inertia_is_allowed(load: Load) -> None:
    # A thin plate, printed with four digits: izz = ixx + iyy except in the last digit.
    load(link("a", GOOD), link("b", inertia(0.01234, 0.02345, 0.0358)), joint("a", "b"))


def test_a_fault_too_small_to_matter_is_a_warning(load: Load) -> None:
    speck = link("c", inertia(1e-7, 1e-7, 1e-6, mass=0.01))
    loaded = load(link("a", None), link("b", OFF_AXIS), speck, joint("a", "b"), joint("b", "c", kind="fixed"))
    assert any("link 'c'" in w and "too small to matter" in w for w in loaded.warnings)  # type: ignore[attr-defined]


def test_a_welded_link_may_be_anything(load: Load) -> None:
    load(link("a", inertia(0.01, 0.01, 0.05)), link("b", OFF_AXIS), joint("a", "b"))


def test_accept_inertias_turns_refusals_into_warnings(load: Load) -> None:
    elements = (link("a", None), link("b", inertia(0.01, 0.01, 0.05)), joint("a", "b"))
    toml = "[model]\naccept_inertias = true"
    loaded = load(*elements, toml=toml)
    assert any("triangle" in w and "robot.toml" in w for w in loaded.warnings)  # type: ignore[attr-defined]


# ---- mass matrices that cannot be inverted ------------------------------------------------------------------------


def test_a_joint_that_moves_no_mass(load: Load) -> None:
    elements = (link("a", GOOD), link("b", OFF_AXIS), link("c", None), joint("a", "b"), joint("b", "c", "1 0 0"))
    with pytest.raises(InertiaError) as caught:
        load(*elements)
    one_line(caught.value, "joint 'b_c' moves no mass", "`lock_massless`")
    # The error disappears if the joint has an armature or is locked.
    load(*elements, armature={"b_c": 0.01})
    load(*elements, lock=("b_c",))


def test_a_chain_of_massless_links_is_named_whole(load: Load) -> None:
    chain = [("a", "b"), ("b", "c"), ("c", "d")]
    elements = [link("a", None), link("b", OFF_AXIS), link("c", None), link("d", None), *(joint(*e) for e in chain)]
    with pytest.raises(InertiaError, match="2 joints move no mass: 'b_c', 'c_d'"):
        load(*elements)


def test_a_urdf_for_kinematics_only(load: Load, tmp_path: Path) -> None:
    elements = (link("a", GOOD), link("b", None), link("c", None), joint("a", "b"), joint("b", "c", "1 0 0"))
    for options in ({}, {"lock_massless": True}):
        with pytest.raises(InertiaError) as caught:
            load(*elements, **options)
        one_line(caught.value, "no link that moves has a mass", "kinematics only", "<inertial>")
        assert "lock" not in caught.value.line
    with pytest.raises(InertiaError, match="kinematics only"):
        write_draft(str(tmp_path / "bad.urdf"), LoadOptions(), tmp_path / "draft.toml")


def test_a_floating_joint_in_the_urdf(load: Load) -> None:
    elements = (link("world", None), link("a", OFF_AXIS), link("b", OFF_AXIS))
    joints = (joint("world", "a", kind="floating"), joint("a", "b", "0 1 0"))
    for root in (None, "fixed", "free-flyer"):
        with pytest.raises(UrdfError) as caught:
            load(*elements, *joints, root=root)
        one_line(caught.value, "'world_a', is floating", "`root` free-flyer")


def test_a_massless_floating_base(load: Load) -> None:
    elements = (link("a", None), link("b", OFF_AXIS), joint("a", "b", "0 1 0"))
    with pytest.raises(InertiaError) as caught:
        load(*elements, root="free-flyer")
    one_line(caught.value, "mass matrix is singular", "base wy", "a_b", "neutral")
    load(*elements)
    load(*elements, root="free-flyer", armature={"a_b": 0.01})


def test_a_floating_point_mass(load: Load) -> None:
    elements = (link("a", '<mass value="1"/>'), link("b", OFF_AXIS), joint("a", "b", "0 1 0"))
    with pytest.raises(InertiaError) as caught:
        load(link("a", '<mass value="1"/>'), root="free-flyer")
    one_line(caught.value, "base wx, base wy, base wz move no inertia together")
    load(*elements)


def test_a_joint_through_a_point_mass(load: Load) -> None:
    on_axis = '<origin xyz="0 0 0.2"/><mass value="1"/>'
    with pytest.raises(InertiaError) as caught:
        load(link("a", GOOD), link("b", OFF_AXIS), link("c", on_axis), joint("a", "b"), joint("b", "c"))
    one_line(caught.value, "b_c moves no inertia")
    # A point mass has inertia about an axis that does not pass through it.
    load(link("a", GOOD), link("b", OFF_AXIS), link("c", on_axis), joint("a", "b"), joint("b", "c", "1 0 0"))


def test_two_joints_about_one_axis_without_mass_between(load: Load) -> None:
    elements = (link("a", None), link("b", None), link("c", OFF_AXIS), joint("a", "b"), joint("b", "c"))
    with pytest.raises(InertiaError) as caught:
        load(*elements)
    one_line(caught.value, "a_b, b_c move no inertia together")
    load(*elements, armature={"a_b": 1e-4})
    load(link("a", None), link("b", None), link("c", OFF_AXIS), joint("a", "b", "1 0 0"), joint("b", "c"))


def test_units_do_not_make_a_mass_matrix_singular(load: Load) -> None:
    # A mass of grams on a base of tons makes the matrix badly scaled, but every joint moves an inertia.
    tiny = '<origin xyz="0.001 0 0"/>' + inertia(1e-9, 1e-9, 1e-9, mass=1e-3)
    heavy = inertia(500.0, 500.0, 500.0, mass=2000.0)
    load(link("a", heavy), link("b", tiny), joint("a", "b"), root="free-flyer")


# ---- robot.toml ---------------------------------------------------------------------------------------------------

PLAIN = (link("a", None), link("b", OFF_AXIS), joint("a", "b"))


@pytest.mark.parametrize(
    ("toml", "words"),
    [
        ('default_postur = "x"', ("unknown key 'default_postur'", "default_posture")),
        ("[model]\nurfd = 'x'", ("unknown key 'model.urfd'", "urdf")),
        ("[armature]\njoint = {}", ("unknown key 'armature.joint'", "joints")),
        ("[[supports]]\nframe = 'b'\nkid = 'point'", ("unknown key 'supports.0.kid'", "kind")),
        ("[postures.up]\njonts = {}", ("unknown key 'postures.up.jonts'", "joints")),
        ("[[supports]]\nframe = 'b'\nkind = 'line'", ("supports.0.kind", "'line' is not one of point, surface")),
        ("[[supports]]\nkind = 'point'", ("key 'supports.0.frame' is missing; add it",)),
        ("[model]\nroot = 'floating'", ("model.root", "free-flyer")),
        ("[limits.velocity]\na_b = 0.0", ("limits.velocity.a_b", "above zero")),
        ('schema = "impact-posture/robot/2"\nnew = 1', ("schema 'impact-posture/robot/2'", "impact-posture/robot/1")),
        ("schema = 1", ("schema '1'",)),
        ("a = ", ("is not valid TOML", "config.toml", "correct the syntax")),
        ("model:\n  root: free-flyer", ("is not valid TOML", "looks like YAML: in TOML write [table], then key = ")),
        ('{"model": {}}', ("is not valid TOML", "looks like JSON")),
        ('default_posture = "up"', ("default_posture 'up' does not exist", "neutral")),
        ("[limits.position]\na_b = [1.0, -1.0]", ("a_b", "lower < upper")),
        ("[postures.up]\nbase = [0, 0, 0, 0, 0, 0, 1]", ("base pose", "root is fixed")),
        ("[model]\nroot='free-flyer'\n[postures.up]\nbase = [0, 0, 0, 0, 0, 0, 2]", ("posture 'up'", "norm 2")),
        ("[model]\nroot='free-flyer'\n[postures.up]\nbase = [0, 0, nan, 0, 0, 0, 1]", ("up",)),
        ("[postures.up.joints]\na_b = nan", ("a_b", "nan")),
    ],
)
def test_bad_robot_toml(load: Load, toml: str, words: tuple[str, ...]) -> None:
    with pytest.raises(SpecError) as caught:
        load(*PLAIN, toml=toml)
    one_line(caught.value, *words)


def test_choices_of_numbers_are_listed() -> None:
    rotor = {"name": "r", "position": [0, 0, 0], "direction": [0, 0, 1], "spin": "ccw"}
    with pytest.raises(SpecError) as caught:
        validate(RotorSpec, rotor, "robot.toml")
    one_line(caught.value, "key 'spin': 'ccw' is not one of -1, 1; choose one of them")


def test_missing_config(load: Load) -> None:
    with pytest.raises(SpecError) as caught:
        load(*PLAIN, config="no/such.toml")
    one_line(caught.value, "no such file")


def test_limits_and_postures_of_joints_that_are_not_one_number(load: Load) -> None:
    spinning = (link("a", None), link("b", OFF_AXIS), joint("a", "b", kind="continuous"))
    with pytest.raises(SpecError, match="has no position limits"):
        load(*spinning, toml="[limits.position]\na_b = [0.0, 1.0]")
    sliding = (link("a", None), link("b", OFF_AXIS), joint("a", "b", kind="planar"))
    with pytest.raises(SpecError, match="3 degrees of freedom"):
        load(*sliding, toml="[postures.up.joints]\na_b = 1.0")
