"""Closed-form derivatives of the jump equations, compared with automatic differentiation."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from impact_posture.config.problem_settings import ProblemSettings
from impact_posture.posture.formulation.problem_file import prepare
from impact_posture.posture.program.program import Program
from impact_posture.posture.program.program_rows import Derivatives
from tests.support.settings import make_settings

NORMAL = (-1.0, 0.3, 0.4)
HANDS = ("gripper_right_base_link:-1,0,0", "gripper_left_base_link:0,0,1")
CASES = {
    "arm": {"robot": "panda"},
    "continuous joints": {"robot": "kinova", "objective": "speed"},
    "flying arm": {"robot": "tilthex_arm", "objective": "sticking"},
    "friction, quadruped": {"robot": "anymal_c", "objective": "coulomb"},
    "humanoid": {"robot": "talos", "frame": "gripper_right_base_link"},
    "sliding joint": {"robot": "tiago", "objective": "energy"},
    "kinetic": {"robot": "solo12", "metric": "kinetic"},
    "cone": {"robot": "solo8", "normal_cone": 20.0},
    "normal that turns": {"robot": "anymal_kinova", "normal_frame": "contact"},
    "locked joints": {"robot": "tilthex_arm", "joint_model": "locked"},
    "several models": {"robot": "solo12", "armature_range": (0.5, 2.0)},
}


@pytest.mark.parametrize("case", CASES)
def test_closed_derivatives_equal_automatic_ones(case: str) -> None:
    program = Program(prepare(make_settings({"normal": NORMAL, **CASES[case]})).problem)
    same_as_automatic(program)


def test_they_save_operations() -> None:
    program = Program(prepare(make_settings({"normal": NORMAL, **CASES["humanoid"]})).problem)
    ours, theirs = functions_of(program)
    assert ours.n_instructions() < 0.5 * theirs.n_instructions()


def test_of_contacts_that_act_at_once() -> None:
    program = Program(prepare(ProblemSettings(robot="talos", contact=HANDS)).problem)
    assert len(program.lifted.jumps) == 2
    same_as_automatic(program)


def functions_of(program: Program) -> tuple[ca.Function, ca.Function]:
    """Return Jacobian and upper triangle of the Hessian of ``lifted``, in closed form and by CasADi."""
    lifted = program.lifted
    assert lifted.jumps
    unknowns = ca.vertcat(program.rows.x, lifted.variables)
    rows = ca.vertcat(program.value, program.rows.norms, lifted.residual, lifted.inequalities)
    results = []
    for name, result in ("ours", program.fixed), ("theirs", Derivatives.of(rows, unknowns)):
        arguments = [unknowns, result.multipliers, program.parameters]
        results.append(ca.Function(name, arguments, [result.jacobian, ca.triu(result.hessian)]))
    return results[0], results[1]


def same_as_automatic(program: Program) -> None:
    """Compare at random values of the unknowns, which do not satisfy the constraints."""
    ours, theirs = functions_of(program)
    # The closed form may have at most 2 % more entries, because the solver factorizes all of them.
    assert ours.nnz_out() <= 1.02 * theirs.nnz_out()
    rng = np.random.default_rng(3)
    for _ in range(3):
        values = [rng.normal(size=ours.size1_in(k)) for k in range(3)]
        for one, other in zip(ours(*values), theirs(*values), strict=True):
            np.testing.assert_allclose(np.array(one), np.array(other), atol=1e-9 * np.abs(np.array(other)).max())
