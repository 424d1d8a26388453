"""Tasks of the whole body: tilt and orientation of a floating base, center of mass."""

from __future__ import annotations

import math

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray

from impact_posture.errors import InputError
from impact_posture.tsid.frame_tasks import without_target
from impact_posture.tsid.state import State
from impact_posture.tsid.task import Task

Array = NDArray[np.float64]


class _BaseTurn(Task):
    """What turns with the base: its ``J`` picks the first rows of ω out of ν, in base axes, so that ``J̇ν = 0``."""

    constant = True

    def __init__(
        self, name: str, size: int, *, kp: ArrayLike = 0.0, kd: ArrayLike | None = None, weight: ArrayLike = 1.0
    ) -> None:
        super().__init__(name, size, kp=kp, kd=kd, weight=weight)
        self._jacobian, self._zero = np.zeros((size, 0)), np.zeros(size)

    def jacobian(self, state: State) -> Array:
        """Rows of the base's ω, shape (size, nv)."""
        if self._jacobian.shape[1] != state.nv:
            self._jacobian = np.eye(self.size, state.nv, 3)
        return self._jacobian

    def drift(self, state: State) -> Array:
        """Zero: base angular velocity is part of ν."""
        return self._zero


class Tilt(_BaseTurn):
    """Reduced attitude of the base: where its z axis points; yaw stays free (2 × nv).

    ``e`` is the shortest rotation that takes the base's z axis to ``target`` (Brescianini and D'Andrea 2018), its x
    and y in base axes; ``J`` picks ``ω_x, ω_y`` out of ν, hence ``J̇ν = 0``.

    Attributes:
        target: Unit vector in the world along which the base's z axis is wanted, shape (3,); up by default.
    """

    def __init__(
        self, *, name: str = "tilt", kp: ArrayLike = 100.0, kd: ArrayLike | None = None, weight: ArrayLike = 1.0
    ) -> None:
        super().__init__(name, 2, kp=kp, kd=kd, weight=weight)
        self.target = np.array([0.0, 0.0, 1.0])

    def reset(self, state: State) -> None:
        """Check the target's length.

        Raises:
            InputError: It is not of unit length, or the base is fixed.
        """
        _ = state.base_rotation
        if not abs(float(np.linalg.norm(self.target)) - 1.0) < 1e-9:
            raise InputError("the target is no unit vector", where=self.name, hint="normalize it")

    def error(self, state: State) -> Array:
        """Angle (rad) times axis."""
        x, y, z = (state.base_rotation.T @ self.target).tolist()
        sine = math.hypot(x, y)
        if sine < 1e-12:
            # Aligned, or upside down: there every axis is as short as any other.
            return np.array([0.0 if z > 0 else math.pi, 0.0])
        scale = math.atan2(sine, z) / sine
        return np.array([-scale * y, scale * x])


class BaseOrientation(_BaseTurn):
    """Orientation of the base: ``e = log₃(RᵀR_des)`` in base axes, ``J`` picks ω out of ν (3 × nv).

    Attributes:
        target: ``R_des``, world from base, shape (3, 3); what it is at ``reset`` unless set.
    """

    def __init__(
        self,
        *,
        name: str = "base orientation",
        kp: ArrayLike = 100.0,
        kd: ArrayLike | None = None,
        weight: ArrayLike = 1.0,
    ) -> None:
        super().__init__(name, 3, kp=kp, kd=kd, weight=weight)
        self.target: Array | None = None

    def reset(self, state: State) -> None:
        """Take the present orientation as target unless one is set.

        Raises:
            InputError: The base is fixed.
        """
        if self.target is None:
            self.target = np.array(state.base_rotation)

    def error(self, state: State) -> Array:
        """``log₃(RᵀR_des)``."""
        if self.target is None:
            raise without_target(self.name)
        return np.asarray(pin.log3(state.base_rotation.T @ self.target))


class CenterOfMass(Task):
    """World position of the center of mass of a floating robot (3 × nv).

    Attributes:
        target: Meters, shape (3,); where it is at ``reset`` unless set.
    """

    def __init__(
        self,
        *,
        name: str = "center of mass",
        kp: ArrayLike = 100.0,
        kd: ArrayLike | None = None,
        weight: ArrayLike = 1.0,
    ) -> None:
        super().__init__(name, 3, kp=kp, kd=kd, weight=weight)
        self.target: Array | None = None

    def reset(self, state: State) -> None:
        """Take the present center of mass as target unless one is set.

        Raises:
            InputError: The base is fixed.
        """
        if self.target is None:
            self.target = state.center_of_mass()[0]

    def error(self, state: State) -> Array:
        """``c_des − c``."""
        if self.target is None:
            raise without_target(self.name)
        return np.asarray(self.target - state.center_of_mass()[0])

    def jacobian(self, state: State) -> Array:
        """``∂c/∂ν``."""
        return state.center_of_mass()[1]

    def drift(self, state: State) -> Array:
        """``J̇ν``."""
        return state.center_of_mass()[2]
