"""Drivers of controllers in a scenario: they set references and prepare the controller for the impact."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin

from impact_posture.path.posture_path import PosturePath
from impact_posture.simulation.controllers.compiled_tick import CompiledTick
from impact_posture.simulation.controllers.contact_reference import ReferencePoint
from impact_posture.simulation.controllers.task_formulations import build_formulation, end_effector_task
from impact_posture.simulation.setup import Setup
from impact_posture.simulation.world.sensor_noise import Reading
from impact_posture.system.arrays import Array
from impact_posture.tsid.controller import Command, Controller
from impact_posture.tsid.flow.reference_flow_posture import ReferenceFlowPosture
from impact_posture.tsid.smooth_step import smooth
from impact_posture.tsid.tasks.body_tasks import BaseOrientation, BodyTaskLead, CenterOfMass
from impact_posture.tsid.tasks.impact_robust import ImpactRobustPosture
from impact_posture.tsid.tasks.joint_posture import JointPosture
from impact_posture.tsid.tasks.task import TargetTask

# Duration of the motion of references to a new posture, s.
MOVE = 1.0


class Driver:
    """Nominal controller: task-space inverse dynamics with a posture task.

    Attributes:
        controller: The controller in Python.
        compiled: The same controller as machine code, which then computes the commands; ``None`` if the controller
            runs in Python.
        leads_posture: Whether the posture task has a moving reference, which each tick sends to a controller in C.
        start: Posture at the start of a run, shape (nq,).
    """

    compiled: CompiledTick | None = None
    leads_posture = False

    def __init__(self, setup: Setup, posture: JointPosture) -> None:
        self.setup, self.posture, self.start = setup, posture, setup.q
        self._end_effector = end_effector_task(setup)
        formulation = build_formulation(setup, posture, self._end_effector)
        self._body_tasks = [t for t in formulation.weighted if isinstance(t, CenterOfMass | BaseOrientation)]
        self.controller = Controller(setup.robot, formulation, period=setup.scenario.control.period)
        self._inward = np.zeros(3 if self._end_effector is None else self._end_effector.size)
        self._inward[:3] = -setup.scenario.normal
        self._home: pin.SE3 | Array | None = None
        self._followed: ReferencePoint | None = None

    def reset(self, q: Array) -> Command:
        """Start at rest at ``q``.  The targets of all tasks are reset to the present state."""
        end_effector, self._followed = self._end_effector, None
        for task in self.controller.formulation.tasks:
            if isinstance(task, TargetTask):
                task.target, task.target_velocity, task.target_acceleration = task.default_target(), 0.0, 0.0
        at_rest = np.zeros(self.setup.robot.nv)
        command = self.controller.reset(q, at_rest)
        self._home = None if end_effector is None else end_effector.target
        return command if self.compiled is None else self.compiled.reset(q, at_rest)

    def tick(self, reading: Reading, reference: ReferencePoint | None = None) -> Command:
        """Return the command for a reading.  ``reference`` is the target of the end effector along its approach."""
        self.lead(reading.t, reference)
        if self.compiled is not None:
            return self.compiled.tick(reading)
        return self.controller.tick(reading.t, reading.q, reading.v, reading.force)

    def lead(self, t: float, reference: ReferencePoint | None = None) -> None:
        """Set the targets of the tasks for a tick at time ``t``, s."""
        if reference != self._followed and reference is not None:
            self._follow(reference)
            self._followed = reference

    def brace(self) -> None:
        """Prepare for impacts from now on.  The nominal controller does nothing."""

    def hold(self) -> None:
        """Hold the reached posture.  The nominal controller does nothing."""

    def expect(self, t: float) -> None:
        """Expect an impact at time ``t``, s.  The nominal controller does nothing."""

    @property
    def ahead(self) -> float:
        """Time before an impact at which :meth:`expect` is called at the latest, s."""
        return 0.0

    @property
    def level(self) -> float:
        """Activation level of the preparation for an impact, 0 to 1."""
        return self.posture.level if self.compiled is None else self.compiled.library.level

    def _call_posture(self, method: str, *arguments: Any, **named: Any) -> None:
        """Call a method of the posture task, in C if the controller runs in C, otherwise in Python."""
        getattr(self.posture if self.compiled is None else self.compiled.library, method)(*arguments, **named)

    def _follow(self, reference: ReferencePoint) -> None:
        task, home = self._end_effector, self._home
        if task is None or home is None:
            return
        step = reference.distance * self._inward[:3]
        task.target = home + step if isinstance(home, np.ndarray) else pin.SE3(home.rotation, home.translation + step)
        task.target_velocity = reference.speed * self._inward
        task.target_acceleration = reference.acceleration * self._inward


class RobustDriver(Driver):
    """Impact-robust controller.  After :meth:`brace`, the posture task contains the impact-robust term."""

    posture: ImpactRobustPosture

    def brace(self) -> None:
        self._call_posture("brace")

    def hold(self) -> None:
        """Hold the present posture, center of mass and base orientation, and switch the term off."""
        self._call_posture("contact")
        if self.compiled is not None:
            self.compiled.catch_up()
        for task in self._body_tasks:
            task.target = None
            task.reset(self.controller.state)


class FlowDriver(Driver):
    """Controller whose reference posture flows towards a smaller impact after :meth:`brace`."""

    posture: ReferenceFlowPosture
    _now = 0.0

    def lead(self, t: float, reference: ReferencePoint | None = None) -> None:
        self._now = t
        super().lead(t, reference)

    def brace(self) -> None:
        self._call_posture("brace")

    def hold(self) -> None:
        self._call_posture("contact")

    def expect(self, t: float) -> None:
        """Stop the flow before an impact at time ``t``, s, so that the posture is at rest at the impact."""
        if self.level > 0:
            self._call_posture("brace", t_impact=t - self._now)


class PostureDriver(Driver):
    """Nominal controller that moves to the offline posture ``target``, shape (nq,), after :meth:`brace`."""

    def __init__(self, setup: Setup, posture: JointPosture, target: Array) -> None:
        super().__init__(setup, posture)
        self._goal = target
        self._since: float | None = None
        # Each tuple contains a task, its target at the start of the motion, and its target at the end of the motion.
        self._moves: list[tuple[CenterOfMass | BaseOrientation, Any, Any]] = []

    def reset(self, q: Array) -> Command:
        self._since, self._moves = None, []
        return super().reset(q)

    def brace(self) -> None:
        """Move posture, center of mass and base orientation to the offline posture within :data:`MOVE` seconds."""
        self._call_posture("move_to", self._goal, MOVE)
        model = self.setup.robot.model
        for task in self._body_tasks:
            # The offline posture has the same positions of the feet, so this motion does not move the feet.
            if isinstance(task, CenterOfMass):
                end = np.array(pin.centerOfMass(model, model.createData(), self._goal))
            else:
                end = pin.Quaternion(self._goal[3:7]).matrix()
            self._moves.append((task, task.target, end))
        self._since = 0.0

    def lead(self, t: float, reference: ReferencePoint | None = None) -> None:
        if self._since is not None and self._since < MOVE:
            self._since = min(MOVE, self._since + self.controller.period)
            for task, begin, end in self._moves:
                if isinstance(task, CenterOfMass):
                    task.target = begin + self.level * (end - begin)
                else:
                    task.target = begin @ pin.exp3(self.level * pin.log3(begin.T @ end))
        super().lead(t, reference)

    @property
    def level(self) -> float:
        """Progress of the motion to the offline posture, 0 to 1."""
        return 0.0 if self._since is None else smooth(self._since / MOVE)


class PathDriver(Driver):
    """Nominal controller whose posture follows a timed path after :meth:`brace`.

    Between two rows of the path, the motion is the quintic polynomial that the path files describe.  The targets of
    center of mass and base orientation follow from the posture.

    Attributes:
        path: Path to the offline optimum, from the start posture or the nearest posture that satisfies the
            constraints.
    """

    leads_posture = True

    def __init__(self, setup: Setup, posture: JointPosture, path: PosturePath) -> None:
        super().__init__(setup, posture)
        self.path = path
        self._since: float | None = None
        self._body = BodyTaskLead(setup.robot.model)

    def reset(self, q: Array) -> Command:
        self._since = None
        return super().reset(q)

    def brace(self) -> None:
        self._since = 0.0

    def lead(self, t: float, reference: ReferencePoint | None = None) -> None:
        if self._since is not None and self.level < 1:
            self._since += self.controller.period
            path, model = self.path, self.setup.robot.model
            if self._since >= path.duration:
                q, v, a = path.q[-1], np.zeros(model.nv), np.zeros(model.nv)
            else:
                q, v, a = path.at(self._since)
            self.posture.lead(q, v, a)
            if self.compiled is not None:
                self.compiled.library.lead_posture(q, v, a)
            self._body.lead(self._body_tasks, q, v, a)
        super().lead(t, reference)

    @property
    def level(self) -> float:
        """Elapsed share of the duration of the path, 0 to 1."""
        if self._since is None:
            return 0.0
        return min(1.0, self._since / self.path.duration) if self.path.duration else 1.0
