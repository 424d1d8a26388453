"""Posture task whose target moves to a posture with lower impacts."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from impact_posture.codegen.impact_gradient import ImpactGradient
from impact_posture.config.checked import checked
from impact_posture.errors import InputError
from impact_posture.robot.robot import Robot
from impact_posture.tsid.actuators import Actuators
from impact_posture.tsid.flow.flow_direction import FlowOptions
from impact_posture.tsid.flow.reference_flow import ReferenceFlow
from impact_posture.tsid.state import State
from impact_posture.tsid.task_formulation import TaskFormulation
from impact_posture.tsid.tasks.body_tasks import BodyTaskLead
from impact_posture.tsid.tasks.impact_robust import Gradient, fitting_gradient
from impact_posture.tsid.tasks.joint_posture import JointPosture


@checked
class ReferenceFlowPosture(JointPosture):
    """``ν̇* = K_p (q_r ⊖ q) + K_d (u − ν) + u̇``, where ``q_r`` follows the reference flow.

    ``∇H`` requires no gain, because the speed, the acceleration and the stopping rule of
    :class:`~impact_posture.tsid.flow.reference_flow.ReferenceFlow` suit every robot.  On a standing robot, the
    targets of the center of mass and of the base orientation follow ``q_r``, too.  While the flow rests,
    :meth:`move_to` can move the posture; the next :meth:`brace` starts from the new posture.

    Attributes:
        settle: Time for which the flow rests before a known impact, s: four time constants ``1/√K_p``.
    """

    def __init__(
        self,
        robot: Robot,
        gradient: Gradient | ImpactGradient,
        *,
        options: FlowOptions | None = None,
        path: ArrayLike | None = None,
        name: str = "flow posture",
        **gains: Any,
    ) -> None:
        """Set gains and options.

        Args:
            robot: The robot.
            gradient: Function ``q → (H, ∇H)``, or a compiled export, whose objective gives H and ∇H.
            options: Parameters of the flow.
            path: Posture, shape (nq,), or postures, shape (k, nq), that ``q_r`` visits first, for example an offline
                optimum or the path to it.  After the last posture, the flow starts.
            name: Name in reports.
            gains: Arguments of :class:`~impact_posture.tsid.tasks.joint_posture.JointPosture`.

        Raises:
            PostureError: A posture of the path is not a configuration of the robot.
            ManifestMismatch: The export belongs to another robot.
        """
        super().__init__(robot, name=name, **gains)
        self._function = fitting_gradient(robot, gradient)
        self.options = options or FlowOptions()
        visited = np.zeros((0, robot.nq)) if path is None else np.atleast_2d(np.asarray(path, dtype=float))
        self._path = [robot.check_posture(q, limits=False) for q in visited]
        self._flow: ReferenceFlow | None = None
        self._lead = BodyTaskLead(robot.model)
        slowest = float(self.kp[robot.first_joint :].min(initial=np.inf))
        self.settle = 4.0 / np.sqrt(slowest) if 0 < slowest < np.inf else 0.0

    @property
    def flow(self) -> ReferenceFlow:
        """The reference flow of this task.

        Raises:
            InputError: No controller with this task has been reset.
        """
        if self._flow is None:
            raise InputError("the flow has no start posture yet", where=self.name, hint="reset the controller first")
        return self._flow

    def brace(self, t_impact: float | None = None) -> None:
        """Start the flow, because an impact is coming.

        ``t_impact`` is the time to the impact, s, or ``None`` if it is unknown.  The flow moves for at most
        ``options.duration``.  The flow comes to rest :attr:`settle` seconds before a known impact, if its
        acceleration permits this.

        Raises:
            InputError: The time is not finite, or no controller with this task has been reset.
        """
        if t_impact is not None and not math.isfinite(t_impact):
            raise InputError("the time is not finite", where=f"{self.name}: t_impact", hint="give seconds from now")
        if not self.flow.moves:
            self.flow.start_at(self._reached())
        self.flow.on = True
        self.flow.rest_at(np.inf if t_impact is None else t_impact - self.settle)

    def contact(self) -> None:
        """Stop the flow and hold the reached posture."""
        self.flow.on = False

    def release(self) -> None:
        """Do the same as :meth:`contact`."""
        self.contact()

    @property
    def level(self) -> float:
        """1 if the flow may move, otherwise 0."""
        return 0.0 if self._flow is None else float(self._flow.on)

    def reset(self, state: State) -> None:
        """Set the targets to the present state: the posture, and the outputs of the tasks that followed the flow."""
        super().reset(state)
        self._lead.reset(state)

    def begin(self, state: State, formulation: TaskFormulation, actuators: Actuators) -> None:
        """Create the flow at ``state``.  The controller calls this method in its ``reset``.

        Raises:
            MetricError: At this state, the gradient does not exist or ``H`` is zero.
        """
        flow = ReferenceFlow(self._robot, self._function, formulation, actuators, self.options, self._path)
        flow.reset(state.q)
        self._flow, self.value = flow, flow.value

    def advance(self, state: State, dt: float) -> None:
        """Advance the flow, and move the targets of the posture and of the tasks that follow the flow."""
        super().advance(state, dt)
        flow = self.flow
        if not flow.moves:
            return
        flow.advance(dt, state.q)
        self.value = flow.value
        self.lead(flow.q, flow.velocity, flow.acceleration)
        if flow.led:
            self._lead.lead(flow.led, flow.q, flow.velocity, flow.acceleration)
