"""Extensions from outside the package: an objective, a constraint, a task, and an experiment controller."""

from __future__ import annotations

import importlib
import json
import shutil
import sys
import tomllib
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest

import impact_posture as ip
from impact_posture.dynamics.numeric import Numeric
from impact_posture.dynamics.tree import Tree
from impact_posture.errors import InputError
from impact_posture.experiment.job_store import JobStore
from impact_posture.experiment.reproduction import reproduce
from impact_posture.impact.impact_contact import ImpactContact
from impact_posture.impact.objective import Objective, Subgradients
from impact_posture.impact.quantities.lifted_form import Guess, Lifted
from impact_posture.posture.constraints.constraint import ExpressionConstraint
from impact_posture.posture.constraints.requirements import Requirements
from impact_posture.posture.formulation.build_problem import build_problem
from impact_posture.posture.manifold.null_space_path import null_space_path
from impact_posture.posture.search.multistart import solve
from impact_posture.robot.robot import Robot
from impact_posture.robot.robot_spec import Support
from impact_posture.simulation.controllers.controller_factory import GROUP
from impact_posture.simulation.run import run
from tests.experiment.conftest import shortened as cut
from tests.simulation.factories import controller_factory, needs_mujoco, shared_factory, shortened
from tests.support.command import refused
from tests.support.command import run as start
from tests.support.helpers import Vector, robot

EXAMPLE = Path(__file__).parents[2] / "docs" / "examples" / "setback"


@dataclass(frozen=True)
class JointDistance:
    """Objective ``1 + ‖q − q*‖²`` for a robot whose joints are all revolute."""

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


class Coupled(ExpressionConstraint):
    """Constraint that the angles of the first two joints add up to a given value."""

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
    # The projection of the target onto q₁ + q₂ = c changes both angles equally.
    # The second finger of panda follows the first.
    expected = arm.coupled(expected)
    expected[:2] += (total - expected[:2].sum()) / 2
    assert solution.certificate.holds()
    np.testing.assert_allclose(solution.q, expected, atol=1e-7)
    with pytest.raises(InputError, match="joint-distance"):
        null_space_path(problem, start, solution.q)


@pytest.fixture
def setback(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """Provide the package docs/examples/setback as if it were installed: module, and metadata with entry points."""
    shutil.copy(EXAMPLE / "setback.py", tmp_path)
    project = tomllib.loads((EXAMPLE / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    added = [f"{name} = {value}" for name, value in project["entry-points"][GROUP].items()]
    # Add entry points with faults: `gone` cannot be imported, `number` and `odd` do not create a controller driver.
    added += ["gone = setback_gone:make", "number = setback:len", "odd = setback:Vector"]
    metadata = tmp_path / "setback-1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: setback\nVersion: 1.0\n", encoding="utf-8")
    (metadata / "entry_points.txt").write_text("\n".join([f"[{GROUP}]", *added]), encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "setback", raising=False)
    return importlib.import_module("setback")


def test_another_task_in_the_controller(setback: ModuleType) -> None:
    """Error of a critically damped joint: ``e(t) = e₀ (1 + ωt) exp(−ωt)`` with ``ω = √K_p``."""
    arm, dt, omega = robot("panda"), 1e-3, 6.0
    q, v = arm.posture(), np.zeros(arm.nv)
    task = setback.JointAngle(arm, "panda_joint4", q[3] + 0.2, omega**2)
    controller = ip.tsid.Controller(arm, ip.tsid.TaskFormulation(((task,),), posture=ip.tsid.JointPosture(arm)))
    controller.reset(q, v)
    for k in range(500):
        t = k * dt
        expected = 0.2 * (1 + omega * t) * np.exp(-omega * t)
        assert abs(task.target - q[3] - expected) < 2e-3
        command = controller.tick(t, q, v)
        assert command.status is ip.tsid.Status.SOLVED
        v = v + dt * command.acceleration
        q = np.array(pin.integrate(arm.model, q, dt * v))


def test_another_controller_lives_through_a_scenario(setback: ModuleType) -> None:
    needs_mujoco()
    built = controller_factory(shortened("aerial-vertical"))
    (bent,), (nominal,) = run(built, "setback"), run(built, "nominal")
    begin = nominal.of("impact")[0].begin
    before = [outcome.series.q[np.searchsorted(outcome.series.t, begin) - 2] for outcome in (bent, nominal)]
    moved = float(before[0][-1] - before[1][-1])
    assert -0.2 < moved < -0.1
    for outcome, level in ((bent, 1.0), (nominal, 0.0)):
        assert outcome.away is None and outcome.of("impact")[0].touched
        assert outcome.series.level[-1] == level


def test_the_installed_command_runs_a_registered_controller(setback: ModuleType, tmp_path: Path) -> None:
    """Two faults in the extension package, and a misspelled controller name, each give a one-line error."""
    needs_mujoco()
    scenario = tmp_path / "aerial.toml"
    scenario.write_text(cut("aerial-vertical", count=1, settle=0.1, dwell=0.2, pause=0.05), encoding="utf-8")

    words = ("simulate", scenario, "--json", "--controller")
    done = start(*words, "setback", "--no-report", cwd=tmp_path)
    assert done.returncode == 0
    document = json.loads(done.stdout)
    assert (document["controller"], document["status"]) == ("setback", "completed")
    assert all("of the impact windows" in warning for warning in document["warnings"])
    for name, said in (
        ("setbakc", ("no controller 'setbakc'", "did you mean setback?")),
        ("gone", ("controller 'gone' (setback_gone:make)", "No module named 'setback_gone'")),
    ):
        refused(start(*words, name, cwd=tmp_path), 1, *said)


@pytest.mark.parametrize(("name", "words"), [("odd", "fails: TypeError"), ("number", "of type int")])
def test_what_another_package_makes_must_be_a_driver(setback: ModuleType, name: str, words: str) -> None:
    needs_mujoco()
    setback.len = lambda *given: len(given)
    with pytest.raises(InputError, match=words) as caught:
        shared_factory("aerial-vertical").driver(name)
    assert "\n" not in caught.value.line and f"controller '{name}'" in caught.value.line


def test_a_registered_controller_is_compared_and_runs_again(setback: ModuleType, tmp_path: Path) -> None:
    """Stored runs of a registered controller are ignored, because its code may have changed."""
    needs_mujoco()
    scenario = tmp_path / "aerial.toml"
    scenario.write_text(cut("aerial-vertical", count=1, settle=0.1, dwell=0.2, pause=0.05), encoding="utf-8")
    plan, store = {str(scenario): ["nominal", "setback"]}, JobStore(tmp_path / "store")
    first = reproduce(plan, seeds=1, store=store)
    assert [row.status for row in first.rows] == ["completed", "completed"]
    setback.SetbackDriver.brace = setback.Driver.brace
    again = reproduce(plan, seeds=1, store=store)
    totals = [[row.metrics["q_total_impact"].mean for row in result.rows] for result in (first, again)]
    assert totals[0][0] == totals[1][0] != totals[0][1] != totals[1][1]
