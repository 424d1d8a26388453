"""Several contacts that arrive at the same time and at the same speed, each along its normal, and then stick.

With the stacked Jacobian ``J`` (3m × nv) and the stacked normals ``n`` of m contacts, the velocity jump per approach
speed is ``a = M⁻¹Jᵀs`` with ``Ja = n``.  The objective is ``aᵀWa``, as for a single contact that sticks.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import casadi as ca
import numpy as np

from impact_posture.dynamics.tree import Tree, Wrench
from impact_posture.errors import MetricError
from impact_posture.impact.objective import Subgradients
from impact_posture.impact.quantities.impact_kernel import ImpactKernel
from impact_posture.impact.quantities.impact_oracle import ImpactOracle
from impact_posture.impact.quantities.lifted_form import Guess, Lifted, in_world, unknown_jump, weighed
from impact_posture.impact.quantities.sticking_point import ImpulseResponse, StickingPoint
from impact_posture.system.arrays import Array


@dataclass(frozen=True)
class SimultaneousImpact:
    """Squared velocity jump per squared approach speed if all contact points stick.

    Attributes:
        oracles: Numeric impact quantities, one object per contact.
        attempts: Number of different initial guesses that :meth:`guess` offers.
    """

    oracles: tuple[ImpactOracle, ...]
    attempts: ClassVar[int] = 1

    @property
    def oracle(self) -> ImpactOracle:
        return self.oracles[0]

    def solve(self, q: Array) -> tuple[StickingPoint, ImpulseResponse, Array]:
        """Return the system of the impact at ``q``, the jump per approach speed, and the impulses, shape (3m,).

        Raises:
            MetricError: The contact points cannot move along their normals at the same time.
        """
        held = self._held(q)
        n = np.concatenate([oracle.n for oracle in self.oracles])
        if not held.can_move(n):
            what = "S does not exist here: the contact points cannot all move along their normals at the same time"
            hint = "choose `objective` impulse, or other contacts, or another posture"
            raise MetricError(what, where="objective sticking", hint=hint)
        return (held, *held.respond(velocity=n))

    def _held(self, q: Array) -> StickingPoint:
        return self.oracle.at(q).held_points(np.vstack([oracle.at(q).J for oracle in self.oracles]))

    def value(self, q: Array) -> float:
        _, x, _ = self.solve(q)
        return float(x.a @ self.oracle.weigh(x.a))

    def subgradients(self, q: Array, within: float = 0.0) -> Subgradients:
        """Return the gradient ``∂_q[2 Σ(s_iᵀJ_i b + r_iᵀJ_i a) − 2 bᵀMa − 2 Σ r_iᵀn_i]``, as for a single contact."""
        held, x, s = self.solve(q)
        y, r = held.respond(tau=self.oracle.weigh(x.a))
        gradient = self.oracle.metric_gradient(x.a) - 2 * self.oracle.inertial(y, x)
        for oracle, s_i, r_i in zip(self.oracles, s.reshape(-1, 3), r.reshape(-1, 3), strict=True):
            gradient = gradient + 2 * (oracle.coupling(s_i, y.a, False) + oracle.coupling(r_i, x.a, False))
            if oracle.case.in_contact_frame:
                gradient = gradient - 2 * oracle.numeric.turning_gradient(oracle.point, oracle.n, r_i)
        return Subgradients(np.asarray(gradient)[None, :], np.zeros(1))

    def check_independent(self) -> None:
        """Raise ``MetricError`` if the velocities of the contact points depend on each other.

        An example are points on one rigid link.  The impulses are then not unique, so :meth:`expressions` does not
        exist.
        """
        if self._held(self.oracle.robot.posture()).outside.size:
            what = "the velocities of the contact points depend on each other, so C code cannot compute S"
            hint = "give one contact per link, or leave out the C code (--no-codegen)"
            raise MetricError(what, where="objective sticking", hint=hint)

    def expressions(self, k: ImpactKernel) -> tuple[ca.SX, ca.SX]:
        """Return value and gradient.  Raise the error of :meth:`check_independent`."""
        self.check_independent()

        def pushed(impulses: ca.SX) -> list[Wrench]:
            parts = ca.vertsplit(impulses, 3)
            return [Wrench(o.point, part, ca.SX.zeros(3)) for o, part in zip(self.oracles, parts, strict=True)]

        count, normals = 3 * len(self.oracles), self._normals(k.tree, k.n)
        columns = [k.respond(pushed(ca.SX(column))).velocities for column in np.eye(count)]
        points = [oracle.point for oracle in self.oracles]
        B = ca.horzcat(*[k.tree.point_velocities(points, each) for each in columns])
        x = k.respond(pushed(ca.solve(B, normals)))
        r = -ca.solve(B, k.adjoint_velocity(x, points))
        gradient = k.size_gradient(x, pushed(r))
        for oracle, n, r_i in zip(self.oracles, ca.vertsplit(normals, 3), ca.vertsplit(r, 3), strict=True):
            if oracle.case.in_contact_frame:
                gradient = gradient - 2 * k.tree.turning_gradient(oracle.point, n, r_i)
        return k.product(x, x), gradient

    def lift(self, tree: Tree, parameters: ca.SX, scale: ca.SX) -> Lifted:
        case, impulses = self.oracle.case, [ca.SX.sym(f"s{i}_", 3) for i in range(len(self.oracles))]
        wrenches = [Wrench(o.point, s, ca.SX.zeros(3)) for o, s in zip(self.oracles, impulses, strict=True)]
        jump = unknown_jump(case, tree, wrenches)
        jump = jump.with_impulse(ca.vertcat(*impulses), jump.contact_velocity - self._normals(tree, parameters))
        return Lifted.of([jump], weighed(case.metric, jump, jump))

    def guess(self, q: Array, scale: float, attempt: int = 0) -> Guess:
        _, x, s = self.solve(q)
        return Guess.unbounded(np.concatenate([self.oracle.at(q).with_support_impulses(x.a), s]))

    def _normals(self, tree: Tree, n: ca.SX) -> ca.SX:
        """Return the normals in world axes, shape (3m,); ``n`` is the normal of the first contact."""
        leading, *others = [oracle.case for oracle in self.oracles]
        rest = [in_world(case, tree, ca.SX(np.array(case.contact.normal))) for case in others]
        return ca.vertcat(in_world(leading, tree, n), *rest)
