"""Symbolic dynamics compared with Pinocchio: all known robots, random trees of all joint types, unusual URDFs."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from impact_posture.dynamics.chart import Chart
from impact_posture.dynamics.joints import joint_kind
from impact_posture.dynamics.numeric import Numeric
from impact_posture.dynamics.spatial import template
from impact_posture.dynamics.tree import PointOnLink, Tree, Wrench
from impact_posture.errors import UnsupportedJoint
from impact_posture.robot.urdf import build_model
from tests.support.helpers import NAMES, Vector, assert_close, contact_frame, random_configurations, rng, robot
from tests.support.pinocchio_values import central_gradient, frame_jacobian, frame_placement, mass_matrix
from tests.support.tangent import composite_mass_matrix

TOLERANCE = 1e-10
OFFSET = np.array([0.03, -0.05, 0.08])


def point_at(model: pin.Model, frame: int, offset: Vector = OFFSET) -> PointOnLink:
    carrier = model.frames[frame]
    position = np.array(carrier.placement.act(offset))
    return PointOnLink(int(carrier.parentJoint), position, np.array(carrier.placement.rotation))


@dataclass(frozen=True)
class Symbolic:
    """CasADi functions of all expressions of a tree: one of (q, v, tau, wrench), one of chart coordinates."""

    model: pin.Model
    frame: int
    all_fun: ca.Function
    chart: Chart
    chart_fun: ca.Function


def build(model: pin.Model, frame: int) -> Symbolic:
    q, v, tau = ca.SX.sym("q", model.nq), ca.SX.sym("v", model.nv), ca.SX.sym("tau", model.nv)
    w, u = ca.SX.sym("w", 6), ca.SX.sym("u", model.nv)
    tree = Tree(model, q)
    point = point_at(model, frame)
    world, local = Wrench(point, w[:3], w[3:]), Wrench(point, w[:3], w[3:], in_frame=True)
    at_v = tree.velocities(v)
    solved, other = tree.respond(tau=tau, wrenches=[world]), tree.respond(tau=u, wrenches=[local])
    rates, lean = solved.velocities, Tree(model, q, visits=[])
    both = lean.respond(tau=tau, wrenches=[world]), lean.respond(tau=u, wrenches=[local])
    outputs = {
        "M": composite_mass_matrix(tree),
        "M v": tree.mass_times(v),
        "M v of known velocities": tree.mass_times(v, at_v, extra=False),
        "solve": tree.respond(tau=tau).a,
        "solve with wrench": solved.a,
        "solve with wrench in frame": other.a,
        "solve's velocities": ca.horzcat(*[rates[i] for i in sorted(rates)]),
        "velocities": ca.horzcat(*[at_v[i] for i in sorted(at_v)]),
        "force": tree.generalized_force([world]),
        "force in frame": tree.generalized_force([local]),
        "two forces": tree.generalized_force([world, local]),
        "position": tree.position(point),
        "rotation": tree.rotation(point),
        "com": tree.center_of_mass(),
        "J v": tree.point_velocity(point, at_v),
        "gradient vMv": tree.energy_gradient(at_v),
        "gradient of a pair": tree.pair_gradient(solved, other),
        "lean gradient of a pair": lean.pair_gradient(*both),
    }
    names = list(outputs)
    all_fun = ca.Function(
        "all", [q, v, u, tau, w], list(outputs.values()), ["q", "v", "u", "tau", "w"],
        [f"o{k}" for k in range(len(names))],
    )  # fmt: skip
    chart = Chart(model)
    x = ca.SX.sym("x", chart.nx)
    chart_tree = Tree(model, chart.configuration(x), chart_x=x)
    chart_fun = ca.Function("chart", [x], [chart_tree.quaternion(point), chart_tree.position(point)])
    return Symbolic(model, frame, all_fun, chart, chart_fun)


OUTPUTS = (
    "M", "M v", "M v of known velocities", "solve", "solve with wrench", "solve with wrench in frame",
    "solve's velocities", "velocities", "force", "force in frame", "two forces", "position", "rotation", "com", "J v",
    "gradient vMv", "gradient of a pair", "lean gradient of a pair",
)  # fmt: skip


def compare(symbolic: Symbolic, q: Vector, generator: np.random.Generator) -> None:
    model, frame = symbolic.model, symbolic.frame
    v, u, tau = (generator.normal(size=model.nv) for _ in range(3))
    w = generator.normal(size=6)
    result = dict(zip(OUTPUTS, (np.array(o) for o in symbolic.all_fun(q, v, u, tau, w)), strict=True))
    M, J, placement = mass_matrix(model, q), frame_jacobian(model, q, frame, OFFSET), frame_placement(model, q, frame)
    turned = np.concatenate([placement.rotation @ w[:3], placement.rotation @ w[3:]])
    data = model.createData()

    def link_velocities(rate: Vector) -> Vector:
        pin.forwardKinematics(model, data, q, rate)
        return np.column_stack([data.v[i].vector for i in range(1, model.njoints)])

    accelerated, other = np.linalg.solve(M, tau + J.T @ w), np.linalg.solve(M, u + J.T @ turned)
    expected: dict[str, Vector] = {
        "M": M,
        "M v": M @ v,
        "M v of known velocities": M @ v,
        "solve": np.linalg.solve(M, tau),
        "solve with wrench": accelerated,
        "solve with wrench in frame": other,
        "solve's velocities": link_velocities(accelerated),
        "velocities": link_velocities(v),
        "force": J.T @ w,
        "force in frame": J.T @ turned,
        "two forces": J.T @ (w + turned),
        "position": placement.act(OFFSET),
        "rotation": placement.rotation,
        "com": np.array(pin.centerOfMass(model, data, q)),
        "J v": J @ v,
    }
    for name, value in expected.items():
        assert_close(result[name], value, TOLERANCE, name)
    # Pinocchio's derivative algorithms are independent of the backward sweeps under test.
    numeric, point = Numeric(model).at(q), point_at(model, frame)
    terms = (
        (numeric.coupling_gradient(point, w, other), np.abs(w) @ np.abs(J @ other)),
        (numeric.coupling_gradient(point, w, accelerated, in_frame=True), np.abs(turned) @ np.abs(J @ accelerated)),
        (-numeric.inertial_gradient(other, accelerated), np.abs(other) @ np.abs(M @ accelerated)),
    )
    gradients = {
        "gradient vMv": (numeric.inertial_gradient(v, v), np.abs(v) @ np.abs(M @ v)),
        "gradient of a pair": (sum(gradient for gradient, _ in terms), max(scale for _, scale in terms)),
    }
    gradients["lean gradient of a pair"] = gradients["gradient of a pair"]
    for name, (value, scale) in gradients.items():
        assert_close(result[name], value, TOLERANCE, name, scale)
    quaternion, position = (np.array(o).reshape(-1) for o in symbolic.chart_fun(symbolic.chart.to_x(q)))
    assert abs(np.linalg.norm(quaternion) - 1) < TOLERANCE
    assert_close(pin.Quaternion(quaternion).matrix(), placement.rotation, TOLERANCE, "quaternion")
    assert_close(position, placement.act(OFFSET), TOLERANCE, "position in the chart")


# ---- all known robots -------------------------------------------------------------------------------------------


@functools.cache
def symbolic_of(name: str) -> Symbolic:
    loaded = robot(name)
    return build(loaded.model, loaded.frame_id(contact_frame(loaded)))


@pytest.mark.parametrize("name", NAMES)
def test_robot_agrees_with_pinocchio(name: str) -> None:
    # Named postures contain zeros and right angles, for which Pinocchio uses other branches than for random numbers.
    symbolic = symbolic_of(name)
    for k, q in enumerate(
        [*random_configurations(symbolic.model, 3, name, "dynamics"), *robot(name).postures.values()]
    ):
        compare(symbolic, q, rng(name, k))


@pytest.mark.parametrize("name", ["solo8", "panda", "kinova", "tilthex_arm"])
def test_numeric_gradients_are_central_differences(name: str) -> None:
    loaded = robot(name)
    model, frame = loaded.model, loaded.frame_id(contact_frame(loaded))
    generator = rng(name, "numeric")
    (q,) = random_configurations(model, 1, name, "numeric")
    left, right, w = generator.normal(size=model.nv), generator.normal(size=model.nv), generator.normal(size=6)
    point, numeric = point_at(model, frame), Numeric(model).at(q)

    def inertial(at: Vector) -> float:
        return float(left @ mass_matrix(model, at) @ right)

    def coupled(at: Vector) -> float:
        return float(w @ frame_jacobian(model, at, frame, OFFSET) @ right)

    def turning(at: Vector) -> Vector:
        return frame_placement(model, at, frame).rotation @ w[:3]

    def coupled_in_frame(at: Vector) -> float:
        R = frame_placement(model, at, frame).rotation
        J = frame_jacobian(model, at, frame, OFFSET)
        return float((R @ w[:3]) @ J[:3] @ right + (R @ w[3:]) @ J[3:] @ right)

    def differences(f: Callable[[Vector], object]) -> Vector:
        return central_gradient(f, model, q, 1e-3)  # type: ignore[arg-type]

    assert_close(numeric.inertial_gradient(left, right), differences(inertial), 1e-8, "inertial")
    assert_close(numeric.coupling_gradient(point, w, right), differences(coupled), 1e-8, "coupling")
    in_frame = numeric.coupling_gradient(point, w, right, in_frame=True)
    scale = float(np.abs(w) @ np.abs(frame_jacobian(model, q, frame, OFFSET) @ right))
    assert_close(in_frame, differences(coupled_in_frame), 1e-8, "coupling in frame", scale)
    found_turning = numeric.turning_gradient(point, turning(q), left[:3])
    assert_close(found_turning, left[:3] @ differences(turning), 1e-8, "turning")


@pytest.mark.parametrize("name", NAMES)
def test_numeric_is_pinocchio(name: str) -> None:
    loaded = robot(name)
    model, frame = loaded.model, loaded.frame_id(contact_frame(loaded))
    for q in random_configurations(model, 2, name, "is pinocchio"):
        numeric, point = Numeric(model).at(q), point_at(model, frame)
        assert_close(numeric.mass_matrix(), mass_matrix(model, q), TOLERANCE, "M")
        assert_close(numeric.jacobian(point), frame_jacobian(model, q, frame, OFFSET), TOLERANCE, "J")
        assert_close(numeric.placement(point).rotation, frame_placement(model, q, frame).rotation, TOLERANCE, "R")
        com, com_jacobian = numeric.center_of_mass()
        data = model.createData()
        assert_close(com, pin.centerOfMass(model, data, q), TOLERANCE, "com")
        assert_close(com_jacobian, pin.jacobianCenterOfMass(model, data, q), TOLERANCE, "com jacobian")


def test_the_mass_matrix_does_not_depend_on_the_base_pose() -> None:
    symbolic = symbolic_of("talos")
    q, other = random_configurations(symbolic.model, 2, "base pose")
    moved = np.concatenate([other[:7], q[7:]])
    zeros = [np.zeros(symbolic.model.nv)] * 3
    first, second = (np.array(symbolic.all_fun(p, *zeros, np.zeros(6))[0]) for p in (q, moved))
    np.testing.assert_array_equal(first, second)


# ---- random trees of every joint --------------------------------------------------------------------------------

_LINK = (
    '<link name="{0}"><inertial><mass value="{1}"/><origin xyz="0.02 0.1 0.3" rpy="0.3 0.2 0.1"/>'
    '<inertia ixx="0.02" iyy="0.03" izz="0.04" ixy="0.001" ixz="0.002" iyz="0.003"/></inertial></link>'
)
_JOINT = (
    '<joint name="to_{1}" type="{2}"><parent link="{0}"/><child link="{1}"/><origin xyz="0.1 0.2 0.5" rpy="1 2 3"/>'
    '{3}<limit lower="-1" upper="1" effort="1" velocity="1"/></joint>'
)
_AXIS = np.array([1.0, -2.0, 3.0]) / np.sqrt(14.0)


@functools.cache
def _continuous_about_an_odd_axis() -> pin.JointModel:
    # Only the URDF parser can create this joint type; Pinocchio's Python API cannot.
    joint = '<parent link="a"/><child link="b"/><axis xyz="1 -2 3"/>'
    xml = f'<link name="a"/>{_LINK.format("b", 1.0)}<joint name="j" type="continuous">{joint}</joint>'
    return pin.buildModelFromXML(f'<robot name="r">{xml}</robot>').joints[1]


JOINTS: dict[str, Callable[[], pin.JointModel]] = {
    **{n: getattr(pin, f"JointModel{n}") for n in ("RX", "RY", "RZ", "RUBX", "RUBY", "RUBZ", "PX", "PY", "PZ")},
    "RevoluteUnaligned": lambda: pin.JointModelRevoluteUnaligned(_AXIS),
    "RevoluteUnboundedUnaligned": _continuous_about_an_odd_axis,
    "PrismaticUnaligned": lambda: pin.JointModelPrismaticUnaligned(_AXIS),
    "Planar": pin.JointModelPlanar,
    "Spherical": pin.JointModelSpherical,
    "Translation": pin.JointModelTranslation,
    "FreeFlyer": pin.JointModelFreeFlyer,
}


def random_tree(kinds: list[str], climbs: list[int], seed: int, armature: bool) -> pin.Model:
    """Build a tree.  The parent of joint k is the preceding joint, or its ancestor ``climbs[k]`` levels above."""
    pin.seed(seed)
    generator = np.random.default_rng(seed)
    model, path = pin.Model(), [0]
    for k, kind in enumerate(kinds):
        # Choose each parent on the path to the last joint, so that joint numbers are depth-first, as Pinocchio's CRBA
        # requires.
        del path[max(1, len(path) - climbs[k]) :]
        joint = model.addJoint(path[-1], JOINTS[kind](), pin.SE3.Random(), f"{k} {kind}")
        body = pin.Inertia.Random()
        body.mass = abs(body.mass) + 0.2
        model.appendBodyToJoint(joint, body, pin.SE3.Identity())
        path.append(joint)
    if armature:
        model.armature = generator.uniform(0.01, 0.3, model.nv)
    model.addFrame(pin.Frame("tip", path[-1], 0, pin.SE3.Random(), pin.FrameType.OP_FRAME))
    return model


@st.composite
def trees(draw: st.DrawFn) -> pin.Model:
    floating = draw(st.booleans())
    kinds = draw(st.lists(st.sampled_from(sorted(JOINTS)), min_size=1, max_size=6))
    if floating:
        kinds = ["FreeFlyer", *kinds]
    climbs = draw(st.lists(st.integers(0, 3), min_size=len(kinds), max_size=len(kinds)))
    return random_tree(kinds, climbs, draw(st.integers(0, 10_000)), draw(st.booleans()))


@settings(max_examples=25)
@given(trees(), st.integers(0, 10_000))
def test_random_tree_agrees_with_pinocchio(model: pin.Model, seed: int) -> None:
    (q,) = random_configurations(model, 1, seed)
    compare(build(model, model.nframes - 1), q, rng(seed))


@pytest.mark.parametrize("kind", sorted(JOINTS))
@pytest.mark.parametrize("above", ["RX", "FreeFlyer"])
def test_each_joint_in_the_middle_of_a_branching_tree(kind: str, above: str) -> None:
    model = random_tree([above, kind, "RY", "PZ", kind], [0, 0, 0, 1, 2], seed=7, armature=True)
    (q,) = random_configurations(model, 1, kind, above)
    compare(build(model, model.nframes - 1), q, rng(kind, above))


def test_joints_that_no_urdf_makes_are_refused_by_name() -> None:
    for joint in (pin.JointModelHX(0.1), pin.JointModelUniversal(np.eye(3)[0], np.eye(3)[1])):
        with pytest.raises(UnsupportedJoint, match="joint 'odd' is of type"):
            joint_kind(joint, "odd")


# ---- joint types of the URDF parser ------------------------------------------------------------------------------


def write_urdf(path: Path, joints: list[tuple[str, str]]) -> Path:
    """Write the URDF of a chain of links; ``joints`` lists pairs of type and axis."""
    text = ["<robot name='chain'>", _LINK.format("l0", 2.0)]
    for k, (kind, axis) in enumerate(joints):
        text.append(_LINK.format(f"l{k + 1}", 1.0 + 0.3 * k))
        text.append(_JOINT.format(f"l{k}", f"l{k + 1}", kind, f'<axis xyz="{axis}"/>' if axis else ""))
    path.write_text("\n".join([*text, "</robot>"]), encoding="utf-8")
    return path


@pytest.mark.parametrize("floating", [False, True])
@pytest.mark.parametrize(
    ("joints", "types"),
    [
        ([("continuous", "1 2 3"), ("revolute", "0 0 1")], ["RevoluteUnboundedUnaligned", "RZ"]),
        ([("continuous", "-1 0 0"), ("prismatic", "0 -1 0")], ["RevoluteUnboundedUnaligned", "PrismaticUnaligned"]),
        ([("continuous", "0 1 0"), ("revolute", "3 2 1")], ["RUBY", "RevoluteUnaligned"]),
        ([("planar", "0 0 1"), ("revolute", "1 0 0")], ["Planar", "RX"]),
        ([("revolute", "0 1 0"), ("floating", ""), ("continuous", "0 0 1")], ["RY", "FreeFlyer", "RUBZ"]),
        ([("prismatic", "1 0 0"), ("prismatic", "1 1 0"), ("fixed", "")], ["PX", "PrismaticUnaligned"]),
    ],
)
def test_urdf_joints(tmp_path: Path, joints: list[tuple[str, str]], types: list[str], floating: bool) -> None:
    model, _, _ = build_model(write_urdf(tmp_path / "chain.urdf", joints), free_flyer=floating)
    built = [joint.shortname().removeprefix("JointModel") for joint in list(model.joints)[1 + floating :]]
    assert built == types
    symbolic = build(model, model.getFrameId(f"l{len(joints)}"))
    for k, q in enumerate(random_configurations(model, 2, types, floating)):
        compare(symbolic, q, rng(types, k))


def test_a_template_inserts_its_arguments_as_if_written_out() -> None:
    times = []

    @template
    def turned(R: ca.SX, v: ca.SX, *, factor: float) -> ca.SX:
        times.append(factor)
        return factor * (R @ v)

    v, angle = ca.SX.sym("v", 3), ca.SX.sym("angle")
    R = ca.blockcat([[1, 0, 0], [0, ca.cos(angle), -ca.sin(angle)], [0, ca.sin(angle), ca.cos(angle)]])
    written, result = 2 * (R @ v), turned(R, v, factor=2.0)
    assert str(result) == str(written)
    assert str(turned(ca.SX.eye(3), v, factor=2.0)) == str(2 * v)
    assert turned(ca.SX(3, 3), v, factor=2.0).is_zero()
    assert times == [2.0], "made again for the same sizes and options"
    assert turned(R, ca.SX.sym("two", 3, 2), factor=2.0).shape == (3, 2)
    assert turned(R, v, factor=3.0).shape == (3, 1)
    assert times == [2.0, 2.0, 3.0]
