"""Keep two bodies apart by a separating plane with unknown coefficients.

Two convex bodies do not touch if a plane separates them (S. Boyd and L. Vandenberghe, Convex Optimization, 2004,
section 2.5).  Let ``{y: n·y = c}`` be a plane in the axes of body b, r the sweep radii and δ the clearance.  The
corners x of body a and the corners y of body b satisfy::

    m·x + d + s ≥ r_a + r_b + δ,      n·y − c ≤ 0,      n·n ≤ 1,
    m = Qᵀn,   d = n·t − c            (Q, t: placement of a in the axes of b)

Each row for a corner is linear in the unknowns (n, c, m, d, s).  Only four equations for each pair of bodies depend
on the posture.  With the slack s, a solver can start from bodies that penetrate each other.  A half-space has a known
plane, so n and c are constants.  The program has rows only for corners that a separating plane could touch.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import casadi as ca
import numpy as np
import pinocchio as pin

from impact_posture.collision.swept_hull import SweptHull, separation
from impact_posture.dynamics.numeric import Numeric
from impact_posture.dynamics.tree import PointOnLink, Tree
from impact_posture.impact.quantities.lifted_form import Guess
from impact_posture.posture.constraints.constraint import LiftedRows, Linearization
from impact_posture.system.arrays import Array

# Number of equations that define m and d for each pair.
EQUATIONS = 4
# Lower bound on n·n.  Without this lower bound, the normal n could shrink to zero if bodies penetrate each other, and
# the solver could not continue.
_SHORT = 0.8
# Initial slack minus penetration, m, so that the slack starts inside its bound.
_ABOVE = 0.01
# Initial length of the normal, so that the length starts inside its bounds.
_LENGTH = 0.98
# Unit of the unknown slack, m: one divided by ``SLACK_PRICE`` in ``posture_nlp.py``.  The multiplier of the slack is
# then one, which is the initial guess of IPOPT, and a run takes a quarter fewer iterations than with meters.
_UNIT = 0.02
# A corner gets a row if it is the closest to the plane, either untilted or tilted to one of eight sides.  This value
# is the tangent of the tilt angle.
_TILT = 0.5
_AROUND = np.array([[0.0, 0.0], *[[np.cos(a), np.sin(a)] for a in np.arange(8) * np.pi / 4]])
# A plane separates two bodies if it cuts less than this value (m) into a body.  The certificate accepts twice this
# value.
_KEPT = 5e-9
# If the distance of a corner from the plane exceeds this value, m, its row is inactive, and the linearization omits
# it.
_NEAR = 1e-3


@dataclass(frozen=True, eq=False)
class ConvexBody:
    """A swept hull or half-space that moves with a link, is fixed in the world, or follows a point without turning.

    Attributes:
        hull: Corners and sweep radius in the axes of ``point``; ``None`` for the half-space behind a plane.
        point: Point and axes to which the body is fixed; the joint with index 0 is the world.
        turns: Whether the body turns with the link; otherwise its axes stay parallel to the world axes.
        normal: Unit normal out of the half-space, in the axes of ``point``, shape (3,).
        offset: Offset of the boundary plane ``{y: normal·y = offset}`` of the half-space, m.
    """

    name: str
    hull: SweptHull | None
    point: PointOnLink
    turns: bool = True
    normal: Array | None = None
    offset: float = 0.0

    @staticmethod
    def of_link(hull: SweptHull) -> ConvexBody:
        """Return a swept hull as a body that is fixed to its link or to the world."""
        return ConvexBody(hull.name, hull, PointOnLink(hull.joint, np.zeros(3), np.eye(3)))

    @property
    def plane(self) -> Array:
        """Normal and offset of the half-space, shape (4,); empty for a swept hull."""
        return np.zeros(0) if self.normal is None else np.append(self.normal, self.offset)

    def placement(self, model: Numeric) -> pin.SE3:
        """Return the placement of the body axes in the world."""
        placement = model.placement(self.point)
        return placement if self.turns else pin.SE3(np.eye(3), placement.translation)

    @property
    def center(self) -> Array:
        """Center of the hull, or origin of the half-space, shape (3,).

        The axes are the joint axes if the body turns with the link, and the world axes otherwise.
        """
        center = np.zeros(3) if self.hull is None else self.hull.center
        return np.asarray(self.point.placement.act(center)) if self.turns else center

    def rates(self, model: Numeric, direction: Array, positions: Array) -> Array:
        """Return the tangent gradients, shape (k, nv), of ``direction·x`` for points x of the body.

        ``positions`` are the world positions of these points, shape (k, 3).
        """
        if self.point.joint == 0:
            return np.zeros((len(positions), model.model.nv))
        J = model.jacobian(self.point)
        heights = np.broadcast_to(direction @ J[:3], (len(positions), J.shape[1]))
        if not self.turns:
            return np.array(heights)
        arms = (positions - model.placement(self.point).translation) @ pin.skew(direction)
        return np.asarray(heights + arms @ J[3:])


class Corners(NamedTuple):
    """Indices of the corners of bodies ``a`` and ``b`` that have rows in the program."""

    a: frozenset[int]
    b: frozenset[int]


class SeparatingPlane:
    """The rows and unknowns of a plane that separates a swept hull ``a`` from a swept hull or half-space ``b``.

    ``margin`` is the clearance δ, m.
    """

    def __init__(self, a: ConvexBody, b: ConvexBody, margin: float) -> None:
        assert a.hull is not None  # noqa: S101 (narrows a type)
        self.a, self.b, self.name = a, b, f"{a.name} / {b.name}"
        self._x, self._y = a.hull.vertices, np.zeros((0, 3)) if b.hull is None else b.hull.vertices
        self.gap = a.hull.radius + (0.0 if b.hull is None else b.hull.radius) + margin
        self.margin = margin
        # Cache of the last distance with the placements of both bodies, because a search evaluates a posture several
        # times.
        self._latest: tuple[pin.SE3, pin.SE3, tuple[float, Array, Array]] | None = None

    @property
    def count(self) -> int:
        """Number of unknowns."""
        return 5 if self.known else 9

    def slack(self, unknowns: Array) -> float:
        """Return the slack, m, from the unknowns of :meth:`lift`."""
        return _UNIT * float(unknowns[-1])

    @property
    def known(self) -> bool:
        """Whether the plane is known, because ``b`` is a half-space."""
        return self.b.normal is not None

    def bounds(self, corners: Corners) -> tuple[Array, Array]:
        """Return the bounds of the rows of :meth:`sides`: the corners of ``a``, the corners of ``b``, and ``n·n``.

        The rows of :meth:`lift` are equations with both bounds zero.
        """
        of_a, of_b, normal = len(corners.a), len(corners.b), [] if self.known else [1.0]
        lower = np.array([*[self.gap] * of_a, *[-np.inf] * of_b, *[_SHORT] * len(normal)])
        return lower, np.array([*[np.inf] * of_a, *[0.0] * of_b, *normal])

    def content(self, corners: Corners) -> str:
        """Return the constants in the rows as text; the coefficients of a known plane are not constants."""
        bodies = [(b.point.joint, b.point.position.tolist(), b.point.rotation.tolist()) for b in (self.a, self.b)]
        points = self._x[sorted(corners.a)].tolist(), self._y[sorted(corners.b)].tolist()
        return repr((bodies, self.b.turns, self.known, points))

    def lift(self, tree: Tree, label: str, known: ca.SX) -> LiftedRows:
        """Return the equations, the unknowns ``n, c, m, d, s`` (``m, d, s`` for a half-space), and the slack.

        The unknown ``s`` is in units of 2 cm.  ``label`` is the suffix of the names of the unknowns.  ``known``
        contains ``n, c`` of a half-space, shape (4, 1), and is not used for a swept hull.
        """
        plane = ca.SX(0, 1) if self.known else ca.SX.sym(f"plane{label}", 4)
        m, d, s = ca.SX.sym(f"m{label}", 3), ca.SX.sym(f"d{label}"), ca.SX.sym(f"s{label}")
        n, c = ca.vertsplit(known if self.known else plane, [0, 3, 4])
        Q, t = self._relative(tree)
        return LiftedRows(ca.vertcat(m - Q.T @ n, d - (ca.dot(n, t) - c)), ca.vertcat(plane, m, d, s), _UNIT * s)

    def sides(self, variables: ca.SX, corners: Corners) -> ca.SX:
        """Return the rows of ``corners`` and of ``n·n`` as expressions of the unknowns of :meth:`lift`."""
        m, d, s = variables[-5:-2], variables[-2], variables[-1]
        rows = [ca.SX(self._x[sorted(corners.a)]) @ m + d + _UNIT * s]
        if not self.known:
            n, c = variables[:3], variables[3]
            rows += [ca.SX(self._y[sorted(corners.b)]) @ n - c, ca.dot(n, n)]
        return ca.vertcat(*rows)

    def corners(self, model: Numeric) -> Corners:
        """Return the corners closest to the separating plane, either untilted or tilted to one of eight sides."""
        normal = self.distance(model)[1]
        across = np.linalg.svd(normal[None])[2][1:]
        directions = normal + _TILT * _AROUND @ across
        first, second = (directions @ body.placement(model).rotation for body in (self.a, self.b))
        return Corners(
            frozenset(int(k) for k in (first @ self._x.T).argmin(axis=1)),
            frozenset(int(k) for k in (second @ self._y.T).argmax(axis=1)) if len(self._y) else frozenset(),
        )

    @property
    def every_corner(self) -> Corners:
        """All corners of both bodies; no corners if the plane is known, because the closest corner then suffices."""
        first, second = (0, 0) if self.known else (len(self._x), len(self._y))
        return Corners(frozenset(range(first)), frozenset(range(second)))

    def _relative(self, tree: Tree) -> tuple[ca.SX, ca.SX]:
        if self.b.turns:
            R, p = tree.relative(self.b.point.joint, self.a.point.joint)
            axes = ca.SX(self.b.point.rotation).T
            return axes @ R, axes @ (p - ca.SX(self.b.point.position))
        R, p = tree.relative(0, self.a.point.joint)
        return R, p - tree.position(self.b.point)

    def distance(self, model: Numeric) -> tuple[float, Array, Array]:
        """Return the distance minus the clearance, the world normal from b to a, and the closest points, (2, 3)."""
        at_a, at_b = self.a.placement(model), self.b.placement(model)
        if self._latest is None or self._latest[0] != at_a or self._latest[1] != at_b:
            self._latest = at_a, at_b, self._distance(at_a, at_b)
        return self._latest[2]

    def _distance(self, at_a: pin.SE3, at_b: pin.SE3) -> tuple[float, Array, Array]:
        if self.b.hull is not None:
            assert self.a.hull is not None  # noqa: S101 (narrows a type)
            nearest = separation(self.a.hull, at_a, self.b.hull, at_b)
            return nearest.distance - self.margin, nearest.normal, np.array([nearest.point_a, nearest.point_b])
        n = at_b.rotation @ self.b.normal
        points = self._x @ at_a.rotation.T + at_a.translation
        heights = (points - at_b.translation) @ n - self.b.offset
        lowest = points[int(np.argmin(heights))]
        return float(heights.min()) - self.gap, n, np.array([lowest, lowest - heights.min() * n])

    def guess(self, model: Numeric) -> Guess:
        """Return initial values and bounds of the unknowns, for the plane between the closest points."""
        value, normal, _ = self.distance(model)
        at_b = self.b.placement(model)
        relative = at_b.actInv(self.a.placement(model))
        n, c = self._plane(at_b, relative, normal)
        n = n if self.known else _LENGTH * n
        plane = [] if self.known else [*n, c]
        slack = (max(0.0, -value) + _ABOVE) / _UNIT
        values = np.array([*plane, *(n @ relative.rotation), n @ relative.translation - c, slack])
        lower = np.full(len(values), -np.inf)
        lower[-1] = 0.0
        return Guess(values, lower)

    def _plane(self, at_b: pin.SE3, relative: pin.SE3, normal: Array) -> tuple[Array, float]:
        """Return ``n, c``, in the axes of ``b``, of the plane midway between the bodies, given its world normal."""
        if self.b.normal is not None:
            return self.b.normal, self.b.offset
        n = normal @ at_b.rotation
        points = self._x @ relative.rotation.T + relative.translation
        return n, float((points @ n).min() - self.gap + (self._y @ n).max()) / 2

    def linearize(self, model: Numeric, unknowns: Array | None) -> Linearization:
        """Linearize the rows of corners near the plane with respect to the posture and (n, c).

        The plane is given by the unknowns of :meth:`lift`.  If ``unknowns`` is ``None``, the plane between the
        closest points is used.
        """
        if unknowns is not None and not self.known:
            rows = self.linearize_at(model, unknowns[:3], float(unknowns[3]))
            # Corners that have no row in the program may lie on the wrong side of the plane of the program.  The pair
            # is then inactive, and the plane between the closest points is used.
            if rows.violation <= _KEPT:
                return rows
        at_b = self.b.placement(model)
        relative = at_b.actInv(self.a.placement(model))
        return self.linearize_at(model, *self._plane(at_b, relative, self.distance(model)[1]))

    def linearize_at(self, model: Numeric, n: Array, c: float) -> Linearization:
        """Linearize the rows for the plane ``{y: n·y = c}``, given in the axes of body b."""
        at_a, at_b, nv = self.a.placement(model), self.b.placement(model), model.model.nv
        corners = self._x @ at_a.rotation.T + at_a.translation
        in_b = (corners - at_b.translation) @ at_b.rotation
        near = in_b @ n - c < self.gap + _NEAR
        corners, in_b = corners[near], in_b[near]
        world = at_b.rotation @ n
        rates = self.a.rates(model, world, corners) - self.b.rates(model, world, corners)
        first = len(in_b)
        names, lower, upper = [self.name] * first, np.full(first, self.gap), np.full(first, np.inf)
        if self.known:
            return Linearization(names, in_b @ n - c, lower, upper, rates, np.zeros((first, 0)))
        of_b = self._y[self._y @ n - c > -_NEAR]
        more = len(of_b) + 1
        of_plane = [np.c_[in_b, -np.ones(first)], np.c_[of_b, -np.ones(len(of_b))], [[*(2 * n), 0.0]]]
        return Linearization(
            names=[*names, *[""] * more],
            value=np.concatenate([in_b @ n - c, of_b @ n - c, [n @ n]]),
            lower=np.append(lower, np.full(more, -np.inf)),
            upper=np.concatenate([upper, np.zeros(len(of_b)), [1.0]]),
            posture=np.vstack([rates, np.zeros((more, nv))]),
            auxiliary=np.vstack(of_plane),
        )
