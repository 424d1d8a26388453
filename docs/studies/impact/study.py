"""Compare objectives with measured impacts, in random postures of a task and in the optimum of each objective."""

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
# Friction coefficient for which the objective ``coulomb`` is optimized.
PICKED_FOR = 0.3
# Robot with the smallest effective mass at the contact point.
LIGHTEST = "hextilt"
# A contact point has slid if its tangential speed after the impact is more than this share of v_n.
SLID = 0.01
# Robot → its optimization problem, the contact pose that random postures keep, and a description.
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
# Friction coefficients of a surface without friction, of ice, of two ordinary surfaces, and of a surface on which
# nothing slides.
FRICTIONS = (0.0, 0.1, 0.3, 0.8, np.inf)
# Other variations of an impact, each with a description and a surface; the friction is set later.
VARIATIONS = (
    ("0.1 m/s", Surface(speed=0.1)),
    ("3 m/s", Surface(speed=3.0)),
    ("rebound, ζ = 0.3", Surface(damping=0.3)),
    ("rebound, ζ = 0.1", Surface(damping=0.1)),
    ("T = 1 ms", Surface(time=1e-3)),
    ("T = 10 ms", Surface(time=1e-2)),
)


def needed_friction(predicted: ImpactQuantities) -> float:
    """Return the smallest friction coefficient for which the contact point sticks.

    The coefficient is the tangential part of the impulse of a sticking contact, divided by the normal part.
    """
    s, n = predicted.sticking_impulse, predicted.normal
    return float("nan") if s is None else float(np.linalg.norm(s - (n @ s) * n) / (n @ s))


@dataclass(frozen=True)
class Outcome:
    """Prediction and measurement at one posture."""

    predicted: ImpactQuantities
    measured: Measured
    speed: float
    coulomb: Vector  # predicted jump per unit approach speed with Coulomb friction of the surface

    def value(self, objective: str) -> float:
        if objective == "coulomb":
            return float(self.coulomb @ self.coulomb)
        return float(getattr(self.predicted, OBJECTIVES[objective]))

    def deviation(self, objective: str) -> float:
        """Return ``‖Δν − predicted Δν‖ / ‖predicted Δν‖``, for all objectives except ``impulse`` and ``energy``."""
        o, rebound = self.predicted, (1 + self.measured.restitution) * self.speed
        jumps = {"speed": o.jump / o.G, "sticking": o.sticking_jump, "coulomb": self.coulomb}
        predicted = rebound * np.asarray(jumps[objective])
        return float(np.linalg.norm(self.measured.jump - predicted) / np.linalg.norm(predicted))

    @property
    def per_impulse(self) -> float:
        """Measured jump per impulse, ``‖Δν‖/λ``, which ``√H`` predicts."""
        return self.measured.size / self.measured.impulse

    def ratio(self, objective: str) -> float:
        """Return the measured jump divided by the predicted jump; for ``energy``, return the ratio of energy losses.

        The prediction for ``impulse`` uses the measured normal impulse.  The other predictions use the approach speed
        and the measured restitution.
        """
        m, value, v = self.measured, self.value(objective), self.speed
        if objective == "impulse":
            return self.per_impulse / float(np.sqrt(value))
        if objective == "energy":
            return m.loss / ((1 - m.restitution**2) * v**2 * value)
        return m.size / ((1 + m.restitution) * v * float(np.sqrt(value)))


@dataclass(frozen=True)
class Row:
    """Outcomes of all postures of one robot on one surface, and the number of omitted postures by reason."""

    robot: str
    surface: Surface
    outcomes: tuple[Outcome, ...]
    left_out: Counter[str]

    def rank(self, objective: str, of: Callable[[Outcome], float] = lambda o: o.measured.size) -> float:
        """Return Spearman's rank correlation of an objective with a measurement, by default the jump."""
        values = [o.value(objective) for o in self.outcomes]
        return float(scipy.stats.spearmanr([of(o) for o in self.outcomes], values).statistic)

    def ratios(self, objective: str) -> Vector:
        """Return the measured jumps divided by the predicted jumps, sorted."""
        return np.sort([o.ratio(objective) for o in self.outcomes])

    def measured(self, name: str) -> Vector:
        return np.array([getattr(o.measured, name) for o in self.outcomes])

    @property
    def slid(self) -> int:
        """Number of postures whose contact point has slid."""
        return int((self.measured("slip") > SLID).sum())

    def split(self) -> tuple[Row, Row]:
        """Return the postures in which the friction of the surface should prevent sliding, and the other postures."""
        holds = [needed_friction(o.predicted) <= self.surface.friction for o in self.outcomes]
        held, rest = (
            replace(self, outcomes=tuple(o for o, h in zip(self.outcomes, holds, strict=True) if h is wanted))
            for wanted in (True, False)
        )
        return held, rest


@dataclass(frozen=True, eq=False)
class Dropped:
    """Random postures of one robot for simulated impacts."""

    robot: str
    scenes: tuple[tuple[Scene, ImpactQuantities], ...]
    left_out: Counter[str]

    @staticmethod
    def prepare(robot: str, count: int, seed: int) -> Dropped:
        """Draw postures within the limits that keep the feet and the contact point in place."""
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
        """Simulate the impact of all postures on a surface."""
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
    """Optimal posture of an objective, or the start posture.

    ``measured`` maps each friction coefficient to a measurement, or to ``None`` if no impact occurs.
    """

    robot: str
    objective: str
    predicted: ImpactQuantities
    measured: dict[float, Measured | None]


def choices(robot: str, starts: int = 16) -> list[Choice] | ImpactPostureError:
    """Optimize each objective without constraints on collisions and loads, and simulate the impact in the optimum."""
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
