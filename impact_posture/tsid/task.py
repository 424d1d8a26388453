"""What a task is: an error and a Jacobian; everything else is derived once, here."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from impact_posture.errors import InputError
from impact_posture.tsid.points import Point
from impact_posture.tsid.state import State

Array = NDArray[np.float64]

# Central differences along the motion, seconds: truncation and rounding are both far below a tick's tolerance.
_STEP = 1e-4


class Task(ABC):
    """An output ``y(q)`` that is to accelerate with ``ÿ* = ÿ_des + K_p e + K_d (ẏ_des − Jν)``.

    Define a task by two methods, :meth:`error` and :meth:`jacobian`.  :meth:`drift` (``J̇ν``) is then computed by
    central differences of the Jacobian along the motion, at the price of two more evaluations of the kinematics;
    override it to save them.  A controller takes gains and weights over at ``reset``; targets at every tick.

    Attributes:
        name: What it is called in reports.
        size: Rows k.
        points: The points of the robot that it looks at; the state follows them.
        kp: Stiffness, 1/s², shape (k,).
        kd: Damping, 1/s, shape (k,).
        weight: In a weighted cost, shape (k,).
    """

    points: Sequence[Point] = ()
    constant = False
    """Whether ``J`` never changes and ``J̇ν`` is zero: a stack then asks for them once."""

    def __init__(
        self, name: str, size: int, *, kp: ArrayLike = 0.0, kd: ArrayLike | None = None, weight: ArrayLike = 1.0
    ) -> None:
        """Set gains and weight; each is one number or one a row.

        Args:
            name: What it is called in reports.
            size: Rows k.
            kp: Stiffness, 1/s².
            kd: Damping, 1/s; critical, ``2√kp``, by default.
            weight: In a weighted cost.

        Raises:
            InputError: A gain or weight that is negative, not finite or of another shape.
        """
        self.name, self.size = name, size
        self.kp = gain(kp, size, f"{name}: kp")
        self.kd = 2.0 * np.sqrt(self.kp) if kd is None else gain(kd, size, f"{name}: kd")
        self.weight = gain(weight, size, f"{name}: weight")
        self._velocity, self._acceleration = np.zeros(size), np.zeros(size)

    @abstractmethod
    def error(self, state: State) -> Array:
        """``e``, shape (k,): where ``y`` should go from here, so that ``ė = ẏ_des − Jν`` to first order."""

    @abstractmethod
    def jacobian(self, state: State) -> Array:
        """``J`` with ``ẏ = Jν``, shape (k, nv)."""

    def drift(self, state: State) -> Array:
        """``J̇ν``, shape (k,)."""
        ahead = np.array(self.jacobian(state.displaced(_STEP)))
        behind = np.array(self.jacobian(state.displaced(-_STEP)))
        return np.asarray((ahead - behind) @ state.v / (2 * _STEP))

    def feedforward(self, state: State) -> Array | None:
        """What is added to ``ÿ*`` beside target and feedback, shape (k,); nothing by default."""
        return None

    @property
    def target_velocity(self) -> Array:
        """``ẏ_des``, shape (k,); zero unless set."""
        return self._velocity

    @target_velocity.setter
    def target_velocity(self, value: ArrayLike) -> None:
        self._velocity[:] = value

    @property
    def target_acceleration(self) -> Array:
        """``ÿ_des``, shape (k,); zero unless set."""
        return self._acceleration

    @target_acceleration.setter
    def target_acceleration(self, value: ArrayLike) -> None:
        self._acceleration[:] = value

    def desired(self, state: State) -> Array:
        """``ÿ*``, shape (k,)."""
        wanted = self._acceleration + self.kp * self.error(state)
        wanted += self.kd * (self._velocity - self.jacobian(state) @ state.v)
        more = self.feedforward(state)
        return wanted if more is None else wanted + more

    def reset(self, state: State) -> None:  # noqa: B027 - a task may have nothing to begin
        """Begin anew at ``state``: a task without a target takes the present as its own."""

    def advance(self, state: State, dt: float) -> None:  # noqa: B027 - nor to go on with
        """Let ``dt`` seconds pass in what the task remembers; nothing by default."""

    def bind(self, velocity: Array, acceleration: Array) -> None:
        """Keep the targets in a stack's buffers from now on, so that a tick copies nothing."""
        velocity[:], acceleration[:] = self._velocity, self._acceleration
        self._velocity, self._acceleration = velocity, acceleration


class TaskStack:
    """Tasks one below the other: ``J ν̇ = a`` with ``a = ÿ* − J̇ν``, updated once a tick.

    Attributes:
        tasks: From the top.
        rows: Where each task stands.
        size: Rows altogether.
        J: Shape (size, nv); may be part of a larger matrix.
        a: Shape (size,).
        weight: Shape (size,).
    """

    def __init__(self, tasks: Sequence[Task], nv: int, J: Array | None = None) -> None:
        ends = np.cumsum([0, *(task.size for task in tasks)])
        self.tasks = tuple(tasks)
        self.rows = tuple(slice(int(b), int(e)) for b, e in pairwise(ends))
        self.size = int(ends[-1])
        self.J = np.zeros((self.size, nv)) if J is None else J
        self.a, self._e = np.zeros(self.size), np.zeros(self.size)
        self._drift, self._work = np.zeros(self.size), np.zeros(self.size)
        self._yd, self._ydd = np.zeros(self.size), np.zeros(self.size)
        for task, rows in zip(self.tasks, self.rows, strict=True):
            task.bind(self._yd[rows], self._ydd[rows])
        # What the loop over the tasks writes into, sliced once.
        self._parts = [
            (task, self.J[rows], self._e[rows], self._drift[rows], self.a[rows])
            for task, rows in zip(self.tasks, self.rows, strict=True)
        ]
        self.refresh()

    def refresh(self, state: State | None = None) -> None:
        """Take gains and weights from the tasks; Jacobians that never change at ``state``."""
        if state is not None:
            for task, J, *_ in self._parts:
                J[:] = task.jacobian(state)
        self.kp, self.kd, self.weight = (
            np.concatenate([np.zeros(0), *(getattr(task, key) for task in self.tasks)])
            for key in ("kp", "kd", "weight")
        )

    def update(self, state: State) -> None:
        """Evaluate all tasks at ``state``."""
        if not self._parts:
            return
        for task, J, e, drift, _ in self._parts:
            e[:] = task.error(state)
            if not task.constant:
                J[:] = task.jacobian(state)
                drift[:] = task.drift(state)
        a, work = self.a, self._work
        np.matmul(self.J, state.v, out=work)
        np.subtract(self._yd, work, out=work)
        work *= self.kd
        np.multiply(self.kp, self._e, out=a)
        a += work
        a += self._ydd
        a -= self._drift
        for task, _, _, _, part in self._parts:
            more = task.feedforward(state)
            if more is not None:
                part += more

    def residuals(self, acceleration: Array) -> dict[str, Array]:
        """``ÿ − ÿ*`` of each task at ``ν̇``, by name."""
        left = self.J @ acceleration - self.a
        return {task.name: left[rows] for task, rows in zip(self.tasks, self.rows, strict=True)}


def gain(value: ArrayLike, size: int, where: str) -> Array:
    """One number or one a row, as an array of ``size``; finite and not negative.

    Raises:
        InputError: Otherwise.
    """
    given = np.asarray(value, dtype=float)
    if given.shape not in ((), (size,)):
        raise InputError(f"has shape {given.shape}", where=where, hint=f"give one number or {size}")
    if not (np.isfinite(given).all() and (given >= 0).all()):
        raise InputError("is negative or not finite", where=where, hint="give finite numbers from zero up")
    return np.array(np.broadcast_to(given, (size,)))
