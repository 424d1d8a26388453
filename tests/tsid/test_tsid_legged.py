"""Standing robots: friction cones, limits, and the tick solved over all variables (ν̇, f, τ) by another solver."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest

from impact_posture.errors import ContactError, InputError
from impact_posture.tsid.controller import Controller, Status
from impact_posture.tsid.point_kinematics import Point
from impact_posture.tsid.support_contact import SupportContact, point_cone, support_contacts, surface_cone, to_world
from impact_posture.tsid.task_formulation import legged_formulation
from impact_posture.tsid.tasks.joint_posture import JointPosture
from tests.support.helpers import rng, robot
from tests.support.pinocchio_values import frame_jacobian, mass_matrix
from tests.tsid.test_tsid_controller import DT, assert_dynamics, assert_limits, run

LEGGED = ("solo8", "talos", "solo12")


def controller_of(name: str, kp: float = 20.0, weight: float = 0.1, **more: float) -> Controller:
    r = robot(name)
    posture = JointPosture(r, kp=kp, weight=weight, base_weight=0.0)
    return Controller(r, legged_formulation(r, posture, kp=kp, **more))  # type: ignore[arg-type]


def displaced(name: str, amount: float) -> np.ndarray:
    """Return a posture near the nominal posture, within the joint limits."""
    r = robot(name)
    q = np.array(pin.integrate(r.model, r.posture(), amount * rng(name, "away").uniform(-1, 1, r.nv)))
    low, high = r.model.lowerPositionLimit[7:], r.model.upperPositionLimit[7:]
    q[7:] = np.clip(q[7:], low + 1e-3, high - 1e-3)
    return q


@pytest.mark.parametrize("name", LEGGED)
def test_feet_stay_where_they_are(name: str) -> None:
    # The posture task has a small weight, because it opposes the motion of the center of mass.
    controller = controller_of(name, kp=40.0, weight=1e-3)
    q, v = robot(name).posture(), np.zeros(robot(name).nv)
    controller.reset(q, v)
    com = controller.formulation.weighted[0]
    com.target = com.target + np.array([0.01, 0.005, -0.02])  # type: ignore[attr-defined]
    start = [controller.state.at(c.point).position.copy() for c in controller.formulation.contacts]
    contacts = controller.assembly.contacts
    for k, command, _, _ in run(controller, q, v, 800):
        assert command.status is Status.SOLVED
        assert (contacts.cone @ command.forces >= contacts.least - 1e-7).all()
        if k % 20 == 0:
            assert_dynamics(controller, command)
    # At rest, the contact forces of the feet equal the weight.
    normal = sum(float(command.forces[rows][2]) for rows in contacts.rows)
    assert normal == pytest.approx(9.81 * robot(name).mass, rel=0.1)
    reached = controller.state.center_of_mass()[0]
    for contact, place in zip(controller.formulation.contacts, start, strict=True):
        assert np.linalg.norm(controller.state.at(contact.point).position - place) < 1e-4
    # solo8 cannot move sideways on its feet, but all robots can move down.
    assert abs(reached[2] - com.target[2]) < 2e-3  # type: ignore[attr-defined]


def dense_torques(controller: Controller, q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Return the torques of the same tick over (ν̇, f, τ), from raw Pinocchio calls.

    Each sole is modeled by forces at its four corners.  The cost contains the total wrench of the corner forces, so
    the optimum equals the optimum of the controller. The solver is qpOASES of CasADi, as in the paper.
    """
    r, formulation = controller.robot, controller.formulation
    model, nv, nj = r.model, r.nv, r.nv - 6
    data = model.createData()
    M, h = mass_matrix(model, q), pin.rnea(model, data, q, v, np.zeros(nv))
    com, base = formulation.weighted
    posture = formulation.posture
    assert posture is not None
    pin.centerOfMass(model, data, q, v, np.zeros(nv))
    c, dc, bias = data.com[0].copy(), data.vcom[0].copy(), data.acom[0].copy()
    J_com = pin.jacobianCenterOfMass(model, data, q).copy()
    R = pin.Quaternion(q[3:7]).matrix()

    rows, wanted, weight = [], [], []

    def add(J: np.ndarray, acceleration: np.ndarray, w: float) -> None:
        rows.append(J)
        wanted.append(acceleration)
        weight.append(np.full(len(acceleration), w))

    add(J_com, com.kp * (com.target - c) - com.kd * dc - bias, 10.0)  # type: ignore[attr-defined]
    error = pin.log3(R.T @ base.target)  # type: ignore[attr-defined]
    add(np.eye(3, nv, 3), base.kp * error - base.kd * v[3:6], 1.0)
    away = pin.difference(model, q, posture.target)
    add(np.eye(nj, nv, 6), (posture.kp * away - posture.kd * v)[6:], 0.1)

    forces, wrenches, hard = [], [], []
    for contact, (position, rotation) in zip(formulation.contacts, controller.assembly.contacts._home, strict=True):
        index, offset = r.frame_id(contact.point.frame), np.array(contact.point.offset)
        J = frame_jacobian(model, q, index, offset)
        step = 1e-6
        ahead, behind = (
            frame_jacobian(model, np.array(pin.integrate(model, q, s * step * v)), index, offset) for s in (1, -1)
        )
        drift = (ahead - behind) @ v / (2 * step)
        pin.framesForwardKinematics(model, data, q)
        place = data.oMf[index].act(offset)
        e = np.concatenate([position - place, np.zeros(3)])
        turn = data.oMf[index].rotation
        e[3:] = turn @ pin.log3(turn.T @ rotation)
        a = contact.kp * e - contact.kd * J @ v - drift
        if contact.kind == "point":
            add(J[:3], a[:3], contact.weight or 0.0)
            forces.append(J[:3])
            wrenches.append(np.eye(3))
        else:
            hard.append((J, a))
            corners = []
            for x, y in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
                arm = turn @ np.array([x * contact.half[0], y * contact.half[1], 0])
                forces.append(J[:3] - pin.skew(arm) @ J[3:])
                corners.append(np.vstack([np.eye(3), pin.skew(arm)]))
            wrenches.append(np.hstack(corners))
    J_f = np.vstack(forces)
    nf = J_f.shape[0]
    n = nv + nf + nj
    A, w, b = np.vstack(rows), np.concatenate(weight), np.concatenate(wanted)
    H, g = np.zeros((n, n)), np.zeros(n)
    # The solver needs a positive definite H, so variables without a weight get a small weight.
    H[:nv, :nv], g[:nv] = A.T * w @ A + 1e-8 * np.eye(nv), -A.T * w @ b
    H[-nj:, -nj:] = 1e-13 * np.eye(nj)
    start = nv
    for W in wrenches:
        scale = 1e-6 * np.array([1.0, 1, 1, 100, 100, 100][: W.shape[0]])
        at = slice(start, start + W.shape[1])
        # Many corner forces have the same wrench, so a small weight selects one set of forces.
        H[at, at] = W.T * scale @ W + 1e-12 * np.eye(W.shape[1])
        start += W.shape[1]
    S = np.vstack([np.zeros((6, nj)), np.eye(nj)])
    equal = [np.hstack([M, -J_f.T, -S])]
    right = [-h]
    for J, a in hard:
        equal.append(np.hstack([J, np.zeros((6, nf + nj))]))
        right.append(a)
    mu = 0.7 / np.sqrt(2)
    cone = []
    for k in range(nf // 3):
        for row in ((-1, 0, mu), (1, 0, mu), (0, -1, mu), (0, 1, mu)):
            C = np.zeros(n)
            C[nv + 3 * k : nv + 3 * k + 3] = row
            cone.append(C)
    low = []
    start = nv
    for W in wrenches:
        C = np.zeros(n)
        C[start : start + W.shape[1]] = W[2]
        low.append(C)
        start += W.shape[1]
    limits = np.hstack([np.zeros((nj, nv + nf)), np.eye(nj)])
    effort = model.effortLimit[6:]
    G = np.vstack([-np.array(cone), -np.array(low), limits, -limits])
    top = np.concatenate([np.zeros(len(cone)), -np.ones(len(low)), effort, effort])
    A = np.vstack([*equal, G])
    shapes = {"h": ca.DM(H).sparsity(), "a": ca.DM(A).sparsity()}
    solver = ca.conic("s", "qpoases", shapes, {"printLevel": "none", "sparse": False})
    e = np.concatenate(right)
    answer = solver(h=H, g=g, a=A, lba=np.concatenate([e, np.full(len(top), -np.inf)]), uba=np.concatenate([e, top]))
    assert solver.stats()["success"]
    return np.array(answer["x"]).ravel()[-nj:]


@pytest.mark.parametrize("name", ["solo8", "talos"])
def test_torques_equal_a_dense_program_over_all_variables(name: str) -> None:
    r = robot(name)
    controller = controller_of(name)
    controller.reset(r.posture(), np.zeros(r.nv))
    for k, amount in enumerate((0.0, 0.01)):
        q, v = displaced(name, amount), 3 * amount * rng(name, k).normal(size=r.nv)
        command = controller.tick(k * DT, q, v)
        assert command.status is Status.SOLVED
        # The dense formulation omits joint limits, so no joint limit may be active in the compared ticks.
        assert not [name for name, _ in controller.report().active if name in r.tangent_names[6:]]
        difference = dense_torques(controller, q, v) - command.torque
        assert np.abs(difference).max() <= 1e-6 * np.abs(command.torque).max()


@pytest.mark.parametrize("name", ["quadprog", "proxqp"])
def test_other_solvers_agree_on_the_program_of_a_tick(name: str) -> None:
    pytest.importorskip("quadprog" if name == "quadprog" else "proxsuite")
    pytest.importorskip("qpsolvers")
    from tests.support.qpsolvers_solver import QpsolversSolver

    settings = {} if name == "quadprog" else {"eps_abs": 1e-10, "max_iter": 10000}
    other = QpsolversSolver(name, **settings)
    for robot_name in ("solo8", "talos"):
        controller = controller_of(robot_name)
        r = robot(robot_name)
        controller.reset(r.posture(), np.zeros(r.nv))
        command = controller.tick(0.0, displaced(robot_name, 0.01), 0.1 * rng(robot_name).normal(size=r.nv))
        solved = other.solve(controller.assembly.qp)
        assert solved is not None
        controls = controller.assembly.controls(controller.state, solved.z)
        assert np.abs(controls - command.u).max() <= 1e-5 * np.abs(command.u).max()


def test_a_solution_certifies_itself() -> None:
    """With and without whitening, a solution is feasible and stationary, and its multipliers have the right sign."""
    for name in ("solo8", "talos"):
        controller = controller_of(name)
        r = robot(name)
        controller.reset(r.posture(), np.zeros(r.nv))
        controller.tick(0.0, displaced(name, 0.05), rng(name).normal(size=r.nv))
        solved, qp = controller._outcome.solved, controller.assembly.qp
        assert solved is not None
        assert qp.violation(solved.z) <= 1e-8
        scale = np.abs(qp.g).max()
        gradient = qp.H @ solved.z + qp.g + solved.multipliers[: qp.n] + qp.A.T @ solved.multipliers[qp.n :]
        assert np.abs(gradient).max() <= 1e-8 * scale
        values = qp.values(solved.z)
        inside = (values < qp.upper - 1e-6) & (values > qp.lower + 1e-6)
        assert np.abs(solved.multipliers[inside]).max() <= 1e-9 * scale


def test_the_wrench_cone_of_a_sole_contains_exactly_the_corner_forces() -> None:
    """Caron's closed form agrees with linear programs: a wrench is inside if and only if corner forces produce it."""
    from scipy.optimize import linprog

    half, friction = (0.1, 0.06), 0.7
    cone, pyramid = surface_cone(friction, *half), point_cone(friction)
    G = []
    for x, y in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
        arm = np.array([x * half[0], y * half[1], 0])
        G.append(np.vstack([np.eye(3), pin.skew(arm)]))
    corners = np.hstack(G)
    generator = rng("cone")
    inside = 0
    for _ in range(150):
        wrench = generator.normal(size=6) * np.array([0.3, 0.3, 0, 0.04, 0.06, 0.04]) + np.array([0, 0, 1.0, 0, 0, 0])
        blocks = np.kron(np.eye(4), -pyramid)
        answer = linprog(np.zeros(12), blocks, np.zeros(20), corners, wrench, bounds=(None, None))
        by_rows = bool((cone @ wrench >= 0).all())
        assert by_rows == (answer.status == 0)
        inside += by_rows
    assert 30 < inside < 120


def test_a_cone_turns_with_its_ground() -> None:
    normal = np.array([0.6, 0.0, 0.8])
    cone = to_world(point_cone(0.5), normal, np.array([1.0, 0, 0]))
    assert (cone @ normal > 0).all()
    assert not (cone @ np.array([1.0, 0, 0]) >= 0).all()
    with pytest.raises(ContactError):
        to_world(surface_cone(0.5, 0.1, 0.1), normal, normal)


def test_slippery_ground_binds_the_cone() -> None:
    controller = controller_of("talos", friction=0.05)
    r = robot("talos")
    controller.reset(r.posture(), np.zeros(r.nv))
    com = controller.formulation.weighted[0]
    com.target = com.target + np.array([0.0, 0.2, 0.0])  # type: ignore[attr-defined]
    command = controller.tick(0.0, r.posture(), np.zeros(r.nv))
    contacts = controller.assembly.contacts
    assert command.status is Status.SOLVED
    assert any(name.startswith("cone of") for name, _ in controller.report().active)
    assert (contacts.cone @ command.forces >= contacts.least - 1e-7).all()
    for rows in contacts.rows:
        f = command.forces[rows]
        assert np.hypot(f[0], f[1]) <= 0.05 * f[2] + 1e-6


def test_feet_too_fast_for_the_motors_relax_the_contacts() -> None:
    """At 30 m/s upwards, the legs lack the torque to keep the feet on the ground, so the contacts are relaxed."""
    controller = controller_of("talos")
    r = robot("talos")
    controller.reset(r.posture(), np.zeros(r.nv))
    v = np.zeros(r.nv)
    v[2] = 30.0
    command = controller.tick(0.0, r.posture(), v)
    contacts = controller.assembly.contacts
    assert command.status is Status.RELAXED
    assert [x.level for x in controller.report().relaxed] == ["contacts"]
    assert (contacts.cone @ command.forces >= contacts.least - 1e-6).all()
    assert_limits(controller, command)
    assert controller.report().dynamics <= 1e-8


@pytest.mark.parametrize(
    "wrong",
    [
        lambda: SupportContact(Point("left_sole_link"), friction=0.0),
        lambda: SupportContact(Point("left_sole_link"), "surface"),
        lambda: SupportContact(Point("left_sole_link"), normal=(0, 0, 2)),
        lambda: SupportContact(Point("left_sole_link"), weight=-1.0),
        lambda: legged_formulation(robot("panda"), JointPosture(robot("panda"))),
    ],
)
def test_invalid_contacts_are_refused(wrong: object) -> None:
    with pytest.raises((ContactError, InputError)):
        wrong()  # type: ignore[operator]


def test_supports_of_the_robots_become_contacts() -> None:
    feet = support_contacts(robot("solo8"))
    assert [c.point.frame for c in feet] == ["FL_FOOT", "FR_FOOT", "HL_FOOT", "HR_FOOT"]
    assert all(c.kind == "point" and c.weight for c in feet)
    soles = support_contacts(robot("talos"))
    assert all(c.kind == "surface" and c.weight is None and c.half == (0.1, 0.06) for c in soles)
