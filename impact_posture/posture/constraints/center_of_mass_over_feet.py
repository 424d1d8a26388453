"""The constraint that the center of mass stays over the feet."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pinocchio as pin

from impact_posture.dynamics.numeric import Numeric
from impact_posture.dynamics.tree import Tree
from impact_posture.posture.constraints.constraint import ExpressionConstraint
from impact_posture.system.arrays import Array


class CenterOfMassOverFeet(ExpressionConstraint):
    """The center of mass stays above the feet: ``A xy − b ≤ −margin``, meters.

    ``normals`` are ``A``, the outward unit normals of the edges of the support polygon, shape (k, 2), and ``offsets``
    are ``b``.  If ``loaded`` is given (a model and its name), the center of mass of this model is used.
    """

    unit = "m"

    def __init__(
        self, normals: Array, offsets: Array, margin: float, loaded: tuple[pin.Model, str] | None = None
    ) -> None:
        self.name = "center of mass over the feet" + (f" with {loaded[1]}" if loaded else "")
        self.normals, self.offsets, self.margin = normals, offsets, margin
        self._model = loaded[0] if loaded else None
        self.parameters = np.concatenate([normals.T.reshape(-1), offsets])
        self.lower, self.upper = np.full(len(offsets), -np.inf), np.full(len(offsets), -margin)

    def describe(self) -> str:
        return f"{self.name}, {self.margin:.3g} m inside the support polygon"

    def symbolic(self, tree: Tree, parameters: ca.SX) -> ca.SX:
        k, loaded = self.rows, tree if self._model is None else Tree(self._model, tree.q)
        center = loaded.center_of_mass()
        return parameters[:k] * center[0] + parameters[k : 2 * k] * center[1] - parameters[2 * k :]

    def evaluate(self, model: Numeric) -> tuple[Array, Array]:
        loaded = model if self._model is None else Numeric(self._model).at(model.q)
        center, jacobian = loaded.center_of_mass()
        return self.normals @ center[:2] - self.offsets, self.normals @ jacobian[:2]

    def row_name(self, row: int) -> str:
        return f"{self.name} (edge {row})"
