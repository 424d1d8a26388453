"""Controller that computes a command from each measured state."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import ArrayLike

from impact_posture.config.checked import checked
from impact_posture.config.demand import Positive
from impact_posture.errors import InputError, PostureError
from impact_posture.robot.robot import Robot
from impact_posture.system.arrays import Array
from impact_posture.tsid.actuators import Actuators
from impact_posture.tsid.assembly import Assembly
from impact_posture.tsid.flow.reference_flow_posture import ReferenceFlowPosture
from impact_posture.tsid.qp.daqp_solver import DaqpSolver, WhitenedSolver
from impact_posture.tsid.qp.quadratic_program import EQUALITY
from impact_posture.tsid.relaxation import Outcome, Relaxed, missed, solve
from impact_posture.tsid.state import PERIOD, State, checked_velocity
from impact_posture.tsid.task_formulation import TaskFormulation
from impact_posture.tsid.tasks.impact_robust import ImpactRobustPosture
from impact_posture.tsid.tasks.task import Task

# Largest time step of ramps, in periods of the controller.  Without this bound, a tick after a long pause would end a
# ramp.
LONGEST = 10
# Least nv for which LAPACK factorizes the cost (:class:`WhitenedSolver`).  For smaller robots, LAPACK saves no time.
_LARGE = 20
# A measured vector is invalid if the sum of its squared entries exceeds this value.  The square root of this value is
# 1e8 (m, rad/s or N).
ABSURD = 1e16
# Largest violation of a control limit, relative to the largest limit.
_EXCESS = 1e-6
# Joint damping that is added to a repeated command, divided by the inertia of the joint, 1/s.
_HOLD = 10.0


class Status(Enum):
    """Result of a tick."""

    SOLVED = "solved"
    """All constraints hold, and strict levels of tasks hold as far as their rank permits (``Report.deficient``)."""
    RELAXED = "relaxed"
    """A strict level does not hold, because limits prevent it (``Report.relaxed``)."""
    INFEASIBLE = "infeasible"
    """No acceleration satisfies the hard constraints.  The previous command is repeated, with damping."""
    UNSOLVED = "unsolved"
    """The solver failed, or its answer violates a control limit.  The previous command is repeated, with damping."""
    NON_FINITE = "non-finite"
    """A measurement is not finite, exceeds 1e8, or is not a rotation.

    The previous command is repeated, with damping.
    """


@dataclass(frozen=True, slots=True, eq=False)
class Command:
    """Command for the motors, in arrays that the controller does not change later.

    Attributes:
        u: Controls ``u``: rotor thrusts (N), then joint torques (N·m), shape (controls,).
        torque: Joint torques, N·m (N for prismatic joints), shape (joints,).
        rotor_speed: Rotor speeds in the unit of ``speed_max`` in robot.toml, shape (rotors,).
        status: Result of the tick.
        acceleration: Planned ``ν̇``, shape (nv,); zero if the previous command is repeated.
        forces: Planned contact forces, world axes, in the order of the contacts, N and N·m.
    """

    u: Array
    torque: Array
    rotor_speed: Array
    status: Status
    acceleration: Array
    forces: Array


@dataclass(frozen=True)
class Report:
    """Diagnosis of a tick.

    Attributes:
        status: Result of the tick.
        relaxed: Strict levels and limits that more important constraints prevent, the most important first.
        deficient: Strict levels that do not hold because their rows are dependent (:class:`LevelRank`).  Either more
            important levels determine the same motion, or rows contradict each other, or the posture is nearly
            singular.
        residuals: Task name → ``ÿ − ÿ*``; the name ``contacts`` stands for all contacts.
        active: Name of each active bound, with its side ``lower`` or ``upper``.
        dynamics: Error of the equations of motion, ``‖Mν̇ + h − Gu − Jᵀf − J_eᵀF̂‖_∞``.
        level: Activation of a posture task that prepares for impacts, 0 to 1.
        objective: Value of the posture task's objective, for example ``H``; NaN without such a task.
        iterations: Iterations of the QP solver.
    """

    status: Status
    relaxed: tuple[Relaxed, ...]
    deficient: tuple[Relaxed, ...]
    residuals: dict[str, Array]
    active: tuple[tuple[str, str], ...]
    dynamics: float
    level: float
    objective: float
    iterations: int


@checked
class Controller:
    """Task-space inverse dynamics by one QP per tick.

    Attributes:
        formulation: Tasks, contacts and limits.
        period: Expected time between ticks, s.
        state: Dynamics of the robot at the last tick.
        actuators: Rotors and motors.
        assembly: Buffers of the QP.
    """

    def __init__(self, robot: Robot, formulation: TaskFormulation, *, period: Positive = PERIOD) -> None:
        """Size all buffers.

        ``period``, s, is the first time step of ramps.  Later time steps are at most ten times ``period``.

        Raises:
            FrameNotFound: The frame of a task does not exist.
            InputError: The period is not positive.
        """
        self.robot, self.formulation, self.period = robot, formulation, period
        self.state = State(robot, formulation.points)
        self.actuators = Actuators(robot)
        self.assembly = Assembly(robot, formulation, self.actuators)
        n, m = self.assembly.qp.n, self.assembly.qp.m
        white = formulation.weighted and robot.nv >= _LARGE
        self._solver = WhitenedSolver(n, m, robot.nv) if white else DaqpSolver(n, m)
        self._tasks = formulation.tasks
        # Call ``advance`` only for tasks that define it, because most tasks keep no memory.
        self._advancing = [task for task in self._tasks if type(task).advance is not Task.advance]
        self._ready = False
        # The solver may violate control limits slightly.  ``_excess`` is the square of the largest permitted
        # violation.
        limits = np.abs([self.actuators.lower, self.actuators.upper])
        self._excess = (_EXCESS * max(1.0, float(np.max(limits, where=np.isfinite(limits), initial=0.0)))) ** 2

    def reset(self, q: ArrayLike, v: ArrayLike) -> Command:
        """Start again at ``(q, ν)``: set task targets that are not set yet, and clear ramps and warm starts.

        Returns:
            The first command.  The first tick repeats this command, with additional damping, if the QP has no valid
            solution.

        Raises:
            PostureError: ``q`` is not a configuration, ``v`` is not a velocity, or an entry is too large.
        """
        q = self.robot.check_posture(np.asarray(q, dtype=float), limits=False)
        v = checked_velocity(self.robot, v)
        if not math.hypot(*q, *v) < math.sqrt(ABSURD):
            raise PostureError("q or ν is too large for a measurement", where="reset", hint="give SI units")
        state, assembly = self.state, self.assembly
        state.push(None)
        state.update(q, v)
        for task in self._tasks:
            task.reset(state)
        assembly.reset(state)
        assembly.build_qp(state)
        posture = self.formulation.posture
        if isinstance(posture, ImpactRobustPosture):
            posture.normalize(state, assembly.redundancy(state))
        elif isinstance(posture, ReferenceFlowPosture):
            posture.begin(state, self.formulation, self.actuators)
        self._damping = _HOLD * np.diag(state.M)[self.actuators.base :].copy()
        # The initial command holds the robot against gravity.
        held = self.actuators.solve(state.h, np.zeros(self.actuators.spare.shape[1]))
        self._u = np.clip(held, self.actuators.lower, self.actuators.upper)
        self._solver.reset()
        first = self._finish(solve(assembly, self._solver))
        self._solver.reset()
        self._t: float | None = None
        self._ready = True
        return first

    def tick(self, t: float, q: ArrayLike, v: ArrayLike, force: ArrayLike | None = None) -> Command:
        """Return the command at ``(q, ν)``.

        Args:
            t: Time, s.
            q: Configuration, shape (nq,).
            v: Generalized velocity ν, shape (nv,).
            force: Measured contact force (3) or wrench (6) on the robot at ``force_point``, world axes.

        Raises:
            InputError: ``reset`` has not been called.
            ValueError: The shape of an array is wrong.
        """
        self._check_ready()
        state = self.state
        q, v = np.asarray(q, dtype=float), np.asarray(v, dtype=float)
        if q.shape != state.q.shape or v.shape != state.v.shape:
            raise ValueError(f"q and v have shapes {q.shape} and {v.shape}, not {state.q.shape} and {state.v.shape}")
        # If the sum of squares is finite and below ``ABSURD``, every number is finite and not too large.
        total = q.dot(q) + v.dot(v)
        if force is not None:
            force = np.asarray(force, dtype=float)
            total += force.dot(force)
        if not (total < ABSURD and math.isfinite(t)) or self._far_from_unit(q):
            return self._held(Status.NON_FINITE, v)
        dt = self.period if self._t is None else min(max(t - self._t, 0.0), LONGEST * self.period)
        self._t = t
        state.push(force)
        state.update(q, v)
        for task in self._advancing:
            task.advance(state, dt)
        self.assembly.build_qp(state)
        return self._finish(solve(self.assembly, self._solver))

    def _check_ready(self) -> None:
        if not self._ready:
            raise InputError("has not been reset", where="controller", hint="call reset(q, v) first")

    def report(self) -> Report:
        """Compute and return the diagnosis of the last tick.

        Raises:
            InputError: ``reset`` has not been called.
        """
        self._check_ready()
        assembly, state, posture = self.assembly, self.state, self.formulation.posture
        residuals, active, deficient, dynamics = {}, [], tuple[Relaxed, ...](), math.nan
        solved = self._outcome.solved
        if solved is not None:
            z = solved.z
            acceleration = assembly.acceleration(z)
            residuals = assembly.strict.residuals(acceleration) | assembly.weighted.residuals(acceleration)
            if posture is not None:
                residuals[posture.name] = acceleration - posture.desired(state)
            if assembly.contacts.size:
                residuals["contacts"] = assembly.contacts.J @ acceleration - assembly.contacts.a
            deficient = missed(assembly, z, equations=False)
            force = assembly.generalized_force(state, z)
            dynamics = float(np.max(np.abs(force - self.actuators.G @ self._u)))
            for name, multiplier, sense in zip(assembly.names, solved.multipliers, assembly.qp.sense, strict=True):
                if multiplier and sense != EQUALITY:
                    active.append((name, "upper" if multiplier > 0 else "lower"))
        return Report(
            self._status,
            self._outcome.relaxed,
            deficient,
            residuals,
            tuple(active),
            dynamics,
            0.0 if posture is None else posture.level,
            math.nan if posture is None else posture.value,
            0 if solved is None else solved.iterations,
        )

    def _finish(self, outcome: Outcome) -> Command:
        """Return the command of a solution; if there is no valid solution, repeat the previous command."""
        state, assembly, solved = self.state, self.assembly, outcome.solved
        self._outcome = outcome
        if solved is None:
            if not assembly.qp.finite:
                return self._held(Status.NON_FINITE, state.v)
            return self._held(Status.INFEASIBLE if self._solver.infeasible else Status.UNSOLVED, state.v)
        u = assembly.controls(state, solved.z)
        over = np.minimum(u, self.actuators.upper)
        np.maximum(over, self.actuators.lower, out=over)
        over -= u
        # The test is "not <=" instead of ">", because ">" is false for NaN.
        if not over.dot(over) <= self._excess:
            return self._held(Status.UNSOLVED, state.v)
        self._status = Status.RELAXED if outcome.relaxed else Status.SOLVED
        self._u[:] = u
        return self._command(u, self._status, assembly.acceleration(solved.z), assembly.forces(solved.z))

    def _far_from_unit(self, q: Array) -> bool:
        return any(abs(q[part].dot(q[part]) - 1.0) > 1e-2 for part in self.state.unit_parts)

    def _held(self, status: Status, v: Array) -> Command:
        """Return the previous command, with damping of the joints whose measured rates are valid."""
        actuators, u = self.actuators, self._u.copy()
        self._status, self._outcome = status, Outcome(None)
        rates = v[actuators.base :]
        u[actuators.rotors :] -= self._damping * np.where(np.abs(rates) < math.sqrt(ABSURD), rates, 0.0)
        np.clip(u, actuators.lower, actuators.upper, out=u)
        return self._command(u, status, np.zeros(self.robot.nv), np.zeros(self.assembly.contacts.size))

    def _command(self, u: Array, status: Status, acceleration: Array, forces: Array) -> Command:
        rotors = self.actuators.rotors
        speeds = self.actuators.rotor_speeds(u[:rotors])
        return Command(u, u[rotors:], speeds, status, acceleration, forces)
