"""Task-space inverse dynamics at 1 kHz with the impact-robust posture task.  This package does not import CasADi."""

from impact_posture.tsid.controller import Command, Controller, Report, Status
from impact_posture.tsid.flow.flow_direction import FlowOptions
from impact_posture.tsid.flow.reference_flow import ReferenceFlow
from impact_posture.tsid.flow.reference_flow_posture import ReferenceFlowPosture
from impact_posture.tsid.limits.acceleration_bounds import LimitLaw
from impact_posture.tsid.point_kinematics import Point
from impact_posture.tsid.support_contact import SupportContact, support_contacts
from impact_posture.tsid.task_formulation import (
    TaskFormulation,
    aerial_formulation,
    arm_formulation,
    legged_formulation,
)
from impact_posture.tsid.tasks.activation import Phase
from impact_posture.tsid.tasks.body_tasks import BaseOrientation, CenterOfMass, Tilt
from impact_posture.tsid.tasks.frame_tasks import FrameAligned, FramePose, FramePosition, Impedance
from impact_posture.tsid.tasks.impact_robust import ImpactRobustPosture
from impact_posture.tsid.tasks.joint_posture import JointPosture
from impact_posture.tsid.tasks.task import Task

__all__ = [
    "BaseOrientation",
    "CenterOfMass",
    "Command",
    "Controller",
    "FlowOptions",
    "FrameAligned",
    "FramePose",
    "FramePosition",
    "ImpactRobustPosture",
    "Impedance",
    "JointPosture",
    "LimitLaw",
    "Phase",
    "Point",
    "ReferenceFlow",
    "ReferenceFlowPosture",
    "Report",
    "Status",
    "SupportContact",
    "Task",
    "TaskFormulation",
    "Tilt",
    "aerial_formulation",
    "arm_formulation",
    "legged_formulation",
    "support_contacts",
]
