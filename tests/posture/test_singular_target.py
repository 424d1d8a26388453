"""Targets at which an arm is singular: the error names the singularity, and its bent start works."""

from __future__ import annotations

import re
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from impact_posture.errors import SolverFailed
from impact_posture.posture.formulation.problem_file import prepare
from impact_posture.posture.program.constrained_problem import ConstrainedProblem
from impact_posture.posture.search.multistart import solve
from impact_posture.posture.search.singular_target import singular_target
from tests.support.settings import make_settings
from tests.support.urdfs import joint, link, write


def candle(folder: Path, offset: float = 0.01, toml: str = "", **settings: object) -> ConstrainedProblem:
    """Return the problem of an arm that is stretched if all seven joints are zero, as many published arms are.

    ``offset`` is the distance between its vertical axes, m.
    """
    parts = [link("l0"), link("tip"), joint("tm", "l7 tip", None, "0 0 0.1", "fixed", "")]
    for k in range(1, 8):
        axis, at = f"0 {1 - k % 2} {k % 2}", f"{offset * (1 - k % 2)} 0 0.15"
        parts += [link(f"l{k}", 1, "0 0.01 0.07"), joint(f"q{k}", f"l{k - 1} l{k}", axis, at)]
    path = write(folder, *parts, toml=toml)
    return prepare(make_settings({"robot": str(path), "frame": "tip", "normal": [1.0, 0.0, 0.0], **settings})).problem


def test_a_stretched_arm_is_named_and_gets_a_bent_start(tmp_path: Path) -> None:
    with pytest.raises(SolverFailed) as caught:
        solve(candle(tmp_path), starts=4, jobs=1)
    line = caught.value.line
    assert re.search(
        r"pose of tip is held where the robot is singular \(its Jacobian has the rank [45] instead of 6", line
    )
    assert "starts`" not in line
    table = caught.value.hint.partition("[postures.bent] ")[2].partition(" in robot.toml")[0]
    bent = tomllib.loads(table)["joints"]
    assert 1 <= len(bent) <= 3 and all(abs(abs(angle) - 0.5) < 1e-9 for angle in bent.values())
    start = candle(tmp_path, toml=f"[postures.bent]\n{table}\n", posture="bent")
    assert solve(start, starts=4, jobs=1).certified_starts > 0


def test_only_singular_targets_are_named(tmp_path: Path) -> None:
    """A target is singular only if all postures are singular.  An initial posture does not change a stated target."""
    problem = candle(tmp_path)
    bent = np.array([0.0, 0.5, 0.0, -0.5, 0.0, 0.5, 0.0])
    assert singular_target(problem, [problem.given, bent]) is None
    stated = singular_target(candle(tmp_path, target_position=[0.03, 0.0, 1.15]), [problem.given])
    assert stated is not None and stated.hint == "move the target to where the robot need not stretch"


def test_a_straight_wrist_needs_one_bent_joint(tmp_path: Path) -> None:
    """If q3 is held, the axes of q5 and q7 coincide in a straight wrist, and only q6 can separate them."""
    straight = np.array([0.0, 0.5, 0.0, -0.9, 0.0, 0.0, 0.0])
    assert singular_target(candle(tmp_path, 0.0), [straight]) is None
    problem = replace(candle(tmp_path, 0.0, hold=["q3"]), given=straight)
    singular = singular_target(problem, [straight])
    assert singular is not None and (singular.rank, singular.full_rank) == (5, 6)
    assert [*singular.bent] == ["q6"]
