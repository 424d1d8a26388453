"""Joint models: the inertia at the joints in an impact, with rotors, without rotors, or with locked joints.

With a soft spring between rotor and link, a short impact ends before the rotor turns.  The inertia is then ``M``, the
mass matrix of the links, and the armature is zero.  With a stiff transmission, the rotor moves with the link.  The
inertia is then ``M + B``, where the armature ``B`` is the reflected rotor inertia.  A joint that cannot be driven
from its link does not move, so its armature is infinite.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impact_posture.config.problem_settings import JointModel
from impact_posture.errors import InputError
from impact_posture.robot.inertia_checks import check_mass_matrix
from impact_posture.robot.joint_coupling import with_partners
from impact_posture.robot.model_joints import joint_index, v_slice
from impact_posture.robot.robot import Robot
from impact_posture.robot.robot_spec import JointTransmissionSpec
from impact_posture.system.arrays import Array

Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Transmissions:
    """Transmission of each velocity entry, shape (nv,); a floating base has no transmission.

    The rotor of a ``rigid`` joint moves with the link.  A ``locked`` joint cannot be driven from its link.
    ``stiffness`` between rotor and link is in N·m/rad (N/m if prismatic), and infinite if robot.toml states none.
    ``damping`` acts in parallel with this spring, N·m·s/rad (N·s/m).
    """

    rigid: Mask
    locked: Mask
    stiffness: Array
    damping: Array

    @property
    def elastic(self) -> Mask:
        """Whether a spring of known stiffness lies between rotor and link."""
        return np.isfinite(self.stiffness) & ~self.rigid & ~self.locked


def transmissions(robot: Robot) -> Transmissions:
    """Return the transmissions in robot.toml; raise ``JointNotFound`` if robot.toml names an unknown joint."""
    spec, model, nv = robot.spec.transmission, robot.model, robot.nv
    result = Transmissions(np.zeros(nv, dtype=bool), np.zeros(nv, dtype=bool), np.full(nv, np.inf), np.zeros(nv))
    for joint in spec.joints:
        if joint not in robot.locked:
            joint_index(model, joint, f"{robot.name} [transmission.joints]")
    for joint in robot.joint_names:
        table = spec.joints.get(joint, JointTransmissionSpec())
        kind, entries = table.kind or spec.kind, v_slice(model, robot.joint_id(joint))
        result.rigid[entries], result.locked[entries] = kind == "rigid", kind == "locked"
        result.stiffness[entries] = table.stiffness or spec.stiffness or np.inf
        result.damping[entries] = spec.damping if table.damping is None else table.damping
    # The spring of a coupled joint lies between the motor and the leader.
    result.stiffness[robot.followers] = np.inf
    return result


def with_joint_model(robot: Robot, joint_model: JointModel) -> Robot:
    """Return a copy of the robot whose armature belongs to the joint model ``joint_model``.

    - ``reflected`` keeps the armature at all joints.
    - ``link`` removes the armature, except at joints with a ``rigid`` transmission.
    - ``locked`` locks all joints, so that only a floating base moves.  Position control with stiff gears has the same
      effect.
    - ``elastic`` removes the armature at joints with springs of known stiffness.  H, G, V, S and E then describe the
      first instant of the impact.  The rotors follow later
      (:mod:`impact_posture.impact.elasticity.elastic_impact`).

    A joint with a ``locked`` transmission moves in no joint model.

    Raises:
        InertiaError: The mass matrix is singular without the rotors.
        InputError: Nothing can move, or ``elastic`` is chosen for a robot without springs.
    """
    stated, table = robot.armature, transmissions(robot)
    armature = stated.copy()
    joints = np.arange(robot.nv) >= robot.first_joint
    if joint_model == "link":
        armature = np.where(joints & ~table.rigid, 0.0, armature)
    elif joint_model == "locked":
        armature[joints] = np.inf
    elif joint_model == "elastic":
        # A rotor without inertia moves with its spring, so the spring has no effect.
        springs = table.elastic & (stated > 0)
        if not springs.any():
            fault = f"no joint of {robot.name} has a rotor on a spring of known stiffness"
            hint = "state stiffness in robot.toml [transmission] and the inertia of the rotors in [armature]"
            raise InputError(fault, where="joint_model", hint=hint)
        armature = np.where(springs, 0.0, armature)
    armature[table.locked] = np.inf
    entries = {joint: v_slice(robot.model, robot.joint_id(joint)) for joint in robot.joint_names}
    held = [joint for joint, of_joint in entries.items() if np.isinf(armature[of_joint]).all()]
    for joint in with_partners(robot.couplings, held):
        armature[entries[joint]] = np.inf
    if (np.isinf(armature) | ~joints).all() and not robot.floating:
        fault = f"all joints of {robot.name} are locked, so nothing moves in an impact"
        raise InputError(fault, where="joint_model", hint="choose reflected or link")
    if np.array_equal(armature, robot.model.armature):
        return replace(robot, joint_model=joint_model, stated_armature=stated)
    model = pin.Model(robot.model)
    model.armature = armature
    changed = replace(robot, model=model, joint_model=joint_model, stated_armature=stated)
    check_mass_matrix(changed, f"{robot.source}, joint model '{joint_model}'")
    return changed


def describe_joints(robot: Robot) -> str:
    """Describe the joint model of a robot, for messages."""
    armature = np.asarray(robot.model.armature)[robot.first_joint :]
    held, kept = int(np.isinf(armature).sum()), int((np.isfinite(armature) & (armature > 0)).sum())
    words = {
        "reflected": "links and rotors",
        "elastic": "links, and rotors on springs; H, G, V, S, E at the beginning of the impact",
        "link": "links without rotors" + (f", but {kept} rigid transmissions" if kept else ""),
    }
    parts = [words.get(robot.joint_model), f"{held} of {len(armature)} joints rigid" if held else ""]
    return f"{robot.joint_model} ({', '.join(filter(None, parts))})"
