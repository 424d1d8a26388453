"""Controller that strikes a surface along a planned path, and then follows the planned stop."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from impact_posture.path.posture_path import PosturePath
from impact_posture.path.row_interpolation import Moment, RowInterpolation
from impact_posture.simulation.controllers.contact_reference import ReferencePoint
from impact_posture.simulation.controllers.driver import MOVE
from impact_posture.simulation.controllers.impact_baselines import ImpactFeedbackDriver
from impact_posture.simulation.setup import Setup
from impact_posture.simulation.world.sensor_noise import Reading
from impact_posture.system.arrays import Array
from impact_posture.tsid.controller import Command
from impact_posture.tsid.tasks.body_tasks import BodyTaskLead
from impact_posture.tsid.tasks.joint_posture import JointPosture


class StrikeDriver(ImpactFeedbackDriver):
    """Nominal controller whose references follow a path that strikes (:mod:`impact_posture.path.strike`).

    After :meth:`brace`, the robot moves to the beginning of the run-up.  The run-up ends at the expected time of the
    impact.  If there is no contact yet, the references continue at the velocity of the impact.  The controller
    detects the contact by the force sensor, or because the contact point has less than half of its planned speed.  At
    the contact, or :attr:`LATE` after the expected time, the references switch to the stop after the impact.  When
    the end effector has to return, the robot moves back to the beginning of the run-up.

    The thrust of rotors lags behind its command, so the accelerations of a robot with rotors are sent earlier than
    the other references, by the mean time constant of the rotors.

    Attributes:
        path: Path with a strike.
    """

    # Longest time for which the references continue into the surface, s, and the share of the planned speed below
    # which the point has touched the surface.
    LATE, STOPPED = 0.05, 0.5

    def __init__(self, setup: Setup, posture: JointPosture, path: PosturePath) -> None:
        super().__init__(setup, posture)
        assert path.strike is not None  # noqa: S101 (the factory has checked it)
        self.path, self._strike, after = path, path.strike, path.strike.follow_through
        self._after = None if after is None else after.rows
        self._body = BodyTaskLead(setup.robot.model)
        rotors = setup.robot.spec.propulsion
        self._lag = 0.0 if rotors is None else (rotors.time_constant_up + rotors.time_constant_down) / 2
        self._begin()

    def _begin(self) -> None:
        # Motion to the beginning of the run-up, the time at which this motion ends, and the time at which it began.
        self._way: RowInterpolation = self.path
        self._until, self._left = self._strike.run_up_s, np.inf
        # Time of the contact, and the displacement of the robot from its planned posture at this time.
        self._hit, self._shift = np.inf, np.zeros(self.setup.robot.nv)
        self._now, self._moment = 0.0, self.path.at(0.0)

    def reset(self, q: Array) -> Command:
        self._begin()
        rest = np.zeros(self.setup.robot.nv)
        self.posture.lead(q, rest, rest)
        return super().reset(q)

    def brace(self) -> None:
        self._left = self._now

    def tick(self, reading: Reading, reference: ReferencePoint | None = None) -> Command:
        if self._strikes(reading.t) and self._hit == np.inf:
            model, planned = self.setup.robot.model, self._approach(*self._moment_at(reading.t)[:2])
            stopped = (
                self._approach(reading.q, reading.v) < self.STOPPED * planned > self.STOPPED**2 * self._strike.speed
            )
            if self._feel(reading) or stopped or reading.t > self._at + self.LATE:
                self._hit = reading.t
                here = self._moment_at(reading.t)[0] if reading.t <= self._at + self.LATE else reading.q
                self._shift = np.array(pin.difference(model, self.path.q[-1], here))
        return super().tick(reading, reference)

    def lead(self, t: float, reference: ReferencePoint | None = None) -> None:
        self._now = t
        if t < self._left:
            return
        if reference is not None and reference.speed < 0 and self._hit < np.inf:
            self._retreat()
        q, v, _ = self._moment = self._moment_at(t)
        a = self._moment_at(t + self._lag)[2]
        self.posture.lead(q, v, a)
        self._body.lead(self._body_tasks, q, v, a)
        task = self._end_effector
        if task is not None:
            state = self._state.update(q, v)
            J = task.jacobian(state)
            # If the end effector task regulates only the position, its target is an array.
            task.target = task.present(state)
            task.target_velocity, task.target_acceleration = J @ v, J @ a + task.drift(state)

    def _retreat(self) -> None:
        """Begin a motion from the last stop to the beginning of the run-up, within :data:`MOVE`."""
        zero = np.zeros((2, self.setup.robot.nv))
        ends = np.array([self._moment[0], self.path.at(self._strike.run_up_s)[0]])
        self._way = RowInterpolation(self.setup.robot.model, np.array([0.0, MOVE]), ends, zero, zero)
        self._until, self._left, self._hit, self._at = MOVE, self._now, np.inf, np.inf

    def _approach(self, q: Array, v: Array) -> float:
        """Return the speed of the contact point towards the surface, m/s."""
        J = self._state.update(q, v).at(self._point).jacobian[:3]
        return float(-self.setup.scenario.normal @ J @ v)

    @property
    def _duration(self) -> float:
        return self._strike.contact_s - self._strike.run_up_s

    def _strikes(self, t: float) -> bool:
        return t >= self._at - self._duration and t >= self._left

    def _moment_at(self, t: float) -> Moment:
        """Return posture, velocity and acceleration of the references at time ``t``, s."""
        model, zero = self.setup.robot.model, np.zeros(len(self._shift))
        if not self._strikes(t):
            return self._way.at(min(t - self._left, self._until))
        if self._hit == np.inf:
            late = t - self._at
            if late <= 0:
                return self.path.at(self._strike.contact_s + late)
            q, v, _ = self.path.at(self._strike.contact_s)
            return np.array(pin.integrate(model, q, late * v)), v, zero
        if self._after is None:
            return np.array(pin.integrate(model, self.path.q[-1], self._shift)), zero, zero
        since = t - self._hit
        q, v, a = self._after.at(since)
        if since >= self._after.t[-1]:
            v = a = zero
        return np.array(pin.integrate(model, q, self._shift)), v, a

    @property
    def level(self) -> float:
        """Elapsed share of the path to the contact, 0 to 1."""
        if self._now < self._left:
            return 0.0
        along = min(self._now - self._left, self._until) if not self._strikes(self._now) else self._strike.contact_s
        return min(1.0, along / self._strike.contact_s)
