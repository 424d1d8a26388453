"""The closed derivatives of the torques of a robot at rest, against automatic differentiation of the same torques."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from impact_posture.dynamics.tree import Tree
from impact_posture.posture.holdable import Holdable
from impact_posture.posture.problem_settings import prepare
from impact_posture.posture.program_rows import Derivatives, ProgramRows
from tests.settings import make_settings

CASES = {
    "humanoid": {"robot": "talos", "frame": "gripper_right_base_link"},
    "quadruped": {"robot": "solo12"},
    "humanoid that pushes": {"robot": "g1", "hold_force": 20.0},
    "quadruped with an arm": {"robot": "anymal_kinova"},
}


@pytest.mark.parametrize("case", CASES)
def test_closed_derivatives_equal_automatic_ones(case: str) -> None:
    ours, theirs = functions_of(case)
    assert ours.nnz_out() <= 1.02 * theirs.nnz_out()
    rng = np.random.default_rng(5)
    for _ in range(3):
        # The quaternion has no unit norm there.
        values = [rng.normal(size=ours.size1_in(k)) for k in range(2)]
        for one, other in zip(ours(*values), theirs(*values), strict=True):
            np.testing.assert_allclose(np.array(one), np.array(other), atol=1e-9 * np.abs(np.array(other)).max())


def test_they_save_operations() -> None:
    ours, theirs = functions_of("humanoid")
    assert ours.n_instructions() < 0.5 * theirs.n_instructions()


def functions_of(case: str) -> tuple[ca.Function, ca.Function]:
    """Jacobian and upper Hessian of all rows of a load, ours and by automatic differentiation."""
    problem = prepare(make_settings({"normal": (-1.0, 0.3, 0.4), "holdable": True, **CASES[case]})).problem
    rows = ProgramRows(problem)
    loads = [c for c in problem.constraints if isinstance(c, Holdable)]
    rest = loads[-1]._rest
    tree = rows.tree if rows.tree.model is rest.load.model else Tree(rest.load.model, rows.tree.q, rows.x)
    lifted = Holdable("at rest", rest, "", active=True).lift(tree, ca.SX(0, 1))
    assert lifted.known is not None
    unknowns = ca.vertcat(rows.x, lifted.variables)
    automatic = Derivatives.of(lifted.rows, unknowns)
    results = []
    for name, (jacobian, hessian) in (
        ("ours", lifted.known(automatic.multipliers)),
        ("theirs", (automatic.jacobian, automatic.hessian)),
    ):
        results.append(ca.Function(name, [unknowns, automatic.multipliers], [jacobian, ca.triu(hessian)]))
    return results[0], results[1]
