"""Simulate the impacts of verdicts, and compare each number."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from docs.studies.cases import AHEAD, ASIDE, BACK, DOWN
from docs.studies.core import Vector
from docs.studies.verdict.impact_simulation import ImpactSimulation, Point, SimulatedImpact, Surface
from impact_posture.config.problem_settings import ProblemSettings
from impact_posture.config.table_validation import validate
from impact_posture.impact.elasticity.contact_compression import ContactStiffness
from impact_posture.impact.evaluation.evaluation import Evaluation
from impact_posture.impact.friction.unilateral_impact import StandingFeet
from impact_posture.impact.impact_contact import point_on
from impact_posture.impact.resolved_impact import ResolvedImpact
from impact_posture.posture.analysis.verdict import verdict
from impact_posture.posture.analysis.verdict_changes import PredictedImpact
from impact_posture.posture.analysis.verdict_conditions import LONG_TRAVEL
from impact_posture.posture.formulation.problem_file import prepare
from impact_posture.posture.search.multistart import solve
from impact_posture.robot.robot import Robot

FRICTIONS = (0.0, 0.3, 1.0)
STIFFNESSES = (1e5, 1e6)
# In a simulation, a foot or a contact point moves if its speed is above this share of the approach speed.
MOVES = 0.01
# If the simulated share of another joint is larger by more than this fraction, the prediction names the wrong joint.
_SAME_JOINT = 0.05
# Accuracy of the simulated shortest contact time with which the feet stay.
_HOLDING = 0.05


@dataclass(frozen=True)
class Case:
    """A robot that hits a surface: name of the robot, normal of the surface, and further settings."""

    robot: str
    normal: tuple[float, float, float]
    more: Mapping[str, object] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """Robot, contact frame if it is not the default, and surface."""
        return " ".join([self.robot, *map(str, self.more.values()), _SURFACES[self.normal]])


_SURFACES = {DOWN: "floor", BACK: "wall", AHEAD: "from behind", ASIDE: "from the side"}
# The simulation was written with these robots.
CASES = (
    Case("panda", DOWN),
    Case("ur5", BACK),
    Case("z1", BACK),
    Case("tiago", BACK),
    Case("tilthex_arm", BACK),
    Case("borinot", DOWN),
    Case("solo12", BACK),
    Case("go2", BACK),
    Case("bolt", BACK),
    Case("anymal_kinova", BACK),
    Case("talos", BACK),
    Case("g1", BACK),
)
# These robots were tried only after the simulation was finished.
HELD_OUT = (
    Case("xarm7", BACK),
    Case("kinova", DOWN),
    Case("hextilt", DOWN),
    Case("solo8", AHEAD),
    Case("hyq", ASIDE),
    Case("anymal_c", DOWN),
    Case("romeo", BACK),
    Case("icub", BACK),
    Case("talos", AHEAD, {"frame": "torso_2_link"}),
    Case("g1", ASIDE, {"frame": "torso_link"}),
)


@dataclass(frozen=True)
class Numbers:
    """Numbers of one impact in one posture, predicted or simulated.

    Attributes:
        jump: Norm ``‖Δν‖`` of the whole velocity jump.
        linear, angular: Size of the linear and angular jump of a floating base, m/s and rad/s.
        joint: Jump of the joint that the prediction names as the worst one, rad/s or m/s.
        impulse: Normal impulse, N·s.
        force: Largest normal force, N.
        slips: Whether the contact point slides.
        feet: Frame of each foot → speed of the foot, m/s.  A prediction contains the speed at the end of the impact;
            a simulation contains the largest speed during the contact.
        moving: Frames of the feet that lift or slide.
    """

    jump: float
    linear: float | None
    angular: float | None
    joint: float
    impulse: float
    force: float
    slips: bool
    feet: Mapping[str, float]
    moving: frozenset[str]


@dataclass(frozen=True)
class Pair:
    """Prediction and simulation in one posture.

    Attributes:
        still: The simulation with the mass matrix and the Jacobians of the first posture.
        named: Whether the joint that the prediction names has the largest share of its velocity limit in the
            simulation, up to 5 %.
        speed: Approach speed, m/s.
        time: Simulated compression time, s.
        unsolved: Number of time steps whose conditions were not fulfilled.
    """

    predicted: Numbers
    simulated: Numbers
    still: Numbers
    named: bool
    speed: float
    time: float
    unsolved: int

    def error(self, number: str, *, still: bool = False) -> float | None:
        """Return the relative error of a predicted number."""
        predicted, measured = self.values(number, still=still)
        return None if predicted is None else predicted / measured - 1

    def values(self, number: str, *, still: bool = False) -> tuple[float, float]:
        """Return a predicted number and the simulated one; both are ``None`` without a floating base."""
        return getattr(self.predicted, number), getattr(self.still if still else self.simulated, number)

    def wrong_feet(self) -> list[str]:
        """Return the feet that move in only one of prediction and simulation, and whose speeds differ clearly."""
        different = self.predicted.moving ^ self.simulated.moving
        least = MOVES * self.speed
        return sorted(f for f in different if abs(self.predicted.feet[f] - self.simulated.feet[f]) > least)


@dataclass(frozen=True)
class Row:
    """A verdict: case, friction, stiffness, whether the feet are held, and the initial and the optimal posture.

    Attributes:
        feet: ``held``, ``free``, or ``–`` for a robot without feet.
        long: Whether the verdict says that the robot moves during the contact.
    """

    case: Case
    friction: float
    stiffness: float
    feet: str
    long: bool
    before: Pair
    after: Pair

    def changes(self, number: str) -> tuple[float, float] | None:
        """Return the predicted and the simulated relative change of a number."""
        first, second = self.before.values(number), self.after.values(number)
        return None if first[0] is None else (second[0] / first[0] - 1, second[1] / first[1] - 1)


@dataclass(frozen=True)
class HoldingTime:
    """The shortest contact time, s, with which the feet stay in one posture: predicted, and simulated to 5 %.

    Attributes:
        still: Shortest contact time simulated with the mass matrix and the Jacobians of the first posture.
        long: Whether the verdict would say that the robot moves during a contact of the predicted time.
    """

    case: Case
    friction: float
    posture: str
    predicted: float
    simulated: float
    still: float
    long: bool


@dataclass(frozen=True)
class Compared:
    """Rows of one case and friction coefficient, contact times with which its feet stay, reasons for missing rows."""

    rows: tuple[Row, ...]
    held: tuple[HoldingTime, ...]
    missing: tuple[str, ...]


def compare(case: Case, friction: float, starts: int) -> Compared:
    """Optimize, and compare both postures for each stiffness, with feet that are held and with feet that are free."""
    settings = {"robot": case.robot, "normal": case.normal, "friction": friction, "objective": "auto", **case.more}
    prepared = prepare(validate(ProblemSettings, settings, "options"))
    solution = solve(prepared.problem, starts=starts, jobs=1, compile="never")
    postures, impact = (solution.initial, solution.q), prepared.impact
    rows, missing = list[Row](), list[str]()
    for stiffness in STIFFNESSES:
        stated = replace(impact, contact_stiffness=ContactStiffness(linear=stiffness))
        evaluations = [stated.evaluate(q) for q in postures]
        said = verdict(stated, *evaluations)
        long = any(condition.key == "contact time" for condition in said.conditions)
        for feet in ("held", "free") if impact.supports else ("–",):
            predicted = (said.unilateral if feet == "free" else None) or (said.before, said.after)
            pairs = [_pair(stated, *side, feet) for side in zip(evaluations, predicted, strict=True)]
            reasons = [pair for pair in pairs if isinstance(pair, str)]
            if reasons:
                missing.append(f"{case.name}, friction {friction:g}, {stiffness:g} N/m: {reasons[0]}")
            else:
                rows.append(Row(case, friction, stiffness, feet, long, *pairs))
    held = []
    for posture, q in zip(("before", "after"), postures, strict=True):
        evaluation = impact.evaluate(q)
        if evaluation.standing is not None and (time := evaluation.standing.holding_time) is not None:
            simulated = [_holding_time(impact, evaluation, time, still=still) for still in (False, True)]
            held.append(HoldingTime(case, friction, posture, time, *simulated, impact.speed * time > LONG_TRAVEL))
    return Compared(tuple(rows), tuple(held), tuple(missing))


def _holding_time(impact: ResolvedImpact, evaluation: Evaluation, predicted: float, *, still: bool) -> float:
    """Return the shortest contact time, s, with which simulated feet stay, between 2/3 and 3/2 of the prediction."""
    robot, contact = impact.robot, impact.contact
    hit = point_on(robot, contact.frame, contact.offset)
    simulation = ImpactSimulation(
        robot.model, evaluation.q, Point(hit.joint, hit.position), feet_of(robot)[0], still=still
    )
    low, high = np.log(predicted / 1.5), np.log(predicted * 1.5)
    while high - low > _HOLDING:
        middle = (low + high) / 2
        stiffness = evaluation.contact_mass * (np.pi / 2 / np.exp(middle)) ** 2
        result = simulation.run(Surface(np.array(contact.normal), impact.speed, stiffness, contact.friction))
        low, high = (middle, high) if result.feet.max() > MOVES * impact.speed else (low, middle)
    return float(np.exp((low + high) / 2))


def _pair(impact: ResolvedImpact, evaluation: Evaluation, said: PredictedImpact, feet: str) -> Pair | str:
    """Simulate the impact in one posture; return a reason if there is nothing to compare."""
    robot, contact, q = impact.robot, impact.contact, evaluation.q
    surface = Surface(np.array(contact.normal), impact.speed, impact.contact_stiffness.linear, contact.friction)
    oracle, n, model, standing = impact.objective.oracle.at(q), surface.normal, robot.model, evaluation.standing
    slips, speeds, moving = not said.sticks, dict[str, float](), frozenset[str]()
    if feet == "free":
        if standing is None:
            return "no prediction for feet that lift"
        jump = standing.jump.velocity
        under = StandingFeet(oracle, impact.supports, q, contact.friction)
        speeds = _fastest(under.frames, np.linalg.norm((under.jacobian @ jump).reshape(-1, 3), axis=1))
        moving = frozenset((*standing.lifts, *standing.slides))
        if said.sticks is None:
            contact_velocity = oracle.at(q).J @ jump
            slips = np.linalg.norm(contact_velocity - (n @ contact_velocity) * n) > MOVES * surface.speed
        if under.forces is None:
            # The center of mass is not above the feet, so the prediction does not count the weight.
            model = model.copy()
            model.gravity.linear = np.zeros(3)
    predicted = Numbers(
        said.jump, said.base_linear, said.base_angular, said.joint.velocity, said.impulse, said.peak_force,
        bool(slips), speeds, moving,
    )  # fmt: skip
    points, frames = feet_of(robot)
    hit = point_on(robot, contact.frame, contact.offset)
    simulated = []
    for still in (False, True):
        arguments = model, q, Point(hit.joint, hit.position), points
        simulation = ImpactSimulation(*arguments, held=feet == "held", still=still)
        if not simulation.stands:
            return "the robot falls at rest"
        result = simulation.run(surface)
        simulated.append((_numbers(robot, result, said.joint.name, surface, frames), result))
    (moved, result), (still_numbers, _) = simulated
    share = _worst_share(robot, result.jump)
    named = share[robot.tangent_names.index(said.joint.name)] >= (1 - _SAME_JOINT) * share.max()
    return Pair(predicted, moved, still_numbers, bool(named), surface.speed, result.time, result.unsolved)


def _numbers(robot: Robot, result: SimulatedImpact, joint: str, surface: Surface, frames: list[str]) -> Numbers:
    least = MOVES * surface.speed
    linear, angular = (float(np.linalg.norm(result.jump[part])) for part in (slice(3), slice(3, 6)))
    return Numbers(
        jump=float(np.linalg.norm(result.jump)),
        linear=linear if robot.floating else None,
        angular=angular if robot.floating else None,
        joint=abs(float(result.jump[robot.tangent_names.index(joint)])),
        impulse=float(surface.normal @ result.impulse),
        force=result.force,
        slips=result.slip > least,
        feet=(feet := _fastest(frames, result.feet)),
        moving=frozenset(frame for frame, speed in feet.items() if speed > least),
    )


def _fastest(frames: list[str], speeds: Vector) -> dict[str, float]:
    """Return the speed of the fastest point of each foot, m/s; empty if the feet are held."""
    return {
        frame: max(float(v) for f, v in zip(frames, speeds, strict=False) if f == frame)
        for frame in dict.fromkeys(frames[: len(speeds)])
    }


def _worst_share(robot: Robot, jump: Vector) -> Vector:
    """Return the jump of each joint as a share of its velocity limit, shape (nv,); zero for a floating base."""
    shares = np.abs(jump) / robot.velocity_limits
    shares[: robot.first_joint] = 0.0
    return shares


def feet_of(robot: Robot) -> tuple[list[Point], list[str]]:
    """Return the points of the feet in robot.toml, and the frame of each point."""
    points, frames = list[Point](), list[str]()
    for support in robot.spec.supports:
        foot = point_on(robot, support.frame, support.offset)
        X, Y = support.size
        corners = [(x, y, 0.0) for x in (-X, X) for y in (-Y, Y)] if support.has_sole else [(0.0, 0.0, 0.0)]
        points += [Point(foot.joint, foot.placement.act(np.array(corner))) for corner in corners]
        frames += [support.frame] * len(corners)
    return points, frames
