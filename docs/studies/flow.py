"""Compare the postures at which the reference flow comes to rest with local optima.  No dynamics is simulated."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pinocchio as pin

from docs.studies.cases import AHEAD, DOWN, Case
from docs.studies.core import Request, Vector, collected, machine, table
from docs.studies.flow_course import CompiledFlow, Course
from impact_posture.posture.constraints.requirements import Requirements
from impact_posture.posture.formulation.build_problem import build_problem
from impact_posture.posture.manifold.feasible_start import feasible_start
from impact_posture.posture.program.constrained_problem import ConstrainedProblem
from impact_posture.posture.program.posture_nlp import build_nlp
from impact_posture.posture.search.growing_search import run_start
from impact_posture.robot.robot import Robot
from impact_posture.system.processes import fork_map
from impact_posture.tsid.flow.flow_direction import FlowOptions

# Goal for the time until the flow comes to rest, s.
REST = 8.0
# A flow that does not rest ends after this time, s.
LONGEST = 16.0
# Duration of a flow with smaller steps, s.
FINE = 5.0
FINER = FlowOptions(rho=0.0, mu=0.005, epsilon=1e-7)
# Values of H count as equal if their difference, divided by H at the start, is below this number.
CLOSE = 0.01
CASES = (
    Case("tilthex_arm", "tilthex_arm", DOWN),
    Case("hextilt", "hextilt", DOWN),
    Case("panda", "panda", DOWN),
    Case("solo8", "solo8", AHEAD),
    Case("talos at the torso", "talos", AHEAD, {"frame": "torso_2_link"}),
    Case("g1", "g1", AHEAD),
)
_HEAD = (
    "robot|seed|starts|H rises, of H₀: worst|median|more than 10⁻³|at rest, s: median|95 %|within 8 s|"
    "within 1 % of H₀ of its basin's optimum|H above that, median|another basin|of these, sent to the best|"
    "largest static share|least room of a joint beyond its margin, rad|off contacts and tasks, mm"
)


def problem_of(case: Case) -> ConstrainedProblem:
    """Build the offline problem with the constraints of the flow, except the limits on actuators and tilt."""
    objective, options = case.problem().objective, FlowOptions()
    robot = objective.robot
    stands = bool(robot.spec.supports)
    wanted = Requirements(
        contact_pose="free" if stands else "full",
        base="level" if robot.spec.kind == "aerial" else "free",
        hold=robot.held,
        com_over_feet=stands,
        com_margin=options.com_margin if stands else 0.0,
        limit_margin=options.joint_margin,
    )
    return build_problem(robot, objective, robot.posture(), wanted)


@dataclass(frozen=True)
class Outcome:
    """Course of the flow from one start, and the local optimum near its end.

    Attributes:
        course: Course of the flow.
        optimum: ``H`` at the local optimum, under the constraints of the flow.
        q: Posture at the local optimum.
        program: True if the offline program, started at the end of the flow, computed this optimum; false if a flow
            with smaller steps computed it.
    """

    course: Course
    optimum: float
    q: Vector
    program: bool

    @property
    def start(self) -> float:
        """``H₀``."""
        return float(self.course.values[0])

    @property
    def end(self) -> float:
        """``H`` at the end."""
        return float(self.course.values[-1])

    @property
    def rise(self) -> float:
        """Largest rise of ``H`` above its smallest earlier value, relative to ``H₀``."""
        values = self.course.values
        return float((values - np.minimum.accumulate(values)).max()) / self.start


def lines(request: Request) -> Iterator[str]:
    """Yield a row for each robot and seed.

    Four seeds are used so that the flow is not tuned for one set of starts.
    """
    each = -(-request.count // len(CASES))
    yield machine("daqp")
    yield ""
    starts = f"{each} random feasible starts for each robot and seed"
    yield f"{starts}, with equal contacts and tool pose. Starts that need more than 80 % of the actuator limits"
    yield "are drawn again. The flow runs in the exported controller in C. The robot moves exactly as planned"
    yield "(no physics). The optimum of a basin is the solution of the offline program (IPOPT), started at the"
    yield "end of the flow, under the same constraints. If this solution is far from the end of the flow, or"
    yield "needs more torque or tilt, the optimum is the end of a finer flow (ρ = 0, ε = 10⁻⁷, 5 s more)."
    yield "Another basin: H at the optimum is more than 1 % of H₀ above the best optimum of all starts. *Sent to"
    yield "the best*: flows from these starts first visit the best optimum. The number counts the flows that end"
    yield "within 1 % of H₀ of this optimum."
    yield ""
    seeds, chosen = range(request.seed, request.seed + 4), [case for case in CASES if request.only in case.name]
    rows = (_row(case, each, replace(request, seed=seed)) for case in chosen for seed in seeds)
    yield from table(_HEAD.split("|"), rows)


def _row(case: Case, count: int, request: Request) -> list[str]:
    problem = problem_of(case)
    robot = problem.robot
    with tempfile.TemporaryDirectory() as folder:
        flow = CompiledFlow(problem, Path(folder) / "flow")
    nlp = build_nlp(problem, starts=count)
    starts = starts_of(problem, flow, count, request.seed)

    def one(index: int) -> Outcome:
        course = flow.course(starts[index], LONGEST, FlowOptions())
        start, end = course.values[[0, -1]]
        record, certificate = run_start(nlp, course.q, float(end))
        # The offline program does not limit actuators and tilt, so both are checked here.  If the start tilts more
        # than the limit, the flow must not tilt further.
        tilted = max(FlowOptions().tilt, _tilt(robot, course.q))
        fits = certificate.holds() and flow.share(record.q) < 1.001 and _tilt(robot, record.q) < tilted + 0.001
        away = np.abs(pin.difference(robot.model, course.q, record.q)[robot.first_joint :]).max()
        optimum = problem.objective.value(record.q)
        if fits and away < 0.5 and optimum < end + 1e-6 * start:
            return Outcome(course, optimum, record.q, True)
        finer = flow.course(course.q, FINE, FINER)
        return Outcome(course, float(finer.values[-1]), finer.q, False)

    outcomes = collected(one, len(starts), request.jobs, case.name)
    best = min(outcomes, key=lambda o: o.optimum)
    apart = [i for i, o in enumerate(outcomes) if o.optimum - best.optimum > CLOSE * o.start]

    def again(k: int) -> bool:
        course = flow.course(starts[apart[k]], LONGEST, FlowOptions(), first=best.q)
        return bool(course.values[-1] - best.optimum <= CLOSE * course.values[0])

    with fork_map(again, len(apart), request.jobs) as results:
        arrived = [good for _, good in results]
    return _cells(case.name, request.seed, outcomes, best.optimum, arrived)


def _tilt(robot: Robot, q: Vector) -> float:
    """Return the angle by which the base is tilted from its default posture, rad."""
    if robot.upright is None:
        return 0.0
    return float(np.arccos(np.clip(pin.Quaternion(q[3:7]).matrix()[2] @ robot.upright, -1.0, 1.0)))


def _cells(name: str, seed: int, outcomes: Sequence[Outcome], best: float, arrived: Sequence[bool]) -> list[str]:
    rest = np.array([o.course.rested for o in outcomes])
    start, end, optimum = (np.array([getattr(o, key) for o in outcomes]) for key in ("start", "end", "optimum"))
    rises = np.array([o.rise for o in outcomes])
    program = np.mean([o.program for o in outcomes])
    near = np.mean(end - optimum <= CLOSE * start)
    return [
        name,
        str(seed),
        str(len(outcomes)),
        f"{max(rises):.0e}",
        f"{np.median(rises):.0e}",
        f"{100 * np.mean(rises > CLOSE / 10):.1f} %",
        f"{np.median(rest):.1f}",
        f"{np.percentile(rest, 95):.1f}",
        f"{100 * np.mean(rest <= REST):.1f} %",
        f"{100 * near:.1f} % ({100 * program:.0f} % by the program)",
        f"{100 * np.median(end / optimum - 1):.1f} %",
        f"{100 * np.mean(optimum - best > CLOSE * start):.0f} %",
        f"{sum(arrived)} of {len(arrived)}",
        f"{max(o.course.share for o in outcomes) * FlowOptions().share:.3f}",
        f"{min(o.course.room for o in outcomes):.3f}",
        f"{1e3 * max(o.course.missed for o in outcomes):.2f}",
    ]


def starts_of(problem: ConstrainedProblem, flow: CompiledFlow, count: int, seed: int) -> list[Vector]:
    """Draw feasible postures whose static actuator loads are within the limits."""
    starts: list[Vector] = []
    for index in range(1, 20 * count):
        start = feasible_start(problem, index, seed)
        if start is not None and flow.share(start) <= 1.0:
            starts.append(start)
        if len(starts) == count:
            break
    return starts
