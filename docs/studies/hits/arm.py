"""The arm of the recordings as a robot of this program, and the joint jumps that the joint models predict."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path

import numpy as np
import pinocchio as pin

from docs.studies.core import Vector
from docs.studies.hits.recordings import JOINTS
from impact_posture.config.problem_settings import FRICTION, JointModel
from impact_posture.impact.elasticity.contact_compression import ContactStiffness
from impact_posture.impact.elasticity.elastic_impact import ElasticImpact, ElasticResponse
from impact_posture.impact.friction.coulomb_impact import coulomb_impact
from impact_posture.impact.impact_case import ImpactCase
from impact_posture.impact.impact_contact import ImpactContact
from impact_posture.impact.quantities.impact_oracle import ImpactOracle
from impact_posture.robot.joint_model import with_joint_model
from impact_posture.robot.robot import Robot
from impact_posture.robot.robot_loader import load_robot
from impact_posture.robot.robot_spec import JointTransmissionSpec, TransmissionSpec

URDF = Path(__file__).with_name("iiwa7.urdf")
# The face of the tool is perpendicular to the axis of link 7, so the normal of the contact turns with the tool.
NORMAL = (0.0, 0.0, -1.0)
# Masses of the light and the heavy box, kg: the parameter `object_mass` of the recorded controller.
MASSES = {1: 0.4, 2: 1.915}
# Stiffness of the joint springs, N·m/rad.  No published value for this arm is known; these are the values that the
# study of elastic joints assumes.
ASSUMED_STIFFNESS = np.array((14e3,) * 4 + (9e3,) * 3)
# Time from touch to greatest compression, s: half of the 25 ms in which the heavy box slows the tip.
COMPRESSION = 0.0125
# Distance between tip and origin of link 7 along its z axis, m.
TIP = 0.15
SLIDERS = ("box_x", "box_y", "box_z")


@dataclass(frozen=True, eq=False)
class Arm:
    """Properties of the recorded arm that the published model of its links does not contain.

    Attributes:
        mass: Mass that is added to link 7, kg; negative if the published mass is too large.
        moment: Product of this mass and its position along the axis of link 7, kg·m.
        rotors: Inertia of the rotors at the joints, kg·m², shape (7,).
        offset: Contact point relative to the tip along the x and y axes of link 7, m.  In the recordings, the x axis
            points sideways and the y axis points down.
        friction: Coulomb coefficient between tool and box.
        stiffness: Stiffness of the contact, N/m.
    """

    mass: float = 0.0
    moment: float = 0.0
    rotors: Vector = field(default_factory=lambda: np.zeros(JOINTS))
    offset: tuple[float, float] = (0.0, 0.0)
    friction: float = 0.0
    stiffness: float = 2.5e4

    def robot(self, box: float) -> Robot:
        """Return the robot with a box of this mass, kg, at its tip, and with elastic joints."""
        loaded = _loaded()
        model, link = pin.Model(loaded.model), loaded.model.inertias[JOINTS]
        total = link.mass + self.mass
        center = (link.mass * np.array(link.lever) + np.array([0.0, 0.0, self.moment])) / total
        model.inertias[JOINTS] = pin.Inertia(total, center, np.array(link.inertia) * total / link.mass)
        model.jointPlacements[model.getJointId(SLIDERS[0])] = pin.SE3(np.eye(3), np.array([*self.offset, TIP]))
        model.armature = np.append(self.rotors, np.full(len(SLIDERS), box))
        joints = dict.fromkeys(SLIDERS, JointTransmissionSpec("rigid"))
        joints |= {f"joint_{k + 1}": JointTransmissionSpec("elastic", K) for k, K in enumerate(ASSUMED_STIFFNESS)}
        return replace(loaded, model=model, spec=replace(loaded.spec, transmission=TransmissionSpec(joints=joints)))

    def case(self, box: float) -> ImpactCase:
        """Return the impact on a box of this mass, kg."""
        return ImpactCase(
            self.robot(box), ImpactContact("box", NORMAL, normal_frame="contact", friction=self.friction)
        )

    def inertia(self, q: Vector) -> Vector:
        """Return the inertia of links and rotors, shape (7, 7), kg·m²."""
        model = self.robot(1.0).model
        M = pin.crba(model, model.createData(), with_box(q))
        return np.asarray((np.triu(M) + np.triu(M, 1).T)[:JOINTS, :JOINTS])

    def approach(self, q: Vector) -> Vector:
        """Return ``j``, shape (7,), for which ``j q̇`` is the speed of the contact point along the tool axis, m/s."""
        model = self.robot(1.0).model
        frame = model.getFrameId("box")
        J = pin.computeFrameJacobian(model, model.createData(), with_box(q), frame, pin.ReferenceFrame.LOCAL)
        return np.asarray(J[2, :JOINTS])


@cache
def _loaded() -> Robot:
    return load_robot(str(URDF))


def with_box(q: Vector) -> Vector:
    """Append the positions of the sliders of the box."""
    return np.append(q, np.zeros(len(SLIDERS)))


@dataclass(frozen=True)
class Model:
    """A joint model of this program, and the friction of the contact."""

    joint_model: JointModel
    friction: float = 0.0

    def jump(self, arm: Arm, box: float, q: Vector) -> Vector:
        """Return the plastic joint jumps per approach speed, (rad/s)/(m/s), shape (7,)."""
        case = replace(arm, friction=self.friction).case(box)
        if self.joint_model == "elastic":
            return elastic_response(arm, box, q).jump[:JOINTS]
        oracle = ImpactOracle(replace(case, robot=with_joint_model(case.robot, self.joint_model)))
        return np.asarray(coulomb_impact(oracle, with_box(q)).jump[:JOINTS])


# Models of the tables.  The recordings do not state the friction, so one model has the default of this program.
MODELS: Mapping[str, Model] = {
    "reflected": Model("reflected"),
    "elastic": Model("elastic"),
    "link": Model("link"),
    f"reflected, μ = {FRICTION:g}": Model("reflected", FRICTION),
}


def elastic_response(arm: Arm, box: float, q: Vector) -> ElasticResponse:
    """Return the response to a frictionless contact at 1 m/s."""
    return ElasticImpact(arm.case(box)).response(with_box(q), arm.stiffness)


def with_duration(arm: Arm, box: float, q: Vector) -> Arm:
    """Return the arm with the contact stiffness for which a box of this mass compresses for :data:`COMPRESSION`."""
    mass = 1 / ImpactOracle(arm.case(box)).quantities(with_box(q)).G
    return replace(arm, stiffness=ContactStiffness(duration=COMPRESSION).linear_stiffness(mass, 1.0))
