"""What somebody else's objective and constraint need: the protocols as documented, registered from outside."""

from __future__ import annotations

from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
import pytest

from impact_posture.dynamics.numeric import Numeric
from impact_posture.dynamics.tree import Tree
from impact_posture.errors import InputError
from impact_posture.impact.contact import ImpactContact, Support
from impact_posture.impact.lifted import Guess, Lifted
from impact_posture.impact.objective import Objective
from impact_posture.impact.worst_case import Subgradients
from impact_posture.posture.build_problem import build_problem
from impact_posture.posture.constraint import Constraint
from impact_posture.posture.null_space_path import null_space_path
from impact_posture.posture.problem import Requirements
from impact_posture.posture.solve import solve
from impact_posture.robot.robot import Robot

from .helpers import Vector, robot


@dataclass(frozen=True)
class JointDistance:
    """``1 + ‖q − q*‖²`` of a robot whose joints are all revolute."""

    robot: Robot
    target: tuple[float, ...]
    name: str = "joint-distance"
    contacts: tuple[ImpactContact, ...] = ()
    supports: tuple[Support, ...] = ()
    structure: str = "joint-distance"
    attempts: int = 1

    @property
    def parameters(self) -> Vector:
        return np.array(self.target)

    def lift(self, tree: Tree, parameters: ca.SX, scale: ca.SX) -> Lifted:
        return Lifted(ca.SX(0, 1), ca.SX(0, 1), 1 + ca.sumsqr(tree.q - parameters))

    def guess(self, q: Vector, scale: float, attempt: int = 0) -> Guess:
        return Guess(np.zeros(0), np.zeros(0))

    def value(self, q: Vector) -> float:
        return float(1 + np.sum((q - self.parameters) ** 2))

    def subgradients(self, q: Vector, within: float = 0.0) -> Subgradients:
        return Subgradients(2 * (q - self.parameters)[None, :], np.zeros(1))

    def movable(self, q: Vector) -> bool:
        return True

    def blind_motions(self) -> Vector:
        return np.zeros((0, 6))


class Coupled(Constraint):
    """The first two joints' angles add up to a value."""

    def __init__(self, total: float) -> None:
        self.name = "coupled joints"
        self.parameters = np.array([total])
        self.lower = self.upper = np.zeros(1)

    def symbolic(self, tree: Tree, parameters: ca.SX) -> ca.SX:
        return tree.q[0] + tree.q[1] - parameters

    def evaluate(self, model: Numeric) -> tuple[Vector, Vector]:
        return np.array([model.q[0] + model.q[1] - self.parameters[0]]), np.eye(model.model.nv)[:2].sum(0)[None]


@pytest.mark.parametrize("name", ["ur5", "panda"])
def test_another_objective_with_another_constraint(name: str) -> None:
    arm = robot(name)
    start = arm.posture()
    target = start + 0.1
    objective: Objective = JointDistance(arm, tuple(target))
    problem = build_problem(arm, objective, start, Requirements(contact_pose="free"))
    total = float(start[0] + start[1]) - 0.1
    problem = replace(problem, constraints=(*problem.constraints, Coupled(total)))
    assert "coupled joints held" in problem.describe()
    solution = solve(problem, starts=2, jobs=1)
    expected = np.clip(target, problem.lower, problem.upper)
    # The projection of the target onto q₁ + q₂ = c moves both joints alike.
    expected[:2] += (total - expected[:2].sum()) / 2
    assert solution.certificate.holds()
    np.testing.assert_allclose(solution.q, expected, atol=1e-7)
    with pytest.raises(InputError, match="joint-distance"):
        null_space_path(problem, start, solution.q)
