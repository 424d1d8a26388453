"""Published controllers for impacts: impact-invariant feedback, reference spreading, and impact-aware limits."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from impact_posture.simulation.controllers.contact_reference import ReferencePoint
from impact_posture.simulation.controllers.driver import Driver
from impact_posture.simulation.setup import Setup
from impact_posture.simulation.world.sensor_noise import Reading
from impact_posture.system.arrays import Array
from impact_posture.tsid.controller import Command, Controller
from impact_posture.tsid.limits.impact_limits import ImpactLimits, supported_inverse
from impact_posture.tsid.point_kinematics import Point
from impact_posture.tsid.state import State
from impact_posture.tsid.tasks.joint_posture import JointPosture


class ImpactFeedbackDriver(Driver):
    """Nominal controller whose velocity feedback depends on the time of the impact.

    The time of the impact is the expected time, or the time at which a force sensor measures more than ``FELT`` (N)
    during an approach.
    """

    FELT = 5.0
    # A force that acts more than this time before the expected impact belongs to the previous impact, s.
    EARLY = 0.2

    def __init__(self, setup: Setup, posture: JointPosture) -> None:
        super().__init__(setup, posture)
        self._point = Point(setup.scenario.task.frame, setup.scenario.offset)
        points = (*self.controller.formulation.points, self._point)
        self._state = State(setup.robot, tuple(dict.fromkeys(points)))
        self._at, self._felt = np.inf, False

    def reset(self, q: Array) -> Command:
        self._at, self._felt = np.inf, False
        self._lead(None)
        return super().reset(q)

    def expect(self, t: float) -> None:
        self._at, self._felt = t, False

    def _feel(self, reading: Reading) -> bool:
        """Update the time of the impact from the force sensor.  Return whether a contact force acts now."""
        acts = reading.force is not None and float(np.linalg.norm(reading.force)) > self.FELT
        if acts and not self._felt and reading.t > self._at - self.EARLY:
            self._at, self._felt = reading.t, True
        return acts

    def _lead(self, reference: ReferencePoint | None) -> None:
        """Set the end effector's targets to ``reference``, and the target velocities of other tasks to zero."""
        for task in self.controller.formulation.tasks:
            task.target_velocity = np.zeros(task.size)
        if reference is not None:
            self._follow(reference)

    def _command(self, reading: Reading, shift: Array | None) -> Command:
        """Return the command with the velocity feedback of ``ν + shift``, where ``shift`` has the shape (nv,)."""
        if shift is not None:
            for task in self.controller.formulation.tasks:
                task.target_velocity = task.target_velocity - task.jacobian(self._state) @ shift
        return self.controller.tick(reading.t, reading.q, reading.v, reading.force)


class InvariantDriver(ImpactFeedbackDriver):
    """Feedback on the impact-invariant subspace around an impact (Yang and Posa 2021).

    An impulse at the contact changes ν only in the range of ``M⁻¹Jᵀ``.  Around the impact, the velocity feedback of
    every task uses ``ν + α M⁻¹Jᵀ λ*`` instead of ν.  The feedback then does not oppose velocities that an impulse
    can cause.  ``λ*`` minimizes ``‖ẏ_des − J_y (ν + M⁻¹Jᵀ λ)‖``.  If the time ``t`` is within ``T`` = ``WINDOW`` (s)
    of the impact at ``t*``, then ``α = 1 − exp(−(T − |t − t*|)/τ)`` with ``τ`` = ``FADE`` (s); otherwise, α is 0.

    There are three differences from the paper:

    1. A force sensor corrects the scheduled time ``t*`` of the impact.
    2. The posture task affects ``λ*`` only without other tasks, because the posture target rests while other
       targets move.  The paper has no redundant posture.
    3. The impulses at standing feet follow from the impulse at the contact (``M⁻¹`` contains the constraints of the
       feet).  In the paper, the impulses at the feet are free variables.  On our robots, free impulses at the feet
       could cause every velocity of center of mass and base, so the feedback of these tasks would vanish.
    """

    WINDOW, FADE = 0.05, 0.0025

    def tick(self, reading: Reading, reference: ReferencePoint | None = None) -> Command:
        self._feel(reading)
        self._lead(reference)
        share = self.share(reading.t)
        return self._command(reading, share * self._correction(reading) if share > 0 else None)

    def share(self, t: float) -> float:
        """Return the weight ``α`` at time ``t``, s."""
        left = self.WINDOW - abs(t - self._at)
        return float(-np.expm1(-left / self.FADE)) if left > 0 else 0.0

    def _correction(self, reading: Reading) -> Array:
        state, formulation = self._state.update(reading.q, reading.v), self.controller.formulation
        change = supported_inverse(state, formulation.contacts) @ state.at(self._point).jacobian[:3].T
        leading = [task for task in formulation.tasks if task is not self.posture] or [self.posture]
        J = np.vstack([task.jacobian(state) for task in leading])
        error = np.concatenate([task.target_velocity for task in leading]) - J @ reading.v
        impulse = np.linalg.lstsq(J @ change, error, rcond=1e-9)[0]
        return np.asarray(change @ impulse)


class ReferenceSpreadingDriver(ImpactFeedbackDriver):
    """Time-invariant reference spreading with an interim mode (van Steen et al. 2024).

    The end effector has three references for its distance ``s`` along the approach:

    - Before the impact, the target speed is a function of the position: ``√(2 a s)``, at most the speed of the
      scenario.  The reference continues behind the surface, in case the impact is late.  There is no position
      feedback along the approach.
    - The interim mode of the paper starts at the first touch.  The interim mode ends when the contact has lasted for
      ``SUSTAINED`` (s), or after ``INTERIM`` (s).  In the interim mode, no task has velocity feedback.  The position
      target continues with the speed before the impact, which establishes the contact.
    - After the impact, the position target moves exponentially, with the time constant ``SETTLE`` (s), to the rest
      position of the scenario.  The velocity targets of all tasks start at ``J_y ν⁺`` and decay with the same time
      constant.  ``ν⁺ = ν⁻ + Δν`` is the velocity after a rigid, inelastic impact at the velocity ``ν⁻`` before the
      touch.

    There are four differences from the paper:

    1. There is one contact instead of several simultaneous contacts, and a rebound is treated as a partial contact.
    2. ``ν⁻`` is measured, because the tasks leave redundant motions without a reference.
    3. The return motion is a function of time, as in the scenario.
    4. In a scenario without contacts, this controller is the nominal controller.
    """

    SUSTAINED, INTERIM, SETTLE = 0.005, 0.05, 0.03
    # The target speed before the impact is computed with at least this distance ``s``, m.  At ``s = 0``, the target
    # speed would be zero, and the robot would never start.
    BEGIN = 2e-3
    # Distance ``s`` of the position target, m: its value at the first touch, which increases in the interim mode.
    _touch: float
    # Duration of the contact, s.
    _lasted: float
    # Time at which the interim mode ended, s; ``None`` before this time.
    _done: float | None

    def __init__(self, setup: Setup, posture: JointPosture) -> None:
        super().__init__(setup, posture)
        task = setup.scenario.contacts
        self._speed, self._acceleration = (0.0, 0.0) if task is None else (task.speed, task.acceleration)
        self._impact = ImpactLimits(
            setup.robot, self._point, setup.scenario.normal, self.controller.formulation.contacts
        )

    def reset(self, q: Array) -> Command:
        self._clear()
        command = super().reset(q)
        self._origin = self._state.update(q, np.zeros(self.setup.robot.nv)).at(self._point).position.copy()
        return command

    def expect(self, t: float) -> None:
        super().expect(t)
        self._clear()

    def tick(self, reading: Reading, reference: ReferencePoint | None = None) -> Command:
        acts = self._feel(reading) if reading.force is not None else reading.t >= self._at
        state = self._state.update(reading.q, reading.v)
        if reference is None or reference.speed < 0 or not math.isfinite(self._at):
            self._lead(reference)
            return self._command(reading, None)
        distance = float(-self.setup.scenario.normal @ (state.at(self._point).position - self._origin))
        if reading.t < self._at or not (acts or self._touch):
            speed = min(math.sqrt(2 * self._acceleration * max(distance, self.BEGIN)), self._speed)
            self._before = reading.v.copy()
            self._lead(ReferencePoint(distance, speed, self._acceleration if speed < self._speed else 0.0))
            return self._command(reading, None)
        if not self._touch:
            self._touch = distance
            self._after = self._before + self._impact.jump(state)[0] @ self._before
        self._lasted = self._lasted + self.controller.period if acts else 0.0
        since = reading.t - self._at
        if self._done is None and (self._lasted >= self.SUSTAINED or since > self.INTERIM):
            self._done = reading.t
        if self._done is None:
            self._touch += self.controller.period * self._speed
            self._lead(ReferencePoint(self._touch, self._speed, 0.0))
            for task in self.controller.formulation.tasks:
                task.target_velocity = task.jacobian(state) @ reading.v
            return self._command(reading, None)
        fade = math.exp(-(reading.t - self._done) / self.SETTLE)
        self._lead(ReferencePoint(reference.distance + fade * (self._touch - reference.distance), 0.0, 0.0))
        return self._command(reading, -fade * self._after)

    def _clear(self) -> None:
        self._touch, self._lasted, self._done = 0.0, 0.0, None
        self._before = self._after = np.zeros(self.setup.robot.nv)


class ImpactAwareDriver(Driver):
    """Nominal controller with limits on joint velocities and impulsive torques after an impact (Wang et al. 2020).

    From the start of an approach until the return, each tick satisfies
    :class:`~impact_posture.tsid.limits.impact_limits.ImpactLimits`, as if the impact happened in the next tick.  The
    approach is therefore at most as fast as the limits of the robot allow.  If the limits allow the speed of the
    scenario, the commands are the same as from the nominal controller.

    There are two differences from the paper.  First, limits that the present state violates are relaxed in the same
    way as joint limits; the paper does not treat violated limits.  Second, the forces at the feet during the impact
    are not limited.  In the paper, standing feet also satisfy zero-moment point and friction constraints during the
    impact.
    """

    def __init__(self, setup: Setup, posture: JointPosture) -> None:
        super().__init__(setup, posture)
        formulation, period = self.controller.formulation, setup.scenario.control.period
        point = Point(setup.scenario.task.frame, setup.scenario.offset)
        contacts = formulation.contacts
        self.limits = ImpactLimits(setup.robot, point, setup.scenario.normal, contacts, period=period)
        self.controller = Controller(setup.robot, replace(formulation, row_limits=(self.limits,)), period=period)

    def reset(self, q: Array) -> Command:
        self.limits.active = False
        return super().reset(q)

    def expect(self, t: float) -> None:
        self.limits.active = True

    def tick(self, reading: Reading, reference: ReferencePoint | None = None) -> Command:
        if reference is not None and reference.speed < 0:
            self.limits.active = False
        return super().tick(reading, reference)
