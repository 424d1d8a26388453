"""Lifted against reduced: the impact's linear solve as equations of the program, or inside the objective.

Both by IPOPT with exact Hessians on the same starts, interpreted.  Run: python -m tests.benchmarks.formulations
"""

from __future__ import annotations

import statistics
from dataclasses import dataclass

import casadi as ca
import numpy as np

from impact_posture.dynamics.chart import Chart
from impact_posture.dynamics.tree import Tree
from impact_posture.impact.kernel import ImpactKernel
from impact_posture.posture.nlp import IPOPT_OPTIONS, PostureNLP, build_nlp
from impact_posture.posture.problem import PostureProblem
from impact_posture.posture.solve import run_start
from impact_posture.posture.starts import feasible_start
from tests.benchmarks.common import default_problem, machine

CASES = [
    ("tilthex_arm", "ee", (0.0, 0.0, 1.0)),
    ("panda", "panda_hand_tcp", (0.0, 0.0, 1.0)),
    ("solo8", "base_link", (1.0, 0.0, 0.0)),
    ("talos", "gripper_right_base_link", (1.0, 0.0, 0.0)),
]
STARTS = 12


@dataclass(frozen=True)
class ReducedObjective:
    """The objective with no auxiliaries: ``guess`` is empty, the value is that of the adjoint kernel."""

    problem: PostureProblem

    def solver(self, chart: Chart) -> ca.Function:
        """IPOPT on ``x`` alone."""
        problem, objective = self.problem, self.problem.objective
        x, scale = ca.SX.sym("x", chart.nx), ca.SX.sym("scale")
        q = chart.configuration(x)
        n = ca.SX(np.array(objective.contact.normal))
        kernel = ImpactKernel(objective.case, q, n)
        tree = Tree(problem.robot.model, q, x)
        rows = [chart.norms(x)]
        for index, constraint in enumerate(problem.constraints):
            rows.append(constraint.symbolic(tree, ca.SX(constraint.parameters))[problem.carried(index)])
        program = {"x": x, "p": scale, "f": objective.scale * kernel.H / scale, "g": ca.vertcat(*rows)}
        return ca.nlpsol("reduced", "ipopt", program, IPOPT_OPTIONS)


def main() -> None:
    """Print one row a formulation and case."""
    print(machine())
    print(
        "robot        formulation  unknowns  operations of Hessian  Jacobian  gradient  solve ms  iterations  ended"
    )
    for name, frame, normal in CASES:
        problem = default_problem(name, frame, normal)
        nlp = build_nlp(problem, compile="never")
        scale = problem.objective.value(problem.given)
        starts = [s for k in range(1, 3 * STARTS) if (s := feasible_start(problem, k, seed=2)) is not None][:STARTS]
        runs = [run_start(nlp, start, scale)[0] for start in starts]
        _row(name, "lifted", nlp.size, nlp.solver, [r.time_s for r in runs], [r.iterations for r in runs],
             sum(r.converged for r in runs))  # fmt: skip
        _reduced(name, nlp, starts, scale)


def _reduced(name: str, nlp: PostureNLP, starts: list[np.ndarray], scale: float) -> None:
    import time

    problem, chart = nlp.problem, nlp.chart
    solver = ReducedObjective(problem).solver(chart)
    zeros = np.zeros(len(chart.quaternion_slices()))
    carried = list(enumerate(problem.constraints))
    lower = np.concatenate([zeros, *[c.lower[problem.carried(i)] for i, c in carried]])
    upper = np.concatenate([zeros, *[c.upper[problem.carried(i)] for i, c in carried]])
    times, iterations, ended = [], [], 0
    for start in starts:
        began = time.perf_counter()
        solver(x0=chart.to_x(start), lbx=problem.lower, ubx=problem.upper, lbg=lower, ubg=upper, p=scale)
        times.append(time.perf_counter() - began)
        stats = solver.stats()
        iterations.append(int(stats["iter_count"]))
        ended += bool(stats["success"])
    _row(name, "reduced", chart.nx, solver, times, iterations, ended)


def _row(
    name: str, kind: str, size: int, solver: ca.Function, times: list[float], iterations: list[int], ended: int
) -> None:
    hessian, jacobian, gradient = (
        solver.get_function(f).n_instructions() for f in ("nlp_hess_l", "nlp_jac_g", "nlp_grad_f")
    )
    print(
        f"{name:12s} {kind:11s} {size:9d} {hessian:22d} {jacobian:9d} {gradient:9d} "
        f"{statistics.median(times) * 1e3:9.1f} {statistics.median(iterations):11.0f}  {ended}/{len(times)}"
    )


if __name__ == "__main__":
    main()
