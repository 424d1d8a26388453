"""Values that Pinocchio computes for comparison, and finite differences on the configuration manifold."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from tests.support.helpers import Vector


def central_gradient(f: Callable[[Vector], ArrayLike], model: pin.Model, q: Vector, step: float) -> Vector:
    """Compute fourth-order central differences of ``f(q ⊕ ε e_i)``; the last axis is i."""

    def along(direction: Vector) -> Vector:
        def at(k: int) -> Vector:
            return np.asarray(f(np.array(pin.integrate(model, q, k * step * direction))), dtype=float)

        return (8 * (at(1) - at(-1)) - (at(2) - at(-2))) / (12 * step)

    return np.stack([along(e) for e in np.eye(model.nv)], axis=-1)


def mass_matrix(model: pin.Model, q: Vector) -> Vector:
    """Return the full mass matrix of Pinocchio; CRBA fills only the upper triangle."""
    upper = np.triu(pin.crba(model, model.createData(), q))
    return np.asarray(upper + np.triu(upper, 1).T)


def frame_jacobian(model: pin.Model, q: Vector, frame: int, offset: ArrayLike = (0, 0, 0)) -> Vector:
    """Return Pinocchio's 6 × nv Jacobian of a point that is fixed in a frame, in LOCAL_WORLD_ALIGNED axes."""
    copy = model.copy()
    old = copy.frames[frame]
    placement = old.placement * pin.SE3(np.eye(3), np.array(offset, dtype=float))
    added = copy.addFrame(pin.Frame("there", old.parentJoint, frame, placement, pin.FrameType.OP_FRAME), False)
    J = pin.computeFrameJacobian(copy, copy.createData(), q, added, pin.LOCAL_WORLD_ALIGNED)
    return np.array(J).reshape(6, model.nv)


def frame_placement(model: pin.Model, q: Vector, frame: int) -> pin.SE3:
    data = model.createData()
    pin.framesForwardKinematics(model, data, q)
    return pin.SE3(data.oMf[frame])
