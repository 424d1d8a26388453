"""Offline optimum for the impact of a scenario, under the constraints of ``impact-posture optimize``."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from impact_posture.config.settings import FRICTION, ProblemSettings
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
# Weight of the squared distance from the start, relative to the objective there.  A humanoid goes half as far for a
# hundredth of the objective, and so stays clear of postures whose load its controller shares badly between the legs.
_NEARNESS = 0.005
# Distances that the start may make impossible, most wanted first: from the joint stops, rad (m), because a robot on
# a stop braces on it, and of the center of mass from the edges of the support polygon, m, because an impact tips a
# robot that stands on its heels.
_MARGINS = ((0.1, 0.05), (0.0, 0.05), (0.0, 0.025), (0.0, 0.0))


@dataclass(frozen=True, eq=False)
class OfflinePosture:
    """The posture that was found.

    Attributes:
        solution: What the optimizer found.
        objective: Objective at the posture.
        initial: Objective at the start posture of the scenario, after it was put on the constraints.
        distance: Distance from the posture there, rad (m).
        note: What could not be demanded of the posture, and why.
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
    at most :data:`SHARE` of the limits of motors and rotors to hold the posture.  The end effector is where it meets
    the surface, as far as its task holds it.  The base of a robot that flies stays level.  The feet of a robot that
    stands stay where they are, with the center of mass above them, and its base tilts as far as the reference flow
    may tilt it.  Where no posture is free of collisions, the best one with them is taken, and a note says so.

    Args:
        setup: The experiment.
        objective: The objective.
        starts: Number of starts of the optimizer.
        at_contact: Whether the end effector is where it meets the surface, else where it starts.

    Raises:
        Infeasible, SolverFailed: As :func:`impact_posture.posture.search.multistart.solve`.
    """
    tell("looking for the offline posture")
    wanted, note = scenario_requirements(setup, objective, at_contact=at_contact), ""
    # Margins of the center of mass are none for a robot that does not stand.
    margins = dict.fromkeys((stops, edges if wanted.com_over_feet else 0.0) for stops, edges in _MARGINS)
    tries = [(collision, *each) for collision in (True, False) for each in margins]
    for collision, stops, edges in tries:
        demands = replace(wanted, collision=collision, limit_margin=stops, com_margin=edges)
        try:
            with naming_keys(setup.scenario):
                problem = build_problem(setup.robot, objective, setup.q, demands)
                solution = solve(problem, starts=starts, jobs=1, progress=_tell)
        except (Infeasible, SolverFailed) as error:
            if (collision, stops, edges) == tries[-1]:
                raise
            if collision:
                note = f"links may touch in the offline posture, because none without collisions was found: {error}"
            continue
        value, initial = objective.value(solution.q), objective.value(solution.initial)
        way = distance(Chart(setup.robot.model), solution.q, solution.initial)
        return OfflinePosture(solution, value, initial, way, "" if collision else note)
    raise AssertionError("the last attempt returns or raises")


def scenario_requirements(setup: Setup, objective: WorstCaseObjective, *, at_contact: bool = True) -> Requirements:
    """Return what a scenario demands of a posture, without margins; arguments as of :func:`offline_posture`."""
    control, contact, base, target = setup.scenario.control, objective.contact, "free", None
    if setup.robot.floating:
        base = "level" if control.tilt is not None else f"level:{np.rad2deg(FlowOptions().tilt)}"
    if at_contact and control.end_effector is not None and setup.scenario.contacts:
        place = Numeric(setup.robot.model).at(setup.q).placement(point_on(setup.robot, contact.frame))
        x, y, z = (place.translation - setup.gap * setup.scenario.normal).tolist()
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
