"""Published controllers for impacts: invariant feedback, reference spreading, and impact-aware limits."""

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

    The impact is at the expected time, or when a force sensor feels more than ``FELT`` (N) in an approach.
    """

    FELT = 5.0
    # A force earlier than this before the expected time belongs to the previous impact, s.
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
        """Set the time of an impact that the force sensor feels.  Return whether the impact acts now."""
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
        """Return the command with the velocity feedback of ``ν + shift``, where ``shift`` has the shape (nv,)."""
        if shift is not None:
            for task in self.controller.formulation.tasks:
                task.target_velocity = task.target_velocity - task.jacobian(self._state) @ shift
        return self.controller.tick(reading.t, reading.q, reading.v, reading.force)


class InvariantDriver(ImpactFeedbackDriver):
    """Feedback on the impact-invariant subspace around an impact (Yang and Posa 2021).

    An impulse at the contact does not change the component of ν in the null space of ``J M⁻¹``.  Around the impact,
    the velocity feedback of every task uses ``ν + α M⁻¹Jᵀ λ*`` instead of ν.  So it does not oppose a velocity that
    an impulse may have caused.  ``λ*`` minimizes ``‖ẏ_des − J_y (ν + M⁻¹Jᵀ λ)‖``.  Within ``T`` = ``WINDOW`` (s) of
    the impact at ``t*``, ``α = 1 − exp(−(T − |t − t*|)/τ)`` with ``τ`` = ``FADE`` (s).

    Differences from the paper: a force sensor moves ``t*``, instead of a schedule.  The posture task does not count
    for ``λ*`` if there are other tasks, because its target is at rest while they move.  The paper has no redundant
    posture.  Standing feet react to the impulse (``M⁻¹`` is contact-consistent).  In the paper, their impulses are
    free.  Here, free impulses could explain every velocity of center of mass and base, and would leave no feedback.
    """

    WINDOW, FADE = 0.05, 0.0025

    def tick(self, reading: Reading, reference: ReferencePoint | None = None) -> Command:
        self._feel(reading)
        self._lead(reference)
        share = self.share(reading.t)
        return self._command(reading, share * self._correction(reading) if share > 0 else None)

    def share(self, t: float) -> float:
        """Return ``α`` at time ``t``, s."""
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


class ReferenceSpreadingDriver(ImpactFeedbackDriver):
    """Time-invariant reference spreading with an interim mode (van Steen et al. 2024).

    The end effector has three references along its distance ``s`` into the surface:

    - Before the impact, the speed is a function of the position, ``√(2 a s)`` up to the speed of the scenario.  It
      continues behind the surface, so a late impact meets the same reference.  There is no position error along the
      approach.
    - The interim mode lasts from the first touch until the contact has lasted for ``SUSTAINED`` (s), at most
      ``INTERIM`` (s).  No task has velocity feedback.  The position follows the integral of the speed before the
      impact, which completes the contact.
    - After the impact, the position fades to the rest position of the scenario with the time constant ``SETTLE`` (s).
      The velocity targets of all tasks begin at ``J_y ν⁺`` and fade likewise.  ``ν⁺ = ν⁻ + Δν`` follows from a rigid,
      inelastic impact at the velocity before the touch.

    Differences from the paper: there is one contact instead of several simultaneous contacts.  A rebound counts as a
    partial contact.  ``ν⁻`` is measured, because the tasks leave a redundancy without a reference.  The return
    follows the scenario in time.  Without contacts, this is the nominal controller.  Longer modes let the robot move
    more, because this controller avoids feedback and not motion.
    """

    SUSTAINED, INTERIM, SETTLE = 0.005, 0.05, 0.03
    # Least distance for the speed before the impact, m.  At zero, the robot would never start.
    BEGIN = 2e-3
    # Distance of the touch, which the interim mode advances; duration of the contact; end of the interim mode.
    _touch: float
    _lasted: float
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
    """Nominal controller with limits of post-impact rates and impulsive torques (Wang et al. 2020).

    From the begin of an approach until the return, each tick obeys
    :class:`~impact_posture.tsid.limits.impact_limits.ImpactLimits`, as if the impact came at the next tick.  So the
    approach is only as fast as the limits of the robot allow.  If they allow the speed of the scenario, this is the
    nominal controller.

    Differences from the paper: limits that the present state violates give way, like limits of the joints.  The paper
    does not treat this case.  It also keeps the zero-moment point and the friction of standing feet through the
    impact.  Here, the feet react without limits.
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
