"""The controller: one tick, one command."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import ArrayLike, NDArray

from impact_posture.errors import InputError, PostureError
from impact_posture.robot.robot import Robot
from impact_posture.tsid.actuators import Actuators
from impact_posture.tsid.assembly import Assembly
from impact_posture.tsid.daqp_solver import DaqpSolver
from impact_posture.tsid.impact_robust import ImpactRobustPosture
from impact_posture.tsid.qp import EQUALITY, Solver
from impact_posture.tsid.relaxation import Outcome, Relaxed, missed, solve
from impact_posture.tsid.state import State
from impact_posture.tsid.task import Task
from impact_posture.tsid.task_formulation import TaskFormulation

Array = NDArray[np.float64]

# A longer pause between ticks (in periods) lets ramps move no further than this.
_LONGEST = 10
# Entries of ν from which a dense cost is whitened by LAPACK: measured, a quadruped's is not worth it.
_LARGE = 20
# A measurement beyond this (squares of all numbers summed: 1e8 m, rad/s or N) is as good as none.
_ABSURD = 1e16
# Of the largest control limit.
_EXCESS = 1e-6
# Damping of a held command, 1/s, times each joint's inertia.
_HOLD = 10.0


class Status(Enum):
    """How a tick ended."""

    SOLVED = "solved"
    """Everything holds that has to; strict levels as far as their rank goes (``Report.deficient``)."""
    RELAXED = "relaxed"
    """Limits took from a strict level what it could have had beside those above it (``Report.relaxed``)."""
    INFEASIBLE = "infeasible"
    """No acceleration satisfies what must hold: the previous command is held."""
    UNSOLVED = "unsolved"
    """The QP solver gave up, or its answer breaks a control limit: the previous command is held."""
    NON_FINITE = "non-finite"
    """A measurement is not finite, beyond 1e8, or no rotation: the previous command is held."""


@dataclass(frozen=True, slots=True, eq=False)
class Command:
    """What to send to the motors; nothing else writes into these arrays later.

    Attributes:
        u: Rotor thrusts (N), then joint torques (N·m), shape (controls,).
        torque: Joint torques, N·m (N for prismatic joints), shape (joints,).
        rotor_speed: In the unit of robot.toml's ``speed_max``, shape (rotors,).
        status: How the tick ended.
        acceleration: ``ν̇`` as planned, shape (nv,); zero in a held command.
        forces: Contact forces as planned, world axes, one contact after the other, N and N·m.
    """

    u: Array
    torque: Array
    rotor_speed: Array
    status: Status
    acceleration: Array
    forces: Array


@dataclass(frozen=True)
class Report:
    """What a tick did, for people and tests.

    Attributes:
        status: How it ended.
        relaxed: What gave way to limits, the most important first.
        deficient: What levels miss for want of rank, not because of limits: they ask for a motion that the levels
            above them determine, contradict themselves, or are damped near a singularity (:class:`LevelRank`).
        residuals: ``ÿ − ÿ*`` of each task, by name; of ``contacts`` likewise.
        active: Names of the bounds that hold, with ``lower`` or ``upper``.
        dynamics: ``‖Mν̇ + h − Gu − Jᵀf − J_eᵀF̂‖_∞``.
        level: Activation of the impact-robust term.
        objective: Its ``H`` (or objective); NaN without one.
        iterations: Of the QP solver.
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


class Controller:
    """Task-space inverse dynamics: each tick one QP.

    Attributes:
        robot: The robot.
        formulation: What it does.
        state: The robot's dynamics at the last tick.
        assembly: The QP's buffers.
    """

    def __init__(self, robot: Robot, formulation: TaskFormulation, *, period: float = 1e-3) -> None:
        """Size all buffers.

        Args:
            robot: The robot.
            formulation: What to do.
            period: Expected time between ticks, s: of the first tick, and of what counts as a long pause.

        Raises:
            FrameNotFound: A task's frame does not exist.
            InputError: A period that is not positive.
        """
        if not period > 0:
            raise InputError("the period is not positive", where="controller", hint="give seconds above zero")
        self.robot, self.formulation, self.period = robot, formulation, period
        self.state = State(robot, formulation.points)
        self.actuators = Actuators(robot)
        self.assembly = Assembly(robot, formulation, self.actuators)
        n, m = self.assembly.qp.n, self.assembly.qp.m
        dense = robot.nv if formulation.weighted and robot.nv >= _LARGE else 0
        self._solver = _solver(n, m, dense)
        self._aside = DaqpSolver(n, m)
        self._tasks = formulation.tasks
        # Most tasks remember nothing.
        self._advancing = [task for task in self._tasks if type(task).advance is not Task.advance]
        self._ready = False
        # How far controls may pass their limits: more than a solver's tolerance is no solution.
        limits = np.abs([self.actuators.lower, self.actuators.upper])
        self._excess = (_EXCESS * max(1.0, float(np.max(limits, where=np.isfinite(limits), initial=0.0)))) ** 2

    def reset(self, q: ArrayLike, v: ArrayLike) -> Command:
        """Begin anew at ``(q, ν)``: tasks without a target take the present as theirs, ramps and warm starts go.

        Returns:
            The first command, also the one that is held if the first tick fails.

        Raises:
            PostureError: No configuration of the robot, or a velocity that is none.
        """
        q = self.robot.check_posture(np.asarray(q, dtype=float), limits=False)
        v = np.asarray(v, dtype=float)
        if v.shape != (self.robot.nv,) or not np.isfinite(v).all():
            raise PostureError(
                f"no velocity of {self.robot.name}", where="reset", hint=f"give {self.robot.nv} finite numbers"
            )
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
        self._damping = _HOLD * np.diag(state.M)[self.actuators.base :].copy()
        # Until something better is known: hold against gravity.
        held = self.actuators.solve(state.h, np.zeros(self.actuators.spare.shape[1]))
        self._u = np.clip(held, self.actuators.lower, self.actuators.upper)
        self._solver.reset()
        first = self._finish(solve(assembly, self._solver, self._aside))
        self._solver.reset()
        self._t: float | None = None
        self._ready = True
        return first

    def tick(self, t: float, q: ArrayLike, v: ArrayLike, force: ArrayLike | None = None) -> Command:
        """The command at ``(q, ν)``.

        Args:
            t: Time, s.
            q: Configuration, shape (nq,).
            v: ν, shape (nv,).
            force: Measured contact force (3) or wrench (6) on the robot at the program's ``force_point``, world axes.

        Raises:
            InputError: Before the first ``reset``.
            ValueError: Arrays of another shape.
        """
        if not self._ready:
            raise InputError("has not been reset", where="controller", hint="call reset(q, v) first")
        state = self.state
        q, v = np.asarray(q, dtype=float), np.asarray(v, dtype=float)
        if q.shape != state.q.shape or v.shape != state.v.shape:
            raise ValueError(f"q and v have shapes {q.shape} and {v.shape}, not {state.q.shape} and {state.v.shape}")
        # A sum of squares is finite, and below a bound, only if every number is.
        total = q.dot(q) + v.dot(v)
        if force is not None:
            force = np.asarray(force, dtype=float)
            total += force.dot(force)
        if not (total < _ABSURD and math.isfinite(t)) or self._turned_wrong(q):
            return self._held(Status.NON_FINITE, v)
        dt = self.period if self._t is None else min(max(t - self._t, 0.0), _LONGEST * self.period)
        self._t = t
        state.push(force)
        state.update(q, v)
        for task in self._advancing:
            task.advance(state, dt)
        self.assembly.build_qp(state)
        return self._finish(solve(self.assembly, self._solver, self._aside))

    def report(self) -> Report:
        """What the last tick did; computed when asked."""
        assembly, state, posture = self.assembly, self.state, self.formulation.posture
        residuals, active, dynamics = {}, [], float("nan")
        deficient: tuple[Relaxed, ...] = ()
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
        robust = posture if isinstance(posture, ImpactRobustPosture) else None
        return Report(
            self._status,
            self._outcome.relaxed,
            deficient,
            residuals,
            tuple(active),
            dynamics,
            0.0 if robust is None else robust.activation.level,
            float("nan") if robust is None else robust.value,
            0 if solved is None else solved.iterations,
        )

    def _finish(self, outcome: Outcome) -> Command:
        """Decode a solution, or hold."""
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
        # Not ">": that is false for a NaN.
        if not over.dot(over) <= self._excess:
            return self._held(Status.UNSOLVED, state.v)
        self._status = Status.RELAXED if outcome.relaxed else Status.SOLVED
        self._u[:] = u
        return self._command(u, self._status, assembly.acceleration(solved.z), assembly.forces(solved.z))

    def _turned_wrong(self, q: Array) -> bool:
        """Whether a quaternion, or a cosine with its sine, is far from unit length."""
        for part in self.state.unit_parts:
            unit = q[part]
            if abs(unit.dot(unit) - 1.0) > 1e-2:
                return True
        return False

    def _held(self, status: Status, v: Array) -> Command:
        """The previous command, joints damped where their rates are known."""
        rotors, actuators = self.actuators.rotors, self.actuators
        self._status, self._outcome = status, Outcome(None)
        u = self._u.copy()
        rates = v[actuators.base :]
        u[rotors:] -= self._damping * np.where(np.isfinite(rates), rates, 0.0)
        np.clip(u, actuators.lower, actuators.upper, out=u)
        return self._command(u, status, np.zeros(self.robot.nv), np.zeros(self.assembly.contacts.size))

    def _command(self, u: Array, status: Status, acceleration: Array, forces: Array) -> Command:
        rotors = self.actuators.rotors
        speeds = self.actuators.rotor_speeds(u[:rotors])
        return Command(u, u[rotors:], speeds, status, acceleration, forces)


def _solver(n: int, m: int, dense: int) -> Solver:
    if not dense:
        return DaqpSolver(n, m)
    # Only humanoids' programs are worth the time that importing SciPy takes.
    from impact_posture.tsid.whitened import WhitenedSolver

    return WhitenedSolver(n, m, dense)
