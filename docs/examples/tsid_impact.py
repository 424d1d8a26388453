"""The impact-robust term inside stack-of-tasks' TSID (https://github.com/stack-of-tasks/tsid).

    pip install --no-binary tsid tsid
    python tsid_impact.py

The posture task of TSID asks for ``ν̇* = K_p (q_ref − q) + K_d (ν_ref − ν) + a_ref``.  The term is its reference
acceleration ``a_ref = −K ∇H(q)``, which is updated at every tick.  A ur5 must keep its tip at one point, with a free
orientation.  K_p is zero, so that the posture comes to rest at an optimum of H and not at the rest posture of a
spring.  The accelerations of TSID are integrated without a simulation of the robot, because the example shows only
the term.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pinocchio as pin
import tsid

from impact_posture.codegen.export import export
from impact_posture.codegen.impact_gradient import ImpactGradient
from impact_posture.impact.impact_contact import ImpactContact
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.robot.robot_loader import load_robot

DT, DURATION = 0.002, 20.0
FRAME, NORMAL = "tool0", (0.0, 0.0, 1.0)
KD = 20.0  # 1/s
SPEED = 1.0  # norm of the velocity K/K_d ∇H at the first tick, which gives K for any robot


@dataclass(frozen=True)
class Outcome:
    q: np.ndarray
    H: np.ndarray  # at each tick
    tip_error: float  # largest distance of the tip from its point, m
    speed: float  # norm of ν at the end


def run() -> Outcome:
    """Follow −K ∇H for ``DURATION`` seconds in the null space of the tip position."""
    robot = load_robot("ur5")
    model, q, v = robot.model, robot.posture().copy(), np.zeros(robot.nv)
    with tempfile.TemporaryDirectory() as folder:
        objective = WorstCaseObjective(robot, ImpactContact(FRAME, NORMAL))
        export(objective, Path(folder), prefix="ur5", check=False)
        gradient = ImpactGradient.load(folder, robot=robot)
    K = KD * SPEED / np.linalg.norm(gradient.value_and_gradient(q, NORMAL)[1])

    # Use the model of the export, which has armature.  A URDF contains no armature.
    wrapper = tsid.RobotWrapper(model, tsid.RootJointType.FIXED_BASE_SYSTEM, False)
    formulation = tsid.InverseDynamicsFormulationAccForce("impact", wrapper, False)
    formulation.computeProblemData(0.0, q, v)

    tip = tsid.TaskSE3Equality("tip", wrapper, FRAME)
    tip.setKp(100.0 * np.ones(6))
    tip.setKd(20.0 * np.ones(6))
    tip.setMask(np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0]))
    tip.useLocalFrame(False)
    start = wrapper.framePosition(formulation.data(), model.getFrameId(FRAME))
    tip.setReference(tsid.TrajectorySE3Constant("tip", start).computeNext())
    formulation.addMotionTask(tip, 1.0, 0, 0.0)  # level 0 makes the task a constraint

    posture = tsid.TaskJointPosture("posture", wrapper)
    posture.setKp(np.zeros(robot.nv))
    posture.setKd(KD * np.ones(robot.nv))
    formulation.addMotionTask(posture, 1.0, 1, 0.0)
    sample = tsid.TrajectoryEuclidianConstant("posture", q).computeNext()

    solver = tsid.SolverHQuadProgFast("qp")
    solver.resize(formulation.nVar, formulation.nEq, formulation.nIn)
    H, error = [], 0.0
    for tick in range(round(DURATION / DT)):
        value, grad = gradient.value_and_gradient(q, NORMAL)
        sample.second_derivative(-K * grad)  # these two lines add the term to TSID
        posture.setReference(sample)
        solution = solver.solve(formulation.computeProblemData(tick * DT, q, v))
        a = formulation.getAccelerations(solution)
        q, v = pin.integrate(model, q, v * DT + 0.5 * a * DT**2), v + a * DT
        H.append(value)
        place = wrapper.framePosition(formulation.data(), model.getFrameId(FRAME))
        error = max(error, float(np.linalg.norm(place.translation - start.translation)))
    return Outcome(q, np.array(H), error, float(np.linalg.norm(v)))


def main() -> Outcome:
    outcome = run()
    H = outcome.H
    print(f"H {H[0]:.6g} → {H[-1]:.6g} ({100 * (H[-1] / H[0] - 1):+.1f} %) in {DURATION:g} s")
    print(f"tip off by {1e3 * outcome.tip_error:.1e} mm at most; |ν| at the end {outcome.speed:.1e}")
    return outcome


if __name__ == "__main__":
    main()
