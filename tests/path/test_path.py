"""Paths on the constraints: around a disc, on a curve of two components, by sampling, and why no path exists."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from impact_posture.dynamics.numeric import Numeric
from impact_posture.dynamics.tree import Tree
from impact_posture.errors import InputError
from impact_posture.impact.impact_contact import ImpactContact, point_on
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.path import posture_path as module
from impact_posture.path.path_search import connect, shortened
from impact_posture.path.path_space import CHECK_DISTANCE, PathSpace
from impact_posture.path.posture_path import posture_path
from impact_posture.posture.constraints.constraint import ExpressionConstraint
from impact_posture.posture.constraints.requirements import Requirements
from impact_posture.posture.formulation.build_problem import build_problem
from impact_posture.posture.formulation.problem_file import prepare
from impact_posture.posture.manifold.feasible_start import feasible_start, random_posture
from impact_posture.posture.program.constrained_problem import ConstrainedProblem, equality_jacobian
from impact_posture.posture.search.multistart import PostureSolution, solve
from impact_posture.system.arrays import Array
from tests.support.arms import TIP, Z, arm
from tests.support.helpers import rng, robot
from tests.support.settings import make_settings


class OutsideDisc(ExpressionConstraint):
    """Constraint that keeps a frame of a planar arm outside a disc: ``|p(q) − c|² ≥ r²``."""

    def __init__(self, problem: ConstrainedProblem, frame: str, center: Array, radius: float) -> None:
        self.name, self.parameters = f"disc at {frame}", np.zeros(0)
        self.point, self.center = point_on(problem.robot, frame), center
        self.lower, self.upper = np.array([radius**2]), np.array([np.inf])

    def symbolic(self, tree: Tree, parameters: ca.SX) -> ca.SX:
        return ca.sumsqr(tree.position(self.point)[:2] - self.center)

    def evaluate(self, model: Numeric) -> tuple[Array, Array]:
        away = model.placement(self.point).translation[:2] - self.center
        return np.array([away @ away]), 2 * away[None] @ model.jacobian(self.point)[:2]


def planar(rods: list[float], joints: list[float]) -> ConstrainedProblem:
    """Return the problem of a planar arm with a fixed tip position."""
    loaded = arm([Z] * len(rods), joints, floating=False, rods=[(length, 0, 0) for length in rods])
    objective = WorstCaseObjective(loaded, ImpactContact(TIP, (0.6, 0.8, 0.0)))
    return build_problem(loaded, objective, loaded.posture(), Requirements(contact_pose="position"))


def with_disc(problem: ConstrainedProblem, frame: str, center: Array, radius: float) -> ConstrainedProblem:
    disc = OutsideDisc(problem, frame, center, radius)
    rows = (*problem.rows, (0,)) if problem.rows else ()
    return replace(problem, constraints=(*problem.constraints, disc), rows=rows)


def elbows(rods: list[float], q: Array) -> Array:
    """Return all joints and the tip of a planar arm, computed independently, shape (n + 1, 2)."""
    angles = np.cumsum(q)
    steps = np.array(rods)[:, None] * np.column_stack([np.cos(angles), np.sin(angles)])
    return np.vstack([np.zeros(2), np.cumsum(steps, axis=0)])


def solution_of(problem: ConstrainedProblem, start: Array, end: Array) -> PostureSolution:
    """Return a solution without running a search."""
    values = {name: None for name in PostureSolution.__dataclass_fields__}
    return PostureSolution(**values | {"problem": problem, "initial": start, "q": end, "optima": ()})  # type: ignore[arg-type]


def dense(problem: ConstrainedProblem, postures: list[Array], parts: int = 5) -> list[Array]:
    """Return a path with additional postures on the constraints between its postures."""
    space = PathSpace(problem)
    between = [pin.interpolate(space.model, a, b, k / parts) for a, b in pairwise(postures) for k in range(parts)]
    return [*(space.projector.project(np.asarray(q)).q for q in between), postures[-1]]


RODS = [0.4, 0.3, 0.3, 0.2]


@settings(max_examples=8, deadline=None, derandomize=True)
@given(seed=st.integers(0, 10**6), place=st.floats(0.3, 0.7), radius=st.floats(0.01, 0.08))
def test_a_walk_around_a_disc_holds_the_tip_and_stays_outside(seed: int, place: float, radius: float) -> None:
    problem = planar(RODS, [0.4, 0.5, -0.9, 0.6])
    space, start = PathSpace(problem), problem.given
    end = space.projector.project(start + 0.5 * rng("disc", seed).normal(size=4)).q
    straight = space.walk(start, end)
    middle = elbows(RODS, straight[int(place * (len(straight) - 1))])[2]
    blocked = with_disc(problem, "link_2", middle, radius)
    space = PathSpace(blocked)
    ends_free = space.valid(start) and space.valid(end)
    path = connect(space, start, end, effort=1500).path if ends_free else None
    if path is None:
        return
    assert path[0] is start and path[-1] is end
    for q in dense(blocked, path):
        points = elbows(RODS, q)
        assert np.linalg.norm(points[-1] - elbows(RODS, start)[-1]) < 2e-6
        assert np.linalg.norm(points[2] - middle) > radius - 1e-6
        assert (np.abs(q) <= 5 + 1e-9).all()


def test_a_path_passes_a_disc_on_the_straight_walk() -> None:
    """The previous test would also pass if the disc never blocked the straight path."""
    problem = planar(RODS, [0.4, 0.5, -0.9, 0.6])
    space, start = PathSpace(problem), problem.given
    end = space.projector.project(start + np.array([0.9, -1.2, 0.5, 0.3])).q
    straight = space.walk(start, end)
    assert straight[-1] is end
    middle = elbows(RODS, straight[len(straight) // 2])[2]
    space = PathSpace(with_disc(problem, "link_2", middle, 0.02))
    assert not space.clear_path(straight)
    path = connect(space, start, end).path
    assert path is not None and path[-1] is end and space.clear_path(path)
    assert space.length(path) > 1.005 * space.length(straight)


def test_no_frame_moves_more_than_the_check_distance_between_two_checks() -> None:
    for name in ("panda", "tiago", "solo8", "tilthex_arm"):
        loaded = robot(name)
        frame = next(f.name for f in loaded.model.frames if f.parentJoint == loaded.model.njoints - 1)
        objective = WorstCaseObjective(loaded, ImpactContact(frame, (0, 0, 1)))
        requirements = Requirements(contact_pose="free", com_over_feet=False)
        problem = build_problem(loaded, objective, loaded.posture(), requirements)
        # Distances of frames are checked only if the problem has an inequality, so add a disc constraint.
        space = PathSpace(with_disc(problem, frame, np.full(2, 9.0), 0.1))
        data = loaded.model.createData()
        for seed in range(5):
            step = 0.3 * rng(name, seed).normal(size=loaded.nv)
            parts, before = space.checks(step), None
            for k in range(parts + 1):
                pin.framesForwardKinematics(
                    loaded.model, data, pin.integrate(loaded.model, loaded.posture(), step * k / parts)
                )
                now = np.array([frame.translation for frame in data.oMf])
                if before is not None:
                    assert np.linalg.norm(now - before, axis=1).max() <= CHECK_DISTANCE
                before = now


def test_no_frame_moves_more_than_the_check_distance_beside_a_disc() -> None:
    problem = planar(RODS, [0.4, 0.5, -0.9, 0.6])
    end = PathSpace(problem).projector.project(problem.given + np.array([0.9, -1.2, 0.5, 0.3])).q
    straight = PathSpace(problem).walk(problem.given, end)
    blocked = with_disc(problem, "link_2", elbows(RODS, straight[len(straight) // 2])[2], 0.02)
    checked: list[Array] = []

    class Recorded(PathSpace):
        def pulled(self, q: Array, step: Array | None = None) -> Array | None:
            pulled = super().pulled(q, step)
            checked.extend([] if pulled is None else [pulled])
            return pulled

    space = Recorded(blocked)
    path = connect(space, problem.given, end).path
    assert path is not None
    count = 0
    for a, b in pairwise(path):
        checked.clear()
        assert space.clear(a, b)
        points = [elbows(RODS, q) for q in (a, *checked, b)]
        assert max(np.linalg.norm(p - q, axis=1).max() for p, q in pairwise(points)) <= CHECK_DISTANCE
        count += len(checked)
    assert count > len(path)


# The crank can turn fully (0.1 + 0.5 < 0.4 + 0.4), so the two assemblies of the linkage are separate components.
CRANK = [0.1, 0.4, 0.4]


def crank() -> tuple[ConstrainedProblem, Array, Array]:
    """Return the linkage with its tip at (0.5, 0), and one posture of each component."""
    up = assembled(0.3, 1.0)
    return planar(CRANK, up.tolist()), up, assembled(2.0, -1.0)


def assembled(crank_angle: float, side: float) -> Array:
    """Return the posture for a crank angle, by the law of cosines; the sign ``side`` selects the elbow."""
    pivot = 0.1 * np.array([np.cos(crank_angle), np.sin(crank_angle)])
    diagonal = np.array([0.5, 0.0]) - pivot
    size = float(np.linalg.norm(diagonal))
    first = np.arctan2(diagonal[1], diagonal[0]) + side * np.arccos(size / 0.8)
    elbow = pivot + 0.4 * np.array([np.cos(first), np.sin(first)])
    second = np.arctan2(*(np.array([0.5, 0.0]) - elbow)[::-1])
    turns = [crank_angle, first - crank_angle, second - first]
    return np.array([turns[0], *((np.array(turns[1:]) + np.pi) % (2 * np.pi) - np.pi)])


def test_without_a_path_the_best_posture_of_the_component_is_reached() -> None:
    problem, up, down = crank()
    path = posture_path(solution_of(problem, up, down), effort=1500)
    assert not path.found
    proof = "exists at this contact pose (the optimum is on another component of the self-motion)"
    assert path.reason == f"no path to the optimum {proof}; the path ends at the best posture that was reached"
    value = problem.objective.value
    component = [assembled(angle, 1.0) for angle in np.linspace(-4.5, 4.5, 2000)]
    least = min(value(q) for q in component)
    assert least * (1 - 1e-6) <= path.objective <= (1 + 1e-5) * least
    assert path.objective < 0.95 * value(up)
    ends = elbows(CRANK, path.q[-1])
    assert np.linalg.norm(ends[-1] - [0.5, 0]) < 1e-6


def test_a_path_takes_the_open_side_and_two_cuts_prove_that_none_exists() -> None:
    problem, up, _ = crank()
    target = assembled(2.6, 1.0)
    for cuts, cut in (((1.2,), False), ((1.2, 4.5), True)):
        blocked = problem
        for angle in cuts:
            blocked = with_disc(blocked, "link_2", elbows(CRANK, assembled(angle, 1.0))[2], 0.005)
        path = posture_path(solution_of(blocked, up, target))
        assert path.found is not cut and ("cut the self-motion in both directions" in path.reason) is cut
        if not cut:
            # The path goes from 0.3 rad down to 2.6 − 2π rad, on the side without the disc.
            assert path.q[-1][0] - up[0] == pytest.approx(2.3 - 2 * np.pi, abs=1e-6) and path.max_violation < 1e-8


def test_an_optimum_on_another_component_cannot_be_reached() -> None:
    problem = prepare(make_settings({"robot": "xarm7", "normal": (0, 0, 1), "collision": False})).problem
    solution = solve(problem, starts=8, jobs=1)
    path = posture_path(solution)
    assert not path.found and "(the optimum is on another component of the self-motion)" in path.reason
    assert path.objective < problem.objective.value(solution.initial) and path.max_violation < 1e-8
    # A walk along the null space of Pinocchio's Jacobian does not approach the optimum in either direction.
    space, known = PathSpace(problem), list[Array]()
    for side in (1.0, -1.0):
        q, ahead = solution.initial, np.zeros(problem.robot.nv)
        for _ in range(400):
            tangent = np.linalg.svd(equality_jacobian(problem, space.projector.numeric.at(q)))[2][-1]
            ahead = tangent * (side if not ahead.any() else np.sign(tangent @ ahead))
            moved = space.pulled(q, 0.05 * ahead)
            if moved is None or space.distance(moved, q) < 0.02:
                break
            known.append(q := moved)
    assert min(np.linalg.norm(np.exp(1j * solution.q) - np.exp(1j * q)) for q in known) > 0.3
    assert min(np.linalg.norm(np.exp(1j * path.q[-1]) - np.exp(1j * q)) for q in known) < 0.05


def test_a_start_that_violates_a_constraint_names_it() -> None:
    problem, up, _ = crank()
    blocked = with_disc(problem, "link_2", elbows(CRANK, up)[2], 0.05)
    path = posture_path(solution_of(blocked, up, up))
    assert not path.found and path.reason == "the start violates: disc at link_2"
    assert len(path.t) == 1 and path.duration == 0


def test_a_start_that_is_the_optimum_needs_no_motion() -> None:
    problem, up, _ = crank()
    path = posture_path(solution_of(problem, up, up))
    assert path.found and not path.reason and path.length == 0 and len(path.q) == 1


def test_sampling_finds_a_path_and_depends_only_on_the_seed() -> None:
    problem = planar(RODS, [0.4, 0.5, -0.9, 0.6])
    space, start = PathSpace(problem), problem.given
    end = space.projector.project(start + np.array([-1.2, 0.3, 1.8, 0.5])).q
    middle = elbows(RODS, space.walk(start, end)[15])[2]
    space = PathSpace(with_disc(problem, "link_2", middle, 0.03))
    connections = [connect(space, start, end, seed) for seed in (2, 2, 6)]
    path, again, other = (connection.path for connection in connections)
    assert path is not None and again is not None and other is not None and connections[0].method == "sampling"
    assert np.array_equal(path, again) and not (len(path) == len(other) and np.array_equal(path, other))
    assert path[0] is start and path[-1] is end and space.clear_path(path)
    for q in dense(space.problem, path, 3):
        points = elbows(RODS, q)
        assert np.linalg.norm(points[-1] - elbows(RODS, start)[-1]) < 1e-6
        assert np.linalg.norm(points[2] - middle) > 0.03 - 1e-6
    short = shortened(space, path)
    assert space.length(short) < space.length(path) and space.clear_path(short)
    assert short[0] is start and short[-1] is end


def test_sampling_ends_without_a_path() -> None:
    problem, up, down = crank()
    connection = connect(PathSpace(problem), up, down, effort=1000)
    assert connection.path is None and 1 < len(connection.reached) <= 2100


@pytest.mark.parametrize("name", ["tilthex_arm", "solo8", "g1"])
def test_random_postures_of_robots_are_reached_on_the_constraints(name: str) -> None:
    """The robots have floating bases; for g1, the constraint rows of the two feet are redundant."""
    frame = robot(name).spec.contact.frame
    problem = prepare(make_settings({"robot": name, "normal": (-1, 0, 0), "frame": frame})).problem
    space = PathSpace(problem)
    start = feasible_start(problem, 0, 0)
    assert start is not None
    generator = rng("reach", name)
    for _ in range(2):
        end = space.projector.project(random_posture(problem, space.projector.chart, generator, problem.given)).q
        if not space.valid(end):
            continue
        walk = space.walk(start, end)
        assert all(space.valid(q) for q in walk)
        assert space.distance(walk[-1], end) < space.distance(start, end)


def test_the_optimum_of_a_solved_problem_is_reached() -> None:
    problem = planar(RODS, [0.4, 0.5, -0.9, 0.6])
    solution = solve(problem, starts=4, jobs=1)
    path = posture_path(solution)
    assert path.found and path.max_violation < 1e-8
    assert problem.objective.value(path.q[-1]) == pytest.approx(solution.optima[0].objective, rel=1e-6)
    assert path.objectives[0] == pytest.approx(problem.objective.value(solution.initial))


def test_a_missing_package_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "find_spec", lambda _: None)
    problem, up, _ = crank()
    with pytest.raises(InputError) as caught:
        posture_path(solution_of(problem, up, up))
    line = "the extra 'path': toppra, which times a motion, is not installed; pip install 'impact-posture[path]'"
    assert caught.value.line == line
