"""Tasks of the whole body: tilt and orientation of a floating base, center of mass."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pinocchio as pin

from impact_posture.errors import InputError
from impact_posture.system.arrays import Array
from impact_posture.tsid.state import State
from impact_posture.tsid.tasks.task import TargetTask


class _BaseTurn(TargetTask[Array]):
    """Base class of tasks that rotate the base.

    ``J`` selects, from ν, components of the base's angular velocity ω in base axes.  Hence ``J̇ν = 0``.
    """

    constant = True

    def jacobian(self, state: State) -> Array:
        return np.eye(self.size, state.nv, 3)


class Tilt(_BaseTurn):
    """Regulate the direction of the base's z axis (reduced attitude); the yaw angle stays free (2 × nv).

    The shortest rotation takes the base's z axis to ``target``.  ``e`` contains its x and y components in base axes
    (Brescianini and D'Andrea 2018).  ``J`` selects ``ω_x`` and ``ω_y`` from ν, hence ``J̇ν = 0``.

    Attributes:
        target: Desired direction of the base's z axis, unit vector in the world, shape (3,); upward by default.
    """

    title, rows = "tilt", 2

    def default_target(self) -> Array:
        return np.array([0.0, 0.0, 1.0])

    def present(self, state: State) -> Array:
        return state.base_rotation[:, 2].copy()

    def reset(self, state: State) -> None:
        """Check that the target is a unit vector.

        Raises:
            InputError: The target is not a unit vector, or the base is fixed.
        """
        super().reset(state)
        length = float(np.linalg.norm(state.base_rotation.T @ self.required_target()))
        if not abs(length - 1.0) < 1e-9:
            raise InputError("the target is not a unit vector", where=self.name, hint="normalize it")

    def error(self, state: State) -> Array:
        """Return the x and y components of the rotation vector (angle in rad times axis), shape (2,)."""
        x, y, z = (state.base_rotation.T @ self.required_target()).tolist()
        sine = math.hypot(x, y)
        if sine < 1e-12:
            # The z axis of the base points along the target or opposite to it.  If opposite, all perpendicular
            # rotation axes are equally good, so the code selects the x axis.
            return np.array([0.0 if z > 0 else math.pi, 0.0])
        scale = math.atan2(sine, z) / sine
        return np.array([-scale * y, scale * x])


class BaseOrientation(_BaseTurn):
    """Regulate the orientation of the base with the error ``e = log₃(RᵀR_des)`` in base axes.

    ``J`` selects ω from ν (3 × nv).

    Attributes:
        target: Desired orientation ``R_des``, world from base, shape (3, 3); by default, the orientation at
            ``reset``.
    """

    title, rows = "base orientation", 3

    def present(self, state: State) -> Array:
        return np.array(state.base_rotation)

    def error(self, state: State) -> Array:
        return np.asarray(pin.log3(state.base_rotation.T @ self.required_target()))


class CenterOfMass(TargetTask[Array]):
    """Regulate the world position ``c`` of the center of mass of a floating robot: ``e = c_des − c`` (3 × nv).

    Attributes:
        target: Desired position ``c_des``, world, m, shape (3,); by default, the position at ``reset``.
    """

    title, rows = "center of mass", 3

    def present(self, state: State) -> Array:
        return state.center_of_mass()[0]

    def error(self, state: State) -> Array:
        return np.asarray(self.required_target() - state.center_of_mass()[0])

    def jacobian(self, state: State) -> Array:
        return state.center_of_mass()[1]

    def drift(self, state: State) -> Array:
        return state.center_of_mass()[2]


class BodyTaskLead:
    """Move the targets of center of mass and base orientation along a reference motion."""

    def __init__(self, model: pin.Model) -> None:
        self._model, self._data = model, model.createData()
        self._led: tuple[BaseOrientation | CenterOfMass, ...] = ()
        # Keep views on the results of Pinocchio, because reading its attributes takes longer than the computation.
        data = self._data
        self._com, self._rotation = (data.com[0], data.vcom[0], data.acom[0]), data.oMi[1].rotation

    def lead(self, tasks: Sequence[BaseOrientation | CenterOfMass], q: Array, v: Array, a: Array) -> None:
        """Set the targets of ``tasks`` to their outputs in the motion ``q``, ``ν``, ``ν̇``."""
        self._led = tuple(tasks)
        pin.centerOfMass(self._model, self._data, q, v, a, False)
        position, velocity, acceleration = self._com
        for task in self._led:
            if isinstance(task, CenterOfMass):
                task.target = position.copy()
                task.target_velocity, task.target_acceleration = velocity, acceleration
            else:
                task.target = self._rotation.copy()
                task.target_velocity, task.target_acceleration = v[3:6], a[3:6]

    def reset(self, state: State) -> None:
        """Set each target that :meth:`lead` changed to the present output, with zero velocity and acceleration."""
        for task in self._led:
            task.target, task.target_velocity, task.target_acceleration = None, 0.0, 0.0
            task.reset(state)
        self._led = ()
