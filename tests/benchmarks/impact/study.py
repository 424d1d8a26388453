"""Objectives against measured impacts: random postures of a task, and the optimum of each objective."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.stats
from numpy.typing import NDArray

from impact_posture.errors import ImpactPostureError
from impact_posture.impact.oracle import ImpactQuantities
from impact_posture.posture.problem import PostureProblem
from impact_posture.posture.problem_settings import make_settings, prepare
from impact_posture.posture.solve import solve
from impact_posture.posture.starts import feasible_start
from tests.benchmarks.impact.surface import Measured, NoImpact, Scene, Surface

Vector = NDArray[np.float64]

OBJECTIVES = ("impulse", "speed", "sticking", "energy")
LETTERS = dict(zip(OBJECTIVES, "HVSE", strict=True))
# A contact point that leaves with more tangential speed than this share of v_n has slid.
SLID = 0.01


@dataclass(frozen=True)
class Case:
    """A robot and what it touches.

    Attributes:
        robot: Known name.
        frame: Contact frame.
        normal: Out of the surface, world.
        pose: What random postures keep of the contact frame.
        words: For the table.
    """

    robot: str
    frame: str
    normal: tuple[float, float, float]
    pose: str
    words: str

    def problem(self, **more: object) -> PostureProblem:
        """The problem that ``impact-posture optimize`` solves for it."""
        values = {"robot": self.robot, "frame": self.frame, "normal": self.normal, **more}
        return prepare(make_settings(values)).problem


CASES = (
    Case("tilthex_arm", "ee", (-1, 0, 0), "position", "flies as one body, the arm's end against a wall"),
    Case("panda", "panda_hand_tcp", (0, 0, 1), "position", "bolted down, the hand's tip onto a table"),
    Case("talos", "gripper_right_base_link", (-1, 0, 0), "position", "stands on two feet, a hand against a wall"),
    Case("solo12", "base_link", (-1, 0, 0), "free", "stands on four feet, the base against a wall"),
)
# Without friction, two everyday surfaces, and one on which nothing slides.
FRICTIONS = (0.0, 0.3, 0.8, np.inf)
# What else an impact may differ in: words, and the surface but for its friction.
VARIATIONS = (
    ("0.1 m/s", Surface(speed=0.1)),
    ("3 m/s", Surface(speed=3.0)),
    ("rebound, ζ = 0.3", Surface(damping=0.3)),
    ("rebound, ζ = 0.1", Surface(damping=0.1)),
    ("T = 1 ms", Surface(time=1e-3)),
    ("T = 10 ms", Surface(time=1e-2)),
)


def needed_friction(predicted: ImpactQuantities) -> float:
    """Least coefficient with which the contact point sticks: tangential over normal part of the sticking impulse."""
    s, n = predicted.sticking_impulse, predicted.normal
    if s is None:
        return float("nan")
    return float(np.linalg.norm(s - (n @ s) * n) / (n @ s))


@dataclass(frozen=True)
class Outcome:
    """One posture: what the objectives say, and what happened."""

    predicted: ImpactQuantities
    measured: Measured
    speed: float

    def deviation(self, objective: str) -> float:
        """``‖Δν − predicted Δν‖`` over its size, for ``speed`` or ``sticking``: the vector, whatever the metric."""
        o, rebound = self.predicted, (1 + self.measured.restitution) * self.speed
        predicted = rebound * (o.jump / o.G if objective == "speed" else np.asarray(o.sticking_jump))
        return float(np.linalg.norm(self.measured.jump - predicted) / np.linalg.norm(predicted))

    @property
    def per_impulse(self) -> float:
        """``‖Δν‖/λ``: what ``√H`` claims to be."""
        return self.measured.size / self.measured.impulse

    def ratio(self, objective: str) -> float:
        """Measured over predicted, of what the objective is about: the jump, for energy the loss.

        ``impulse`` is given the measured normal impulse; the others approach speed and measured restitution.
        """
        o, m = self.predicted, self.measured
        e, v = m.restitution, self.speed
        if objective == "impulse":
            return self.per_impulse / float(np.sqrt(o.H))
        if objective == "energy":
            return m.loss / ((1 - e**2) * v**2 * o.E)
        square = o.V if objective == "speed" else o.S
        assert square is not None
        return m.size / ((1 + e) * v * float(np.sqrt(square)))


@dataclass(frozen=True)
class Row:
    """One robot on one surface.

    Attributes:
        case: The robot.
        surface: What it met.
        outcomes: Of the postures that are counted.
        left_out: How many are not, by reason.
    """

    case: Case
    surface: Surface
    outcomes: tuple[Outcome, ...]
    left_out: Counter[str]

    def rank(self, objective: str, of: Callable[[Outcome], float] = lambda o: o.measured.size) -> float:
        """Spearman's rank correlation of something measured, by default the jump, with an objective's value."""
        values = [getattr(o.predicted, LETTERS[objective]) for o in self.outcomes]
        return float(scipy.stats.spearmanr([of(o) for o in self.outcomes], values).statistic)

    def ratios(self, objective: str) -> Vector:
        """Measured over predicted, sorted."""
        return np.sort([o.ratio(objective) for o in self.outcomes])

    def measured(self, name: str) -> Vector:
        """One measured quantity of all postures."""
        return np.array([getattr(o.measured, name) for o in self.outcomes])

    @property
    def slid(self) -> int:
        """Postures whose contact point left with a tangential speed."""
        return int((self.measured("slip") > SLID).sum())

    @property
    def held(self) -> Row:
        """Only the postures that the surface has the friction to hold, by what they need to stick."""
        kept = tuple(o for o in self.outcomes if needed_friction(o.predicted) <= self.surface.friction)
        return replace(self, outcomes=kept)


@dataclass(frozen=True, eq=False)
class Dropped:
    """The random postures of one robot, ready to meet surfaces."""

    case: Case
    scenes: tuple[tuple[Scene, ImpactQuantities], ...]
    left_out: Counter[str]

    @staticmethod
    def prepare(case: Case, count: int, seed: int) -> Dropped:
        """Draw postures that the task allows: limits, feet, and the place of the contact point are kept."""
        problem = case.problem(contact_pose=case.pose)
        left_out: Counter[str] = Counter()
        scenes = []
        for index in range(1, count + 1):
            q = feasible_start(problem, index, seed)
            if q is None:
                left_out["not on the constraints"] += 1
                continue
            found = problem.impact.oracle.quantities(q)
            if found.S is None:
                left_out["S undefined"] += 1
                continue
            try:
                scenes.append((Scene(problem.objective, q), found))
            except NoImpact as reason:
                left_out[str(reason)] += 1
        return Dropped(case, tuple(scenes), left_out)

    def on(self, surface: Surface) -> Row:
        """Drop them all."""
        left_out, outcomes = Counter(self.left_out), []
        for scene, predicted in self.scenes:
            try:
                outcomes.append(Outcome(predicted, scene.hit(surface), surface.speed))
            except NoImpact as reason:
                left_out[str(reason)] += 1
        return Row(self.case, surface, tuple(outcomes), left_out)


@dataclass(frozen=True)
class Choice:
    """What one objective picks.

    Attributes:
        objective: Its name; ``start`` for the initial posture.
        predicted: The impact quantities there.
        measured: By friction coefficient; ``None`` where the impact did not come off.
    """

    objective: str
    predicted: ImpactQuantities
    measured: dict[float, Measured | None]


def choices(
    case: Case, frictions: Sequence[float] = FRICTIONS, starts: int = 16
) -> list[Choice] | ImpactPostureError:
    """Optimize each objective with the command's defaults, and drop the robot in what comes out."""
    found: list[Choice] = []
    for objective in OBJECTIVES:
        problem = case.problem(objective=objective)
        try:
            solution = solve(problem, starts=starts, jobs=1)
        except ImpactPostureError as error:
            return error
        for name, q in (("start", solution.initial), (objective, solution.q))[bool(found) :]:
            scene = Scene(problem.objective, q)
            measured = {mu: _try(scene, Surface(mu)) for mu in frictions}
            found.append(Choice(name, problem.impact.oracle.quantities(q), measured))
    return found


def _try(scene: Scene, surface: Surface) -> Measured | None:
    try:
        return scene.hit(surface)
    except NoImpact:
        return None
