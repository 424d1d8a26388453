"""Where the reference flow of ``robust-flow`` comes to rest, from random feasible starts; kinematics only."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from impact_posture.posture.build_problem import build_problem
from impact_posture.posture.problem import PostureProblem, Requirements
from impact_posture.robot.robot import Robot
from impact_posture.tsid.posture_tasks import JointPosture
from impact_posture.tsid.reference_flow import FlowOptions, ReferenceFlow
from impact_posture.tsid.task_formulation import (
    TaskFormulation,
    aerial_formulation,
    arm_formulation,
    legged_formulation,
)
from tests.benchmarks.cases import AHEAD, DOWN, Case
from tests.benchmarks.core import Vector

DT = 1e-3
# Times in which the flow is to rest, and in which a flow with a finer rule does, s.
REST, LONG = 8.0, 60.0
FINE = FlowOptions(rho=0.0, mu=1e-3, epsilon=1e-7)
CASES = (
    Case("tilthex_arm", "tilthex_arm", DOWN),
    Case("hextilt", "hextilt", DOWN),
    Case("panda", "panda", DOWN),
    Case("solo8", "solo8", AHEAD),
    Case("talos at the torso", "talos", AHEAD, {"frame": "torso_2_link"}),
    Case("g1", "g1", AHEAD),
)


@dataclass(frozen=True)
class Course:
    """A flow from its start to its rest.

    Attributes:
        q: Where it ended.
        values: ``H/H₀`` at each update.
        rested: When it rested, s; infinite if it did not.
        missed: Largest distance from contacts and tasks, m or rad.
        share: Largest share of what the actuators may give at rest on the way, if the start was within it.
        room: Least distance of a joint from its limit, if the start was farther.
    """

    q: Vector
    values: Vector
    rested: float
    missed: float
    share: float
    room: float


def formulation_for(robot: Robot, posture: JointPosture) -> TaskFormulation:
    """The formulation that suits the robot."""
    builders = {"aerial": aerial_formulation, "arm": arm_formulation}
    return builders.get(robot.spec.kind, legged_formulation)(robot, posture)


def problem_of(case: Case) -> PostureProblem:
    """The offline problem with the rows of the flow but for those of the actuators."""
    objective, options = case.problem().objective, FlowOptions()
    robot = objective.robot
    stands = bool(robot.spec.supports)
    wanted = Requirements(
        contact_pose="free" if stands else "full",
        base="level" if robot.spec.kind == "aerial" else "free",
        hold=tuple(j for j in robot.spec.constraints.hold if j not in robot.locked),
        com_over_feet=stands,
        com_margin=options.com_margin if stands else 0.0,
        limit_margin=options.joint_margin,
    )
    return build_problem(robot, objective, robot.posture(), wanted)


def course(flow: ReferenceFlow, q: Vector, longest: float) -> Course:
    """Let the flow go from ``q`` until it rests; the robot follows exactly."""
    flow.reset(q)
    flow.on = True
    values, missed, share, room = [flow.value], 0.0, 0.0, np.inf
    for k in range(round(longest / DT)):
        flow.advance(DT, flow.q)
        if k % 5 == 4:
            values.append(flow.value)
            share = max(share, float(np.abs(flow.shares).max(initial=0.0)))
            room, missed = min(room, flow._state.least_room), max(missed, float(np.abs(flow._e).max(initial=0.0)))
            if flow.resting and not np.abs(flow.velocity).max() > 1e-4:
                break
    rested = (k + 1) * DT if flow.resting else np.inf
    return Course(flow.q.copy(), np.array(values) / flow.start, rested, missed / 10, share, room)
