"""What a recorder takes down, tick by tick, of truths made by hand."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from impact_posture.errors import MetricError
from impact_posture.simulation.actuator_command import Truth
from impact_posture.simulation.contact_forces import ShapeTruth
from impact_posture.simulation.recorder import STATUSES, Recorder
from impact_posture.tsid.controller import Command, Status
from tests.simulation.factories import factory, needs_mujoco

NOTHING = np.zeros(3)


@pytest.fixture(scope="module", autouse=True)
def _mujoco() -> None:
    needs_mujoco()


def metric(q: Any) -> float:
    return 7.0


def truth(t: float, *, began: float | None = None, touching: bool = False, stops: tuple[str, ...] = ()) -> Truth:
    q = factory("aerial-vertical").setup.q
    shape = ShapeTruth(
        "ee", touching, np.array([0, 0, 5.0 * touching]), NOTHING, 9.0 * touching, began, 0.1 * touching
    )
    return Truth(t, q, np.full(9, 0.1), np.full(6, 50.0), np.zeros(6), np.ones(3), (shape,), stops)


def command(speed: float = 50.0, status: Status = Status.SOLVED) -> Command:
    return Command(np.zeros(9), np.ones(3), np.full(6, speed), status, np.zeros(9), np.zeros(0))


def test_a_touch_is_told_once_however_long_it_lasts() -> None:
    recorder = Recorder(factory("aerial-vertical").setup, metric)
    # Touches in the third tick, stays for four, and bounces: the world tells of the last push at every look.
    course = [(None, False), (None, False), (0.0025, True), (0.003, True), (0.004, True), (0.005, False),
              (None, False), (0.0072, True), (0.008, True)]  # fmt: skip
    for k, (began, touching) in enumerate(course):
        recorder.take(truth(1e-3 * (k + 1), began=began, touching=touching), command(), 0.0, 0.0)
    assert recorder.first_touch(0.0, 1.0) == 0.0025
    # One that has lasted since before is none.
    assert recorder.first_touch(0.003, 0.007) is None
    assert recorder.first_touch(0.003, 1.0) == 0.0072
    assert recorder.first_touch(0.0, 0.002) is None and recorder.first_touch(0.0025, 0.0026) == 0.0025
    series = recorder.series()
    np.testing.assert_array_equal(series.touching, [0, 0, 1, 1, 1, 0, 0, 1, 1])
    np.testing.assert_array_equal(series.peak, 9.0 * series.touching)
    np.testing.assert_array_equal(series.force[:, 2], 5.0 * series.touching)


def test_columns_are_what_was_true_then() -> None:
    setup = factory("aerial-vertical").setup
    propulsion = setup.robot.spec.propulsion
    assert propulsion is not None
    recorder = Recorder(setup, metric)
    for k, status in enumerate(STATUSES):
        recorder.take(truth(1e-3 * k, stops=("elbow_pitch",) * (k % 2)), command(500.0 * k, status), k / 9, k / 10)
    series = recorder.series()
    np.testing.assert_array_equal(series.status, np.arange(len(STATUSES)))
    np.testing.assert_array_equal(series.at_stop[:, -1], np.arange(len(STATUSES)) % 2 == 1)
    assert not series.at_stop[:, :-1].any()
    # Commands are recorded as the motors take them.
    assert series.rotor_command[0, 0] == propulsion.speed_min and series.rotor_command[1, 0] == propulsion.speed_max
    np.testing.assert_allclose(series.level, np.arange(len(STATUSES)) / 9)
    assert recorder.speed == pytest.approx(0.3)


def test_the_metric_is_taken_every_tenth_tick_and_may_be_undefined() -> None:
    calls = []

    def sometimes(q: Any) -> float:
        calls.append(1)
        if len(calls) == 2:
            raise MetricError("does not exist there", where="S", hint="move")
        return 2.0

    recorder = Recorder(factory("aerial-vertical").setup, sometimes)
    for k in range(25):
        recorder.take(truth(1e-3 * k), command(), 0.0, 0.0)
    found = recorder.series().objective
    assert len(calls) == 3
    assert found[0] == found[20] == 2.0 and np.isnan(np.delete(found, [0, 20])).all()


def test_a_push_acts_from_its_begin_to_its_end() -> None:
    setup = factory("solo8-push").setup
    recorder = Recorder(setup, lambda q: 1.0)
    recorder.pushed(np.array([6.5, 0, 0]), 0.1 + 0.2, 0.1 + 0.2 + 0.003)
    ticks = [0.299, 0.3, 0.301, 0.302, 0.303, 0.304]
    for t in ticks:
        shapes = tuple(ShapeTruth(s.frame, True, NOTHING, NOTHING, 0.0, None, 0.01 * k) for k, s in
                       enumerate(setup.scenario.shapes))  # fmt: skip
        recorder.take(Truth(t, setup.q, np.zeros(14), np.zeros(0), np.zeros(0), np.zeros(8), shapes, ()),
                      Command(np.zeros(8), np.zeros(8), np.zeros(0), Status.SOLVED, np.zeros(14), np.zeros(0)),
                      0.0, 0.0)  # fmt: skip
    series = recorder.series()
    np.testing.assert_array_equal(series.force[:, 0], [0, 0, 6.5, 6.5, 6.5, 0])
    np.testing.assert_array_equal(series.peak, series.force[:, 0])
    np.testing.assert_allclose(series.slip, 0.03)
    assert (series.touching == 4).all()
