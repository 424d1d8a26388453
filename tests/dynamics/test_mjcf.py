"""MuJoCo and Pinocchio compute the same numbers for a ``pin.Model``, on every robot and joint."""

from __future__ import annotations

import functools
import xml.etree.ElementTree as ET
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from impact_posture.dynamics import mjcf
from impact_posture.dynamics.mjcf import build_mjcf
from impact_posture.dynamics.mjcf_layout import MjcfLayout
from impact_posture.errors import InputError
from impact_posture.robot.robot_loader import load_robot
from impact_posture.robot.urdf import build_model
from tests.dynamics.test_dynamics import JOINTS, random_tree, write_urdf
from tests.support.helpers import NAMES, Vector, assert_close, random_configurations, rng, robot
from tests.support.pinocchio_values import frame_jacobian, frame_placement, mass_matrix

mujoco = pytest.importorskip("mujoco", reason="mujoco is not installed (the extra 'sim')")

TOLERANCE = 1e-9
SUPPORTED = sorted(JOINTS)


class InMujoco:
    """A MuJoCo model without joint limits, because random postures violate them."""

    def __init__(self, model: pin.Model) -> None:
        self.written = build_mjcf(model)
        self.model: Any = self.written.compile()
        self.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
        self.data: Any = mujoco.MjData(self.model)


@functools.cache
def in_mujoco(name: str) -> InMujoco:
    return InMujoco(robot(name).model)


def qacc(layout: MjcfLayout, q: Vector, v: Vector, a: Vector) -> Vector:
    """Return MuJoCo's acceleration ``qacc = T a + Ṫ v``, shape (nv,); Pinocchio uses rotating body axes."""
    turning = np.zeros(layout.nv)
    for slot in layout.slots:
        piece = v[slot.joint.v]
        if slot.joint.kind.family == "free-flyer":
            turning[slot.joint.v.start : slot.joint.v.start + 3] = np.cross(piece[3:], piece[:3])
        elif slot.joint.kind.family == "planar":
            turning[slot.joint.v.start : slot.joint.v.start + 2] = -piece[2] * piece[1], piece[2] * piece[0]
    return layout.qvel(q, a + turning)


def compare(model: pin.Model, simulated: InMujoco, q: Vector, generator: np.random.Generator) -> None:
    """Compare mass matrices, frame poses and Jacobians, and accelerations under gravity, velocity and torque."""
    layout, data = simulated.written.layout, simulated.data
    v, tau = generator.normal(size=model.nv), generator.normal(size=model.nv)
    T = layout.velocity_map(q)
    data.qpos[:], data.qvel[:], data.qfrc_applied[:] = layout.qpos(q), layout.qvel(q, v), T @ tau
    mujoco.mj_forward(simulated.model, data)
    M = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(simulated.model, data, M)
    assert_close(T.T @ M @ T, mass_matrix(model, q), TOLERANCE, "M")
    for frame, site in simulated.written.sites.items():
        index = mujoco.mj_name2id(simulated.model, mujoco.mjtObj.mjOBJ_SITE, site)
        linear, angular = np.zeros((3, model.nv)), np.zeros((3, model.nv))
        mujoco.mj_jacSite(simulated.model, data, linear, angular, index)
        placement = frame_placement(model, q, frame)
        assert_close(np.vstack([linear, angular]) @ T, frame_jacobian(model, q, frame), TOLERANCE, f"J {site}", 1e-6)
        assert_close(data.site_xpos[index], placement.translation, TOLERANCE, f"position {site}", 1e-6)
        assert_close(data.site_xmat[index], placement.rotation, TOLERANCE, f"rotation {site}")
    a = pin.aba(model, model.createData(), q, v, tau)
    assert_close(data.qacc, qacc(layout, q, v, a), TOLERANCE, "acceleration")
    # Convert the posture of MuJoCo back.
    returned = layout.q(layout.qpos(q))
    assert np.abs(pin.difference(model, q, returned)).max() < 1e-12
    assert_close(layout.state(data.qpos, data.qvel)[1], v, 1e-12, "velocity")


@pytest.mark.parametrize("name", NAMES)
def test_robot_agrees_with_pinocchio(name: str) -> None:
    model = robot(name).model
    for k, q in enumerate(random_configurations(model, 2, name, "mjcf")):
        compare(model, in_mujoco(name), q, rng(name, k))
    compare(model, in_mujoco(name), robot(name).posture(), rng(name, "default"))


@pytest.mark.parametrize("name", NAMES)
def test_indices_equal_the_compiled_model(name: str) -> None:
    model, simulated = robot(name).model, in_mujoco(name)
    assert (simulated.model.nq, simulated.model.nv) == (simulated.written.layout.nqpos, model.nv)
    assert simulated.model.nbody == model.njoints
    for slot in simulated.written.layout.slots:
        body = simulated.model.body(simulated.written.bodies[slot.joint.index])
        first = int(body.jntadr[0])
        assert simulated.model.jnt_qposadr[first] == slot.qpos.start
        assert simulated.model.jnt_dofadr[first] == slot.qvel.start
    # The rotational inertia of point masses becomes 1e-15 kg m²; all other inertias are unchanged.
    assert simulated.model.body_mass.sum() == pytest.approx(pin.computeTotalMass(model), rel=1e-12)
    named = {f.name for f in model.frames} - {"universe"}
    assert {simulated.model.site(k).name for k in range(simulated.model.nsite)} == named


# ---- all joint types --------------------------------------------------------------------------------------------


def without_base_armature(model: pin.Model) -> pin.Model:
    """Remove the armature of base and ball joints that MuJoCo and Pinocchio interpret differently.

    With this armature, the mass matrices agree (tested below), but the accelerations differ.  In Pinocchio and
    MuJoCo, the momentum of an armature is fixed in different axes: body axes or world axes.  MuJoCo accepts only one
    armature value per ball joint.
    """
    armature = np.array(model.armature)
    for joint in list(model.joints)[1:]:
        if joint.shortname()[10:] in ("FreeFlyer", "Planar"):
            armature[joint.idx_v : joint.idx_v + joint.nv] = 0.0
        elif joint.shortname()[10:] == "Spherical":
            armature[joint.idx_v : joint.idx_v + 3] = armature[joint.idx_v]
    model.armature = armature
    return model


@pytest.mark.parametrize("kind", SUPPORTED)
@pytest.mark.parametrize("above", ["RX", "FreeFlyer"])
def test_each_joint_in_the_middle_of_a_branching_tree(kind: str, above: str) -> None:
    model = without_base_armature(random_tree([above, kind, "RY", "PZ", kind], [0, 0, 0, 1, 2], 7, True))
    (q,) = random_configurations(model, 1, kind, above)
    compare(model, InMujoco(model), q, rng(kind, above))


@settings(max_examples=40)
@given(st.lists(st.sampled_from(SUPPORTED), min_size=1, max_size=6), st.integers(0, 10_000), st.booleans())
def test_random_tree_agrees_with_pinocchio(kinds: list[str], seed: int, armature: bool) -> None:
    climbs = [int(c) for c in np.random.default_rng(seed).integers(0, 4, len(kinds))]
    model = without_base_armature(random_tree(kinds, climbs, seed, armature))
    (q,) = random_configurations(model, 1, seed)
    compare(model, InMujoco(model), q, rng(seed))


def test_joints_numbered_across_branches() -> None:
    """Pinocchio may number a sibling before a child, but MuJoCo numbers depth-first."""
    pin.seed(3)
    model = pin.Model()
    for k, (parent, joint) in enumerate(
        [(0, pin.JointModelFreeFlyer()), (1, pin.JointModelRX()), (1, pin.JointModelRUBY()), (2, pin.JointModelPZ()),
         (3, pin.JointModelSpherical())]
    ):  # fmt: skip
        added = model.addJoint(parent, joint, pin.SE3.Random(), f"j{k}")
        model.appendBodyToJoint(added, pin.Inertia.Random(), pin.SE3.Identity())
    model.addFrame(pin.Frame("tip", 4, 0, pin.SE3.Random(), pin.FrameType.OP_FRAME))
    simulated = InMujoco(model)
    assert [slot.joint.index for slot in simulated.written.layout.slots] == [1, 2, 4, 3, 5]
    (q,) = random_configurations(model, 1, "across")
    # Pinocchio's CRBA requires depth-first numbers, its ABA does not.
    layout, data = simulated.written.layout, simulated.data
    v, tau = rng("v").normal(size=model.nv), rng("tau").normal(size=model.nv)
    data.qpos[:], data.qvel[:] = layout.qpos(q), layout.qvel(q, v)
    data.qfrc_applied[:] = layout.velocity_map(q) @ tau
    mujoco.mj_forward(simulated.model, data)
    expected = qacc(layout, q, v, pin.aba(model, model.createData(), q, v, tau))
    assert_close(data.qacc, expected, TOLERANCE, "acceleration")


def test_urdf_joints_with_limits(tmp_path: Any) -> None:
    joints = [("revolute", "0 0 1"), ("continuous", "1 2 3"), ("prismatic", "1 1 0"), ("planar", "0 0 1")]
    model, _, _ = build_model(write_urdf(tmp_path / "chain.urdf", joints), free_flyer=True)
    simulated = InMujoco(model)
    (q,) = random_configurations(model, 1, "urdf")
    compare(model, simulated, q, rng("urdf"))
    compiled = simulated.model
    limits = {
        compiled.joint(k).name: (bool(compiled.jnt_limited[k]), list(compiled.jnt_range[k]))
        for k in range(compiled.njnt)
    }
    assert limits["to_l1"] == (True, [-1.0, 1.0])
    assert limits["to_l3"] == (True, [-1.0, 1.0])
    assert not limits["to_l2"][0] and not limits["to_l4.x"][0] and not limits["to_l4.turn"][0]


# ---- bodies that MuJoCo cannot represent -------------------------------------------------------------------------


def test_moments_beyond_the_triangle_inequality_are_kept() -> None:
    model = robot("romeo").model
    simulated = build_mjcf(model)
    assert set(simulated.moments) == {"RShoulderYawLink", "RElbowYawLink"}
    compiled = simulated.compile()
    for joint, name in simulated.bodies.items():
        exact = np.linalg.eigvalsh(model.inertias[joint].inertia)
        assert_close(np.sort(compiled.body(name).inertia), exact, 1e-12, name)


def test_a_massless_body_between_others() -> None:
    model = random_tree(["RX", "RY", "RZ"], [0, 0, 0], 1, True)
    model.inertias[2] = pin.Inertia.Zero()
    simulated = InMujoco(model)
    assert simulated.model.body(simulated.written.bodies[2]).mass[0] == 1e-15
    (q,) = random_configurations(model, 1, "massless")
    compare(model, simulated, q, rng("massless"))


def test_names_that_meet_or_need_escaping() -> None:
    model = random_tree(["RX", "RY"], [0, 0], 1, False)
    model.names[1], model.names[2] = "world", 'a<"b&'
    simulated = build_mjcf(model, 'r<"&')
    compiled = simulated.compile()
    assert simulated.bodies == {1: "world_2", 2: 'a<"b&'}
    assert compiled.joint('a<"b&').name == 'a<"b&'


def test_armature_that_has_no_place_is_refused() -> None:
    for kind, values in (("Spherical", [1.0, 2.0, 1.0]), ("Planar", [1.0, 2.0, 0.0])):
        model = random_tree([kind], [0], 1, False)
        model.armature = np.array(values)
        with pytest.raises(InputError, match="differs between its axes"):
            build_mjcf(model)


def test_base_armature_of_one_linear_and_one_angular_value_has_its_place() -> None:
    model = random_tree(["FreeFlyer", "RX"], [0, 0], 1, False)
    model.armature = np.array([2.0, 2, 2, 0.5, 0.5, 0.5, 0.1])
    simulated = InMujoco(model)
    assert simulated.model.jnt_type[0] == mujoco.mjtJoint.mjJNT_SLIDE
    (q,) = random_configurations(model, 1, "base")
    simulated.data.qpos[:] = simulated.written.layout.qpos(q)
    mujoco.mj_forward(simulated.model, simulated.data)
    M, T = np.zeros((7, 7)), simulated.written.layout.velocity_map(q)
    mujoco.mj_fullM(simulated.model, simulated.data, M)
    assert_close(T.T @ M @ T, mass_matrix(model, q), TOLERANCE, "M")


def test_the_model_is_plain_and_the_same_again() -> None:
    first, second = (build_mjcf(load_robot("solo8").model, "solo8") for _ in range(2))
    first.compile(), second.compile()
    assert first.spec.to_xml() == second.spec.to_xml()
    root = ET.fromstring(first.spec.to_xml())
    assert root.get("model") == "solo8"
    assert {e.tag for e in root.iter()} == {"mujoco", "compiler", "worldbody", "body", "joint", "inertial", "site"}
    assert list(first.spec.option.gravity) == [0.0, 0.0, -9.81]


def test_what_mujoco_refuses_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mjcf, "_LEAST", 0.0)
    model = random_tree(["RX", "RY"], [0, 0], 1, False)
    model.inertias[2] = pin.Inertia.Zero()
    with pytest.raises(InputError, match="MuJoCo refuses the model") as caught:
        build_mjcf(model).compile()
    assert "\n" not in caught.value.line
