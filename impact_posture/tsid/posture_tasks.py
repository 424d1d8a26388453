"""The posture task on the configuration manifold."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray

from impact_posture.errors import InputError
from impact_posture.robot.robot import Robot
from impact_posture.tsid.state import State
from impact_posture.tsid.task import Task

Array = NDArray[np.float64]


class JointPosture(Task):
    """``ν̇* = K_p (q_des ⊖ q) − K_d ν`` over all of ν, the base included (Afifi et al. 2026, nominal posture).

    ``⊖`` is the manifold's difference in the tangent space at ``q``.  Where the base is led by other tasks, give its
    six entries no weight (``base_weight = 0``).

    A new ``q_des`` is faded in (:meth:`move_to`): no step in ``ν̇*``.
    """

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
            target: ``q_des``, shape (nq,); the posture at ``reset`` by default.
            name: What it is called in reports.
            kp: Stiffness, 1/s², one number or (nv,).
            kd: Damping, 1/s; critical by default.
            weight: In the cost, one number or (nv,).
            base_weight: Of the six base entries instead.

        Raises:
            PostureError: The target is no configuration of the robot.
            InputError: Gains that are none.
        """
        super().__init__(name, robot.nv, kp=kp, kd=kd, weight=weight)
        if base_weight is not None and robot.floating:
            self.weight[:6] = base_weight
        self._model, self._robot = robot.model, robot
        self._given = None if target is None else robot.check_posture(np.asarray(target), limits=False)
        self._target = robot.posture() if self._given is None else self._given.copy()
        self._next, self._blend, self._over = self._target.copy(), 1.0, 1.0
        self._eye, self._zero = np.eye(robot.nv), np.zeros(robot.nv)

    @property
    def target(self) -> Array:
        """``q_des``, shape (nq,); while a new one is faded in, the new one.  Change it by :meth:`move_to`."""
        return self._next if self._blend < 1 else self._target

    def reset(self, state: State) -> None:
        """Go for the target given to the constructor, else for the present posture."""
        self._target[:] = state.q if self._given is None else self._given
        self._blend = 1.0

    def move_to(self, target: ArrayLike, over: float = 0.5) -> None:
        """Fade ``q_des`` over to another posture within ``over`` seconds.

        A fade that is under way gives way to the new one from where it is.

        Raises:
            PostureError: No configuration of the robot.
            InputError: A time that is not positive.
        """
        if not over > 0:
            raise InputError("the time is not positive", where=self.name, hint="give seconds above zero")
        self._fade_to(self._robot.check_posture(np.asarray(target), limits=False), over)

    def advance(self, state: State, dt: float) -> None:
        """Go on with a fade."""
        if self._blend < 1:
            self._blend += dt / self._over
            if self._blend >= 1:
                self._target[:], self._blend = self._next, 1.0

    def error(self, state: State) -> Array:
        """``q_des ⊖ q``, shape (nv,)."""
        error = np.asarray(pin.difference(self._model, state.q, self._target))
        if self._blend < 1:
            share = smooth(self._blend)
            ahead = pin.difference(self._model, state.q, self._next)
            error = (1 - share) * error + share * ahead
        return error

    def jacobian(self, state: State) -> Array:
        """The identity."""
        return self._eye

    def drift(self, state: State) -> Array:
        """Zero."""
        return self._zero

    def desired(self, state: State) -> Array:
        """``ν̇*``, shape (nv,)."""
        wanted = self.kp * self.error(state)
        wanted += self._acceleration
        wanted += self.kd * (self._velocity - state.v)
        return wanted

    def step_bound(self, state: State, dt: float) -> float:
        """How far ``ν̇*`` can move within ``dt`` because of a fade alone, largest entry (``q``, ν held)."""
        if self._blend >= 1:
            return 0.0
        way = pin.difference(self._model, state.q, self._next) - pin.difference(self._model, state.q, self._target)
        return float(np.max(self.kp * np.abs(way))) * 1.5 * dt / self._over

    def _fade_to(self, target: Array, over: float) -> None:
        """As :meth:`move_to`, for what is known to be a configuration: in a tick nothing may be refused."""
        self._settle()
        self._next[:], self._blend, self._over = target, 0.0, over

    def _settle(self) -> None:
        """Stop a fade where it is."""
        if self._blend < 1:
            self._target[:] = pin.interpolate(self._model, self._target, self._next, smooth(self._blend))
            self._blend = 1.0


def smooth(x: float) -> float:
    """``3x² − 2x³``: from 0 to 1 with level ends; its slope is at most 1.5."""
    return x * x * (3.0 - 2.0 * x)
