"""Objectives against measured impacts: random postures of a task, and the optimum of each objective."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import scipy.stats

from docs.studies.cases import CASES, Case
from docs.studies.core import Vector
from docs.studies.impact.surface import Measured, NoImpact, Scene, Surface
from impact_posture.errors import ImpactPostureError
from impact_posture.impact.quantities.impact_quantities import ImpactQuantities
from impact_posture.posture.manifold.feasible_start import feasible_start
from impact_posture.posture.search.multistart import solve

OBJECTIVES = {"impulse": "H", "speed": "V", "sticking": "S", "coulomb": "C", "energy": "E"}
# Friction for which ``coulomb`` picks a posture.
PICKED_FOR = 0.3
# The robot whose contact point weighs least.
LIGHTEST = "hextilt"
# A contact point that leaves with more tangential speed than this share of v_n has slid.
SLID = 0.01
# Cases by robot, with the contact pose that random postures keep, and words.
STUDIED: dict[str, tuple[Case, str, str]] = {
    CASES[name].robot: (CASES[name], pose, words)
    for name, pose, words in (
        ("tilthex_arm, wall", "position", "flies as one body, the arm's end against a wall"),
        ("panda", "position", "bolted down, the hand's tip onto a table"),
        ("talos, wall", "position", "stands on two feet, a hand against a wall"),
        ("solo12, wall", "free", "stands on four feet, the base against a wall"),
        ("hextilt, wall", "position", "flies as one body, the arm's end against a wall"),
    )
}
# Without friction, ice, two everyday surfaces, and one on which nothing slides.
FRICTIONS = (0.0, 0.1, 0.3, 0.8, np.inf)
# Other variations of an impact: words, and the surface without its friction.
VARIATIONS = (
    ("0.1 m/s", Surface(speed=0.1)),
    ("3 m/s", Surface(speed=3.0)),
    ("rebound, ζ = 0.3", Surface(damping=0.3)),
    ("rebound, ζ = 0.1", Surface(damping=0.1)),
    ("T = 1 ms", Surface(time=1e-3)),
    ("T = 10 ms", Surface(time=1e-2)),
)


def needed_friction(predicted: ImpactQuantities) -> float:
    """Return the least friction that makes the contact point stick: tangential over normal part of its impulse."""
    s, n = predicted.sticking_impulse, predicted.normal
    return float("nan") if s is None else float(np.linalg.norm(s - (n @ s) * n) / (n @ s))


@dataclass(frozen=True)
class Outcome:
    """Prediction and measurement at one posture."""

    predicted: ImpactQuantities
    measured: Measured
    speed: float
    coulomb: Vector  # predicted jump per approach speed with the friction of the surface

    def value(self, objective: str) -> float:
        """The value of an objective."""
        if objective == "coulomb":
            return float(self.coulomb @ self.coulomb)
        return float(getattr(self.predicted, OBJECTIVES[objective]))

    def deviation(self, objective: str) -> float:
        """``‖Δν − predicted Δν‖`` over the predicted norm, for all objectives except ``impulse`` and ``energy``."""
        o, rebound = self.predicted, (1 + self.measured.restitution) * self.speed
        jumps = {"speed": o.jump / o.G, "sticking": o.sticking_jump, "coulomb": self.coulomb}
        predicted = rebound * np.asarray(jumps[objective])
        return float(np.linalg.norm(self.measured.jump - predicted) / np.linalg.norm(predicted))

    @property
    def per_impulse(self) -> float:
        """``‖Δν‖/λ``, which ``√H`` predicts."""
        return self.measured.size / self.measured.impulse

    def ratio(self, objective: str) -> float:
        """Return measured over predicted jump, or for energy the loss.

        ``impulse`` uses the measured normal impulse; the others use approach speed and measured restitution.
        """
        m, value, v = self.measured, self.value(objective), self.speed
        if objective == "impulse":
            return self.per_impulse / float(np.sqrt(value))
        if objective == "energy":
            return m.loss / ((1 - m.restitution**2) * v**2 * value)
        return m.size / ((1 + m.restitution) * v * float(np.sqrt(value)))


@dataclass(frozen=True)
class Row:
    """One robot on one surface: the counted postures, and the number of the others by reason."""

    robot: str
    surface: Surface
    outcomes: tuple[Outcome, ...]
    left_out: Counter[str]

    def rank(self, objective: str, of: Callable[[Outcome], float] = lambda o: o.measured.size) -> float:
        """Return Spearman's rank correlation of a measurement, by default the jump, with an objective."""
        values = [o.value(objective) for o in self.outcomes]
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

    def split(self) -> tuple[Row, Row]:
        """Return the postures that the friction of the surface should hold, and the others."""
        holds = [needed_friction(o.predicted) <= self.surface.friction for o in self.outcomes]
        held, rest = (
            replace(self, outcomes=tuple(o for o, h in zip(self.outcomes, holds, strict=True) if h is wanted))
            for wanted in (True, False)
        )
        return held, rest


@dataclass(frozen=True, eq=False)
class Dropped:
    """The random postures of one robot, ready to meet surfaces."""

    robot: str
    scenes: tuple[tuple[Scene, ImpactQuantities], ...]
    left_out: Counter[str]

    @staticmethod
    def prepare(robot: str, count: int, seed: int) -> Dropped:
        """Draw postures that keep the limits, the feet, and the place of the contact point."""
        case, pose, _ = STUDIED[robot]
        problem = case.problem(contact_pose=pose)
        left_out: Counter[str] = Counter()
        scenes = []
        for index in range(1, count + 1):
            try:
                q = feasible_start(problem, index, seed)
                if q is None:
                    raise NoImpact("not on the constraints")
                quantities = problem.impact.oracle.quantities(q)
                if quantities.S is None:
                    raise NoImpact("S undefined")
                scenes.append((Scene(problem.objective, q), quantities))
            except NoImpact as reason:
                left_out[str(reason)] += 1
        return Dropped(robot, tuple(scenes), left_out)

    def on(self, surface: Surface) -> Row:
        """Drop them all."""
        left_out, outcomes = Counter(self.left_out), []
        for scene, predicted in self.scenes:
            try:
                coulomb = scene.with_friction(surface.friction)
                outcomes.append(Outcome(predicted, scene.hit(surface), surface.speed, coulomb))
            except NoImpact as reason:
                left_out[str(reason)] += 1
        return Row(self.robot, surface, tuple(outcomes), left_out)


@dataclass(frozen=True)
class Choice:
    """Posture that an objective picks, or the start; measurements by friction, ``None`` without an impact."""

    robot: str
    objective: str
    predicted: ImpactQuantities
    measured: dict[float, Measured | None]


def choices(robot: str, starts: int = 16) -> list[Choice] | ImpactPostureError:
    """Optimize each objective without collisions and loads, and simulate the impact in the optimal posture."""
    picked: list[Choice] = []
    for objective in OBJECTIVES:
        problem = STUDIED[robot][0].problem(objective=objective, friction=PICKED_FOR)
        try:
            solution = solve(problem, starts=starts, jobs=1)
        except ImpactPostureError as error:
            return error
        for name, q in (("start", solution.initial), (objective, solution.q))[bool(picked) :]:
            scene = Scene(problem.objective, q)
            measured = {mu: _try(scene, Surface(mu)) for mu in FRICTIONS}
            picked.append(Choice(robot, name, problem.impact.oracle.quantities(q), measured))
    return picked


def _try(scene: Scene, surface: Surface) -> Measured | None:
    try:
        return scene.hit(surface)
    except NoImpact:
        return None
