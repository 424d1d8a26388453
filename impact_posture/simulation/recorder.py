"""Recorder of a run."""

from __future__ import annotations

import numpy as np

from impact_posture.arrays import Array
from impact_posture.errors import ImpactPostureError
from impact_posture.impact.contact import point_on
from impact_posture.simulation.actuator_command import Truth
from impact_posture.simulation.scenario import Setup
from impact_posture.simulation.scenario_objective import Gradient
from impact_posture.simulation.series import STATUSES, Series
from impact_posture.tsid.controller import Command

# Ticks from one evaluation of the metric to the next.  The metric is only drawn.
_EVERY = 10


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
        metric: ``q → (H, ∇H)``, for the time series of H.
    """

    def __init__(self, setup: Setup, metric: Gradient) -> None:
        self._setup, self._metric = setup, metric
        robot, scenario = setup.robot, setup.scenario
        shapes = [s.frame for s in setup.scenario.shapes]
        self._shape = None if scenario.push else shapes.index(scenario.task.frame)
        feet = feet_of(setup)
        self._feet = [k for k, frame in enumerate(shapes) if frame in feet]
        self._joints = {name: k for k, name in enumerate(robot.tangent_names)}
        self._rows: list[tuple[object, ...]] = []
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
        self.speed = float(np.linalg.norm(truth.v))
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
            peak = float(np.linalg.norm(force))
            slip = max((s.slip for s in truth.shapes), default=0.0)
        stopped = np.zeros(self._setup.robot.nv, dtype=bool)
        stopped[[self._joints[name] for name in truth.at_stops if name in self._joints]] = True
        self._rows.append((
            truth.t, truth.q, truth.v, truth.torques, np.clip(command.rotor_speed, *self._rotors), truth.rotor_speeds,
            force, peak, slip, sum(s.touching for s in truth.shapes),
            [truth.shapes[k].touching for k in self._feet], self._value(truth.q), level,
            STATUSES.index(command.status), stopped, distance,
        ))  # fmt: skip

    def first_touch(self, begin: float, end: float) -> float | None:
        """Return when the shape that hits first began to touch within ``[begin, end)``, s."""
        return next((t for t in self._touches if begin <= t < end), None)

    def series(self) -> Series:
        """Return the time series."""
        return Series(*(np.array(column) for column in zip(*self._rows, strict=True)))

    def _value(self, q: Array) -> float:
        if len(self._rows) % _EVERY:
            return float("nan")
        try:
            return self._metric(q)[0]
        except ImpactPostureError:
            return float("nan")
