"""The recorder, tested with a synthetic world."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from impact_posture.errors import MetricError
from impact_posture.simulation.recorder import STATUSES, Recorder
from impact_posture.simulation.setup import Setup
from impact_posture.simulation.world.actuator_command import Trace
from impact_posture.tsid.controller import Command, Status
from tests.simulation.factories import shared_factory


def metric(q: Any) -> float:
    return 7.0


class SyntheticWorld:
    """Synthetic world that returns given rows as its traces."""

    def __init__(self, setup: Setup) -> None:
        self.stops, self._setup, self.marks, self.next = setup.world.stops, setup, 0, 0
        self.rows: list[tuple[Any, ...]] = []

    def add(
        self, t: float, *, began: float | None = None, touching: bool = False, stop: str = "", slip: float = 0.1
    ) -> None:
        """Add a state in which all shapes have equal contacts, except that the slip increases from shape to shape."""
        robot, shapes = self._setup.robot, len(self._setup.scenario.shapes)
        rotors = 0 if robot.spec.propulsion is None else len(robot.spec.propulsion.rotors)
        ones = np.ones(shapes)
        self.rows.append((
            t, self._setup.q, np.full(robot.nv, 0.1), np.full(rotors, 50.0), np.ones(robot.nv - 6),
            np.array([name == stop for name in self.stops.names]), touching * ones > 0,
            np.tile([0, 0, 5.0 * touching], (shapes, 1)), np.zeros((shapes, 3)), 9.0 * touching * ones,
            ones * (np.nan if began is None else began), slip * touching * (np.arange(shapes) + (shapes == 1)),
        ))  # fmt: skip

    def mark(self) -> None:
        self.marks += 1

    def trace(self) -> Trace:
        first, self.next = self.next, self.marks
        return Trace(*(np.array(column) for column in zip(*self.rows[first : self.marks], strict=True)))


def recording(name: str, metric: Callable[[Any], float]) -> tuple[Recorder, SyntheticWorld]:
    setup = shared_factory(name).setup
    recorder, world = Recorder(setup, metric), SyntheticWorld(setup)
    recorder._world = world  # type: ignore[assignment]
    return recorder, world


def command(speed: float = 50.0, status: Status = Status.SOLVED) -> Command:
    return Command(np.zeros(9), np.ones(3), np.full(6, speed), status, np.zeros(9), np.zeros(0))


def test_a_lasting_touch_is_reported_once() -> None:
    recorder, world = recording("aerial-vertical", metric)
    # The shape touches in the third tick, stays in contact for four ticks, and rebounds.
    course = [(None, False), (None, False), (0.0025, True), (0.003, True), (0.004, True), (0.005, False),
              (None, False), (0.0072, True), (0.008, True)]  # fmt: skip
    for k, (began, touching) in enumerate(course):
        world.add(1e-3 * (k + 1), began=began, touching=touching)
        recorder.take(command(), 0.0, 0.0)
        if k == 4:
            # The time of the first touch does not depend on how ticks are divided into recorded blocks.
            assert recorder.first_touches(0.0, 1.0) == [0.0025]
    assert recorder.first_touches(0.0, 1.0) == [0.0025]
    # A touch that began before the interval is ignored.
    assert recorder.first_touches(0.003, 0.007) == []
    assert recorder.first_touches(0.003, 1.0) == [0.0072]
    assert recorder.first_touches(0.0, 0.002) == [] and recorder.first_touches(0.0025, 0.0026) == [0.0025]
    series = recorder.series()
    np.testing.assert_array_equal(series.touching, [0, 0, 1, 1, 1, 0, 0, 1, 1])
    np.testing.assert_array_equal(series.peak, 9.0 * series.touching)
    np.testing.assert_array_equal(series.force[:, 2], 5.0 * series.touching)


def test_columns_have_the_values_of_their_ticks() -> None:
    setup = shared_factory("aerial-vertical").setup
    propulsion = setup.robot.spec.propulsion
    assert propulsion is not None
    recorder, world = recording("aerial-vertical", metric)
    for k, status in enumerate(STATUSES):
        world.add(1e-3 * k, stop="elbow_pitch" * (k % 2))
        recorder.take(command(500.0 * k, status), k / 9, k / 10)
    series = recorder.series()
    np.testing.assert_array_equal(series.status, np.arange(len(STATUSES)))
    np.testing.assert_array_equal(series.at_stop[:, -1], np.arange(len(STATUSES)) % 2 == 1)
    assert not series.at_stop[:, :-1].any()
    # Recorded commands are clipped to the actuator limits.
    assert series.rotor_command[0, 0] == propulsion.speed_min and series.rotor_command[1, 0] == propulsion.speed_max
    np.testing.assert_allclose(series.level, np.arange(len(STATUSES)) / 9)


def test_the_metric_is_evaluated_every_tenth_tick_and_may_be_undefined() -> None:
    calls = []

    def sometimes(q: Any) -> float:
        calls.append(1)
        if len(calls) == 2:
            raise MetricError("is undefined at this posture", where="S", hint="move")
        return 2.0

    recorder, world = recording("aerial-vertical", sometimes)
    for k in range(25):
        world.add(1e-3 * k)
        recorder.take(command(), 0.0, 0.0)
    values = recorder.series().objective
    assert len(calls) == 3
    assert values[0] == values[20] == 2.0 and np.isnan(np.delete(values, [0, 20])).all()


def test_a_push_acts_from_its_begin_to_its_end() -> None:
    recorder, world = recording("solo8-push", lambda q: 1.0)
    recorder.pushed(np.array([6.5, 0, 0]), 0.1 + 0.2, 0.1 + 0.2 + 0.003)
    ticks = [0.299, 0.3, 0.301, 0.302, 0.303, 0.304]
    for t in ticks:
        world.add(t, touching=True, slip=0.01)
        recorder.take(Command(np.zeros(8), np.zeros(8), np.zeros(0), Status.SOLVED, np.zeros(14), np.zeros(0)),
                      0.0, 0.0)  # fmt: skip
    series = recorder.series()
    np.testing.assert_array_equal(series.force[:, 0], [0, 0, 6.5, 6.5, 6.5, 0])
    np.testing.assert_array_equal(series.peak, series.force[:, 0])
    np.testing.assert_allclose(series.slip, 0.03)
    assert (series.touching == 4).all()
