"""Offline optimum under the constraints of a scenario, as far as the motors can hold it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from impact_posture.arrays import Array
from impact_posture.dynamics.chart import Chart
from impact_posture.errors import Infeasible, SolverFailed
from impact_posture.impact.objective import ImpactObjective
from impact_posture.posture.build_problem import build_problem
from impact_posture.posture.pareto import pareto_front
from impact_posture.posture.posture_distance import distance
from impact_posture.posture.problem import Requirements
from impact_posture.posture.solve import PostureSolution, solve
from impact_posture.progress import tell
from impact_posture.simulation.driver import Driver
from impact_posture.simulation.scenario import Setup
from impact_posture.simulation.task_formulations import nominal_posture
from impact_posture.tsid.controller import Status

# Share of the limits that holding a posture may take.
SHARE = 0.8
# Number of distances on the way to the optimum at which postures are tried, farthest first.
_POINTS = 16
# Distance from the joint stops, rad (m), because a robot on a stop braces on it.
_MARGIN = 0.1
# Acceleration that the least normal forces of the feet may cause in a robot that is held, rad/s² (m/s²).
_STILL = 0.5
# Least distance of the center of mass from the edges of the support polygon, m.  The motors alone would hold a robot
# that stands on its heels, but an impact tips it.
_COM_MARGIN = 0.05


@dataclass(frozen=True, eq=False)
class OfflinePosture:
    """The posture that was found.

    Attributes:
        q: The posture, shape (nq,).
        objective: Objective at the posture.
        initial: Objective at the start posture of the scenario, after it was put on the constraints.
        optimum: Objective at the optimum.
        distance: Distance from the start posture, rad (m).
        whole: Distance of the optimum from the start posture, rad (m).
        note: Reason if it is not the optimum.
    """

    q: Array
    objective: float
    initial: float
    optimum: float
    distance: float
    whole: float
    note: str = ""


def offline_posture(setup: Setup, objective: ImpactObjective, *, starts: int = 16) -> OfflinePosture:
    """Optimize the posture for the impact of a scenario, but only as far as the motors can hold it.

    The end effector stays where it starts, as far as its task holds it.  The base of a robot that flies stays level.
    The feet of a robot that stands stay where they are, with the center of mass above them.  The result is on the
    trade-off between objective and distance from the start.  It is the farthest posture that a nominal controller
    holds at rest with at most :data:`SHARE` of every torque limit and of the range of the rotors.

    Args:
        setup: The experiment.
        objective: The objective.
        starts: Number of starts of the optimizer.

    Raises:
        Infeasible, SolverFailed: As :func:`impact_posture.posture.solve.solve`.
    """
    tell("looking for the offline posture")
    solution = _solve(setup, objective, starts)
    initial = objective.value(solution.initial)
    if holds(setup, solution.q):
        value, far = objective.value(solution.q), distance(Chart(setup.robot.model), solution.q, solution.initial)
        return OfflinePosture(solution.q, value, initial, value, far, far)
    curve = pareto_front(solution, _POINTS, progress=_tell)
    whole, optimum = curve.points[-1].distance, curve.points[-1].objective
    for point in reversed(curve.points):
        if point.certified and holds(setup, point.q):
            note = (
                f"the optimum is {whole:.2f} rad (m) away and the motors cannot hold it with {100 * SHARE:.0f} % of "
                f"their torque: the best posture within {point.distance:.2f} is taken"
            )
            return OfflinePosture(point.q, point.objective, initial, optimum, point.distance, whole, note)
    note = f"no better posture can be held with {100 * SHARE:.0f} % of the motors' torque: the start is kept"
    return OfflinePosture(solution.initial, initial, initial, optimum, 0.0, whole, note)


def _solve(setup: Setup, objective: ImpactObjective, starts: int) -> PostureSolution:
    """Return the optimum as far from the stops and from the edges of the feet as the start allows."""
    robot, control = setup.robot, setup.scenario.control
    stands = control.footing is not None
    requirements = Requirements(
        contact_pose="free" if control.end_effector is None else control.end_effector.pose,
        base="level" if control.tilt is not None and robot.floating else "free",
        hold=tuple(j for j in robot.spec.constraints.hold if j not in robot.locked),
        com_over_feet=stands,
        com_asked=False,
    )
    for stops, edges in ((_MARGIN, _COM_MARGIN), (0.0, _COM_MARGIN), (0.0, _COM_MARGIN / 2), (0.0, 0.0)):
        try:
            wanted = replace(requirements, limit_margin=stops, com_margin=edges if stands else 0.0)
            problem = build_problem(robot, objective, setup.q, wanted)
            return solve(problem, starts=starts, jobs=1, progress=_tell)
        except (Infeasible, SolverFailed):
            if edges == 0.0:
                raise
    raise AssertionError("the last attempt returns or raises")


def _tell(done: int, total: int) -> None:
    tell("looking for the offline posture", done / total)


def holds(setup: Setup, q: Array) -> bool:
    """Whether a nominal controller rests at ``q`` with at most :data:`SHARE` of the limits."""
    driver = Driver(setup, nominal_posture(setup))
    command = driver.reset(q)
    if command.status is not Status.SOLVED:
        return False
    limits = driver.controller.actuators
    middle = np.where(np.isfinite(limits.upper + limits.lower), (limits.upper + limits.lower) / 2, 0.0)
    half = np.where(np.isfinite(limits.upper), limits.upper - middle, np.inf)
    still = float(np.abs(command.acceleration).max()) < _STILL
    return bool((np.abs(command.u - middle) <= SHARE * half).all()) and still
