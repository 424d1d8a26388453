"""Problem class ``ip.PostureProblem``; the robot provides defaults for missing arguments."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Any

from impact_posture.config.checked import checked
from impact_posture.config.problem_settings import RESTITUTION, SPEED, ImpactSettings, ProblemSettings, RobotSettings
from impact_posture.config.setting import stated
from impact_posture.config.table_validation import validate
from impact_posture.errors import InputError
from impact_posture.impact.elasticity.contact_compression import ContactStiffness
from impact_posture.impact.objective import Objective
from impact_posture.impact.resolved_impact import ResolvedImpact, choose_objective
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.posture.formulation.build_problem import build_problem
from impact_posture.posture.formulation.problem_file import Prepared, prepare, requirements
from impact_posture.posture.program.constrained_problem import ConstrainedProblem
from impact_posture.robot.posture_files import read_posture
from impact_posture.system.arrays import Array

# Settings that ImpactObjective defines.  PostureProblem rejects them.
_OF_THE_OBJECTIVE = {field.name for field in fields(ImpactSettings)} - {"contact_stiffness", "contact_duration"}


@checked
class PostureProblem:
    """``min_q objective(q)`` under the constraints of a task; the robot provides defaults for missing arguments.

    Args:
        objective: An :class:`ImpactObjective`, or another implementation of
            :class:`~impact_posture.impact.objective.Objective`.  If speed, friction or elasticity of the contact are
            stated, an objective without ``kind`` gets the kind that ``--objective auto`` selects on the command line.
        posture: Start of the search: the name of a posture, a file, or a configuration of shape (nq,); ``None``
            selects the default posture.
        speed: Approach speed of the predicted impact, m/s.
        restitution: Coefficient of restitution of the predicted impact.
        task: Fields of :class:`~impact_posture.config.problem_settings.ProblemSettings` that describe the task, such
            as ``base="level"``, ``target_position=(x, y, z)``, ``keep_contacts=True`` or ``hold=("joint",)``.

    Attributes:
        problem: Objective, constraints and bounds, independent of a solver.
        prepared: The problem together with its settings; ``None`` if the objective is not an impact objective.

    Raises:
        ImpactPostureError: An argument is not valid.
    """

    def __init__(
        self,
        objective: Objective,
        posture: str | Array | Sequence[float] | None = None,
        *,
        speed: float = SPEED,
        restitution: float = RESTITUTION,
        **task: Any,
    ) -> None:
        robot = objective.robot
        q, name = read_posture(robot, posture), "a configuration"
        if posture is None or isinstance(posture, str):
            name = posture or robot.default_posture
        loaded = robot.settings or RobotSettings(robot=robot.source)
        values = {field.name: getattr(loaded, field.name) for field in fields(RobotSettings)}
        values |= {"restitution": restitution, "joint_model": robot.joint_model}
        if stated(speed):
            values["speed"] = speed
        if isinstance(objective, WorstCaseObjective):
            values |= {"objective": getattr(objective, "_stated_kind", objective.kind)}
            values |= {"normal_cone": objective.normal_cone_deg, "bilateral": objective.bilateral}
            if stated(objective.contact.friction):
                values["friction"] = objective.contact.friction
        for name in _OF_THE_OBJECTIVE & set(task):
            fault = "belongs to the objective"
            raise InputError(fault, where=name, hint="pass the setting to ImpactObjective or ImpactContact")
        settings = validate(ProblemSettings, values | task, "PostureProblem")
        self.prepared: Prepared | None = None
        if isinstance(objective, WorstCaseObjective):
            missing = getattr(objective, "_missing", "")
            contact = ContactStiffness.of(settings.contact_stiffness, settings.contact_duration)
            kind, choice = choose_objective(settings, several=bool(objective.others))
            chosen = objective if kind == objective.kind else replace(objective, kind=kind)
            impact = ResolvedImpact(chosen, q, name, speed, restitution, missing, contact, choice)
            self.prepared = prepare(settings, impact)
            self.problem: ConstrainedProblem = self.prepared.problem
        else:
            self.problem = build_problem(robot, objective, q, requirements(settings, objective))

    @classmethod
    def of(cls, prepared: Prepared) -> PostureProblem:
        """Return the problem for settings that were read from a file or a command line."""
        problem = cls.__new__(cls)
        problem.prepared, problem.problem = prepared, prepared.problem
        return problem

    def describe(self) -> list[str]:
        """Describe each constraint in one line."""
        return self.problem.describe()
