"""Arms for tests, on a fixed base or mounted below the hexarotor of ``tilthex_arm``."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from impact_posture.robot.robot import Robot
from impact_posture.robot.robot_spec import ContactSpec, RobotSpec
from tests.support.helpers import robot

X, Y, Z = (1, 0, 0), (0, 1, 0), (0, 0, 1)
TIP = "tip"


def arm(
    axes: Sequence[ArrayLike],
    joints: ArrayLike,
    *,
    floating: bool,
    rods: Sequence[ArrayLike] | None = None,
    effort: float = 5.0,
) -> Robot:
    """Build a serial arm with hinge joints and the frames ``link_0``, ``link_1``, …, and ``tip`` on the last link.

    Args:
        axes: Axis of each hinge in the frame of the preceding body.
        floating: If true, the arm is mounted below the hexarotor of ``tilthex_arm``; else its base is fixed.
        rods: Vector from each hinge to the next, and from the last hinge to the tip, m; by default 0.3 m down.
        effort: Torque limit of the motors, N·m; zero if the motors have no limit.
    """
    rods = [(0, 0, -0.3)] * len(axes) if rods is None else rods
    hexarotor, model, parent, start = robot("tilthex_arm"), pin.Model(), 0, np.zeros(3)
    if floating:
        parent = model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "root_joint")
        model.appendBodyToJoint(parent, hexarotor.model.inertias[1], pin.SE3.Identity())
        model.addFrame(pin.Frame("base_link", parent, 0, pin.SE3.Identity(), pin.FrameType.BODY))
        start = np.array([0, 0, -0.08])
    for k, (axis, rod) in enumerate(zip(axes, np.array(rods, dtype=float), strict=True)):
        joint = pin.JointModelRevoluteUnaligned(np.array(axis, dtype=float) / np.linalg.norm(axis))
        bounds = [np.full(1, value) for value in (effort, 10.0, -5.0, 5.0)]
        parent = model.addJoint(parent, joint, pin.SE3(np.eye(3), start), f"joint_{k}", *bounds)
        slender = 0.2 / 12 * (rod @ rod * np.eye(3) - np.outer(rod, rod)) + 1e-5 * np.eye(3)
        model.appendBodyToJoint(parent, pin.Inertia(0.2, rod / 2, slender), pin.SE3.Identity())
        model.addFrame(pin.Frame(f"link_{k}", parent, 0, pin.SE3.Identity(), pin.FrameType.BODY))
        start = rod
    model.addFrame(pin.Frame(TIP, parent, 0, pin.SE3(np.eye(3), start), pin.FrameType.BODY))
    model.armature = np.concatenate([np.zeros(6 if floating else 0), np.full(len(axes), 0.01)])
    posture = pin.neutral(model)
    posture[-len(axes) :] = joints
    spec = RobotSpec(
        kind="aerial" if floating else "arm",
        contact=ContactSpec(frame=TIP),
        propulsion=hexarotor.spec.propulsion if floating else None,
    )
    return Robot("made up", "tests", model, "free-flyer" if floating else "fixed", {"home": posture}, "home", spec)


def yaw_and_pitches() -> Robot:
    """Build a hexarotor with an arm (yaw, pitch, pitch, pitch).  Only a motion of the base can roll the tip."""
    return arm([Z, Y, Y, Y], [0.3, -0.8, 1.2, -0.5], floating=True)


def seven_joints() -> Robot:
    """Build a bent arm on a fixed base: seven hinges, connected by rods of 0.15 m and 0.2 kg."""
    bent = [0.3, -0.7, 0.5, 1.1, -0.4, 0.8, 0.2]
    return arm([Z, Y, Z, Y, Z, Y, X], bent, floating=False, rods=[(0.02, 0.01, -0.15)] * 7)
