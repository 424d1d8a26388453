"""A controller inside a scenario: what it follows, when it prepares for the impact, what it holds."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impact_posture.simulation.reference import ReferencePoint
from impact_posture.simulation.scenario import Setup
from impact_posture.simulation.sensor_noise import Reading
from impact_posture.simulation.task_formulations import build_formulation, end_effector_task
from impact_posture.tsid.body_tasks import BaseOrientation, CenterOfMass
from impact_posture.tsid.controller import Command, Controller
from impact_posture.tsid.impact_robust import ImpactRobustPosture
from impact_posture.tsid.posture_tasks import JointPosture, smooth

Array = NDArray[np.float64]

# Seconds over which references move to a new posture.
MOVE = 1.0


class Driver:
    """Task-space inverse dynamics with one posture task or another; by itself the nominal controller.

    Attributes:
        setup: The experiment.
        posture: The posture task.
        controller: The controller.
    """

    def __init__(self, setup: Setup, posture: JointPosture) -> None:
        """Build the scenario's program around a posture task."""
        self.setup, self.posture = setup, posture
        self._hand = end_effector_task(setup)
        formulation = build_formulation(setup, posture, self._hand)
        self.controller = Controller(setup.robot, formulation, period=setup.scenario.control.period)
        self._inward = np.zeros(3 if self._hand is None else self._hand.size)
        self._inward[:3] = -setup.scenario.normal
        self._home: pin.SE3 | Array | None = None

    def reset(self, q: Array) -> Command:
        """Begin at rest: what the tasks hold is what is there, whatever a run before has moved."""
        if self._hand is not None:
            self._hand.target = None
            self._hand.target_velocity = self._hand.target_acceleration = np.zeros(self._hand.size)
        for task in self.controller.formulation.weighted:
            if isinstance(task, CenterOfMass | BaseOrientation):
                task.target = None
        command = self.controller.reset(q, np.zeros(self.setup.robot.nv))
        self._home = None if self._hand is None else self._hand.target
        return command

    def tick(self, reading: Reading, reference: ReferencePoint | None = None) -> Command:
        """The command; ``reference`` is where the end effector is to be along its way in."""
        if reference is not None:
            self._follow(reference)
        return self.controller.tick(reading.t, reading.q, reading.v, reading.force)

    def brace(self) -> None:
        """Prepare for impacts from now on; a nominal controller does not."""

    def hold(self) -> None:
        """Keep the posture that was reached and move no further."""

    def expect(self, t: float) -> None:
        """An impact is expected at this time, s."""

    @property
    def level(self) -> float:
        """How much of the preparing term is on, 0 to 1."""
        return 0.0

    def _freeze(self) -> None:
        """Let center of mass and base orientation be wanted where they are now."""
        state = self.controller.state
        for task in self.controller.formulation.weighted:
            if isinstance(task, CenterOfMass):
                task.target = state.center_of_mass()[0].copy()
            elif isinstance(task, BaseOrientation):
                task.target = np.array(state.base_rotation)

    def _follow(self, reference: ReferencePoint) -> None:
        if self._hand is None or self._home is None:
            return
        home, way = self._home, reference.distance * self._inward[:3]
        self._hand.target = (
            home + way if isinstance(home, np.ndarray) else pin.SE3(home.rotation, home.translation + way)
        )
        self._hand.target_velocity = reference.speed * self._inward
        self._hand.target_acceleration = reference.acceleration * self._inward


class RobustDriver(Driver):
    """Impact-robust: the posture task carries the term, from :meth:`Driver.brace` on."""

    posture: ImpactRobustPosture

    def brace(self) -> None:
        """Switch the term on."""
        self.posture.brace()

    def hold(self) -> None:
        """Hold the reached posture, center of mass and base orientation; switch the term off."""
        self.posture.contact()
        self._freeze()

    @property
    def level(self) -> float:
        """Activation of the term."""
        return self.posture.activation.level


class PostureDriver(Driver):
    """Nominal, but for the posture: from :meth:`Driver.brace` on it goes to one that was found offline."""

    def __init__(self, setup: Setup, posture: JointPosture, target: Array) -> None:
        """Take the posture to go to, shape (nq,)."""
        super().__init__(setup, posture)
        self._goal = target
        self._since: float | None = None
        self._from: dict[str, Array] = {}
        self._to: dict[str, Array] = {}

    def reset(self, q: Array) -> Command:
        """Begin at rest."""
        self._since, self._from = None, {}
        return super().reset(q)

    def brace(self) -> None:
        """Go there within :data:`MOVE`, center of mass and base orientation likewise."""
        self.posture.move_to(self._goal, MOVE)
        model, data = self.setup.robot.model, self.setup.robot.model.createData()
        # Feet stay where they are: the goal was found with them there.
        center = np.array(pin.centerOfMass(model, data, self._goal))
        rotation = pin.Quaternion(self._goal[3:7]).matrix() if self.setup.robot.floating else np.eye(3)
        for task in self.controller.formulation.weighted:
            if isinstance(task, CenterOfMass) and task.target is not None:
                self._from[task.name], self._to[task.name] = task.target.copy(), center
            elif isinstance(task, BaseOrientation) and task.target is not None:
                self._from[task.name], self._to[task.name] = task.target.copy(), rotation
        self._since = 0.0

    def tick(self, reading: Reading, reference: ReferencePoint | None = None) -> Command:
        """The command, references on their way."""
        if self._since is not None and self._since < MOVE:
            self._since = min(MOVE, self._since + self.controller.period)
            self._move(smooth(self._since / MOVE))
        return super().tick(reading, reference)

    @property
    def level(self) -> float:
        """How far on the way it is."""
        return 0.0 if self._since is None else smooth(self._since / MOVE)

    def _move(self, share: float) -> None:
        for task in self.controller.formulation.weighted:
            if task.name not in self._from:
                continue
            begin, end = self._from[task.name], self._to[task.name]
            if isinstance(task, CenterOfMass):
                task.target = begin + share * (end - begin)
            elif isinstance(task, BaseOrientation):
                task.target = begin @ pin.exp3(share * pin.log3(begin.T @ end))
