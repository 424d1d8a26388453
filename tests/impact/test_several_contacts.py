"""Several contacts at once: compared with enumeration and samples of the impulse box, at ties, and in searches."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from impact_posture.errors import ContactError, ImpactPostureError, InputError, MetricError, SpecError
from impact_posture.impact.evaluation.coulomb_jump import coulomb_jumps
from impact_posture.impact.evaluation.evaluation import evaluate
from impact_posture.impact.impact_contact import ImpactContact
from impact_posture.impact.metric import Metric
from impact_posture.impact.worst_case.impulse_box import ImpulseBox, corners
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.posture.constraints.clearance import Clearance
from impact_posture.posture.constraints.kept_contacts import KeptContacts
from impact_posture.posture.formulation.problem_file import dump_settings, prepare, read_settings, resolved_settings
from impact_posture.posture.manifold.feasible_start import feasible_start
from impact_posture.posture.program.constrained_problem import ConstrainedProblem
from impact_posture.posture.search.multistart import solve
from impact_posture.robot.robot import Robot
from impact_posture.robot.robot_spec import RobotSpec, Support
from tests.dynamics.test_dynamics import random_tree
from tests.support.helpers import assert_close, random_configurations, relative, rng, robot, unit
from tests.support.pinocchio_values import central_gradient, frame_jacobian, frame_placement, mass_matrix
from tests.support.settings import make_settings

HANDS = ("gripper_right_base_link", "gripper_left_base_link")


def random_robot(generator: np.random.Generator, *, floating: bool) -> Robot:
    """Return a random branching tree with five joints and six frames."""
    kinds = [*(["FreeFlyer"] if floating else []), *generator.choice(["RX", "RUBY", "PZ", "RevoluteUnaligned"], 5)]
    climbs = [int(v) for v in generator.integers(0, 3, len(kinds))]
    model = random_tree([str(k) for k in kinds], climbs, int(generator.integers(1000)), armature=True)
    for k in range(6):
        joint = int(generator.integers(2 if floating else 3, model.njoints))
        model.addFrame(pin.Frame(f"f{k}", joint, 0, pin.SE3.Random(), pin.FrameType.OP_FRAME))
    root = "free-flyer" if floating else "fixed"
    return Robot("tree", "", model, root, {"neutral": pin.neutral(model)}, "neutral", RobotSpec())  # type: ignore[arg-type]


def box_of(objective: WorstCaseObjective) -> ImpulseBox:
    assert isinstance(objective.worst_case, ImpulseBox)
    return objective.worst_case


def jumps_of(objective: WorstCaseObjective, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the velocity jumps of unit impulses as columns, and the weight matrix W, by dense algebra on M and J."""
    model = objective.robot.model
    M = mass_matrix(model, q)
    impacts = []
    for contact in objective.contacts:
        frame = objective.robot.frame_id(contact.frame)
        n = np.array(contact.normal)
        n = frame_placement(model, q, frame).rotation @ n if contact.normal_frame == "contact" else n
        impacts.append(frame_jacobian(model, q, frame, contact.offset)[:3].T @ n)
    rows = [
        frame_jacobian(model, q, objective.robot.frame_id(s.frame), s.offset)[: s.rows] for s in objective.supports
    ]
    Js = np.vstack(rows) if rows else np.zeros((0, model.nv))
    kkt = np.block([[M, -Js.T], [Js, objective.compliance * np.eye(len(Js))]])
    right = np.vstack([np.array(impacts).T, np.zeros((len(Js), len(impacts)))])
    metric = objective.metric
    W = {"euclidean": np.eye(model.nv), "kinetic": M}.get(metric.kind)
    return np.linalg.solve(kkt, right)[: model.nv], np.diag(metric.diagonal(model.nv)) if W is None else W


def enumerated(objective: WorstCaseObjective, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return all corners of the impulse box and the origin, with ``‖Σ λ_i a_i‖²_W`` at each corner."""
    jumps, W = jumps_of(objective, q)
    ends = [(-c.impulse if objective.bilateral else 0.0, c.impulse) for c in objective.contacts]
    rows = np.array(list(itertools.product(*ends)))
    return rows, np.einsum("ki,ij,kj->k", rows, jumps.T @ W @ jumps, rows)


# ---- comparison with enumeration, samples, differences ------------------------------------------------------------


@settings(max_examples=25)
@given(
    floating=st.booleans(),
    count=st.integers(2, 4),
    feet=st.integers(0, 2),
    metric=st.sampled_from(["euclidean", "kinetic", "weighted"]),
    axes=st.sampled_from(["world", "contact"]),
    bilateral=st.booleans(),
    seed=st.integers(0, 10_000),
)
def test_every_box(floating: bool, count: int, feet: int, metric: str, axes: str, bilateral: bool, seed: int) -> None:
    generator = rng(seed, "box")
    loaded = random_robot(generator, floating=floating)
    contacts = [
        ImpactContact(f"f{k}", tuple(unit(generator)), tuple(0.1 * generator.normal(size=3)), axes, impulse)  # type: ignore[arg-type]
        for k, impulse in enumerate(generator.uniform(0.3, 3.0, count))
    ]
    weights = tuple(generator.uniform(0.2, 5.0, loaded.nv)) if metric == "weighted" else None
    objective = WorstCaseObjective(
        loaded,
        contacts[0],
        Metric(metric, weights),  # type: ignore[arg-type]
        supports=tuple(Support(f"f{5 - k}", "point") for k in range(feet)),
        compliance=1e-3,
        others=tuple(contacts[1:]),
        bilateral=bilateral,
    )
    (q,) = random_configurations(loaded.model, 1, seed, "box", spread=0.6)
    jumps, W = jumps_of(objective, q)
    box, values = enumerated(objective, q)
    value = objective.value(q)
    assert_close(value, values.max(), 1e-9, "the largest of all corners")

    low = -1.0 if bilateral else 0.0
    bounds = np.array([c.impulse for c in contacts])
    inside = generator.uniform(low, 1.0, (10_000, count)) * bounds
    assert np.einsum("ki,ij,kj->k", inside, jumps.T @ W @ jumps, inside).max() <= value * (1 + 1e-9)

    worst = box_of(objective).worst(q)
    assert any(np.array_equal(worst.impulses, corner) for corner in box), "a corner of the box"
    assert_close(worst.impulses @ jumps.T @ W @ jumps @ worst.impulses, value, 1e-9, "attained there")
    assert_close(worst.jump, jumps @ worst.impulses, 1e-8, "its jump")

    # With bilateral impulses, opposite corners have equal values, so the next smaller value is the third.
    best = np.sort(values)[::-1]
    if best[2 if bilateral else 1] < value * (1 - 1e-3):
        gradient = objective.gradient(q)
        differences = central_gradient(objective.value, loaded.model, q, 1e-4)
        assert_close(gradient, differences, 3e-6, "gradient", scale=value)
        symbolic = [np.array(v).ravel() for v in objective.gradient_fun()(q, objective.contact.normal)]
        assert_close(symbolic[0], value, 1e-9, "CasADi's value")
        assert_close(symbolic[1], gradient, 1e-7, "CasADi's gradient", scale=value)
        assert_close(objective.subgradients(q).gradients, [gradient], 1e-12, "one gradient", scale=value)


@pytest.mark.long(but=("2-0-euclidean-contact", "2-1-kinetic-world", "3-0-weighted-world", "2-1-weighted-contact"))
@pytest.mark.parametrize("axes", ["world", "contact"])
@pytest.mark.parametrize(
    ("count", "feet", "metric"), [(2, 0, "euclidean"), (2, 1, "kinetic"), (3, 0, "weighted"), (2, 1, "weighted")]
)
def test_every_simultaneous_impact(count: int, feet: int, metric: str, axes: str) -> None:
    """The oracle is the KKT system of all contact points that stick, with dense matrices of Pinocchio."""
    generator, condition = rng("simultaneous", count, feet, metric, axes), np.inf
    # Two points of a link cannot move independently, and the impact is then not defined.
    while condition > 1e3:
        loaded = random_robot(generator, floating=True)
        contacts = [
            ImpactContact(f"f{k}", tuple(unit(generator)), tuple(0.1 * generator.normal(size=3)), axes)  # type: ignore[arg-type]
            for k in range(count)
        ]
        (q,) = random_configurations(loaded.model, 1, int(generator.integers(10_000)), "simultaneous", spread=0.6)
        J, n = [], []
        for contact in contacts:
            frame = loaded.frame_id(contact.frame)
            R = frame_placement(loaded.model, q, frame).rotation if axes == "contact" else np.eye(3)
            J.append(frame_jacobian(loaded.model, q, frame, contact.offset)[:3])
            n.append(R @ contact.normal)
        A, b = np.vstack(J), np.concatenate(n)
        condition = float(np.linalg.cond(A))
    weights = tuple(generator.uniform(0.2, 5.0, loaded.nv)) if metric == "weighted" else None
    supports = tuple(Support(f"f{5 - k}", "point") for k in range(feet))
    norm, others = Metric(metric, weights), tuple(contacts[1:])  # type: ignore[arg-type]
    objective = WorstCaseObjective(loaded, contacts[0], norm, "sticking", supports, 1e-3, others=others)
    M, rows = mass_matrix(loaded.model, q), [A]
    rows += [frame_jacobian(loaded.model, q, loaded.frame_id(s.frame), s.offset)[:3] for s in supports]
    C = np.vstack(rows)
    soft = np.diag([*np.zeros(len(A)), *np.full(3 * feet, 1e-3)])
    right = np.concatenate([np.zeros(loaded.nv), b, np.zeros(3 * feet)])
    a = np.linalg.solve(np.block([[M, -C.T], [C, soft]]), right)[: loaded.nv]
    W = M if metric == "kinetic" else np.diag(objective.metric.diagonal(loaded.nv))
    value = objective.value(q)
    assert_close(value, a @ W @ a, 1e-8, "the squared jump")
    gradient = objective.gradient(q)
    assert_close(gradient, central_gradient(objective.value, loaded.model, q, 1e-4), 1e-5, "gradient", scale=value)
    symbolic = [np.array(v).ravel() for v in objective.gradient_fun()(q, objective.contact.normal)]
    assert_close(symbolic[0], value, 1e-8, "CasADi's value")
    assert_close(symbolic[1], gradient, 1e-6, "CasADi's gradient", scale=value)


def test_a_simultaneous_impact_is_the_predicted_plastic_impact_if_all_feet_stick() -> None:
    loaded = robot("solo12")
    first, *others = [ImpactContact(s.frame, (0, 0, 1), s.offset, friction=2.0) for s in loaded.spec.supports]
    objective = WorstCaseObjective(loaded, first, Metric(), "sticking", others=tuple(others))
    jumps = coulomb_jumps(objective, loaded.posture(), 1.0)
    assert jumps is not None and all(jump.sticks for jump in jumps)
    assert_close(objective.value(loaded.posture()), jumps[0].velocity @ jumps[0].velocity, 1e-6, "squared jump")


def test_a_simultaneous_impact_along_conflicting_normals_is_refused() -> None:
    loaded = robot("panda")
    first, second = (ImpactContact("panda_hand_tcp", normal) for normal in ((0, 0, 1), (1, 0, 0)))
    objective = WorstCaseObjective(loaded, first, Metric(), "sticking", others=(second,))
    with pytest.raises(MetricError, match="does not exist here") as error:
        objective.value(loaded.posture())
    assert "speed" not in error.value.hint, "this objective is for one contact"


def test_a_simultaneous_impact_of_points_on_one_link_is_not_exported() -> None:
    """The distance of the points is constant, so their mobility is always singular, but the objective exists."""
    loaded = robot("panda")
    first, second = (ImpactContact(frame, (0, 0, 1)) for frame in ("panda_hand_tcp", "panda_hand"))
    objective = WorstCaseObjective(loaded, first, Metric(), "sticking", others=(second,))
    assert objective.value(loaded.posture()) > 0
    with pytest.raises(MetricError, match="depend on each other"):
        objective.gradient_fun()
    task = {"robot": "panda", "contact": ("panda_hand_tcp:0,0,1", "panda_hand:0,0,1"), "objective": "sticking"}
    problem = prepare(make_settings(task)).problem
    assert solve(problem, starts=1, jobs=1, screened=16).estimate.method == "multistart"


@pytest.mark.parametrize("feet", [(), ("HL_FOOT", "HR_FOOT")])
def test_an_optimum_of_a_simultaneous_impact_certifies(feet: tuple[str, ...]) -> None:
    """The other feet are either supports, or contacts like the struck feet."""
    struck = tuple(f"{foot}:0,0,1" for foot in ("FL_FOOT", "FR_FOOT", "HL_FOOT", "HR_FOOT") if foot not in feet)
    task = {
        "robot": "solo12", "normal": None, "contact": struck, "support": feet, "contact_pose": "position",
        "objective": "sticking", "base": "level", "limit_margin": 0.5, "collision": False, "com": False,
    }  # fmt: skip
    problem = prepare(make_settings(task)).problem
    solution = solve(problem, starts=2, jobs=1)
    assert solution.certificate.holds() and solution.reduction > 0.2


@pytest.mark.parametrize(("name", "frames"), [("solo12", ("FL_SHOULDER", "FR_SHOULDER")),
                                              ("solo8", ("FL_UPPER_LEG", "FR_UPPER_LEG"))])  # fmt: skip
def test_subgradients_at_a_mirror_symmetric_posture(name: str, frames: tuple[str, str]) -> None:
    """Impacts from both sides are equally bad, so the objective increases like the larger of both values."""
    loaded = robot(name)
    one, other = (ImpactContact(f, (0.0, side, 0.0)) for f, side in zip(frames, (1.0, -1.0), strict=True))
    objective = WorstCaseObjective(loaded, one, others=(other,))
    q = loaded.posture()
    worst, points = box_of(objective).worst(q), objective.subgradients(q)
    assert np.array_equal(worst.tied, [[1, 0], [0, 1]]) and worst.to_dict()["tied"] is True
    assert len(points.gradients) == 2 and relative(*points.gradients) > 0.5
    assert np.all(points.gaps <= 1e-6 * objective.value(q))
    step = 1e-6
    for index in range(20):
        direction = unit(rng("kink", name, index), loaded.nv)
        there = np.array(pin.integrate(loaded.model, q, step * direction))
        rise = (objective.value(there) - objective.value(q)) / step
        slopes = points.gradients @ direction
        # The rise of the objective is the largest slope, as for a maximum of smooth functions.
        assert rise == pytest.approx(slopes.max(), rel=1e-3, abs=1e-3 * objective.value(q))
        assert slopes.min() < rise + 1e-3 * objective.value(q)
    # The symbolic gradient is the gradient of one of the equally bad corners.
    value, gradient = (np.array(v).ravel() for v in objective.gradient_fun()(q, one.normal))
    assert value[0] == pytest.approx(objective.value(q), rel=1e-9)
    assert min(relative(gradient, g) for g in points.gradients) < 1e-6


def test_corners() -> None:
    for count in range(2, 7):
        one_sided, both = corners(count, False), corners(count, True)
        assert one_sided.shape == (2**count - 1, count) and both.shape == (2 ** (count - 1), count)
        assert len({tuple(c) for c in one_sided}) == len(one_sided) and one_sided.any(axis=1).all()
        assert len({tuple(c) for c in (*both, *-both)}) == 2**count
        assert one_sided[0].all(), "among equally bad corners, the corner with all impulses comes first"


def test_an_evaluation_has_each_contact_alone_and_the_worst_impulses() -> None:
    talos = robot("talos")
    right, left = (
        ImpactContact(hand, (-1.0, 0.0, 0.2), impulse=k) for hand, k in zip(HANDS, (1.0, 2.0), strict=True)
    )
    objective, q = WorstCaseObjective(talos, right, supports=talos.spec.supports, others=(left,)), talos.posture()
    evaluation = evaluate(objective, q)
    assert [single.contact for single in objective.singles] == [right, left]
    assert [contact.objective for contact in evaluation.contacts] == [s.value(q) for s in objective.singles]
    assert evaluation.impulses is not None
    assert evaluation.objective == pytest.approx(evaluation.impulses.value, rel=1e-12)


# ---- solving ------------------------------------------------------------------------------------------------------

ELBOW = {"robot": "panda", "contact": ("panda_hand_tcp:0,0,1", "panda_link4:1,0,0:2"), "contact_pose": "position"}
TASKS = {
    "talos' hands": {"robot": "talos", "contact": tuple(f"{hand}:-1,0,0" for hand in HANDS)},
    "two feet": {
        "robot": "solo12", "contact": ("FL_FOOT:0,0,1", "FR_FOOT:0,0,1"), "contact_pose": "free", "com": False,
        "support": ("HL_FOOT", "HR_FOOT"),
    },
    "hand and elbow": ELBOW,
    "hand and elbow, free": ELBOW | {"contact_pose": "free"},
    "six": {
        "robot": "panda", "contact_pose": "free",
        "contact": ("panda_hand:1,1,0", *[f"panda_link{k}:{k % 2},{k % 3},-1:0.{k}" for k in range(3, 8)]),
    },
}  # fmt: skip


def problem_of(task: dict[str, object], **more: object) -> ConstrainedProblem:
    return prepare(make_settings(task | more)).problem


@pytest.mark.long(but=("two feet", "hand and elbow", "hand and elbow, free", "six"))
@pytest.mark.parametrize("name", TASKS)
def test_every_start_certifies(name: str) -> None:
    problem = problem_of(TASKS[name])
    solution = solve(problem, starts=3, jobs=1, compile="never")
    assert solution.certified_starts == solution.feasible_starts == 3
    assert solution.reduction > 0 and solution.certificate.holds()
    # The optimum of a single contact is a lower bound for both contacts.
    first = problem.impact.singles[0]
    alone = solve(replace(problem, objective=first), starts=3, jobs=1, compile="never", guesses=(solution.q,))
    assert problem.objective.value(solution.q) >= first.value(alone.q) * (1 - 1e-9)
    assert problem.objective.value(solution.q) <= problem.objective.value(alone.q) * (1 + 1e-6)
    assert len({c.frame for c in problem.objective.contacts}) == len(problem.objective.contacts)


def test_no_feasible_posture_is_better() -> None:
    """If hand and elbow are fixed, two degrees of freedom remain, which random feasible postures cover."""
    problem = problem_of(ELBOW)
    solution = solve(problem, starts=8, jobs=1, compile="never")
    assert solution.redundancy == 2
    result = [feasible_start(problem, k, seed=5) for k in range(1, 60)]
    values = [problem.objective.value(q) for q in result if q is not None]
    assert len(values) > 40
    best = problem.objective.value(solution.q)
    assert min(values) >= best * (1 - 1e-7)
    assert min(values) < best * 1.5, "and some come near"


def test_an_optimum_at_a_kink_certifies_by_a_mixture() -> None:
    """At two equally bad corners, neither gradient vanishes on the constraints, but a convex combination does."""
    problem = problem_of(TASKS["two feet"], bilateral=True)
    solution = solve(problem, starts=6, jobs=1, compile="never")
    points = problem.objective.subgradients(solution.q)
    assert len(points.gradients) > 1 and relative(*points.gradients[:2]) > 0.01
    assert solution.certificate.stationarity < 1e-7
    smooth = replace(problem, objective=_Frozen(problem.objective))  # type: ignore[arg-type]
    from impact_posture.posture.program.certificate import certify

    assert not certify(smooth, solution.q, problem.objective.value(solution.initial)).holds()


def test_optima_far_below_their_start_certify() -> None:
    """If the objective falls ten-thousandfold, equally bad corners agree only to the accuracy of the solver."""
    task = {"robot": "icub", "contact_pose": "free", "com": False, "contact": (
        "r_gripper_joint:-0.033,-0.472,-0.830:0.92", "l_gripper_joint:-0.983,-1.982,0.553:2.89",
        "root_joint:0.586,-0.165,1.748:2.53", "l_leg_ft_sensor:0.826,2.150,0.821:2.87")}  # fmt: skip
    solution = solve(problem_of(task), starts=2, seed=3, jobs=1, compile="never")
    assert solution.certified_starts == 2 and solution.reduction > 0.9995


class _Frozen:
    """Objective for a test that reports only its first subgradient."""

    def __init__(self, objective: WorstCaseObjective) -> None:
        self._objective = objective

    def subgradients(self, q: np.ndarray, within: float = 0.0) -> object:
        whole = self._objective.subgradients(q, within)
        return replace(whole, gradients=whole.gradients[:1], gaps=whole.gaps[:1])


def test_pulling_is_never_milder() -> None:
    pushing, both = problem_of(ELBOW), problem_of(ELBOW, bilateral=True)
    for q in random_configurations(pushing.robot.model, 10, "pull"):
        assert both.objective.value(q) >= pushing.objective.value(q) * (1 - 1e-12)
    one, two = (solve(p, starts=6, jobs=1, compile="never") for p in (pushing, both))
    assert both.objective.value(two.q) >= pushing.objective.value(one.q) * (1 - 1e-9)


def test_two_frames_of_one_link_are_held_once() -> None:
    """The two contact poses have dependent constraint rows, both in the search for starts and in the program."""
    problem = problem_of({"robot": "ur5", "contact": ("tool0:1,0,0", "wrist_3_link-tool0_fixed_joint:0,1,0")})
    assert problem.rows, "rows that repeat others are left out"
    assert sum(feasible_start(problem, k, seed=0) is not None for k in range(12)) == 12
    solution = solve(problem, starts=4, jobs=1, compile="never")
    assert solution.certified_starts == solution.feasible_starts == 4


def test_struck_feet_that_are_balls_are_held_in_place_only() -> None:
    problem = problem_of({k: v for k, v in TASKS["two feet"].items() if k != "contact_pose"})
    names = [c.name for c in problem.constraints]
    assert "position of FL_FOOT" in names and "pose of FL_FOOT" not in names


@pytest.mark.parametrize("normal_frame", ["world", "contact"])
@pytest.mark.parametrize(
    ("normals", "stops"),
    [
        (((-1, 0, 0), (-1, 0, 0)), False),
        # The two hands contact different surfaces, and the left hand must not touch the surface of the right hand.
        (((-1, 0, 0), (0, 1, 0)), True),
    ],
)
def test_two_hands_at_one_wall_may_both_touch_it(
    normals: tuple[tuple[int, int, int], ...], stops: bool, normal_frame: str
) -> None:
    talos, contacts = robot("talos"), []
    for hand, normal in zip(HANDS, normals, strict=True):
        turned = frame_placement(talos.model, talos.posture(), talos.frame_id(hand)).rotation.T @ np.array(normal)
        x, y, z = normal if normal_frame == "world" else turned
        contacts.append(f"{hand}:{x},{y},{z}")
    task = {"robot": "talos", "contact": tuple(contacts), "normal_frame": normal_frame, "collision": True}
    problem = problem_of(task)
    (wall,) = [c for c in problem.constraints if c.name == f"surface at {HANDS[0]}"]
    assert isinstance(wall, Clearance)
    bodies = [wall.row_name(k).split(" / ")[0] for k in range(len(wall.lower))]
    assert "torso_2_link" in bodies and any("arm_left_5" in name for name in bodies)
    assert not any("gripper_right" in name for name in bodies)
    assert any("gripper_left" in name for name in bodies) == stops


def test_kept_feet_of_each_impact() -> None:
    task = {"robot": "bolt", "contact": ("base_link:0,0.1,-1", "base_link:0.1,0,-1"), "contact_pose": "free",
            "keep_contacts": True, "friction": 2.0}  # fmt: skip
    problem = problem_of(task)
    kept = [c for c in problem.constraints if isinstance(c, KeptContacts)]
    assert [tuple(c.parameters) for c in kept] == [c.normal for c in problem.objective.contacts]
    solution = solve(problem, starts=1, jobs=1, compile="never")
    for one in evaluate(problem.objective, solution.q).contacts:
        result = one.contact_stability
        assert result is not None and result.friction is not None and result.friction <= 2.02
    with pytest.raises(InputError, match="pull as well as push"):
        problem_of(task, bilateral=True)


def test_a_resolved_problem_gives_the_same_again(tmp_path: Path) -> None:
    prepared = prepare(make_settings({**ELBOW, "contact": ("panda_hand_tcp:1,2,3:0.7", "panda_link4:1,0,-0.3"),
                                      "bilateral": True, "impulse": 2.0, "starts": 2, "seed": 3}))  # fmt: skip
    (tmp_path / "problem.toml").write_text(dump_settings(resolved_settings(prepared)))
    again = prepare(read_settings(tmp_path / "problem.toml"))
    assert again.problem.objective.contacts == prepared.problem.objective.contacts
    assert again.problem.impact.bilateral and again.problem.impact.contact.impulse == 0.7


@pytest.mark.parametrize(
    ("settings_", "kind", "words"),
    [
        ({"target_position": (0.4, 0.0, 0.4)}, InputError, "single target, but there are several contacts"),
        ({"target_quaternion": (0.0, 0.0, 0.0, 1.0)}, InputError, "single target, but there are several contacts"),
        ({"objective": "speed"}, MetricError, "approach speed of one contact"),
        ({"normal_cone": 5.0}, MetricError, "exact for one contact only"),
        ({"offset": (0.0, 0.0, 0.1)}, ContactError, "one offset for several contacts"),
        ({"frame": "panda_hand_tcp"}, ContactError, "cannot be combined with `frame`"),
        ({"contact": ("panda_hand:1,0,0", "panda_hand:2,0,0")}, ContactError, "given twice"),
        ({"contact": tuple(f"panda_link{k}:0,0,1" for k in range(1, 8))}, ContactError, "7 contacts"),
        ({"contact": ("panda_hand_tcp:0,0,1",), "bilateral": True}, ContactError, "one contact"),
        ({"objective": "sticking", "bilateral": True}, ContactError, "sticking has no bounds on impulses"),
        ({"contact": ("panda_hand_tcp:0,0,1", "panda_hnd:0,0,1")}, ImpactPostureError, "panda_hand"),
        ({"contact": ("panda_hand_tcp:0,0,1", "panda_link4:0,0,0")}, SpecError, "with a direction"),
        ({"contact": ("panda_hand_tcp:0,0,1", "panda_link4:0,0,1:-2")}, SpecError, "impulse above zero"),
    ],
)
def test_refusals(settings_: dict[str, object], kind: type[ImpactPostureError], words: str) -> None:
    with pytest.raises(kind, match=words) as caught:
        problem_of(ELBOW, **settings_)
    assert "\n" not in caught.value.line and caught.value.hint
