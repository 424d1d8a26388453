"""Controllers to compare the impact-robust term with: stiffer ones, and the gradient flow of Walker 1994."""

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
    """Return ``[K ∇²H(q)/λ]₊``, the spring that an impact-robust term is for a robot that is pushed away from ``q``.

    A posture task with this added stiffness has the spring of the term, but not its posture.  What the term gains
    over such a task comes from the posture alone.  ``∇²H`` is symmetrized.  The base of a floating robot is left out,
    because other tasks control it.  Negative curvature is left out, because the term is no spring there.

    Args:
        robot: The robot.
        gradient: ``q → (H, ∇H)``.
        q: Posture where the term rests, shape (nq,).
        strength: ``K/λ`` of the term.

    Returns:
        Stiffness, 1/s², shape (nv, nv).
    """
    added = strength * curvature(gradient, robot.model, q, np.eye(robot.nv))
    if robot.floating:
        added[:6], added[:, :6] = 0.0, 0.0
    values, vectors = np.linalg.eigh((added + added.T) / 2)
    spring = (vectors * np.maximum(values, 0.0)) @ vectors.T
    return np.asarray(spring + spring.T) / 2


def resting_posture(driver: Driver, seconds: float, quiet: float = 1e-3, ahead: float = 0.0) -> Array:
    """Return the posture that a driver braces to, shape (nq,).

    The robot executes the planned acceleration exactly, without physics engine, sensors and motors.

    Args:
        driver: The driver, which is reset.
        seconds: Longest time to come to rest, s.
        quiet: ``‖ν‖`` below which the robot rests, once the driver is at its full level.
        ahead: Way that the end effector then goes on towards the surface, m.
    """
    setup, period = driver.setup, driver.controller.period
    q, v, t = setup.q.copy(), np.zeros(setup.robot.nv), 0.0
    driver.reset(q)
    driver.brace()
    for way in (0.0, ahead) if ahead else (0.0,):
        began, rest = t, 0
        if way:
            driver.expect(t + MOVE)
        while t < began + seconds and rest * period <= 0.2:
            gone = ReferencePoint(way * smooth(min((t - began) / MOVE, 1.0)), 0.0, 0.0)
            v = v + period * driver.tick(Reading(t, q, v, None), gone if way else None).acceleration
            q = np.asarray(pin.integrate(setup.robot.model, q, period * v))
            t += period
            rest = rest + 1 if driver.level == 1 and float(np.linalg.norm(v)) < quiet else 0
    return q


class FlowPosture(ImpactRobustPosture):
    """Projected gradient flow of Walker 1994 as the reference of a posture task.

    ``ν_ref = −α k Z Zᵀ ∇H/λ``, where the columns of ``Z`` span what the other tasks leave free.  ``q_des`` is the
    integral of ``ν_ref``, and ``ν_ref`` is the velocity reference, in place of the impact-robust term.  ``k = K/K_d``
    makes the flow as fast as that term would be.  It has the bound and the fade near joint limits of the term.

    Attributes:
        basis: ``Z``, shape (nv, r); without it, nothing flows.
    """

    def reset(self, state: State) -> None:
        """Hold the present posture."""
        super().reset(state)
        self.basis: Array | None = None
        self._flow = np.zeros(state.nv)

    def contact(self) -> None:
        """Let the flow fade; its reference is ahead of the robot, so :class:`WalkerDriver` moves it back at once."""
        self.activation.enter(Phase.CONTACT)

    def advance(self, state: State, dt: float) -> None:
        """Move ``q_des``."""
        super().advance(state, dt)
        if self.basis is None or self.level <= 0:
            self._flow[:] = 0.0
            return
        wanted = self.level * self.term / np.maximum(self.kd, 1e-9)
        self._flow = self.basis @ (self.basis.T @ wanted)
        self._target[:] = pin.integrate(self._model, self._target, dt * self._flow)

    def feedforward(self, state: State) -> Array:
        """Return the flow as velocity reference."""
        return np.asarray(self.kd * self._flow)


class WalkerDriver(RobustDriver):
    """Nominal controller whose posture reference flows down the gradient."""

    posture: FlowPosture

    def reset(self, q: Array) -> Command:
        """Begin at rest."""
        command = super().reset(q)
        self.posture.basis = self.controller.assembly.redundancy(self.controller.state)
        self._ticks = 0
        return command

    def tick(self, reading: Reading, reference: ReferencePoint | None = None) -> Command:
        """Return the command.  The redundancy is computed as often as the gradient."""
        if self.level > 0:
            if self._ticks % self.posture.every == 0:
                self.posture.basis = self.controller.assembly.redundancy(self.controller.state)
            self._ticks += 1
        return super().tick(reading, reference)

    def hold(self) -> None:
        """Stop the flow and hold the present posture, center of mass and base orientation."""
        super().hold()
        # The reference is ahead of the robot wherever other tasks kept the robot back.
        self.posture.move_to(self.controller.state.q, self.posture.activation.ramp)


class ReleaseDriver(RobustDriver):
    """The impact-robust term without the nominal spring, until ``H`` falls no more.

    Without ``K_p``, the posture flows to the optimum itself instead of resting short of it.  The term is scaled with
    the larger curvature of the start and of the offline optimum, hence nowhere between is it a spring much stiffer
    than ``K``.  As soon as ``H`` has fallen by less than :attr:`LEAST` of itself within :attr:`PATIENCE`, the reached
    posture is held.

    Args:
        setup: The experiment.
        term: The term, with ``spring="release"`` and an activation that is not live.
        gradient: ``q → (H, ∇H)``.
        optimum: Posture found offline, shape (nq,).
    """

    PATIENCE, LEAST = 0.5, 0.01

    def __init__(self, setup: Setup, term: ImpactRobustPosture, gradient: Gradient, optimum: Array) -> None:
        """Measure both curvatures."""
        super().__init__(setup, term)
        scales = []
        for q in (setup.q, optimum):
            self.controller.reset(q, np.zeros(setup.robot.nv))
            Z = self.controller.assembly.redundancy(self.controller.state)
            scales.append(curvature_scale(gradient, setup.robot.model, q, Z, term.name))
        self._scale = max(scales)
        self._ticks, self._reached, self._braced = 0, np.inf, False

    def reset(self, q: Array) -> Command:
        """Begin at rest."""
        command = super().reset(q)
        self.posture.scale = self._scale
        self._ticks, self._reached, self._braced = 0, np.inf, False
        return command

    def brace(self) -> None:
        """Switch the term on."""
        super().brace()
        self._braced = True

    def tick(self, reading: Reading, reference: ReferencePoint | None = None) -> Command:
        """Return the command.  Now and then, look whether ``H`` still falls."""
        if self._braced and self.level == 1:
            self._ticks += 1
            if self._ticks * self.controller.period >= self.PATIENCE:
                if self.posture.value > (1 - self.LEAST) * self._reached:
                    self._braced = False
                    self.hold()
                self._ticks, self._reached = 0, self.posture.value
        return super().tick(reading, reference)
