"""Data for the figures of a result, and texts that several figures share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from numpy.typing import NDArray

from impact_posture.config.problem_settings import RESTITUTION, SPEED, Against
from impact_posture.errors import InputError, MetricError
from impact_posture.impact.evaluation.impact_effect import tangent_units
from impact_posture.impact.evaluation.objective_value import objective_value
from impact_posture.impact.kinds.impact_kind import ImpactKind
from impact_posture.impact.quantities.impact_oracle import ImpactOracle
from impact_posture.impact.quantities.impact_quantities import ImpactQuantities
from impact_posture.impact.worst_case.worst_normal import WorstNormal
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.robot.robot import Robot
from impact_posture.system.arrays import Array

if TYPE_CHECKING:
    from impact_posture.path.posture_path import PosturePath
    from impact_posture.posture.manifold.null_space_path import NullSpacePath
    from impact_posture.posture.search.global_search import SelfMotionMap

_Data = TypeVar("_Data")

ALONE = "numbers and ellipsoids"
"""Start of the line in the header that names the shown contact, if there are several contacts."""

SEPARATOR = "  ·  "
"""Separator of the facts in a header line."""

_UNITS = {"H": "‖Δν‖²/(N·s)²", "G": "1/kg", "V": "‖Δν‖²/(m/s)²", "S": "‖Δν‖²/(m/s)²", "E": "kg"}


@dataclass(frozen=True, eq=False)
class TradeOffData:
    """Best postures for increasing bounds on the distance from the initial posture, or on the peak force.

    Arrays have the shape (k,).  The first entry belongs to the initial posture.  S is NaN if it is undefined.

    Attributes:
        within: Bounds on the distance (rad mixed with m) or on the force (N), increasing.
        certified: Whether the certificate of each posture holds.
        knee: Index of the knee; ``None`` if the curve has no knee.
        against: The bounded quantity, ``distance`` or ``force``.
    """

    within: Array
    objective: Array
    H: Array
    G: Array
    V: Array
    S: Array
    certified: NDArray[np.bool_]
    knee: int | None = None
    against: Against = "distance"


@dataclass(frozen=True, eq=False)
class ResultView:
    """Data for the figures of a result.  "Before" is the initial posture, and "after" is the optimal posture.

    Attributes:
        objective: Objective with robot, contacts, metric and supports.
        q_initial: Initial posture, shape (nq,).
        q_optimal: Optimal posture, or the posture where the path towards it ends, shape (nq,).
        speed: Approach speed along the normal, m/s.
        restitution: Coefficient of restitution e, in [0, 1].
        path: Quantities along the null-space path between both postures; ``None`` if unknown.
        tradeoff: Trade-off of objective against distance or force; ``None`` if it was not computed.
        motion: Path to the optimum over time; ``None`` if it was not searched.
        self_motion: Map of the self-motion manifold; ``None`` if it was not computed.
        collisions: Pairs of names of colliding shapes, at the start and at the optimum.
        depths: Distance from each contact point to the surface behind it, m; empty without surroundings.
        pushed: Whether the robot is pushed (free contact pose) instead of striking a surface.
    """

    objective: WorstCaseObjective
    q_initial: Array
    q_optimal: Array
    speed: float = SPEED
    restitution: float = RESTITUTION
    path: NullSpacePath | None = None
    tradeoff: TradeOffData | None = None
    motion: PosturePath | None = None
    self_motion: SelfMotionMap | None = None
    collisions: tuple[Sequence[tuple[str, str]], Sequence[tuple[str, str]]] = ((), ())
    depths: tuple[float, ...] = ()
    pushed: bool = False

    @property
    def robot(self) -> Robot:
        """The robot."""
        return self.objective.robot

    @cached_property
    def before(self) -> ImpactQuantities:
        """Quantities at ``q_initial``."""
        return self.objective.oracle.quantities(self.q_initial)

    @cached_property
    def after(self) -> ImpactQuantities:
        """Quantities at ``q_optimal``."""
        return self.objective.oracle.quantities(self.q_optimal)

    @cached_property
    def free(self) -> tuple[ImpactQuantities, ...]:
        """Quantities at the start and at the optimum, without the supports; empty for a robot without supports."""
        if not self.objective.supports:
            return ()
        oracle = ImpactOracle(replace(self.objective.case, supports=()))
        return oracle.quantities(self.q_initial), oracle.quantities(self.q_optimal)

    @cached_property
    def worst(self) -> tuple[WorstNormal | None, WorstNormal | None]:
        """Worst normals at the start and at the optimum, world; ``None`` if undefined or without a cone."""

        def worst(q: Array) -> WorstNormal | None:
            try:
                return cone.worst_in_world(q) if cone is not None else None
            except MetricError:
                return None

        cone = self.objective.normal_cone
        return worst(self.q_initial), worst(self.q_optimal)

    def jacobian(self, q: Array) -> Array:
        """Return the Jacobian ``J(q)`` of the world velocity of the contact point, shape (3, nv)."""
        oracle = self.objective.oracle.at(q)
        return np.array(oracle.numeric.jacobian(oracle.point)[:3])


def jump_unit(view: ResultView) -> str:
    """Return the unit of ``‖Δν‖_W``, which depends on the metric."""
    metric = view.objective.metric
    if metric.kind == "kinetic":
        return "√J"
    if metric.kind == "weighted":
        return "weighted"
    return mixed_unit(view.robot)


def objective_unit(view: ResultView) -> str:
    """Return the unit of the objective, which depends on the kind of objective and the metric."""
    jump = jump_unit(view)
    square = "J" if jump == "√J" else f"({jump})²" if "/" in jump and jump[0] != "(" else f"{jump}²"
    return {"impulse": square, "energy": "kg", "effective-mass": "kg"}.get(view.objective.kind, f"{square}/(m/s)²")


def mixed_unit(robot: Robot) -> str:
    """Return the unit of the Euclidean ``‖ν‖``; both units if ν mixes m/s and rad/s."""
    kinds = [u for u in ("m/s", "rad/s") if u in tangent_units(robot)]
    return kinds[0] if len(kinds) == 1 else f"({', '.join(kinds)})"


def contact_letters(view: ResultView) -> list[str]:
    """Return a letter for each contact (" A", " B", …), or an empty text for a single contact."""
    count = len(view.objective.contacts)
    return [f" {letter}" for letter in "ABCDEFGHIJKLMNOPQRSTUVWXYZ"[:count]] if count > 1 else [""]


def header_lines(view: ResultView) -> tuple[str, list[str]]:
    """Return the title of a figure and two lines below it: settings, and H, G, V, S and E at start and optimum."""
    contact, metric, robot = view.objective.contact, view.objective.metric, view.robot
    named = zip(view.objective.contacts, contact_letters(view), strict=True)
    frames = ", ".join(f"{each.frame}{letter and f' ({letter.strip()})'}" for each, letter in named)
    normal = ", ".join(number(v) for v in contact.normal)
    axes = "world" if contact.normal_frame == "world" else "contact frame"
    facts = [f"offset ({', '.join(number(v) for v in contact.offset)}) m"] if any(contact.offset) else []
    cone = view.objective.normal_cone_deg
    source = f" ({_short(metric.source)})" if metric.kind == "weighted" and metric.source else ""
    facts += [
        f"n = ({normal}) in {axes}" + (f", worst within {cone:g}°" if cone else ""),
        f"objective {view.objective.name}" + _worst_values(view),
        f"metric {metric.kind}{source}",
        f"armature {_armature(robot)}",
    ]
    if view.objective.others:
        facts.insert(0, f"{ALONE}: {contact.frame} alone; objective: all contacts together")
    if count := len(view.objective.model_variants):
        facts.insert(0, f"figure and numbers: the nominal model; objective: the worst of {count} models")
    feet = [s.frame for s in view.objective.supports]
    facts.append(f"contact-consistent, on {', '.join(feet)}" if feet else "no supports")
    numbers = []
    for name, unit in _UNITS.items():
        first, second = getattr(view.before, name), getattr(view.after, name)
        shown = f" {unit}" if (first, second) != (None, None) else ""
        numbers.append(f"{name} {number(first)} → {number(second)}{shown}")
    return f"{robot.name}, impact at {frames}", [SEPARATOR.join(facts), SEPARATOR.join(numbers)]


def _worst_values(view: ResultView) -> str:
    """Return a worst-case objective at the start and at the optimum as text; ``""`` for a single impact."""
    if isinstance(view.objective.worst_case, ImpactKind):
        return ""
    return " " + " → ".join(number(objective_value(view.objective, q)) for q in (view.q_initial, view.q_optimal))


def required(data: _Data | None, name: str, figure: str, hint: str) -> _Data:
    """Return ``data``; raise ``InputError`` if it is ``None``, because a figure needs it."""
    if data is None:
        raise InputError(f"there is no {name} to draw", where=f"figure {figure}", hint=hint)
    return data


def contact_speeds(view: ResultView, q: Array, v: Array) -> Array:
    """Return the speed of the first contact point towards its surface, m/s, at each row of a motion."""
    oracle = view.objective.singles[0].oracle
    return np.array([-(oracle.at(here).n @ oracle.J @ velocity) for here, velocity in zip(q, v, strict=True)])


def number(value: float | None) -> str:
    """Format a number with three significant digits and the minus sign "−"; ``undefined`` for ``None`` and NaN."""
    if value is None or np.isnan(value):
        return "undefined"
    if np.isinf(value):
        return "∞" if value > 0 else "−∞"
    rounded = float(f"{value:.3g}") + 0.0
    text = f"{rounded:g}" if abs(rounded) < 1e5 else f"{rounded:.3g}"
    mantissa, _, exponent = text.partition("e")
    return (f"{mantissa}e{int(exponent)}" if exponent else mantissa).replace("-", "−")


def _short(source: str) -> str:
    """Remove the explanation in parentheses and the folders from the name of a data source."""
    return source.split(" (")[0].rsplit("/", 1)[-1]


def _armature(robot: Robot) -> str:
    source = _short(robot.armature_source)
    joints = robot.armature[robot.first_joint :]
    if not joints.size or not joints.any():
        return "zero" if source == "none" else f"zero ({source})"
    low, high = f"{joints.min():.2g}", f"{joints.max():.2g}"
    model = "" if robot.joint_model == "reflected" else f", joint model {robot.joint_model}"
    return f"{low if low == high else f'{low}–{high}'} kg·m² ({source}){model}"
