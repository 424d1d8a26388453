"""The problem behind ``ip.PostureProblem``, with the defaults of the robot."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from typing import Any

import numpy as np

from impact_posture.config.checked import checked
from impact_posture.config.problem_settings import ImpactSettings, ProblemSettings, RobotSettings
from impact_posture.config.table_validation import validate
from impact_posture.errors import InputError
from impact_posture.impact.elasticity.contact_compression import ContactStiffness
from impact_posture.impact.objective import Objective
from impact_posture.impact.resolved_impact import ResolvedImpact
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.posture.formulation.build_problem import build_problem
from impact_posture.posture.formulation.problem_file import Prepared, prepare, requirements
from impact_posture.posture.program.constrained_problem import ConstrainedProblem
from impact_posture.robot.posture_files import read_posture
from impact_posture.system.arrays import Array

# Settings that the objective and its robot hold already.
_OF_THE_OBJECTIVE = {field.name for field in fields(ImpactSettings)} - {"contact_stiffness", "contact_duration"}


@checked
class PostureProblem:
    """``min_q objective(q)`` under the constraints of a task; a missing argument comes from the robot.

    Args:
        objective: An :class:`ImpactObjective`, or another implementation of
            :class:`~impact_posture.impact.objective.Objective`.
        posture: Start of the search: a name, a file, or a configuration (nq,); ``None`` for the default posture.
        speed: Approach speed of the predicted jumps, m/s.
        restitution: Coefficient of restitution of the predicted jumps.
        task: Other fields of :class:`~impact_posture.config.problem_settings.ProblemSettings` about the task, such as
            ``base="level"``, ``target_position=(x, y, z)``, ``keep_contacts=True`` or ``hold=("joint",)``.

    Attributes:
        problem: Constraints and bounds, before any solver sees them.
        prepared: The problem with its settings; ``None`` unless the objective is an impact objective.

    Raises:
        ImpactPostureError: An argument is wrong.
    """

    def __init__(
        self,
        objective: Objective,
        posture: str | Array | Sequence[float] | None = None,
        *,
        speed: float = 1.0,
        restitution: float = 0.0,
        **task: Any,
    ) -> None:
        robot = objective.robot
        if posture is None or isinstance(posture, str):
            q, name = read_posture(robot, posture), posture or robot.default_posture
        else:
            q, name = robot.check_posture(np.asarray(posture, dtype=float), where="posture"), "a configuration"
        loaded = robot.settings or RobotSettings(robot=robot.source)
        values = {field.name: getattr(loaded, field.name) for field in fields(RobotSettings)}
        values |= {"speed": speed, "restitution": restitution, "joint_model": robot.joint_model}
        if isinstance(objective, WorstCaseObjective):
            values["friction"] = objective.contact.friction
        for name in _OF_THE_OBJECTIVE & set(task):
            fault = "belongs to the objective"
            raise InputError(fault, where=name, hint="give it to ImpactObjective or ImpactContact")
        settings = validate(ProblemSettings, values | task, "PostureProblem")
        self.prepared: Prepared | None = None
        if isinstance(objective, WorstCaseObjective):
            missing = getattr(objective, "_missing", "")
            contact = ContactStiffness.of(settings.contact_stiffness, settings.contact_duration)
            impact = ResolvedImpact(objective, q, name, speed, restitution, missing, contact)
            self.prepared = prepare(settings, impact)
            self.problem: ConstrainedProblem = self.prepared.problem
        else:
            self.problem = build_problem(robot, objective, q, requirements(settings, objective))

    @classmethod
    def of(cls, prepared: Prepared) -> PostureProblem:
        """Return the problem of settings from a file or a command line."""
        problem = cls.__new__(cls)
        problem.prepared, problem.problem = prepared, prepared.problem
        return problem

    def describe(self) -> list[str]:
        """Describe the constraints, one line each."""
        return self.problem.describe()
