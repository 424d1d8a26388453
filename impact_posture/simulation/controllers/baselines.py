"""Controllers for comparison with the impact-robust term: stiffer springs, and the gradient flow of Walker 1994."""

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

    ``gradient`` is ``q → (H, ∇H)``, ``strength`` is ``K/λ``, and the term rests at ``q``, shape (nq,).
    A posture task with this added stiffness has the spring of the term without its posture.  The difference between
    the two controllers is the effect of the posture.  ``∇²H`` is symmetrized.  The base of a floating robot is left
    out, because other tasks control it.  Negative curvature is left out, because it is not a stiffness.
    """
    added = strength * curvature(gradient, robot.model, q, np.eye(robot.nv))
    if robot.floating:
        added[:6], added[:, :6] = 0.0, 0.0
    values, vectors = np.linalg.eigh((added + added.T) / 2)
    spring = (vectors * np.maximum(values, 0.0)) @ vectors.T
    return np.asarray(spring + spring.T) / 2


def resting_posture(driver: Driver, seconds: float, *, ahead: float = 0.0) -> Array:
    """Return the posture in which a driver comes to rest after :meth:`Driver.brace`, shape (nq,).

    The robot executes the planned acceleration exactly, without physics engine, sensors and motors.  It rests once
    ``‖ν‖`` has been below 1e-3 at the full level of the driver for 0.2 s, or after ``seconds``.  Then the end
    effector moves ``ahead`` (m) towards the surface, and the robot comes to rest again.
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

    ``ν_ref = −α k Z Zᵀ ∇H/λ``.  The columns of ``Z`` span the motions that the other tasks leave free.  ``q_des`` is
    the integral of ``ν_ref``, and ``ν_ref`` is the velocity reference.  They replace the impact-robust term.
    ``k = K/K_d`` makes the flow as fast as this term.  The flow has the bound and the fade of the term near joint
    limits.

    Attributes:
        basis: ``Z``, shape (nv, r).  Without it, the posture does not flow.
    """

    def reset(self, state: State) -> None:
        super().reset(state)
        self.basis: Array | None = None
        self._flow = np.zeros(state.nv)

    def contact(self) -> None:
        """Let the flow fade.  :class:`WalkerDriver` then moves the reference back to the robot."""
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
    """Nominal controller whose posture reference flows down the gradient."""

    posture: FlowPosture

    def reset(self, q: Array) -> Command:
        command = super().reset(q)
        self.posture.basis = self.controller.assembly.redundancy(self.controller.state)
        self._ticks = 0
        return command

    def tick(self, reading: Reading, reference: ReferencePoint | None = None) -> Command:
        """Return the command, and compute the redundancy as often as the gradient."""
        if self.level > 0:
            if self._ticks % self.posture.every == 0:
                self.posture.basis = self.controller.assembly.redundancy(self.controller.state)
            self._ticks += 1
        return super().tick(reading, reference)

    def hold(self) -> None:
        """Stop the flow and hold the present posture, center of mass and base orientation."""
        super().hold()
        # The reference is ahead of the robot where other tasks have kept the robot back.
        self.posture.move_to(self.controller.state.q, self.posture.activation.ramp)


class ReleaseDriver(RobustDriver):
    """Impact-robust term without the nominal spring, until ``H`` stops falling.

    Without ``K_p``, the posture flows to the optimum instead of coming to rest before it.  The scale of the term is
    the larger curvature of the start and the offline optimum, so its stiffness hardly exceeds ``K`` between them.
    The reached posture is held when ``H`` falls by a share of less than :attr:`LEAST` within :attr:`PATIENCE` (s).
    The term has ``spring="release"`` and an activation that is not live.
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
        """Return the command, and check periodically whether ``H`` still falls."""
        if self._braced and self.level == 1:
            self._ticks += 1
            if self._ticks * self.controller.period >= self.PATIENCE:
                if self.posture.value > (1 - self.LEAST) * self._reached:
                    self._braced = False
                    self.hold()
                self._ticks, self._reached = 0, self.posture.value
        return super().tick(reading, reference)
