"""Solve the points of one case: a program that is built once, warm starts, and a certificate for each point."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any, NamedTuple, TypeVar

import numpy as np

from impact_posture.arrays import Array
from impact_posture.dynamics.numeric import Numeric
from impact_posture.errors import ImpactPostureError, Infeasible, InputError, SolverFailed
from impact_posture.impact.contact import point_on
from impact_posture.impact.resolved_impact import resolve
from impact_posture.posture.build_problem import retarget
from impact_posture.posture.certificate import Certificate, certify
from impact_posture.posture.nlp import PostureNLP, build_nlp
from impact_posture.posture.problem import PostureProblem
from impact_posture.posture.problem_settings import Prepared, prepare
from impact_posture.posture.solve import distinct, solve
from impact_posture.posture.starts import feasible_start
from impact_posture.robot.robot_loader import load_robot
from impact_posture.sweep.grid import Grid
from impact_posture.sweep.sweep_file import OFFSETS, Case, at_point

# Problems and programs that a process keeps.  Both are small beside the solver itself.
_TEMPLATES, _PROGRAMS = 64, 16
# Most rounds in which the program of a point grows.
_ROUNDS = 8
# An optimum is better than another if its objective is lower by this share.
_BETTER = 1e-4

_Value = TypeVar("_Value")


@dataclass(frozen=True, eq=False)
class PointResult:
    """The answer to one problem.

    Attributes:
        status: ``certified``, ``infeasible``, ``uncertified`` or ``undefined``.
        reason: Why there is no posture, in one line; ``None`` if there is.
        q: The posture, shape (nq,).
        objective: The objective at ``q``.
        quantities: H, G, V, S and E at ``q``, by name.
        stationarity: See :class:`~impact_posture.posture.certificate.Certificate`.
        violation: Largest violation of a constraint.
        optima: Number of distinct optima that the runs ended at.
        runs: Number of runs of the solver.
    """

    status: str
    reason: str | None = None
    q: Array | None = None
    objective: float | None = None
    quantities: Mapping[str, float | None] = field(default_factory=dict)
    stationarity: float | None = None
    violation: float | None = None
    optima: int = 0
    runs: int = 0


class CaseSolver:
    """The robot, problems and programs of a case, which a process keeps from shard to shard.

    Args:
        case: The case.

    Attributes:
        solver_s: Processor time within IPOPT and the functions that it calls, s.
        robot: The robot.

    Raises:
        ImpactPostureError: A setting is wrong.
    """

    def __init__(self, case: Case) -> None:
        self._case, self.solver_s = case, 0.0
        self._loaded = load_robot(case.settings.robot, case.settings)
        self.template = lru_cache(_TEMPLATES)(self._template)
        self._programs: OrderedDict[str, PostureNLP] = OrderedDict()
        self._known: OrderedDict[tuple[Any, ...], Prepared] = OrderedDict()
        self.robot = self.template(*self.normal_and_speed({})).impact.robot

    def normal_and_speed(self, values: Mapping[str, Any]) -> tuple[Any, float]:
        """Return the normal and the speed at values of the grid, which choose the template."""
        settings = self._case.settings
        return values.get("normal", settings.normal), values.get("speed", settings.speed)

    def _template(self, normal: Any, speed: float) -> Prepared:
        """Return the problem with a normal and a speed, at the target of the case."""
        settings = at_point(self._case, {"normal": normal, "speed": speed})
        made = prepare(settings, resolve(settings, self._loaded))
        # Most problems do not depend on the speed, and then all speeds share their solutions.
        objective = made.impact.objective
        key = objective.structure, tuple(objective.parameters), made.problem.requirements
        return replace(kept(self._known, key, lambda: made, _TEMPLATES), impact=made.impact)

    def target(self, prepared: Prepared, values: Mapping[str, Any]) -> tuple[Any, Any]:
        """Return the position and orientation of the contact frame at values of the grid."""
        position = values.get("target_position", self._case.settings.target_position)
        quaternion = values.get("target_quaternion", self._case.settings.target_quaternion)
        offset = np.array([values.get(name, 0.0) for name in OFFSETS])
        if offset.any() or any(name in values for name in OFFSETS):
            if position is None:
                frame = point_on(self.robot, prepared.impact.contact.frame)
                position = Numeric(self.robot.model).at(prepared.impact.q).placement(frame).translation
            position = tuple(float(v) for v in np.array(position) + offset)
        return position, quaternion

    def check(self, grid: Grid) -> None:
        """Check that the targets of the grid fit the problem.

        Raises:
            InputError: A target is given but the contact takes none, or a quaternion has no unit length.
        """
        for axis in grid.axes:
            for value in axis.values if axis.name in ("target_quaternion", "target_position") else axis.values[:1]:
                prepared = self.template(*self.normal_and_speed({axis.name: value}))
                if len(prepared.impact.objective.contacts) > 1:
                    what, hint = "varies, but there are several contacts", "state one contact by `frame` and `normal`"
                    raise InputError(what, where=f"grid.{axis.name}", hint=hint)
                if axis.name not in ("normal", "speed"):
                    retarget(prepared.problem, *self.target(prepared, {axis.name: value}))

    def program(self, problem: PostureProblem) -> PostureNLP:
        """Return the program of a problem, built anew only if its expressions are new.

        A program never grows out of another here, so its rounding depends on its problem alone.
        """
        rows = [f"{c.structure}:{problem.carried(k)}" for k, c in enumerate(problem.constraints)]
        key = "\n".join([problem.objective.structure, *rows])
        made = kept(self._programs, key, lambda: build_nlp(problem, compile="never"), _PROGRAMS)
        return replace(made, problem=problem)

    def search(self, walk: Walk, place: tuple[Any, Any], guesses: Sequence[Array]) -> PointResult:
        """Solve one point: from the guesses and the given posture, and from many starts where they disagree.

        Args:
            walk: Problem and program as the points before have left them.
            place: Target position and orientation.
            guesses: Optima of neighbors.
        """
        settings, runs = self._case.settings, 0
        problem = retarget(walk.problem, *place)
        try:
            for _ in range(_ROUNDS):
                nlp = replace(walk.nlp, problem=problem)
                scale = problem.objective.value(guesses[0] if len(guesses) else problem.given)
                ends = [self._run(nlp, start, scale) for start in [*guesses, problem.given]]
                if not _agree(problem, ends[:-1], ends[-1]):
                    starts = (feasible_start(problem, k, settings.seed) for k in range(1, settings.starts))
                    ends += [self._run(nlp, start, scale) for start in starts if start is not None]
                runs += len(ends)
                found = _optima(problem, ends)
                for end in found:
                    certificate = certify(problem, end.q, scale, end.auxiliaries)
                    if certificate.holds() and self._clear(problem, end.q):
                        return self._answer(problem, end.value, end.q, certificate, len(found), runs)
                grown = problem.grown([end.q for end in found])
                if grown is problem:
                    break
                walk.grow(self, grown)
                problem, guesses = grown, [end.q for end in found]
            return self._thorough(problem, guesses, runs)
        except Infeasible as error:
            return PointResult("infeasible", error.what, runs=runs)
        except SolverFailed as error:
            return PointResult("uncertified", error.line, runs=runs)
        except ImpactPostureError as error:
            return PointResult("undefined", error.line, runs=runs)

    def _run(self, nlp: PostureNLP, start: Array, scale: float) -> _End:
        record = nlp.solve(start, scale=scale)
        self.solver_s += record.cpu_s
        value = nlp.problem.objective.value(record.q) if record.converged else np.inf
        return _End(record.q, value, record.auxiliaries)

    def _thorough(self, problem: PostureProblem, guesses: Sequence[Array], runs: int) -> PointResult:
        """Search as ``optimize`` does, which finds the reason as well if there is no posture."""
        settings = self._case.settings
        found = solve(
            problem, starts=settings.starts, seed=settings.seed, jobs=1, compile="never", guesses=guesses[: settings.starts - 1]
        )
        value = problem.objective.value(found.q)
        return self._answer(problem, value, found.q, found.certificate, len(found.optima), runs + found.starts)

    @staticmethod
    def _clear(problem: PostureProblem, q: Array) -> bool:
        return problem.objective.movable(q) and not (problem.surroundings and problem.surroundings.collisions(q))

    @staticmethod
    def _answer(
        problem: PostureProblem, value: float, q: Array, certificate: Certificate, optima: int, runs: int
    ) -> PointResult:
        found = problem.impact.oracle.quantities(q)
        return PointResult(
            "certified", None, q, value, {key: getattr(found, key) for key in "HGVSE"},
            certificate.stationarity, certificate.primal, optima, runs,
        )  # fmt: skip


class Walk:
    """Problem and program of one template on its way through a shard, where both may grow.

    Args:
        solver: The solver of the case.
        problem: The problem of the template.
    """

    def __init__(self, solver: CaseSolver, problem: PostureProblem) -> None:
        # Kept, because a shard knows it by its identity.
        self._template = problem
        self.problem, self.nlp = problem, solver.program(problem)

    def grow(self, solver: CaseSolver, problem: PostureProblem) -> None:
        """Go on with the parts that a point needed."""
        self.problem, self.nlp = problem, solver.program(problem)


class _End(NamedTuple):
    """End of a run; the value is infinite if the run did not converge."""

    q: Array
    value: float
    auxiliaries: Array


def _optima(problem: PostureProblem, ends: Sequence[_End]) -> list[_End]:
    """Return one end for each distinct optimum, the best first."""
    known = {id(end.q): end for end in ends}
    return [known[id(one.q)] for one in distinct(problem, [(e.q, e.value) for e in ends if np.isfinite(e.value)])]


def _agree(problem: PostureProblem, ends: Sequence[_End], home: _End) -> bool:
    """Whether all neighbors lead to one optimum, and the given posture leads to no better one."""
    if not ends or not all(np.isfinite(end.value) for end in ends):
        return False
    return len(_optima(problem, ends)) == 1 and home.value > (1 - _BETTER) * min(end.value for end in ends)


def kept(cache: OrderedDict[Any, _Value], key: Any, make: Callable[[], _Value], most: int) -> _Value:
    """Return a value of a cache that drops what was not used for longest."""
    if key not in cache:
        cache[key] = make()
        if len(cache) > most:
            cache.popitem(last=False)
    cache.move_to_end(key)
    return cache[key]
