"""Replace constants of a model by parameters, so that models with different constants share expressions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import casadi as ca
import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from impact_posture.dynamics.repeated_limbs import RepeatedLimbs
from impact_posture.dynamics.spatial import constant, rounded
from impact_posture.robot.model_joints import finite_armature, v_slice
from impact_posture.robot.robot import Robot
from impact_posture.system.arrays import Array


class ModelParameters(RepeatedLimbs):
    """Parameters for the nonzero armatures and joint positions of a model, in which no limbs are treated as repeated.

    Attributes:
        symbol: CasADi symbol that stacks all parameters, shape (n, 1), with n ≥ 1.
        values: Values of the parameters, shape (n,).
    """

    def __init__(self, model: pin.Model) -> None:
        self.groups, self.places, self.parameters = (), {}, {}
        numbers = _numbers(model)
        entries = np.concatenate([*numbers.values(), np.zeros(0)])
        self.values: Array = entries[entries != 0.0] if entries.any() else np.ones(1)
        self.symbol = ca.SX.sym("numbers", self.values.size)
        self._parameters: dict[tuple[int, str], ca.SX] = {}
        count = 0
        for key, values in numbers.items():
            self._parameters[key] = ca.SX(values.size, 1)
            for k in np.flatnonzero(values):
                self._parameters[key][int(k)] = self.symbol[count]
                count += 1

    def constant(self, joint: int, tag: str, of: Callable[[int], ArrayLike]) -> ca.SX:
        """Return a constant of a joint as an expression, with parameters for armature and position."""
        parameters = self._parameters.get((joint, tag))
        return constant(of(joint)) if parameters is None else parameters


def without_parameters(robot: Robot) -> Robot:
    """Return a copy of the robot with all nonzero parameters set to one; robots with equal copies can share code."""
    model, armature = robot.model.copy(), np.array(robot.model.armature)
    finite = np.isfinite(armature)
    armature[finite] = rounded(armature[finite]) != 0.0
    model.armature = armature
    for placement in model.jointPlacements:
        placement.translation = (rounded(placement.translation) != 0.0).astype(float)
    return replace(robot, model=model, stated_armature=None)


def _numbers(model: pin.Model) -> dict[tuple[int, str], Array]:
    """Return the constants that become parameters: (joint index, kind of constant) → values."""
    armature, numbers = finite_armature(model)[0], dict[tuple[int, str], Array]()
    for joint in range(1, model.njoints):
        numbers[joint, "translation"] = rounded(model.jointPlacements[joint].translation)
        numbers[joint, "armature"] = rounded(armature[v_slice(model, joint)])
    return numbers
