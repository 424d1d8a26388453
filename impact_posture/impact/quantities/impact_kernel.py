"""The impact quantities and their tangent gradients as CasADi expressions, derived in ``docs/theory.md``.

If supports with compliance ε keep the feet in place, ``M + J_sᵀJ_s/ε`` replaces ``M`` in every formula below.  ``M +
J_sᵀJ_s/ε`` is the mass matrix of a robot with an additional point mass 1/ε at each foot.  The same code therefore
handles robots with and without supports.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import casadi as ca
import numpy as np
import pinocchio as pin

from impact_posture.dynamics.kinematics import Visits
from impact_posture.dynamics.numeric import Numeric
from impact_posture.dynamics.repeated_limbs import RepeatedLimbs
from impact_posture.dynamics.tree import ByJoint, PointOnLink, Response, Tree, Wrench
from impact_posture.impact.impact_case import ImpactCase
from impact_posture.impact.quantities.lifted_form import impact_at, in_world
from impact_posture.impact.support_compliance import support_inertia
from impact_posture.robot.robot import Robot
from impact_posture.system.arrays import Array, null_space

# Singular values of the stacked Jacobians are treated as zero below this fraction of the largest singular value.
_FROZEN = 1e-9


class ImpactKernel:
    """Symbolic ``H, G, V, S, E, Λ_c`` and gradients of one impact.

    The symbol ``q`` has shape (nq, 1).  The symbol ``n``, shape (3, 1), is the normal in the axes ``normal_frame`` of
    the contact.  With ``limbs``, the expressions of repeated limbs (:class:`RepeatedLimbs`) differ only in
    parameters.  ``visits`` is the argument of :class:`~impact_posture.dynamics.tree.Tree`.
    """

    def __init__(
        self,
        case: ImpactCase,
        q: ca.SX,
        n: ca.SX,
        limbs: RepeatedLimbs | None = None,
        visits: Visits | None = None,
    ) -> None:
        self.case, self.metric, self.q, self.n = case, case.metric, q, n
        extra = support_inertia(case.robot, case.supports, case.compliance)
        couplings = case.robot.coupled_entries
        self.tree = Tree(case.robot.model, q, None, extra, limbs, couplings, visits)
        self.point = case.point
        self._supported = bool(case.supports)

    @cached_property
    def impact(self) -> Wrench:
        """Unit impulse along the normal at the contact point."""
        return impact_at(self.case, self.n)

    @cached_property
    def world_normal(self) -> ca.SX:
        """The normal in world axes, shape (3,)."""
        return in_world(self.case, self.tree, self.n)

    @cached_property
    def jump(self) -> Response:
        """Response of the robot to the unit impulse along the normal, with ``a = M⁻¹Jᵀn``."""
        return self.respond([self.impact])

    def _on_all_limbs(self, wrench: Wrench) -> list[Wrench]:
        """Return the wrench, or one wrench per repeated limb (:class:`RepeatedLimbs`) if it acts on such a limb.

        An indicator sets the wrenches on the other limbs to zero, so all limbs have the same operations.
        """
        limbs, joint = self.tree.limbs, wrench.point.joint
        if limbs is None or joint not in limbs.places:
            return [wrench]
        point = wrench.point
        return [
            Wrench(
                PointOnLink(link, point.position, point.rotation),
                wrench.force * (on := limbs.indicator(link, joint)),
                wrench.moment * on,
                wrench.in_frame,
            )
            for link in limbs.counterparts(joint)
        ]

    @cached_property
    def H(self) -> ca.SX:
        """H: squared jump per squared impulse, ``aᵀWa``."""
        return self.product(self.jump, self.jump)

    @cached_property
    def G(self) -> ca.SX:
        """G: inverse effective mass along the normal, ``nᵀJM⁻¹Jᵀn = 1/m_eff``, 1/kg."""
        return ca.dot(self.tree.link_force(self.impact), self.jump.velocities[self.point.joint])

    @cached_property
    def grad_H(self) -> ca.SX:
        """Tangent gradient of H, ``2 ∂_q[nᵀJb − bᵀMa]`` with ``Mb = Wa``, shape (nv,); plus ``∂_q aᵀMa`` if W = M."""
        return self.grad_G if self.metric.kind == "kinetic" and not self._supported else self.size_gradient(self.jump)

    def respond(self, impacts: Sequence[Wrench]) -> Response:
        """Return the response of the robot to simultaneous impulses at any points."""
        return self.tree.respond(wrenches=[part for impact in impacts for part in self._on_all_limbs(impact)])

    def product(self, first: Response, second: Response) -> ca.SX:
        """Return ``a₁ᵀWa₂`` for the velocity jumps of two responses."""
        return ca.dot(first.a, self._weigh(second.a, second.velocities))

    def size_gradient(self, jump: Response, r: Sequence[Wrench] = ()) -> ca.SX:
        """Return the tangent gradient of ``aᵀWa`` for the velocity jump ``a`` of a response, shape (nv,).

        If ``r`` is empty, the impulses that cause the jump are constant.  If not, impulses ``p(q)`` at the points of
        ``r`` cause the jump, and ``∂pᵀJM⁻¹Wa = rᵀ∂B p`` with ``B = JM⁻¹Jᵀ``.
        """
        if self.metric.kind == "kinetic" and not self._supported and not r:
            return self.tree.pair_gradient(jump, jump)
        pushed = [part for impulse in r for part in self._on_all_limbs(impulse)]
        adjoint = self.tree.respond(self._weigh(jump.a, jump.velocities), pushed)
        gradient = 2 * self.tree.pair_gradient(jump, adjoint)
        if self.metric.kind == "kinetic":
            gradient = gradient + self.tree.energy_gradient(jump.velocities)
        return gradient

    def adjoint_velocity(self, x: Response, points: Sequence[PointOnLink] = ()) -> ca.SX:
        """Return ``JM⁻¹Wa`` for the velocity jump ``a`` of a response, world axes, shape (3m,).

        ``J`` belongs to the points, by default to the contact point.
        """
        free = self.tree.respond(tau=self._weigh(x.a, x.velocities))
        return self.tree.point_velocities(points or [self.point], free.velocities)

    @cached_property
    def grad_G(self) -> ca.SX:
        """Tangent gradient of G, ``∂_q[2nᵀJa − aᵀMa]``, shape (nv,)."""
        return self.tree.pair_gradient(self.jump, self.jump)

    @cached_property
    def V(self) -> ca.SX:
        """V: squared jump per squared approach speed without friction, ``H/G²``."""
        return self.H / self.G**2

    @cached_property
    def grad_V(self) -> ca.SX:
        """Tangent gradient of V, shape (nv,)."""
        return self.grad_H / self.G**2 - 2 * self.H / self.G**3 * self.grad_G

    @cached_property
    def E(self) -> ca.SX:
        """E: dissipated energy per squared approach speed, ``1/(2G) = m_eff/2``, kg."""
        return 1 / (2 * self.G)

    @cached_property
    def grad_E(self) -> ca.SX:
        """Tangent gradient of E, shape (nv,)."""
        return -self.grad_G / (2 * self.G**2)

    @cached_property
    def _axes(self) -> list[Response]:
        """Responses ``M⁻¹Jᵀe_k`` to unit impulses along the three world axes."""
        eye = np.eye(3)
        return [self.respond([self._force(ca.SX(eye[k]))]) for k in range(3)]

    @cached_property
    def ellipsoid(self) -> ca.SX:
        """Dynamic impact ellipsoid ``Λ_c = J M⁻¹ W M⁻¹ Jᵀ``, world axes, shape (3, 3)."""
        columns = [self._weigh(x.a, x.velocities) for x in self._axes]
        return ca.blockcat([[ca.dot(self._axes[i].a, columns[j]) for j in range(3)] for i in range(3)])

    @cached_property
    def mobility(self) -> ca.SX:
        """Mobility of the contact point, ``J M⁻¹ Jᵀ``, world axes, shape (3, 3), 1/kg."""
        return ca.horzcat(*[self.tree.point_velocity(self.point, x.velocities)[:3] for x in self._axes])

    @cached_property
    def _mobility_inverse(self) -> ca.SX:
        """``(JM⁻¹Jᵀ)⁻¹``, or the pseudo-inverse of ``JM⁻¹Jᵀ`` for a planar robot."""
        frozen = frozen_directions(self.case.robot, self.point)
        return _inverse3(self.mobility + frozen if frozen.any() else self.mobility)

    @cached_property
    def sticking_form(self) -> ca.SX:
        """Matrix ``K = (JM⁻¹Jᵀ)⁻¹Λ_c(JM⁻¹Jᵀ)⁻¹``, shape (3, 3), with ``S = nᵀKn`` for the world normal ``n``."""
        return self._mobility_inverse.T @ self.ellipsoid @ self._mobility_inverse

    @cached_property
    def _sticking(self) -> Response:
        """Response to the impulse ``s = (JM⁻¹Jᵀ)⁻¹n`` per unit approach speed."""
        return self.respond([self._force(self._mobility_inverse @ self.world_normal)])

    @cached_property
    def S(self) -> ca.SX:
        """``‖M⁻¹Jᵀ(JM⁻¹Jᵀ)⁻¹n‖²_W``: squared jump per squared approach speed if the contact point sticks."""
        return self.product(self._sticking, self._sticking)

    @cached_property
    def grad_S(self) -> ca.SX:
        """Tangent gradient of S, ``2 ∂_q[sᵀJb + rᵀJa − bᵀMa]``, shape (nv,).

        ``b`` and ``r`` are the adjoint variables of the velocity jump ``a`` and of the impulse ``s``.  If the normal
        turns with the robot, ``−2 ∂_q rᵀn(q)`` is added.
        """
        x = self._sticking
        r = -self._mobility_inverse @ self.adjoint_velocity(x)
        gradient = self.size_gradient(x, [self._force(r)])
        if self.case.in_contact_frame:
            gradient = gradient - 2 * self.tree.turning_gradient(self.point, self.world_normal, r)
        return gradient

    def _weigh(self, a: ca.SX, velocities: ByJoint) -> ca.SX:
        if self.metric.kind == "kinetic":
            return self.tree.mass_times(a, velocities, extra=False)
        followers = self.case.robot.followers
        if self.metric.weights is None and not followers.any():
            return a
        return self.tree.by_joint("weight", self.metric.diagonal(self.tree.nv) * ~followers) * a

    def _force(self, impulse: ca.SX) -> Wrench:
        return Wrench(self.point, impulse, ca.SX.zeros(3))


def frozen_directions(robot: Robot, point: PointOnLink) -> Array:
    """Return the projector onto the world directions in which a point cannot move at any posture, shape (3, 3).

    The projector is zero except for planar robots.  For impulses along the other directions, the inverse of
    ``JM⁻¹Jᵀ + projector`` equals the pseudo-inverse of ``JM⁻¹Jᵀ``.
    """
    numeric, generator = Numeric(robot.model), np.random.default_rng(0)
    samples = [
        pin.integrate(robot.model, pin.neutral(robot.model), generator.normal(size=robot.nv)) for _ in range(3)
    ]
    J = np.hstack([numeric.at(q).jacobian(point)[:3] @ robot.coupling_matrix for q in samples])
    missing = null_space(J.T, _FROZEN)
    return np.asarray(missing @ missing.T)


def _inverse3(A: ca.SX) -> ca.SX:
    """Return the inverse of a symmetric 3×3 matrix by cofactors."""
    rows = [A[k, :].T for k in range(3)]
    cofactors = ca.horzcat(ca.cross(rows[1], rows[2]), ca.cross(rows[2], rows[0]), ca.cross(rows[0], rows[1]))
    return cofactors / ca.dot(rows[0], cofactors[:, 0])
