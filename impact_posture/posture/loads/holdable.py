"""The constraint that thrusts, torques and contact forces within their limits can hold the posture."""

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

# Rows are added to the program if a posture violates them by more than this value.  The tolerance of the certificate
# is twice this value.
_KEPT = 5e-9
# If an actuator share differs from 1 by less than this value, its row may be active and have a multiplier.
_NEAR = 1e-3
# Weight of a violated actuator limit in the search for conflicts (:attr:`Constraint.price`).  A position error has a
# higher weight, so the search reports the actuators as the conflict, and not the pose.
_PRICE = 1e-3


class Holdable(Constraint):
    """The constraint that some forces z balance the base while no actuator exceeds its limits.

    In the nonlinear program, the rows ``R τ(q, z) + r`` of :class:`Equilibrium` must be within bounds.  ``c(q)`` has
    one row for the unbalanced wrench on the base, and for each actuator the row ``share − 1``, where 1 is the share
    at a limit.

    Args:
        name: Name of the load, such as ``at rest``.
        active: Whether the program contains the rows.  Most optima satisfy the limits without the rows, and a program
            without the rows is faster.  So :meth:`grown` adds the rows to the program only if an optimum violates a
            limit.
    """

    price = _PRICE
    # Initial postures are not projected onto this constraint, so that they remain diverse.  Most searches end within
    # the actuator limits even so.
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

    def size(self, name: str, violation: float) -> str:
        if name == self._balance:
            return f"off by {violation:.3g} of the weight"
        k = self._names.index(name)
        low, high, unit = self._rest.lower[k], self._rest.upper[k], self._rest.units[k]
        if low == -high:
            return f"needs {high * (1 + violation):.6g} {unit}, limit {high:.4g} {unit}"
        return f"{(high - low) / 2 * violation:.3g} {unit} outside {low:.4g} to {high:.4g} {unit}"

    def evaluate(self, model: Numeric) -> tuple[Array, Array]:
        forces = self._rest.distribute(model.q)
        # If the base is not balanced, the shares are not known, so their rows are reported as satisfied.
        shares = np.full(len(self._names), -1.0) if forces.unbalanced else np.abs(forces.shares) - 1
        return np.append(forces.unbalanced, shares), forces.jacobian

    def value(self, model: Numeric) -> Array:
        """Return ``c(q)``, or zeros if nearly even forces (:meth:`Equilibrium.spares`) hold the posture."""
        return np.zeros(self.rows) if self._rest.spares(model.q, 0.0) else self.evaluate(model)[0]

    def grown(self, model: Numeric, auxiliaries: Array | None = None) -> Self:
        """Return the constraint with its rows in the program if ``model.q`` violates the constraint."""
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

        If the program lacks the rows of this constraint, the forces that minimize the largest share are used.  If
        nearly even forces (:meth:`Equilibrium.spares`) stay away from all limits, no rows are returned.
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
    """The rotors can produce the wrench ``h(q)`` on the base: ``R h(q) = 0``.

    For example, parallel rotors produce no side force, so the robot has to be level to hold its weight.  ``rows`` is
    the matrix ``R``, shape (6 − rank of the allocation, 6).  Each row is a combination of the base wrench that the
    rotors cannot produce, in units of the robot's weight.
    """

    price = _PRICE
    unit = "of the weight"

    def __init__(self, name: str, load: StaticLoad, rows: Array) -> None:
        self.name, self._load = f"force on the base that the rotors cannot exert {name}", load
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
