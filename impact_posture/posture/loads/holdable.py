"""The constraint that a robot can hold its posture: thrusts, torques and contact forces within their limits."""

from __future__ import annotations

from typing import Self

import casadi as ca
import numpy as np

from impact_posture.dynamics.numeric import Numeric
from impact_posture.dynamics.tree import Tree
from impact_posture.impact.quantities.lifted_form import Guess
from impact_posture.posture.constraints.constraint import (
    Constraint,
    ExpressionConstraint,
    LiftedRows,
    Linearization,
    digest,
)
from impact_posture.posture.loads.equilibrium import Equilibrium
from impact_posture.posture.loads.static_load import StaticLoad
from impact_posture.system.arrays import Array

# The program lacks the rows if a posture violates them by more than this, half of what the certificate allows.
_KEPT = 5e-9
# A share of a limit closer to 1 than this may have a multiplier.
_NEAR = 1e-3
# A share of a limit counts less than meters: where a pose cannot be held, the actuators are the reason.
_PRICE = 1e-3


class Holdable(Constraint):
    """Forces z exist with ``R τ(q, z)`` within bounds: the base is balanced, and no actuator exceeds its limits.

    ``c(q)`` has a row for the unbalanced wrench of the base, and ``share − 1`` for each actuator at the forces with
    the least largest share.

    Args:
        name: The load in words, such as ``at rest``.
        active: Whether the program has the rows.  Most optima keep the limits anyway, and a program without the rows
            is faster, so :meth:`grown` adds them only where an optimum violates a limit.
    """

    price = _PRICE
    # Most starts end within the limits anyway, and starts that are pulled onto this constraint are less diverse.
    projected = False
    by_row = True

    def __init__(self, name: str, equilibrium: Equilibrium, description: str, active: bool = False) -> None:
        self.name, self._load, self._description, self._rest = f"holding {name}", name, description, equilibrium
        rest, self.active = equilibrium, active
        self._balance = f"balance of the base {name}"
        self._names = [f"{kind} of {part} {name}" for kind, part in zip(rest.kinds, rest.actuators, strict=True)]
        self.parameters = np.zeros(0)
        self.lower = np.full(1 + len(self._names), -np.inf)
        self.upper = np.zeros(1 + len(self._names))

    def describe(self) -> str:
        return self._description

    @property
    def structure(self) -> str:
        return f"{super().structure}:{digest(self._rest.rows, self._rest.offset, *self._rest.load.content)}"

    def row_name(self, row: int) -> str:
        return self._names[row - 1] if row else self._balance

    def evaluate(self, model: Numeric) -> tuple[Array, Array]:
        forces = self._rest.distribute(model.q)
        # Without a balance no torque is known.
        shares = np.full(len(self._names), -1.0) if forces.unbalanced else np.abs(forces.shares) - 1
        return np.append(forces.unbalanced, shares), forces.jacobian

    def value(self, model: Numeric) -> Array:
        """Return ``c(q)``, or zeros if even forces show that the posture can be held."""
        return np.zeros(self.rows) if self._rest.spares(model.q, 0.0) else self.evaluate(model)[0]

    def grown(self, model: Numeric, auxiliaries: Array | None = None) -> Self:
        """Add the rows where a posture violates them; this is rare, so a program without them is worth compiling."""
        if self.active or self.value(model).max() <= _KEPT:
            return self
        return type(self)(self._load, self._rest, self._description, active=True)

    @property
    def _bounds(self) -> tuple[Array, Array]:
        upper = np.ones(len(self._rest.rows))
        upper[: self._rest.balanced] = 0.0
        return -upper, upper

    @property
    def lifted_bounds(self) -> tuple[Array, Array]:
        return self._bounds if self.active else (np.zeros(0), np.zeros(0))

    def lift(self, tree: Tree, parameters: ca.SX) -> LiftedRows:
        if not self.active:
            return LiftedRows(ca.SX(0, 1))
        z = ca.SX.sym("z", self._rest.load.count)
        return LiftedRows(_sparse(self._rest.rows) @ self._rest.load.symbolic(tree, z) + self._rest.offset, z)

    @property
    def unknowns(self) -> int:
        return self._rest.load.count if self.active else 0

    def guess(self, model: Numeric) -> Guess:
        if not self.active:
            return Guess(np.zeros(0), np.zeros(0))
        load = self._rest.load
        return Guess(self._rest.distribute(model.q).forces, load.lower, load.upper)

    def linearize(self, model: Numeric, auxiliaries: Array) -> Linearization:
        """Return the rows of :meth:`lift` and the bounds of the forces.

        If the program lacks the rows, the forces have the least largest share.  No row is returned where even forces
        stay away from all limits.
        """
        rest, load, z = self._rest, self._rest.load, auxiliaries
        if not self.active:
            if rest.spares(model.q, _NEAR):
                return Linearization.joined([], model.model.nv)
            z = rest.distribute(model.q).forces
        torque = load.torque(model.q, z)
        lower, upper = self._bounds
        rows = [self._balance] * rest.balanced + self._names[: len(rest.rows) - rest.balanced]
        return Linearization(
            [*rows, *(f"force of {name} {self._load}" for name in load.names)],
            np.concatenate([rest.rows @ torque.value + rest.offset, z]),
            np.concatenate([lower, load.lower]),
            np.concatenate([upper, load.upper]),
            np.vstack([rest.rows @ torque.by_posture, np.zeros((load.count, model.model.nv))]),
            np.vstack([rest.rows @ torque.by_force, np.eye(load.count)]),
        )


class ReachableWrench(ExpressionConstraint):
    """The rotors can make the wrench on the base: ``R h(q) = 0`` for the combinations that they cannot make.

    For example, rotors in one plane make no side force, so the robot has to be level to hold its weight.  ``rows``
    are ``R`` on the base wrench in weights, shape (6 − rank of the allocation, 6).
    """

    price = _PRICE

    def __init__(self, name: str, load: StaticLoad, rows: Array) -> None:
        self.name, self._load = f"force on the base beyond the rotors {name}", load
        self._rows = np.hstack([rows, np.zeros((len(rows), load.model.nv - 6))])
        self.parameters = np.zeros(0)
        self.lower = self.upper = np.zeros(len(rows))

    @property
    def structure(self) -> str:
        return f"{super().structure}:{digest(self._rows, *self._load.content)}"

    def describe(self) -> str:
        return f"no {self.name}"

    def symbolic(self, tree: Tree, parameters: ca.SX) -> ca.SX:
        return _sparse(self._rows) @ self._load.symbolic(tree, ca.SX(0, 1))

    def evaluate(self, model: Numeric) -> tuple[Array, Array]:
        torque = self._load.torque(model.q, np.zeros(0))
        return self._rows @ torque.value, self._rows @ torque.by_posture


def _sparse(matrix: Array) -> ca.SX:
    return ca.SX(ca.sparsify(ca.DM(matrix)))
