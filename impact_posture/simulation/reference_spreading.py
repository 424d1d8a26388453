"""Reference spreading with an interim mode, for the contacts of an end effector."""

from __future__ import annotations

import math

import numpy as np

from impact_posture.arrays import Array
from impact_posture.simulation.invariant import ImpactFeedbackDriver
from impact_posture.simulation.reference import ReferencePoint
from impact_posture.simulation.scenario import Setup
from impact_posture.simulation.sensor_noise import Reading
from impact_posture.tsid.controller import Command
from impact_posture.tsid.impact_limits import ImpactLimits
from impact_posture.tsid.posture_tasks import JointPosture


class ReferenceSpreadingDriver(ImpactFeedbackDriver):
    """Time-invariant reference spreading with an interim mode (van Steen et al. 2024).

    The end effector has three references along its way ``s`` into the surface:

    - Before the impact, the speed ``√(2 a s)``, at most that of the scenario, is a function of the place.  It goes on
      behind the surface, so an impact that comes late meets no other reference.  There is no error of position along
      the way.
    - In the interim mode, from the first touch until the contact has lasted for ``SUSTAINED`` (s), at most
      ``INTERIM`` (s), no task has velocity feedback.  The position follows the integral of the speed before the
      impact, which completes the contact.
    - After the impact, the position fades from there to where the scenario rests, with the time constant ``SETTLE``
      (s).  The velocity targets of all tasks begin at ``J_y ν⁺`` and fade likewise.  ``ν⁺ = ν⁻ + Δν`` follows from a
      rigid, inelastic impact at the velocity before the touch.

    Adapted: there is one contact, not several at nominally the same time.  A contact that rebounds counts as partial.
    ``ν⁻`` is measured, because the tasks leave a redundancy without a reference.  On its way back, the end effector
    follows the scenario in time.  Without contacts there is nothing to spread, and this is the nominal controller.
    Longer modes let the robot move more, because this controller avoids feedback and not motion.
    """

    SUSTAINED, INTERIM, SETTLE = 0.005, 0.05, 0.03
    # Place from which the speed before the impact counts, m, because at zero the robot would never leave.
    BEGIN = 2e-3
    # Place of the touch, which the interim mode moves, how long the contact has lasted, and the end of the mode.
    _place: float
    _lasted: float
    _done: float | None

    def __init__(self, setup: Setup, posture: JointPosture) -> None:
        """Build the nominal controller."""
        super().__init__(setup, posture)
        task = setup.scenario.contacts
        self._speed, self._acceleration = (0.0, 0.0) if task is None else (task.speed, task.acceleration)
        self._impact = ImpactLimits(
            setup.robot, self._point, setup.scenario.normal, self.controller.formulation.contacts
        )
        self._clear()

    def reset(self, q: Array) -> Command:
        """Begin at rest, without an expected impact."""
        self._clear()
        command = super().reset(q)
        self._origin = self._state.update(q, np.zeros(self.setup.robot.nv)).at(self._point).position.copy()
        return command

    def expect(self, t: float) -> None:
        """Expect an impact at a time, s, before which the next approach begins."""
        super().expect(t)
        self._clear()

    def tick(self, reading: Reading, reference: ReferencePoint | None = None) -> Command:
        """Return the command with the reference of the present mode."""
        acts = self._feel(reading) if reading.force is not None else reading.t >= self._at
        state = self._state.update(reading.q, reading.v)
        if reference is None or reference.speed < 0 or not math.isfinite(self._at):
            self._lead(reference)
            return self._command(reading, None)
        way = float(-self.setup.scenario.normal @ (state.at(self._point).position - self._origin))
        if reading.t < self._at or not (acts or self._place):
            speed = min(math.sqrt(2 * self._acceleration * max(way, self.BEGIN)), self._speed)
            self._before = reading.v.copy()
            self._lead(ReferencePoint(way, speed, self._acceleration if speed < self._speed else 0.0))
            return self._command(reading, None)
        if not self._place:
            # The first tick of the touch.
            self._place = way
            self._after = self._before + self._impact.jump(state)[0] @ self._before
        self._lasted = self._lasted + self.controller.period if acts else 0.0
        since = reading.t - self._at
        if self._done is None and (self._lasted >= self.SUSTAINED or since > self.INTERIM):
            self._done = reading.t
        if self._done is None:
            self._place += self.controller.period * self._speed
            self._lead(ReferencePoint(self._place, self._speed, 0.0))
            for task in self.controller.formulation.tasks:
                task.target_velocity = task.jacobian(state) @ reading.v
            return self._command(reading, None)
        fade = math.exp(-(reading.t - self._done) / self.SETTLE)
        self._lead(ReferencePoint(reference.distance + fade * (self._place - reference.distance), 0.0, 0.0))
        return self._command(reading, -fade * self._after)

    def _clear(self) -> None:
        """Forget the last impact."""
        self._place, self._lasted, self._done = 0.0, 0.0, None
        self._before = self._after = np.zeros(self.setup.robot.nv)
