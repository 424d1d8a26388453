"""Record the states and commands of a run."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from impact_posture.errors import ImpactPostureError
from impact_posture.impact.impact_contact import point_on
from impact_posture.simulation.series import STATUSES, Series
from impact_posture.simulation.setup import Setup
from impact_posture.simulation.world.actuator_command import Trace
from impact_posture.system.arrays import Array
from impact_posture.tsid.controller import Command

# The metric is evaluated only at every tenth tick, because only figures need it.
_EVERY = 10
# Number of ticks after which the true states are read from the world, so that the log of contacts stays short.
_BLOCK = 1000
_NUMBERS = {status: k for k, status in enumerate(STATUSES)}


def feet_of(setup: Setup) -> tuple[str, ...]:
    """Return the frames of the standing feet; empty if the robot does not stand."""
    scenario, robot = setup.scenario, setup.robot
    if scenario.control.footing is None:
        return ()
    struck = () if scenario.contacts is None else scenario.contacts.frames
    lifted = (*scenario.control.footing.lifted, *struck)
    held = {point_on(robot, s.frame).joint for s in robot.spec.supports if s.frame not in lifted}
    return tuple(s.frame for s in scenario.shapes if s.frame not in lifted and point_on(robot, s.frame).joint in held)


class Recorder:
    """Record each tick of a run.  ``metric`` is the function q → H."""

    def __init__(self, setup: Setup, metric: Callable[[Array], float]) -> None:
        self._setup, self._metric, self._world = setup, metric, setup.world
        robot, scenario = setup.robot, setup.scenario
        shapes = [s.frame for s in setup.scenario.shapes]
        struck = scenario.contacts.frames if scenario.contacts else () if scenario.push else (scenario.task.frame,)
        self._shapes = [shapes.index(frame) for frame in struck]
        feet = feet_of(setup)
        self._feet = [k for k, frame in enumerate(shapes) if frame in feet]
        self._rows: list[tuple[Array, float, int, float]] = []
        # For each block of recorded ticks, ``_columns`` contains rotor commands, levels, status numbers and
        # distances, and ``_traces`` contains the true states.
        self._columns: list[tuple[Array, ...]] = []
        self._traces: list[Trace] = []
        self._push = (np.zeros(3), np.inf, -np.inf)
        propulsion = robot.spec.propulsion
        self._rotors = (0.0, 0.0) if propulsion is None else (propulsion.speed_min, propulsion.speed_max)

    def pushed(self, force: Array, begin: float, end: float) -> None:
        """Record a push with a force (world, N) that acts from ``begin`` to ``end``, s."""
        self._push = (force, begin, end)

    @property
    def ticks(self) -> int:
        """Number of recorded ticks."""
        return len(self._rows) + sum(trace.t.size for trace in self._traces)

    def take(self, command: Command, level: float, distance: float) -> None:
        """Record a tick and the state of the world after it."""
        self._rows.append((command.rotor_speed, float(level), _NUMBERS[command.status], distance))
        self._world.mark()
        if len(self._rows) == _BLOCK:
            self._trace()

    def take_all(self, trace: Trace, *columns: Array) -> None:
        """Record several ticks.

        ``trace`` contains the states after the ticks.  ``columns`` are rotor commands, levels, status numbers and
        distances.
        """
        self._traces.append(trace)
        self._columns.append(columns)

    def first_touches(self, begin: float, end: float) -> list[float]:
        """Return the sorted times of the first touch of each contact that touches within ``[begin, end)``, s."""
        trace, first = self._trace(), list[float]()
        for k in self._shapes:
            # During a contact, ``began`` has a new time in every tick, so only the first tick of the contact is used.
            before = np.concatenate([[False], trace.touching[:-1, k]])
            touches = trace.began[~before, k]
            first += touches[(begin <= touches) & (touches < end)][:1].tolist()
        return sorted(first)

    def series(self) -> Series:
        """Return the time series of all recorded ticks."""
        trace = self._trace()
        command, level, status, distance = (np.concatenate(parts) for parts in zip(*self._columns, strict=True))
        t, q, (pushed, begin, end) = trace.t, trace.q, self._push
        if self._shapes:
            force, impulse = (x[:, self._shapes].sum(axis=1) for x in (trace.force, trace.impulse))
            peak, slip = (x[:, self._shapes].max(axis=1) for x in (trace.peak, trace.slip))
        else:
            force = pushed * ((begin < t) & (t <= end + 1e-9))[:, None]
            peak, slip = np.linalg.norm(force, axis=1), trace.slip.max(axis=1, initial=0.0)
            impulse = pushed * np.clip(t - begin, 0.0, max(end - begin, 0.0))[:, None]
        stopped, names = np.zeros(trace.v.shape, dtype=bool), self._setup.robot.tangent_names
        for name, column in zip(self._world.stops.names, trace.stopped.T, strict=True):
            if name in names:
                stopped[:, names.index(name)] = column
        objective = np.full(t.size, np.nan)
        objective[::_EVERY] = [self._value(posture) for posture in q[::_EVERY]]
        return Series(
            t, q, trace.v, trace.torques, np.clip(command, *self._rotors), trace.rotor_speeds, force, peak, impulse,
            slip, trace.touching.sum(axis=1), trace.touching[:, self._feet], objective, level, status, stopped,
            distance,
        )  # fmt: skip

    def _trace(self) -> Trace:
        if self._rows:
            self.take_all(self._world.trace(), *map(np.array, zip(*self._rows, strict=True)))
            self._rows = []
        self._traces = [Trace(*map(np.concatenate, zip(*self._traces, strict=True)))]
        return self._traces[0]

    def _value(self, q: Array) -> float:
        try:
            return self._metric(q)
        except ImpactPostureError:
            return float("nan")
