"""Where the reference flow of ``robust-flow`` comes to rest, from random feasible starts; kinematics only."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pinocchio as pin

from impact_posture.codegen.export import export
from impact_posture.codegen.impact_gradient import ImpactGradient
from impact_posture.posture.build_problem import build_problem
from impact_posture.posture.nlp import build_nlp
from impact_posture.posture.problem import PostureProblem, Requirements
from impact_posture.posture.search import run_start
from impact_posture.posture.starts import feasible_start
from impact_posture.processes import fork_map
from impact_posture.robot.robot import Robot
from impact_posture.tsid.actuators import Actuators
from impact_posture.tsid.impact_robust import gradient_of
from impact_posture.tsid.posture_tasks import JointPosture
from impact_posture.tsid.ranges import JointRanges
from impact_posture.tsid.reference_flow import PHASES, FlowOptions, ReferenceFlow
from impact_posture.tsid.task_formulation import (
    TaskFormulation,
    aerial_formulation,
    arm_formulation,
    legged_formulation,
)
from tests.benchmarks.cases import AHEAD, DOWN, Case
from tests.benchmarks.core import Request, Vector, machine, say, table

DT = 1e-3
# The time in which a flow is to rest, the longest that one may take, and that of a fine one, s.
REST, LONGEST, FINE = 8.0, 16.0, 5.0
# The most flows that are sent to the best optimum first.
SENT = 30
# Share of the start's H that counts: as distance from an optimum, and between basins.
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
    "robot|starts|H rises, of H₀: worst|median|at rest, s: median|95 %|within 8 s|"
    "within 1 % of H₀ of its basin's optimum|H above that, median|another basin|of these, sent to the best|"
    "largest static share|least room of a joint beyond its margin, rad|off contacts and tasks, mm"
)


@dataclass(frozen=True)
class Course:
    """A flow from its start to its rest.

    Attributes:
        q: Where it ended.
        values: ``H/H₀`` at each update.
        rested: When it rested, s; infinite if it did not.
        missed: Largest distance from contacts and tasks, m or rad.
        share: Largest share of what the actuators may give at rest on the way, if the start was within it.
        room: Least distance of a joint from its limit less its margin there, rad (m); zero or more holds the margin.
    """

    q: Vector
    values: Vector
    rested: float
    missed: float
    share: float
    room: float


def formulation_for(robot: Robot, posture: JointPosture) -> TaskFormulation:
    """The formulation that suits the robot."""
    builders = {"aerial": aerial_formulation, "arm": arm_formulation}
    return builders.get(robot.spec.kind, legged_formulation)(robot, posture)


def problem_of(case: Case) -> PostureProblem:
    """The offline problem with the rows of the flow but for those of the actuators."""
    objective, options = case.problem().objective, FlowOptions()
    robot = objective.robot
    stands = bool(robot.spec.supports)
    wanted = Requirements(
        contact_pose="free" if stands else "full",
        base="level" if robot.spec.kind == "aerial" else "free",
        hold=tuple(j for j in robot.spec.constraints.hold if j not in robot.locked),
        com_over_feet=stands,
        com_margin=options.com_margin if stands else 0.0,
        limit_margin=options.joint_margin,
    )
    return build_problem(robot, objective, robot.posture(), wanted)


def course(flow: ReferenceFlow, q: Vector, longest: float) -> Course:
    """Let the flow go from ``q`` until it rests; the robot follows exactly."""
    flow.reset(q)
    flow.on = True
    values, missed, share, room = [flow.value], 0.0, 0.0, np.inf
    for k in range(round(longest / DT)):
        flow.advance(DT, flow.q)
        if k % len(PHASES) == len(PHASES) - 1:
            values.append(flow.value)
            share = max(share, float(np.abs(flow.shares).max(initial=0.0)))
            room, missed = min(room, _room(flow)), max(missed, float(np.abs(flow.error).max(initial=0.0)))
            if flow.resting and not np.abs(flow.velocity).max() > 1e-4:
                break
    rested = (k + 1) * DT if flow.resting else np.inf
    return Course(flow.q.copy(), np.array(values) / flow.start, rested, missed, share, room)


def _room(flow: ReferenceFlow) -> float:
    """Least distance of a joint from its limit less its margin, of joints that move."""
    robot = flow.robot
    ranges = JointRanges(robot)
    moving = np.isfinite(ranges.upper - ranges.lower)
    moving[[robot.tangent_names.index(j) for j in robot.spec.constraints.hold if j in robot.tangent_names]] = False
    q, lower, upper = flow.q[ranges.index[moving]], ranges.lower[moving], ranges.upper[moving]
    margin = np.minimum(flow.options.joint_margin, (upper - lower) / 8)
    return float((np.minimum(q - lower, upper - q) - margin).min())


@dataclass(frozen=True)
class Outcome:
    """A course beside the optimum of its basin.

    Attributes:
        course: The course.
        start: ``H₀``.
        optimum: ``H`` at the optimum of the basin, under the same rows.
        q: That optimum.
        program: Whether the offline program from the end of the flow gave it, and not a finer flow.
    """

    course: Course
    start: float
    optimum: float
    q: Vector
    program: bool

    @property
    def end(self) -> float:
        """``H`` at the end."""
        return self.start * float(self.course.values[-1])


def lines(request: Request) -> Iterator[str]:
    """A row for each robot."""
    each = max(1, request.count // len(CASES))
    yield machine("daqp")
    yield ""
    yield f"{each} random feasible starts for each robot, all on the same contacts and tool pose. Starts that need"
    yield "more than 80 % of what the actuators can give are drawn again. The robot follows exactly (no physics). The"
    yield "optimum of a basin is what the offline program (IPOPT) finds from the end of the flow under the same rows."
    yield "Where that lies elsewhere or needs more torque, it is the end of a finer flow (ρ = 0, ε = 10⁻⁷, 5 s more)."
    yield "Another basin: that optimum lies more than 1 % of H₀ above the best that any start has found. *Sent to the"
    yield f"best*: of up to {SENT} of these, which visit that posture first, those that end within 1 % of H₀ of it."
    yield ""
    yield from table(_HEAD.split("|"), (_row(case, each, request) for case in CASES if request.only in case.name))


def _row(case: Case, count: int, request: Request) -> list[str]:
    problem = problem_of(case)
    robot = problem.robot
    with tempfile.TemporaryDirectory() as folder:
        export(problem.impact, Path(folder), check=False)
        library = ImpactGradient.load(folder, robot=robot)
        formulation, actuators = formulation_for(robot, JointPosture(robot)), Actuators(robot)

        def flow_of(options: FlowOptions, path: Sequence[Vector] = ()) -> ReferenceFlow:
            return ReferenceFlow(robot, gradient_of(library), formulation, actuators, options, path)

        flow, fine = flow_of(FlowOptions()), flow_of(FlowOptions(rho=0.0, mu=0.005, epsilon=1e-7))
        nlp = build_nlp(problem, compile="never")
        starts = starts_of(problem, flow, count, request.seed)

        def one(index: int) -> Outcome:
            found = course(flow, starts[index], LONGEST)
            start = problem.objective.value(starts[index])
            end = start * found.values[-1]
            record, certificate = run_start(nlp, found.q, end)
            flow.reset(record.q)
            fits = certificate.holds() and np.abs(flow.shares).max(initial=0.0) < 1.001
            away = np.abs(pin.difference(robot.model, found.q, record.q)[6 if robot.floating else 0 :]).max()
            optimum = problem.objective.value(record.q)
            if fits and away < 0.5 and optimum < end + 1e-6 * start:
                return Outcome(found, start, optimum, record.q, True)
            finer = course(fine, found.q, FINE)
            return Outcome(found, start, end * float(finer.values[-1]), finer.q, False)

        outcomes: dict[int, Outcome] = {}
        with fork_map(one, len(starts), request.jobs) as results:
            for index, outcome in results:
                outcomes[index] = outcome
                say(f"\r{case.name}: {len(outcomes)} of {len(starts)}", end="")
        say("")
        best = min(outcomes.values(), key=lambda o: o.optimum)
        apart = [i for i, o in outcomes.items() if o.optimum - best.optimum > CLOSE * o.start][:SENT]
        warm = flow_of(FlowOptions(), [best.q])

        def again(k: int) -> bool:
            found, start = course(warm, starts[apart[k]], LONGEST), outcomes[apart[k]].start
            return bool(found.values[-1] * start - best.optimum <= CLOSE * start)

        with fork_map(again, len(apart), request.jobs) as results:
            arrived = [good for _, good in results]
    return _cells(case.name, list(outcomes.values()), best.optimum, arrived)


def _cells(name: str, outcomes: Sequence[Outcome], best: float, arrived: Sequence[bool]) -> list[str]:
    rest = np.array([o.course.rested for o in outcomes])
    start, end, optimum = (np.array([getattr(o, key) for o in outcomes]) for key in ("start", "end", "optimum"))
    rises = [float((o.course.values - np.minimum.accumulate(o.course.values)).max()) for o in outcomes]
    program = np.mean([o.program for o in outcomes])
    near = np.mean(end - optimum <= CLOSE * start)
    return [
        name,
        str(len(outcomes)),
        f"{max(rises):.0e}",
        f"{np.median(rises):.0e}",
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


def starts_of(problem: PostureProblem, flow: ReferenceFlow, count: int, seed: int) -> list[Vector]:
    """Random feasible postures whose static shares are within the limits."""
    found: list[Vector] = []
    for index in range(1, 20 * count):
        start = feasible_start(problem, index, seed)
        if start is not None:
            flow.reset(start)
            if np.abs(flow.shares).max(initial=0.0) <= 1.0:
                found.append(start)
        if len(found) == count:
            break
    return found
