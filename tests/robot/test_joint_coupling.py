"""Coupled joints (``<mimic>``): how they are read, and their dynamics, compared with mimic joints of Pinocchio."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from impact_posture.codegen.export import export
from impact_posture.codegen.impact_gradient import ImpactGradient
from impact_posture.dynamics.mjcf import build_mjcf
from impact_posture.errors import InputError, PostureError, UrdfError
from impact_posture.impact.evaluation.evaluation import evaluate
from impact_posture.impact.impact_case import ImpactCase
from impact_posture.impact.impact_contact import ImpactContact
from impact_posture.impact.metric import Metric
from impact_posture.impact.quantities.impact_oracle import ImpactOracle
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.robot.joint_coupling import JointCoupling
from impact_posture.robot.joint_model import with_joint_model
from impact_posture.robot.posture_files import set_joints
from impact_posture.robot.robot import Robot
from impact_posture.robot.robot_loader import load_robot
from impact_posture.robot.urdf import example_robot_data
from impact_posture.system.libraries import build_library, load_library
from tests.support.helpers import Vector, assert_close, robot, unit
from tests.support.mjcfs import ARM
from tests.support.pinocchio_values import central_gradient, mass_matrix
from tests.support.urdfs import MOVED, joint, link, load, write

FINGERS = MOVED.replace("-2.5", "0").replace("2.5", "0.04")


def mimic(leader: str, multiplier: float = 1.0, offset: float = 0.0) -> str:
    return f'<mimic joint="{leader}" multiplier="{multiplier}" offset="{offset}"/>'


def gripper(kind: str = "prismatic", phalanx: str = mimic("right_joint", -2.0, 0.1)) -> list[str]:
    """Return an arm with two fingers of different masses, the second with a phalanx that is coupled too."""
    masses = {"stand": 5, "upper": 2, "palm": 0.5, "left": 0.05, "right": 0.07}
    places = ("0 0 0", "0.2 0 0", "0.05 0.02 0", "0.04 0.01 0", "0.04 -0.02 0.01")
    return [
        *map(link, masses, masses.values(), places), link("tip", 0.02, "0.01 0 0"),
        joint("a", "stand upper", at="0 0 0.3"), joint("b", "upper palm", "0 0 1", at="0.4 0 0"),
        joint("left_joint", "palm left", "0 1 0", "0.08 0.01 0", kind, FINGERS),
        joint("right_joint", "palm right", "0 -1 0", "0.08 -0.01 0", kind, MOVED + mimic("left_joint", 1.5, 0.005)),
        joint("phalanx", "right tip", "0 0 1", "0.05 0 0", more=MOVED + phalanx),
    ]  # fmt: skip


def reduced_metric(model: pin.Model, q: Vector, frame: int, offset: Vector, n: Vector, armature: Vector) -> float:
    """Return ``nᵀJM⁻²Jᵀn`` of a model with mimic joints; ``q`` has the shape of this model."""
    data = model.createData()
    M = pin.crba(model, data, q)
    M = np.triu(M) + np.triu(M, 1).T + np.diag(armature)
    pin.computeJointJacobians(model, data, q)
    pin.updateFramePlacements(model, data)
    J = pin.getFrameJacobian(model, data, frame, pin.LOCAL_WORLD_ALIGNED)
    lever = data.oMf[frame].rotation @ offset
    a = np.linalg.solve(M, (J[:3] - pin.skew(lever) @ J[3:]).T @ n)
    return float(a @ a)


@pytest.mark.parametrize("kind", ["prismatic", "revolute"])
def test_the_metric_is_that_of_pinocchio_with_mimic_joints(tmp_path: Path, kind: str) -> None:
    loaded = load(tmp_path, *gripper(kind), toml="[armature]\ndefault = 0.01\n")
    pairs = [("right_joint", "left_joint", 1.5), ("phalanx", "left_joint", -3.0)]
    assert [(c.follower, c.leader, c.ratio) for c in loaded.couplings] == pairs
    assert [c.offset for c in loaded.couplings] == pytest.approx([0.005, 0.09])
    # Pinocchio does not read a follower of a follower, so its phalanx follows the first finger.
    path = write(tmp_path, *gripper(kind, mimic("left_joint", -3.0, 0.09)))
    reference = pin.buildModelFromUrdf(str(path), mimic=True)
    n, random = np.array([0.48, 0.6, 0.64]), np.random.default_rng(0)
    armature = 0.01 * np.array([1, 1, 1 + 1.5**2 + 3**2])
    for frame in ("palm", "left", "tip"):
        offset = (0.03, 0.01, -0.02)
        oracle = ImpactOracle(ImpactCase(loaded, ImpactContact(frame, tuple(n), offset)))
        for _ in range(3):
            q = loaded.coupled(random.uniform(0, 0.04, loaded.nq) + np.array([0.7, -0.4, 0, 0, 0]))
            index = reference.getFrameId(frame)
            expected = reduced_metric(reference, q[:3], index, np.array(offset), n, armature)
            assert oracle.quantities(q).H == pytest.approx(expected, rel=1e-10)
            jump = oracle.quantities(q).jump
            assert_close(jump[3:], jump[2] * np.array([1.5, -3.0]), 1e-12, "followers")


def test_panda_has_the_mass_matrix_of_pinocchio_with_mimic_joints() -> None:
    loaded = robot("panda")
    path = example_robot_data() / "panda_description/urdf/panda.urdf"
    reference = pin.buildModelFromUrdf(str(path), mimic=True)
    n, offset = unit(np.random.default_rng(1)), np.array([0.0, 0.0, 0.0095])
    armature = np.append(np.full(7, 0.1), 0.2)
    contact = ImpactContact("panda_leftfinger", tuple(n), tuple(offset))
    q = loaded.posture()
    expected = reduced_metric(reference, q[:-1], reference.getFrameId("panda_leftfinger"), offset, n, armature)
    assert ImpactOracle(ImpactCase(loaded, contact)).quantities(q).H == pytest.approx(expected, rel=1e-10)


@pytest.mark.parametrize("metric", [Metric(), Metric("kinetic"), Metric("weighted", (1.0, 2.0, 3.0, 4.0, 5.0))])
@pytest.mark.parametrize("kind", ["impulse", "speed", "sticking", "energy"])
def test_gradients_and_the_exported_code_agree(tmp_path: Path, kind: str, metric: Metric) -> None:
    loaded = load(tmp_path, *gripper(), toml="[armature]\ndefault = 0.01\n")
    contact = ImpactContact("tip", (0.0, 0.6, 0.8), (0.01, 0.0, 0.02))
    objective = WorstCaseObjective(loaded, contact, kind=kind, metric=metric)  # type: ignore[arg-type]
    q = loaded.coupled(np.array([0.7, -0.4, 0.02, 0, 0]))
    value, gradient = objective.gradient_fun()(q, np.array(contact.normal))
    assert float(value) == pytest.approx(objective.value(q), rel=1e-10)
    assert_close(np.array(gradient).ravel(), objective.gradient(q), 1e-9, "CasADi and Pinocchio")
    differences = central_gradient(objective.value, loaded.model, q, 2e-4)
    assert_close(objective.gradient(q), differences, 1e-8, "differences")
    together = evaluate(objective, q).gradient
    ends = [objective.oracle.quantities(loaded.coupled(q + step * np.eye(5)[2])).H for step in (-1e-5, 1e-5)]
    assert together[2] == pytest.approx((ends[1] - ends[0]) / 2e-5, rel=1e-6) and not together[3:].any()
    if kind == "impulse" and metric.kind == "euclidean":
        (tmp_path / "code").mkdir()
        made = export(objective, tmp_path / "code", prefix="grip", check=False)
        compiled = ImpactGradient(load_library(build_library(tmp_path / "code", made.prefix)), made.manifest)
        code, (H, slope) = compiled.call("eval", q, np.array(contact.normal))
        assert code == 0 and float(np.ravel(H)[0]) == pytest.approx(objective.value(q), rel=1e-12)
        assert_close(np.ravel(slope), objective.gradient(q), 1e-10, "C")
        header = (tmp_path / "code" / "grip.h").read_text()
        equations = [
            line.removeprefix(" *   ") for line in header.splitlines() if " = " in line and "q[2] + " in line
        ]
        for equation, entry in zip(equations, (3, 4), strict=True):
            left, right = equation.replace(" q[2]", " * q[2]").split(" = ")
            assert left == f"q[{entry}]" and eval(right, {"q": q}) == pytest.approx(q[entry])
        (sum_,) = (line.removeprefix(" *   ") for line in header.splitlines() if "grad[2] + " in line)
        along = eval(sum_.replace(" grad", " * grad").replace("+ * ", "+ "), {"grad": np.ravel(slope)})
        assert along == pytest.approx(together[2])


@pytest.mark.parametrize("kind", ["prismatic", "revolute"])
@pytest.mark.parametrize("frame", ["pillar", "tip", "c_finger"])
def test_leader_and_followers_at_one_link(tmp_path: Path, kind: str, frame: str) -> None:
    """Two arms on the ground and three fingers move together; two followers come before their leaders."""
    masses = {
        "stand": 5,
        "counter": 3,
        "pillar": 2,
        "a_finger": 0.05,
        "b_finger": 0.06,
        "c_finger": 0.07,
        "tip": 0.02,
    }
    fingers = [
        joint(f"{k}_joint", f"pillar {k}_finger", axis, f"0.08 {y} 0.3", kind, FINGERS + more)
        for k, axis, y, more in (
            ("a", "0 -1 0", -0.01, mimic("b_joint", 1.5, 0.005)), ("b", "0 1 0", 0.01, ""),
            ("c", "0.6 0 0.8", 0.0, mimic("b_joint", -0.7, 0.04)),
        )
    ]  # fmt: skip
    loaded = load(
        tmp_path, *[link(name, mass, "0.04 0.01 -0.02") for name, mass in masses.items()],
        joint("counter", "stand counter", "0 0.6 0.8", more=MOVED + mimic("pillar", -0.5)),
        joint("pillar", "stand pillar", "1 0 0", "0.1 0 0.2"), *fingers,
        joint("tip", "a_finger tip", "0 0 1", "0.05 0 0"), toml="[armature]\ndefault = 0.01\n",
    )  # fmt: skip
    assert {(c.follower, c.leader) for c in loaded.couplings} == {
        ("counter", "pillar"), ("a_joint", "b_joint"), ("c_joint", "b_joint")
    }  # fmt: skip
    objective = WorstCaseObjective(loaded, ImpactContact(frame, (0.0, 0.6, 0.8), (0.01, 0.0, 0.02)))
    q = loaded.coupled(np.array([0.0, 0.4, 0.0, 0.3, 0.02, 0.0]))
    value, gradient = objective.gradient_fun()(q, np.array(objective.contact.normal))
    assert float(value) == pytest.approx(objective.value(q), rel=1e-12)
    assert_close(np.array(gradient).ravel(), objective.gradient(q), 1e-11, "CasADi and Pinocchio")
    differences = central_gradient(objective.value, loaded.model, q, 2e-4)
    assert_close(np.array(gradient).ravel(), differences, 1e-8, "differences")


def test_a_light_follower_changes_nothing_and_a_locked_one_locks_its_leader(tmp_path: Path) -> None:
    loaded = load(tmp_path, *gripper(), toml="[armature]\ndefault = 0.01\n")
    alone = load(tmp_path, *gripper(), lock=("right_joint",), toml="[armature]\ndefault = 0.01\n")
    assert set(alone.locked) == {"left_joint", "right_joint", "phalanx"} and not alone.couplings
    table = '[armature]\ndefault = 0.01\n[transmission.joints]\nphalanx = { kind = "locked" }\n'
    held = with_joint_model(load(tmp_path, *gripper(), toml=table), "reflected")
    assert np.isinf(held.model.armature[2:]).all()
    case = ImpactCase(held, ImpactContact("tip", (0.0, 0.6, 0.8)))
    q = loaded.posture()
    expected = ImpactOracle(replace(case, robot=alone)).quantities(q[:2]).H
    assert ImpactOracle(case).quantities(q).H == pytest.approx(expected, rel=1e-9)


def test_limits_of_a_follower_bound_its_leader(tmp_path: Path) -> None:
    def limits(follower: str, multiplier: float = -2.0, offset: float = 0.1) -> tuple[Robot, list[float]]:
        ends = MOVED.replace('lower="-2.5" upper="2.5"', follower) + mimic("a", multiplier, offset)
        parts = link("s", 1), link("u", 1, "0.1 0 0"), link("f", 1, "0.1 0 0"), joint("a", "s u")
        loaded = load(tmp_path, *parts, joint("b", "u f", more=ends))
        low, high = loaded.model.lowerPositionLimit, loaded.model.upperPositionLimit
        return loaded, [*low.tolist(), *high.tolist()]

    # -1 ≤ -2 a + 0.1 ≤ 2 gives -0.95 ≤ a ≤ 0.55.
    loaded, bounds = limits('lower="-1" upper="2"')
    assert bounds == pytest.approx([-0.95, -1, 0.55, 2])
    assert loaded.velocity_limits == pytest.approx([2.5, 5])
    # A range of the follower that leaves no range for the leader is ignored.  Equal limits hold the follower, so they
    # do not bound the leader.
    loaded, bounds = limits('lower="6" upper="7"')
    assert bounds == pytest.approx([-2.5, -4.9, 2.5, 5.1])
    assert [line for line in loaded.warnings if "[6, 7] of 'b' contradict" in line]
    loaded, bounds = limits('lower="0" upper="0"')
    assert bounds == pytest.approx([-2.5, -4.9, 2.5, 5.1]) and not [w for w in loaded.warnings if "limits" in w]


def test_postures_keep_the_coupling(tmp_path: Path) -> None:
    toml = "[postures.open]\njoints = { left_joint = 0.02 }\n"
    loaded = load(tmp_path, *gripper(), toml=toml)
    assert loaded.posture("open")[2:] == pytest.approx([0.02, 0.035, 0.03])
    q = set_joints(loaded, loaded.posture(), {"left_joint": 0.01}, "here")
    assert loaded.check_posture(q)[2:] == pytest.approx([0.01, 0.02, 0.06])
    stated = {"left_joint": 0.01, "right_joint": 0.0201}
    q = loaded.check_posture(set_joints(loaded, loaded.posture(), stated, "here"))
    assert q[3] == pytest.approx(0.02, abs=1e-15)
    with pytest.raises(PostureError, match=r"'right_joint' is at 0\.03, but it follows 'left_joint' to 0\.02"):
        loaded.check_posture(set_joints(loaded, loaded.posture(), {**stated, "right_joint": 0.03}, "here"))


def test_couplings_that_cannot_be_carried_are_refused_by_name(tmp_path: Path) -> None:
    parts = link("s", 1), link("u", 1, "0.1 0 0"), link("f", 1, "0.1 0 0")
    for first, second, words in (
        (MOVED + mimic("b"), MOVED + mimic("a"), "'a' mimics 'b' mimics 'a'"),
        (MOVED, MOVED + mimic("b"), "'b' mimics 'b'"),
        (MOVED, MOVED + mimic("a").replace("1.0", "one"), "multiplier 'one' is not a number"),
    ):
        with pytest.raises(UrdfError, match=words):
            load(tmp_path, *parts, joint("a", "s u", more=first), joint("b", "u f", more=second))
    with pytest.raises(UrdfError, match="'a' of type planar is coupled"):
        load(tmp_path, *parts, joint("a", "s u", kind="planar", more=""), joint("b", "u f", more=MOVED + mimic("a")))


def test_a_mimic_of_a_fixed_joint_is_held_and_a_continuous_joint_gets_one_angle(tmp_path: Path) -> None:
    parts = link("s", 1), link("u", 1, "0.1 0 0"), link("f", 1, "0.1 0 0"), link("t", 1, "0.1 0 0")
    loaded = load(
        tmp_path, *parts, joint("a", "s u", kind="continuous"), joint("weld", "u f", kind="fixed", more=""),
        joint("b", "f t", kind="continuous", more=mimic("a", 0.5)), link("g", 1, "0 0 0.1"),
        joint("c", "t g", more=MOVED + mimic("weld", 3.0, 0.25)), link("h", 1, "0 0 0.1"),
        joint("d", "g h", kind="continuous", more=mimic("a", 0.0, -0.5)),
    )  # fmt: skip
    assert loaded.nq == loaded.nv == 4 and loaded.couplings == (JointCoupling("b", "a", 0.5, 0.0),)
    assert loaded.posture()[2:].tolist() == [0.25, -0.5] and loaded.fixed_with(()) == ("c", "d")
    assert not [w for w in loaded.warnings if "continuous" in w]


def test_the_online_controller_refuses_coupled_joints_that_it_would_move(tmp_path: Path) -> None:
    from impact_posture.tsid.actuators import Actuators

    with pytest.raises(InputError, match="'right_joint' is coupled to 'left_joint'"):
        Actuators(load(tmp_path, *gripper()))
    Actuators(load(tmp_path, *gripper(), toml='[constraints]\nhold = ["left_joint"]'))
    Actuators(robot("panda"))


def test_the_simulated_world_moves_coupled_joints_together(tmp_path: Path) -> None:
    """MuJoCo's constraint is soft, so the acceleration is compared to 0.1 %."""
    mujoco = pytest.importorskip("mujoco")
    loaded = load(tmp_path, *gripper(), toml="[armature]\ndefault = 0.01\n")
    written = build_mjcf(loaded.model)
    written.spec.option.timestep, written.spec.option.gravity = 1e-4, np.zeros(3)
    written.couple_joints(loaded)
    model = written.compile()
    data, q = mujoco.MjData(model), loaded.coupled(np.array([0.7, -0.4, 0.02, 0, 0]))
    data.qpos[:] = written.layout.qpos(q)
    tau = np.array([1.0, -2.0, 3.0, 0.5, -0.2])
    data.qfrc_applied[:] = np.linalg.inv(written.layout.velocity_map(q)).T @ tau
    mujoco.mj_forward(model, data)
    C, M = loaded.coupling_matrix, mass_matrix(loaded.model, q)
    expected = C @ np.linalg.solve(C.T @ M @ C + np.diag(1.0 * loaded.followers), C.T @ tau)
    assert_close(np.linalg.solve(written.layout.velocity_map(q), data.qacc), expected, 1e-3, "acceleration")
    for _ in range(100):
        mujoco.mj_step(model, data)
    moved = written.layout.q(data.qpos)
    assert abs(moved - q).max() > 1e-3
    assert_close(moved, loaded.coupled(moved), 1e-5, "coupling")


def test_joint_equalities_of_an_mjcf_are_couplings(tmp_path: Path) -> None:
    """The attribute ``data`` of an equality couples changes of the joints from their reference positions."""
    pytest.importorskip("mujoco")
    equality = '<equality><joint joint1="wrist" joint2="shoulder" polycoef=".1 -2 {} 0 0"/></equality></mujoco>'
    twice = '<joint joint1="wrist" joint2="elbow"/>'
    path = tmp_path / "arm.xml"
    path.write_text(ARM.replace("</mujoco>", equality.format(0)))
    loaded = load_robot(str(path))
    assert loaded.couplings == (JointCoupling("wrist", "shoulder", -2.0, 0.1 + 2 * 0.4),)
    assert loaded.nq == loaded.nv == 4
    path.write_text(ARM.replace("</mujoco>", equality.format(1)))
    with pytest.raises(UrdfError, match="'wrist' follows another by a polynomial"):
        load_robot(str(path))
    path.write_text(ARM.replace("</mujoco>", equality.format(0).replace("</equality>", f"{twice}</equality>")))
    with pytest.raises(UrdfError, match="'wrist' follows two joints"):
        load_robot(str(path))
    held = '<equality><joint joint1="elbow" polycoef=".3 0 0 0 0"/></equality></mujoco>'
    path.write_text(ARM.replace("</mujoco>", held))
    assert load_robot(str(path)).fixed_with(()) == ("elbow",)
