"""Offline posture optimization for the impact of a scenario, with the constraints of ``impact-posture optimize``."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from impact_posture.config.problem_settings import FRICTION, SURFACE_SPREAD, ProblemSettings
from impact_posture.dynamics.chart import Chart
from impact_posture.dynamics.numeric import Numeric
from impact_posture.errors import Infeasible, SolverFailed
from impact_posture.impact.impact_contact import point_on
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.posture.analysis.verdict_conditions import near_surface
from impact_posture.posture.constraints.posture_distance import distance
from impact_posture.posture.constraints.requirements import Requirements
from impact_posture.posture.formulation.build_problem import build_problem
from impact_posture.posture.formulation.problem_file import requirements
from impact_posture.posture.search.multistart import PostureSolution, solve
from impact_posture.simulation.setup import Setup, naming_keys
from impact_posture.system.arrays import Array
from impact_posture.system.progress import tell
from impact_posture.tsid.flow.flow_direction import FlowOptions

# To hold the posture, motors and rotors may need at most this share of their limits.
SHARE = 0.8
# Default number of starts.
OFFLINE_STARTS = 8
# Weight of the squared distance from the start, relative to the objective at the start.  With this weight, a humanoid
# moves half as far, and its objective is 1 % larger.  The humanoid thus avoids postures in which its controller loads
# the legs unevenly.
_NEARNESS = 0.005
# Pairs of margins, tried in this order, because large margins are not feasible for every start posture: distance from
# the joint stops, rad (m), so that no joint rests on a stop; and distance of the center of mass from the edges of the
# support polygon, m, so that an impact does not tip the robot.
_MARGINS = ((0.1, 0.05), (0.0, 0.05), (0.0, 0.025), (0.0, 0.0))
# Distance from the joint stops of a robot that falls, rad (m), so that the impact does not straighten its legs.
_LANDING_MARGIN = 0.5


@dataclass(frozen=True, eq=False)
class OfflinePosture:
    """Optimal posture for the impact of a scenario.

    Attributes:
        solution: Solution of the posture optimization.
        objective: Objective at the optimal posture.
        initial: Objective at the start posture after its projection onto the constraints.
        distance: Distance of the optimal posture from the projected start posture, rad (m).
        note: Requirements that the posture does not satisfy, and the reasons; empty if it satisfies all requirements.
    """

    solution: PostureSolution
    objective: float
    initial: float
    distance: float
    note: str = ""

    @property
    def q(self) -> Array:
        """The posture, shape (nq,)."""
        return self.solution.q

    def to_dict(self) -> dict[str, object]:
        """Return JSON content."""
        numbers = {name: getattr(self, name) for name in ("objective", "initial", "distance", "note")}
        return {"q": self.q.tolist(), **numbers}


def offline_posture(
    setup: Setup,
    objective: WorstCaseObjective,
    *,
    starts: int = OFFLINE_STARTS,
    at_contact: bool = True,
    strikes: bool = False,
) -> OfflinePosture:
    """Optimize the posture for the impact of a scenario.

    The result satisfies these constraints:

    - The robot does not collide with itself, the surface or the ground.
    - Motors and rotors need at most :data:`SHARE` of their limits to hold the posture.
    - The end effector touches the surface, with the pose that its task controls.  If ``at_contact`` is false, the
      end effector stays at its start.
    - The base of a flying robot stays level.
    - The feet of a standing robot stay in place.  The center of mass is above the feet, and the base tilts at most as
      far as the reference flow allows.
    - If the robot ``strikes``, its joints reach the speed of the contact, increased by the spread of the speed in
      ``[spread]`` of the scenario, or else the greatest possible speed.  Only the end effector touches the surface,
      also if the surface is tilted and shifted as far as ``[spread]`` states, or by :data:`SURFACE_SPREAD` if this
      is more.  No foot of a standing robot lifts or slides during the impact.
    - A robot that falls touches the surface with its feet, which are as far apart as in the start posture.

    If no posture satisfies all constraints, these constraints are dropped in this order: tilt and shift of the
    surface, feet that stay during the impact, collisions.  The ``note`` of the result states the dropped constraints.

    Raises:
        Infeasible, SolverFailed: The same errors as in :func:`impact_posture.posture.search.multistart.solve`.
    """
    tell("looking for the offline posture")
    wanted = scenario_requirements(setup, objective, at_contact=at_contact, strikes=strikes)
    notes = dict[tuple[bool, bool], str]()
    # A robot that does not stand has no support polygon, so the second margin is zero.
    margins = dict.fromkeys((stops, edges if wanted.com_over_feet else 0.0) for stops, edges in _MARGINS)
    if setup.scenario.falls:
        margins = {(_LANDING_MARGIN, 0.0): None, **margins}
    kept = strikes and bool(objective.supports)
    levels = dict.fromkeys(((kept, True), (False, True), (False, False)))
    attempts = [(*level, *margin) for level in levels for margin in margins]
    for keep, collision, stops, edges in attempts:
        demands = replace(wanted, keep_contacts=keep, collision=collision, limit_margin=stops, com_margin=edges)
        try:
            with naming_keys(setup.scenario):
                problem = build_problem(setup.robot, objective, setup.landed, demands)
                solution = solve(problem, starts=starts, jobs=1, progress=_tell)
        except (Infeasible, SolverFailed) as error:
            if (keep, collision, stops, edges) == attempts[-1]:
                raise
            if keep:
                what = "feet may lift or slide at the impact, because no posture in which they stay is known"
            else:
                what = "links may touch in the offline posture, because none without collisions is known"
            notes[keep, collision] = f"{what}: {error}"
            continue
        value, initial = objective.value(solution.q), objective.value(solution.initial)
        moved = distance(Chart(setup.robot.model), solution.q, solution.initial)
        notes.pop((keep, collision), None)
        lines = list(notes.values())
        if (clear := solution.problem.requirements.surface_spread) != demands.surface_spread:
            lines.append(near_surface(*clear))
        return OfflinePosture(solution, value, initial, moved, "; ".join(lines))
    raise AssertionError("the last attempt returns or raises")


def scenario_requirements(
    setup: Setup, objective: WorstCaseObjective, *, at_contact: bool = True, strikes: bool = False
) -> Requirements:
    """Return the requirements of a scenario without margins, for the arguments of :func:`offline_posture`."""
    control, contact, base, target = setup.scenario.control, objective.contact, "free", None
    if setup.robot.floating:
        base = "level" if control.tilt is not None else f"level:{np.rad2deg(FlowOptions().tilt)}"
    if at_contact and control.end_effector is not None and setup.scenario.contacts:
        placement = Numeric(setup.robot.model).at(setup.q).placement(point_on(setup.robot, contact.frame))
        x, y, z = (placement.translation - setup.gap * setup.scenario.normal).tolist()
        target = (x, y, z)
    held = "position" if setup.scenario.falls else "free"
    settings = ProblemSettings(
        robot=setup.scenario.robot,
        frame=contact.frame,
        normal=contact.normal,
        contact_pose=held if control.end_effector is None else control.end_effector.pose,
        target_position=target,
        base=base,
        regularization=_NEARNESS,
        friction=FRICTION if control.footing is None else control.footing.friction,
    )
    if strikes and setup.scenario.contacts is not None:
        (tilt, shift), spread = SURFACE_SPREAD, setup.scenario.spread
        speed = (1 + spread.speed) * setup.scenario.contacts.speed
        larger = max(tilt, spread.normal), max(shift, spread.gap)
        settings = replace(settings, strike=True, speed=speed, surface_spread=larger)
    demands = requirements(settings, objective)
    over_feet = demands.com_over_feet or bool(objective.supports)
    return replace(demands, com_over_feet=over_feet, com_asked=False, limit_share=SHARE)


def _tell(done: int, total: int) -> None:
    tell("looking for the offline posture", done / total)
