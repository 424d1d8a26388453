"""Short run of the impact study: few postures per robot, MuJoCo's jump compared with predictions, and its page."""

from __future__ import annotations

import functools
import re
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mujoco", reason="mujoco is not installed (the extra 'sim')")

from docs.studies.core import page_of
from docs.studies.impact.study import STUDIED, Dropped, needed_friction
from docs.studies.impact.surface import Surface

DOCS = Path(__file__).parents[2] / "docs"
FLYING, ARM, STANDING = "tilthex_arm", "panda", "solo12"
STICKS = float("inf")
POSTURES = 3


@functools.cache
def dropped(name: str) -> Dropped:
    robot = Dropped.prepare(name, POSTURES, seed=0)
    assert len(robot.scenes) == POSTURES
    return robot


@pytest.mark.parametrize("name", [FLYING, ARM, STANDING])
def test_without_friction_speed_impulse_and_energy_hold(name: str) -> None:
    row = dropped(name).on(Surface())
    assert not row.left_out
    assert max(o.deviation("speed") for o in row.outcomes) < 0.01
    for objective in ("impulse", "speed", "energy"):
        np.testing.assert_allclose(row.ratios(objective), 1, atol=0.01, err_msg=objective)
    assert row.rank("speed") == pytest.approx(1)
    # The predictions assume a nearly plastic, short impact and feet that do not move.
    assert (np.abs(row.measured("restitution") - 0.05) < 0.02).all()
    assert (row.measured("duration") < 1e-3).all()
    assert (row.measured("feet") < 1e-3).all()


@pytest.mark.parametrize("name", [FLYING, ARM, STANDING])
def test_where_the_point_sticks_sticking_holds_and_speed_does_not(name: str) -> None:
    row = dropped(name).on(Surface(STICKS))
    assert not row.left_out
    assert row.slid == 0
    assert max(o.deviation("sticking") for o in row.outcomes) < 0.01
    np.testing.assert_allclose(row.ratios("sticking"), 1, atol=0.01)
    missed, hit = (np.abs(row.ratios(objective) - 1).max() for objective in ("speed", "sticking"))
    assert missed > 5 * hit
    # Friction never reduces the energy that the contact dissipates.
    assert row.ratios("energy")[0] > 0.99


def test_a_rebound_and_another_speed_scale_the_jump() -> None:
    row = dropped(FLYING).on(Surface(speed=2.0, damping=0.1))
    assert (row.measured("restitution") > 0.7).all()
    np.testing.assert_allclose(row.ratios("speed"), 1, atol=0.01)
    np.testing.assert_allclose(row.ratios("energy"), 1, atol=0.01)


def test_the_sticking_impulse_says_which_postures_slide() -> None:
    """The study's Coulomb law predicts sticking inside the friction cone; MuJoCo agrees for sticking contacts."""
    friction = 0.8
    row = dropped(FLYING).on(Surface(friction))
    held = [needed_friction(o.predicted) <= friction for o in row.outcomes]
    assert any(held)
    assert not all(held)
    assert [bool(slip < 0.01) for slip in row.measured("slip")] == held
    # A sliding contact is not mistaken for a rebound.
    assert (np.abs(row.measured("restitution") - 0.05) < 0.02).all()
    ours, mujocos = dropped(FLYING).on(Surface(10.0)), dropped(FLYING).on(Surface(STICKS))
    np.testing.assert_allclose(ours.measured("size"), mujocos.measured("size"), rtol=0.01)


def test_the_page_says_only_what_the_bench_printed() -> None:
    """Every decimal number on the page is also in the generated tables, and the tables confirm the targets met."""
    tables = page_of("impacts").read_text(encoding="utf-8")
    prose = (DOCS / "objectives.md").read_text(encoding="utf-8")
    printed = set(re.findall(r"\d+\.\d+", tables))
    said = set(re.findall(r"\d+\.\d+", prose))
    assert said
    assert said <= printed, f"not printed by the bench: {sorted(said - printed)}"
    for line in ("`speed`, no friction: rank", "`speed`, no friction: every jump", "`sticking`, sticks: rank"):
        assert re.search(rf"{re.escape(line)}.*: met by all {len(STUDIED)}", tables), line
