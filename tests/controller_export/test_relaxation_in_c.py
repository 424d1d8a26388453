"""The relaxations in C and in Python agree, and a separate certificate shows that they are lexicographic optima."""

from __future__ import annotations

import functools
import itertools
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
import scipy.optimize
from hypothesis import given
from hypothesis import strategies as st

from tests.support.helpers import rng
from tests.support.relaxation_in_c import (
    BUDGET,
    COUNTS,
    INFEASIBLE,
    SOLVED,
    UNSOLVED,
    Relaxation,
    missed,
    stationarity,
    violations,
)
from tests.support.relaxed_ticks import RelaxedTick, recording
from tests.tsid.test_tsid_never_fails import DT, bracing

ROBOTS = [("tilthex_arm", "strict"), ("kinova", "arm"), ("solo8", "legged"), ("talos", "legged")]


@pytest.fixture(scope="module")
def relaxation(tmp_path_factory: pytest.TempPathFactory) -> Relaxation:
    return Relaxation(tmp_path_factory.mktemp("relaxation"), "-fsanitize=undefined", "-fno-sanitize-recover=all")


@functools.cache
def ticks_of(name: str, kind: str) -> list[RelaxedTick]:
    """Return the relaxed ticks of a controller at random states, far from the posture and too fast."""
    controller, _ = bracing(name, kind)
    robot, generator = controller.robot, rng(name, "relaxed in C")
    with recording() as ticks:
        for k in itertools.takewhile(lambda k: k < 9 or len(ticks) < 4, range(60)):
            far, fast = (0.0, 0.1, 1.0)[min(k // 3, 2)], (3.0, 10.0, 30.0)[k % 3]
            q = np.array(pin.integrate(robot.model, robot.posture(), far * generator.normal(size=robot.nv)))
            force = None if kind == "legged" else 100.0 * generator.normal(size=6)
            controller.tick(k * DT, q, fast * generator.normal(size=robot.nv), force)
    assert len(ticks) >= 4
    return ticks


def squares(tick: RelaxedTick, z: np.ndarray) -> list[float]:
    """Return for each level below level 0 the norm of its violations."""
    over = violations(tick, z)[0]
    return [float(np.linalg.norm(over[tick.level == k])) for k in range(1, int(tick.level.max()) + 1)]


@pytest.mark.parametrize(("name", "kind"), ROBOTS)
def test_robots_in_hard_states(relaxation: Relaxation, name: str, kind: str) -> None:
    relaxation.forget()
    for tick in ticks_of(name, kind):
        answer = relaxation.solve(tick)
        assert answer.code == SOLVED
        for z in (answer.z, tick.z):
            assert missed(tick, z)[0] <= 1e-9
            *levels, cost = stationarity(tick, z)
            assert max(levels) <= 1e-7
            # The cost of a quadruped has a nearly flat direction, so the solver adds a proximal term.
            assert cost <= (1e-5 if name == "solo8" else 1e-7)
        terms = float(np.max(np.abs(tick.A) @ np.abs(tick.z)))
        assert np.allclose(squares(tick, answer.z), squares(tick, tick.z), rtol=0, atol=1e-9 * terms)


@pytest.mark.parametrize(("name", "kind"), ROBOTS[:3])
def test_the_active_rows_of_the_last_tick_change_no_answer(relaxation: Relaxation, name: str, kind: str) -> None:
    tick, other = ticks_of(name, kind)[:2]
    relaxation.forget()
    cold = relaxation.solve(tick)
    again = relaxation.solve(tick)
    relaxation.solve(other)
    back = relaxation.solve(tick)
    if name != "solo8":
        assert again.iterations < cold.iterations
    for answer in (again, back):
        assert np.allclose(squares(tick, answer.z), squares(tick, cold.z), rtol=1e-7, atol=1e-6)


@given(st.integers(0, 2**32 - 1))
def test_random_stacks(relaxation: Relaxation, seed: int) -> None:
    """The problems have dependent, contradictory and zero rows, fixed variables, and numbers up to 1e6."""
    g = np.random.default_rng(seed)
    n = int(g.integers(2, 9))
    sizes = [int(g.integers(0, 4)), int(g.integers(0, 6)), *g.integers(1, 5, size=int(g.integers(1, 4)))]
    A = g.normal(size=(sum(sizes), n))
    level = np.concatenate([np.ones(n), np.repeat([0, *range(len(sizes) - 1)], sizes)]).astype(np.intc)
    # Level 0 contains equations that a random point satisfies, and inequalities that the point satisfies strictly.
    inside = g.normal(size=n)
    values = A @ inside
    lower, upper = (
        np.concatenate([np.full(n, -np.inf), values - 1.0]),
        np.concatenate([np.full(n, np.inf), values + 1]),
    )
    equations = slice(n, n + min(sizes[0], n - 1))
    lower[equations] = upper[equations] = values[: min(sizes[0], n - 1)]
    scale = 10.0 ** g.uniform(-1, 6)
    bounded = g.random(n) < 0.6
    center = scale * g.normal(size=n)
    lower[:n][bounded], upper[:n][bounded] = (center - g.random(n))[bounded], (center + g.random(n))[bounded]
    own = np.flatnonzero(level[n:] >= 2)
    lower[n + own] = upper[n + own] = scale * g.normal(size=own.size)
    for row in own:
        kind = g.integers(0, 6)
        if kind == 0 and sum(sizes) > 1:
            A[row] = A[int(g.integers(0, sum(sizes)))]
        elif kind == 1:
            A[row] = 0.0
    root = g.normal(size=(n, n)) * 10.0 ** g.uniform(-2, 1, size=n)
    H = root @ root.T + 1e-6 * np.eye(n)
    tick = RelaxedTick(H, g.normal(size=n), A, lower, upper, level, np.ones(n), np.zeros(n))
    relaxation.forget()
    answer = relaxation.solve(tick)
    assert answer.code == SOLVED
    assert missed(tick, answer.z)[0] <= COUNTS
    assert max(stationarity(tick, answer.z)[:-1]) <= 1e-6


def small(**changes: np.ndarray) -> RelaxedTick:
    """Return a problem of two variables: level 0 bounds the first by 1, and a lower level demands z = (2, 3)."""
    inf = np.inf
    tick = RelaxedTick(
        H=np.eye(2), g=np.zeros(2), A=np.array([[1.0, 0.0], [1.0, 0.0], [0.0, 1.0]]),
        lower=np.array([-inf, -inf, -inf, 2.0, 3.0]), upper=np.array([inf, inf, 1.0, 2.0, 3.0]),
        level=np.array([1, 1, 0, 2, 2]), unit=np.ones(2), z=np.zeros(2),
    )  # fmt: skip
    return replace(tick, **changes)


def test_a_level_that_a_bound_stops(relaxation: Relaxation) -> None:
    assert np.allclose(relaxation.solve(small()).z, [1.0, 3.0], atol=1e-12)


def test_the_cost_decides_in_the_free_directions(relaxation: Relaxation) -> None:
    """SciPy solves the same problem: an equation, bounds, and an arbitrary convex cost."""
    g = rng("cost")
    for _ in range(5):
        root, row = g.normal(size=(3, 3)), g.normal(size=3)
        bounds = np.concatenate([np.full(3, 0.5), [1.0]])
        tick = RelaxedTick(root @ root.T, g.normal(size=3), row[None], np.append(-bounds[:3], 1.0), bounds,
                           np.array([1, 1, 1, 2]), np.ones(3), np.zeros(3))  # fmt: skip
        relaxation.forget()
        z = relaxation.solve(tick).z
        best = scipy.optimize.minimize(
            lambda x, t=tick: 0.5 * x @ t.H @ x + t.g @ x, np.zeros(3), jac=lambda x, t=tick: t.H @ x + t.g,
            bounds=[(-0.5, 0.5)] * 3, constraints={"type": "eq", "fun": lambda x, r=row: r @ x - 1.0},
            options={"ftol": 1e-14},
        )  # fmt: skip
        if best.success:
            assert np.allclose(z, best.x, atol=1e-5)


def test_without_levels_or_rows(relaxation: Relaxation) -> None:
    """The bound z ≥ 1 can be on level 0 or on a lower level.  In both cases, the minimizer of z²/2 is z = 1."""
    for level in (0, 1):
        one = np.ones(1)
        tick = RelaxedTick(np.eye(1), 0 * one, np.zeros((0, 1)), one, np.inf * one, np.array([level]), one, one)
        answer = relaxation.solve(tick)
        assert answer.code == SOLVED and answer.z[0] == pytest.approx(1.0, abs=1e-9)


def test_a_budget_is_kept(relaxation: Relaxation) -> None:
    """With too few iterations, the result is an error code.  The next solve starts from the last active rows."""
    tick = ticks_of("talos", "legged")[-1]
    relaxation.forget()
    needed = relaxation.solve(tick).iterations
    assert needed > 50
    relaxation.forget()
    for budget in (1, 2, 10, needed // 2):
        answer = relaxation.solve(tick, budget)
        assert answer.code == BUDGET and answer.iterations <= budget
    assert relaxation.solve(tick).iterations < needed


def test_problems_without_an_answer_have_a_code(relaxation: Relaxation) -> None:
    relaxation.forget()
    bounds = np.array([-np.inf, -np.inf, 5.0, 2.0, 3.0]), np.array([np.inf, np.inf, 6.0, 2.0, 3.0])
    equation = small(lower=bounds[0], upper=bounds[1], level=np.array([1, 1, 0, 0, 2]))
    assert relaxation.solve(equation).code in (INFEASIBLE, UNSOLVED)
    inequality = small(
        lower=bounds[0], upper=np.array([np.inf, np.inf, 6.0, 4.0, 3.0]), level=np.array([1, 1, 0, 0, 2])
    )
    assert relaxation.solve(inequality).code == INFEASIBLE
    relaxation.forget()
    assert relaxation.solve(small(), budget=1).code == BUDGET
    for name, value in (("A", np.nan), ("H", np.nan), ("g", np.inf), ("A", 1e300)):
        tick = small()
        getattr(tick, name).reshape(-1)[0] = value
        relaxation.forget()
        answer = relaxation.solve(tick)
        assert answer.code <= 0 or np.isfinite(answer.z).all()
