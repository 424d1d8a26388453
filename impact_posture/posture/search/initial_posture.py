"""Find the posture from which a search begins, or name the constraints that conflict."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace

import numpy as np

from impact_posture.errors import ContactError, ImpactPostureError, Infeasible, SolverFailed
from impact_posture.impact.contact_point import at_front, early_touches
from impact_posture.impact.objective import Objective
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.posture.approach.approach_speed import ApproachSpeed
from impact_posture.posture.constraints.clearance import SpreadClearance
from impact_posture.posture.constraints.requirements import Requirements
from impact_posture.posture.formulation.build_problem import build_problem
from impact_posture.posture.manifold.feasible_start import FEASIBLE, Projector, feasible_start
from impact_posture.posture.program.constrained_problem import ConstrainedProblem
from impact_posture.posture.program.program_rows import ProgramRows
from impact_posture.posture.search.conflicts import ElasticProgram, LeastViolation, find_conflicts
from impact_posture.posture.search.growing_search import feasible
from impact_posture.system.arrays import Array

# With this value of ``beside``, :func:`find_conflicts` gives up after a few starts.
_QUICK = 1e-9
# Clearance, m, that is tried in order to find out whether the stated clearance causes a conflict.
_LEAST_CLEARANCE = 1e-4
# If no posture allows the speed of a strike, the required speed is below the greatest speed by this fraction, so that
# the program has an interior.
_SLOWER = 1e-3
# Fractions of the stated tilt and shift of the surface that are required in turn until a posture satisfies them.
_SHARES = (1.0, 0.5, 0.0)
# A greatest speed below this fraction of the stated speed is a conflict.
_LEAST_SPEED = 0.01
# Number of speeds that the search for the greatest speed tries if other constraints conflict with the speed.
_BISECTIONS = 8


def initial_posture(problem: ConstrainedProblem, seed: int) -> tuple[ConstrainedProblem, Array, ProgramRows]:
    """Return the problem, a posture from which the search begins, and the rows of the program.

    If no posture keeps clear of the surfaces for the stated tilt and shift (:class:`SpreadClearance`), the returned
    problem requires only a fraction of this tilt and shift.

    Raises:
        Infeasible, SolverFailed: The same errors as in :func:`_initial_posture`.
    """
    *larger, last = _with_spreads(problem)
    for tried in larger:
        rows = ProgramRows(tried)
        try:
            return *_initial_posture(tried, seed, rows, beside=_QUICK), rows
        except (Infeasible, SolverFailed):
            continue
    rows = ProgramRows(last)
    return *_initial_posture(last, seed, rows), rows


def _with_spreads(problem: ConstrainedProblem) -> Iterator[ConstrainedProblem]:
    """Yield the problem with smaller and smaller tilt and shift of the surfaces, down to zero."""
    spread = next((c for c in problem.constraints if isinstance(c, SpreadClearance)), None)
    if spread is None or problem.surroundings is None:
        yield problem
        return
    place = problem.constraints.index(spread)
    for share in _SHARES:
        tilt, shift = (share * value for value in problem.requirements.surface_spread)
        smaller = problem.surroundings.clearance_of_spread(tilt, shift)
        constraints, rows = list(problem.constraints), list(problem.rows)
        constraints[place : place + 1] = [] if smaller is None else [smaller]
        if smaller is None:
            del rows[place : place + 1]
        requirements = replace(problem.requirements, surface_spread=(tilt, shift))
        yield replace(problem, requirements=requirements, constraints=tuple(constraints), rows=tuple(rows))


def _initial_posture(
    problem: ConstrainedProblem, seed: int, rows: ProgramRows, beside: float = 0.0
) -> tuple[ConstrainedProblem, Array]:
    """Return the given posture moved onto the constraints, or else the first random start that reaches them.

    If the posture still violates constraints that the projection ignores, :class:`ElasticProgram` moves the posture.
    The returned problem then has all rows that the elastic program needed.  If no posture allows the speed of a
    strike, the returned problem requires the greatest possible speed instead, unless ``beside`` is above zero.

    Raises:
        Infeasible: No posture satisfies the constraints; the error names the conflicting constraints.
        SolverFailed: The search reached a posture near the constraints, but no posture that satisfies them.
    """
    starts = (feasible_start(problem, index, seed) for index in range(5))
    start = next((q for q in starts if q is not None), None)
    if start is not None and feasible(problem, start):
        return problem, start
    given, problem = problem.given, problem if start is None else replace(problem, given=start)
    program = ElasticProgram(problem, rows)
    least = find_conflicts(problem, seed, program, beside=beside)
    least = _slowed(least, seed, program) if problem.requirements.strike and not beside else least
    if least.conflicts and beside:
        raise Infeasible(least.conflicts, least.sizes)
    if least.conflicts:
        limits = f"; there {', '.join(least.at_limits[:4])}" if least.at_limits else ""
        struck = any(" / surface at " in name for name in least.conflicts)
        links = {body.name for body in problem.surroundings.shapes.bodies} if problem.surroundings else set()
        overlap = any({*name.split(" / ")} <= links for name in least.conflicts)
        hint = f"{_remedy(problem, seed, struck=struck, overlap=overlap)}relax one of them, move the target, or start"
        hint += " from another `posture`"
        if struck:
            hint += (
                "; check the sign of the normal, which points towards the robot, and how far the `surface` reaches"
            )
        if overlap and problem.surroundings:
            hint += f"; {problem.surroundings.by_design}"
        near = any(" / " in name for name in least.conflicts)
        if near and problem.surroundings and not problem.surroundings.collisions(least.q):
            hint += "; there only the hulls around the links touch, which are slightly larger than the links"
        raise Infeasible(least.conflicts, least.sizes, hint=hint + limits)
    projection = Projector(problem).project(least.q)
    if projection.violation > FEASIBLE:
        fault = f"no known posture satisfies the constraints; the nearest misses them by {projection.violation:.1e}"
        raise SolverFailed(fault, where="problem", hint="start from a `posture` nearer to the target")
    return replace(least.problem, given=given), projection.q


def _slowed(least: LeastViolation, seed: int, program: ElasticProgram) -> LeastViolation:
    """Return a posture for the greatest approach speed, or ``least`` if the speed does not cause the conflict.

    If other constraints, such as clearances, conflict with the speed, the penalties do not show the greatest speed.
    Bisection then finds the greatest speed.
    """
    (approach,) = [c for c in least.problem.constraints if isinstance(c, ApproachSpeed)] or (None,)
    if approach is None or not least.conflicts:
        return least
    low, high, best = 0.0, approach.speed, least
    if least.conflicts.keys() == {approach.name}:
        low = high = approach.speed - least.conflicts[approach.name]
    speed, problem = _LEAST_SPEED * approach.speed, least.problem
    for _ in range(_BISECTIONS if low < high else 0):
        tried = find_conflicts(_at_speed(problem, speed), seed, program, (least.q,), beside=_QUICK)
        problem = tried.problem
        if tried.conflicts and not low:
            return least
        low, high, best = (low, speed, best) if tried.conflicts else (speed, high, tried)
        speed = (low + high) / 2
    if low < _LEAST_SPEED * approach.speed:
        return least
    note = f"{approach.speed:g} m/s cannot be reached, so the program requires the greatest speed, {low:.3g} m/s"
    problem = _at_speed(replace(problem, notes=(*problem.notes, note)), (1 - _SLOWER) * low)
    return replace(best, problem=problem, conflicts={})


def _at_speed(problem: ConstrainedProblem, speed: float) -> ConstrainedProblem:
    constraints = (c.slower(speed) if isinstance(c, ApproachSpeed) else c for c in problem.constraints)
    return replace(problem, constraints=tuple(constraints))


def _remedy(problem: ConstrainedProblem, seed: int, *, struck: bool, overlap: bool) -> str:
    """Return the first change of the settings that removes all conflicts, as text; empty if no change does.

    ``struck`` says whether a link conflicts with the surface, and ``overlap`` whether two links conflict.
    """
    wanted, objective = problem.requirements, problem.objective
    changes: list[tuple[str, Objective, Requirements]] = []
    if struck and isinstance(objective, WorstCaseObjective):
        robot, q, held = problem.robot, problem.given, wanted.hold
        if early_touches(robot, objective.contacts, q, held):
            first, *others = (at_front(robot, contact, q, held) for contact in objective.contacts)
            moved = replace(objective, contact=first, others=tuple(others))
            changes.append(("put the contact point at the front of its links (`contact_point` front)", moved, wanted))
    if objective.contacts and wanted.contact_pose not in ("position", "box", "free"):
        freed = replace(wanted, contact_pose="position", target_quaternion=None)
        changes.append(("let the contact frame turn (`contact_pose` position)", objective, freed))
    if wanted.com_over_feet and not objective.supports:
        leaning = replace(wanted, com_over_feet=False)
        changes.append(("let the center of mass leave the feet that land (no `com`)", objective, leaning))
    if overlap:
        closer = replace(wanted, clearance=_LEAST_CLEARANCE)
        changes.append((f"let links come closer (`clearance` below {wanted.clearance:g})", objective, closer))
    for words, changed, requirements in changes:
        with suppress(ImpactPostureError):
            tried = build_problem(problem.robot, changed, problem.given, requirements)
            if not find_conflicts(tried, seed, beside=_QUICK).conflicts:
                return f"{words}, which is possible; or "
    return ""


def initial_objective(problem: ConstrainedProblem, initial: Array) -> float:
    """Return the objective at the initial posture, by which the program is scaled.

    Raise ``ContactError`` if the contact point cannot move along the normal, because the objective is then not
    defined.
    """
    objective = problem.objective
    # If the contact point cannot move along the normal, the objective would only be a rounding error.
    value = objective.value(initial) if objective.movable(initial) else 0.0
    if not (np.isfinite(value) and value > 0):
        frames = ", ".join(f"'{contact.frame}'" for contact in objective.contacts)
        fault = f"the contact point at {frames} cannot move along the normal"
        hint = "choose another frame, normal or posture: an impact along this normal moves nothing"
        raise ContactError(fault, where="normal", hint=hint)
    return value
