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

    From the begin of an approach until the way back, each tick obeys
    :class:`~impact_posture.tsid.impact_limits.ImpactLimits`, as if the impact came at the next tick.  It approaches
    only as fast as the limits of the robot allow.  Where they allow the speed of the scenario, this is the nominal
    controller.

    Adapted: limits that the present state cannot obey give way like those of the joints.  The paper has no answer to
    them.  The paper also keeps the zero-moment point and the friction of standing feet through the impact.  Here, the
    feet react without limit.
    """

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
        self.limits.active = False
        return super().reset(q)

    def expect(self, t: float) -> None:
        """Expect an impact at a time, s, and limit what it may do from now on."""
        self.limits.active = True

    def tick(self, reading: Reading, reference: ReferencePoint | None = None) -> Command:
        """Return the command, limited until the end effector goes back."""
        if reference is not None and reference.speed < 0:
            self.limits.active = False
        return super().tick(reading, reference)
