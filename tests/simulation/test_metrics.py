"""Metrics of records made by hand, where every number is known beforehand."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from impact_posture.errors import SpecError
from impact_posture.simulation.metrics import JUMP, before, jump, measure
from impact_posture.simulation.recorder import STATUSES
from impact_posture.simulation.run import Run
from impact_posture.simulation.series import Series, Window
from impact_posture.tsid.controller import Status
from tests.simulation.factories import by_hand, factory, fields_of, needs_mujoco


@pytest.fixture(scope="module", autouse=True)
def _mujoco() -> None:
    needs_mujoco()


def touch(begin: float, length: float = 0.3, contact: int = 0, kind: str = "impact", touched: bool = True) -> Window:
    return Window(kind, contact, begin, begin + length, touched)


def measured(columns: dict[str, Any], *windows: Window, n: int = 1000) -> Any:
    setup = factory("aerial-vertical").setup
    return measure(setup, Run(by_hand(setup, n, **columns), windows))


def test_the_integral_of_speed_and_its_shares() -> None:
    v = np.zeros((1000, 9))
    v[:, 0], v[:, 7] = 3.0, 4.0
    found = measured({"v": v}, touch(0.2), touch(0.2, 0.5, kind="dwell"))
    assert found.q_total_impact == pytest.approx(5 * 0.3)
    assert found.q_total_impact_base == pytest.approx(3 * 0.3)
    assert found.q_total_impact_joints == pytest.approx(4 * 0.3)
    assert found.q_total_dwell == pytest.approx(5 * 0.5)


def test_the_integral_against_one_known_in_closed_form() -> None:
    t = 1e-3 * np.arange(1, 1001)
    v = np.zeros((1000, 9))
    v[:, 2] = np.where(t > 0.4, np.exp(-(t - 0.4) / 0.05), 0.0)
    found = measured({"v": v}, touch(0.4))
    # A sum of a thousandth's steps: its error is half a step times the fall of the speed.
    assert found.q_total_impact == pytest.approx(0.05 * (1 - np.exp(-6)), abs=1e-3 / 2 * 1.01)


def test_what_lies_outside_the_windows_does_not_count() -> None:
    v, slip, peak = np.zeros((1000, 9)), np.zeros(1000), np.zeros(1000)
    # Ticks end at 1, 2, … ms: the window (0.2, 0.5] holds those from 201 to 500.
    for k in (0, 199, 500, 999):
        v[k], slip[k], peak[k] = 1.0, 1.0, 99.0
    found = measured({"v": v, "slip": slip, "peak": peak}, touch(0.2))
    assert (found.q_total_impact, found.slip, found.peak_force) == (0, 0, 0)
    for k in (200, 499):
        v[k, :] = 0
        v[k, 8], slip[k], peak[k] = 2.0, 0.5, 7.0 + k
    found = measured({"v": v, "slip": slip, "peak": peak}, touch(0.2))
    assert found.q_total_impact == pytest.approx(2 * 2e-3)
    assert found.slip == pytest.approx(2 * 0.5e-3) and found.peak_force == 7 + 499


@pytest.mark.parametrize("begin", [0.2, 0.20000000000001, 0.19999999999999, 0.2003, 0.2007, 0.3 - 0.1])
def test_a_window_has_as_many_ticks_wherever_it_begins(begin: float) -> None:
    setup = factory("aerial-vertical").setup
    # As the world counts (steps times the time step), and as MuJoCo does (their sum).
    for t in (0.25e-3 * 4 * np.arange(1, 1001), np.cumsum(np.full(4000, 0.25e-3))[3::4]):
        part = by_hand(setup, 1000, t=t).slice(begin, begin + 0.3)
        assert part.stop - part.start == 300
        assert t[part.start] > begin and t[part.start - 1] <= begin + 1e-9


def test_what_is_given_back_later_is_in_the_recovery() -> None:
    setup = factory("aerial-vertical").setup
    v = np.zeros((1000, 9))
    v[:201, 0] = 0.5
    # Quiet in the window, and all of it afterwards.
    v[600:800, 3] = 2.0
    windows = (touch(0.2), touch(0.2, 0.5, kind="recovery"), touch(0.9, 0.1, 1, touched=False))
    found = measure(setup, Run(by_hand(setup, 1000, v=v), windows))
    assert found.q_total_impact == pytest.approx(0.5e-3) and found.peak_jump == pytest.approx(0.5)
    assert found.q_total_recovery == pytest.approx(0.5e-3 + 2 * 0.1)
    assert found.peak_recovery == pytest.approx(np.hypot(0.5, 2.0))
    assert (found.contacts, found.contacts_asked) == (1, setup.scenario.task.count)  # type: ignore[union-attr]


def test_windows_that_overlap_count_once() -> None:
    v = np.zeros((1000, 9))
    v[:, 1] = 1.0
    assert measured({"v": v}, touch(0.1), touch(0.3, contact=1)).q_total_impact == pytest.approx(0.5)


def test_the_jump_is_the_largest_within_fifteen_milliseconds() -> None:
    v = np.zeros((1000, 9))
    v[:, 3] = 0.7
    v[204:, 3] = 0.7 + 0.4
    v[209, 4] = 0.3
    v[230:, 5] = 9.0
    found = measured({"v": v}, touch(0.2))
    assert JUMP == 0.015
    assert found.peak_jump == found.peak_jump_max == pytest.approx(0.5)


def test_the_jump_begins_at_the_last_tick_before_the_touch() -> None:
    setup = factory("aerial-vertical").setup
    v = np.arange(1000)[:, None] * np.ones(9)
    series = by_hand(setup, 1000, v=v)
    # Touched in the middle of the tick that ends at 0.201 (index 200): index 199 is before.
    assert before(series, touch(0.2004)) == 199
    assert jump(setup, series, touch(0.2004)) == pytest.approx(3 * 15)
    assert before(series, touch(0.0)) == 0


def test_mean_and_largest_jump_of_the_contacts_that_came_about() -> None:
    v = np.zeros((1000, 9))
    v[201:, 0], v[601:, 0] = 1.0, 4.0
    windows = [touch(0.2), touch(0.6, contact=1), touch(0.4, 0.1, contact=2, touched=False)]
    found = measured({"v": v}, *windows)
    assert found.peak_jump == pytest.approx(2.0) and found.peak_jump_max == pytest.approx(3.0)
    assert found.contacts == 2
    none = measured({"v": v}, touch(0.2, touched=False))
    assert (none.peak_jump, none.contacts) == (0.0, 0)


def test_saturation_inside_outside_and_of_which_motors() -> None:
    setup = factory("aerial-vertical").setup
    propulsion = setup.robot.spec.propulsion
    assert propulsion is not None
    limits = np.asarray(setup.robot.model.effortLimit)[6:]
    command, torque = np.full((1000, 6), 50.0), np.zeros((1000, 3))
    command[210:215, 2] = propulsion.speed_max
    command[215:217, 5] = propulsion.speed_min
    torque[216:226, 1] = -limits[1]
    torque[400, 0] = 0.99 * limits[0]
    command[600:640, 0] = propulsion.speed_max
    found = measured({"rotor_command": command, "torque": torque}, touch(0.2))
    assert found.saturation_inside == pytest.approx(0.016)
    assert found.saturation_rotors == pytest.approx(0.007)
    assert found.saturation_outside == pytest.approx(0.040)


def test_relaxed_and_failed_ticks_stops_and_contacts() -> None:
    status, at_stop = np.zeros(1000, int), np.zeros((1000, 9), bool)
    status[10:13] = STATUSES.index(Status.RELAXED)
    status[500] = STATUSES.index(Status.UNSOLVED)
    status[501] = STATUSES.index(Status.NON_FINITE)
    # From the start on, outside the window, and one that counts.
    at_stop[:, 6], at_stop[700, 7], at_stop[300, 8] = True, True, True
    found = measured({"status": status, "at_stop": at_stop}, touch(0.2))
    assert (found.relaxed_ticks, found.failed_ticks) == (3, 2)
    assert found.stops == ("elbow_pitch",)


def test_a_pushs_jump_is_the_largest_speed_and_its_force_the_pushs() -> None:
    setup = factory("solo8-push").setup
    v, peak = np.zeros((1000, 14)), np.zeros(1000)
    v[:, 0], v[350, 0], v[700, 0] = 0.1, -0.6, 5.0
    peak[200:600] = 6.5
    found = measure(setup, Run(by_hand(setup, 1000, v=v, peak=peak), (touch(0.2, 0.4),), -1, 0.2, False))
    assert found.peak_jump == 0.6 and found.peak_force == 6.5 and not found.rested
    assert found.q_total_dwell == 0 and found.q_total_impact == pytest.approx(0.1 * 0.399 + 0.6e-3)


def test_metrics_are_json() -> None:
    found = json.loads(json.dumps(measured({}, touch(0.2)).to_dict()))
    assert found["saturation_s"] == {"inside": 0, "outside": 0, "rotors": 0}
    assert found["stops"] == [] and found["contacts"] == 1 and found["q_total_impact"] == 0


# ---- series as files ----------------------------------------------------------------------------------------------


def test_a_series_comes_back_from_its_file(tmp_path: Path) -> None:
    setup = factory("aerial-vertical").setup
    series = by_hand(setup, 20, v=np.random.default_rng(0).normal(size=(20, 9)))
    series.save(tmp_path / "series.npz")
    again = Series.load(tmp_path / "series.npz")
    for name, column in fields_of(series).items():
        np.testing.assert_array_equal(getattr(again, name), column)
        assert getattr(again, name).dtype == column.dtype


@pytest.mark.parametrize("kind", ["missing", "empty", "text", "array", "other"])
def test_what_is_no_series_is_one_line(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "series.npz"
    if kind == "empty":
        path.touch()
    elif kind == "text":
        path.write_text("t = 1")
    elif kind == "array":
        with path.open("wb") as file:
            np.save(file, np.zeros(3))
    elif kind == "other":
        np.savez(path, t=np.zeros(3))
    with pytest.raises(SpecError, match="is not a time series") as caught:
        Series.load(path)
    assert "\n" not in caught.value.line and "series.npz" in caught.value.line
