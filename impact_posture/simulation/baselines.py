"""Controllers to compare the impact-robust term with: a stiffer nominal controller, and two published methods."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin

from impact_posture.arrays import Array
from impact_posture.errors import InputError
from impact_posture.robot.robot import Robot
from impact_posture.simulation.driver import Driver, RobustDriver
from impact_posture.simulation.reference import ReferencePoint
from impact_posture.simulation.scenario import Setup
from impact_posture.simulation.scenario_objective import Gradient
from impact_posture.simulation.sensor_noise import Reading
from impact_posture.tsid.controller import Command
from impact_posture.tsid.impact_robust import ImpactRobustPosture, curvature, curvature_scale
from impact_posture.tsid.points import Point
from impact_posture.tsid.posture_tasks import JointPosture
from impact_posture.tsid.smooth_step import smooth
from impact_posture.tsid.state import State


class StiffPosture(JointPosture):
    """``ν̇* = K (q_des ⊖ q) − D ν`` with ``K = K_p + K_r ∇²H(q_des)/λ`` and ``D = 2 K^½``.

    An impact-robust term that stays on pulls like a spring ``K_r ∇²H/λ`` when the robot is pushed away from its rest
    posture.  This nominal controller has that spring from the start, critically damped, but no better posture.  The
    term gains over it by the posture alone.  ``∇²H`` is symmetrized.  The base of a floating robot is left out,
    because other tasks control it.  Negative curvature is left out, because the term is no spring there.

    Attributes:
        stiffness: ``K`` after a reset, 1/s², shape (nv, nv).
        damping: ``D`` after a reset, 1/s, shape (nv, nv).
    """

    def __init__(self, robot: Robot, gradient: Gradient, K: float, **options: Any) -> None:
        """Set the gradient, whose curvature counts, and the gains.

        Args:
            robot: The robot.
            gradient: ``q → (H, ∇H)``.
            K: ``K_r``, 1/s².
            options: As of :class:`~impact_posture.tsid.posture_tasks.JointPosture`; the damping is not used.

        Raises:
            InputError: A gain is negative or not finite.
        """
        super().__init__(robot, **options)
        if not 0 <= K < np.inf:
            raise InputError("the gain K is out of range", where=self.name, hint="give a number from zero up")
        self._gradient, self._K = gradient, K
        self.stiffness, self.damping = np.diag(self.kp), np.diag(self.kd)

    def stiffen(self, state: State, redundancy: Array) -> None:
        """Measure the curvature at a state, with the scale λ of an impact-robust term (:func:`curvature_scale`)."""
        scale = curvature_scale(self._gradient, self._model, state.q, redundancy, self.name)
        hessian = curvature(self._gradient, self._model, state.q, np.eye(state.nv))
        added = self._K / scale * (hessian + hessian.T) / 2
        if self._robot.floating:
            added[:6], added[:, :6] = 0.0, 0.0
        values, vectors = np.linalg.eigh(added)
        stiffness = np.diag(self.kp) + (vectors * np.maximum(values, 0.0)) @ vectors.T
        self.stiffness = (stiffness + stiffness.T) / 2
        values, vectors = np.linalg.eigh(self.stiffness)
        self.damping = (vectors * (2 * np.sqrt(np.maximum(values, 0.0)))) @ vectors.T

    def desired(self, state: State) -> Array:
        """Return ``ν̇*``, shape (nv,)."""
        return np.asarray(self.stiffness @ self.error(state) - self.damping @ state.v)


class StiffDriver(Driver):
    """Nominal controller with the gains of :class:`StiffPosture`."""

    posture: StiffPosture

    def reset(self, q: Array) -> Command:
        """Begin at rest, and measure the curvature there."""
        super().reset(q)
        state = self.controller.state
        self.posture.stiffen(state, self.controller.assembly.redundancy(state))
        return super().reset(q)


class FlowPosture(JointPosture):
    """Projected gradient flow of Walker 1994 as the reference of a posture task.

    ``ν_ref = −α k Z Zᵀ ∇H/λ``, where the columns of ``Z`` span what the other tasks leave free.  ``q_des`` is the
    integral of ``ν_ref``, and ``ν_ref`` is the velocity reference.  ``k = K/K_d`` makes the flow as fast as the
    impact-robust term with the gain K would be.  It has the bound and the fade near joint limits of that term.

    Attributes:
        term: The impact-robust term whose gradient, scale, bound and activation are used.  It is no task itself.
        basis: ``Z``, shape (nv, r); without it, nothing flows.
    """

    def __init__(self, robot: Robot, term: ImpactRobustPosture) -> None:
        """Set the gains and weights of the term."""
        super().__init__(robot, kp=term.kp, kd=term.kd, weight=term.weight)
        self.term = term
        self._flow = np.zeros(robot.nv)
        self.basis: Array | None = None

    def reset(self, state: State) -> None:
        """Hold the present posture."""
        super().reset(state)
        self.term.reset(state)
        self.basis = None
        self._flow[:] = 0.0

    def advance(self, state: State, dt: float) -> None:
        """Move ``q_des``."""
        super().advance(state, dt)
        self.term.advance(state, dt)
        level = self.term.activation.level
        if self.basis is None or level <= 0:
            self._flow[:] = 0.0
            return
        wanted = level * self.term.term / np.maximum(self.kd, 1e-9)
        self._flow = self.basis @ (self.basis.T @ wanted)
        self._target[:] = pin.integrate(self._model, self._target, dt * self._flow)

    def desired(self, state: State) -> Array:
        """Return ``ν̇*``, shape (nv,), with the flow as velocity reference."""
        return super().desired(state) + self.kd * self._flow


class WalkerDriver(RobustDriver):
    """Nominal controller whose posture reference flows down the gradient."""

    posture: FlowPosture

    def reset(self, q: Array) -> Command:
        """Begin at rest, and measure the scale of the term there."""
        command = super().reset(q)
        state = self.controller.state
        self.posture.basis = self.controller.assembly.redundancy(state)
        self.term.normalize(state, self.posture.basis)
        self._ticks = 0
        return command

    def tick(self, reading: Reading, reference: ReferencePoint | None = None) -> Command:
        """Return the command.  The redundancy is computed as often as the gradient."""
        if self.level > 0:
            if self._ticks % self.term.every == 0:
                self.posture.basis = self.controller.assembly.redundancy(self.controller.state)
            self._ticks += 1
        return super().tick(reading, reference)

    def hold(self) -> None:
        """Stop the flow and hold the present posture, center of mass and base orientation."""
        super().hold()
        # The reference is ahead of the robot wherever other tasks kept the robot back.
        self.posture.move_to(self.controller.state.q, self.term.activation.ramp)


class InvariantDriver(Driver):
    """Feedback on the impact-invariant subspace around an impact (Yang and Posa 2021).

    An impulse at the contact does not change the component of ν in the null space of ``J M⁻¹``.  Around the impact,
    the feedback gets ``ν̂ = ν + α M⁻¹Jᵀ λ*``.  The impulse ``λ*`` brings the velocities of the tasks nearest to their
    targets, so the feedback does not fight what an impulse may have done.  The posture task does not count for ``λ*``
    if there are others, because its target is rest while they move.  For a robot that stands, ``M⁻¹`` is
    contact-consistent.  ``α`` is 1 from ``BEFORE`` before the expected or felt impact to ``AFTER`` after it, with
    smooth flanks of ``FLANK`` (s).
    """

    BEFORE, AFTER, FLANK = 0.02, 0.05, 0.03
    # Force that counts as an impact, N.
    FELT = 5.0

    def __init__(self, setup: Setup, posture: JointPosture) -> None:
        """Build the nominal controller."""
        super().__init__(setup, posture)
        self._point = Point(setup.scenario.task.frame, setup.scenario.offset)
        points = (*self.controller.formulation.points, self._point)
        self._state = State(setup.robot, tuple(dict.fromkeys(points)))
        self._at, self._felt = -np.inf, False

    def reset(self, q: Array) -> Command:
        """Begin at rest."""
        self._at, self._felt = -np.inf, False
        return super().reset(q)

    def expect(self, t: float) -> None:
        """Expect an impact at a time, s.  One that is felt earlier or later moves the time."""
        self._at, self._felt = t, False

    def tick(self, reading: Reading, reference: ReferencePoint | None = None) -> Command:
        """Return the command for a velocity without the change that an impulse may have caused."""
        if reference is not None:
            # The error is measured from the present targets.
            self._follow(reference)
        if reading.force is not None and not self._felt and reading.t > self._at - 0.2:
            if float(np.linalg.norm(reading.force)) > self.FELT:
                self._at, self._felt = reading.t, True
        share = self.share(reading.t)
        if share > 0:
            v = reading.v + share * self._correction(reading)
            reading = Reading(reading.t, reading.q, v, reading.force)
        return super().tick(reading, reference)

    def share(self, t: float) -> float:
        """Return ``α`` at a time, s."""
        since = t - self._at
        left = max(-self.BEFORE - since, since - self.AFTER, 0.0)
        return smooth(1 - left / self.FLANK) if left < self.FLANK else 0.0

    def _correction(self, reading: Reading) -> Array:
        """Return ``M⁻¹Jᵀ λ*``, shape (nv,)."""
        state, formulation = self._state.update(reading.q, reading.v), self.controller.formulation
        inverse = np.linalg.inv(state.M)
        if formulation.contacts:
            feet = np.vstack([state.at(c.point).jacobian[: c.size] for c in formulation.contacts])
            held = feet @ inverse
            inverse = inverse - held.T @ np.linalg.pinv(held @ feet.T, rcond=1e-6, hermitian=True) @ held
        change = inverse @ state.at(self._point).jacobian[:3].T
        leading = [task for task in formulation.tasks if task is not self.posture] or [self.posture]
        J = np.vstack([task.jacobian(state) for task in leading])
        error = np.concatenate([task.target_velocity for task in leading]) - J @ reading.v
        impulse = np.linalg.lstsq(J @ change, error, rcond=1e-9)[0]
        return np.asarray(change @ impulse)
