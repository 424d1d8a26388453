"""Metrics of synthetic time series with known results."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from impact_posture.errors import SpecError
from impact_posture.simulation.metrics import JUMP, before, impact_load, measure
from impact_posture.simulation.recorder import STATUSES
from impact_posture.simulation.run import Run
from impact_posture.simulation.series import Series, Window
from impact_posture.tsid.controller import Status
from tests.simulation.factories import by_hand, fields_of, shared_setup


def touch(begin: float, length: float = 0.3, contact: int = 0, kind: str = "impact", touched: bool = True) -> Window:
    return Window(kind, contact, begin, begin + length, touched)


def measured(columns: dict[str, Any], *windows: Window, n: int = 1000) -> Any:
    setup = shared_setup("aerial-vertical")
    return measure(setup, Run(by_hand(setup, n, **columns), windows))


def test_the_integral_of_speed_for_base_and_joints() -> None:
    v = np.zeros((1000, 9))
    v[:, 0], v[:, 7] = 3.0, 4.0
    metrics = measured({"v": v}, touch(0.2), touch(0.2, 0.5, kind="dwell"))
    assert metrics.q_total_impact == pytest.approx(5 * 0.3)
    assert metrics.q_total_impact_base == pytest.approx(3 * 0.3)
    assert metrics.q_total_impact_joints == pytest.approx(4 * 0.3)
    assert metrics.q_total_dwell == pytest.approx(5 * 0.5)


def test_the_integral_of_speed_against_its_closed_form() -> None:
    t = 1e-3 * np.arange(1, 1001)
    v = np.zeros((1000, 9))
    v[:, 2] = np.where(t > 0.4, np.exp(-(t - 0.4) / 0.05), 0.0)
    metrics = measured({"v": v}, touch(0.4))
    # The integration error of the sum is half a time step times the drop in speed.
    assert metrics.q_total_impact == pytest.approx(0.05 * (1 - np.exp(-6)), abs=1e-3 / 2 * 1.01)


def test_ticks_outside_the_windows_do_not_count() -> None:
    v, slip, peak = np.zeros((1000, 9)), np.zeros(1000), np.zeros(1000)
    # Ticks end at 1, 2, … ms, so the window (0.2, 0.5] contains the ticks 201 to 500.
    for k in (0, 199, 500, 999):
        v[k], slip[k], peak[k] = 1.0, 1.0, 99.0
    metrics = measured({"v": v, "slip": slip, "peak": peak}, touch(0.2))
    assert (metrics.q_total_impact, metrics.slip, metrics.peak_force) == (0, 0, 0)
    for k in (200, 499):
        v[k, :] = 0
        v[k, 8], slip[k], peak[k] = 2.0, 0.5, 7.0 + k
    metrics = measured({"v": v, "slip": slip, "peak": peak}, touch(0.2))
    assert metrics.q_total_impact == pytest.approx(2 * 2e-3)
    assert metrics.slip == pytest.approx(2 * 0.5e-3) and metrics.peak_force == 7 + 499


@pytest.mark.parametrize("begin", [0.2, 0.20000000000001, 0.19999999999999, 0.2003, 0.2007, 0.3 - 0.1])
def test_a_window_always_has_the_same_number_of_ticks(begin: float) -> None:
    setup = shared_setup("aerial-vertical")
    # Compare the time of the world (steps times time step) with the time of MuJoCo (sum of time steps).
    for t in (0.25e-3 * 4 * np.arange(1, 1001), np.cumsum(np.full(4000, 0.25e-3))[3::4]):
        part = by_hand(setup, 1000, t=t).slice(begin, begin + 0.3)
        assert part.stop - part.start == 300
        assert t[part.start] > begin and t[part.start - 1] <= begin + 1e-9


def test_a_delayed_motion_is_in_the_recovery() -> None:
    setup = shared_setup("aerial-vertical")
    v = np.zeros((1000, 9))
    v[:201, 0] = 0.5
    # The robot moves only after the window.
    v[600:800, 3] = 2.0
    windows = (touch(0.2), touch(0.2, 0.5, kind="recovery"), touch(0.9, 0.1, 1, touched=False))
    metrics = measure(setup, Run(by_hand(setup, 1000, v=v), windows))
    assert metrics.q_total_impact == pytest.approx(0.5e-3) and metrics.peak_jump == pytest.approx(0.5)
    assert metrics.q_total_recovery == pytest.approx(0.5e-3 + 2 * 0.1)
    assert metrics.peak_recovery == pytest.approx(np.hypot(0.5, 2.0))
    assert (metrics.contacts, metrics.contacts_asked) == (1, setup.scenario.task.count)  # type: ignore[union-attr]


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
    metrics = measured({"v": v}, touch(0.2))
    assert JUMP == 0.015
    assert metrics.peak_jump == metrics.peak_jump_max == pytest.approx(0.5)


def test_the_jump_is_measured_until_the_last_contact_has_landed() -> None:
    v, impulse = np.zeros((1000, 9)), np.zeros((1000, 3))
    # The last contact touches 28 ms after the first contact, so the interval contains the ticks 200 to 242.
    v[200:, 3], v[215:243, 4], v[243:, 5] = 0.3, 0.4, 9.0
    impulse[210:], impulse[235:], impulse[243:] = 1.0, 3.0, 50.0
    setup = shared_setup("aerial-vertical")
    series = by_hand(setup, 1000, v=v, impulse=impulse)
    for landing, jump, factor in ((0.0, 0.3, 1.0), (0.028, 0.5, 3.0)):
        load = impact_load(setup, series, Window("impact", 0, 0.2, 0.5, True, landing))
        assert load.jump == pytest.approx(jump)
        assert load.impulse == pytest.approx(factor * abs(setup.scenario.normal.sum()))
        assert load.base_angular == pytest.approx(jump)


def test_the_jump_begins_at_the_last_tick_before_the_touch() -> None:
    setup = shared_setup("aerial-vertical")
    v = np.arange(1000)[:, None] * np.ones(9)
    series = by_hand(setup, 1000, v=v)
    # The first touch is in tick 200, which ends at 0.201 s, so tick 199 is the last tick before the touch.
    assert before(series, touch(0.2004)) == 199
    assert impact_load(setup, series, touch(0.2004)).jump == pytest.approx(3 * 15)
    assert before(series, touch(0.0)) == 0


def test_mean_and_largest_jump_of_the_contacts() -> None:
    v = np.zeros((1000, 9))
    v[201:, 0], v[601:, 0] = 1.0, 4.0
    windows = [touch(0.2), touch(0.6, contact=1), touch(0.4, 0.1, contact=2, touched=False)]
    metrics = measured({"v": v}, *windows)
    assert metrics.peak_jump == pytest.approx(2.0) and metrics.peak_jump_max == pytest.approx(3.0)
    assert metrics.contacts == 2
    none = measured({"v": v}, touch(0.2, touched=False))
    assert (none.peak_jump, none.contacts) == (0.0, 0)


def test_base_worst_joint_and_impulse_of_each_window() -> None:
    setup = shared_setup("aerial-vertical")
    limits, names = setup.robot.velocity_limits, setup.robot.tangent_names
    generator = np.random.default_rng(5)
    v = generator.normal(size=(1000, 9)) * np.where(np.isfinite(limits), limits, 1.0)
    impulse = generator.normal(size=(1000, 3)).cumsum(axis=0)
    windows = touch(0.2), touch(0.6, contact=1), touch(0.4, 0.1, contact=2, touched=False)
    metrics = measured({"v": v, "impulse": impulse, "peak": np.arange(1000.0)}, *windows)
    # Ticks end at 1, 2, … ms.  The last tick before the touch at 0.2 s has the index 199.
    loads, series = [], by_hand(setup, 1000, v=v, impulse=impulse, peak=np.arange(1000.0))
    for k, window in zip((199, 599), windows, strict=False):
        change = v[k + 1 : k + 16] - v[k]
        load = impact_load(setup, series, window)
        assert load.base_linear == pytest.approx(np.linalg.norm(change[:, :3], axis=1).max())
        assert load.base_angular == pytest.approx(np.linalg.norm(change[:, 3:6], axis=1).max())
        largest = np.abs(change[:, 6:]).max(axis=0)
        worst = int(np.argmax(largest / limits[6:]))
        assert load.joint is not None and load.joint.name == names[6 + worst]
        assert load.joint.velocity == pytest.approx(largest[worst])
        assert load.joint.share == pytest.approx((largest / limits[6:]).max())
        assert load.impulse == pytest.approx(abs(setup.scenario.normal @ (impulse[k + 15] - impulse[k])))
        assert load.peak_force == k + 300
        loads.append(load)
    for name in ("base_linear", "base_angular", "impulse"):
        assert getattr(metrics, name) == pytest.approx(np.mean([getattr(load, name) for load in loads])), name
    assert metrics.joint == max((load.joint for load in loads if load.joint), key=lambda joint: joint.share or 0)
    assert metrics.load.joint == metrics.joint and metrics.load.peak_force == 599 + 300
    nothing = measured({"v": v}, touch(0.2, touched=False))
    assert (nothing.base_linear, nothing.joint, nothing.impulse) == (None, None, 0.0)


def test_a_fixed_robot_has_no_base() -> None:
    setup = shared_setup("panda-tap")
    v = np.zeros((1000, setup.robot.nv))
    v[300:, 2] = 0.4
    load = measure(setup, Run(by_hand(setup, 1000, v=v), (touch(0.2),))).load
    assert (load.base_linear, load.base_angular, load.joint) == (None, None, load.joint)
    quiet = impact_load(setup, by_hand(setup, 1000, v=v), touch(0.29))
    assert load.joint is not None and load.joint.velocity == 0 and quiet.joint is not None
    assert (quiet.joint.name, quiet.joint.velocity) == (setup.robot.tangent_names[2], 0.4)


def test_saturation_inside_and_outside_the_windows() -> None:
    setup = shared_setup("aerial-vertical")
    propulsion = setup.robot.spec.propulsion
    assert propulsion is not None
    limits = np.asarray(setup.robot.model.effortLimit)[6:]
    command, torque = np.full((1000, 6), 50.0), np.zeros((1000, 3))
    command[210:215, 2] = propulsion.speed_max
    command[215:217, 5] = propulsion.speed_min
    torque[216:226, 1] = -limits[1]
    torque[400, 0] = 0.99 * limits[0]
    command[600:640, 0] = propulsion.speed_max
    metrics = measured({"rotor_command": command, "torque": torque}, touch(0.2))
    assert metrics.saturation_inside == pytest.approx(0.016)
    assert metrics.saturation_rotors == pytest.approx(0.007)
    assert metrics.saturation_outside == pytest.approx(0.040)


def test_relaxed_and_failed_ticks_stops_and_contacts() -> None:
    status, at_stop = np.zeros(1000, int), np.zeros((1000, 9), bool)
    status[10:13] = STATUSES.index(Status.RELAXED)
    status[500] = STATUSES.index(Status.UNSOLVED)
    status[501] = STATUSES.index(Status.NON_FINITE)
    # Three joints reach a stop: at the start, outside the time window, and inside the time window.  Only the joint
    # inside the time window is reported.
    at_stop[:, 6], at_stop[700, 7], at_stop[300, 8] = True, True, True
    metrics = measured({"status": status, "at_stop": at_stop}, touch(0.2))
    assert (metrics.relaxed_ticks, metrics.failed_ticks) == (3, 2)
    assert metrics.stops == ("elbow_pitch",)


def test_the_jump_of_a_push_is_the_largest_speed() -> None:
    setup = shared_setup("solo8-push")
    v, peak = np.zeros((1000, 14)), np.zeros(1000)
    v[:, 0], v[350, 0], v[700, 0] = 0.1, -0.6, 5.0
    peak[200:600] = 6.5
    metrics = measure(setup, Run(by_hand(setup, 1000, v=v, peak=peak), (touch(0.2, 0.4),), -1, 0.2, False))
    assert metrics.peak_jump == 0.6 and metrics.peak_force == 6.5 and not metrics.rested
    assert metrics.q_total_dwell == 0 and metrics.q_total_impact == pytest.approx(0.1 * 0.399 + 0.6e-3)


def test_metrics_are_json() -> None:
    content = json.loads(json.dumps(measured({}, touch(0.2)).to_dict()))
    assert content["saturation_s"] == {"inside": 0, "outside": 0, "rotors": 0}
    assert content["stops"] == [] and content["contacts"] == 1 and content["q_total_impact"] == 0


# ---- series as files ----------------------------------------------------------------------------------------------


def test_a_saved_series_can_be_loaded(tmp_path: Path) -> None:
    setup = shared_setup("aerial-vertical")
    series = by_hand(setup, 20, v=np.random.default_rng(0).normal(size=(20, 9)))
    series.save(tmp_path / "series.npz")
    again = Series.load(tmp_path / "series.npz")
    for name, column in fields_of(series).items():
        np.testing.assert_array_equal(getattr(again, name), column)
        assert getattr(again, name).dtype == column.dtype


@pytest.mark.parametrize("kind", ["missing", "empty", "text", "array", "other"])
def test_a_file_without_a_series_is_refused(tmp_path: Path, kind: str) -> None:
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
