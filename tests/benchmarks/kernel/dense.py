"""The textbook way within CasADi: composite rigid bodies, LDLᵀ, reverse mode."""

from __future__ import annotations

import casadi as ca

from impact_posture.dynamics.tree import Tree, Wrench
from impact_posture.impact.contact import point_on
from tests.benchmarks.kernel.case import Case
from tests.benchmarks.kernel.generated import base_rotation, c_source, compiled, function_of
from tests.benchmarks.kernel.peer import Peer


def peers(case: Case, notes: list[str]) -> list[Peer]:
    """From this project's ``Tree.mass_matrix`` on CasADi's own LDLᵀ, derivative and code generator."""
    robot = case.robot
    q, n, step = ca.SX.sym("q", robot.nq), ca.SX.sym("n", 3), ca.SX.sym("step", robot.nv)
    base = 7 if robot.floating else 0
    moved = q[base:] + step[robot.nv - (robot.nq - base) :]
    # M does not depend on the base's pose: leave it at rest and give the normal in the base's axes.
    at, direction = moved, n
    if robot.floating:
        at = ca.vertcat(ca.DM([0, 0, 0, 0, 0, 0, 1]), moved)
        rest = base_rotation(q).T @ n
        direction = rest - ca.cross(step[3:6], rest)
    tree = Tree(robot.model, at)
    blow = Wrench(point_on(robot, case.frame), direction, ca.SX.zeros(3))
    H = solved(tree.mass_matrix(), tree.generalized_force([blow]))
    return compiled("CRBA + LDLᵀ, reverse AD", c_source(function_of(q, n, step, H)), notes)


def solved(M: ca.SX, force: ca.SX) -> ca.SX:
    """``H = aᵀa`` with ``M a = force`` by CasADi's sparse ``LDLᵀ``."""
    D, LT, order = ca.ldl(M)
    return ca.sumsqr(ca.ldl_solve(force, D, LT, order))
