"""What the impact-robust term is held against: a stiffer nominal controller, and two published ways."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray

from impact_posture.robot.robot import Robot
from impact_posture.simulation.driver import Driver
from impact_posture.simulation.reference import ReferencePoint
from impact_posture.simulation.scenario import Setup
from impact_posture.simulation.scenario_objective import Gradient
from impact_posture.simulation.sensor_noise import Reading
from impact_posture.tsid.controller import Command
from impact_posture.tsid.impact_robust import ImpactRobustPosture
from impact_posture.tsid.points import Point
from impact_posture.tsid.posture_tasks import JointPosture, smooth
from impact_posture.tsid.state import State

Array = NDArray[np.float64]

# Of the central differences of the gradient, rad.
_STEP = 1e-5


class StiffPosture(JointPosture):
    """``ν̇* = K (q_des ⊖ q) − D ν`` with ``K = K_p + K_r ∇²H(q_des)/λ`` and ``D = 2 K^½``: the term's gain.

    An impact-robust term that stays on pulls back like a spring ``K_r ∇²H/λ`` when the robot is pushed away from
    where it rests.  This nominal controller has that spring from the start, critically damped, and no better posture:
    what the term gains over it, the posture gains.  ``∇²H`` is symmetrized; the base of a floating robot, which other
    tasks lead, is left out, and so is negative curvature: there the term is no spring, and ``K`` stays at ``K_p``.

    Attributes:
        stiffness: ``K``, 1/s², shape (nv, nv), once reset.
        damping: ``D``, 1/s, likewise.
    """

    def __init__(
        self,
        robot: Robot,
        gradient: Gradient,
        K: float,
        kp: ArrayLike,
        base_weight: float | None,
        weight: ArrayLike = 1.0,
    ) -> None:
        """Take the gradient whose curvature counts, and the gains.

        Args:
            robot: The robot.
            gradient: ``q → (H, ∇H)``.
            K: ``K_r``, 1/s².
            kp: ``K_p``, 1/s².
            base_weight: Weight of the base's entries in the cost.
            weight: Of the others.
        """
        super().__init__(robot, kp=kp, weight=weight, base_weight=base_weight)
        self._gradient, self._K = gradient, K
        # Only for its scale λ: normalized as the term would be.
        self._like = ImpactRobustPosture(robot, gradient, K=K, kp=kp)
        self.stiffness, self.damping = np.diag(self.kp), np.diag(self.kd)

    def stiffen(self, state: State, redundancy: Array) -> None:
        """Measure the curvature at ``state``, with ``redundancy`` as in :meth:`ImpactRobustPosture.normalize`."""
        self._like.normalize(state, redundancy)
        columns = []
        for unit in np.eye(state.nv):
            ahead = np.array(self._gradient(pin.integrate(self._model, state.q, _STEP * unit))[1])
            behind = np.array(self._gradient(pin.integrate(self._model, state.q, -_STEP * unit))[1])
            columns.append((ahead - behind) / (2 * _STEP))
        curvature = np.column_stack(columns)
        added = self._K / self._like.scale * (curvature + curvature.T) / 2
        if self._robot.floating:
            added[:6], added[:, :6] = 0.0, 0.0
        values, vectors = np.linalg.eigh(added)
        stiffness = np.diag(self.kp) + (vectors * np.maximum(values, 0.0)) @ vectors.T
        self.stiffness = (stiffness + stiffness.T) / 2
        values, vectors = np.linalg.eigh(self.stiffness)
        self.damping = (vectors * (2 * np.sqrt(np.maximum(values, 0.0)))) @ vectors.T

    def desired(self, state: State) -> Array:
        """``ν̇*``, shape (nv,)."""
        return np.asarray(self.stiffness @ self.error(state) - self.damping @ state.v)


class StiffDriver(Driver):
    """Nominal, with the gains of :class:`StiffPosture`."""

    posture: StiffPosture

    def reset(self, q: Array) -> Command:
        """Begin at rest; measure the curvature there."""
        super().reset(q)
        state = self.controller.state
        self.posture.stiffen(state, self.controller.assembly.redundancy(state))
        return super().reset(q)


class FlowPosture(JointPosture):
    """Walker's projected gradient at the level of velocities (Walker 1994), made the reference of a posture task.

    ``ν_ref = −α k Z Zᵀ ∇H/λ`` with ``Z`` a basis of what the other tasks leave; ``q_des`` is ``ν_ref`` integrated
    and ``ν_ref`` the velocity reference.  ``k = K/K_d`` makes the flow as fast as the impact-robust term, with its
    gain K, would be on its way; bound and fade towards joint limits are that term's.

    Attributes:
        term: Whose gradient, scale, bound and activation are used; it is no task itself.
    """

    def __init__(
        self, robot: Robot, term: ImpactRobustPosture, base_weight: float | None, weight: ArrayLike = 1.0
    ) -> None:
        """Take the gains from a term."""
        super().__init__(robot, kp=term.kp, kd=term.kd, weight=weight, base_weight=base_weight)
        self.term = term
        self._flow = np.zeros(robot.nv)
        self._basis: Array | None = None
        self._count = 0

    def reset(self, state: State) -> None:
        """Hold what is there."""
        super().reset(state)
        self.term.reset(state)
        self._basis, self._count = None, 0
        self._flow[:] = 0.0

    def lead(self, basis: Array) -> None:
        """Flow within the columns of ``basis`` from now on, shape (nv, r)."""
        self._basis = basis

    def advance(self, state: State, dt: float) -> None:
        """Move ``q_des`` on."""
        super().advance(state, dt)
        self.term.advance(state, dt)
        level = self.term.activation.level
        if self._basis is None or level <= 0:
            self._flow[:] = 0.0
            return
        wanted = level * self.term.term / np.maximum(self.kd, 1e-9)
        self._flow = self._basis @ (self._basis.T @ wanted)
        self._target[:] = pin.integrate(self._model, self._target, dt * self._flow)

    def desired(self, state: State) -> Array:
        """``ν̇*``, shape (nv,), with the flow as velocity reference."""
        return super().desired(state) + self.kd * self._flow


class WalkerDriver(Driver):
    """Nominal, with the posture's reference flowing down the gradient."""

    posture: FlowPosture

    def reset(self, q: Array) -> Command:
        """Begin at rest; measure the term's scale there."""
        command = super().reset(q)
        state = self.controller.state
        self._free = self.controller.assembly.redundancy(state)
        self.posture.term.normalize(state, self._free)
        self._ticks = 0
        return command

    def tick(self, reading: Reading, reference: ReferencePoint | None = None) -> Command:
        """The command; what the tasks leave is found anew as often as the gradient."""
        if self.level > 0:
            if self._ticks % self.posture.term.every == 0:
                self._free = self.controller.assembly.redundancy(self.controller.state)
            self._ticks += 1
        self.posture.lead(self._free)
        return super().tick(reading, reference)

    def brace(self) -> None:
        """Let it flow."""
        self.posture.term.brace()

    def hold(self) -> None:
        """Stop the flow; hold the reached posture, center of mass and base orientation."""
        self.posture.term.contact()
        # The reference has gone ahead wherever other tasks kept the robot back.
        self.posture.move_to(self.controller.state.q, self.posture.term.activation.ramp)
        self._freeze()

    @property
    def level(self) -> float:
        """Activation of the flow."""
        return self.posture.term.activation.level


class InvariantDriver(Driver):
    """Feedback on the impact-invariant subspace around an impact (Yang and Posa 2021).

    No impulse at the contact changes the component of ν in the null space of ``J M⁻¹``.  Around the impact the
    feedback sees ``ν̂ = ν + α M⁻¹Jᵀ λ*``, with ``λ*`` the impulse that brings the tasks' velocities
    nearest to what they are asked for: what an impulse may have done is not fought.  The posture task has no say in
    ``λ*`` beside others: it asks for rest while they move.  ``M⁻¹`` is contact-consistent for a robot that stands.
    ``α`` is 1 from ``BEFORE`` before the impact, expected or felt, to ``AFTER`` after it, with smooth flanks of
    ``FLANK`` (s).
    """

    BEFORE, AFTER, FLANK = 0.02, 0.05, 0.03
    # What is felt as an impact, N.
    FELT = 5.0

    def __init__(self, setup: Setup, posture: JointPosture) -> None:
        """Build the nominal controller."""
        super().__init__(setup, posture)
        self._point = Point(setup.scenario.task.frame, setup.scenario.offset)
        points = (*self.controller.formulation.points, self._point)
        self._aside = State(setup.robot, tuple(dict.fromkeys(points)))
        self._at, self._felt = -np.inf, False

    def reset(self, q: Array) -> Command:
        """Begin at rest."""
        self._at, self._felt = -np.inf, False
        return super().reset(q)

    def expect(self, t: float) -> None:
        """Go around this time, unless the impact is felt."""
        self._at, self._felt = t, False

    def tick(self, reading: Reading, reference: ReferencePoint | None = None) -> Command:
        """The command for the velocity without what an impulse could have changed."""
        if reference is not None:
            # What is asked for now is what the error is measured from.
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
        """``α`` at a time."""
        since = t - self._at
        left = max(-self.BEFORE - since, since - self.AFTER, 0.0)
        return smooth(1 - left / self.FLANK) if left < self.FLANK else 0.0

    def _correction(self, reading: Reading) -> Array:
        state, formulation = self._aside.update(reading.q, reading.v), self.controller.formulation
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
