"""Forces that hold a posture, compared with independent statics and linear programs, and in optimized postures."""

from __future__ import annotations

import functools
import re
from dataclasses import replace

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog

from impact_posture.config.problem_settings import FRICTION
from impact_posture.dynamics.chart import Chart
from impact_posture.dynamics.mjcf import build_mjcf
from impact_posture.dynamics.numeric import Numeric
from impact_posture.dynamics.tree import Tree
from impact_posture.errors import InputError
from impact_posture.posture.formulation.problem_file import prepare
from impact_posture.posture.loads.equilibrium import Equilibrium, Thrusts
from impact_posture.posture.loads.holdable import Holdable, ReachableWrench
from impact_posture.posture.loads.load_cases import LoadCase, LoadCases, load_cases
from impact_posture.posture.manifold.feasible_start import feasible_start, random_posture
from impact_posture.posture.program.constrained_problem import ConstrainedProblem
from impact_posture.posture.program.posture_nlp import build_nlp
from impact_posture.posture.search.conflicts import find_conflicts
from impact_posture.posture.search.growing_search import run_start
from impact_posture.posture.search.multistart import solve
from impact_posture.robot.actuation import allocation_matrix, hover, torque_limits
from tests.support.constraints import check_lifted_rows
from tests.support.helpers import Vector, assert_close, rng
from tests.support.pinocchio_values import central_gradient, frame_jacobian
from tests.support.settings import make_settings

SIZE = st.integers(0, 2**32 - 1)
ROBOTS = ("tilthex_arm", "hextilt", "borinot", "talos", "solo12", "panda", "ur5", "tiago")
PUSHED = {name: {"hold_force": 2.0} for name in ("tilthex_arm", "talos", "panda")}


@functools.cache
def problem(name: str, **more: object) -> ConstrainedProblem:
    """Return the problem without collision constraints, which have separate tests."""
    values = {"robot": name, "normal": (0.3, -0.2, 1.0), "holdable": True, **more}
    return prepare(make_settings(values)).problem


@functools.cache
def cases(name: str, **more: object) -> tuple[LoadCase, ...]:
    posed = problem(name, **more)
    return load_cases(posed.objective, posed.given, posed.requirements).cases


def posture(posed: ConstrainedProblem, seed: int, *, near: bool = True) -> Vector:
    return random_posture(posed, Chart(posed.robot.model), np.random.default_rng(seed), posed.given if near else None)


def statics(posed: ConstrainedProblem, case: LoadCase, q: Vector, z: Vector) -> Vector:
    """Return ``h(q) − Σ Jᵀ f``, with Pinocchio's Jacobians of frames instead of links, and the rotor allocation."""
    model, contact = posed.robot.model, posed.impact.contact
    tau = np.array(pin.computeGeneralizedGravity(model, model.createData(), q))
    for source, own in zip(case.equilibrium.load.sources, case.equilibrium.load.split(z), strict=True):
        if source.in_frame and own.size:
            tau[:6] -= allocation_matrix(model, posed.robot.spec.propulsion) @ own * case.equilibrium.weight
        elif own.size:
            support = next(s for s in posed.objective.supports if s.frame == source.names[0])
            index = model.getFrameId(support.frame)
            # Point where the force acts, in the frame of the foot.
            offset = model.frames[index].placement.actInv(source.point.position)
            assert np.abs(offset - support.offset)[:2] == pytest.approx(support.size if support.has_sole else (0, 0))
            tau -= frame_jacobian(model, q, index, offset)[:3].T @ (source.columns @ own)[:3]
        else:
            index = model.getFrameId(contact.frame)
            force = np.array(contact.normal) * posed.requirements.hold_force
            tau -= frame_jacobian(model, q, index, contact.offset)[:3].T @ force
    return tau


@pytest.mark.parametrize("name", ROBOTS)
@given(seed=SIZE)
@settings(max_examples=3)
def test_torques_agree_with_statics_the_expression_and_differences(name: str, seed: int) -> None:
    """The reference computes gravity and forces with other Pinocchio algorithms than the code under test."""
    posed, generator = problem(name, **PUSHED.get(name, {})), np.random.default_rng(seed)
    case = cases(name, **PUSHED.get(name, {}))[-1]
    load, model, q = case.equilibrium.load, posed.robot.model, posture(posed, seed)
    z = generator.uniform(0, 1, load.count)
    linear_torque = load.torque(q, z)
    assert_close(linear_torque.value, statics(posed, case, q, z), 1e-10, "torque")
    chart = Chart(model)
    x, symbol = ca.SX.sym("x", chart.nx), ca.SX.sym("z", load.count)
    tree = Tree(model, chart.configuration(x), x)
    expression = ca.Function("tau", [x, symbol], [load.symbolic(tree, symbol)])
    assert_close(np.array(expression(chart.to_x(q), z)).ravel(), linear_torque.value, 1e-10, "expression")
    numeric = central_gradient(lambda p: load.torque(p, z).value, model, q, 1e-3)
    assert_close(linear_torque.by_posture, numeric, 1e-8, "by posture")
    step = generator.normal(size=load.count)
    assert_close(
        linear_torque.by_force @ step, load.torque(q, z + step).value - linear_torque.value, 1e-9, "by force", 1e-9
    )


@pytest.mark.parametrize("name", ["talos", "solo12"])
def test_mujoco_stands_still_under_the_torques_and_forces(name: str) -> None:
    mujoco = pytest.importorskip("mujoco", reason="mujoco is not installed (the extra 'sim')")
    posed, (case,) = problem(name), cases(name)
    rest, model, q = case.equilibrium, posed.robot.model, posed.given
    z = rest.distribute(q).forces
    tau = rest.load.torque(q, z).value
    assert np.abs(tau[:6]).max() < 1e-7 * rest.weight
    written = build_mjcf(model)
    compiled = written.compile()
    compiled.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    data = mujoco.MjData(compiled)
    data.qpos[:] = written.layout.qpos(q)
    mujoco.mj_forward(compiled, data)
    falling = np.abs(data.qacc).max()
    data.qfrc_applied[:] = written.layout.velocity_map(q) @ np.concatenate([np.zeros(6), tau[6:]])
    kinematics = Numeric(model).at(q)
    for source, own in zip(rest.load.sources, rest.load.split(z), strict=True):
        body = compiled.body(written.bodies[source.point.joint]).id
        at, wrench = kinematics.placement(source.point).translation, source.columns @ own
        mujoco.mj_applyFT(compiled, data, wrench[:3], wrench[3:], at, body, data.qfrc_applied)
    mujoco.mj_forward(compiled, data)
    assert falling > 5
    assert np.abs(data.qacc).max() < 1e-5 * falling


# ---- the linear program -----------------------------------------------------------------------------------------


def least_share(posed: ConstrainedProblem, q: Vector) -> float:
    """Return the least share of the limits, by a linear program over corner forces and thrusts; NaN if unbalanced."""
    model, spec = posed.robot.model, posed.robot.spec
    blocks, cones = [], []
    for support in posed.objective.supports:
        index = model.getFrameId(support.frame)
        for x in (-1, 1) if support.has_sole else (0,):
            for y in (-1, 1) if support.has_sole else (0,):
                corner = np.array(support.offset) + np.array([x * support.size[0], y * support.size[1], 0])
                blocks.append(frame_jacobian(model, q, index, corner)[:3].T)
                cones.append(np.array([[a, b, -FRICTION] for a in (-1, 1) for b in (-1, 1)]))
    h, limits = np.array(pin.computeGeneralizedGravity(model, model.createData(), q)), torque_limits(model)
    rotors = np.zeros((model.nv, 0))
    if spec.propulsion is not None:
        rotors = np.vstack([allocation_matrix(model, spec.propulsion), np.zeros((model.nv - 6, 6))])
    B = np.hstack([np.zeros((model.nv, 0)), *blocks, rotors])
    feet, base = 3 * len(blocks), posed.robot.first_joint
    rows, right = [], []
    for k in np.flatnonzero(np.isfinite(limits)):
        for sign in (1, -1):
            rows.append(np.append(-sign * B[k], -limits[k]))
            right.append(-sign * h[k])
    for k, cone in enumerate(cones):
        for face in cone:
            rows.append(np.zeros(B.shape[1] + 1))
            rows[-1][3 * k : 3 * k + 3] = face
            right.append(0.0)
    for k in range(rotors.shape[1]):
        c, low, high = spec.propulsion.thrust_coefficient, spec.propulsion.speed_min, spec.propulsion.speed_max
        low, high = c * low**2, c * high**2
        for sign in (1, -1):
            rows.append(np.zeros(B.shape[1] + 1))
            rows[-1][feet + k], rows[-1][-1] = sign, -(high - low) / 2
            right.append(sign * (high + low) / 2)
    balance = np.column_stack([B[:base], np.zeros(base)]) if base else None
    cost = np.append(np.zeros(B.shape[1]), 1.0)
    optimum = linprog(cost, rows, right, balance, h[:base] if base else None, bounds=(None, None), method="highs-ipm")
    return float(optimum.fun) if optimum.status == 0 else float("nan")


@pytest.mark.parametrize("name", ROBOTS)
@given(seed=SIZE)
@settings(max_examples=4)
def test_least_largest_share_agrees_with_another_program(name: str, seed: int) -> None:
    """Both programs detect loss of balance at random postures of legged robots; lateral rotor forces are excluded."""
    posed, (case,) = problem(name), cases(name)
    q = posture(posed, seed) if name != "borinot" else posed.given
    distribution = case.equilibrium.distribute(q)
    expected = least_share(posed, q)
    assert (distribution.unbalanced == 0) == np.isfinite(expected)
    if distribution.unbalanced == 0:
        assert distribution.largest == pytest.approx(expected, rel=1e-6)
        assert (distribution.forces[~np.isfinite(case.equilibrium.load.upper)] >= -1e-9).all()
        if posed.objective.supports:
            base = statics(posed, case, q, distribution.forces)[:6]
            assert np.abs(base).max(initial=0.0) < 1e-7 * case.equilibrium.weight


def test_thrusts_agree_with_hover() -> None:
    for name in ("tilthex_arm", "hextilt", "borinot"):
        posed, (case,) = problem(name), cases(name)
        expected = hover(posed.robot.model, posed.robot.spec.propulsion, posed.given)
        rest = case.equilibrium
        shares = dict(zip(rest.actuators, rest.distribute(posed.given).shares, strict=True))
        spans = dict(zip(rest.actuators, zip(rest.lower, rest.upper, strict=True), strict=True))
        # Six rotors in one plane can share the load in many ways, but the most loaded rotor is always the same.
        thrusts = [a + (b - a) * (1 + shares[k]) / 2 for k, (a, b) in spans.items() if k.startswith("rotor")]
        assert min(thrusts) == pytest.approx(min(expected.thrusts), abs=1e-6)
        if name != "borinot":
            assert thrusts == pytest.approx(expected.thrusts)


@pytest.mark.parametrize("name", ["tilthex_arm", "borinot", "talos", "solo12", "panda"])
@given(seed=SIZE)
@settings(max_examples=3)
def test_reduced_form_has_the_gradient_of_its_largest_row(name: str, seed: int) -> None:
    posed = problem(name)
    constraint = Holdable("at rest", cases(name)[0].equilibrium, "")
    numeric = Numeric(posed.robot.model)

    def largest(q: Vector) -> float:
        value = constraint.evaluate(numeric.at(q))[0]
        return float(value[0] or value[1:].max())

    q = posture(posed, seed)
    value, jacobian = constraint.evaluate(numeric.at(q))
    top = largest(q)
    slope = rng(seed).normal(size=posed.robot.nv)
    ahead, behind = (largest(pin.integrate(posed.robot.model, q, step * slope)) for step in (1e-6, -1e-6))
    # The largest share has a kink where another actuator becomes the most loaded.  The one-sided slopes differ at the
    # kink.
    sides = [(ahead - top) / 1e-6, (top - behind) / 1e-6]
    above = value == value[0] if value[0] else value > top - 1e-9
    if sides[0] == pytest.approx(sides[1], rel=1e-3, abs=1e-3):
        for row in np.flatnonzero(above[1:]) + 1 if not value[0] else (0,):
            assert jacobian[row] @ slope == pytest.approx(np.mean(sides), rel=2e-3, abs=2e-3)
    if cases(name)[0].equilibrium.load.count:
        assert not jacobian[1:][value[1:] < top - 1e-6].any()


@pytest.mark.parametrize("name", ["tilthex_arm", "borinot", "talos", "solo12", "ur5"])
def test_lifted_rows_agree_with_pinocchio_and_with_differences(name: str) -> None:
    posed, q = problem(name), posture(problem(name), 5)
    for case in cases(name, **PUSHED.get(name, {})):
        holdable = Holdable(case.name, case.equilibrium, "", active=True)
        for constraint in (holdable, *(c for c in case.constraints() if isinstance(c, ReachableWrench))):
            z = rng(name).uniform(0, 1, constraint.unknowns)
            check_lifted_rows(constraint, posed.robot.model, q, z)


# ---- solutions --------------------------------------------------------------------------------------------------


def test_an_optimum_beyond_the_limits_moves_to_them_and_certifies() -> None:
    """The run from the given start ends beyond the torque limits of the legs, so the program needs more rows."""
    posed = problem("anymal_kinova", normal=(1.0, 0.0, 0.0))
    begin, scale = feasible_start(posed, 1, seed=0), posed.objective.value(posed.given)
    assert begin is not None
    first, refused = run_start(build_nlp(posed, compile="never"), begin, scale)
    assert first.converged and not refused.holds() and refused.primal > 0.1
    grown = posed.grown([first.q])
    assert grown is not posed and grown.grown([first.q]) is grown
    last, certificate = run_start(build_nlp(grown, compile="never"), begin, scale)
    assert certificate.holds()
    (case,) = cases("anymal_kinova", normal=(1.0, 0.0, 0.0))
    assert case.equilibrium.distribute(first.q).largest > 1.1
    after = case.equilibrium.distribute(last.q)
    assert after.largest == pytest.approx(1, abs=1e-6) and after.unbalanced == 0
    assert "torque of LF_HFE at rest" in [active.constraint for active in certificate.active]
    assert posed.objective.value(last.q) > posed.objective.value(first.q)


def test_a_program_without_the_rows_is_certified_by_the_best_forces() -> None:
    """Far within the limits, the program has no rows; beyond the limits, the rows show the violation."""
    (case,) = cases("solo12")
    posed, q = problem("solo12"), problem("solo12").given
    constraint, numeric = Holdable("at rest", case.equilibrium, ""), Numeric(problem("solo12").robot.model)
    assert constraint.grown(numeric.at(q)) is constraint
    assert not constraint.linearize(numeric.at(q), np.zeros(0)).names
    # Pitch the base so far that the center of mass is outside the polygon of the feet.
    leaning = pin.integrate(posed.robot.model, q, np.eye(posed.robot.nv)[4] * 0.9)
    linearized = constraint.linearize(numeric.at(leaning), np.zeros(0))
    outside = np.maximum(linearized.lower - linearized.value, linearized.value - linearized.upper)
    missing = constraint.evaluate(numeric)[0][0]
    assert missing > 0.01
    assert np.abs(outside[: case.equilibrium.balanced]).sum() == pytest.approx(missing)
    assert constraint.grown(numeric).active


@pytest.mark.parametrize("name", ["tilthex_arm", "borinot", "solo12", "tiago"])
def test_every_start_certifies_and_holds(name: str) -> None:
    posed = problem(name, normal=(1.0, 0.0, 0.0))
    solution = solve(posed, starts=4, jobs=1)
    assert solution.certified_starts == 4
    holding_forces = load_cases(posed.objective, solution.q, posed.requirements).holding(solution.q)
    assert holding_forces is not None and holding_forces.feasible and not holding_forces.violations()


def test_a_tight_limit_is_kept_and_has_a_multiplier() -> None:
    """A torque limit below the demand of the free optimum worsens the objective; the certificate names the joint."""
    posed = problem("panda", normal=(1.0, 0.0, 0.0))
    (case,) = cases("panda", normal=(1.0, 0.0, 0.0))
    best = solve(posed, starts=1, jobs=1)
    torques = [case.equilibrium.load.torque(q, np.zeros(0)).value for q in (best.initial, best.q)]
    tight = int((np.abs(torques[1]) - np.abs(torques[0])).argmax())
    limits = torque_limits(posed.robot.model)
    limits[tight] = np.abs([torque[tight] for torque in torques]).mean()
    nothing = np.zeros((0, 6))
    model, coupling, names = posed.robot.model, posed.robot.coupling_matrix, posed.robot.tangent_names
    rest = Equilibrium(model, [], 1.0, limits, coupling, nothing, Thrusts(), names)
    tighter = Holdable("at rest", rest, "")
    solution = solve(replace(posed, constraints=(*posed.constraints[:-1], tighter)), starts=1, jobs=1)
    assert rest.distribute(solution.q).largest == pytest.approx(1, abs=1e-6)
    assert rest.distribute(best.q).largest > 1.1
    assert solution.reduction < best.reduction
    names = [active.constraint for active in solution.certificate.active]
    assert f"torque of {posed.robot.tangent_names[tight]} at rest" in names


@pytest.mark.usefixtures("few_tries")
@pytest.mark.parametrize(
    ("name", "normal", "force", "named", "size"),
    [
        ("ur5", (0.0, 0.0, 1.0), 3000.0, "torque of shoulder_lift_joint", r"needs [\d.]+ N·m, limit 150 N·m"),
        ("tilthex_arm", (0.0, 0.0, 1.0), 60.0, "thrust of rotor_1", r"[\d.]+ N outside 0.2534 to 9.9 N"),
        (
            "borinot",
            (1.0, 0.0, 0.0),
            3.0,
            "force on the base that the rotors cannot exert",
            r"off by [\d.]+ of the weight",
        ),
        ("solo12", (0.0, 0.0, 1.0), 500.0, "balance of the base", r"off by [\d.]+ of the weight"),
    ],
)
def test_a_force_beyond_the_robot_is_infeasible_and_names_the_limit(
    name: str, normal: tuple[float, float, float], force: float, named: str, size: str
) -> None:
    posed = problem(name, normal=normal, hold_force=force)
    least = find_conflicts(posed)
    key = f"{named} while it pushes with {force:g} N"
    assert re.fullmatch(size, least.sizes[key])
    if name == "ur5":
        data = posed.robot.model.createData()
        gravity = pin.computeGeneralizedGravity(posed.robot.model, data, least.q)
        jacobian = frame_jacobian(posed.robot.model, least.q, posed.robot.frame_id("tool0"))
        torque = abs(gravity - force * jacobian[2])[1]
        assert float(least.sizes[key].split()[1]) == pytest.approx(torque, rel=1e-3)


# ---- load cases -------------------------------------------------------------------------------------------------


def cases_of(name: str, **more: object) -> LoadCases:
    posed = problem(name, holdable=False, **more)
    return load_cases(posed.objective, posed.given, posed.requirements)


def test_data_that_say_nothing_leave_the_robot_alone() -> None:
    assert "feet with friction" in cases_of("bolt").notes[0]
    assert not cases_of("bolt").cases and cases_of("bolt").holding(problem("bolt").given) is None
    floating = cases_of("talos", support=(), base="free")
    assert "neither rotors nor feet" in floating.notes[0]
    posed = problem("talos", holdable=False, support=(), base="free")
    with pytest.raises(InputError, match="neither rotors nor feet"):
        load_cases(posed.objective, posed.given, replace(posed.requirements, hold_force=1.0))


def test_limits_of_sliding_joints_are_in_newtons() -> None:
    rest = cases_of("tiago").cases[0].equilibrium
    units = dict(zip(rest.actuators, rest.units, strict=True))
    assert units["torso_lift_joint"] == "N" and units["arm_1_joint"] == "N·m"
    assert set(cases_of("tilthex_arm").cases[0].equilibrium.units) == {"N", "N·m"}


def test_a_payload_and_a_force_make_cases_of_their_own() -> None:
    more = {"payload": (("ee", 0.4),), "hold_force": 2.0}
    every = cases("tilthex_arm", **more)
    assert len(every) == 4
    q = problem("tilthex_arm").given
    rest = {case.name: case.equilibrium.load.torque(q, np.zeros(0)).value for case in every}
    weights = {name: tau[:3] @ pin.Quaternion(q[3:7]).matrix().T[:, 2] for name, tau in rest.items()}
    (empty, pushing, loaded, both) = weights.values()
    assert loaded - empty == pytest.approx(0.4 * 9.81, rel=1e-6)
    assert pushing < empty and both - loaded == pytest.approx(pushing - empty)
    assert [name.split(" (")[0] for name in weights] == ["at rest", "while it pushes with 2 N"] * 2
    names = [c.name for c in problem("tilthex_arm", **more).constraints if isinstance(c, Holdable)]
    assert len(set(names)) == 4


def test_limits_without_a_meaning_are_no_data() -> None:
    model = problem("panda").robot.model.copy()
    limits = np.array(model.effortLimit)
    limits[:3] = 0.0, np.inf, -1.0
    model.effortLimit = limits
    model.armature = np.where(np.arange(model.nv) == 3, np.inf, model.armature)
    assert np.isinf(torque_limits(model)[:4]).all()
    assert torque_limits(model)[4:] == pytest.approx(limits[4:])
    assert np.isinf(torque_limits(problem("talos").robot.model)[:6]).all()


def test_rotors_in_one_plane_keep_the_base_level() -> None:
    (case,) = cases("borinot")
    (reachable,) = [c for c in case.constraints() if isinstance(c, ReachableWrench)]
    posed = problem("borinot")
    numeric = Numeric(posed.robot.model)
    assert np.abs(reachable.evaluate(numeric.at(posed.given))[0]).max() < 1e-12
    tilted = pin.integrate(posed.robot.model, posed.given, np.eye(posed.robot.nv)[4] * 0.2)
    assert np.linalg.norm(reachable.evaluate(numeric.at(tilted))[0]) == pytest.approx(np.sin(0.2))
    jacobian = reachable.evaluate(numeric.at(tilted))[1]
    slopes = central_gradient(lambda q: reachable.evaluate(numeric.at(q))[0], posed.robot.model, tilted, 1e-3)
    assert_close(jacobian, slopes, 1e-9, "side force")
