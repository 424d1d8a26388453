"""Compare two forms of the nonlinear program.

In the lifted form, the impact equations are constraints.  In the reduced form, the objective function solves these
equations.

IPOPT solves both forms with exact Hessians from the same starts, without compiled code.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Iterator

import casadi as ca
import numpy as np

from docs.studies.cases import CASES
from docs.studies.core import Request, Vector, feasible_starts, machine, table
from impact_posture.dynamics.tree import Tree
from impact_posture.impact.quantities.impact_kernel import ImpactKernel
from impact_posture.posture.program.ipopt import IPOPT_OPTIONS
from impact_posture.posture.program.posture_nlp import PostureNLP, build_nlp
from impact_posture.posture.search.growing_search import run_start

_CASES = ("tilthex_arm", "panda", "solo8, four feet", "talos, two feet")
_HEAD = "case|formulation|unknowns|operations of Hessian|Jacobian|gradient|solve ms|iterations|ended".split("|")
_Runs = list[tuple[float, int, bool]]


def lines(request: Request) -> Iterator[str]:
    yield from (machine(), "")
    yield from table(_HEAD, (row for name in _CASES if request.only in name for row in _rows(name, request.count)))


def _rows(name: str, count: int) -> Iterator[list[str]]:
    problem = CASES[name].problem()
    nlp = build_nlp(problem, compile="never")
    starts, scale = feasible_starts(problem, count, seed=2), problem.objective.value(problem.given)
    records = [run_start(nlp, start, scale)[0] for start in starts]
    yield _row(
        name,
        "lifted",
        nlp.solver.size1_in("x0"),
        nlp.solver,
        [(r.time_s, r.iterations, r.converged) for r in records],
    )
    solver = _reduced(nlp)
    yield _row(name, "reduced", nlp.chart.nx, solver, [_run(nlp, solver, start, scale) for start in starts])


def _reduced(nlp: PostureNLP) -> ca.Function:
    """Build the reduced form: the only variable is ``x``, and the adjoint kernel computes the objective."""
    problem, objective, chart = nlp.problem, nlp.problem.objective, nlp.chart
    x, scale = ca.SX.sym("x", chart.nx), ca.SX.sym("scale")
    q = chart.configuration(x)
    kernel = ImpactKernel(objective.case, q, ca.SX(np.array(objective.contact.normal)))
    tree = Tree(problem.robot.model, q, x)
    rows = [chart.norms(x)]
    for index, constraint in enumerate(problem.constraints):
        rows.append(constraint.lift(tree, ca.SX(constraint.parameters)).rows[problem.carried(index)])
    program = {"x": x, "p": scale, "f": objective.scale * kernel.H / scale, "g": ca.vertcat(*rows)}
    return ca.nlpsol("reduced", "ipopt", program, IPOPT_OPTIONS)


def _run(nlp: PostureNLP, solver: ca.Function, start: Vector, scale: float) -> tuple[float, int, bool]:
    problem, chart = nlp.problem, nlp.chart
    zeros, rows = np.zeros(len(chart.quaternion_slices())), list(enumerate(problem.constraints))
    lower, upper = (
        np.concatenate([zeros, *[getattr(c, side)[problem.carried(i)] for i, c in rows]])
        for side in ("lower", "upper")
    )
    began = time.perf_counter()
    solver(x0=chart.to_x(start), lbx=problem.lower, ubx=problem.upper, lbg=lower, ubg=upper, p=scale)
    stats = solver.stats()
    return time.perf_counter() - began, int(stats["iter_count"]), bool(stats["success"])


def _row(name: str, kind: str, size: int, solver: ca.Function, runs: _Runs) -> list[str]:
    counts = [str(solver.get_function(f).n_instructions()) for f in ("nlp_hess_l", "nlp_jac_g", "nlp_grad_f")]
    took, iterations, ended = zip(*runs, strict=True)
    middle = [f"{statistics.median(took) * 1e3:.1f}", f"{statistics.median(iterations):.0f}"]
    return [name, kind, str(size), *counts, *middle, f"{sum(ended)}/{len(runs)}"]
