"""What ``impact-posture codegen ROBOT --controller KIND`` exports."""

from __future__ import annotations

from dataclasses import fields
from typing import TYPE_CHECKING

from impact_posture.settings import ImpactSettings, LoadOptions, RobotSettings
from impact_posture_cli.error_boundary import UsageError
from impact_posture_cli.settings_options import Given

if TYPE_CHECKING:
    from impact_posture.controller_export.builtin import ControllerKind
    from impact_posture.impact.objective import ImpactObjective
    from impact_posture.robot.robot import Robot
    from impact_posture.tsid.task_formulation import TaskFormulation


def controller_parts(
    given: Given, robot: str, kind: ControllerKind, flow: bool, scenario: str | None
) -> tuple[Robot, TaskFormulation, ImpactObjective | None]:
    """Return the robot, its tasks, and the objective that the posture task follows."""
    if scenario is not None:
        from impact_posture.simulation.controller_factory import ControllerFactory
        from impact_posture.simulation.scenario import set_up
        from impact_posture.simulation.scenario_file import read_scenario
        from impact_posture.simulation.scenario_objective import interpreted

        if given.values:
            raise UsageError(f"--{next(iter(given.values))} contradicts --scenario, which has robot and impact.")
        setup = set_up(read_scenario(scenario))
        if setup.robot.name != robot:
            raise UsageError(f"The scenario {scenario} is of {setup.robot.name}, not of {robot}.")
        factory = ControllerFactory(setup, gradient_of=interpreted)
        driver = factory.driver("robust-flow" if flow else "robust")
        return setup.robot, driver.controller.formulation, factory.objective()
    from impact_posture.controller_export.builtin import default_formulation

    if "normal" in given.values:
        from impact_posture.impact.resolved_impact import resolve

        frames = given.values.get("frame", (None,))
        if len(frames) > 1:
            raise UsageError("--controller follows the gradient of one impact: give one --frame.")
        objective = resolve(given.fill(ImpactSettings, robot=robot, frame=frames[0])).objective
        return objective.robot, default_formulation(objective.robot, kind, objective, flow=flow), objective
    from impact_posture.robot.robot_loader import load_robot

    if flow:
        raise UsageError("--flow lowers impacts: give --normal X Y Z, or --scenario.")
    known = {field.name for field in fields(LoadOptions)}
    for name in given.values:
        if name not in known:
            raise UsageError(f"--{name.replace('_', '-')} belongs to an impact: give --normal X Y Z too.")
    loaded = load_robot(robot, given.fill(RobotSettings, robot=robot))
    return loaded, default_formulation(loaded, kind), None
