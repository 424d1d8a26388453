"""Recorder of a run."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from impact_posture.arrays import Array
from impact_posture.errors import ImpactPostureError
from impact_posture.impact.contact import point_on
from impact_posture.simulation.actuator_command import Truth
from impact_posture.simulation.scenario import Setup
from impact_posture.simulation.series import STATUSES, Series
from impact_posture.tsid.controller import Command

# Ticks from one evaluation of the metric to the next.  The metric is only drawn.
_EVERY = 10
_NUMBERS = {status: k for k, status in enumerate(STATUSES)}


def feet_of(setup: Setup) -> tuple[str, ...]:
    """Return the frames of the shapes on bodies that must stay on the ground, if the robot stands."""
    scenario, robot = setup.scenario, setup.robot
    if scenario.control.footing is None:
        return ()
    lifted = (*scenario.control.footing.lifted, "" if scenario.contacts is None else scenario.contacts.frame)
    held = {point_on(robot, s.frame).joint for s in robot.spec.supports if s.frame not in lifted}
    return tuple(s.frame for s in scenario.shapes if s.frame not in lifted and point_on(robot, s.frame).joint in held)


class Recorder:
    """Record of a run, one row for each tick.

    Args:
        setup: The experiment.
        metric: ``q → H``, for the time series of H.
    """

    def __init__(self, setup: Setup, metric: Callable[[Array], float]) -> None:
        self._setup, self._metric = setup, metric
        robot, scenario = setup.robot, setup.scenario
        shapes = [s.frame for s in setup.scenario.shapes]
        self._shape = None if scenario.push else shapes.index(scenario.task.frame)
        feet = feet_of(setup)
        self._feet = [k for k, frame in enumerate(shapes) if frame in feet]
        self._joints = {name: k for k, name in enumerate(robot.tangent_names)}
        self._rows: list[tuple[object, ...]] = []
        # Few ticks have a joint at a stop.
        self._stopped: dict[int, tuple[str, ...]] = {}
        self._touches: list[float] = []
        self._touching = False
        self._push = (np.zeros(3), np.inf, -np.inf)
        propulsion = robot.spec.propulsion
        self._rotors = (0.0, 0.0) if propulsion is None else (propulsion.speed_min, propulsion.speed_max)
        self.speed = 0.0
        """``‖ν‖`` at the last tick."""

    def pushed(self, force: Array, begin: float, end: float) -> None:
        """Record a push that acts from ``begin`` to ``end``."""
        self._push = (force, begin, end)

    @property
    def ticks(self) -> int:
        """Number of recorded ticks."""
        return len(self._rows)

    def take(self, truth: Truth, command: Command, level: float, distance: float) -> None:
        """Record a tick."""
        self.speed = math.sqrt(truth.v.dot(truth.v))
        if self._shape is not None:
            hit = truth.shapes[self._shape]
            # Every look reports a contact that lasts again.
            if hit.began is not None and not self._touching:
                self._touches.append(hit.began)
            self._touching = hit.touching
            force, peak, slip = hit.force, hit.peak, hit.slip
        else:
            force, begin, end = self._push
            force = force if begin < truth.t <= end + 1e-9 else np.zeros(3)
            peak = math.sqrt(force.dot(force))
            slip = max((s.slip for s in truth.shapes), default=0.0)
        if truth.at_stops:
            self._stopped[len(self._rows)] = truth.at_stops
        self._rows.append((
            truth.t, truth.q, truth.v, truth.torques, command.rotor_speed, truth.rotor_speeds, force, peak, slip,
            sum(s.touching for s in truth.shapes), [truth.shapes[k].touching for k in self._feet], level,
            _NUMBERS[command.status], distance,
        ))  # fmt: skip

    def first_touch(self, begin: float, end: float) -> float | None:
        """Return when the shape that hits first began to touch within ``[begin, end)``, s."""
        return next((t for t in self._touches if begin <= t < end), None)

    def series(self) -> Series:
        """Return the time series, with what follows from the recorded states and commands."""
        t, q, v, torque, command, speed, force, peak, slip, touching, feet, level, status, distance = (
            np.array(column) for column in zip(*self._rows, strict=True)
        )
        stopped = np.zeros(v.shape, dtype=bool)
        for tick, names in self._stopped.items():
            stopped[tick, [self._joints[name] for name in names if name in self._joints]] = True
        objective = np.full(t.size, np.nan)
        objective[::_EVERY] = [self._value(posture) for posture in q[::_EVERY]]
        return Series(
            t, q, v, torque, np.clip(command, *self._rotors), speed, force, peak, slip, touching, feet, objective,
            level, status, stopped, distance,
        )  # fmt: skip

    def _value(self, q: Array) -> float:
        try:
            return self._metric(q)
        except ImpactPostureError:
            return float("nan")
