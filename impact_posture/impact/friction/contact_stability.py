"""Check whether support impulses within the friction cones can keep the feet in place during an impact.

The metric assumes that the feet stay in place, even if the ground would have to pull.  If ``J_s`` does not have full
row rank, the support impulses are not unique.  All solutions are ``f + N z``, where ``N`` is a basis of ``{f: J_sᵀ f
= 0}``, the impulses with which feet press against each other.  The weight has no effect, because it is a finite force
and the impact takes no time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from impact_posture.config.json_block import JsonBlock
from impact_posture.dynamics.linear_program import solve_linear
from impact_posture.impact.quantities.impact_oracle import ImpactOracle
from impact_posture.robot.robot_spec import Support
from impact_posture.system.arrays import Array

# A singular value of J_s below this fraction of the largest one is a rounding error.
_RANK = 1e-9
# An impulse below this fraction of the largest impulse is regarded as zero.
_NONE = 1e-6
# Number of sides of the pyramid that approximates the friction cone from inside.
_SIDES = 16
_MOST_FRICTION = 10.0


@dataclass(frozen=True, eq=False)
class FootImpulse(JsonBlock):
    """Support impulse on one foot per unit impulse of the impact.

    Attributes:
        frame: Frame of the foot.
        impulse: Impulse of the ground on the foot, world axes, shape (3,); positive z pushes the robot up.
        moment: Angular impulse about the contact point of the foot, world axes, shape (3,); zero for a point foot.
        lifts: Whether the foot lifts, because the ground would have to pull it.
    """

    frame: str
    impulse: Array
    moment: Array
    lifts: bool


@dataclass(frozen=True)
class ContactStability(JsonBlock):
    """Whether the feet can stay on the ground in an impact.

    Attributes:
        friction: Least friction coefficient for which all feet stay in place; infinite if above ten; ``None`` if a
            foot lifts or a sole tips for every friction coefficient.
        feet: Impulse on each foot.  The impulses are within the friction cones if possible, and otherwise minimize
            the largest pull of the ground.
        freedom: Dimension of the set of possible impulses; zero if the impulses are unique.
    """

    friction: float | None
    feet: tuple[FootImpulse, ...]
    freedom: int

    @property
    def line(self) -> str:
        """Description of the result for users."""
        lifting = [foot.frame for foot in self.feet if foot.lifts]
        if lifting:
            return f"the impact lifts {', '.join(lifting)}, although the metric assumes that all feet stay"
        if self.friction is None:
            return "a sole tips over its edge, although the metric assumes that all feet stay"
        if self.friction > _MOST_FRICTION:
            return f"the feet slide at any friction below {_MOST_FRICTION:g}"
        return f"the feet stay with a friction coefficient of {self.friction:.2f} or more"

    def to_dict(self) -> dict[str, object]:
        """Return JSON content."""
        block = super().to_dict()
        return block | {"stays": block["friction"] is not None, "verdict": self.line}


def contact_stability(oracle: ImpactOracle, supports: tuple[Support, ...], q: Array) -> ContactStability:
    """Compute support impulses at ``q``, shape (nq,), within the friction cones or, if impossible, of least pull.

    The ground is level, so the axis of every cone is world z.  A sole with a ``size`` transmits moments until its
    center of pressure reaches an edge.
    """
    particular = oracle.quantities(q).support_impulse
    values, vectors = np.linalg.eigh(oracle.Js @ oracle.Js.T)
    basis = vectors[:, values <= _RANK**2 * max(float(values[-1]), 1e-300)]
    cones = FrictionCones(supports, [oracle.numeric.placement(foot.point).rotation for foot in oracle.feet])
    none = _NONE * max(float(np.abs(particular).max(initial=0.0)), 1e-300)

    def verdict(friction: float | None, impulse: Array) -> ContactStability:
        return ContactStability(friction, cones.feet(impulse, none), basis.shape[1])

    lifting = cones.least_pull(particular, basis)
    if cones.pull(lifting) > none:
        return verdict(None, lifting)
    held = cones.within(particular, basis, _MOST_FRICTION)
    if held is None:
        # With a friction coefficient of 1e6, no foot slides.  If no impulses exist even then, a sole tips.
        tips = cones.within(particular, basis, 1e6) is None
        return verdict(None if tips else float("inf"), lifting)
    low, high = 0.0, _MOST_FRICTION
    while high - low > 1e-4:
        middle = (low + high) / 2
        impulse = cones.within(particular, basis, middle)
        low, high, held = (middle, high, held) if impulse is None else (low, middle, impulse)
    return verdict(high, held)


class FrictionCones:
    """The friction cones as inequalities ``A f ≤ 0`` on the stacked support impulses ``f``.

    ``axes`` contains the world axes of the frame of each foot, shape (3, 3).  The half extents of a sole are along
    these axes.
    """

    def __init__(self, supports: tuple[Support, ...], axes: Sequence[Array]) -> None:
        starts = np.cumsum([0, *[s.rows for s in supports]])
        self._size = int(starts[-1])
        self._feet = [(int(k), s, np.asarray(R)) for k, s, R in zip(starts, supports, axes, strict=False)]

    def matrix(self, friction: float) -> tuple[Array, list[str]]:
        """Return ``A``, shape (rows, impulses), for a friction coefficient, and the name of each row.

        Rows of each foot are ``−f_z ≤ 0`` and ``|f_t| ≤ μ f_z``.  Rows of each sole are also ``|τ_x| ≤ Y f_z`` and
        ``|τ_y| ≤ X f_z`` in the axes of the foot, and ``|τ_z| ≤ μ (X+Y)/2 f_z``.
        """
        names, rows = [f"{s.frame} lifts" for _, s, _ in self._feet], [*self._lifts()]

        def add(name: str, start: int, entries: Array) -> None:
            names.append(name)
            rows.append(np.zeros(self._size))
            rows[-1][start : start + len(entries)] = entries

        for start, support, R in (foot for foot in self._feet if foot[1].kind == "surface"):
            for axis, reach in ((0, support.size[1]), (1, support.size[0])):
                for sign in (1.0, -1.0):
                    add(f"{support.frame} tips", start, np.array([0.0, 0.0, -reach, *(sign * R[:, axis])]))
        inner = friction * np.cos(np.pi / _SIDES)
        for start, support, _ in self._feet:
            for angle in 2 * np.pi * np.arange(_SIDES) / _SIDES:
                add(f"{support.frame} slides", start, np.array([np.cos(angle), np.sin(angle), -inner]))
            if support.kind == "surface":
                twist = friction * sum(support.size) / 2
                for sign in (1.0, -1.0):
                    add(f"{support.frame} turns", start, np.array([0.0, 0.0, -twist, 0.0, 0.0, sign]))
        return np.array(rows), names

    def _lifts(self) -> Array:
        rows = np.zeros((len(self._feet), self._size))
        for row, (start, _, _) in zip(rows, self._feet, strict=True):
            row[start + 2] = -1.0
        return rows

    def pull(self, impulse: Array) -> float:
        """Return the largest pull of the ground on any foot; zero if the ground pushes all feet."""
        return float(np.max(self._lifts() @ impulse, initial=0.0))

    def least_pull(self, particular: Array, basis: Array) -> Array:
        """Return the impulses ``particular + basis z`` for which the largest pull of the ground is least."""
        up, count = self._lifts(), basis.shape[1]
        if not count:
            return particular
        # min t: -f_z ≤ t, t ≥ 0.
        z = _least_last(np.hstack([up @ basis, -np.ones((len(up), 1))]), -up @ particular, 0.0)
        return particular if z is None else particular + basis @ z

    def within(self, particular: Array, basis: Array, friction: float) -> Array | None:
        """Return the impulses ``particular + basis z`` within the cones with the least maximum norm, or ``None``."""
        A, _ = self.matrix(friction)
        slack = 1e-9 * max(float(np.abs(particular).max(initial=0.0)), 1e-300)
        if not basis.shape[1]:
            return particular if (A @ particular <= _NONE * np.abs(particular).max(initial=1e-300)).all() else None
        limits = np.vstack([np.hstack([sign * basis, -np.ones((len(particular), 1))]) for sign in (1.0, -1.0)])
        rows = np.vstack([np.hstack([A @ basis, np.zeros((len(A), 1))]), limits])
        right = np.concatenate([slack - A @ particular, -particular, particular])
        z = _least_last(rows, right, -np.inf)
        return None if z is None else particular + basis @ z

    def feet(self, impulse: Array, none: float) -> tuple[FootImpulse, ...]:
        """Return the impulse on each foot.  A foot lifts if the ground would pull it by more than ``none``."""
        feet = []
        for start, support, _ in self._feet:
            foot_impulse = impulse[start : start + support.rows]
            moment = foot_impulse[3:] if support.rows == 6 else np.zeros(3)
            feet.append(
                FootImpulse(support.frame, foot_impulse[:3].copy(), moment.copy(), bool(foot_impulse[2] < -none))
            )
        return tuple(feet)


def _least_last(A: Array, b: Array, least: float) -> Array | None:
    """Return the ``z`` for which ``A [z; t] ≤ b`` with the smallest ``t ≥ least``; ``None`` if there is none."""
    count, free = A.shape[1] - 1, np.full(A.shape[1] - 1, np.inf)
    cost, low, high = np.append(np.zeros(count), 1.0), np.append(-free, least), np.append(free, np.inf)
    optimum = solve_linear(cost, A, np.full(len(b), -np.inf), b, low, high)
    return None if optimum is None else optimum.x[:-1]
