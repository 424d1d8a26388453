"""The effective mass, or another objective, as a task of mink (https://github.com/kevinzakka/mink).

    pip install mink
    python mink_impact.py

``ImpactTask`` asks for the velocity ``v = −K ∇f(q)``, where ``f`` is the objective of an export.  Tasks that the
robot must keep are equality constraints in mink, so that ``f`` decreases only in their null space.  The file
``rail_arm_mjcf/rail_arm.xml`` must be in the folder of this program.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

import mink
import mujoco
import numpy as np

import impact_posture as ip

MJCF = Path(__file__).parent / "rail_arm_mjcf" / "rail_arm.xml"
DT, DURATION, AT_REST = 0.01, 10.0, 1e-5  # time step, s; longest run, s; norm of v at rest


class ImpactTask(mink.Task):
    """Task ``Δq = −K ∇f(q) Δt``, with the error ``K ∇f Δt`` and the identity as Jacobian.

    ``f`` is the objective of an export, such as the effective mass or H.  The gain K is chosen so that the norm of v
    at the first tick equals ``speed``.  The robot must have a fixed base, and the joints of both models must have
    the same order.
    """

    def __init__(self, gradient: ip.ImpactGradient, speed: float, q: np.ndarray) -> None:
        super().__init__(cost=np.ones(len(q)))
        self.gradient, self.K = gradient, speed / np.linalg.norm(gradient.objective(q)[1])

    def compute_error(self, configuration: mink.Configuration) -> np.ndarray:
        return self.K * DT * self.gradient.objective(configuration.q)[1]

    def compute_jacobian(self, configuration: mink.Configuration) -> np.ndarray:
        return np.eye(configuration.nv)


class PointTask(mink.Task):
    """Keep the position of a site and leave its orientation free."""

    def __init__(self, site: str, configuration: mink.Configuration) -> None:
        super().__init__(cost=np.ones(3))
        self.site = site
        self.target = self._pose(configuration).translation()

    def _pose(self, configuration: mink.Configuration) -> mink.SE3:
        return configuration.get_transform_frame_to_world(self.site, "site")

    def compute_error(self, configuration: mink.Configuration) -> np.ndarray:
        return self._pose(configuration).translation() - self.target

    def compute_jacobian(self, configuration: mink.Configuration) -> np.ndarray:
        rotation = self._pose(configuration).rotation().as_matrix()
        return rotation @ configuration.get_frame_jacobian(self.site, "site")[:3]


@dataclass(frozen=True)
class Outcome:
    q: np.ndarray
    mass: np.ndarray  # effective mass at the start and after each tick, kg
    error: float  # largest distance of the tool from its point, m
    speed: float  # norm of v at the end


def run(speed: float = 10.0) -> Outcome:
    """Lower the effective mass of the tool along z while the tool stays at its point."""
    robot, model = ip.load_robot(str(MJCF)), mujoco.MjModel.from_xml_path(str(MJCF))
    contact = ip.ImpactContact("tool", normal=(0, 0, 1), friction=0.0)
    with tempfile.TemporaryDirectory() as folder:
        objective = ip.ImpactObjective(robot, contact, kind="effective-mass")
        gradient = objective.export(Path(folder) / "c").load()

    configuration = mink.Configuration(model, robot.posture())
    tool = PointTask("tool", configuration)
    task = ImpactTask(gradient, speed, configuration.q)
    mass, error = [gradient.objective(configuration.q)[0]], 0.0
    for _ in range(round(DURATION / DT)):
        v = mink.solve_ik(configuration, [task], DT, solver="daqp", constraints=[tool])
        configuration.integrate_inplace(v, DT)
        mass.append(gradient.objective(configuration.q)[0])
        error = max(error, float(np.linalg.norm(tool.compute_error(configuration))))
        if np.linalg.norm(v) < AT_REST:
            break
    return Outcome(configuration.q, np.array(mass), error, float(np.linalg.norm(v)))


def main() -> Outcome:
    outcome = run()
    print(f"effective mass {outcome.mass[0]:.4g} → {outcome.mass[-1]:.4g} kg in {len(outcome.mass) - 1} ticks")
    print(f"the tool was off by {outcome.error:.1e} at most, speed at the end {outcome.speed:.1e}")
    return outcome


if __name__ == "__main__":
    main()
