"""The textbook way within CasADi: composite rigid bodies, LDLᵀ, reverse mode, CasADi's code generator."""

from __future__ import annotations

import casadi as ca

from impact_posture.benchmark.case import Case
from impact_posture.benchmark.generated import base_rotation, c_source, compiled, function_of
from impact_posture.benchmark.peer import Peer
from impact_posture.benchmark.workbench import Workbench
from impact_posture.dynamics.chart import Chart, tangent_map
from impact_posture.dynamics.tree import Tree, Wrench
from impact_posture.impact.contact import point_on


def peers(case: Case, bench: Workbench) -> list[Peer]:
    """From this project's ``Tree.mass_matrix`` on CasADi's own LDLᵀ, derivative and code generator.

    Raises:
        Absent: No compiler, or none of them ended in time.
    """
    robot = case.robot
    q, n, step = ca.SX.sym("q", robot.nq), ca.SX.sym("n", 3), ca.SX.sym("step", robot.nv)
    # To first order in the step this is q ⊕ step.
    at, direction = q + tangent_map(Chart(robot.model), q) @ step, n
    if robot.floating:
        # M does not depend on the base's pose: leave it at rest and give the normal in the base's axes.
        at = ca.vertcat(ca.DM([0, 0, 0, 0, 0, 0, 1]), at[7:])
        rest = base_rotation(q).T @ n
        direction = rest - ca.cross(step[3:6], rest)
    tree = Tree(robot.model, at)
    impact = Wrench(point_on(robot, case.frame), direction, ca.SX.zeros(3))
    H = solved(tree.mass_matrix(), tree.generalized_force([impact]))
    source = c_source(function_of(q, n, step, H))
    return compiled("CasADi", "casadi", "CRBA + LDLᵀ, CasADi's reverse mode and C", source, bench)


def solved(M: ca.SX, force: ca.SX) -> ca.SX:
    """``H = aᵀa`` with ``M a = force`` by CasADi's sparse ``LDLᵀ``."""
    D, LT, order = ca.ldl(M)
    return ca.sumsqr(ca.ldl_solve(force, D, LT, order))
