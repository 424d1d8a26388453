"""Base classes of tasks.  A task defines its error and Jacobian; the base class computes everything else."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from impact_posture.config.checked import checked
from impact_posture.errors import InputError
from impact_posture.system.arrays import Array
from impact_posture.tsid.point_kinematics import Point
from impact_posture.tsid.qp.quadratic_program import stacked_rows
from impact_posture.tsid.state import State

Target = TypeVar("Target")

# Time step of central differences along the motion, s.  With this step, the errors of the differences are far below
# the tolerance of the QP solver.
_STEP = 1e-4


@checked
class Task(ABC):
    """Accelerate an output ``y(q)`` with ``ÿ* = ÿ_des + K_p e + K_d (ẏ_des − Jν)``.

    A task defines two methods, :meth:`error` and :meth:`jacobian`.  By default, :meth:`drift` computes ``J̇ν`` by
    central differences of the Jacobian along the motion, which takes two more evaluations of the kinematics.
    A subclass can override :meth:`drift` to save time.  A controller reads gains and weights at ``reset``, and
    targets at each tick.

    Attributes:
        name: Name in reports.
        size: Number k of rows.
        points: Points of the robot whose kinematics the task reads from the state.
        kp: Stiffness, 1/s², shape (k,).
        kd: Damping, 1/s, shape (k,).
        weight: Weight in the cost of a weighted formulation, shape (k,).
    """

    points: Sequence[Point] = ()
    constant = False
    """Whether ``J`` is constant and ``J̇ν`` is zero, so that :class:`TaskStack` evaluates ``J`` only at ``reset``."""

    def __init__(
        self, name: str, size: int, *, kp: ArrayLike = 0.0, kd: ArrayLike | None = None, weight: ArrayLike = 1.0
    ) -> None:
        """Set ``kp``, ``kd`` and ``weight``, each of which is one number or one number per row.

        By default, the damping is critical: ``kd = 2√kp``.

        Raises:
            InputError: A gain or weight is negative, is not finite, or has the wrong shape.
        """
        self.name, self.size = name, size
        self.kp = gain(kp, size, f"{name}: kp")
        self.kd = 2.0 * np.sqrt(self.kp) if kd is None else gain(kd, size, f"{name}: kd")
        self.weight = gain(weight, size, f"{name}: weight")
        self._velocity, self._acceleration = np.zeros(size), np.zeros(size)

    @abstractmethod
    def error(self, state: State) -> Array:
        """Return the error ``e`` from ``y`` to the target, shape (k,).  To first order, ``ė = ẏ_des − Jν``."""

    @abstractmethod
    def jacobian(self, state: State) -> Array:
        """Return the Jacobian ``J`` with ``ẏ = Jν``, shape (k, nv)."""

    def drift(self, state: State) -> Array:
        """Return ``J̇ν``, shape (k,)."""
        if self.constant:
            return np.zeros(self.size)
        ahead = np.array(self.jacobian(state.displaced(_STEP)))
        behind = np.array(self.jacobian(state.displaced(-_STEP)))
        return np.asarray((ahead - behind) @ state.v / (2 * _STEP))

    def feedforward(self, state: State) -> Array | None:
        """Return a term that is added to ``ÿ*``, shape (k,); ``None`` by default."""
        return None

    @property
    def target_velocity(self) -> Array:
        """Desired velocity ``ẏ_des`` of the output, shape (k,); zero by default."""
        return self._velocity

    @target_velocity.setter
    def target_velocity(self, value: ArrayLike) -> None:
        self._velocity[:] = value

    @property
    def target_acceleration(self) -> Array:
        """Desired acceleration ``ÿ_des`` of the output, shape (k,); zero by default."""
        return self._acceleration

    @target_acceleration.setter
    def target_acceleration(self, value: ArrayLike) -> None:
        self._acceleration[:] = value

    def desired(self, state: State) -> Array:
        """Return ``ÿ*``, shape (k,)."""
        wanted = self._acceleration + self.kp * self.error(state)
        wanted += self.kd * (self._velocity - self.jacobian(state) @ state.v)
        more = self.feedforward(state)
        return wanted if more is None else wanted + more

    def reset(self, state: State) -> None:  # noqa: B027 - many tasks have nothing to reset
        """Start again at ``state``.  If the task has no target, the present output becomes its target."""

    def advance(self, state: State, dt: float) -> None:  # noqa: B027 - many tasks keep no memory
        """Advance the internal memory, such as ramps, by ``dt`` seconds.  By default, this method does nothing."""

    def bind(self, velocity: Array, acceleration: Array) -> None:
        """Keep desired velocity and acceleration in buffers of a :class:`TaskStack`, so that no tick copies them."""
        velocity[:], acceleration[:] = self._velocity, self._acceleration
        self._velocity, self._acceleration = velocity, acceleration


@checked
class TargetTask(Task, Generic[Target]):
    """Base class of tasks that move an output to a target; by default, to the output at ``reset``.

    A subclass defines its default name ``title`` and its number of rows ``rows``.

    Attributes:
        target: Target of the output; ``None`` until it is set.
    """

    title: str
    rows: int

    def __init__(
        self, *, name: str | None = None, kp: ArrayLike = 100.0, kd: ArrayLike | None = None, weight: ArrayLike = 1.0
    ) -> None:
        super().__init__(name or self.title, self.rows, kp=kp, kd=kd, weight=weight)
        self.target: Target | None = self.default_target()

    def default_target(self) -> Target | None:
        """Return the target before any ``reset``; ``None`` by default."""
        return None

    @abstractmethod
    def present(self, state: State) -> Target:
        """Return a copy of the output at ``state``, in the form of a target."""

    def reset(self, state: State) -> None:
        """Set the target to the present output if the task has no target yet.

        Raises:
            InputError: The task requires a floating base, but the base is fixed.
        """
        if self.target is None:
            self.target = self.present(state)

    def required_target(self) -> Target:
        """Return the target.

        Raises:
            InputError: The task has no target yet.
        """
        if self.target is None:
            raise InputError("has no target", where=self.name, hint="set `target`, or reset the controller first")
        return self.target


class TaskStack:
    """Stack of tasks in the form ``J ν̇ = a`` with ``a = ÿ* − J̇ν``, which each tick updates.

    Attributes:
        tasks: Tasks in the order of their rows.
        rows: Rows of each task.
        size: Total number of rows.
        J: Jacobian of all tasks, shape (size, nv); may be a view on a larger matrix.
        a: Desired accelerations minus drifts, shape (size,).
        weight: Weight of each row in the cost, shape (size,).
    """

    def __init__(self, tasks: Sequence[Task], nv: int, J: Array | None = None) -> None:
        self.tasks = tuple(tasks)
        self.rows, self.size = stacked_rows(task.size for task in tasks)
        self.J = np.zeros((self.size, nv)) if J is None else J
        self.a, self._e, self._drift, self._work, self._yd, self._ydd = np.zeros((6, self.size))
        for task, rows in zip(self.tasks, self.rows, strict=True):
            task.bind(self._yd[rows], self._ydd[rows])
        # Store the views for the loop over the tasks, so that no tick must slice the arrays.
        self._parts = [
            (task, self.J[rows], self._e[rows], self._drift[rows], self.a[rows])
            for task, rows in zip(self.tasks, self.rows, strict=True)
        ]
        self.refresh()

    def refresh(self, state: State | None = None) -> None:
        """Read the gains and weights of the tasks.  If ``state`` is not ``None``, evaluate the Jacobians there."""
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
        """Return task name → ``ÿ − ÿ*`` at the acceleration ``ν̇``, shape (nv,)."""
        left = self.J @ acceleration - self.a
        return {task.name: left[rows] for task, rows in zip(self.tasks, self.rows, strict=True)}


def gain(value: ArrayLike, size: int, where: str) -> Array:
    """Return ``value``, one number or one number per row, as an array of shape (size,).

    Raises:
        InputError: The value has the wrong shape, is negative, or is not finite.
    """
    values = np.asarray(value, dtype=float)
    if values.shape not in ((), (size,)):
        raise InputError(f"has shape {values.shape}", where=where, hint=f"give one number or {size}")
    if not (np.isfinite(values).all() and (values >= 0).all()):
        raise InputError("is negative or not finite", where=where, hint="give finite numbers from zero up")
    return np.array(np.broadcast_to(values, (size,)))
