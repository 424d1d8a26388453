"""An aerial manipulator braces for an impact from below: it moves from the nominal to the impact-robust posture.

Run: python brace.py EXPORT
EXPORT: folder that `impact-posture codegen tilthex_arm --frame ee --normal 0 0 1 --out EXPORT` wrote.
"""

import sys

import numpy as np
import pinocchio as pin

from impact_posture.codegen.impact_gradient import ImpactGradient
from impact_posture.robot.robot_loader import load_robot
from impact_posture.tsid.controller import Controller
from impact_posture.tsid.task_formulation import aerial_formulation
from impact_posture.tsid.tasks.impact_robust import ImpactRobustPosture, gradient_of

robot = load_robot("tilthex_arm")
export = ImpactGradient.load(sys.argv[1], robot=robot)

posture = ImpactRobustPosture(robot, gradient_of(export), K=20.0, kp=10.0, spring="release")
controller = Controller(robot, aerial_formulation(robot, posture))

q, v = robot.posture(), np.zeros(robot.nv)
controller.reset(q, v)
print(f"H before: {posture.value:.1f}")

events = {500: posture.brace, 3500: posture.contact, 3800: posture.release}
for k in range(4500):
    if k in events:
        events[k]()
    command = controller.tick(k * 1e-3, q, v)
    # On a robot, send command.rotor_speed and command.torque.  In this example, the robot moves exactly as planned.
    v = v + 1e-3 * command.acceleration
    q = pin.integrate(robot.model, q, 1e-3 * v)

report = controller.report()
print(f"H after: {export.objective(q)[0]:.1f}; {posture.activation.phase.value}, {command.status.value}")
print(f"end effector: acceleration error {1e3 * np.linalg.norm(report.residuals['ee pose']):.1e} mm/s²")
