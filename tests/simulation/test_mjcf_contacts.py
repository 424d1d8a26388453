"""Geoms, excluded pairs and contact pairs of an MJCF act in the world as in the file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from impact_posture.collision.mjcf_shapes import solid_geoms
from impact_posture.dynamics.mjcf import Mjcf
from impact_posture.dynamics.mjcf_layout import file_layout
from impact_posture.errors import InputError
from impact_posture.robot.model_joints import q_slice
from impact_posture.robot.robot import Robot
from impact_posture.robot.robot_loader import load_robot
from impact_posture.simulation.outcome import doubts
from impact_posture.simulation.recorder import feet_of
from impact_posture.simulation.scenario_file import read_scenario
from impact_posture.simulation.setup import Setup, set_up
from impact_posture.simulation.world.actuator_command import ActuatorCommand
from impact_posture.simulation.world.mjcf_contacts import contact_warnings
from impact_posture.simulation.world.scene import Physics, Scene, Shape, Surface
from impact_posture.simulation.world.world import build_world
from impact_posture.simulation.world.world_builder import build_scene
from tests.dynamics.test_mjcf import qacc
from tests.simulation.factories import HIT, controller_factory, driven
from tests.support.helpers import assert_close, rng
from tests.support.mjcfs import ARM, MESH, ODD, QUADRUPED
from tests.support.pinocchio_values import mass_matrix

mujoco = pytest.importorskip("mujoco", reason="mujoco is not installed (the extra 'sim')")

# Contact laws, a pair of geoms that otherwise collide with nothing, and meshes on both sides of a contact.
LAWS = (
    ARM.replace('size=".03" mass="1.5"', 'size=".03" mass="1.5" condim="6" friction=".2 .01 .02" solref=".03 .7"')
    .replace('<geom type="ellipsoid"', '<geom name="palm" contype="0" conaffinity="0" type="ellipsoid"')
    .replace('<geom type="cylinder"', '<geom name="foot" margin=".01" gap=".002" priority="2" type="cylinder"')
    .replace(
        "</contact>", '<pair geom1="palm" geom2="foot" condim="4" friction=".3 .4 .1 .2 .3" margin=".02"/></contact>'
    )
)
FIELD = ARM.replace(
    "<worldbody>",
    """<asset><hfield name="h" nrow="3" ncol="4" size=".4 .6 .3 .1" elevation="0 1 2 3 1 .5 .2 1 2 2 .3 .1"/></asset>
    <worldbody><geom type="hfield" hfield="h" pos=".2 0 -.1" euler="0 0 20"/>""",
)
WEDGES = MESH.replace('<geom type="mesh" mesh="wedge" contype="0" conaffinity="0"/>', """
        <body name="third" pos="-.3 0 0"><joint name="three" axis="0 1 0" range="-180 180"/>
        <geom type="mesh" mesh="wedge" mass="1"/></body>""")  # fmt: skip
# A ball on two slides is pulled towards a box on the first slide.
SLIDES = """
<mujoco>
  <worldbody>
    <body name="box">
      <joint name="a" type="slide" axis="1 0 0"/>
      <geom type="box" size=".1 .1 .1" mass="2" friction=".2"/>
      <body name="between">
        <joint name="b" type="slide" axis="0 1 0"/>
        <inertial pos="0 0 0" mass=".5" diaginertia=".01 .01 .01"/>
        <body name="ball" pos=".3 0 .05">
          <joint name="c" type="slide" axis="1 0 0"/>
          <geom type="sphere" size=".05" mass="1" solref=".01 .5"/>
        </body>
      </body>
    </body>
  </worldbody>
  <contact>{}</contact>
</mujoco>
"""
SETS = {"arm": ARM, "quadruped": QUADRUPED, "odd": ODD, "laws": LAWS, "wedges": WEDGES, "field": FIELD}


def loaded(folder: Path, text: str, **options: Any) -> Robot:
    (folder / "own.xml").write_text(text)
    return load_robot(str(folder / "own.xml"), **options)


def contacts(model: Any, data: Any, names: dict[int, str]) -> list[Any]:
    """Return body names, depth, and contact law of each contact between named geoms."""
    rows = []
    for contact in data.contact:
        if all(int(g) in names for g in contact.geom):
            law = (
                *contact.friction,
                *contact.solref,
                *contact.solimp,
                contact.includemargin,
                *contact.solreffriction,
            )
            rows.append((*sorted(names[int(g)] for g in contact.geom), contact.dim, float(contact.dist), *law))
    return sorted(rows)


def configurations(robot: Robot, count: int) -> list[Any]:
    random = rng("mjcf contacts")
    moves = random.uniform(-2, 2, (count, robot.nv))
    return [pin.integrate(robot.model, robot.posture(), move) for move in moves]


@pytest.mark.parametrize(("name", "lock"), [*((name, ()) for name in SETS), ("laws", ("elbow",))])
def test_contacts_between_links_are_those_of_the_file(tmp_path: Path, name: str, lock: tuple[str, ...]) -> None:
    robot, source = loaded(tmp_path, SETS[name], lock=lock), mujoco.MjModel.from_xml_string(SETS[name])
    assert robot.mjcf is not None
    source.opt.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    built = build_scene(robot, Scene(), robot.posture())
    model, layout, theirs = built.mjcf.compile(), built.mjcf.layout, file_layout(robot.mjcf.joints)
    moving = [robot.mjcf.joints.getJointId(joint) for joint in robot.model.names[1:]]
    places = np.r_[tuple(q_slice(robot.mjcf.joints, joint) for joint in moving)]
    links = {model.geom(geom).id: link.body for geom, link in built.link_geoms.items()}
    bodies = {g: source.body(b).name or f"body{b}" for b, solid in solid_geoms(source) for g in solid}
    assert sorted(links.values()) == sorted(bodies.values())
    ours, own, count = mujoco.MjData(model), mujoco.MjData(source), 0
    for q in configurations(robot, 150):
        whole = robot.mjcf.start.copy()
        whole[places] = q
        ours.qpos[:], own.qpos[:] = layout.qpos(q), theirs.qpos(whole)
        mujoco.mj_forward(model, ours)
        mujoco.mj_forward(source, own)
        actual, expected = contacts(model, ours, links), contacts(source, own, bodies)
        count += len(expected)
        assert [row[:3] for row in actual] == [row[:3] for row in expected]
        # MuJoCo computes the depth of convex bodies by an iteration whose result depends on the order of the bodies.
        for mine, of_file in zip(actual, expected, strict=True):
            assert np.allclose(mine[3:], of_file[3:], rtol=0, atol=1e-3 if name == "wedges" else 1e-9)
    assert count > 3


@pytest.mark.parametrize("name", SETS)
def test_geoms_do_not_change_the_dynamics(tmp_path: Path, name: str) -> None:
    robot = loaded(tmp_path, SETS[name])
    built = build_scene(robot, Scene(), robot.posture())
    model, layout = built.mjcf.compile(), built.mjcf.layout
    flags = mujoco.mjtDisableBit
    model.opt.disableflags |= flags.mjDSBL_CONSTRAINT | flags.mjDSBL_DAMPER | flags.mjDSBL_SPRING
    data, generator = mujoco.MjData(model), rng("mjcf dynamics")
    for q in configurations(robot, 5):
        v = generator.normal(size=robot.nv)
        data.qpos[:], data.qvel[:] = layout.qpos(q), layout.qvel(q, v)
        mujoco.mj_forward(model, data)
        M, T = np.zeros((robot.nv, robot.nv)), layout.velocity_map(q)
        mujoco.mj_fullM(model, data, M)
        assert_close(T.T @ M @ T, mass_matrix(robot.model, q), 1e-10, "M")
        a = pin.aba(robot.model, robot.model.createData(), q, v, np.zeros(robot.nv))
        assert_close(data.qacc, qacc(layout, q, v, a), 1e-10, "acceleration")


@pytest.mark.parametrize(("exclude", "stops"), [("", True), ('<exclude body1="ball" body2="box"/>', False)])
def test_links_collide_as_in_the_file_unless_excluded(tmp_path: Path, exclude: str, stops: bool) -> None:
    text, torque, steps = SLIDES.format(exclude), np.array([0.0, 0.3, -2.0]), 1200
    robot, physics = loaded(tmp_path, text), Physics(5e-4, gravity=(0, 0, 0))
    world = build_world(robot, Scene(physics=physics))
    world.reset(robot.posture())
    world.step(ActuatorCommand(torque, np.zeros(0)), steps)
    source = mujoco.MjModel.from_xml_string(text)
    source.opt.timestep, source.opt.gravity = 5e-4, 0
    source.opt.integrator, source.opt.cone = mujoco.mjtIntegrator.mjINT_IMPLICITFAST, mujoco.mjtCone.mjCONE_ELLIPTIC
    data = mujoco.MjData(source)
    data.qfrc_applied[:] = torque
    mujoco.mj_step(source, data, steps)
    q = world.truth().q
    assert np.abs(q - data.qpos).max() < 1e-9
    # The center of the ball stays 0.15 m before the center of the box, except for the compression.
    assert bool(q[2] > -0.16) is stops


FLOOR = Surface("floor", (0, 0, 1), (0, 0, 0))


@pytest.mark.parametrize("frame", ["foot_fl", "trunk"])
def test_links_without_shapes_touch_surfaces(tmp_path: Path, frame: str) -> None:
    """A quadruped falls 5 mm onto its trunk.  The impulse is recorded only for a shape at the trunk."""
    robot = loaded(tmp_path, QUADRUPED)
    q = robot.posture()
    q[2:7], q[7:] = [0.055, 0, 0, 0, 1], np.tile([0.0, -1.5, 1.5], 4)
    shape = Shape(frame, (0.02,), center=(0.0, 0.0, -0.03 if frame == "trunk" else 0.0))
    world = build_world(robot, Scene((FLOOR,), (shape,)))
    world.reset(q)
    world.step(ActuatorCommand(np.zeros(12), np.zeros(0)), 400)
    truth = world.truth()
    assert truth.q[2] > 0.04, "without the floor, the trunk would be at 0.006 m"
    impulse = truth.shapes[0].impulse
    assert impulse[2] > 0.1 if frame == "trunk" else not impulse.any()


STANDING = """
name = "standing"
robot = "own.xml"
{shapes}
[physics]
timestep = 0.0005

[[surfaces]]
name = "floor"
normal = [0, 0, 1]
point = [0, 0, 0]
friction = 0.8
solref = [0.004, 1.0]
solimp = [0.95, 0.99, 0.001]

[push]
frame = "trunk"
force = [5, 0, 0]

[control]
period = 0.001
[control.posture]
kp = 50
[control.footing]
friction = 0.5
[control.robust]
gain = 10
"""
FEET = ("foot_fl", "foot_fr", "foot_hl", "foot_hr")


def standing(folder: Path, text: str, shapes: str = "") -> Setup:
    (folder / "own.xml").write_text(text)
    (folder / "robot.toml").write_text("".join(f'[[supports]]\nframe = "{foot}"\n' for foot in FEET))
    (folder / "mine.toml").write_text(STANDING.format(shapes=shapes))
    return set_up(read_scenario(folder / "mine.toml"))


def test_a_robot_lands_on_its_feet_as_in_its_file(tmp_path: Path) -> None:
    """A quadruped falls 2 cm onto its feet, with the geoms of the MJCF, as in MuJoCo with the file itself."""
    law = '<default><geom friction=".8" solref=".004 1" solimp=".95 .99 .001"/>'
    text = QUADRUPED.replace("<default>", law, 1)
    setup = standing(tmp_path, text)
    assert feet_of(setup) == FEET
    assert len(setup.world.built.shape_geoms[0]) == 2, "capsule and ball of a shin"
    source = mujoco.MjModel.from_xml_string(text)
    source.opt.timestep, source.opt.integrator = 5e-4, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    source.opt.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    source.jnt_solref[:], source.jnt_solimp[:, :3] = (0.005, 1.0), (0.95, 0.99, 0.001)
    data = mujoco.MjData(source)
    q = setup.q.copy()
    q[2] += 0.02 - min(setup.world.built.gaps.values())
    setup.world.reset(q)
    assert setup.robot.mjcf is not None
    data.qpos[:] = file_layout(setup.robot.mjcf.joints).qpos(q)
    torque, landed = np.tile([0.0, -1.0, 1.0], 4), False
    data.qfrc_applied[6:] = torque
    for _ in range(8):
        setup.world.step(ActuatorCommand(torque, np.zeros(0)), 50)
        mujoco.mj_step(source, data, 50)
        truth = setup.world.truth()
        assert np.abs(file_layout(setup.robot.mjcf.joints).qpos(truth.q) - data.qpos).max() < 1e-9
        landed = landed or all(shape.touching for shape in truth.shapes)
    mass = float(source.body_mass.sum())
    assert landed and sum(shape.impulse[2] for shape in truth.shapes) > 0.5 * mass * 9.81 * 0.1


def test_a_shape_of_the_scenario_replaces_the_geoms_of_a_foot(tmp_path: Path) -> None:
    sphere = '[[shapes]]\nframe = "foot_hl"\nsize = [0.03]\ncenter = [0, 0, 0]'
    setup = standing(tmp_path, QUADRUPED, sphere)
    kinds = {shape.frame: shape.kind for shape in setup.scenario.shapes}
    assert kinds == {"foot_hl": "sphere", "foot_fl": "link", "foot_fr": "link", "foot_hr": "link"}
    data = setup.robot.model.createData()
    pin.framesForwardKinematics(setup.robot.model, data, setup.q)
    for foot in FEET:
        at = data.oMf[setup.robot.frame_id(foot)]
        radius, center = (0.03, at.translation) if foot == "foot_hl" else (0.025, at.act(np.array([0, 0, 0.025])))
        assert setup.world.built.gaps["floor", foot] == pytest.approx(center[2] - radius, abs=1e-12)


def test_a_shape_of_kind_link_needs_geoms_and_no_sizes(tmp_path: Path) -> None:
    for wrong in ({"size": (0.1,)}, {"center": (0.0, 0.0, 0.0)}):
        with pytest.raises(InputError, match="leave it out"):
            Shape("tip", kind="link", **wrong)
    bare = QUADRUPED.replace('size=".25 .1 .05"', 'size=".25 .1 .05" contype="0" conaffinity="0"')
    robot = loaded(tmp_path, bare)
    with pytest.raises(InputError, match="its link has no solid geoms"):
        build_scene(robot, Scene((FLOOR,), (Shape("trunk", kind="link"),)), robot.posture())


def test_replaced_options_are_named(tmp_path: Path) -> None:
    options = '<option integrator="RK4" timestep=".001"><flag contact="disable"/></option>'
    text = ARM.replace("<worldbody>", f"{options}<worldbody>")
    for content, lines in (
        (ARM, []),
        (text, ["the scenario replaces these options of the MJCF: timestep, integrator, disableflags"]),
    ):
        robot = loaded(tmp_path, content)
        mjcf: Mjcf = build_scene(robot, Scene(), robot.posture()).mjcf
        assert list(contact_warnings(mjcf, robot)) == lines


def test_links_that_touch_are_named_after_a_run(tmp_path: Path) -> None:
    (tmp_path / "own.xml").write_text(ARM)
    (tmp_path / "mine.toml").write_text(
        HIT.format(robot="own.xml", frame="tip", more="joints = { shoulder = -0.8, elbow = 0.9 }")
    )
    setup = set_up(read_scenario(tmp_path / "mine.toml"))
    run_ = driven(controller_factory(setup), "nominal")
    assert not [line for line in doubts(setup, [run_], [], None) if "touched" in line]
    folded = run_.series.q.copy()
    folded[40:, :2] = 1.9, 0.0
    moved = replace(run_, series=replace(run_.series, q=folded))
    (line,) = (line for line in doubts(setup, [moved], [], None) if "touched" in line)
    pairs = ("hand and world", "fore and world", "upper and world", "base and upper")
    assert line == f"links touched: {', '.join(f'{pair} (t = 0.08 s)' for pair in pairs)}"
