"""Links, rotors and springs during a contact: time stepping, energy, limit cases, differences, and invalid input."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import NamedTuple

import numpy as np
import pinocchio as pin
import pytest
from scipy.integrate import solve_ivp

from impact_posture.config.problem_settings import MetricKind, NormalFrame
from impact_posture.errors import ContactError, ImpactPostureError, InputError
from impact_posture.impact.elasticity.elastic_impact import ElasticImpact, ElasticResponse
from impact_posture.impact.impact_case import ImpactCase
from impact_posture.impact.impact_contact import ImpactContact
from impact_posture.impact.metric import Metric
from impact_posture.impact.quantities.impact_oracle import ImpactOracle
from impact_posture.robot.joint_model import with_joint_model
from impact_posture.robot.robot import Robot
from impact_posture.robot.robot_spec import JointTransmissionSpec, TransmissionSpec
from tests.support.arms import TIP, Y, arm, seven_joints
from tests.support.helpers import Vector, assert_close, contact_frame, rng, robot, unit
from tests.support.pinocchio_values import central_gradient, frame_jacobian, frame_placement, mass_matrix

STEP = 2e-4


def on_springs(loaded: Robot, table: TransmissionSpec) -> Robot:
    return replace(loaded, spec=replace(loaded.spec, transmission=table))


def springs(stiffness: float, damping: float = 0.0, **joints: JointTransmissionSpec) -> TransmissionSpec:
    """Return springs for all joints; ``joints`` states other transmissions."""
    return TransmissionSpec("elastic", stiffness, damping, joints)


class Setup(NamedTuple):
    """Impact case with its posture and the stiffness of its contact."""

    case: ImpactCase
    q: Vector
    stiffness: float


def case_of(name: str) -> Setup:
    """Return the test case of a robot; the cases differ in base, feet, dampers, joint types and metric."""
    generator = rng(name, "elastic")
    rigid, locked = JointTransmissionSpec("rigid"), JointTransmissionSpec("locked")
    if name == "panda":
        soft = {f"panda_joint{k}": JointTransmissionSpec("elastic", 14e3 if k < 5 else 9e3) for k in range(1, 8)}
        loaded, stiffness = on_springs(robot(name), TransmissionSpec(joints=soft)), 1e5
    elif name == "arm":
        loaded, stiffness = on_springs(seven_joints(), springs(150.0)), 3e3
    elif name == "mixed arm":
        table = springs(150.0, 0.4, joint_1=rigid, joint_3=locked, joint_5=JointTransmissionSpec(None, 700.0, 0.0))
        loaded, stiffness = on_springs(seven_joints(), table), 5e3
    elif name == "talos":
        soft = {f"arm_right_{k}_joint": JointTransmissionSpec("elastic", 9e3, 3.0) for k in range(1, 8)}
        loaded, stiffness = on_springs(robot(name), TransmissionSpec("rigid", joints=soft)), 1e5
    elif name == "tilthex_arm":
        loaded, stiffness = on_springs(robot(name), springs(300.0)), 1e4
    else:
        loaded, stiffness = on_springs(robot(name), springs(30.0, 0.01)), 1e4
    feet = loaded.spec.supports if name == "solo12" else ()
    place = list(CASES).index(name)
    kind: MetricKind = ("euclidean", "kinetic", "weighted")[place % 3]
    weights = tuple(generator.uniform(0.5, 2.0, loaded.nv)) if kind == "weighted" else None
    axes: NormalFrame = ("world", "contact")[place % 2]
    contact = ImpactContact(contact_frame(loaded), tuple(unit(generator)), (0.01, -0.02, 0.03), axes)
    q = np.array(pin.integrate(loaded.model, loaded.posture(), 0.2 * generator.normal(size=loaded.nv)))
    return Setup(ImpactCase(loaded, contact, Metric(kind, weights), feet), q, stiffness)


CASES = ("panda", "arm", "mixed arm", "talos", "tilthex_arm", "solo12")


class Stepped(NamedTuple):
    """State of the time stepping at the end of the compression, and the largest values before the end."""

    duration: float
    x: Vector
    y: Vector
    delta: float
    impulse: float
    torque: Vector
    largest_torque: Vector
    largest_square: float
    loss: float
    energy: float


def stepped(case: ImpactCase, q: Vector, stiffness: float, speed: float) -> Stepped:
    """Integrate the equations of motion with Pinocchio's matrices, by an adaptive Runge–Kutta method."""
    result, spec = case.robot, case.robot.spec.transmission
    nv, base = result.nv, result.first_joint
    own = [spec.joints.get(joint, JointTransmissionSpec()) for joint in result.joint_names]
    kinds = np.array(["base"] * base + [joint.kind or spec.kind or "none" for joint in own])
    K = np.array([0.0] * base + [joint.stiffness or spec.stiffness or 0.0 for joint in own])
    D = np.array([0.0] * base + [spec.damping if joint.damping is None else joint.damping for joint in own])
    soft = (kinds == "elastic") & (result.armature > 0) & (K > 0)
    moves, B = kinds != "locked", np.where(soft, result.armature, 1.0)
    K, D = K * soft, D * soft
    bare = pin.Model(result.model)
    bare.armature = np.where(soft, 0.0, result.armature)
    links = mass_matrix(bare, q)
    M = links.copy()
    for foot in case.supports:
        Js = frame_jacobian(bare, q, result.frame_id(foot.frame), foot.offset)[: foot.rows]
        M += Js.T @ Js / case.compliance
    frame = result.frame_id(case.contact.frame)
    n = np.array(case.contact.normal)
    if case.in_contact_frame:
        n = frame_placement(bare, q, frame).rotation @ n
    j = n @ frame_jacobian(bare, q, frame, case.contact.offset)[:3]
    inverse = np.zeros((nv, nv))
    C, followers = result.coupling_matrix, result.followers
    inverse[np.ix_(moves, moves)] = np.linalg.inv((C.T @ M @ C + np.diag(1.0 * followers))[np.ix_(moves, moves)])
    inverse = C @ inverse @ C.T
    W = links if case.metric.kind == "kinetic" else np.diag(case.metric.diagonal(nv) * ~followers)

    def torque(state: Vector) -> Vector:
        x, y, dx, dy = state[: 4 * nv].reshape(4, nv)
        return K * (x - y) + D * (dx - dy)

    def rate(_: float, state: Vector) -> Vector:
        _x, _y, dx, dy = state[: 4 * nv].reshape(4, nv)
        tau, f = torque(state), stiffness * state[4 * nv]
        loss = np.sum(D * (dx - dy) ** 2)
        return np.concatenate([dx, dy, inverse @ (j * f - tau), tau / B, [speed - j @ dx, f, loss]])

    def slows(_: float, state: Vector) -> float:
        return float(speed - j @ state[2 * nv : 3 * nv])

    slows.terminal, slows.direction = True, -1  # type: ignore[attr-defined]
    end = 20 * np.pi / np.sqrt(stiffness * float(j @ inverse @ j))
    run = solve_ivp(
        rate, (0, 10 * end), np.zeros(4 * nv + 3), method="DOP853", events=slows, rtol=1e-11, atol=1e-14,
        max_step=end / 2000, dense_output=True,
    )  # fmt: skip
    assert run.status == 1
    last = run.y_events[0][0]
    dx, dy = last[2 * nv : 4 * nv].reshape(2, nv)
    between = run.sol(np.linspace(0, run.t_events[0][0], 5000)).T
    x, y, dxs, dys = np.moveaxis(between[:, : 4 * nv].reshape(-1, 4, nv), 1, 0)
    torques, squares = K * (x - y) + D * (dxs - dys), np.sum((dxs @ W) * dxs, axis=1)
    x, y = last[: 2 * nv].reshape(2, nv)
    delta, impulse, loss = last[4 * nv :]
    stored = stiffness * delta**2 / 2 + np.sum(K * (x - y) ** 2) / 2
    return Stepped(
        duration=float(run.t_events[0][0]), x=dx, y=np.where(soft, dy, dx), delta=delta, impulse=impulse,
        torque=torque(last), largest_torque=np.abs(torques).max(axis=0), largest_square=float(squares.max()),
        loss=loss, energy=float(dx @ M @ dx / 2 + dy @ (B * soft * dy) / 2 + stored),
    )  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_time_stepping_finds_the_same(name: str) -> None:
    case, q, stiffness = case_of(name)
    speed = 0.7
    response, other = ElasticImpact(case).response(q, stiffness, speed), stepped(case, q, stiffness, speed)
    assert response.duration == pytest.approx(other.duration, rel=1e-8)
    assert response.force == pytest.approx(stiffness * other.delta, rel=1e-8)
    assert response.impulse == pytest.approx(other.impulse, rel=1e-8)
    assert_close(response.jump, other.x, 1e-8, "links")
    assert_close(response.rotor_jump, other.y, 1e-8, "rotors")
    assert_close(response.torque, other.torque, 1e-7, "torque")
    assert_close(response.peak_torque, other.largest_torque, 1e-6, "largest torque")
    assert response.peak_jump_norm == pytest.approx(np.sqrt(other.largest_square), rel=1e-6)
    assert (response.peak_torque >= np.abs(response.torque) * (1 - 1e-12)).all()
    assert response.peak_jump_norm >= response.jump_norm * (1 - 1e-12)
    assert response.value == pytest.approx((response.jump_norm / speed) ** 2, rel=1e-12)
    # The supplied energy is the impulse times the approach speed, because the motion without contact has this speed.
    assert response.impulse * response.speed == pytest.approx(other.energy + other.loss, rel=1e-8)
    assert (other.loss > 0) == (name in ("mixed arm", "talos", "solo12"))


@pytest.mark.parametrize("name", CASES)
def test_gradient_equals_differences(name: str) -> None:
    case, q, stiffness = case_of(name)
    elastic = ElasticImpact(case)
    value = elastic.value(q, stiffness)
    assert value == pytest.approx(elastic.response(q, stiffness, 0.3).value, rel=1e-12)
    differences = central_gradient(lambda p: elastic.value(p, stiffness), case.robot.model, q, STEP)
    assert_close(elastic.gradient(q, stiffness), differences, 1e-6, "gradient", scale=value)


@pytest.mark.parametrize("name", ["panda", "arm", "tilthex_arm"])
def test_limits_are_the_joint_models(name: str) -> None:
    """A stiff contact moves only the links; a soft contact with stiff joint springs moves links and rotors."""
    case, q, _ = case_of(name)
    case = replace(case, metric=Metric(), robot=on_springs(case.robot, springs(5e3 if name == "panda" else 150.0)))
    elastic, stiff = ElasticImpact(case), {}
    links = ImpactOracle(replace(case, robot=with_joint_model(case.robot, "link"))).quantities(q).V
    both = ImpactOracle(case).quantities(q).V
    assert not 0.7 < links / both < 1.5
    short = [abs(elastic.response(q, k).value / links - 1) for k in (1e10, 1e12)]
    assert short[1] < 1e-6 and short[0] / short[1] == pytest.approx(100, rel=0.05)
    for K in (1e10, 1e12):
        rigid = replace(case, robot=on_springs(case.robot, springs(K)))
        stiff[K] = abs(ElasticImpact(rigid).response(q, 1e4).value / both - 1)
    assert stiff[1e12] < 1e-6 and stiff[1e10] < 1e-4
    assert elastic.response(q, 1.0).value == pytest.approx(both, rel=1e-2)
    assert elastic.response(q, 1e10).compliance_ratio < 0.02 < 20 < elastic.response(q, 1.0).compliance_ratio


def test_dampers_hold_rotors_to_links() -> None:
    case, q, stiffness = case_of("arm")
    case = replace(case, metric=Metric())
    both = ImpactOracle(case).quantities(q).V
    held = replace(case, robot=on_springs(case.robot, springs(150.0, 1e5)))
    assert ElasticImpact(held).response(q, stiffness).value == pytest.approx(both, rel=1e-5)


def test_first_greatest_compression_of_many() -> None:
    """With soft wrists, the compression rises, stops and rises again; the impact phase ends at the first stop."""
    generator, close = rng("first root"), 0
    case, _, _ = case_of("arm")
    case = replace(case, metric=Metric())
    for _ in range(25):
        soft = {
            f"joint_{k}": JointTransmissionSpec("elastic", 10 ** generator.uniform(0, 4), generator.choice([0, 0.1]))
            for k in range(7)
        }
        drawn = replace(case, robot=on_springs(case.robot, TransmissionSpec(joints=soft)))
        q, stiffness = generator.uniform(-1, 1, 7), 10 ** generator.uniform(2, 5)
        response, other = ElasticImpact(drawn).response(q, stiffness), stepped(drawn, q, stiffness, 1.0)
        assert response.duration == pytest.approx(other.duration, rel=1e-7)
        assert response.value == pytest.approx(float(other.x @ other.x), rel=1e-6)
        close += 0.2 < response.compliance_ratio < 0.75
    assert close >= 3


def test_ratio_of_a_robot_on_its_feet() -> None:
    """The base yields through the springs of the legs, although feet and rotors are fixed."""
    case, q, stiffness = case_of("solo12")
    oracle = ElasticImpact(case).oracle.at(q)
    Js, j = oracle.Js, oracle.n @ oracle.J
    K = np.diag([0.0] * 6 + [30.0] * 12)
    kkt = np.block([[K, Js.T], [Js, np.zeros((len(Js),) * 2)]])
    compliance = j @ np.linalg.lstsq(kkt, np.append(j, np.zeros(len(Js))), rcond=1e-12)[0][:18]
    response = ElasticImpact(case).response(q, stiffness)
    expected = response.duration * np.sqrt(j @ oracle.solve(j) / compliance)
    assert response.compliance_ratio == pytest.approx(expected, rel=1e-5)


def test_contact_that_no_spring_takes() -> None:
    case, q, stiffness = case_of("arm")
    rigid = {f"joint_{k}": JointTransmissionSpec("rigid") for k in range(6)}
    held = replace(
        case,
        robot=on_springs(case.robot, springs(150.0, **rigid)),
        contact=ImpactContact("link_6", (1, 0, 0), normal_frame="contact"),
    )
    response = ElasticImpact(held).response(q, stiffness)
    assert response.compliance_ratio > 1e12


def test_numbers_are_proportional_to_the_speed() -> None:
    case, q, stiffness = case_of("mixed arm")
    slow, fast = (ElasticImpact(case).response(q, stiffness, speed) for speed in (0.5, 1.5))
    same = {"stiffness", "duration", "compliance_ratio", "value"}
    for field in fields(ElasticResponse):
        factor = 1 if field.name in same else 3
        assert_close(getattr(fast, field.name), factor * np.array(getattr(slow, field.name)), 1e-12, field.name)


def test_joints_without_a_spring() -> None:
    case, q, stiffness = case_of("mixed arm")
    response = ElasticImpact(case).response(q, stiffness)
    rigid, locked, soft = 1, 3, [0, 2, 4, 5, 6]
    assert (
        response.jump[locked]
        == response.rotor_jump[locked]
        == 0.0
        != response.jump[rigid]
        == response.rotor_jump[rigid]
    )
    assert response.torque[rigid] == response.peak_torque[locked] == 0.0
    assert (response.peak_torque[soft] > 0).all() and (response.rotor_jump[soft] != response.jump[soft]).all()


def test_armature_is_that_stated_whatever_the_joint_model() -> None:
    case, q, stiffness = case_of("panda")
    linked = replace(case, robot=with_joint_model(case.robot, "link"))
    assert ElasticImpact(linked).response(q, stiffness).value == ElasticImpact(case).response(q, stiffness).value


# ---- invalid input ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("stiffness", [0.0, -1e5, float("nan"), float("inf"), 1e30, 0.5])
def test_stiffness_out_of_range(stiffness: float) -> None:
    case, q, _ = case_of("arm")
    with pytest.raises(InputError, match=r"^contact_stiffness: is .* N/m; give 1 to 1e\+12 N/m$"):
        ElasticImpact(case).response(q, stiffness)


@pytest.mark.parametrize("speed", [0.0, -1.0, float("nan"), float("inf")])
def test_speed_out_of_range(speed: float) -> None:
    case, q, stiffness = case_of("arm")
    with pytest.raises(InputError, match=r"^approach speed: is .*; give m/s above zero"):
        ElasticImpact(case).response(q, stiffness, speed)


@pytest.mark.parametrize(
    "table", [TransmissionSpec(), TransmissionSpec("elastic"), TransmissionSpec("rigid", 1e4), springs(1e4)]
)
def test_no_rotor_on_a_spring(table: TransmissionSpec) -> None:
    case, _, _ = case_of("arm")
    model = pin.Model(case.robot.model)
    if table.kind == "elastic" and table.stiffness:
        model.armature = np.zeros(model.nv)
    loaded = on_springs(replace(case.robot, model=model), table)
    with pytest.raises(
        InputError, match=r"no joint of made up has a rotor on a spring.*\[transmission\].*\[armature\]"
    ):
        ElasticImpact(replace(case, robot=loaded))


def test_springs_too_stiff_for_a_soft_contact() -> None:
    case, q, _ = case_of("arm")
    stiff = replace(case, robot=on_springs(case.robot, springs(1e300)))
    with pytest.raises(InputError, match="joints are too stiff or too damped for a contact as soft as this one"):
        ElasticImpact(stiff).response(q, 1e5)


def test_contact_that_cannot_move() -> None:
    loaded = on_springs(arm([Y, Y], [0.4, 0.9], floating=False), springs(100.0))
    case = ImpactCase(loaded, ImpactContact(TIP, (0, 1, 0)))
    with pytest.raises(ContactError, match="cannot move along its normal"):
        ElasticImpact(case).response(loaded.posture(), 1e4)


def test_extreme_but_allowed_numbers_answer() -> None:
    """Extreme stiffness, damping and inertia give a finite result or an error in one line."""
    case, q, _ = case_of("arm")
    for inertia in (1e-14, 1e-9, 1e6, 1e18, 1e40):
        model = pin.Model(case.robot.model)
        model.armature = np.full(model.nv, inertia)
        heavy = replace(case, robot=replace(case.robot, model=model))
        try:
            assert np.isfinite(ElasticImpact(heavy).response(q, 1e5).peak_jump_norm)
        except ImpactPostureError as error:
            assert "\n" not in str(error)
    for K, D in ((1e-300, 0.0), (1e-3, 1e6), (1e9, 1e-9), (1e20, 0.0), (150.0, 1e300)):
        for stiffness in (1.0, 1e12):
            loaded = replace(case, robot=on_springs(case.robot, springs(K, D)))
            try:
                response = ElasticImpact(loaded).response(q, stiffness)
            except ImpactPostureError as error:
                assert "\n" not in str(error)
            else:
                assert np.isfinite(
                    [response.value, response.duration, response.peak_jump_norm, *response.peak_torque]
                ).all()
