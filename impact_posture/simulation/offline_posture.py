"""Offline optimum for the impact of a scenario, under the constraints of ``impact-posture optimize``."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from impact_posture.config.problem_settings import FRICTION, ProblemSettings
from impact_posture.dynamics.chart import Chart
from impact_posture.dynamics.numeric import Numeric
from impact_posture.errors import Infeasible, SolverFailed
from impact_posture.impact.impact_contact import point_on
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.posture.constraints.posture_distance import distance
from impact_posture.posture.constraints.requirements import Requirements
from impact_posture.posture.formulation.build_problem import build_problem
from impact_posture.posture.formulation.problem_file import requirements
from impact_posture.posture.search.multistart import PostureSolution, solve
from impact_posture.simulation.setup import Setup, naming_keys
from impact_posture.system.arrays import Array
from impact_posture.system.progress import tell
from impact_posture.tsid.flow.flow_direction import FlowOptions

# Share of the limits that holding a posture may take.
SHARE = 0.8
# Weight of the squared distance from the start, relative to the objective there.  With it, a humanoid moves half as
# far and gives up 1 % of the objective.  So it avoids postures in which its controller loads the legs unevenly.
_NEARNESS = 0.005
# Margins in the order of preference, because not every start allows them.  The first is the distance from the joint
# stops, rad (m), because a joint at a stop rests on it.  The second is the distance of the center of mass from the
# edges of the support polygon, m, because an impact tips a robot that stands near an edge.
_MARGINS = ((0.1, 0.05), (0.0, 0.05), (0.0, 0.025), (0.0, 0.0))


@dataclass(frozen=True, eq=False)
class OfflinePosture:
    """Offline optimum of a scenario.

    Attributes:
        objective: Objective at the posture.
        initial: Objective at the start posture after its projection onto the constraints.
        distance: Distance from the projected start, rad (m).
        note: Requirement that was dropped, and the reason.
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
    setup: Setup, objective: WorstCaseObjective, *, starts: int = 8, at_contact: bool = True
) -> OfflinePosture:
    """Optimize the posture for the impact of a scenario.

    The constraints are those of ``impact-posture optimize``: no collision with itself, the surface or the ground, and
    at most :data:`SHARE` of the limits of motors and rotors to hold the posture.  The end effector is at the surface,
    as far as its task controls it.  The base of a flying robot stays level.  The feet of a standing robot stay in
    place, the center of mass is above them, and the base tilts no further than the reference flow may tilt it.  If
    every posture has collisions, the best one is taken with a note.  Without ``at_contact``, the end effector stays
    at its start.

    Raises:
        Infeasible, SolverFailed: As :func:`impact_posture.posture.search.multistart.solve`.
    """
    tell("looking for the offline posture")
    wanted, note = scenario_requirements(setup, objective, at_contact=at_contact), ""
    # For a robot that does not stand, the margin of the center of mass has no meaning.
    margins = dict.fromkeys((stops, edges if wanted.com_over_feet else 0.0) for stops, edges in _MARGINS)
    attempts = [(collision, *margin) for collision in (True, False) for margin in margins]
    for collision, stops, edges in attempts:
        demands = replace(wanted, collision=collision, limit_margin=stops, com_margin=edges)
        try:
            with naming_keys(setup.scenario):
                problem = build_problem(setup.robot, objective, setup.q, demands)
                solution = solve(problem, starts=starts, jobs=1, progress=_tell)
        except (Infeasible, SolverFailed) as error:
            if (collision, stops, edges) == attempts[-1]:
                raise
            if collision:
                note = f"links may touch in the offline posture, because none without collisions was found: {error}"
            continue
        value, initial = objective.value(solution.q), objective.value(solution.initial)
        moved = distance(Chart(setup.robot.model), solution.q, solution.initial)
        return OfflinePosture(solution, value, initial, moved, "" if collision else note)
    raise AssertionError("the last attempt returns or raises")


def scenario_requirements(setup: Setup, objective: WorstCaseObjective, *, at_contact: bool = True) -> Requirements:
    """Return the requirements of a scenario without margins, for the arguments of :func:`offline_posture`."""
    control, contact, base, target = setup.scenario.control, objective.contact, "free", None
    if setup.robot.floating:
        base = "level" if control.tilt is not None else f"level:{np.rad2deg(FlowOptions().tilt)}"
    if at_contact and control.end_effector is not None and setup.scenario.contacts:
        placement = Numeric(setup.robot.model).at(setup.q).placement(point_on(setup.robot, contact.frame))
        x, y, z = (placement.translation - setup.gap * setup.scenario.normal).tolist()
        target = (x, y, z)
    settings = ProblemSettings(
        robot=setup.scenario.robot,
        frame=contact.frame,
        normal=contact.normal,
        contact_pose="free" if control.end_effector is None else control.end_effector.pose,
        target_position=target,
        base=base,
        regularization=_NEARNESS,
        friction=FRICTION if control.footing is None else control.footing.friction,
    )
    demands = requirements(settings, objective)
    return replace(demands, com_over_feet=bool(objective.supports), com_asked=False, limit_share=SHARE)


def _tell(done: int, total: int) -> None:
    tell("looking for the offline posture", done / total)
