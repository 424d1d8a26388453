"""How many operations ``bench`` says that a program does: in a text, in this project's graph, and at least."""

from __future__ import annotations

from pathlib import Path

import pytest

from impact_posture.benchmark.case import Case
from impact_posture.benchmark.count import Operations, count_operations
from impact_posture.benchmark.floor import floor
from impact_posture.benchmark.work import eval_operations
from impact_posture.codegen.export import export
from tests.helpers import robot


def test_operations_in_a_text() -> None:
    text = """
    static double helper(double x) { return sin(x) * -2.5e-3; }  /* a * b + c */
    int f(const double *x, double *y) {
      int i;
      for (i = 0; i < 3; ++i) { y[i + 1] += x[2 * i] * x[i] - x[0] / x[1]; }
      y[0] = -x[0] + helper(x[1]) / 2.;
      return 0;
    }
    """
    assert count_operations(text, "f") == Operations(add=3, mul=3, div=1, trig=1, neg=1)


@pytest.mark.parametrize(("name", "frame"), [("ur5", "tool0"), ("solo8", "base_link")])
def test_own_operations_are_those_of_the_text(tmp_path: Path, name: str, frame: str) -> None:
    """The portable C has the same arithmetic on single numbers; sums may be in another order."""
    case = Case.of(robot(name), frame)
    export(case.objective, tmp_path, prefix="k", check=False, portable=True)
    text = (tmp_path / "k.c").read_text()
    # Sines and cosines are a loop there; the unit norm of the quaternion is checked apart.
    shared = [count_operations(text, f"k_{part}") for part in ("eval", "check")]
    found = eval_operations(case.objective)
    for kind in ("add", "mul", "div"):
        written = getattr(shared[0], kind) - getattr(shared[1], kind)
        assert getattr(found, kind) == pytest.approx(written, rel=0.02), kind
    turning = case.robot.nv - (6 if case.robot.floating else 0)
    assert found.trig == 2 * turning
    assert (found.packed is None) == (name == "ur5")
    assert found.packed is None or 0.2 * found.total < found.packed < 0.6 * found.total


@pytest.mark.parametrize("name", ["solo8", "tilthex_arm", "panda"])
def test_floor_is_near_what_is_done(name: str) -> None:
    """The yardstick is of the right size: the export is neither far above nor far below it."""
    case = Case.of(robot(name), robot(name).spec.contact.frame or "")
    assert 0.5 < eval_operations(case.objective).total / floor(case.robot, case.point[0]).total < 1.3
