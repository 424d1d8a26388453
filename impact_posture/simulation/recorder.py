"""Takes down what happens in a run."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from impact_posture.errors import ImpactPostureError
from impact_posture.robot.robot import Robot
from impact_posture.simulation.actuator_command import Truth
from impact_posture.simulation.scenario import RepeatedContacts, Setup
from impact_posture.simulation.scenario_objective import Gradient
from impact_posture.simulation.series import Series
from impact_posture.tsid.controller import Command, Status

Array = NDArray[np.float64]

STATUSES: tuple[Status, ...] = tuple(Status)
# The metric is drawn, not controlled with: ticks from one evaluation to the next.
_EVERY = 10


def feet_of(setup: Setup) -> tuple[str, ...]:
    """Frames of the shapes on bodies that are to stay on the ground; none where the robot does not stand."""
    scenario, robot = setup.scenario, setup.robot
    if scenario.control.footing is None:
        return ()
    held = {_joint(robot, support.frame) for support in robot.spec.supports}
    led = scenario.task.frame if isinstance(scenario.task, RepeatedContacts) else None
    return tuple(s.frame for s in scenario.shapes if s.frame != led and _joint(robot, s.frame) in held)


def _joint(robot: Robot, frame: str) -> int:
    return int(robot.model.frames[robot.frame_id(frame)].parentJoint)


class Recorder:
    """One row a tick.

    Args:
        setup: The experiment.
        metric: ``q → (H, ∇H)``, for the course of H.
    """

    def __init__(self, setup: Setup, metric: Gradient) -> None:
        self._setup, self._metric = setup, metric
        robot, task = setup.robot, setup.scenario.task
        shapes = [s.frame for s in setup.scenario.shapes]
        self._shape = shapes.index(task.frame) if isinstance(task, RepeatedContacts) else None
        feet = feet_of(setup)
        self._feet = [k for k, frame in enumerate(shapes) if frame in feet]
        self._joints = {robot.tangent_names[k]: k for k in range(robot.nv)}
        self._rows: list[tuple[object, ...]] = []
        self._touches: list[float] = []
        self._touching = False
        self._push = (np.zeros(3), np.inf, -np.inf)
        propulsion = robot.spec.propulsion
        self._rotors = (0.0, 0.0) if propulsion is None else (propulsion.speed_min, propulsion.speed_max)
        self.speed = 0.0
        """``‖ν‖`` at the last tick."""

    def pushed(self, force: Array, begin: float, end: float) -> None:
        """A push acts from ``begin`` to ``end``."""
        self._push = (force, begin, end)

    @property
    def ticks(self) -> int:
        """How many were taken down."""
        return len(self._rows)

    def take(self, truth: Truth, command: Command, level: float, distance: float) -> None:
        """Take down a tick."""
        self.speed = float(np.linalg.norm(truth.v))
        hit = None if self._shape is None else truth.shapes[self._shape]
        if hit is not None:
            # One that lasts is told of anew at every look.
            if hit.began is not None and not self._touching:
                self._touches.append(hit.began)
            self._touching = hit.touching
        force, begin, end = self._push
        if hit is not None:
            force, peak, slip = hit.force, hit.peak, hit.slip
        else:
            force = force if begin < truth.t <= end + 1e-9 else np.zeros(3)
            peak = float(np.linalg.norm(force))
            slip = max((s.slip for s in truth.shapes), default=0.0)
        self._rows.append((
            truth.t, truth.q, truth.v, truth.torques, np.clip(command.rotor_speed, *self._rotors), truth.rotor_speeds,
            force, peak, slip, sum(s.touching for s in truth.shapes),
            [truth.shapes[k].touching for k in self._feet], self._value(truth.q), level,
            STATUSES.index(command.status), self._stopped(truth), distance,
        ))  # fmt: skip

    def first_touch(self, begin: float, end: float) -> float | None:
        """When a touch of the shape that hits first began within ``[begin, end)``, s."""
        return next((t for t in self._touches if begin <= t < end), None)

    def series(self) -> Series:
        """All of it."""
        return Series(*(np.array(column) for column in zip(*self._rows, strict=True)))

    def _value(self, q: Array) -> float:
        if len(self._rows) % _EVERY:
            return float("nan")
        try:
            return self._metric(q)[0]
        except ImpactPostureError:
            return float("nan")

    def _stopped(self, truth: Truth) -> Array:
        stopped = np.zeros(self._setup.robot.nv, dtype=bool)
        for name in truth.at_stops:
            if name in self._joints:
                stopped[self._joints[name]] = True
        return stopped
