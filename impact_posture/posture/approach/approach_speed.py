"""The constraint that the joints can bring the contact to the surface at the speed of the impact."""

from __future__ import annotations

import casadi as ca
import numpy as np

from impact_posture.dynamics.numeric import Numeric
from impact_posture.dynamics.tree import Tree
from impact_posture.errors import InputError
from impact_posture.impact.quantities.lifted_form import Guess
from impact_posture.posture.approach.attainable_speed import FASTEST, AttainableSpeed
from impact_posture.posture.constraints.constraint import Constraint, LiftedRows, Linearization, digest
from impact_posture.system.arrays import Array

# Weight per m/s of missing speed in the search for conflicts (:attr:`Constraint.price`), lower than the weight of a
# position error per m.
_PRICE = 1e-3


class ApproachSpeed(Constraint):
    """``s − σ(q) ≤ 0``: the joints can bring the contact to the surface at the speed s, m/s.

    The joint velocities, divided by their limits, are unknowns of the nonlinear program.  For a strike, the joints
    also have room for a run-up (:class:`AttainableSpeed`).

    Attributes:
        speed: The speed s, m/s.

    Raises:
        InputError: There are too few joints to move the contact along the normal.
    """

    at_impact = True
    price = _PRICE
    unit = "m/s"
    # Initial postures are not projected onto this constraint, so that they remain diverse.
    projected = False

    def __init__(self, attainable: AttainableSpeed, speed: float) -> None:
        self.name = f"approach at {speed:g} m/s"
        self._attainable, self.speed, self._kept = attainable, speed, attainable.independent
        if len(self._kept) > len(attainable.free):
            points = " and ".join(point.name for point in attainable.points)
            what = f"{len(attainable.free)} joints cannot move {points} as required"
            raise InputError(what, where="approach", hint="leave out `approach`, or hold fewer joints and frames")
        self._coming = [point for point in attainable.points if point.comes]
        self.parameters = np.concatenate([[speed], *[point.axes.ravel() for point in self._coming]])
        self.lower, self.upper = np.array([-np.inf]), np.zeros(1)

    @property
    def structure(self) -> str:
        attainable = self._attainable
        parts: list[object] = [self.parameters.shape, self._kept, attainable.moves, attainable.room]
        for moved in attainable.points:
            parts += [moved.point.position, moved.point.rotation, moved.point.joint, moved.rows]
            parts += [moved.comes, moved.in_frame]
        return f"{type(self).__name__}:{digest(*parts)}"

    def slower(self, speed: float) -> ApproachSpeed:
        """Return the constraint for another speed, m/s, which has the same expressions."""
        return type(self)(self._attainable, speed)

    def describe(self) -> str:
        room = ", with room for a run-up" if self._attainable.roomy.size else ""
        return f"{self.name} within the velocity limits of the joints{room}"

    def evaluate(self, model: Numeric) -> tuple[Array, Array]:
        attained = self._attainable.at(model)
        # If the attainable speed is unbounded, use twice the required speed, so that the row stays finite.
        speed = attained.speed if np.isfinite(attained.speed) else 2 * self.speed
        return np.array([self.speed - speed]), -attained.gradient[None, :]

    @property
    def lifted_bounds(self) -> tuple[Array, Array]:
        attainable, zero = self._attainable, np.zeros(len(self._kept))
        return np.append(zero, attainable.lowest), np.append(zero, attainable.highest)

    def lift(self, tree: Tree, parameters: ca.SX) -> LiftedRows:
        attainable = self._attainable
        z = ca.SX.sym("w", len(attainable.free))
        moves = ca.SX(ca.sparsify(ca.DM(attainable.moves)))
        velocities, rows, start = tree.velocities(moves @ z), [], 1
        for moved in attainable.points:
            axes = ca.SX(moved.axes)
            if moved.comes:
                axes = ca.reshape(parameters[start : start + 9], 3, 3).T
                start += 9
            rows.append(moved.symbolic(tree, velocities, axes) + moved.arrives * parameters[0])
        begins = attainable.begins(tree.q, z)
        return LiftedRows(ca.vertcat(ca.densify(ca.vertcat(*rows)[self._kept]), begins), z)

    @property
    def unknowns(self) -> int:
        return len(self._attainable.free)

    def guess(self, model: Numeric) -> Guess:
        """Return the joint velocities of the fastest approach, scaled down to the required speed."""
        attained, upper = self._attainable.at(model), self._attainable.upper
        slower = min(1.0, self.speed / min(attained.speed, FASTEST)) if attained.speed > 0 else 1.0
        return Guess(slower * attained.velocities, -upper, upper)

    def linearize(self, model: Numeric, auxiliaries: Array) -> Linearization:
        """Linearize the rows of :meth:`lift` and the velocity limits."""
        attainable, nv = self._attainable, model.model.nv
        names = [f"motion of {moved.name} in the {self.name}" for moved in attainable.points for _ in moved.rows]
        by_posture = [attainable.by_posture(model, auxiliaries, row) for row in np.eye(len(names))]
        A, limited = attainable.jacobian(model), np.flatnonzero(np.isfinite(attainable.upper))
        bounds, zero = attainable.upper[limited], np.zeros(len(A))
        roomy = [attainable.names[k] for k in attainable.roomy]
        return Linearization(
            [
                *names,
                *(f"joint '{name}' at the beginning of the run-up" for name in roomy),
                *(f"velocity limit of {attainable.names[k]}" for k in limited),
            ],
            np.concatenate([
                A @ auxiliaries + attainable.arrives * self.speed,
                attainable.begins(model.q, auxiliaries),
                auxiliaries[limited],
            ]),
            np.concatenate([zero, attainable.lowest, -bounds]),
            np.concatenate([zero, attainable.highest, bounds]),
            np.vstack([
                np.array(by_posture), np.eye(nv)[attainable.free[attainable.roomy]], np.zeros((len(limited), nv))
            ]),
            np.vstack([A, -attainable.room, np.eye(len(auxiliaries))[limited]]),
        )  # fmt: skip
