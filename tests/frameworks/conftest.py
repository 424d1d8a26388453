"""A small robot with every kind of joint, its export, and postures."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from impact_posture.codegen.export import Export, write_export
from impact_posture.codegen.self_test import sample_postures
from impact_posture.impact.impact_contact import ImpactContact
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from tests.support.tools import need_compiler
from tests.support.urdfs import joint, link, load

N = np.array([0.0, 0.6, 0.8])


@dataclass(frozen=True)
class Sample:
    objective: WorstCaseObjective
    written: Export
    q: Any

    @property
    def out(self) -> Path:
        return self.written.out


@pytest.fixture(scope="module")
def sample(tmp_path_factory: pytest.TempPathFactory) -> Sample:
    """A floating robot with a planar, a continuous and a revolute joint, and postures with batches for threads."""
    need_compiler()
    folder = tmp_path_factory.mktemp("frameworks")
    robot = load(
        folder, link("base", 3.0, "0.1 0 0"), link("a", 1.0, "0 0.1 0.2"), link("b", 0.7, "0 0 0.2"),
        link("tip", 0.4, "0.1 0 0.1"), joint("slide", "base a", "0 0 1", kind="planar", more=""),
        joint("spin", "a b", at="0 0 0.3", kind="continuous"), joint("bend", "b tip", "1 0 0", at="0 0 0.4"),
        root="free-flyer",
    )  # fmt: skip
    objective = WorstCaseObjective(robot, ImpactContact("tip", N, (0, 0, 0.1)), kind="effective-mass")
    written = write_export([objective], folder / "out", prefix="small", cuda=True, build=True)
    return Sample(objective, written, np.array(sample_postures(robot, 600, 5)))


def near(values: Any, expected: Any, digits: float = 1e-13) -> None:
    np.testing.assert_allclose(values, expected, rtol=0, atol=digits * np.abs(expected).max())
