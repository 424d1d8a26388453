"""First and second derivatives of the torques of a robot at rest, in closed form.

Gravity and the forces of feet do not turn with the links.  Let ``u_p = R_bᵀ f_p`` be the force at a point p in the
axes of the floating base, with the weights at the centers of mass.  All vectors here are in these axes.  With
``J_pk = v_k + ω_k × p`` the velocity of p under joint k, the torques are ``τ_k = −Σ_p J_pkᵀ u_p`` over the points
beyond k.  Moving joint k turns the axes beyond it by ``ω_k`` and moves a point by ``J_pk``.  So ::

    ∂τ_j/∂q_k          = −ω_j · N_k                                   for k = j or beyond j, and symmetric
    ∂²(bᵀτ)/∂q_k∂q_l   = −ω_k · y_l − (w_k × ω_k) · N_l               for l = k or beyond k
    A_k = Σ_p J_pk u_pᵀ,  N_k = Σ_p J_pk × u_p,  B_k = A_k − tr(A_k) 1,  y_l = B_l w_l + (Σ b_m B_m) ω_l

``w_k`` is the angular velocity of the parent of k under b.  Sums over p are over the points beyond the joint, that
over m over l and all joints beyond it.  The base is one more joint that turns about each axis.  ``bᵀτ`` is linear in
``u``, whose own derivatives over the quaternion and the forces are those of small products.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import casadi as ca

from impact_posture.dynamics.kinematics import ByJoint, Kinematics, PointOnLink
from impact_posture.dynamics.root_axes import RootAxes, kept
from impact_posture.dynamics.spatial import constant, cross, skew, template


class StaticDerivatives(RootAxes):
    """Derivatives of ``τ(q, z) = h(q) − Σ J_pᵀ f_p(z)`` of a robot with a floating base.

    Args:
        tree: The tree at the configuration, with its chart coordinates.
        gravity: Acceleration of gravity in world axes, shape (3,).
        points: The points where forces act.
    """

    def __init__(self, tree: Kinematics, gravity: ca.SX, points: Sequence[PointOnLink]) -> None:
        super().__init__(tree)
        self._gravity, self._points = gravity, tuple(points)

    @property
    def exist(self) -> bool:
        """Whether the robot has one root, which flies, and all other joints have one degree of freedom."""
        first = self._tree.chart.slots[0]
        alone = len(self._beyond) == len(self._tree.chart.slots) - 1
        return super().exist and alone and first.kind.family == "free-flyer"

    def of(self, x: ca.SX, forces: Sequence[ca.SX], z: ca.SX, b: ca.SX) -> tuple[ca.SX, ca.SX]:
        """Return the Jacobian of τ and the Hessian of ``bᵀτ`` over chart coordinates and ``z``.

        Args:
            x: Chart coordinates of the configuration, shape (nx,).
            forces: The force at each point in world axes, shape (3,) each, linear in ``z``.
            z: Unknowns of the forces, shape (k,).
            b: Multipliers, shape (nv,).
        """
        slots, nx, count = self._tree.chart.slots, self._tree.chart.nx, z.numel()
        base, joints = list(range(nx))[slots[0].x], [slot.x.start for slot in self._beyond]
        of_base = [*base, *range(nx, nx + count)]
        around, turned = ca.vertcat(x[base], z), self._tree.rotations[slots[0].index].T
        u = ca.vertcat(turned @ self._gravity, *[turned @ force for force in forces])
        by_u, rates, mixed, by_joints, curvature = self._in_base_axes(u, b)
        du = ca.jacobian(u, around)
        jacobian, hessian = ca.SX(self._tree.nv, nx + count), ca.SX(nx + count, nx + count)
        jacobian[:, joints], jacobian[:, of_base] = -by_joints, -by_u.T @ du
        hessian[joints, joints] = -curvature
        across = -mixed @ du
        hessian[joints, of_base], hessian[of_base, joints] = across, across.T
        symbols = ca.SX.sym("rates", u.numel())
        bent = ca.hessian(ca.dot(symbols, u), around)[0]
        hessian[of_base, of_base] = -ca.substitute(bent, symbols, rates)
        return ca.sparsify(jacobian), ca.sparsify(hessian)

    def _in_base_axes(self, u: ca.SX, b: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX, ca.SX]:
        """Return the derivatives of ``Σ J_pᵀu_p`` where all is in the axes of the base.

        These are its derivative over u, transposed; its product with b over u; the derivative of that over joints;
        its derivative over joints; and the second derivative of its product with b.
        """
        S, weight = self._subspaces, u[:3]
        own = [slot.v.start for slot in self._beyond]
        S_w = S[3:, :]
        velocities, momenta = self._moving(b)
        pushed = [u[3 * k : 3 * k + 3] for k in range(1, 1 + len(self._points))]
        # Sums of forces and of the products of points and forces over subtrees.
        total: ByJoint = {i: ca.SX(3, 1) for i in self._places}
        dyads: ByJoint = {i: ca.SX(3, 3) for i in self._places}
        for point, place, force in zip(self._points, self._positions, pushed, strict=True):
            total[point.joint] += force
            dyads[point.joint] += place @ force.T
        total, dyads = self._gathered(total), self._gathered(dyads)
        B: ByJoint = {i: ca.SX(3, 3) for i in self._places}
        shares: ByJoint = dict(B)
        N, crossed, mixed = list[ca.SX](), list[ca.SX](), list[ca.SX]()
        for slot in self._beyond:
            i, k, before = slot.index, slot.v.start, velocities[self._parents[slot.index]]
            weighed = S[:, k], self._masses[i], self._moments[i]
            B[i], shares[i], moment, turn, row = _of_joint(
                *weighed, total[i], dyads[i], weight, before, momenta[i], b[k]
            )
            N.append(moment)
            crossed.append(turn)
            rows = [row]
            for point, place in zip(self._points, self._positions, strict=True):
                beyond = i in self._tree.model.supports[point.joint]
                rows.append(_of_point(S[:, k], place, before, velocities[point.joint]) if beyond else ca.SX(3, 1))
            mixed.append(ca.vertcat(*rows).T)
        sums = self._gathered(shares)
        y = [
            _bent(B[i], velocities[self._parents[i]], sums[i], S[:, k]) for i, k in zip(self._of_u, own, strict=True)
        ]
        turns, moments = S_w[:, own], ca.horzcat(ca.SX(3, 0), *N)
        products = ca.vertcat(ca.horzcat(ca.SX(3, 0), *y), moments).T @ ca.vertcat(
            turns, ca.horzcat(ca.SX(3, 0), *crossed)
        )
        curvature = ca.tril2symm(kept(products, self._lies_on(self._of_u, self._of_u)))
        outer = kept(moments.T @ S_w, self._lies_on(self._of_u, self._of_v))
        by_joints = outer.T
        by_joints[own, :] += kept(outer[:, own], self._lies_on(self._of_u, self._of_u, itself=False))
        rates = [momenta[self._tree.chart.slots[0].index]]
        for point, place in zip(self._points, self._positions, strict=True):
            rates.append(_velocity(velocities[point.joint], place))
        return self._jacobian, ca.vertcat(*rates), ca.vertcat(ca.SX(0, u.numel()), *mixed), by_joints, curvature

    @cached_property
    def _positions(self) -> list[ca.SX]:
        """The points."""
        places = [self._places[point.joint] for point in self._points]
        return [p + R @ constant(point.position) for (R, p), point in zip(places, self._points, strict=True)]

    @cached_property
    def _masses(self) -> ByJoint:
        """Mass of the subtree of every joint."""
        return self._gathered({i: ca.SX(float(self._tree.model.inertias[i].mass)) for i in self._places})

    @cached_property
    def _of_links(self) -> ByJoint:
        """First moment of every link."""
        found: ByJoint = {}
        for i, (R, p) in self._places.items():
            body = self._tree.model.inertias[i]
            found[i] = float(body.mass) * (p + R @ constant(body.lever))
        return found

    @cached_property
    def _moments(self) -> ByJoint:
        """First moment of the subtree of every joint."""
        return self._gathered(self._of_links)

    @cached_property
    def _jacobian(self) -> ca.SX:
        """Momentum of the robot, then velocities of the points, under unit velocities, shape (3 + 3p, nv)."""
        S = self._subspaces
        columns = [self._masses[i] * S[:3, k] + cross(S[3:, k], self._moments[i]) for k, i in enumerate(self._of_v)]
        blocks = [ca.horzcat(*columns)]
        for point, place in zip(self._points, self._positions, strict=True):
            velocity = kept(S[:3, :] - skew(place) @ S[3:, :], self._lies_on([point.joint] * 3, self._of_v))
            blocks.append(velocity)
        return ca.vertcat(*blocks)

    def _moving(self, b: ca.SX) -> tuple[ByJoint, ByJoint]:
        """Return spatial velocities of links about the origin of the base, and momenta of subtrees, under b."""
        velocities: ByJoint = {0: ca.SX(6, 1)}
        momenta: ByJoint = {}
        for slot in self._tree.chart.slots:
            i = slot.index
            velocities[i] = velocities[self._parents[i]] + self._subspaces[:, slot.v] @ b[slot.v]
            mass = ca.SX(float(self._tree.model.inertias[i].mass))
            momenta[i] = _momentum(velocities[i], mass, self._of_links[i])
        return velocities, self._gathered(momenta)


@template
def _velocity(motion: ca.SX, place: ca.SX) -> ca.SX:
    """Return the velocity of a point under a spatial motion about the origin."""
    return motion[:3] + cross(motion[3:], place)


@template
def _momentum(motion: ca.SX, mass: ca.SX, moment: ca.SX) -> ca.SX:
    """Return the linear momentum of a body under a spatial motion about the origin."""
    return mass * motion[:3] + cross(motion[3:], moment)


@template
def _of_joint(
    S: ca.SX,
    mass: ca.SX,
    moment: ca.SX,
    total: ca.SX,
    dyad: ca.SX,
    weight: ca.SX,
    before: ca.SX,
    momentum: ca.SX,
    b: ca.SX,
) -> tuple[ca.SX, ...]:
    """Return ``B``, ``bB``, ``N``, ``w × ω``, and the derivative over the joint of the momentum of its subtree."""
    v, w, turning = S[:3], S[3:], before[3:]
    A = v @ (total + mass * weight).T + skew(w) @ (dyad + moment @ weight.T)
    N = ca.vertcat(A[1, 2] - A[2, 1], A[2, 0] - A[0, 2], A[0, 1] - A[1, 0])
    B = A - ca.trace(A) * ca.SX.eye(3)
    rest = momentum - _momentum(before, mass, moment)
    return B, b * B, N, cross(turning, w), cross(turning, _momentum(S, mass, moment)) + cross(w, rest)


@template
def _of_point(S: ca.SX, place: ca.SX, before: ca.SX, motion: ca.SX) -> ca.SX:
    """Return the derivative over a joint of the velocity of a point beyond it."""
    rest = _velocity(motion - before, place)
    return cross(before[3:], _velocity(S, place)) + cross(S[3:], rest)


@template
def _bent(B: ca.SX, before: ca.SX, beyond: ca.SX, S: ca.SX) -> ca.SX:
    """Return ``y``."""
    return B @ before[3:] + beyond @ S[3:]
