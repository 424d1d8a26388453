"""Controllers for comparison with the impact-robust term: additional stiffness, and the flow of Walker 1994."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from impact_posture.robot.robot import Robot
from impact_posture.simulation.controllers.contact_reference import ReferencePoint
from impact_posture.simulation.controllers.driver import MOVE, Driver, RobustDriver
from impact_posture.simulation.scenario_objective import Gradient
from impact_posture.simulation.setup import Setup
from impact_posture.simulation.world.sensor_noise import Reading
from impact_posture.system.arrays import Array
from impact_posture.tsid.controller import Command
from impact_posture.tsid.smooth_step import smooth
from impact_posture.tsid.state import State
from impact_posture.tsid.tasks.activation import Phase
from impact_posture.tsid.tasks.impact_robust import ImpactRobustPosture, curvature, curvature_scale


def spring_of_term(robot: Robot, gradient: Gradient, q: Array, strength: float) -> Array:
    """Return ``[K ∇²H(q)/λ]₊``, the stiffness of the impact-robust term at ``q``, 1/s², shape (nv, nv).

    ``gradient`` is ``q → (H, ∇H)`` and ``strength`` is ``K/λ``.  ``q``, shape (nq,), is the posture in which the
    robot rests with the impact-robust term.  A posture task with this additional stiffness is as stiff as the term,
    but does not change the posture.  A comparison of both controllers therefore shows the effect of the posture
    alone.  ``∇²H`` is symmetrized.  The entries of a floating base are zero, because other tasks control the base.
    Negative eigenvalues are set to zero, because they would destabilize the robot.
    """
    added = strength * curvature(gradient, robot.model, q, np.eye(robot.nv))
    if robot.floating:
        added[:6], added[:, :6] = 0.0, 0.0
    values, vectors = np.linalg.eigh((added + added.T) / 2)
    spring = (vectors * np.maximum(values, 0.0)) @ vectors.T
    return np.asarray(spring + spring.T) / 2


def resting_posture(driver: Driver, seconds: float, *, ahead: float = 0.0) -> Array:
    """Return the posture in which a driver comes to rest after :meth:`Driver.brace`, shape (nq,).

    The robot executes the commanded acceleration exactly, without physics engine, sensors and motors.  The motion
    ends when :attr:`Driver.level` is 1 and ``‖ν‖`` has been below 1e-3 for 0.2 s, or after ``seconds``.  If ``ahead``
    is not zero, the end effector moves ``ahead`` (m) towards the surface afterwards, and the robot comes to rest
    again.
    """
    setup, period = driver.setup, driver.controller.period
    q, v, t = setup.q.copy(), np.zeros(setup.robot.nv), 0.0
    driver.reset(q)
    driver.brace()
    for distance in (0.0, ahead) if ahead else (0.0,):
        begin, rest = t, 0
        if distance:
            driver.expect(t + MOVE)
        while t < begin + seconds and rest * period <= 0.2:
            reference = ReferencePoint(distance * smooth(min((t - begin) / MOVE, 1.0)), 0.0, 0.0)
            v = v + period * driver.tick(Reading(t, q, v, None), reference if distance else None).acceleration
            q = np.asarray(pin.integrate(setup.robot.model, q, period * v))
            t += period
            rest = rest + 1 if driver.level == 1 and float(np.linalg.norm(v)) < 1e-3 else 0
    return q


class FlowPosture(ImpactRobustPosture):
    """Projected gradient flow of Walker 1994 as the reference of a posture task.

    The velocity reference ``ν_ref = −α k Z Zᵀ ∇H/λ`` and its integral, the posture reference ``q_des``, replace the
    impact-robust term.  The columns of ``Z`` span the motions that the other tasks leave free.  ``k = K/K_d`` makes
    the flow as fast as the impact-robust term.  The flow has the same bound and the same fade near joint limits as
    the impact-robust term.

    Attributes:
        basis: Basis ``Z`` of the motions that the other tasks leave free, shape (nv, r); ``None`` to stop the flow.
    """

    def reset(self, state: State) -> None:
        super().reset(state)
        self.basis: Array | None = None
        self._flow = np.zeros(state.nv)

    def contact(self) -> None:
        """Fade the flow out.  :class:`WalkerDriver` then moves the posture reference to the present posture."""
        self.activation.enter(Phase.CONTACT)

    def advance(self, state: State, dt: float) -> None:
        super().advance(state, dt)
        if self.basis is None or self.level <= 0:
            self._flow[:] = 0.0
            return
        wanted = self.level * self.term / np.maximum(self.kd, 1e-9)
        self._flow = self.basis @ (self.basis.T @ wanted)
        self._target[:] = pin.integrate(self._model, self._target, dt * self._flow)

    def feedforward(self, state: State) -> Array:
        return np.asarray(self.kd * self._flow)


class WalkerDriver(RobustDriver):
    """Nominal controller whose posture reference follows the negative gradient of H (:class:`FlowPosture`)."""

    posture: FlowPosture

    def reset(self, q: Array) -> Command:
        command = super().reset(q)
        self.posture.basis = self.controller.assembly.redundancy(self.controller.state)
        self._ticks = 0
        return command

    def tick(self, reading: Reading, reference: ReferencePoint | None = None) -> Command:
        """Return the command.  Update the basis ``Z`` in the ticks that update the gradient."""
        if self.level > 0:
            if self._ticks % self.posture.every == 0:
                self.posture.basis = self.controller.assembly.redundancy(self.controller.state)
            self._ticks += 1
        return super().tick(reading, reference)

    def hold(self) -> None:
        """Stop the flow and hold the present posture, center of mass and base orientation."""
        super().hold()
        # Other tasks can slow the robot, so that the posture reference is ahead of the robot.  Move the reference to
        # the present posture.
        self.posture.move_to(self.controller.state.q, self.posture.activation.ramp)


class ReleaseDriver(RobustDriver):
    """Apply the impact-robust term without the nominal stiffness ``K_p`` until ``H`` no longer decreases.

    Without ``K_p``, the robot reaches the optimum; with ``K_p``, it would come to rest before the optimum.  The scale
    ``λ`` of the term is the larger of the curvatures at the start and at the offline optimum.  Therefore, the
    stiffness of the term hardly exceeds ``K`` between start and optimum.  If ``H`` decreases by less than the share
    :attr:`LEAST` within :attr:`PATIENCE` (s), the controller holds the reached posture.  The term must have
    ``spring="release"`` and ``activation.live = False``.
    """

    PATIENCE, LEAST = 0.5, 0.01

    def __init__(self, setup: Setup, term: ImpactRobustPosture, gradient: Gradient, optimum: Array) -> None:
        super().__init__(setup, term)
        scales = []
        for q in (setup.q, optimum):
            self.controller.reset(q, np.zeros(setup.robot.nv))
            Z = self.controller.assembly.redundancy(self.controller.state)
            scales.append(curvature_scale(gradient, setup.robot.model, q, Z, term.name))
        self._scale = max(scales)
        self._ticks, self._reached, self._braced = 0, np.inf, False

    def reset(self, q: Array) -> Command:
        command = super().reset(q)
        self.posture.scale = self._scale
        self._ticks, self._reached, self._braced = 0, np.inf, False
        return command

    def brace(self) -> None:
        super().brace()
        self._braced = True

    def tick(self, reading: Reading, reference: ReferencePoint | None = None) -> Command:
        """Return the command, and check periodically whether ``H`` still decreases."""
        if self._braced and self.level == 1:
            self._ticks += 1
            if self._ticks * self.controller.period >= self.PATIENCE:
                if self.posture.value > (1 - self.LEAST) * self._reached:
                    self._braced = False
                    self.hold()
                self._ticks, self._reached = 0, self.posture.value
        return super().tick(reading, reference)
