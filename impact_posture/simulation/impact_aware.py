"""Limits of what the impact would do, as inequalities of the controller."""

from __future__ import annotations

from dataclasses import replace

from impact_posture.arrays import Array
from impact_posture.simulation.driver import Driver
from impact_posture.simulation.reference import ReferencePoint
from impact_posture.simulation.scenario import Setup
from impact_posture.simulation.sensor_noise import Reading
from impact_posture.tsid.controller import Command, Controller
from impact_posture.tsid.impact_limits import ImpactLimits
from impact_posture.tsid.points import Point
from impact_posture.tsid.posture_tasks import JointPosture


class ImpactAwareDriver(Driver):
    """Nominal controller with limits of post-impact rates and impulsive torques (Wang et al. 2020).

    From the begin of an approach until ``AFTER`` (s) behind the expected impact, each tick obeys
    :class:`~impact_posture.tsid.impact_limits.ImpactLimits`, as if the impact came at the next tick.  It approaches
    only as fast as the limits of the robot allow.  Where they allow the speed of the scenario, this is the nominal
    controller.

    Adapted: limits that the present state cannot obey give way like those of the joints.  The paper has no answer to
    them.  The paper also keeps the zero-moment point and the friction of standing feet through the impact.  Here, the
    feet react without limit.
    """

    AFTER = 0.1

    def __init__(self, setup: Setup, posture: JointPosture) -> None:
        """Add the limits to the tasks of the scenario."""
        super().__init__(setup, posture)
        formulation, period = self.controller.formulation, setup.scenario.control.period
        point = Point(setup.scenario.task.frame, setup.scenario.offset)
        contacts = formulation.contacts
        self.limits = ImpactLimits(setup.robot, point, setup.scenario.normal, contacts, period=period)
        self.controller = Controller(setup.robot, replace(formulation, row_limits=(self.limits,)), period=period)

    def reset(self, q: Array) -> Command:
        """Begin at rest, without an expected impact."""
        self._until, self.limits.active = -1.0, False
        return super().reset(q)

    def expect(self, t: float) -> None:
        """Expect an impact at a time, s."""
        self._until = t + self.AFTER

    def tick(self, reading: Reading, reference: ReferencePoint | None = None) -> Command:
        """Return the command, limited while an impact may come."""
        self.limits.active = reading.t < self._until
        return super().tick(reading, reference)
