"""The fastest approach within velocity limits, and the constraint on this approach speed."""

from __future__ import annotations

import functools
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog

from impact_posture.dynamics.numeric import Numeric
from impact_posture.errors import Infeasible, InputError
from impact_posture.posture.analysis.result_document import result_document
from impact_posture.posture.approach.approach_speed import ApproachSpeed
from impact_posture.posture.approach.attainable_speed import _ROOM, USABLE, AttainableSpeed
from impact_posture.posture.formulation.problem_file import Prepared, prepare
from impact_posture.posture.manifold.feasible_start import feasible_start
from impact_posture.posture.search.growing_search import feasible
from impact_posture.posture.search.initial_posture import _at_speed, initial_posture
from impact_posture.posture.search.multistart import solve
from tests.support.command import refused, run, succeed
from tests.support.constraints import check_lifted_rows
from tests.support.helpers import Vector, rng
from tests.support.settings import make_settings
from tests.support.urdfs import MOVED, joint, link, write

# Problems with fixed and standing bases, one and two contacts, a normal in the contact frame, a held joint, a kept
# frame, and room for a run-up.
PROBLEMS: dict[str, dict[str, object]] = {
    "ur5": {"normal": (0.2, -0.1, 1.0)},
    "panda": {"normal": (0, 0, 1), "hold": ("panda_joint1",), "strike": True},
    "xarm7": {"normal": (0.3, 0.2, -1), "normal_frame": "contact", "contact_pose": "position"},
    "tiago": {"normal": (-1, 0, 0)},
    "talos": {"frame": "gripper_right_base_link", "normal": (-1, 0, 0), "keep": ("gripper_left_base_link",)},
    "g1": {
        "contact": ("left_rubber_hand:-1,0,0", "right_rubber_hand:-1,0,0"),
        "contact_pose": "position",
        "strike": True,
    },
}


@functools.cache
def prepared(name: str, speed: float = 0.5, **more: object) -> Prepared:
    over = {
        "robot": name,
        "collision": False,
        "objective": "impulse",
        "speed": speed,
        "approach": True,
        **PROBLEMS[name],
        **more,
    }
    return prepare(make_settings(over))


def constraint_of(posed: Prepared) -> ApproachSpeed:
    (approach_constraint,) = (c for c in posed.problem.constraints if isinstance(c, ApproachSpeed))
    return approach_constraint


def posture(posed: Prepared, seed: int) -> Vector:
    robot = posed.problem.robot
    return np.array(pin.integrate(robot.model, posed.problem.given, 0.3 * rng(seed).normal(size=robot.nv)))


def fastest(posed: Prepared, q: Vector) -> float:
    """Return the fastest approach by an independent program on raw Jacobians, which bounds each velocity entry."""
    robot, wanted = posed.problem.robot, posed.problem.requirements
    model, data = robot.model, robot.model.createData()
    pin.computeJointJacobians(model, data, q)
    pin.updateFramePlacements(model, data)
    nv, rows, arrives = model.nv, [], []
    contacts = posed.problem.objective.contacts
    for contact, pose in zip(contacts, (wanted.contact_pose, *wanted.other_poses), strict=True):
        frame = model.getFrameId(contact.frame)
        J = pin.getFrameJacobian(model, data, frame, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)
        R = data.oMf[frame].rotation
        arm, n = R @ contact.offset, np.array(contact.normal)
        n = R @ n if contact.normal_frame == "contact" else n
        point = J[:3] - pin.skew(arm) @ J[3:]
        if len(contacts) > 1 and not wanted.strike:
            rows, arrives = [*rows, n @ point], [*arrives, 1.0]
            continue
        rows, arrives = [*rows, *point], [*arrives, *n]
        if pose == "full":
            rows, arrives = [*rows, *J[3:]], [*arrives, 0.0, 0.0, 0.0]
        elif pose.startswith("aligned"):
            # Only two of the three rows are independent, because the rotation about the normal is not constrained.
            rows, arrives = [*rows, *((np.eye(3) - np.outer(n, n)) @ J[3:])], [*arrives, 0.0, 0.0, 0.0]
    for frame in wanted.keep:
        J = pin.getFrameJacobian(model, data, model.getFrameId(frame), pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)
        rows, arrives = [*rows, *J], [*arrives, *np.zeros(6)]
    limit = np.where(model.velocityLimit > 0, model.velocityLimit, np.inf)
    if robot.floating:
        limit[:6] = 0.0
    for name in wanted.hold:
        limit[model.idx_vs[model.getJointId(name)]] = 0.0
    low, high = -limit, limit
    if wanted.strike:
        room = np.maximum(model.upperPositionLimit - q, 0), np.maximum(q - model.lowerPositionLimit, 0)
        # During the approach, a floating base does not move.
        count = nv - 6 if robot.floating else nv
        still, joints = np.zeros(nv - count), slice(model.nq - count, None)
        ahead, behind = (np.append(still, side[joints] / _ROOM) for side in room)
        low, high = np.maximum(-USABLE * limit, -ahead), np.minimum(USABLE * limit, behind)
    A = np.column_stack([np.array(rows), arrives])
    bounds = [*zip(low, high, strict=True), (0, 1e3)]
    optimum = linprog(np.append(np.zeros(nv), -1.0), A_eq=A, b_eq=np.zeros(len(A)), bounds=bounds)
    return float(-optimum.fun)


@pytest.mark.parametrize("name", PROBLEMS)
@given(seed=st.integers(0, 2**20))
@settings(max_examples=6)
def test_the_fastest_approach_agrees_with_another_program(name: str, seed: int) -> None:
    posed = prepared(name)
    attainable = AttainableSpeed(posed.problem.robot, posed.problem.objective, posed.problem.requirements)
    q = posture(posed, seed)
    attained = attainable.at(Numeric(posed.problem.robot.model).at(q))
    assert attained.speed == pytest.approx(fastest(posed, q), rel=1e-6, abs=1e-9)
    assert (np.abs(attained.velocities) <= attainable.upper + 1e-9).all()


@pytest.mark.parametrize("name", PROBLEMS)
@given(seed=st.integers(0, 2**20))
@settings(max_examples=4)
def test_reduced_form_has_the_gradient_of_the_manifold(name: str, seed: int) -> None:
    posed = prepared(name)
    constraint, model = constraint_of(posed), posed.problem.robot.model
    numeric, q = Numeric(model), posture(posed, seed)

    def value(q: Vector) -> float:
        return float(constraint.evaluate(numeric.at(q))[0][0])

    gradient, slope = constraint.evaluate(numeric.at(q))[1][0], rng(seed, 1).normal(size=model.nv)
    sides = [side * (value(pin.integrate(model, q, side * 1e-6 * slope)) - value(q)) / 1e-6 for side in (1, -1)]
    # The speed has a kink where another joint reaches its velocity limit.
    margin = 1e-4 + 1e-3 * np.abs(sides).max()
    assert min(sides) - margin <= gradient @ slope <= max(sides) + margin


@pytest.mark.parametrize("name", PROBLEMS)
def test_lifted_rows_agree_with_pinocchio_and_with_differences(name: str) -> None:
    posed = prepared(name)
    constraint = constraint_of(posed)
    z = rng(name).uniform(-1, 1, constraint.unknowns)
    check_lifted_rows(constraint, posed.problem.robot.model, posture(posed, 5), z)


@pytest.mark.long(but=("tiago-0.8",))
@pytest.mark.parametrize(("name", "speed"), [("tiago", 0.8), ("talos", 1.0)])
def test_an_optimum_that_is_too_slow_moves_to_a_fast_one(name: str, speed: float) -> None:
    """Both optima are certified.  Without the constraint on the speed, the optimum is better but too slow."""
    wrist = (0.0, 0.0, 0.0)
    free, asked = (prepared(name, speed, approach=approach, offset=wrist) for approach in (False, True))
    attainable = AttainableSpeed(asked.problem.robot, asked.problem.objective, asked.problem.requirements)
    solutions = [solve(posed.problem, starts=4, jobs=1) for posed in (free, asked)]
    slow, fast = (attainable.reached(one.q) for one in solutions)
    assert slow is not None and fast is not None
    assert slow < 0.9 * speed <= speed * (1 - 1e-6) <= fast
    assert solutions[1].optima[0].objective > solutions[0].optima[0].objective
    documents = [result_document(posed, one) for posed, one in zip((free, asked), solutions, strict=True)]
    verdicts = [document["verdict"] for document in documents]
    assert [v["line"].startswith(f"verdict: cannot arrive at {speed:g} m/s (") for v in verdicts] == [True, False]
    assert [v["outcome"] == "cannot arrive" for v in verdicts] == [True, False]
    assert fastest(asked, solutions[1].q) == pytest.approx(documents[1]["optimal"]["attainable_speed"], rel=1e-6)


def test_a_speed_beyond_the_joints_is_infeasible_and_named() -> None:
    posed = prepared("ur5", 20.0)
    with pytest.raises(Infeasible, match="approach at 20 m/s"):
        solve(posed.problem, starts=2, jobs=1)


def test_a_strike_beyond_the_joints_gets_the_greatest_speed() -> None:
    """No random posture is faster, and the constraint on the speed is active at the optimum."""
    posed = prepared("ur5", 20.0, strike=True, contact_pose="aligned")
    solution = solve(posed.problem, starts=2, jobs=1)
    (required,) = (c for c in solution.problem.constraints if isinstance(c, ApproachSpeed))
    assert solution.certificate.holds()
    attainable = AttainableSpeed(posed.problem.robot, posed.problem.objective, posed.problem.requirements)
    reached = attainable.reached(solution.q)
    assert reached is not None and required.speed * (1 - 1e-6) <= reached <= 1.01 * required.speed
    assert any("20 m/s cannot be reached, so the program requires the greatest" in note for note in solution.notes)
    drawn = (feasible_start(posed.problem, index, 1) for index in range(40))
    speeds = [attainable.reached(q) for q in drawn if q is not None]
    assert len(speeds) > 10 and max(speeds) <= required.speed * 1.002


@pytest.mark.long
def test_a_clearance_that_conflicts_with_the_speed_of_a_strike_slows_it() -> None:
    """At 1 m/s, a link of panda would touch the wall.  No random posture without collisions is much faster."""
    posed = prepared("panda", 1.0, strike=True, normal=(-1, 0, 0), hold=None, collision=True)
    problem, q, _ = initial_posture(posed.problem, 0)
    (required,) = (c for c in problem.constraints if isinstance(c, ApproachSpeed))
    assert feasible(problem, q) and required.speed < 1
    attainable = AttainableSpeed(posed.problem.robot, posed.problem.objective, posed.problem.requirements)
    drawn = [q for index in range(30) if (q := feasible_start(problem, index, 1)) is not None]
    clear = _at_speed(problem, 1e-3)
    speeds = [(attainable.reached(q) or 0.0, feasible(clear, q)) for q in drawn]
    assert max(speed for speed, _ in speeds) > 1
    assert 0.7 < max(speed for speed, apart in speeds if apart) < 1.02 * required.speed


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ({"robot": "tilthex_arm"}, "nothing bounds it"),
        ({"robot": "solo12", "frame": "base_link", "contact_pose": "free"}, "nothing bounds it"),
        ({"robot": "talos", "frame": "base_link", "contact_pose": "position"}, "the legs move the contact"),
        ({"robot": "solo12", "frame": "FL_LOWER_LEG", "contact_pose": "position"}, "the legs move the contact"),
    ],
)
def test_where_joints_with_limits_do_not_bring_the_contact_nothing_is_demanded(
    more: dict[str, object], words: str
) -> None:
    posed = prepare(make_settings({"normal": (0, 0, 1), "approach": True, **more}))
    assert not any(isinstance(c, ApproachSpeed) for c in posed.problem.constraints)
    assert any("speed of the approach is not required" in note and words in note for note in posed.problem.notes)
    assert AttainableSpeed(posed.problem.robot, posed.problem.objective, posed.problem.requirements).unknown


def test_a_kept_foot_does_not_count_as_a_leg_that_moves_the_hand() -> None:
    posed = prepared("talos", keep=("right_sole_link",))
    constraint = constraint_of(posed)
    at = Numeric(posed.problem.robot.model).at(posed.problem.given)
    assert constraint.evaluate(at)[0][0] == pytest.approx(
        constraint_of(prepared("talos", keep=())).evaluate(at)[0][0]
    )


def chain(folder: Path, axes: str, limits: Sequence[float]) -> str:
    """Write an arm of links along z; a velocity limit of zero stands for an unlimited joint."""
    turns, last = {"x": "1 0 0", "y": "0 1 0", "z": "0 0 1"}, len(axes)
    parts = [link("l0"), link("tip"), joint("end", f"l{last} tip", None, "0 0 0.3", "fixed", "")]
    for k, (axis, limit) in enumerate(zip(axes, limits, strict=True)):
        moved, at = MOVED.replace('velocity="5"', f'velocity="{limit}"'), f"0 0 {0.3 if k else 0}"
        parts += [link(f"l{k + 1}", 2, "0 0 0.15"), joint(f"j{k}", f"l{k} l{k + 1}", turns[axis], at, more=moved)]
    return str(write(folder, *parts))


@pytest.mark.parametrize(
    ("axes", "limits", "pose"),
    [
        # For a planar arm, the constraint rows perpendicular to the plane are zero.
        ("yyyy", [2, 2, 2, 2], "full"),
        # The huge velocity limits act like no limit.
        ("zyzyzyz", [2, 2, 2, 2, 2, 2, 1e6], "full"),
        ("zyzyzyz", [5e9, 5e9, 5e9, 5e9, 5e9, 5e9, 2], "full"),
        # Only the first joint has a limit, so the speed is unbounded at most postures.
        ("zyzyzyz", [2, 0, 0, 0, 0, 0, 0], "full"),
        # Five joints cannot fix the rotation of the tip, so the tip may turn.
        ("zyyyz", [2, 2, 2, 2, 2], "position"),
    ],
)
def test_unusual_arms_certify(tmp_path: Path, axes: str, limits: list[float], pose: str) -> None:
    path = chain(tmp_path, axes, limits)
    q = tuple([0.3, 0.6, 0.5, 0.4, 0.3, 0.4, 0.2][: len(axes)])
    values = {"robot": path, "frame": "tip", "normal": (-1, 0, 0), "q": q, "contact_pose": pose}
    posed = prepare(make_settings({**values, "speed": 0.2, "approach": True}))
    solution = solve(posed.problem, starts=3, jobs=1)
    assert solution.certificate.holds() and solution.certified_starts == 3
    attainable = AttainableSpeed(posed.problem.robot, posed.problem.objective, posed.problem.requirements)
    assert 0.2 - 1e-8 <= (attainable.reached(solution.q) or np.inf)


def test_joints_that_are_too_few_are_refused(tmp_path: Path) -> None:
    held = {"hold": tuple(f"joint{k}" for k in range(1, 8)), "robot": "xarm7", "normal": (0, 0, 1)}
    with pytest.raises(InputError, match="cannot move"):
        prepare(make_settings({**held, "approach": True}))
    posed = prepare(make_settings(held))
    attainable = AttainableSpeed(posed.problem.robot, posed.problem.objective, posed.problem.requirements)
    assert attainable.reached(posed.problem.given) == 0.0


def test_the_command(tmp_path: Path) -> None:
    words = ("optimize", "ur5", "--normal", 0, 0, 1, "--speed", 0.8, "--approach", "--starts", 2, "--no-codegen")
    done = succeed(*words, "--out", "out", cwd=tmp_path)
    document = json.loads((tmp_path / "out" / "result.json").read_text())
    speed = document["optimal"]["attainable_speed"]
    assert speed >= 0.8 * (1 - 1e-6)
    assert f"{speed:.4g}  m/s" in done.stdout
    assert "approach at 0.8 m/s within the velocity limits of the joints" in document["constraints"]
    succeed("optimize", tmp_path / "out" / "problem.toml", "--out", "again", cwd=tmp_path)
    still = run("optimize", "ur5", "--normal", 0, 0, 1, "--speed", 0, "--approach", cwd=tmp_path)
    refused(still, 1, "--approach", "--speed")
