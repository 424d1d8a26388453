"""The impact-robust term as a torque in the null space of a controller in MuJoCo.

    pip install mujoco
    python mujoco_null_space.py

The arm holds its tool at a point by an operational-space controller.  The term adds the torque ``−K ∇H − D M q̇`` in
the null space of the tool, so that ``H`` decreases while the tool does not move.  The file
``rail_arm_mjcf/rail_arm.xml`` must be in the folder of this program.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

import impact_posture as ip

MJCF = Path(__file__).parent / "rail_arm_mjcf" / "rail_arm.xml"
NORMAL = (0.0, 0.0, 1.0)
DURATION = 3.0  # duration of the simulation, s
STIFFNESS, DAMPING = 400.0, 40.0  # stiffness and damping of the tool controller, 1/s² and 1/s
D = 10.0  # damping in the null space, 1/s
SPEED = 2.0  # K is chosen so that the norm of K/D M⁻¹∇H is this speed at the start


def null_space_torque(M: np.ndarray, J: np.ndarray, torque: np.ndarray) -> np.ndarray:
    """Return ``(I − JᵀΛJM⁻¹) τ`` with ``Λ = (JM⁻¹Jᵀ)⁻¹``: the part of ``τ`` that does not accelerate the tool.

    If ``τ = −K ∇H``, then ``H`` cannot increase, because the matrix ``M⁻¹(I − JᵀΛJM⁻¹)`` is positive semidefinite.
    """
    mobility = J @ np.linalg.solve(M, J.T)
    return torque - J.T @ np.linalg.solve(mobility, J @ np.linalg.solve(M, torque))


@dataclass(frozen=True)
class Outcome:
    q: np.ndarray
    H: np.ndarray  # at each tick
    error: float  # largest distance of the tool from its position at the start, m


def run(term: bool = True) -> Outcome:
    """Hold the tool for ``DURATION``, with or without the term."""
    robot, model = ip.load_robot(str(MJCF)), mujoco.MjModel.from_xml_path(str(MJCF))
    with tempfile.TemporaryDirectory() as folder:
        objective = ip.ImpactObjective(robot, ip.ImpactContact("tool", NORMAL))
        gradient = objective.export(Path(folder) / "c").load()
    data, tool = mujoco.MjData(model), model.site("tool").id
    data.qpos[:] = robot.posture()
    mujoco.mj_forward(model, data)
    M, J, H, error = np.zeros((model.nv, model.nv)), np.zeros((3, model.nv)), [], 0.0
    mujoco.mj_fullM(model, data, M)
    K = D * SPEED / np.linalg.norm(np.linalg.solve(M, gradient.value_and_gradient(data.qpos, NORMAL)[1]))
    target = data.site_xpos[tool].copy()
    for _ in range(round(DURATION / model.opt.timestep)):
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, M)
        mujoco.mj_jacSite(model, data, J, None, tool)
        value, grad = gradient.value_and_gradient(data.qpos, NORMAL)
        command = STIFFNESS * (target - data.site_xpos[tool]) - DAMPING * (J @ data.qvel)
        torque = data.qfrc_bias + J.T @ np.linalg.solve(J @ np.linalg.solve(M, J.T), command)
        torque += null_space_torque(M, J, (-K * grad if term else 0.0) - D * M @ data.qvel)
        data.ctrl[:] = torque / model.actuator_gear[:, 0]
        mujoco.mj_step(model, data)
        H.append(value)
        error = max(error, float(np.linalg.norm(target - data.site_xpos[tool])))
    return Outcome(data.qpos.copy(), np.array(H), error)


def main() -> tuple[Outcome, Outcome]:
    """Run the controller with and without the term, and print the results."""
    outcomes = run(True), run(False)
    for outcome, words in zip(outcomes, ("with the term", "without the term"), strict=True):
        print(
            f"{words}: H {outcome.H[0]:.4g} → {outcome.H[-1]:.4g}, tool off by {1000 * outcome.error:.2g} mm at most"
        )
    return outcomes


if __name__ == "__main__":
    main()
