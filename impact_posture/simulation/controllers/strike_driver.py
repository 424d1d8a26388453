"""Controllers that strike a surface along a planned path or fall onto it, and then follow the planned stop."""

from __future__ import annotations

import numpy as np

from impact_posture.path.path_reference import PathPhase, PathReference
from impact_posture.path.posture_path import PosturePath
from impact_posture.simulation.controllers.contact_reference import ReferencePoint
from impact_posture.simulation.controllers.driver import MOVE, Driver
from impact_posture.simulation.setup import Setup
from impact_posture.simulation.world.sensor_noise import Reading
from impact_posture.system.arrays import Array
from impact_posture.tsid.controller import Command, Controller
from impact_posture.tsid.point_kinematics import Point
from impact_posture.tsid.state import State
from impact_posture.tsid.task_formulation import TaskFormulation
from impact_posture.tsid.tasks.joint_posture import JointPosture


class StrikeDriver(Driver):
    """Nominal controller whose references follow a path that strikes (:mod:`impact_posture.path.strike`).

    After :meth:`brace`, the robot moves to the beginning of the run-up, or waits at the start if the path is in one
    piece.  The run-up ends at the expected time of the impact.  At the contact, which
    :class:`~impact_posture.path.path_reference.PathReference` notices, the references switch to the stop after the
    impact.  When the end effector has to return, the robot moves back to a posture of the path before the contact.

    The thrust of rotors lags behind the command.  For a robot with rotors, the acceleration references are therefore
    ahead of the other references by the mean time constant of the rotors.

    Attributes:
        path: Path with a strike.
    """

    leads_posture = True

    def __init__(self, setup: Setup, posture: JointPosture, path: PosturePath) -> None:
        super().__init__(setup, posture)
        contacts, scenario = setup.scenario.contacts, setup.scenario
        frames = () if contacts is None else contacts.frames
        points = [Point(shape.frame, shape.offset) for shape in scenario.shapes if shape.frame in frames]
        self._state = State(setup.robot, dict.fromkeys((*self.controller.formulation.points, *points)))
        here = self._state.update(path.q[-1], None)
        approach = np.array([-scenario.normal @ here.at(point).jacobian[:3] for point in points])
        rotors = setup.robot.spec.propulsion
        self.path, self._now = path, 0.0
        self._reference = PathReference(path, approach, rotors.lag if rotors else 0.0)

    def reset(self, q: Array) -> Command:
        self._reference.reset()
        self._now = 0.0
        return super().reset(q)

    def brace(self) -> None:
        self._reference.start(self._now, np.inf)

    def expect(self, t: float) -> None:
        self._reference.expect(t)

    @property
    def ahead(self) -> float:
        rest = self.path.strike.rest_s if self.path.strike else 0.0
        return self.path.duration - rest + self.setup.scenario.control.period

    def tick(self, reading: Reading, reference: ReferencePoint | None = None) -> Command:
        if reference is not None and reference.speed < 0:
            self._reference.back(MOVE)
        force = None if reading.force is None else float(np.linalg.norm(reading.force))
        self._reference.tick(reading.t, reading.q, reading.v, force)
        return super().tick(reading, reference)

    def lead(self, t: float, reference: ReferencePoint | None = None) -> None:
        self._now = t
        if self._reference.phase == PathPhase.IDLE:
            return
        q, v, a = self._reference.moment
        if self.compiled is not None:
            self.compiled.library.lead(q, v, a)
        else:
            self.controller.formulation.lead(self._state.update(q, v), a)

    @property
    def level(self) -> float:
        """Elapsed share of the path to the contact, 0 to 1."""
        return self._reference.level


class LandingDriver(StrikeDriver):
    """Controller of a robot that falls freely and lands on its feet.

    During the fall, the joints follow the path under a controller without contact constraints.  From the contact on,
    the controller of the standing robot follows the planned stop, or holds the posture of the contact if the path has
    no stop.
    """

    def __init__(self, setup: Setup, posture: JointPosture, path: PosturePath) -> None:
        super().__init__(setup, posture, path)
        self.start = path.q[0]
        self._fall = Controller(setup.robot, TaskFormulation(posture=posture), period=setup.scenario.control.period)
        self._stands = False

    def reset(self, q: Array) -> Command:
        self._stands = False
        super().reset(q)
        return self._fall.reset(q, np.zeros(self.setup.robot.nv))

    def tick(self, reading: Reading, reference: ReferencePoint | None = None) -> Command:
        q, v, a = self._reference.tick(reading.t, reading.q, reading.v, None)
        self._now = reading.t
        if self._reference.phase <= PathPhase.LATE:
            self.posture.lead(q, v, a)
            return self._fall.tick(reading.t, reading.q, reading.v)
        if not self._stands:
            self.controller.reset(reading.q, reading.v)
            self._stands = True
        self.controller.formulation.lead(self._state.update(q, v), a)
        return self.controller.tick(reading.t, reading.q, reading.v)
