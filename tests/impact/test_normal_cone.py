"""The worst case over a cone of normals: compared with samples and two other methods, at ties, and in searches."""

from __future__ import annotations

import json
from pathlib import Path

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest
import scipy.optimize
from hypothesis import given
from hypothesis import strategies as st

from impact_posture.codegen.export import export
from impact_posture.config.problem_settings import ObjectiveKind
from impact_posture.errors import InputError, MetricError
from impact_posture.impact.evaluation.evaluation import evaluate
from impact_posture.impact.impact_contact import ImpactContact
from impact_posture.impact.metric import Metric
from impact_posture.impact.worst_case.normal_cone import NormalCone
from impact_posture.impact.worst_case.worst_normal import cone_axes, worst_normal
from impact_posture.impact.worst_case.worst_normal_symbolic import worst_normal_symbolic
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.posture.constraints.requirements import Requirements
from impact_posture.posture.formulation.build_problem import build_problem
from impact_posture.posture.formulation.problem_file import prepare, read_settings
from impact_posture.posture.program.posture_nlp import build_nlp
from impact_posture.posture.search.growing_search import run_start
from impact_posture.posture.search.multistart import solve
from impact_posture.robot.robot_loader import load_robot
from tests.support.command import run, succeed
from tests.support.helpers import assert_close, random_configurations, relative, rng, robot, uncoupled, unit
from tests.support.pinocchio_values import central_gradient, frame_jacobian, mass_matrix
from tests.support.settings import make_settings
from tests.support.tools import need_compiler

ANGLES = (1.0, 5.0, 20.0, 45.0, 80.0)
ROBOTS = {"tilthex_arm": "ee", "panda": "panda_hand_tcp", "solo8": "base_link", "talos": "gripper_right_base_link"}
CONE_KINDS: tuple[ObjectiveKind, ...] = ("impulse", "sticking", "energy")


def cone_of(objective: WorstCaseObjective) -> NormalCone:
    assert objective.normal_cone is not None
    return objective.normal_cone


def cone_samples(axis: np.ndarray, degrees: float, count: int = 100_000) -> np.ndarray:
    """Return unit vectors in a cone, a third of them on its edge, the others evenly inside, shape (count, 3)."""
    edge = count // 3
    k = np.arange(count - edge) + 0.5
    height = np.concatenate([np.full(edge, np.cos(np.deg2rad(degrees))), np.ones(count - edge)])
    height[edge:] -= (1 - height[0]) * k / len(k)
    turn = np.concatenate([2 * np.pi * np.arange(edge) / edge, np.pi * (3 - np.sqrt(5)) * k])
    radius = np.sqrt(1 - height**2)
    local = np.stack([height, radius * np.cos(turn), radius * np.sin(turn)])
    # Compute the axes of the cone independently of the code under test.
    side = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    side /= np.linalg.norm(side)
    return np.asarray((np.stack([axis, side, np.cross(axis, side)], axis=1) @ local).T)


def along(form: np.ndarray, normals: np.ndarray) -> np.ndarray:
    return np.asarray(np.einsum("ki,ij,kj->k", normals, form, normals))


def pinocchio_form(name: str, frame: str, q: np.ndarray, kind: ObjectiveKind) -> np.ndarray:
    """Return the matrix of the objective's quadratic form by dense algebra: Λ_c, B⁻¹Λ_cB⁻¹ or B = JM⁻¹Jᵀ."""
    model = uncoupled(name).model
    J = frame_jacobian(model, q, uncoupled(name).frame_id(frame))[:3]
    A = np.linalg.solve(mass_matrix(model, q), J.T)
    if kind == "energy":
        return np.asarray(J @ A)
    stuck = A @ np.linalg.inv(J @ A) if kind == "sticking" else A
    return np.asarray(stuck.T @ stuck)


# ---- comparison with samples --------------------------------------------------------------------------------------


@pytest.mark.long(
    but=("tilthex_arm-1.0", "tilthex_arm-80.0", "panda-20.0", "solo8-5.0", "solo8-80.0", "talos-1.0", "talos-45.0")
)
@pytest.mark.parametrize("degrees", ANGLES)
@pytest.mark.parametrize("name", ROBOTS)
def test_the_value_bounds_a_hundred_thousand_normals_closely(name: str, degrees: float) -> None:
    for index, q in enumerate(random_configurations(uncoupled(name).model, 3, name, degrees, spread=0.5)):
        axis = unit(rng(name, degrees, index))
        normals = cone_samples(axis, degrees)
        for kind in CONE_KINDS:
            form = pinocchio_form(name, ROBOTS[name], q, kind)
            sampled = along(form, normals)
            worst = 1 / (2 * sampled.min()) if kind == "energy" else 9 * sampled.max()
            worst /= 9 if kind == "sticking" else 1
            contact = ImpactContact(ROBOTS[name], tuple(axis), impulse=3.0)
            value = WorstCaseObjective(uncoupled(name), contact, kind=kind, normal_cone_deg=degrees).value(q)
            assert value >= worst * (1 - 1e-11), (name, kind, degrees)
            assert value <= worst * (1 + 1e-4), (name, kind, degrees)


def test_no_cone_is_the_plain_problem() -> None:
    contact = ImpactContact("ee", (0.2, -0.5, 1.0), impulse=2.0)
    plain = WorstCaseObjective(robot("tilthex_arm"), contact)
    none = WorstCaseObjective(robot("tilthex_arm"), contact, normal_cone_deg=0.0)
    (q,) = random_configurations(plain.robot.model, 1, "plain")
    assert plain == none and none.attempts == 1
    assert none.value(q) == 4 * none.oracle.quantities(q).H
    assert np.array_equal(none.gradient(q), 4 * none.oracle.gradient_H(q))
    assert none.gradient_fun().n_instructions() == plain.gradient_fun().n_instructions()
    evaluation = evaluate(none, q)
    assert (
        evaluation.cone is None
        and "cone" not in evaluation.to_dict()
        and np.array_equal(evaluation.worst_normal, evaluation.normal)
    )
    # As the cone angle vanishes, the value converges to the value for a single normal.
    narrow = WorstCaseObjective(robot("tilthex_arm"), contact, normal_cone_deg=1e-3)
    assert 1 < narrow.value(q) / none.value(q) < 1 + 1e-3


# ---- random matrices, with ties -----------------------------------------------------------------------------------

SYMBOLIC = {}


def symbolic(degrees: float) -> ca.Function:
    if degrees not in SYMBOLIC:
        A, n = ca.SX.sym("A", 3, 3), ca.SX.sym("n", 3)
        SYMBOLIC[degrees] = ca.Function("worst", [A, n], [worst_normal_symbolic(A, n, degrees)])
    return SYMBOLIC[degrees]


EIGENVALUES = st.sampled_from(
    [
        (1, 1, 1),
        (1, 1, 0.3),
        (1, 0.3, 0.3),
        (1, 0, 0),
        (1, 1 - 1e-9, 0.2),
        (1, 1 - 1e-5, 1 - 2e-5),
        (3, 2, 1),
        (0, 0, 0),
    ]
)
DIRECTION = st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: np.linalg.norm(v) > 1e-3)


@given(EIGENVALUES, DIRECTION, DIRECTION, st.sampled_from(["free", "eigenvector", "plane"]), st.sampled_from(ANGLES))
def test_every_matrix(values: tuple, one: tuple, other: tuple, place: str, degrees: float) -> None:
    vectors = cone_axes(np.array(one) / np.linalg.norm(one))
    A = (vectors * np.array(values, dtype=float)) @ vectors.T
    axis = np.array(other) / np.linalg.norm(other)
    if place == "eigenvector":
        axis = vectors[:, 2]
    elif place == "plane":
        axis = np.cos(other[0]) * vectors[:, 0] + np.sin(other[0]) * vectors[:, 1]
    size = max(np.abs(A).max(), 1e-30)
    worst = worst_normal(A, axis, degrees)
    cosine = np.cos(np.deg2rad(degrees))
    assert along(A, cone_samples(axis, degrees, 3000)).max() <= worst.value + 1e-12 * size
    assert worst.bound - worst.value <= 1e-8 * size, "the dual proves the value"
    for n in worst.normals:
        assert abs(np.linalg.norm(n) - 1) < 1e-12 and n @ axis >= cosine - 1e-12
        assert worst.value - n @ A @ n <= 1e-6 * size
    n = np.array(symbolic(degrees)(A, axis)).ravel()
    assert abs(np.linalg.norm(n) - 1) < 1e-12 and n @ axis >= cosine - 1e-12
    assert abs(n @ A @ n - worst.value) <= 1e-12 * size, "the closed form gives the same maximum"
    if not worst.tied and values == (3, 2, 1):
        assert np.linalg.norm(n - worst.normal) < 1e-9


def test_ties_are_flagged() -> None:
    z = np.eye(3)[2]
    mirror = worst_normal(np.diag([4.0, 2.0, 1.0]), z, 30.0)
    assert mirror.tied and len(mirror.normals) == 2 and mirror.angle_deg == pytest.approx(30)
    assert np.allclose(mirror.normals[0], mirror.normals[1] * [-1, 1, 1])
    assert worst_normal(np.diag([1.0, 2.0, 4.0]), z, 30.0).tied is False
    assert worst_normal(np.diag([4.0, 4.0, 1.0]), z, 30.0).tied, "a circle"
    assert worst_normal(np.eye(3), z, 30.0).tied, "a cap"
    arc = worst_normal(np.diag([4.0, 1.0, 4.0]), z, 30.0)
    assert arc.tied and arc.value == pytest.approx(4) and max(abs(arc.normals[:, 0])) == pytest.approx(0.5)
    aside = worst_normal(np.diag([4.0, 2.0, 1.0]), np.array([0.6, 0.0, 0.8]), 30.0)
    assert not aside.tied and aside.multiplier > 0


# ---- gradients ----------------------------------------------------------------------------------------------------


@pytest.mark.long(but=("tilthex_arm-impulse", "panda-energy", "solo8-sticking"))
@pytest.mark.parametrize("kind", CONE_KINDS)
@pytest.mark.parametrize("name", ["tilthex_arm", "panda", "solo8"])
def test_gradient_where_the_worst_normal_is_unique(name: str, kind: ObjectiveKind) -> None:
    loaded = robot(name)
    feet = loaded.spec.supports if kind == "impulse" else ()
    for degrees, metric, axes in ((5.0, "kinetic", "contact"), (45.0, "euclidean", "world")):
        contact = ImpactContact(ROBOTS[name], tuple(unit(rng(name, axes, kind))), (0.02, 0, 0.01), axes)  # type: ignore[arg-type]
        objective = WorstCaseObjective(loaded, contact, Metric(metric), kind, feet, normal_cone_deg=degrees)  # type: ignore[arg-type]
        (q,) = random_configurations(loaded.model, 1, name, axes, kind, degrees, spread=0.4)
        assert not cone_of(objective).worst(q).tied
        gradient = objective.gradient(q)
        where = f"{kind} {axes} {degrees} {metric}"
        assert_close(gradient, central_gradient(objective.value, loaded.model, q, 1e-4), 2e-6, where)
        value, symbolic_gradient = (np.array(v).ravel() for v in objective.gradient_fun()(q, contact.normal))
        assert_close(value, objective.value(q), 1e-9, where)
        assert_close(objective.value_fun()(q, contact.normal), objective.value(q), 1e-9, where)
        assert_close(symbolic_gradient, gradient, 1e-6 if feet else 1e-9, where)
        points = objective.subgradients(q)
        assert_close(points.gradients[0], gradient, 1e-12, where)


def test_subgradients_at_a_mirror_symmetric_posture() -> None:
    """In every direction, the slope of the objective is the largest slope of the subgradients: none is missing."""
    loaded = robot("solo8")
    objective = WorstCaseObjective(loaded, ImpactContact("base_link", (1.0, 0.0, 0.0)), normal_cone_deg=20.0)
    q = loaded.posture()
    worst = cone_of(objective).worst(q)
    assert worst.tied and np.allclose(worst.normals[0], worst.normals[1] * [1, 1, -1], atol=1e-9)
    points = objective.subgradients(q)
    assert relative(points.gradients[0], points.gradients[1]) > 0.1
    for index in range(20):
        direction = unit(rng("kink", index), loaded.nv)
        step = 1e-6
        rise = (
            objective.value(np.array(pin.integrate(loaded.model, q, step * direction))) - objective.value(q)
        ) / step
        assert rise == pytest.approx((points.gradients @ direction).max(), rel=1e-4, abs=1e-4 * objective.value(q))
    # The C export returns the gradient at one of the equally bad normals.
    value, gradient = (np.array(v).ravel() for v in objective.gradient_fun()(q, objective.contact.normal))
    assert value[0] == pytest.approx(objective.value(q), rel=1e-12)
    assert min(relative(gradient, g) for g in points.gradients) < 1e-6


# ---- solving ------------------------------------------------------------------------------------------------------

ARM = """<robot name="arm"><link name="world"/>
<joint name="j1" type="revolute"><parent link="world"/><child link="a"/><axis xyz="0 0 1"/>
 <limit lower="-1" upper="1.2" effort="1" velocity="1"/></joint>
<joint name="j2" type="revolute"><parent link="a"/><child link="b"/><origin xyz="0 0 0.3"/><axis xyz="0 1 0"/>
 <limit lower="-1.5" upper="1.5" effort="1" velocity="1"/></joint>
<joint name="j3" type="revolute"><parent link="b"/><child link="c"/><origin xyz="0.1 0 0.4"/><axis xyz="0 1 0"/>
 <limit lower="-2" upper="2" effort="1" velocity="1"/></joint>{links}</robot>"""
LINK = """<link name="{0}"><inertial><origin xyz="0.03 0.02 0.2"/><mass value="{1}"/>
 <inertia ixx="0.02" iyy="0.03" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>"""


@pytest.mark.long(but=("45.0",))
@pytest.mark.parametrize("degrees", [5.0, 45.0])
def test_solution_equals_brute_force(degrees: float, tmp_path: Path) -> None:
    """Search without duals and gradients: 3,000 sampled normals and Nelder–Mead from many starts."""
    links = "".join(LINK.format(name, mass) for name, mass in (("a", 2.0), ("b", 1.0), ("c", 0.5)))
    (tmp_path / "arm.urdf").write_text(ARM.format(links=links))
    arm = load_robot(str(tmp_path / "arm.urdf"))
    axis = np.array([0.6, 0.0, 0.8])
    objective = WorstCaseObjective(arm, ImpactContact("c", (0.6, 0, 0.8), (0.1, 0.05, 0.3)), normal_cone_deg=degrees)
    problem = build_problem(arm, objective, arm.posture(), Requirements(contact_pose="free"))
    solution = solve(problem, starts=8, jobs=1, compile="never")
    assert solution.certified_starts >= 7

    normals = cone_samples(axis, degrees, 3000)
    low, high = problem.lower, problem.upper

    def sampled(q: np.ndarray) -> float:
        J = frame_jacobian(arm.model, q, arm.frame_id("c"), (0.1, 0.05, 0.3))[:3]
        A = np.linalg.solve(mass_matrix(arm.model, q), J.T)
        return float(along(A.T @ A, normals).max())

    ends = [
        scipy.optimize.minimize(
            sampled,
            rng("brute", degrees, k).uniform(low, high),
            method="Nelder-Mead",
            bounds=list(zip(low, high, strict=True)),
            options={"xatol": 1e-5, "fatol": 1e-10, "maxfev": 600},
        ).fun
        for k in range(6)
    ]
    mine = objective.value(solution.q)
    assert mine <= min(ends) * (1 + 2e-4), "nothing that brute force finds is better"
    assert mine >= sampled(solution.q) * (1 - 1e-12)
    assert min(ends) >= mine * (1 - 2e-4), "brute force is better only by the width of its grid"


@pytest.mark.long(but=("tilthex_arm-impulse", "panda-sticking", "tilthex_arm-energy"))
@pytest.mark.parametrize("kind", CONE_KINDS)
@pytest.mark.parametrize("name", ["tilthex_arm", "panda"])
def test_starts_certify(name: str, kind: ObjectiveKind) -> None:
    settings = {"robot": name, "frame": ROBOTS[name], "normal": (0, 0, 1), "objective": kind, "normal_cone": 20.0}
    problem = prepare(make_settings(settings)).problem
    solution = solve(problem, starts=6, jobs=1, compile="never")
    assert solution.certified_starts == 6
    plain = prepare(make_settings(settings | {"normal_cone": 0.0})).problem
    best = solve(plain, starts=6, jobs=1, compile="never").q
    assert problem.objective.value(solution.q) <= problem.objective.value(best) * (1 + 1e-9)


def test_solved_from_and_at_mirror_symmetric_postures() -> None:
    """At the optimum of solo8, two normals are equally bad; only a convex combination of their gradients is zero."""
    settings = {"robot": "solo8", "frame": "base_link", "normal": (1, 0, 0), "normal_cone": 20.0}
    problem = prepare(make_settings(settings)).problem
    assert cone_of(problem.impact).worst(problem.given).tied
    nlp = build_nlp(problem, compile="never")
    scale = problem.objective.value(problem.given)
    record, certificate = run_start(nlp, problem.given, scale)
    assert certificate.holds()
    assert cone_of(problem.impact).worst(record.q).tied


# ---- rejected input and output ------------------------------------------------------------------------------------


def test_speed_has_no_dual_and_no_cone_is_half_open() -> None:
    contact = ImpactContact("ee", (0, 0, 1))
    with pytest.raises(MetricError, match="not a quadratic form") as caught:
        WorstCaseObjective(robot("tilthex_arm"), contact, kind="speed", normal_cone_deg=5.0)
    assert "\n" not in caught.value.line
    for degrees in (-1.0, 90.0, float("nan")):
        with pytest.raises(InputError, match="from 0 to below 90"):
            WorstCaseObjective(robot("tilthex_arm"), contact, normal_cone_deg=degrees)


def test_export_has_the_worst_case(tmp_path: Path) -> None:
    need_compiler()
    kinds: tuple[ObjectiveKind, ...] = ("sticking", "energy")
    for kind in kinds:
        (tmp_path / kind).mkdir()
        contact = ImpactContact("ee", (0.1, -0.2, 1.0), impulse=2.0)
        objective = WorstCaseObjective(robot("tilthex_arm"), contact, kind=kind, normal_cone_deg=15.0)
        written = export(objective, tmp_path / kind)
        assert written.compiled and written.agreement is not None and written.agreement < 1e-9
        assert written.manifest["normal_cone_deg"] == 15.0
        header = next((tmp_path / kind).glob("*.h")).read_text()
        assert "worst normal within 15 degrees" in header and "subgradient" in header


def test_command_line(tmp_path: Path) -> None:
    fast = ("--starts", 2, "--jobs", 1, "--no-codegen", "--format", "png")
    done = succeed("optimize", "tilthex_arm", "--normal", 0, 0, 1, "--normal-cone", 10, *fast, cwd=tmp_path)
    assert "worst normal after" in done.stdout and "10° from n" in done.stdout
    document = json.loads((tmp_path / "tilthex_arm-ee" / "result.json").read_text())
    assert document["metric"]["normal_cone_deg"] == 10
    assert document["contacts"][0]["normal"] == [0, 0, 1]
    optimal = document["optimal"]
    assert optimal["cone"]["angle_deg"] == pytest.approx(10) and optimal["cone"]["tied"] is False
    assert optimal["worst_normal"] == optimal["cone"]["normals"][0]
    assert optimal["objective"] > optimal["H"]
    again = prepare(read_settings(tmp_path / "tilthex_arm-ee" / "problem.toml")).impact.objective
    assert again.value(np.array(optimal["q"])) == pytest.approx(optimal["objective"], rel=1e-12)
    shown = run("evaluate", "solo8", "--normal", 1, 0, 0, "--normal-cone", 20, cwd=tmp_path)
    assert shown.returncode == 0 and "is as bad" in shown.stdout and "worst within 20° of n" in shown.stdout
    refused = run("evaluate", "panda", "--normal", 0, 0, 1, "--normal-cone", 5, "--objective", "speed", cwd=tmp_path)
    assert refused.returncode == 1 and refused.stderr.startswith("error: --normal-cone")
    assert run("evaluate", "panda", "--normal", 0, 0, 1, "--normal-cone", 90, cwd=tmp_path).returncode == 2
