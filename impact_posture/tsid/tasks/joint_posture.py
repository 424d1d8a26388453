"""Posture task on the configuration manifold."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from impact_posture.config.checked import checked
from impact_posture.config.demand import Positive
from impact_posture.robot.robot import Robot
from impact_posture.system.arrays import Array
from impact_posture.tsid.smooth_step import smooth
from impact_posture.tsid.state import State
from impact_posture.tsid.tasks.task import Task, gain


@checked
class JointPosture(Task):
    """Regulate the posture by ``ν̇* = K_p (q_des ⊖ q) − K_d ν`` (Afifi et al. 2026, nominal posture).

    ``⊖`` is the difference on the configuration manifold, in the tangent space at ``q``, and includes the base.  If
    other tasks control the base, set the weight of the six base entries to zero (``base_weight = 0``).

    :meth:`move_to` fades in a new ``q_des``, so that ``ν̇*`` does not jump.

    Attributes:
        value: Value of the task's objective at the last evaluation; NaN if the task has no objective.
        stiffness: Stiffness matrix set by :meth:`stiffen`, 1/s², shape (nv, nv); ``None`` before the first call.
        damping: Damping matrix set by :meth:`stiffen`, 1/s, shape (nv, nv); ``None`` before the first call.
    """

    constant = True
    value = float("nan")

    def __init__(
        self,
        robot: Robot,
        target: ArrayLike | None = None,
        *,
        name: str = "posture",
        kp: ArrayLike = 10.0,
        kd: ArrayLike | None = None,
        weight: ArrayLike = 1.0,
        base_weight: float | None = None,
    ) -> None:
        """Set gains and target.

        Args:
            robot: The robot.
            target: Target posture ``q_des``, shape (nq,); by default, the posture at ``reset``.
            name: Name in reports.
            kp: Stiffness, 1/s², one number or shape (nv,).
            kd: Damping, 1/s, one number or shape (nv,); critical by default.
            weight: Weight in the cost, one number or shape (nv,).
            base_weight: Weight of the six base entries; by default, ``weight``.

        Raises:
            PostureError: The target is not a configuration of the robot.
            InputError: A gain or weight is negative, is not finite, or has the wrong shape.
        """
        super().__init__(name, robot.nv, kp=kp, kd=kd, weight=weight)
        if base_weight is not None and robot.floating:
            self.weight[:6] = gain(base_weight, 1, f"{name}: base_weight")
        self._model, self._robot = robot.model, robot
        self._given = None if target is None else robot.check_posture(np.asarray(target), limits=False)
        self._target = robot.posture() if self._given is None else self._given.copy()
        self._next, self._blend, self._over = self._target.copy(), 1.0, 1.0
        self._eye = np.eye(robot.nv)
        self.stiffness: Array | None = None
        self.damping: Array | None = None

    def stiffen(self, added: Array) -> None:
        """Use the stiffness ``K = K_p + added`` and the critical damping ``D = 2 K^½`` from now on.

        ``added`` is a symmetric positive semidefinite stiffness, 1/s², shape (nv, nv).
        """
        self.stiffness = np.diag(self.kp) + added
        values, vectors = np.linalg.eigh(self.stiffness)
        self.damping = (vectors * (2 * np.sqrt(np.maximum(values, 0.0)))) @ vectors.T

    @property
    def target(self) -> Array:
        """Target posture ``q_des``, shape (nq,); during a fade, the new target.  :meth:`move_to` changes it."""
        return self._next if self._blend < 1 else self._target

    @property
    def level(self) -> float:
        """Level of the preparation for an impact, 0 to 1; always 0 for a nominal posture task."""
        return 0.0

    def reset(self, state: State) -> None:
        self.lead(state.q if self._given is None else self._given, 0.0, 0.0)

    @checked
    def move_to(self, target: ArrayLike, over: Positive = 0.5) -> None:
        """Fade ``q_des`` to another posture within ``over`` seconds.

        If a fade is running, the new fade starts at the posture that the running fade has reached.

        Raises:
            PostureError: The target is not a configuration of the robot.
            InputError: The time is not positive.
        """
        self._fade_to(self._robot.check_posture(np.asarray(target), limits=False), over)

    def lead(self, q: Array, v: Array | float, a: Array | float) -> None:
        """Set ``q_des``, its velocity and its acceleration in the tangent space, without checks.

        The values stay until the next call of this method, of :meth:`move_to` or of ``reset``.
        """
        self._target[:], self._blend = q, 1.0
        self._velocity[:], self._acceleration[:] = v, a

    def advance(self, state: State, dt: float) -> None:
        if self._blend < 1:
            self._blend += dt / self._over
            if self._blend >= 1:
                self._target[:], self._blend = self._next, 1.0

    def error(self, state: State) -> Array:
        error = np.asarray(pin.difference(self._model, state.q, self._target))
        if self._blend < 1:
            share = smooth(self._blend)
            ahead = pin.difference(self._model, state.q, self._next)
            error = (1 - share) * error + share * ahead
        return error

    def jacobian(self, state: State) -> Array:
        return self._eye

    def pull(self, state: State) -> Array:
        """Return ``K_p (q_des ⊖ q)`` in a new array of shape (nv,)."""
        error = self.error(state)
        return np.asarray(self.kp * error if self.stiffness is None else self.stiffness @ error)

    def desired(self, state: State) -> Array:
        wanted = self.pull(state)
        wanted += self._acceleration
        error = self._velocity - state.v
        wanted += self.kd * error if self.damping is None else self.damping @ error
        more = self.feedforward(state)
        if more is not None:
            wanted += more
        return wanted

    def _fade_to(self, target: Array, over: float) -> None:
        """Fade to a valid configuration within ``over`` seconds, without checks, because a tick must not raise."""
        self.lead(self._reached(), 0.0, 0.0)
        self._next[:], self._blend, self._over = target, 0.0, over

    def _reached(self) -> Array:
        """Return the posture that a fade has reached; if no fade is running, return ``q_des``, shape (nq,)."""
        if self._blend < 1:
            return np.asarray(pin.interpolate(self._model, self._target, self._next, smooth(self._blend)))
        return self._target
