"""Flow of a reference posture to lower impacts, on contacts and tasks, limited in speed and acceleration."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import pinocchio as pin

from impact_posture.arrays import Array
from impact_posture.errors import MetricError
from impact_posture.robot.robot import Robot
from impact_posture.tsid.actuators import Actuators
from impact_posture.tsid.body_tasks import BaseOrientation, CenterOfMass
from impact_posture.tsid.flow_direction import FlowDirection, FlowOptions, Redundancy, limited
from impact_posture.tsid.frame_tasks import FramePose, FramePosition
from impact_posture.tsid.impact_robust import Gradient
from impact_posture.tsid.qp import stacked_rows
from impact_posture.tsid.state import State
from impact_posture.tsid.static_controls import StaticControls, support_edges
from impact_posture.tsid.task import Task
from impact_posture.tsid.task_formulation import TaskFormulation

# Step of the differences along the redundancy, rad.
_STEP = 1e-4
# Way of the flow that is long enough to learn from, rad (m).
_MOVED = 1e-6
# Time constant with which the reference comes back to contacts and tasks, s.
_RETURN = 0.1
# Step below which a posture on the way is reached, or as near as the limits permit, rad (m).
_REACHED = 0.02
# Speed below which a flow that is off stands still, rad/s (m/s).
_STILL = 1e-5
# Square of the length below which a direction is none.
_EMPTY = 1e-24
# Length of what is new in a direction below which once more makes it exact.
_NEW = 0.1
# Length of a velocity below which the flow has no way to stop on.
_SLOW = 1e-3
# How often a change of the flow is tried: as it is, and twice without what crosses limits.
_TIMES = 3
# Least share of the acceleration with which the flow counts on braking, and its growth with each change.
_ABLE = 0.1
# Pull to zero of the base's share in a motion that the joints do not determine.
_IDLE = 1e-9


class ReferenceFlow:
    """Saddle-free Newton flow of a reference posture ``q_r`` in the null space of contacts and tasks.

    ``H`` and ``∇H`` are evaluated at ``q_r`` and not at the measured posture, so that noise, tracking errors and the
    impact itself do not enter.  An update takes as many ticks as :data:`PHASES` has parts.  The controller in C
    spreads the work of a part over the empty ticks beside it.  All memory is in arrays whose sizes do not change,
    except for the basis of the redundancy.

    Contacts stay at their places, and tasks of the strict levels and weighted tasks at their targets.  Only the
    ``led`` tasks (center of mass, base orientation) follow the flow.  Joints that ``robot.toml`` holds do not move.

    Attributes:
        robot: The robot.
        q: ``q_r``, shape (nq,).
        velocity: ``u`` with ``q̇_r = u``, rad/s (m/s), shape (nv,).
        acceleration: ``u̇``, shape (nv,).
        value: ``H(q_r)`` at the last update.
        start: ``H₀``, its value at the reset.
        on: Whether the flow may move.
        resting: Whether no step promises a decrease of more than ε.
        failed: Whether the last evaluation raised or was not finite.  The flow then brakes.
        led: Tasks that follow the flow.
        error: Distance from contacts and tasks at the last update, m and rad, and zeros for held joints.
        shares: Static controls there, within ±1 where the posture can be held (:class:`StaticControls`).
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

        Args:
            robot: The robot.
            gradient: ``q → (H, ∇H)``.
            formulation: Tasks and contacts.
            actuators: Rotors and motors.
            options: Parameters.
            path: Postures to visit first, each of shape (nq,); the last may be an optimum that was found offline.
        """
        self._model, self._gradient, self.options = robot.model, gradient, options
        self._contacts = formulation.contacts
        self._state = State(robot, formulation.points)
        self.led = tuple(t for t in formulation.weighted if isinstance(t, CenterOfMass | BaseOrientation))
        weighted = [t for t in formulation.weighted if t not in self.led]
        self._tasks = [task for level in formulation.levels for task in level] + weighted
        self._base, nv = actuators.base, robot.nv
        fixed = [robot.tangent_names.index(j) for j in robot.spec.constraints.hold if j in robot.tangent_names]
        self._places, count = stacked_rows([c.size for c in self._contacts] + [t.size for t in self._tasks])
        self._J, self.error = np.zeros((count + len(fixed), nv)), np.zeros(count + len(fixed))
        self._J[np.arange(count, count + len(fixed)), fixed] = 1.0
        self._static = StaticControls(actuators, self._contacts, options.share)
        self.q, self.velocity, self.acceleration = robot.posture(), np.zeros(nv), np.zeros(nv)
        self.robot, self._path = robot, tuple(path)
        self._mixed, self._seen = mixed_directions(nv), np.zeros((nv, nv))

    def reset(self, q: Array) -> None:
        """Begin at rest at a posture, shape (nq,), and measure the curvature there.

        Raises:
            MetricError: The gradient does not exist there, or ``H`` vanishes.
        """
        state = self._state
        self.q[:], self.velocity[:], self.acceleration[:] = q, 0.0, 0.0
        self._first, self._here = self.q.copy(), self.q.copy()
        self._wanted, self._flow, self._slope = np.zeros((3, self.velocity.size))
        self._before = np.zeros_like(self._J)
        self.shares = np.zeros(self._static.limited.size)
        self._phase, self._next, self._visited, self._elapsed, self._clock = 0, 0, 0, 0.0, 0.0
        self._deadline = np.inf
        self.on, self.resting, self.failed = False, False, False
        self._ahead, self._able = False, 1.0
        state.update(q, self.velocity)
        kinds = {3: FramePosition, 6: FramePose}
        self._held: list[Task] = [*(kinds[c.size](c.point) for c in self._contacts), *self._tasks]
        for task, rows in zip(self._held, self._places, strict=True):
            task.reset(state)
            self._J[rows] = task.jacobian(state)
        self._turning = [(t, self._J[r]) for t, r in zip(self._held, self._places, strict=True) if not t.constant]
        self._edges, self._offsets = support_edges(state, self._contacts)
        self.direction = FlowDirection(self.robot, self._edges, self._static.limited.size, self.options)
        self.start = 1.0
        self.value, _ = self._evaluate(self.q)
        if not (np.isfinite(self.value) and self.value != 0):
            raise MetricError("the objective vanishes or does not exist", where="reset", hint="start elsewhere")
        self.start = abs(self.value)
        self._look()
        for _ in range(self._space.basis.shape[1]):
            self._probe()
        self._next = 0

    def advance(self, dt: float, measured: Array) -> None:
        """Advance by ``dt`` seconds; ``measured`` is the configuration of the robot that follows, shape (nq,)."""
        self._clock += dt
        self._elapsed += dt
        self._measured = measured
        phase, self._phase = self._phase, (self._phase + 1) % len(PHASES)
        PHASES[phase](self)
        self.velocity += dt * self.acceleration
        self.q[:] = pin.integrate(self._model, self.q, dt * self.velocity)

    def rest_at(self, after: float) -> None:
        """Come to rest within ``after`` seconds from now, as far as the acceleration permits, and stay."""
        self._deadline = self._clock + after

    @property
    def moves(self) -> bool:
        """Whether :meth:`advance` has anything to do."""
        return self.on or bool(np.abs(self.velocity).max() > _STILL)

    # ---- the parts of an update, one a tick -----------------------------------------------------------------------

    def _look(self) -> None:
        """Evaluate objective, constraints and limits, and learn from the way since the last look.

        The motion changes in a later tick.  The look is at where ``q_r`` will be then.
        """
        state, direction = self._state, self.direction
        dt = self._elapsed / _SINCE
        way = _UNTIL * dt * (self.velocity + (_UNTIL + 1) / 2 * dt * self.acceleration)
        ahead = pin.integrate(self._model, self.q, way)
        way, slope, shares = pin.difference(self._model, ahead, self._here), self._slope, self.shares
        self._place(ahead)
        self._here[:] = ahead
        for task, rows in zip(self._held, self._places, strict=True):
            self.error[rows] = task.error(state)
        self.value, self._slope = self._evaluate(ahead)
        self._space = space = Redundancy.of(self._J)
        self._multipliers = space.inverse.T @ self._slope
        self._reduced = self._slope - self._J.T @ self._multipliers
        self.shares = self._static.shares(state, self._J)
        length = math.sqrt(float(way @ way))
        # A look that failed has no slope.
        if length > _MOVED and not self.failed and slope.any():
            self._compare(way / length, length, slope - self._before.T @ self._multipliers, shares)
        self._before[:] = self._J
        rooms = self._offsets
        if rooms.size:
            rooms = -rooms - self.options.com_margin - self._edges @ state.center_of_mass()[0][:2]
        coasting = self._flow * (self.options.speed / self.options.acceleration / 2)
        direction.limit(state, rooms, self.shares, coasting)

    def _probe(self) -> None:
        """Evaluate the reduced gradient and the static controls beside the posture of the last look, and learn."""
        Z = self._space.basis
        if self.failed or not Z.shape[1]:
            return
        self._ahead = not self._ahead
        size = math.sqrt(float(self._flow @ self._flow))
        if self._ahead and size > _SLOW:
            # Where the flow stops: what it learns there is what it needs to know.
            z, length = self._flow / size, max(size * self._stopping(self._flow), _STEP)
            self._beside(z, length)
            return
        k = self._next % Z.shape[1]
        # The columns of Z are as good as any others of that space.  What a fixed direction has in it is unique.
        z, seen = self._seen[k], self._seen[:k]
        z[:] = self._mixed[k]
        for _ in range(2):
            z[:] = Z @ (Z.T @ (z - (seen @ z) @ seen))
            length = math.sqrt(max(float(z @ z), _EMPTY))
            z /= length
            if length > _NEW:
                break
        self._next += int(self._beside(z, _STEP))

    def _beside(self, z: Array, length: float) -> bool:
        """Learn from the end of a way ``z · length`` from the last look; return whether ``H`` exists there."""
        q = pin.integrate(self._model, self._here, length * z)
        _, slope = self._evaluate(q)
        self._place(q)
        if not self.failed:
            reduced = slope - self._J.T @ self._multipliers
            self._compare(z, length, reduced, self._static.shares(self._state, self._J))
        return not self.failed

    def _stopping(self, flow: Array) -> float:
        """Return the time in which a flow stops evenly, s, which takes twice the way that braking takes."""
        return float(np.abs(flow).max()) / self.options.acceleration

    def _compare(self, z: Array, length: float, reduced: Array, shares: Array) -> None:
        """Learn from reduced gradient and static controls at the end of a way ``z · length`` from the last look."""
        self.direction.learn(z, (reduced - self._reduced) / length, (shares - self.shares) / length)

    def _direct(self) -> None:
        """Find the step, and whether it is worth moving."""
        self._wanted[:] = 0.0
        if self.failed:
            return
        if self._visited < len(self._path):
            way, before = pin.difference(self._model, self.q, self._path[self._visited]), self.direction.failures
            self._wanted[:] = self.direction.towards(self._space.basis, way)
            self._visited += int(self.direction.failures == before and np.abs(self._wanted).max() < _REACHED)
            return
        offset = pin.difference(self._model, self._first, self._here)
        self._wanted[:] = self.direction.newton(self._space, self._slope, self.value / self.start, offset, self.error)
        gain, least = self.direction.gain, self.options.epsilon
        self.resting = gain < (4 * least if self.resting else least)
        if self.resting:
            # It brakes as it turns, downhill.
            self._wanted[:] = 0.0

    def _govern(self) -> None:
        """Limit speed and acceleration, and return to contacts and tasks."""
        options, Z = self.options, self._space.basis
        period, self._elapsed = self._elapsed, 0.0
        if not period > 0:
            # A clock that stands still.
            return
        error = np.abs(pin.difference(self._model, self._measured, self.q)[self._base :]).max(initial=0.0)
        fastest = options.speed * max(1.0 - error / options.tracking, 0.0)
        # The speed is that at the next change, and rest comes with the one after.
        fastest = min(fastest, options.acceleration * max(self._deadline - self._clock - 2 * period, 0.0))
        # Two fifths of the acceleration stop a speed of √(4/5 a δ) on the step δ.  Below v/2, it is 8/5 a/v δ.
        least = 0.3125 * options.speed**2 / options.acceleration
        wanted = self._wanted * math.sqrt(0.8 * options.acceleration / max(np.abs(self._wanted).max(), least))
        if not self.on:
            fastest = 0.0
        rate = self.error / _RETURN
        for task, rows in zip(self._held, self._places, strict=True):
            rate[rows] += task.target_velocity
        back = self._space.inverse @ rate
        if self._base:
            # Of all motions that bring the tasks there, that of the base and not of the joints.
            joints = Z[self._base :]
            square = joints.T @ joints
            square.flat[:: square.shape[0] + 1] += _IDLE
            back -= Z @ np.linalg.solve(square, joints.T @ back[self._base :])
        self._flow = Z @ (Z.T @ self._flow)
        step = self._change(limited(wanted, fastest), options.acceleration * period, fastest > 0)
        known = (self._flow + back - self.velocity) / period
        part = self._static.permitted(self._state.M, known, step / period, self.shares, options.haste)
        self._able = min(max(part, _ABLE), self._able + _ABLE)
        step *= part
        self._flow += step
        self.acceleration[:] = known + step / period

    def _change(self, wanted: Array, most: float, moving: bool) -> Array:
        """Return the change of the flow towards the wanted one, shape (nv,), by at most ``most`` an entry.

        Each joint turns as fast as it can, and then all stay on the constraints; or all change evenly; or all brake
        evenly.  The first two count twice more without what crosses limits.  The first change counts from which the
        flow can stop within the limits by braking evenly, as hard as it lately could.
        """
        Z, flow, direction = self._space.basis, self._flow, self.direction
        away, period = wanted - flow, most / self.options.acceleration
        # Twice the way on which it stops, because the curvature may grow on it.
        stop = flow * self._stopping(flow)
        for step in (Z @ (Z.T @ np.minimum(np.maximum(away, -most), most)), away):
            step = limited(step, most)
            for again in range(_TIMES):
                if again:
                    step = direction.along(Z, flow, self._stopping(flow + step) / 2 / self._able + period, step)
                if moving and self._visited == len(self._path):
                    step = direction.downhill(Z, self._slope, flow, stop, step)
                step = limited(step, most)
                if direction.stops(flow + step, self._stopping(flow + step) / 2 / self._able + period):
                    return step
        return limited(-flow, most)

    def _coast(self) -> None:
        """Do nothing, because the controller in C spreads the parts over these ticks, so that none takes long."""

    def _place(self, q: Array) -> None:
        """Evaluate the Jacobian of the constraints at a posture."""
        state = self._state.update(q, None)
        for task, J in self._turning:
            J[:] = task.jacobian(state)

    def _evaluate(self, q: Array) -> tuple[float, Array]:
        """Return ``H`` and a copy of ``∇H/H₀``, zero where they do not exist."""
        try:
            value, gradient = self._gradient(q)
            found = np.array(gradient, dtype=float) / self.start
            self.failed = not np.isfinite(found).all()
        except Exception:
            # A user's function may raise anything, but the tick must go on.  `failed` reports it.
            self.failed = True
        return (np.nan, np.zeros(self.velocity.size)) if self.failed else (float(value), found)


def mixed_directions(nv: int) -> Array:
    """Return directions in which no entry is left out, shape (nv, nv), bit for bit the same on every machine.

    The fractions of ``k² φ``, φ the golden ratio in 32 bits, are spread like random numbers.
    """
    k = np.arange(1, nv * nv + 1, dtype=np.uint32)
    return np.asarray((k * k * np.uint32(2654435769) / 2.0**32 - 0.5).reshape(nv, nv))


PHASES: tuple[Callable[[ReferenceFlow], None], ...] = (
    ReferenceFlow._look,
    *3 * (ReferenceFlow._coast,),
    ReferenceFlow._govern,
    ReferenceFlow._probe,
    *5 * (ReferenceFlow._coast,),
    ReferenceFlow._govern,
    ReferenceFlow._coast,
    ReferenceFlow._direct,
)
# Ticks from a look to the change of the motion, and those since the last change that the flow has counted at a look.
_UNTIL = PHASES.index(ReferenceFlow._govern)
_SINCE = PHASES[::-1].index(ReferenceFlow._govern) + 1
