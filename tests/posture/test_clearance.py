"""Separating planes: their rows as numbers and expressions, their derivatives, and the postures that they allow."""

from __future__ import annotations

import gc
from dataclasses import replace
from itertools import product

import casadi as ca
import coal
import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from impact_posture.collision.swept_hull import SweptHull
from impact_posture.config.obstacle import Obstacle
from impact_posture.config.problem_settings import ProblemSettings
from impact_posture.config.table_validation import validate
from impact_posture.dynamics.chart import Chart
from impact_posture.dynamics.numeric import Numeric
from impact_posture.dynamics.tree import PointOnLink, Tree
from impact_posture.errors import Infeasible, InputError
from impact_posture.impact.impact_contact import point_on
from impact_posture.impact.worst_case.worst_normal import cone_axes
from impact_posture.posture.analysis.verdict_conditions import Circumstances, _surface
from impact_posture.posture.constraints.clearance import Clearance, SpreadClearance
from impact_posture.posture.constraints.pair_distances import PairDistances
from impact_posture.posture.constraints.separating_plane import EQUATIONS, ConvexBody, SeparatingPlane
from impact_posture.posture.formulation.build_problem import retarget
from impact_posture.posture.formulation.problem_file import prepare
from impact_posture.posture.manifold.feasible_start import Projector, random_posture
from impact_posture.posture.program.constrained_problem import ConstrainedProblem
from impact_posture.posture.program.posture_nlp import build_nlp
from impact_posture.posture.search.conflicts import ElasticProgram, find_conflicts
from impact_posture.posture.search.growing_search import feasible
from impact_posture.posture.search.multistart import solve
from impact_posture.robot.robot import Robot
from impact_posture.robot.robot_loader import load_robot
from tests.support.pinocchio_values import central_gradient

BOX = np.array(list(product((-0.04, 0.05), (-0.03, 0.06), (-0.05, 0.07))))
ROBOTS = ("tilthex_arm", "talos", "panda", "kinova")
KINDS = ("pair", "world", "half-space", "in the frame", "with a point")


def _separator(robot: Robot, kind: str) -> SeparatingPlane:
    last, first = robot.model.njoints - 1, 1
    a = ConvexBody.of_link(SweptHull("a", "a", last, BOX, 0.01))
    point = PointOnLink(first, np.array([0.1, -0.2, 0.05]), pin.exp3(np.array([0.3, 0.2, -0.5])))
    normal = np.array([0.6, 0.0, 0.8])
    b = {
        "pair": ConvexBody.of_link(SweptHull("b", "b", first, 1.5 * BOX, 0.02)),
        "world": ConvexBody.of_link(SweptHull("b", "b", 0, 2 * BOX + 0.1, 0.0)),
        "half-space": ConvexBody("b", None, PointOnLink(0, np.array([0.0, 0.1, -0.3]), np.eye(3)), normal=normal),
        "in the frame": ConvexBody("b", None, point, normal=normal, offset=-0.1),
        "with a point": ConvexBody("b", SweptHull("b", "b", first, BOX, 0.005), point, turns=False),
    }[kind]
    return SeparatingPlane(a, b, 0.002)


def _random(robot: Robot, rng: np.random.Generator) -> np.ndarray:
    return pin.integrate(robot.model, pin.neutral(robot.model), rng.normal(size=robot.nv) * 0.8)


@pytest.mark.parametrize("name", ROBOTS)
def test_relative_placements_agree_with_pinocchio(name: str) -> None:
    robot, rng = load_robot(name), np.random.default_rng(5)
    q = ca.SX.sym("q", robot.nq)
    tree, numeric = Tree(robot.model, q), Numeric(robot.model)
    pairs = [tuple(rng.integers(0, robot.model.njoints, 2)) for _ in range(6)] + [(0, robot.model.njoints - 1)]
    expressions = [part for pair in pairs for part in tree.relative(int(pair[0]), int(pair[1]))]
    function = ca.Function("relative", [q], expressions)
    posture = _random(robot, rng)
    numeric.at(posture)
    placements = function(posture)
    for k, (base, joint) in enumerate(pairs):
        expected = numeric.data.oMi[int(base)].actInv(numeric.data.oMi[int(joint)])
        assert np.allclose(np.array(placements[2 * k]), expected.rotation, atol=1e-12)
        assert np.allclose(np.array(placements[2 * k + 1]).ravel(), expected.translation, atol=1e-12)


@pytest.mark.parametrize("name", ROBOTS)
def test_guess_satisfies_the_rows_where_bodies_are_apart(name: str) -> None:
    robot, rng = load_robot(name), np.random.default_rng(1)
    numeric, chart = Numeric(robot.model), Chart(robot.model)
    x = ca.SX.sym("x", chart.nx)
    tree = Tree(robot.model, chart.configuration(x), x)
    apart = touching = 0
    for kind, _ in product(KINDS, range(6)):
        separator, q = _separator(robot, kind), _random(robot, rng)
        distance = separator.distance(numeric.at(q))[0]
        corners = separator.corners(numeric)
        lifted = separator.lift(tree, "", ca.SX(separator.b.plane))
        sides = separator.sides(lifted.variables, corners)
        rows = ca.Function("rows", [x, lifted.variables], [ca.vertcat(lifted.rows, sides)])
        guess = separator.guess(numeric).values.copy()
        assert len(guess) == separator.count
        # Set the slack to zero.
        guess[-1] = 0.0
        value = np.array(rows(chart.to_x(q), guess)).ravel()
        lower, upper = (np.append(np.zeros(EQUATIONS), side) for side in separator.bounds(corners))
        outside = np.maximum(lower - value, value - upper)
        # The guessed normal is 2 % too short, so the rows may report a violation for gaps of a few millimeters.
        if abs(distance) > 0.03:
            assert (outside.max() < 1e-9) == (distance > 0)
            apart, touching = apart + (distance > 0), touching + (distance < 0)
    assert apart and touching


@pytest.mark.parametrize("name", ROBOTS)
@pytest.mark.parametrize("kind", KINDS)
def test_linearization_is_the_derivative_of_the_rows(name: str, kind: str) -> None:
    """Compare with finite differences of the heights of corners above a plane."""
    robot, rng = load_robot(name), np.random.default_rng(2)
    separator, numeric = _separator(robot, kind), Numeric(robot.model)
    q, n = _random(robot, rng), rng.normal(size=3)
    # Put the plane far on the wrong side of both bodies, so that every corner has a row.
    height = 50.0
    rows = separator.linearize_at(numeric.at(q), n, height)
    assert len(rows.names) == len(BOX) + (0 if separator.known else 1)

    slopes = central_gradient(lambda p: separator.linearize_at(numeric.at(p), n, height).value, robot.model, q, 1e-4)
    assert np.allclose(slopes, rows.posture, atol=1e-7)
    for k, step in enumerate([] if separator.known else 1e-6 * np.eye(4)):
        ahead, behind = (separator.linearize_at(numeric.at(q), n + d[:3], height + d[3]) for d in (step, -step))
        assert np.allclose((ahead.value - behind.value) / 2e-6, rows.auxiliary[:, k], atol=1e-6)


@pytest.mark.parametrize("name", ["tilthex_arm", "panda"])
def test_distances_and_their_gradient(name: str) -> None:
    robot, rng = load_robot(name), np.random.default_rng(4)
    constraint = Clearance("c", [_separator(robot, kind) for kind in KINDS], "words")
    numeric, smooth = Numeric(robot.model), 0
    for _ in range(40):
        q = _random(robot, rng)
        jacobian = constraint.evaluate(numeric.at(q))[1]
        slopes = central_gradient(lambda p: constraint.evaluate(numeric.at(p))[0], robot.model, q, 1e-6)
        # At most postures distances are differentiable, for example the distance of two edges that are not parallel.
        for row in np.flatnonzero(np.abs(jacobian).max(axis=1) > 0):
            smooth += bool(np.allclose(slopes[row], jacobian[row], atol=1e-5))
    assert smooth > 10


def test_a_pair_that_stays_violated_has_rows_for_all_corners_in_the_end() -> None:
    """Without these rows, a separating plane could cut corners unnoticed, and the run would seem infeasible."""
    robot, rng = load_robot("tilthex_arm"), np.random.default_rng(5)
    constraint = Clearance("c", [_separator(robot, kind) for kind in KINDS], "words")
    numeric, seen = Numeric(robot.model), set[bool]()
    for _ in range(40):
        values = constraint.value(numeric.at(_random(robot, rng)))
        last, now = constraint, constraint.grown(numeric)
        while now is not last:
            last, now = now, now.grown(numeric)
        assert set(now.active) == set(np.flatnonzero(values < 0))
        for k, corners in now.active.items():
            one = now._pairs[k]
            seen.add(one.known)
            whole = set(range(len(one._x))), set(range(len(one._y)))
            assert one.known or (corners.a, corners.b) == whole
    assert seen == {False, True}


def test_a_pair_that_slack_lets_off_gets_no_more_corners() -> None:
    """If a slack permits the penetration, more rows do not help.  Without slack, the program still lacks rows."""
    robot, rng = load_robot("tilthex_arm"), np.random.default_rng(5)
    constraint = Clearance("c", [_separator(robot, kind) for kind in KINDS], "words")
    numeric, seen = Numeric(robot.model), 0
    for _ in range(100):
        q = _random(robot, rng)
        first = constraint.grown(numeric.at(q))
        numeric.at(pin.integrate(robot.model, q, 0.3 * rng.normal(size=robot.nv)))
        # Each slack in the guess equals the violation of its pair, as after a run in which penetration improves the
        # objective.
        let_off = first.guess(numeric).values
        strict = let_off.copy()
        strict[[int(own[-1]) for own in first._unknowns(np.arange(strict.size)).values()]] = 0.0
        depths = np.maximum(0.0, -constraint.value(numeric))[list(first.active)]
        assert first.slack(let_off) >= depths.max(initial=0.0) and first.slack(strict) == 0
        kept, more = first.grown(numeric, let_off).active, first.grown(numeric, strict).active
        assert all(kept[k] == corners for k, corners in first.active.items())
        assert more == first.grown(numeric).active
        seen += any(more[k] != corners for k, corners in first.active.items())
    assert seen > 5


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_bounds_on_distances_are_never_above_them(seed: int) -> None:
    """The distance of the bounding spheres is never larger than the distance of the bodies."""
    robot = load_robot("tilthex_arm")
    separators = [_separator(robot, kind) for kind in KINDS]
    constraint = Clearance("c", separators, "words")
    rng = np.random.default_rng(seed)
    numeric, q = Numeric(robot.model), _random(robot, rng)
    for size in (0.0, 1e-3, 0.03, 0.3, 1.0):
        # A distance computed at an earlier posture bounds the distances at later postures.
        q = pin.integrate(robot.model, q, size * rng.normal(size=robot.nv))
        values = constraint.evaluate(numeric.at(q))[0]
        exact = np.array([one.distance(numeric)[0] for one in separators])
        assert (values <= exact + 1e-9).all()
        assert ((values < 0) == (exact < 0)).all() and np.allclose(values[exact < 0], exact[exact < 0])


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_distances_do_not_depend_on_earlier_calls(seed: int) -> None:
    robot, rng = load_robot("tilthex_arm"), np.random.default_rng(seed)
    separators = [_separator(robot, kind) for kind in KINDS]
    known, numeric = PairDistances(separators), Numeric(robot.model)
    q = _random(robot, rng)
    for _ in range(3):
        q = pin.integrate(robot.model, q, 0.1 * rng.normal(size=robot.nv))
        exact = np.array([one.distance(numeric.at(q))[0] for one in separators])
        assert (known.bounds(numeric, range(5)) <= exact + 1e-9).all()
        for limit, pairs in product(rng.permutation([-0.1, 0.0, 0.05, 1.0]), (range(2), range(2, 5), range(5))):
            bounds_within, own = known.within(numeric, float(limit), pairs), exact[pairs.start : pairs.stop]
            assert (bounds_within <= own + 1e-9).all() and np.allclose(
                bounds_within[own < limit], own[own < limit], atol=1e-9
            )
            assert not (bounds_within[own >= limit] < limit - 1e-9).any()


def _problem(**changes: object) -> ProblemSettings:
    return ProblemSettings(robot="tilthex_arm", frame="ee", normal=(0.0, 0.0, 1.0), **changes)  # type: ignore[arg-type]


def test_a_body_in_the_way_of_the_optimum() -> None:
    """The unconstrained optimum passes through the obstacle; the constrained optimum touches it and certifies."""
    free = solve(prepare(_problem()).problem, starts=4, jobs=1, compile="never")
    model = free.problem.robot.model
    data = model.createData()
    pin.forwardKinematics(model, data, free.q)
    # The last link is fixed to the held contact frame, so the obstacle is placed at the link before it.
    shoulder = tuple(float(v) for v in data.oMi[model.njoints - 2].translation)
    blocked = prepare(_problem(obstacles=(Obstacle(name="ball", sphere=0.05, position=shoulder),))).problem
    assert not feasible(blocked, free.q)
    solution = solve(blocked, starts=8, jobs=1, compile="never")
    assert solution.certificate.holds()
    assert feasible(solution.problem, solution.q)
    touched = [active for active in solution.certificate.active if active.constraint.endswith("/ ball")]
    assert touched and all(active.multiplier > 0 for active in touched)
    objective = solution.problem.objective
    assert objective.value(free.q) < objective.value(solution.q)


@pytest.mark.parametrize("names", [("a", "a"), ("base_link[0]",), ("surface at ee",)])
def test_obstacles_with_the_name_of_another_body_are_refused(names: tuple[str, ...]) -> None:
    balls = tuple(Obstacle(name=name, sphere=0.01, position=(5.0, 0.0, 0.0)) for name in names)
    with pytest.raises(InputError, match="is the name of another body"):
        prepare(_problem(obstacles=balls))
    with pytest.raises(InputError, match="obstacles"):
        prepare(_problem(obstacles=balls, collision=False))


@pytest.mark.parametrize("name", ["  ", "x" * 100])
def test_an_obstacle_without_a_name_to_print_is_refused(name: str) -> None:
    with pytest.raises(InputError, match="name"):
        Obstacle(name=name, sphere=1.0)


def test_an_obstacle_at_the_contact_is_named() -> None:
    """If the obstacle contains the contact point, no posture avoids the collision."""
    robot = load_robot("tilthex_arm")
    numeric = Numeric(robot.model).at(robot.posture())
    tool = numeric.data.oMi[robot.model.njoints - 1].translation
    around = Obstacle(name="block", box=(0.1, 0.1, 0.1), position=tuple(float(v) for v in tool))
    with pytest.raises(Infeasible) as caught:
        solve(prepare(_problem(obstacles=(around,), contact_pose="full", base="fixed")).problem, jobs=1)
    assert "block" in str(caught.value)
    assert caught.value.exit_code == 3


@pytest.mark.long(but=("position-position2",))
@pytest.mark.usefixtures("few_tries")
@pytest.mark.parametrize(
    ("pose", "position"), [("full", None), ("full", (3.0, 0.0, 0.0)), ("position", (3.0, 0.0, 0.0))]
)
def test_a_turn_that_solves_a_conflict_is_the_hint(pose: str, position: tuple[float, ...] | None) -> None:
    """With a free orientation, the wrist of z1 can leave the floor.  A target out of reach remains a conflict."""
    # The floor touches the gripper below the origin of the frame, not at its tip.
    contact = {"robot": "z1", "normal": (0.0, 0.0, 1.0), "offset": (0.0, 0.0, 0.0)}
    settings = contact | {"contact_pose": pose, "target_position": position}
    problem = prepare(validate(ProblemSettings, settings, "options")).problem
    with pytest.raises(Infeasible) as caught:
        solve(problem, jobs=1)
    assert ("`contact_pose` position" in caught.value.hint) == (position is None)
    if position is None:
        turned = prepare(validate(ProblemSettings, settings | {"contact_pose": "position"}, "options")).problem
        assert solve(turned, starts=2, jobs=1).certificate.holds()


@pytest.mark.parametrize(
    ("name", "normal"), [("z1", (-1.0, 0.0, 0.0)), ("panda", (1.0, 0.0, 0.0)), ("kinova", (0.0, 1.0, 0.0))]
)
def test_a_surface_lies_where_the_link_of_the_contact_reaches(name: str, normal: tuple[float, float, float]) -> None:
    problem = prepare(validate(ProblemSettings, {"robot": name, "normal": normal}, "options")).problem
    around, contact, robot = problem.surroundings, problem.objective.contact, problem.robot
    assert around is not None
    point = point_on(robot, contact.frame, contact.offset)
    height = float(np.array(normal) @ Numeric(robot.model).at(problem.given).placement(point).translation)
    data = robot.model.createData()
    pin.forwardKinematics(robot.model, data, problem.given)
    own = [shape for shape in around.shapes.geometry.geometryObjects if shape.parentJoint == point.joint]

    def touched(above: float) -> bool:
        """Whether coal reports a collision of a link mesh with the half-space this far above the surface (m)."""
        half = coal.Halfspace(np.array(normal), height - around.depth(contact) + above)
        request = coal.CollisionRequest()
        at = [data.oMi[point.joint] * shape.placement for shape in own]
        return any(
            coal.collide(
                half, coal.Transform3s(), shape.geometry, coal.Transform3s(p.rotation, p.translation), request,
                coal.CollisionResult(),
            )
            for shape, p in zip(own, at, strict=True)
        )  # fmt: skip

    assert around.depth(contact) > 0
    assert not touched(-1e-6)
    # A swept hull is a few millimeters larger than the mesh that it contains.
    assert touched(0.015)


STRIKE = {"robot": "tilthex_arm", "normal": (-1, 0, 0), "speed": 0.3, "path": True, "strike": True}
LANDING = {
    "robot": "solo12", "contact": tuple(f"{leg}_FOOT:0,0,1" for leg in ("FL", "FR", "HL", "HR")), "support": (),
    "contact_pose": "position", "objective": "sticking", "speed": 1, "path": True, "strike": True,
}  # fmt: skip


def _touched(problem: ConstrainedProblem, q: np.ndarray, tilt: float, shift: float, width: float) -> bool:
    """Whether coal reports that a mesh of another link touches a surface, tilted to any of 16 sides and shifted."""
    around, model = problem.surroundings, problem.robot.model
    assert around is not None
    contacts, data = problem.objective.contacts, model.createData()
    points = [point_on(problem.robot, contact.frame, contact.offset) for contact in contacts]
    pin.forwardKinematics(model, data, q)
    # The tip turns with the last link, so the link may touch the surface too.
    struck = {point.joint for point in points}
    shapes = [shape for shape in around.shapes.geometry.geometryObjects if shape.parentJoint not in struck]
    for (contact, point), heading in product(zip(contacts, points, strict=True), np.arange(16) * np.pi / 8):
        n, home = np.array(contact.normal), (data.oMi[point.joint] * point.placement).translation
        center = home - around.depth(contact) * n
        across = cone_axes(n)[:, 1:] @ [np.cos(heading), np.sin(heading)]
        normal = np.cos(np.deg2rad(tilt)) * n + np.sin(np.deg2rad(tilt)) * across
        place = coal.Transform3s()
        solid = coal.Halfspace(normal, float(normal @ center) + shift)
        if np.isfinite(width):
            turn = pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), normal).matrix()
            place = coal.Transform3s(turn, center + (shift - width / 2) * normal)
            solid = coal.Box(width, width, width)
        for shape in shapes:
            at, request = data.oMi[shape.parentJoint] * shape.placement, coal.CollisionRequest()
            shape.geometry.computeLocalAABB()
            if normal @ (at.act(shape.geometry.aabb_center) - center) > shift + shape.geometry.aabb_radius:
                continue
            there = coal.Transform3s(at.rotation, at.translation)
            if coal.collide(solid, place, shape.geometry, there, request, coal.CollisionResult()):
                return True
    return False


@pytest.mark.parametrize(
    ("strike", "surface", "scale", "count"),
    [(STRIKE, "plane", 0.8, 60), (STRIKE, 0.4, 0.8, 60), (LANDING, "plane", 0.15, 20)],
)
def test_a_posture_that_keeps_the_spread_touches_no_tilted_surface(
    strike: dict, surface: str | float, scale: float, count: int
) -> None:
    problem = prepare(validate(ProblemSettings, {**strike, "surface": surface}, "options")).problem
    (spread,) = [c for c in problem.constraints if isinstance(c, SpreadClearance)]
    rng, numeric, kept, broken = np.random.default_rng(0), Numeric(problem.robot.model), 0, 0
    for _ in range(count):
        q = pin.integrate(problem.robot.model, problem.given, rng.normal(size=problem.robot.nv) * scale)
        clear = spread.value(numeric.at(q)).min() > 0
        touched = _touched(problem, q, 5.0, 0.005, np.inf if surface == "plane" else float(surface))
        assert not (clear and touched)
        kept, broken = kept + clear, broken + touched
    assert kept > 3 and broken > 3


def test_a_strike_without_room_for_the_spread_requires_half_of_it() -> None:
    problem = prepare(validate(ProblemSettings, STRIKE, "options")).problem
    plain = replace(problem, constraints=tuple(c for c in problem.constraints if not isinstance(c, SpreadClearance)))
    solution, other = solve(problem, starts=1, jobs=1), solve(plain, starts=1, jobs=1)
    tilt, shift = solution.problem.requirements.surface_spread
    assert (tilt, shift) == (2.5, 0.0025) and solution.certificate.holds()
    assert _touched(problem, other.q, tilt, shift, np.inf) and not _touched(problem, solution.q, tilt, shift, np.inf)
    (line,) = _surface(Circumstances(spread=(tilt, shift)))
    assert "tilted by more than 2.5° or shifted by more than 2.5 mm" in line.line


def test_an_elastic_program_serves_other_targets_and_is_freed() -> None:
    problem = prepare(validate(ProblemSettings, {"robot": "panda", "normal": (0, 0, 1)}, "test")).problem
    program = ElasticProgram(problem)
    for height in (1.4, -0.3, 1.5):
        kept, fresh = (
            find_conflicts(retarget(one.problem, (0.4, 0.1, height), None), program=one, beside=1e-3)
            for one in (program, ElasticProgram(problem))
        )
        assert bool(kept.conflicts) is bool(height > 1) and kept.conflicts.keys() == fresh.conflicts.keys()
        assert sum(kept.conflicts.values()) == pytest.approx(sum(fresh.conflicts.values()), rel=0.05)
    assert program.time_s > 0 and program.problem is not problem
    shared = [c._lifted for c in problem.constraints if isinstance(c, Clearance)]
    assert any(len(lifted) for lifted in shared)
    del program, kept, fresh
    gc.collect()
    assert not any(len(lifted) for lifted in shared)


@pytest.mark.parametrize("name", ["tilthex_arm", "panda", "solo12"])
def test_derivatives_of_a_grown_program_agree_with_casadi(name: str) -> None:
    asked = {"robot": name, "normal": (0.0, 0.0, 1.0), "contact_pose": "position"}
    problem = prepare(validate(ProblemSettings, asked, "options")).problem
    rng, projector = np.random.default_rng(3), Projector(problem)
    first = nlp = build_nlp(problem, compile="never")
    for _ in range(3):
        # Random postures add pairs and corners to the program, as the final postures of runs do.
        ends = [random_posture(problem, projector.chart, rng) for _ in range(3)]
        problem = problem.grown(ends)
        nlp = nlp.grown(problem, compile="never")
    assert nlp.solver.size1_in("lbg") > first.solver.size1_in("lbg") + 50
    symbols, _ = nlp.program.symbols(problem)
    plain = ca.nlpsol("plain", "ipopt", symbols, {"print_time": False, "ipopt.print_level": 0})
    numbers = [rng.normal(size=nlp.solver.get_function("nlp_hess_l").size1_in(k)) for k in range(4)]
    for function, count in (("nlp_jac_g", 2), ("nlp_hess_l", 4)):
        ours, theirs = (solver.get_function(function)(*numbers[:count]) for solver in (nlp.solver, plain))
        pairs = zip(ours, theirs, strict=True) if count == 2 else [(ours, theirs)]
        for one, other in pairs:
            np.testing.assert_allclose(ca.DM(one).full(), ca.DM(other).full(), rtol=1e-9, atol=1e-9)


def test_starts_lie_near_a_posture_that_is_clear() -> None:
    # In the given posture, the robot is far inside the wall; most starts near this posture end in collisions.
    posed = prepare(ProblemSettings(robot="xarm7", normal=(-1, 0, 0), holdable=False)).problem
    solution = solve(posed, starts=16, jobs=1, compile="never", finish_all=True)
    assert solution.certified_starts == 16


@pytest.mark.long(but=("9", "33"))
@pytest.mark.parametrize("seed", [1, 9, 33])
def test_the_way_past_a_wall_is_found_from_every_seed(seed: int) -> None:
    # Runs from few of the random postures reach postures without collisions.
    posed = prepare(ProblemSettings(robot="xarm7", normal=(-1, 0, 0))).problem
    assert not find_conflicts(posed, seed).conflicts


def test_no_slack_is_left_where_the_objective_falls_steeply() -> None:
    # With the initial penalty on the slack, every start would end 0.6 mm inside the clearance of the surface.
    urdf = "example-robot-data:ur_description/urdf/ur10_robot.urdf"
    posed = prepare(ProblemSettings(robot=urdf, frame="tool0", normal=(0, 0, 1))).problem
    solution = solve(posed, starts=4, jobs=1, compile="never", finish_all=True)
    assert solution.certified_starts == 4
