"""Flow of a reference posture to lower impacts, with limited speed, while contacts and tasks hold."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pinocchio as pin

from impact_posture.errors import MetricError
from impact_posture.robot.robot import Robot
from impact_posture.system.arrays import Array
from impact_posture.tsid.actuators import Actuators
from impact_posture.tsid.flow.flow_direction import FlowDirection, FlowOptions
from impact_posture.tsid.flow.flow_governor import FlowGovernor, limited
from impact_posture.tsid.flow.flow_probes import ProbeDirections
from impact_posture.tsid.flow.redundancy import Redundancy
from impact_posture.tsid.flow.static_controls import StaticControls, support_edges
from impact_posture.tsid.flow.zero_moment_point import ZeroMomentPoint
from impact_posture.tsid.qp.quadratic_program import stacked_rows
from impact_posture.tsid.state import State
from impact_posture.tsid.task_formulation import TaskFormulation
from impact_posture.tsid.tasks.body_tasks import BaseOrientation, CenterOfMass
from impact_posture.tsid.tasks.frame_tasks import FramePose, FramePosition
from impact_posture.tsid.tasks.impact_robust import Gradient
from impact_posture.tsid.tasks.task import Task

# Step of the finite differences along the redundancy, rad.
PROBE = 1e-4
# Curvature estimates are updated only if two evaluations are at least this far apart, rad (m).
MOVED = 1e-6
# If the step towards a posture of the path is shorter than this, rad (m), the flow continues to the next posture.  A
# step is short if the flow has reached the posture, or if limits prevent this.
REACHED = 0.02
# Speed below which a flow that is off is set to rest, rad/s (m/s).
STILL = 1e-5
# Below this speed, rad/s (m/s), the point where the flow would stop is too near for finite differences.
SLOW = 1e-3
# Number of ticks from one update of the flow to the next.
UPDATE_TICKS = 14
# ``UNTIL`` is the tick of the first change of the motion in an update.  ``SINCE`` is the number of ticks from the
# second change of the motion to the next update.
UNTIL, SINCE = 4, 3


class ReferenceFlow:
    """Saddle-free Newton flow of a reference posture ``q_r`` in the null space of contacts and tasks.

    ``H`` and ``∇H`` are evaluated at ``q_r`` and not at the measured posture.  Noise, tracking errors and the impact
    therefore do not influence ``H`` and ``∇H``.

    An update takes :data:`UPDATE_TICKS` ticks.  Four of these ticks (0, 4, 11 and 13) define the motion.  Tick 0
    evaluates ``H``, ``∇H`` and the limits.  Ticks 4 and 11 change the acceleration.  Tick 13 computes the step from
    ``q_r`` at this tick and decides whether the flow rests.  The C controller does the same at these four ticks, and
    does parts of the work at the other ticks.

    Contacts stay at their places.  Strict and weighted tasks stay at their targets.  Only the ``led`` tasks (center
    of mass, base orientation) follow the flow.  Joints that ``robot.toml`` lists under ``hold`` do not move.

    Attributes:
        q: Reference posture ``q_r``, shape (nq,).
        velocity: Velocity ``u`` of ``q_r`` (``q̇_r = u``), rad/s (m/s), shape (nv,).
        acceleration: Acceleration ``u̇`` of ``q_r``, rad/s² (m/s²), shape (nv,).
        value: ``H(q_r)`` at the last update.
        start: ``H₀``, the absolute value of ``H`` at the reset.
        on: Whether the flow is switched on.
        resting: Whether the flow rests because the predicted decrease of ``H`` is too small or its ``duration`` is
            over.
        failed: Whether the last evaluation raised an exception or was not finite; the flow then brakes.
        led: Tasks that follow the flow.
        error: Errors of contacts and tasks at the last update, m and rad, then zeros for held joints.
        shares: Static controls at the last update; the actuators can hold the posture if all entries are within ±1
            (:class:`StaticControls`).
    """

    def __init__(
        self,
        robot: Robot,
        gradient: Gradient,
        formulation: TaskFormulation,
        actuators: Actuators,
        options: FlowOptions,
        path: Sequence[Array] = (),
    ) -> None:
        """Size the buffers.

        ``gradient`` is a function ``q → (H, ∇H)``.  The flow first visits the postures of ``path``, each of shape
        (nq,).  The last posture of the path may be the optimum of an offline solution.
        """
        self._model, self._gradient, self.options = robot.model, gradient, options
        self._contacts = formulation.contacts
        self._state = State(robot, formulation.points)
        self.led = tuple(t for t in formulation.weighted if isinstance(t, CenterOfMass | BaseOrientation))
        weighted = [t for t in formulation.weighted if t not in self.led]
        self._tasks = [task for level in formulation.levels for task in level] + weighted
        self._base, nv = actuators.base, robot.nv
        fixed = robot.held_entries
        self._places, count = stacked_rows([c.size for c in self._contacts] + [t.size for t in self._tasks])
        self._J, self.error = np.zeros((count + len(fixed), nv)), np.zeros(count + len(fixed))
        self._J[np.arange(count, count + len(fixed)), fixed] = 1.0
        self._static = StaticControls(actuators, self._contacts, options.share)
        self.q, self.velocity, self.acceleration = robot.posture(), np.zeros(nv), np.zeros(nv)
        self.robot, self._path = robot, tuple(path)
        self._probes = ProbeDirections(nv)
        self._tick, self._elapsed, self.resting = 0, 0.0, False

    def reset(self, q: Array) -> None:
        """Begin at rest at the posture ``q``, shape (nq,), and measure the curvature of ``H`` at ``q``.

        Raises:
            InputError: The robot has feet and a fixed base.
            MetricError: At ``q``, the gradient does not exist or ``H`` is zero.
        """
        state = self._state
        self._first, self._here = self.q.copy(), self.q.copy()
        self._wanted, self._slope = np.zeros((2, self.velocity.size))
        self._before = np.zeros_like(self._J)
        self.shares = np.zeros(self._static.limited.size)
        self._visited, self._clock = 0, 0.0
        self.rest_at(np.inf)
        self.on, self.failed = False, False
        self._probes_ahead = False
        state.update(q, None)
        kinds = {3: FramePosition, 6: FramePose}
        self._held: list[Task] = [*(kinds[c.size](c.point) for c in self._contacts), *self._tasks]
        for task, rows in zip(self._held, self._places, strict=True):
            task.reset(state)
            self._J[rows] = task.jacobian(state)
        self._turning = [(t, self._J[r]) for t, r in zip(self._held, self._places, strict=True) if not t.constant]
        self._edges, self._offsets = support_edges(state, self._contacts)
        self._zmp = ZeroMomentPoint(self._edges, self._offsets, state, self._contacts)
        self.direction = FlowDirection(self.robot, self._edges, self._static.limited.size, self.options)
        self._governor = FlowGovernor(self.direction, self.options)
        self._place_at(q)
        self.start = 1.0
        self.value, _ = self._evaluate(self.q)
        if not (np.isfinite(self.value) and self.value != 0):
            what = "the objective is zero or does not exist"
            raise MetricError(what, where="reset", hint="start at another posture")
        self.start = abs(self.value)
        self._look()
        self._probes.count = 0
        for _ in range(self._space.basis.shape[1]):
            self._probe()
        self._probes.count = 0

    def advance(self, dt: float, measured: Array) -> None:
        """Advance by ``dt`` seconds; ``measured`` is the measured configuration of the robot, shape (nq,)."""
        self._clock += dt
        self._elapsed += dt
        tick, self._tick = self._tick, (self._tick + 1) % UPDATE_TICKS
        if tick == 0:
            self._look()
        elif tick == UNTIL:
            self._govern(measured)
            self._probe()
        elif tick == UPDATE_TICKS - SINCE:
            self._govern(measured)
        elif tick == UPDATE_TICKS - 1:
            self._direct()
        self.velocity += dt * self.acceleration
        self.q[:] = pin.integrate(self._model, self.q, dt * self.velocity)
        if not self.on and np.abs(self.velocity).max() <= STILL:
            self.velocity[:] = self.acceleration[:] = 0.0

    def start_at(self, q: Array) -> None:
        """Start again at rest from the posture ``q``, shape (nq,), and keep the estimated curvature."""
        if not np.array_equal(q, self.q):
            self._place_at(q)

    def rest_at(self, after: float) -> None:
        """Come to rest within ``after`` seconds, or later if the acceleration limit requires it, and stay at rest.

        The time limit ``options.duration`` starts now.
        """
        self._deadline, self._moved, self._remains = self._clock + after, 0.0, np.inf

    @property
    def moves(self) -> bool:
        """Whether the flow is on or still moves."""
        return self.on or bool(self.velocity.any())

    def _look(self) -> None:
        """Evaluate objective, constraints and limits at ``q_r`` as predicted for the next change of acceleration.

        Update the curvature estimates from the differences to the last evaluation.
        """
        state, direction = self._state, self.direction
        dt = self._elapsed / SINCE
        ahead = pin.integrate(
            self._model, self.q, UNTIL * dt * (self.velocity + (UNTIL + 1) / 2 * dt * self.acceleration)
        )
        moved, slope, shares = pin.difference(self._model, ahead, self._here), self._slope, self.shares
        self._place(ahead)
        self._here[:] = ahead
        for task, rows in zip(self._held, self._places, strict=True):
            self.error[rows] = task.error(state)
        self.value, self._slope = self._evaluate(ahead)
        self._space = space = Redundancy.of(self._J)
        self._multipliers = space.inverse.T @ self._slope
        self._reduced = self._slope - self._J.T @ self._multipliers
        self.shares = self._static.shares(state, self._J)
        length = math.sqrt(float(moved @ moved))
        # The stored slope is zero if the gradient failed at the last evaluation.
        if length > MOVED and not self.failed and slope.any():
            self._learn(moved / length, length, slope - self._before.T @ self._multipliers, shares)
        self._before[:] = self._J
        rooms = self._offsets
        if rooms.size:
            rooms = -rooms - self.options.com_margin - self._edges @ state.center_of_mass()[0][:2]
        coasting = self._governor.flow * (self.options.speed / self.options.acceleration / 2)
        direction.limit(state, rooms, self.shares, coasting)

    def _probe(self) -> None:
        """Evaluate the reduced gradient and the static controls at a posture near the last evaluated posture.

        Update the curvature estimates from the differences.  Every second probe is at the point where the flow would
        stop, because the flow needs the slopes at this point.
        """
        if self.failed or not self._space.basis.shape[1]:
            return
        self._probes_ahead = not self._probes_ahead
        flow = self._governor.flow
        size = math.sqrt(float(flow @ flow))
        ahead = self._probes_ahead and size > SLOW
        if ahead:
            z, length = flow / size, max(size * self._governor.stopping(flow), PROBE)
        else:
            z, length = self._probes.next(self._space), PROBE
        q = pin.integrate(self._model, self._here, length * z)
        _, slope = self._evaluate(q)
        self._place(q)
        if not self.failed:
            reduced = slope - self._J.T @ self._multipliers
            self._learn(z, length, reduced, self._static.shares(self._state, self._J))
            self._probes.count += not ahead

    def _learn(self, z: Array, length: float, reduced: Array, shares: Array) -> None:
        """Update the curvature estimates by the differences to the last evaluated posture.

        ``reduced`` and ``shares`` are the reduced gradient and the static controls at the distance ``length`` along
        the unit vector ``z``.
        """
        self.direction.learn(z, (reduced - self._reduced) / length, (shares - self.shares) / length)

    def _direct(self) -> None:
        """Compute the step, and decide whether the flow rests."""
        self._wanted[:] = 0.0
        if self.failed:
            return
        if self._visited < len(self._path):
            remaining = pin.difference(self._model, self.q, self._path[self._visited])
            before = self.direction.failures
            self._wanted[:] = self.direction.towards(self._space.basis, remaining)
            self._visited += int(self.direction.failures == before and np.abs(self._wanted).max() < REACHED)
            return
        offset = pin.difference(self._model, self._first, self._here)
        self._wanted[:] = self.direction.newton(self._space, self._slope, self.value / self.start, offset, self.error)
        gain, least = self.direction.gain, self.options.epsilon
        self.resting = gain < (4 * least if self.resting else least) or self._remains <= 0.0
        if self.resting:
            # With a zero step, the governor brakes the flow without raising H.
            self._wanted[:] = 0.0

    def _govern(self, measured: Array) -> None:
        """Set the acceleration within all limits, including the acceleration of the return to contacts and tasks."""
        options = self.options
        period, self._elapsed = self._elapsed, 0.0
        if not period > 0:
            # No time has passed since the previous change, so the acceleration is undefined.
            return
        error = np.abs(pin.difference(self._model, measured, self.q)[self._base :]).max(initial=0.0)
        fastest = options.speed * max(1.0 - error / options.tracking, 0.0)
        if self.on and not self.resting and self._visited == len(self._path):
            self._moved += period
        # The flow keeps its speed until the next change.  From the next change on, 2/5 of the largest acceleration
        # must suffice to stop the flow in the remaining time.
        self._remains = min(self._deadline - self._clock, options.duration - self._moved) - 2 * period
        fastest = min(fastest, 0.4 * options.acceleration * max(self._remains, 0.0))
        if not self.on:
            fastest = 0.0
        governor = self._governor
        # The constraints change with the posture, and the projection on them can speed up a joint.
        governor.flow = limited(self._space.project(governor.flow), options.speed)
        descends = fastest > 0 and self._visited == len(self._path)
        slope = self._slope if descends else None
        back = governor.back(self._space.back(self.error, self._base), period)
        rate = np.zeros(self.error.size)
        for task, rows in zip(self._held, self._places, strict=True):
            rate[rows] = task.target_velocity
        along = self._space.back(rate, self._base) if rate.any() else 0.0
        known = (governor.flow + back + along - self.velocity) / period
        self._zmp.limit(self._state, known)
        change, brakes = governor.change(self._space, self._wanted, fastest, period, slope, self._zmp)
        # Braking may use a larger fraction of the remaining range of the actuators than acceleration.
        most = (1 + options.haste) / 2 if brakes else options.haste
        part = self._static.permitted(self._state.M, known, change / period, self.shares, most)
        self.acceleration[:] = known + governor.take(change, part) / period

    def _place_at(self, q: Array) -> None:
        """Set ``q_r`` to a posture at rest, and begin a new update."""
        self.q[:], self._first[:], self._here[:] = q, q, q
        for moving in self.velocity, self.acceleration, self._governor.flow, self._governor.returning:
            moving[:] = 0.0
        self._tick, self._elapsed, self.resting = 0, 0.0, False

    def _place(self, q: Array) -> None:
        state = self._state.update(q, None)
        for task, J in self._turning:
            J[:] = task.jacobian(state)

    def _evaluate(self, q: Array) -> tuple[float, Array]:
        """Return ``H`` and a copy of ``∇H/H₀``.  If the gradient does not exist, return NaN and a zero vector."""
        try:
            value, gradient = self._gradient(q)
            slope = np.array(gradient, dtype=float) / self.start
            self.failed = not np.isfinite(slope).all()
        except Exception:
            # A user's function may raise any exception, but the tick must not fail.  `failed` reports the problem.
            self.failed = True
        return (np.nan, np.zeros(self.velocity.size)) if self.failed else (float(value), slope)
