"""The offline optimum under a scenario's constraints, as far as the motors can hold it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

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

Array = NDArray[np.float64]

# Distances on the way to the optimum at which postures are tried, farthest first.
_POINTS = 16
# Rad (m) that stay between the posture and a joint's stops: a posture on a stop braces on it.
_MARGIN = 0.1
# Acceleration (rad/s², m/s²) that the least normal forces of the feet may cause in a robot that is held.
_STILL = 0.5
# Least distance in m of the center of mass from the edges of the feet's polygon.  The motors alone would hold a robot
# that stands on its heels, but an impact tips it.
_COM_MARGIN = 0.05


@dataclass(frozen=True, eq=False)
class OfflinePosture:
    """What was found.

    Attributes:
        q: The posture, shape (nq,).
        objective: There.
        initial: The objective at the scenario's start posture, put on the constraints.
        optimum: The objective at the optimum.
        distance: From the start posture, rad (m).
        whole: Distance of the optimum.
        note: In words, where it is not the optimum.
    """

    q: Array
    objective: float
    initial: float
    optimum: float
    distance: float
    whole: float
    note: str = ""


def offline_posture(
    setup: Setup, objective: ImpactObjective, *, starts: int = 16, seed: int = 0, share: float = 0.8
) -> OfflinePosture:
    """Optimize the posture for the scenario's impact; stop where the motors can hold it.

    End effector where it starts, as far as its task holds it; base level (a robot that flies); feet where they are,
    center of mass above them (one that stands).  Of the trade-off between objective and distance from the start, the
    farthest posture that a nominal controller holds at rest with at most ``share`` of every torque limit, and of the
    rotors' range, is taken.

    Args:
        setup: The experiment.
        objective: The impact.
        starts: Of the optimizer.
        seed: Of its random starts.
        share: Of the limits that holding the posture may take.

    Raises:
        Infeasible, SolverFailed: As :func:`impact_posture.posture.solve.solve`.
    """
    tell("looking for the offline posture")
    solution = _solved(setup, objective, starts, seed)
    initial = objective.value(solution.initial)
    if holds(setup, solution.q, share):
        value, far = objective.value(solution.q), _far(setup, solution.q, solution.initial)
        return OfflinePosture(solution.q, value, initial, value, far, far)
    curve = pareto_front(solution, _POINTS, progress=_tell)
    whole, optimum = curve.points[-1].distance, curve.points[-1].objective
    for point in reversed(curve.points):
        if point.certified and holds(setup, point.q, share):
            note = (
                f"the optimum is {whole:.2f} rad (m) away and the motors cannot hold it with {100 * share:.0f} % of "
                f"their torque: the best posture within {point.distance:.2f} is taken"
            )
            return OfflinePosture(point.q, point.objective, initial, optimum, point.distance, whole, note)
    note = f"no better posture can be held with {100 * share:.0f} % of the motors' torque: the start is kept"
    return OfflinePosture(solution.initial, initial, initial, optimum, 0.0, whole, note)


def _solved(setup: Setup, objective: ImpactObjective, starts: int, seed: int) -> PostureSolution:
    """The optimum as far from stops and from the feet's edges as the start allows."""
    robot, control = setup.robot, setup.scenario.control
    stands = control.footing is not None
    asked = Requirements(
        contact_pose="free" if control.end_effector is None else control.end_effector.pose,
        base="level" if control.tilt is not None and robot.floating else "free",
        hold=tuple(j for j in robot.spec.constraints.hold if j not in robot.locked),
        com_over_feet=stands,
        com_asked=False,
    )
    for stops, edges in ((_MARGIN, _COM_MARGIN), (0.0, _COM_MARGIN), (0.0, _COM_MARGIN / 2)):
        try:
            wanted = replace(asked, limit_margin=stops, com_margin=edges if stands else 0.0)
            problem = build_problem(robot, objective, setup.q, wanted)
            return solve(problem, starts=starts, seed=seed, jobs=1, progress=_tell)
        except (Infeasible, SolverFailed):
            continue
    return solve(build_problem(robot, objective, setup.q, asked), starts=starts, seed=seed, jobs=1, progress=_tell)


def _tell(done: int, total: int) -> None:
    tell("looking for the offline posture", done / total)


def holds(setup: Setup, q: Array, share: float) -> bool:
    """Whether a nominal controller rests at ``q`` with at most ``share`` of the limits."""
    driver = Driver(setup, nominal_posture(setup))
    command = driver.reset(q)
    if command.status is not Status.SOLVED:
        return False
    limits = driver.controller.actuators
    middle = np.where(np.isfinite(limits.upper + limits.lower), (limits.upper + limits.lower) / 2, 0.0)
    half = np.where(np.isfinite(limits.upper), limits.upper - middle, np.inf)
    still = float(np.abs(command.acceleration).max()) < _STILL
    return bool((np.abs(command.u - middle) <= share * half).all()) and still


def _far(setup: Setup, q: Array, start: Array) -> float:
    return distance(Chart(setup.robot.model), q, start)
