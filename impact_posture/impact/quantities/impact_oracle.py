"""Compute impact quantities by dense linear algebra with Pinocchio, independently of the symbolic kernel.

The symbolic kernel adds masses to the feet; this module instead solves the KKT system ``[M, −J_sᵀ; J_s, εI]``.  The
support impulses ``f`` are unknowns of this system.  Computing ``f`` as ``−J_s a/ε`` would amplify rounding errors by
1/ε.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from impact_posture.dynamics.jump_derivatives import Foot
from impact_posture.dynamics.numeric import Numeric, reduced
from impact_posture.impact.impact_case import ImpactCase
from impact_posture.impact.impact_contact import point_on
from impact_posture.impact.quantities.impact_quantities import ImpactQuantities
from impact_posture.impact.quantities.sticking_point import ImpulseResponse, StickingPoint, no_sticking
from impact_posture.system.arrays import Array

# Number of postures whose matrices are stored.  A search evaluates its initial postures repeatedly, and then reuses
# these matrices.
_KEPT = 32


@dataclass(eq=False)
class _Factorized:
    """Matrices at one posture; ``quantities`` is ``None`` until the impact quantities are computed."""

    M: Array
    J: Array
    Js: Array
    kkt: Array
    n: Array
    quantities: ImpactQuantities | None = None


class ImpactOracle:
    """Numeric ``H, G, V, S, E, Λ_c`` and tangent gradients of one impact.

    The attributes ``M``, ``J``, ``Js`` and ``n`` (world normal) belong to the posture of the last call of :meth:`at`.
    """

    def __init__(self, case: ImpactCase) -> None:
        self.case, self.robot, self.contact, self.metric = case, case.robot, case.contact, case.metric
        self.numeric = Numeric(case.robot.model)
        self.point = case.point
        self.feet = [Foot(point_on(case.robot, s.frame, s.offset), s.rows) for s in case.supports]
        self.compliance = case.compliance
        self._nv = case.robot.nv
        self._key = b""
        self._known: dict[bytes, _Factorized] = {}

    def at(self, q: Array) -> ImpactOracle:
        """Set the posture to ``q``; the matrices of recent postures are stored and reused."""
        q = np.array(q, dtype=float)
        if (key := q.tobytes()) != self._key:
            self.numeric.at(q)
            # The dictionary is in the order of the calls, so its first entry is the oldest posture.
            self._known[key] = known = self._known.pop(key, None) or self._factorized()
            if len(self._known) > _KEPT:
                del self._known[next(iter(self._known))]
            self.M, self.J, self.Js, self._kkt, self.n = known.M, known.J, known.Js, known.kkt, known.n
            self._key = key
        return self

    def _factorized(self) -> _Factorized:
        num = self.numeric
        parts = [num.jacobian(foot.point)[: foot.rows] for foot in self.feet]
        Js = np.vstack(parts) if parts else np.zeros((0, self._nv))
        M, J, Js = reduced(self.robot.projector, num.mass_matrix(), num.jacobian(self.point)[:3], Js)
        kkt = np.zeros((self._nv + len(Js),) * 2)
        kkt[: self._nv, : self._nv], kkt[: self._nv, self._nv :], kkt[self._nv :, : self._nv] = M, -Js.T, Js
        np.fill_diagonal(kkt[self._nv :, self._nv :], self.compliance)
        return _Factorized(M, J, Js, kkt, self._normals(None)[1])

    def respond(self, tau: Array, slip: Array | None = None) -> ImpulseResponse:
        """Solve ``M a − J_sᵀf = τ, J_s a + εf = slip`` for ``a`` and ``f``.

        ``tau`` is a vector, or a matrix with one right-hand side per column.  ``slip`` is zero by default.
        """
        rhs: Array = np.zeros((len(self._kkt), *tau.shape[1:]))
        rhs[: self._nv] = self.robot.projector.T @ tau
        if slip is not None:
            rhs[self._nv :] = slip
        solution = np.asarray(np.linalg.solve(self._kkt, rhs), dtype=np.float64)
        return ImpulseResponse(self.robot.projector @ solution[: self._nv], solution[self._nv :])

    def solve(self, tau: Array) -> Array:
        """Return ``(M + J_sᵀJ_s/ε)⁻¹ τ`` for a vector ``tau`` or for each column of a matrix."""
        return self.respond(tau).a

    def held_points(self, J: Array) -> StickingPoint:
        """Return the system for m points whose velocities are given; ``J`` is their Jacobian, shape (3m, nv)."""
        return StickingPoint.of(self._kkt, J, J @ self.solve(J.T), self.robot.projector)

    def weigh(self, a: Array) -> Array:
        """Return ``W a``.  The entries of joints that follow another joint are zero."""
        weighed = self.M @ a if self.metric.kind == "kinetic" else (self.metric.diagonal(self._nv) * a.T).T
        return np.asarray((weighed.T * ~self.robot.followers).T)

    def quantities(self, q: Array) -> ImpactQuantities:
        """Return all impact quantities at ``q``; results for recent postures are stored and reused."""
        known = self.at(q)._known[self._key]
        if known.quantities is not None:
            return known.quantities
        answers = self.respond(self.J.T)
        A = answers.a
        mobility = self.J @ A
        mobility = (mobility + mobility.T) / 2
        ellipsoid = A.T @ self.weigh(A)
        a = A @ self.n
        H, G = float(a @ self.weigh(a)), float(self.n @ mobility @ self.n)
        held = StickingPoint.of(self._kkt, self.J, mobility, self.robot.projector)
        stuck, s = None, None
        if held.can_move(self.n):
            response, s = held.respond(velocity=self.n)
            stuck = response.a
        known.quantities = ImpactQuantities(
            H=H,
            G=G,
            V=H / G**2 if G > 0 else float("inf"),
            S=None if stuck is None else float(stuck @ self.weigh(stuck)),
            E=1 / (2 * G) if G > 0 else float("inf"),
            jump=a,
            sticking_jump=stuck,
            sticking_impulse=s,
            ellipsoid=(ellipsoid + ellipsoid.T) / 2,
            mobility=mobility,
            normal=self.n.copy(),
            support_impulse=np.asarray(answers.f @ self.n),
        )
        return known.quantities

    def with_support_impulses(self, a: Array) -> Array:
        """Return ``a``, followed by the support impulses ``−J_s a/ε`` in foot axes, at the last posture."""
        f = -self.Js @ a / self.compliance
        parts, start = [a], 0
        for foot in self.feet:
            R = np.array(self.numeric.placement(foot.point).rotation)
            parts += [R.T @ f[k : k + 3] for k in range(start, start + foot.rows, 3)]
            start += foot.rows
        return np.concatenate(parts)

    def gradient_H(self, q: Array, normal: Array | None = None) -> Array:
        """Return the tangent gradient of H, shape (nv,).

        If given, ``normal``, shape (3,), replaces the normal of the contact, in the axes ``normal_frame``.
        """
        self.at(q)
        normal, n = self._normals(normal)
        x = self.respond(self.J.T @ n)
        y = self.respond(self.weigh(x.a))
        gradient = 2 * (self.coupling(normal, y.a, self.case.in_contact_frame) - self.inertial(y, x))
        return gradient + self.metric_gradient(x.a)

    def gradient_G(self, q: Array, normal: Array | None = None) -> Array:
        """Return the tangent gradient of G, shape (nv,), with ``normal`` as in :meth:`gradient_H`."""
        self.at(q)
        normal, n = self._normals(normal)
        x = self.respond(self.J.T @ n)
        return 2 * self.coupling(normal, x.a, self.case.in_contact_frame) - self.inertial(x, x)

    def gradient_S(self, q: Array, normal: Array | None = None) -> Array:
        """Return the tangent gradient of S, shape (nv,), with ``normal`` as in :meth:`gradient_H`.

        If ``JM⁻¹Jᵀ`` is singular, the contact point can move only in the directions of a plane or a line.  The
        gradient is correct if this plane or line has a constant orientation, as for a planar robot.

        Raises:
            MetricError: S does not exist at ``q``.
        """
        self.at(q)
        _, n = self._normals(normal)
        held = self.held_points(self.J)
        if not held.can_move(n):
            raise no_sticking()
        x, s = held.respond(velocity=n)
        y, r = held.respond(tau=self.weigh(x.a))
        gradient = 2 * (self.coupling(s, y.a, False) + self.coupling(r, x.a, False) - self.inertial(y, x))
        if self.case.in_contact_frame:
            gradient = gradient - 2 * self.numeric.turning_gradient(self.point, n, r)
        return gradient + self.metric_gradient(x.a)

    def gradient_V(self, q: Array) -> Array:
        """Return the tangent gradient of V, ``∇H/G² − 2H/G³ ∇G``, shape (nv,)."""
        quantities = self.quantities(q)
        return self.gradient_H(q) / quantities.G**2 - 2 * quantities.H / quantities.G**3 * self.gradient_G(q)

    def gradient_E(self, q: Array) -> Array:
        """Return the tangent gradient of E, ``−∇G/(2G²)``, shape (nv,)."""
        return -self.gradient_G(q) / (2 * self.quantities(q).G ** 2)

    @property
    def axes(self) -> Array:
        """Axes ``normal_frame`` of the contact at the last posture, as columns in world axes, shape (3, 3)."""
        return np.asarray(self.numeric.placement(self.point).rotation) if self.case.in_contact_frame else np.eye(3)

    def _normals(self, normal: Array | None) -> tuple[Array, Array]:
        """Return ``normal``, by default the contact normal, in the axes ``normal_frame`` and in world axes."""
        normal = np.array(self.contact.normal) if normal is None else normal
        return normal, self.axes @ normal if self.case.in_contact_frame else normal

    def support_gradient(self, q: Array) -> Array:
        """Return the tangent Jacobian of the support impulses ``f``, shape (rows, nv).

        Row k uses the adjoint ``M p − J_sᵀr = 0, J_s p + εr = −e_k``: ``∂f_k = pᵀ∂(Jᵀn + J_sᵀf − M a) + rᵀ∂(J_s a)``.
        """
        rows = len(self.at(q).Js)
        normal, x = np.array(self.contact.normal), self.respond(self.J.T @ self.n)
        adjoints = self.respond(np.zeros((self._nv, rows)), -np.eye(rows))
        gradients = [
            self.coupling(normal, p, self.case.in_contact_frame) - self.inertial(ImpulseResponse(p, r), x)
            for p, r in zip(adjoints.a.T, adjoints.f.T, strict=True)
        ]
        return np.array(gradients).reshape(rows, self._nv)

    def coupling(self, direction: Array, v: Array, in_frame: bool) -> Array:
        """Return the tangent gradient of ``directionᵀJ(q) v`` for a constant ``v``, shape (nv,).

        The direction is constant in the contact frame if ``in_frame`` is true, and otherwise in the world.
        """
        wrench = np.concatenate([direction, np.zeros(3)])
        return self.numeric.coupling_gradient(self.point, wrench, v, in_frame=in_frame)

    def inertial(self, left: ImpulseResponse, right: ImpulseResponse) -> Array:
        """Return ``∂_q lᵀ(M + J_sᵀJ_s/ε)r = ∂_q [lᵀMr − f_lᵀJ_s r − f_rᵀJ_s l]``, shape (nv,).

        ``l`` and ``r`` are the velocity jumps of ``left`` and ``right``, and ``f_l`` and ``f_r`` are their support
        impulses.  The derivative treats ``l``, ``r``, ``f_l`` and ``f_r`` as constant.
        """
        gradient = self.numeric.inertial_gradient(left.a, right.a)
        start = 0
        for foot in self.feet:
            for held, moving in ((left, right), (right, left)):
                wrench = np.zeros(6)
                wrench[: foot.rows] = held.f[start : start + foot.rows]
                gradient = gradient - self.numeric.coupling_gradient(foot.point, wrench, moving.a)
            start += foot.rows
        return gradient

    def metric_gradient(self, a: Array) -> Array:
        """Return ``∂_q aᵀWa`` for a fixed ``a``, shape (nv,); zero unless W = M."""
        return self.numeric.inertial_gradient(a, a) if self.metric.kind == "kinetic" else np.zeros(self._nv)
