"""Controllers with the default gains of this package, by kind of robot."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

from impact_posture.arrays import Array
from impact_posture.errors import InputError
from impact_posture.impact.objective import ImpactObjective
from impact_posture.robot.robot import Robot
from impact_posture.tsid.impact_robust import ImpactRobustPosture
from impact_posture.tsid.posture_tasks import JointPosture
from impact_posture.tsid.reference_flow_posture import ReferenceFlowPosture
from impact_posture.tsid.task_formulation import (
    TaskFormulation,
    aerial_formulation,
    arm_formulation,
    legged_formulation,
)

ControllerKind = Literal["aerial", "legged", "arm"]
_BUILD: dict[str, Callable[[Robot, JointPosture], TaskFormulation]] = {
    "aerial": aerial_formulation,
    "legged": legged_formulation,
    "arm": arm_formulation,
}


def default_formulation(
    robot: Robot, kind: ControllerKind, objective: ImpactObjective | None = None, *, flow: bool = False
) -> TaskFormulation:
    """Return the formulation of a kind of robot with default gains.

    Args:
        robot: The robot.
        kind: ``aerial``, ``legged`` or ``arm``.
        objective: The objective whose gradient the posture task follows; ``None`` for a posture task without one.
        flow: Follow it by a reference flow, and not by the impact-robust term.

    Raises:
        InputError: The robot is of another kind.
    """
    # The posture of a robot that stands is light beside the tasks of its center of mass and base (10 and 1).
    kp, weight, base = (20.0, 0.1, 0.0) if kind == "legged" else (10.0, 1.0, None)
    if objective is None:
        posture = JointPosture(robot, kp=kp, weight=weight, base_weight=base)
    else:
        found = objective

        def gradient(q: Array) -> tuple[float, Array]:
            return found.value(q), found.gradient(q)

        law = ReferenceFlowPosture if flow else ImpactRobustPosture
        posture = law(robot, gradient, kp=kp, weight=weight, base_weight=base)
    try:
        return _BUILD[kind](robot, posture)
    except InputError as error:
        fits = "legged" if robot.spec.supports else "aerial" if robot.spec.propulsion else "arm"
        raise InputError(error.what, where=error.where, hint=f"try `kind='{fits}'`") from None
