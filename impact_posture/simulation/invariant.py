"""Feedback on the impact-invariant subspace, and the base of controllers that expect and feel an impact."""

from __future__ import annotations

import numpy as np

from impact_posture.arrays import Array
from impact_posture.simulation.driver import Driver
from impact_posture.simulation.reference import ReferencePoint
from impact_posture.simulation.scenario import Setup
from impact_posture.simulation.sensor_noise import Reading
from impact_posture.tsid.controller import Command
from impact_posture.tsid.impact_limits import supported_inverse
from impact_posture.tsid.points import Point
from impact_posture.tsid.posture_tasks import JointPosture
from impact_posture.tsid.state import State


class ImpactFeedbackDriver(Driver):
    """Nominal controller whose velocity feedback depends on the time of the impact.

    The impact is at the expected time, or when a force sensor feels more than ``FELT`` (N) in an approach.
    """

    FELT = 5.0
    # An impact that is felt longer before the expected time belongs to the one before, s.
    EARLY = 0.2

    def __init__(self, setup: Setup, posture: JointPosture) -> None:
        """Build the nominal controller."""
        super().__init__(setup, posture)
        self._point = Point(setup.scenario.task.frame, setup.scenario.offset)
        points = (*self.controller.formulation.points, self._point)
        self._state = State(setup.robot, tuple(dict.fromkeys(points)))
        self._at, self._felt = np.inf, False

    def reset(self, q: Array) -> Command:
        """Begin at rest, without an expected impact."""
        self._at, self._felt = np.inf, False
        self._lead(None)
        return super().reset(q)

    def expect(self, t: float) -> None:
        """Expect an impact at a time, s.  One that is felt earlier or later moves the time."""
        self._at, self._felt = t, False

    def _feel(self, reading: Reading) -> bool:
        """Move the time to an impact that is felt.  Return whether the impact acts now."""
        acts = reading.force is not None and float(np.linalg.norm(reading.force)) > self.FELT
        if acts and not self._felt and reading.t > self._at - self.EARLY:
            self._at, self._felt = reading.t, True
        return acts

    def _lead(self, reference: ReferencePoint | None) -> None:
        """Set the targets of the end effector, and the target velocities of all tasks."""
        for task in self.controller.formulation.tasks:
            task.target_velocity = np.zeros(task.size)
        if reference is not None:
            self._follow(reference)

    def _command(self, reading: Reading, shift: Array | None) -> Command:
        """Return the command for a velocity feedback that gets ``ν + shift``, with a shift of shape (nv,)."""
        if shift is not None:
            for task in self.controller.formulation.tasks:
                task.target_velocity = task.target_velocity - task.jacobian(self._state) @ shift
        return self.controller.tick(reading.t, reading.q, reading.v, reading.force)


class InvariantDriver(ImpactFeedbackDriver):
    """Feedback on the impact-invariant subspace around an impact (Yang and Posa 2021).

    An impulse at the contact does not change the component of ν in the null space of ``J M⁻¹``.  Around the impact,
    the velocity feedback of every task gets ``ν + α M⁻¹Jᵀ λ*`` instead of ν, so it does not fight what an impulse may
    have done.  ``λ*`` minimizes ``‖ẏ_des − J_y (ν + M⁻¹Jᵀ λ)‖``.  ``α = 1 − exp(−(T − |t − t*|)/τ)`` within ``T`` =
    ``WINDOW`` (s) of the impact at ``t*``, with ``τ`` = ``FADE`` (s).

    Adapted: a force sensor moves ``t*``, where the paper has a schedule.  The posture task does not count for ``λ*``
    if there are others, because its target is rest while they move.  The paper tracks no redundant posture.  Feet
    that stand react to the impulse (``M⁻¹`` is contact-consistent).  The paper counts their impulses as free, too.
    Here, free impulses could explain every velocity of center of mass and base, and would leave no feedback.
    """

    WINDOW, FADE = 0.05, 0.0025

    def tick(self, reading: Reading, reference: ReferencePoint | None = None) -> Command:
        """Return the command, with a velocity feedback that impulses do not change."""
        self._feel(reading)
        self._lead(reference)
        share = self.share(reading.t)
        return self._command(reading, share * self._correction(reading) if share > 0 else None)

    def share(self, t: float) -> float:
        """Return ``α`` at a time, s."""
        left = self.WINDOW - abs(t - self._at)
        return float(-np.expm1(-left / self.FADE)) if left > 0 else 0.0

    def _correction(self, reading: Reading) -> Array:
        """Return ``M⁻¹Jᵀ λ*``, shape (nv,)."""
        state, formulation = self._state.update(reading.q, reading.v), self.controller.formulation
        change = supported_inverse(state, formulation.contacts) @ state.at(self._point).jacobian[:3].T
        leading = [task for task in formulation.tasks if task is not self.posture] or [self.posture]
        J = np.vstack([task.jacobian(state) for task in leading])
        error = np.concatenate([task.target_velocity for task in leading]) - J @ reading.v
        impulse = np.linalg.lstsq(J @ change, error, rcond=1e-9)[0]
        return np.asarray(change @ impulse)
